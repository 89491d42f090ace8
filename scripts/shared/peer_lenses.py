"""Cameras that OpenCV, mrcal and lensboy calibrate from the same corners, as cameras that one judge can take.

mrcal's splined lens is the documented one (mrcal.secretsauce.org/splined-models.html): u = 2 tan(θ/2) along the way
to the point from the axis, q = f (u + Δu(u)) + c, and Δu a uniform cubic B-spline whose control points are the
parameters, row by row, both components of each side by side. mrcal and lensboy run in interpreters of their own.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from scipy.interpolate import NdBSpline
from torch import Tensor

from kcal import Board, Camera, Observations
from scripts.shared.children import answered, interpreter
from scripts.shared.held_out import held_out

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


def splined(
    lens: str,
    corners: np.ndarray,
    weight: np.ndarray,
    held: np.ndarray,
    *,
    size: tuple[int, int],
    board: Board,
    focal: float,
    field_of_view: int | None = None,
    timeout: float | None = None,
    peer: str = "mrcal",
) -> dict[str, Any]:
    """Fit a spline to all views but those held out: seconds, the lens, and w² |r|² of the latter with its count.

    Args:
        lens: for example SPLINED11x8; of lensboy OPENCV14, too.
        corners: (V, N, 2) pixels.
        weight: (V, N).
        held: numbers of the views that are held out.
        size: of the image.
        board: of the corners.
        focal: about the focal length, pixels.
        field_of_view: degrees that the splines cover along x, around the given focal length; None: 170, around the
            focal length that mrcal finds.
        timeout: seconds.
        peer: mrcal or lensboy.

    Raises:
        subprocess.SubprocessError: it failed, or took longer.
    """
    field = [] if field_of_view is None else [str(field_of_view)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "problem.npz")
        np.savez(
            path,
            corners=corners,
            weight=weight,
            train=np.setdiff1d(np.arange(len(corners)), held),
            held=held,
            image_size=np.array(size),
            board_size=np.array([board.columns, board.rows]),
            square_m=board.square,
            focal=focal,
        )
        return answered(interpreter(peer), f"scripts/bench/peer_{peer}.py", path, lens, *field, timeout=timeout)


KNOTS = 8, 6
_STARTS = 1.0, 0.8, 1.25  # times the rough focal length: mrcal's first poses may be tilted the wrong way
_MARGIN = 1.5  # of the field of view: knots must reach beyond the image, whose center mrcal moves
_STEPS = 100


class SplinedCamera:
    """A lens of mrcal, from what `scripts/bench/peer_mrcal.py` prints."""

    def __init__(self, found: dict[str, Any], size: tuple[int, int], knots: tuple[int, int] = KNOTS) -> None:
        values = torch.tensor(found["intrinsics"], dtype=torch.float64)
        self.size = size
        self._focal, self._center = values[:2], values[2:4]
        spacing = float(found["knots"][1] - found["knots"][0])
        knots_of = (spacing * (np.arange(count + 4) - 0.5 * (count + 3)) for count in knots)
        self._spline = NdBSpline(tuple(knots_of), values[4:].reshape(*knots[::-1], 2).movedim(1, 0).numpy(), 3)

    def _shift(self, u: Tensor) -> Tensor:
        """Δu (N, 2) at u (N, 2)."""
        return torch.from_numpy(self._spline(u.numpy()))

    def project(self, points_cam: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (..., N, 2), and valid (..., N): not straight behind."""
        flat = points_cam.reshape(-1, 3)
        reach = flat.norm(dim=-1) + flat[:, 2]
        valid = reach > 1e-9 * flat.norm(dim=-1)
        u = 2.0 * flat[:, :2] / torch.where(valid, reach, 1.0)[:, None]
        pixels = self._focal * (u + self._shift(u)) + self._center
        return pixels.reshape(*points_cam.shape[:-1], 2), valid.reshape(points_cam.shape[:-1])

    def unproject(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Rays (..., N, 3) and valid (..., N), by iteration."""
        target = (pixels.reshape(-1, 2) - self._center) / self._focal
        u = target
        for _ in range(_STEPS):
            u = target - self._shift(u)
        quarter = 0.25 * u.square().sum(-1, keepdim=True)  # tan² of half the angle
        rays = torch.cat([u, 1.0 - quarter], -1) / (1.0 + quarter)
        valid = ((u + self._shift(u) - target).norm(dim=-1) * self._focal[0] < 0.1) & rays.isfinite().all(-1)
        return rays.reshape(*pixels.shape[:-1], 3), valid.reshape(pixels.shape[:-1])


def splined_camera(seen: Observations, weight: Tensor) -> SplinedCamera:
    """Fit mrcal's spline to all views, started and dimensioned by OpenCV's fisheye: the best of three fits.

    Raises:
        subprocess.SubprocessError: mrcal failed.
        cv2.error: OpenCV failed.
    """
    rough = fisheye(seen)
    width, height = seen.image_size
    sides = torch.tensor([[0.0, 0.5 * height], [width - 1.0, 0.5 * height]], dtype=torch.float64)
    rays, valid = rough.unproject(sides)
    field = math.degrees(math.acos(max(-1.0, float(torch.linalg.vecdot(rays[0], rays[1])))))
    field = min(170, math.ceil(_MARGIN * field)) if bool(valid.all()) else 170
    cameras = []
    for factor in _STARTS:
        found = splined(
            f"SPLINED{KNOTS[0]}x{KNOTS[1]}", seen.pixels().numpy(), weight.numpy(), np.zeros(0, dtype=np.int64),
            size=seen.image_size, board=seen.board, focal=factor * float(rough.focal.detach()[0]), field_of_view=field,
            timeout=300,
        )  # fmt: skip
        cameras.append(SplinedCamera(found, seen.image_size))
    return min(cameras, key=lambda camera: held_out(camera, seen.board.points, seen.pixels(), weight).still)
