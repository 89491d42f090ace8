"""Pictures, pages, the map, and the verdict."""

from kcal.doors import door

__getattr__, __dir__ = door(__name__, __file__)
