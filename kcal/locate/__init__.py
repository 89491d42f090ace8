"""Positions, triangulation, the ground and geodesy; `Localizer` and `locate_points` are in `kcal`."""

from kcal.doors import door

__getattr__, __dir__ = door(__name__, __file__)
