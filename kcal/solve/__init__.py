"""Nonlinear least squares that knows nothing of cameras."""

from kcal.doors import door

__getattr__, __dir__ = door(__name__, __file__)
