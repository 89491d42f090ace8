"""Boards, detection, sub-pixel refinement and observation files."""

from kcal.doors import door

__getattr__, __dir__ = door(__name__, __file__)
