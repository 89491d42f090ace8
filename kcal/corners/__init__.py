"""Find boards and points in images; `Board`, `Observations` and `detect` are in `kcal`."""

from kcal.doors import door

__getattr__, __dir__ = door(__name__, __file__)
