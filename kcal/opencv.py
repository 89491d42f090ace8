"""OpenCV, or why it cannot be used: its packages share one folder, where the last one installed replaces the others."""

from __future__ import annotations

import importlib.metadata

from kcal.errors import KcalError

# The youngest of the functions that kcal calls: OpenCV 4.12 has all of them. What is left of two packages, after one of
# them was removed, has none.
_NEEDED = ("FileStorage", "SIFT_create", "findChessboardCornersSBWithMeta", "fisheye", "stereoRectify", "VideoCapture")
_OWN = "opencv-contrib-python-headless"


class OpenCVError(KcalError):
    """OpenCV is missing, damaged, or of a package that needs what this computer has not."""


def _what_to_do(found: str) -> str:
    packages = sorted(name for name in ("opencv-python", "opencv-python-headless", "opencv-contrib-python", _OWN)
                      if any(importlib.metadata.distributions(name=name)))  # fmt: skip
    beside = f"{' and '.join(packages)} are installed into the same folder; " if len(packages) > 1 else ""
    remove = f"pip uninstall -y {' '.join(packages)} && " if packages else ""
    return f"OpenCV cannot be used ({found}); {beside}{remove}pip install '{_OWN}>=5,<6' mends it"


try:
    import cv2 as cv2
except ImportError as error:
    raise OpenCVError(_what_to_do(str(error).splitlines()[0])) from error
if missing := [name for name in _NEEDED if not hasattr(cv2, name)]:
    raise OpenCVError(_what_to_do(f"{getattr(cv2, '__version__', 'cv2')} has no {missing[0]}"))
