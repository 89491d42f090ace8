"""From observations to cameras and rigs."""

from kcal.doors import door

__getattr__, __dir__ = door(__name__, __file__)
