"""From pixel pairs to positions on the Earth."""

from kcal.doors import door

__getattr__, __dir__ = door(__name__, __file__)
