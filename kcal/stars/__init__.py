"""Stars of night images: found, named, and what they tell of attitudes, rigs and lenses."""

from kcal.doors import door

__getattr__, __dir__ = door(__name__, __file__)
