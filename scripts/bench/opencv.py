"""kcal beside OpenCV on OpenCV's own 13 stereo pairs: projection, calibration, rig, time.

KCAL_DATA holds `opencv_stereo/left01.jpg` ... `right14.jpg` (OpenCV's samples; Debian ships them in opencv-doc). Both
sides get the same corners, found by kcal and rounded to float32, as OpenCV wants them. RMS is sqrt(mean ‖r‖²) over
points, of OpenCV as it returns it. Times are of whole calls in one process on one thread, the two sides in turn.
"""

from __future__ import annotations

import functools
import itertools
import statistics
from collections.abc import Callable
from functools import partial
from typing import Any

import cv2
import numpy as np
import torch

from kcal import CalibrationOptions, Camera, Observations, RigOptions, calibrate_camera, calibrate_rig
from kcal.report.judge_rig import triangulated_sides
from kcal.rig import pair_by_name
from scripts.shared.captures import as_observations
from scripts.shared.page import Lines, section, times
from scripts.shared.peer_lenses import calibrated
from scripts.shared.real_captures import stereo_images

CRITERIA = (3, 300, 1e-12)
MODELS = ("opencv5", "opencv8", "opencv12", "opencv14")


@functools.cache
def _observe(side: str) -> Observations:
    found = stereo_images(side)
    rounded = as_observations(found.pixels().float().double(), found.image_size, found.board).views
    views = (view.model_copy(update={"pixels": own.pixels}) for view, own in zip(found.views, rounded, strict=True))
    return found.model_copy(update={"views": tuple(views)})


@section("other-programs.md", "opencv, projection")
def projection() -> Lines:
    yield ["coefficients", "largest difference, px"]
    generator = np.random.default_rng(0)
    lens = generator.normal(size=14) * [0.2, 0.05, 1e-3, 1e-3, 0.02, 0.05, 0.02, 0.01, *[1e-3] * 4, 0.02, 0.02]
    points = generator.uniform(-1, 1, (2000, 3)) * [1.2, 0.7, 0.5] + [0, 0, 2]
    matrix = np.array([[1600, 0, 957.0], [0, 1590, 541], [0, 0, 1]])
    for count in (4, 5, 8, 12, 14):
        theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, lens[:count])[0][:, 0]
        camera = Camera.build(
            focal=(1600, 1590),
            center=(957, 541),
            size=(1920, 1080),
            coefficients=lens[:count].tolist(),
            model=f"opencv{count}",
        )
        ours, valid = camera.project(torch.from_numpy(points))
        difference = np.abs(ours.numpy() - theirs)[valid.numpy()].max()
        yield [count, f"{difference:.1e} ({int(valid.sum())} points)"]


@section("other-programs.md", "opencv, cameras", repeats=1, models=("opencv5",))
def cameras(repeats: int = 5, models: tuple[str, ...] = MODELS) -> Lines:
    yield ["camera", "model", "RMS kcal, px", "RMS OpenCV", "difference", "kcal, ms", "OpenCV, ms", "ratio"]
    for side, model in itertools.product(("left", "right"), models):
        options = CalibrationOptions(model=model, weak_prior=None, weighted=False)
        seen = _observe(side)
        count = int(model.removeprefix("opencv"))
        ours, theirs, spent = _in_turn(
            partial(calibrate_camera, seen, options), partial(calibrated, seen, count, criteria=CRITERIA), repeats
        )
        ratios = [a / b for a, b in zip(*spent, strict=True)]
        yield [
            side, model, f"{ours.rms:.7f}", f"{theirs[0]:.7f}", f"{ours.rms - theirs[0]:+.1e}",
            _median(spent[0], 1e3), _median(spent[1], 1e3), _median(ratios),
        ]  # fmt: skip


def _median(values: list[float], factor: float = 1.0) -> str:
    median = factor * statistics.median(values)
    return f"{median:.{1 if median < 10 else 0}f}"


def _in_turn(first: Callable[[], Any], second: Callable[[], Any], repeats: int) -> tuple[Any, Any, list[list[float]]]:
    """Results of both, and their seconds."""
    return first(), second(), times((first, second), repeats)


def _points(observations: Observations, also: Observations | None = None) -> tuple[list[Any], list[Any]]:
    """Board points and pixels of each view as OpenCV wants them: only the corners seen (in both views, for pairs)."""
    pixels = observations.pixels()
    seen = torch.isfinite(pixels).all(-1)
    if also is not None:
        seen = seen & torch.isfinite(also.pixels()).all(-1)
    board = observations.board.points.float()
    return [board[s].numpy() for s in seen], [p[s].float().numpy() for p, s in zip(pixels, seen, strict=True)]


@section("other-programs.md", "opencv, rig", repeats=1)
def rig(repeats: int = 5) -> Lines:
    yield ["intrinsics", "side", "baseline, mm", "RMS, px", "squares, mm", "ms"]
    left, right = _observe("left"), _observe("right")
    five = CalibrationOptions(model="opencv5")
    both = (calibrate_camera(left, five).camera, calibrate_camera(right, five).camera)
    pairs = pair_by_name(left.names, right.names)
    for word, refine in (("fixed", False), ("refined jointly", True)):
        options = RigOptions(intrinsics="free" if refine else "fixed", reject=False, weighted=False, motion=False)
        ours, theirs, spent = _in_turn(
            partial(calibrate_rig, *both, left, right, pairs, options),
            partial(_opencv_stereo, left, right, both, refine),
            repeats,
        )
        side = triangulated_sides(ours.stereo(), left.board.columns, left.board.rows, ours.pixels)
        found = ours.rms, float(ours.stereo().baseline), side.mean, side.spread
        for who, (rms, baseline, mean, spread), own in zip(("kcal", "OpenCV"), (found, theirs), spent, strict=True):
            squares = f"{1e3 * mean:.4f} ± {1e3 * spread:.4f}"
            yield [word, who, f"{1e3 * baseline:.5f}", f"{rms:.7f}", squares, _median(own, 1e3)]


def _opencv_stereo(
    left: Observations, right: Observations, cameras: tuple[Camera, Camera], refine: bool
) -> tuple[float, ...]:
    boards, a = _points(left, right)
    b = _points(right, left)[1]
    start = [array.numpy().copy() for camera in cameras for array in (camera.matrix, camera.coefficients)]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS if refine else cv2.CALIB_FIX_INTRINSIC
    solved = cv2.stereoCalibrate(boards, a, b, *start, left.image_size, flags=flags, criteria=CRITERIA)  # type: ignore[call-overload]
    rms, K1, D1, K2, D2, R, T = solved[:7]
    P1, P2 = np.eye(3, 4), np.hstack([R, T])
    sides = []
    place = left.board.points.float().numpy()
    for points, p, q in zip(boards, a, b, strict=True):
        u, v = cv2.undistortPoints(p, K1, D1)[:, 0], cv2.undistortPoints(q, K2, D2)[:, 0]
        homogeneous = cv2.triangulatePoints(P1, P2, u.T.astype(float), v.T.astype(float))
        every_corner = np.full((left.board.corners, 3), np.nan)
        every_corner[(place[:, None] == points).all(-1).any(1)] = (homogeneous[:3] / homogeneous[3]).T
        grid = every_corner.reshape(left.board.rows, left.board.columns, 3)
        for step in (np.diff(grid, axis=0), np.diff(grid, axis=1)):
            side = np.linalg.norm(step, axis=-1).ravel()
            sides.append(side[np.isfinite(side)])
    every = np.concatenate(sides)
    return rms, float(np.linalg.norm(T)), float(every.mean()), float(every.std(ddof=1))
