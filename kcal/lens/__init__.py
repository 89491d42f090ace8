"""Lens models, images, error bars of cameras, and exchange with other programs; `Camera` is in `kcal`."""

from kcal.doors import door

__getattr__, __dir__ = door(__name__, __file__)
