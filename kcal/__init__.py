"""kcal: camera calibration and long-range stereo localization for PyTorch.

The names here are those that most programs need; the others are in `kcal.lens`, `kcal.corners`, `kcal.calibrate`,
`kcal.rig`, `kcal.locate`, `kcal.track`, `kcal.report` and `kcal.solve`. All are loaded when they are first used.
"""

from __future__ import annotations

from typing import Any

from kcal.doors import door

__version__ = "0.1.0"

_find, __dir__ = door(__name__, __file__)


def __getattr__(name: str) -> Any:
    from kcal import old_names

    return old_names.find(name) if name in old_names.PLACES else _find(name)
