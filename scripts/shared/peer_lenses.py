"""Cameras that OpenCV calibrates from the same corners, as cameras of kcal."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np

from kcal import Camera, Observations

FLAGS = {5: 0, 8: cv2.CALIB_RATIONAL_MODEL}
FLAGS[12] = FLAGS[8] | cv2.CALIB_THIN_PRISM_MODEL
FLAGS[14] = FLAGS[12] | cv2.CALIB_TILTED_MODEL
END = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 1000, 1e-12)


def calibrated(
    seen: Observations, coefficients: int, *, release: bool = False, **options: Any
) -> tuple[float, Any, Any]:
    """RMS, matrix and 5, 8, 12 or 14 coefficients of `cv2.calibrateCamera`; `release`: of `cv2.calibrateCameraRO`.

    Raises:
        cv2.error: OpenCV failed.
    """
    # The corner at the other end of the first row sets the scale where corners are free.
    fixed = [seen.board.columns - 1] if release else []
    solve: Any = cv2.calibrateCameraRO if release else cv2.calibrateCamera
    rms, matrix, distortion, *_ = solve(
        *_lists(seen), seen.image_size, *fixed, None, None, flags=FLAGS[coefficients], **options
    )
    return float(rms), matrix, distortion.ravel()[:coefficients]


def opencv(seen: Observations, coefficients: int, **options: Any) -> Camera:
    """The camera of `calibrated`."""
    _, matrix, distortion = calibrated(seen, coefficients, **options)
    return as_camera(matrix, distortion, seen.image_size, f"opencv{coefficients}")


def fisheye(seen: Observations) -> Camera:
    """`cv2.fisheye.calibrate`, from its own start and from focal lengths of 100 to 220 degrees; the lowest RMS.

    Raises:
        cv2.error: OpenCV failed from every start.
    """
    points, pixels = (tuple(part[None] for part in parts) for parts in _lists(seen, np.float64))
    width, height = seen.image_size
    always = cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW
    found, failure = [], cv2.error("cv2.fisheye.calibrate failed")
    for angle in (None, 100, 140, 180, 220):
        start = np.eye(3)
        if angle is not None:
            focal = width / math.radians(angle)
            start = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
        flags = always | (0 if angle is None else cv2.CALIB_USE_INTRINSIC_GUESS)
        try:
            rms, matrix, distortion, _, _ = cv2.fisheye.calibrate(
                points, pixels, seen.image_size, start, np.zeros((4, 1)), flags=flags, criteria=END
            )
        except cv2.error as error:
            failure = error
            continue
        if math.isfinite(rms) and np.isfinite(matrix).all() and matrix[0, 0] > 0:
            found.append((rms, matrix, distortion.ravel()))
    if not found:
        raise failure
    _, matrix, distortion = min(found, key=lambda one: one[0])
    return as_camera(matrix, distortion, seen.image_size, "fisheye4")


def as_camera(matrix: np.ndarray, coefficients: np.ndarray, size: tuple[int, int], model: str) -> Camera:
    return Camera.build(
        focal=(matrix[0, 0], matrix[1, 1]),
        center=(matrix[0, 2], matrix[1, 2]),
        size=size,
        coefficients=coefficients.tolist(),
        model=model,
    )


def _lists(seen: Observations, dtype: type = np.float32) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Corners on the board and in the image, those seen of each view that has enough of them."""
    pixels, points = seen.pixels().numpy(), seen.board.points.numpy()
    good = np.isfinite(pixels).all(-1)
    kept = [(points[one], view[one]) for view, one in zip(pixels, good, strict=True) if one.sum() >= 8]
    return tuple(p.astype(dtype) for p, _ in kept), tuple(q.astype(dtype) for _, q in kept)
