"""Lens models, cameras and rigs in pure torch."""

from kcal.doors import door

__getattr__, __dir__ = door(__name__, __file__)
