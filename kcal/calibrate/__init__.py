"""Calibrate several cameras, compare models, judge results, measure boards; `calibrate_camera` is in `kcal`."""

from kcal.doors import door

__getattr__, __dir__ = door(__name__, __file__)
