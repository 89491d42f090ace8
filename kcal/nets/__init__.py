"""Networks of the paper beside a calibrated camera: residual, field and inverse."""

from kcal.doors import door

__getattr__, __dir__ = door(__name__, __file__)
