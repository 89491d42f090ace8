"""From a detector's boxes in two videos to pairs and tracks."""

from kcal.doors import door

__getattr__, __dir__ = door(__name__, __file__)
