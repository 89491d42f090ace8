"""kcal: camera calibration and long-range stereo localization for PyTorch.

The names here are those that most programs need; the others are in `kcal.lens`, `kcal.corners`, `kcal.calibrate`,
`kcal.rig`, `kcal.locate`, `kcal.track`, `kcal.report`, `kcal.solve`, `kcal.stars` and `kcal.nets`. All are loaded when
they are first used.
"""

from __future__ import annotations

from typing import Any

from kcal.doors import door
from kcal.old_names import GONE, PLACES, find_old

__version__ = "1.0.0"

_find, __dir__ = door(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name in GONE:
        raise AttributeError(f"kcal.{name} is gone; in its place: {GONE[name]}")
    return find_old(name) if name in PLACES else _find(name)
