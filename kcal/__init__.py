"""kcal: camera calibration and long-range stereo localization for PyTorch.

The names here are those that most programs need; the others are in `kcal.lens`, `kcal.corners`, `kcal.calibrate`,
`kcal.rig`, `kcal.locate`, `kcal.track`, `kcal.report`, `kcal.solve`, `kcal.stars` and `kcal.nets`. All are loaded when
they are first used.
"""

from __future__ import annotations

from kcal.doors import door

__version__ = "2.0.0"

__getattr__, __dir__ = door(__name__, __file__)
