"""Stars of night images: detection, names, and the attitudes, rigs and lenses that they determine."""

from kcal.doors import door

__getattr__, __dir__ = door(__name__, __file__)
