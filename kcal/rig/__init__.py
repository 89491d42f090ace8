"""Stereo rigs: what they are solved from, what was found, and whether they have turned since."""

from kcal.doors import door

__getattr__, __dir__ = door(__name__, __file__)
