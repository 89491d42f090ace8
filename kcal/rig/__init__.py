"""Read and match surveys, place rigs, and notice when they have turned; `solve_rig` is in `kcal`."""

from kcal.doors import door

__getattr__, __dir__ = door(__name__, __file__)
