"""Simulated boards that the tests of this folder share: truth, poses and observations from a seed."""

import datetime
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from kcal import Board, Camera, Observations, View
from kcal.lens import rotation_from_vector
from kcal.lens.calibration import BoardRecord, CalibrationRecord

BOARD = Board(columns=7, rows=6, square=0.05)
SIZE = (640, 480)
# Moderate barrel distortion with every coefficient of the 20 different from zero, regular over the whole image.
LENS = {
    "k1": -0.21, "k2": 0.06, "p1": 0.0012, "p2": -0.0008, "k3": -0.012, "k4": 0.05, "k5": -0.02, "k6": 0.004,
    "s1": 0.0015, "s2": -0.001, "s3": -0.0012, "s4": 0.0007, "tau_x": 0.012, "tau_y": -0.017,
    "k7": 0.004, "k8": -0.001, "k9": 0.002, "k10": -0.001, "s5": 0.0004, "s6": -0.0003,
}  # fmt: skip
Motions = tuple[Tensor, Tensor]


def camera(model: str = "opencv5", focal: float = 500.0, size: tuple[int, int] = SIZE) -> Camera:
    """A camera whose four intrinsics differ and whose lens has every coefficient of the model."""
    blank = Camera.build(focal=(focal, 1.01 * focal), center=(0, 0), size=size, model=model)
    return Camera.build(
        focal=(focal, 1.01 * focal),
        center=((size[0] - 1) / 2 + 6.3, (size[1] - 1) / 2 - 4.2),
        size=size,
        coefficients=[LENS[name] for name in blank.model.names],
        model=model,
    )


def motions(
    truth: Camera, count: int, seed: int, *, board: Board = BOARD, fill: float = 0.55, tilt: float = 40.0
) -> Motions:
    """cam_from_board poses: tilted up to `tilt` degrees about any axis, spread over the image, fully seen.

    `fill` is the share of the image's height that the board takes when it faces the camera.
    """
    generator = torch.Generator().manual_seed(seed)
    middle = board.points.mean(0)
    rotations, translations = [], []
    while len(rotations) < count:
        draw = 2.0 * torch.rand(8, generator=generator, dtype=torch.float64) - 1.0
        azimuth, angle = math.pi * draw[0], math.radians(tilt) * (0.4 + 0.6 * draw[1].abs())
        axis = torch.stack([torch.cos(azimuth), torch.sin(azimuth), torch.zeros((), dtype=torch.float64)])
        roll = torch.tensor([0.0, 0.0, 0.3], dtype=torch.float64) * draw[2]
        rotation = rotation_from_vector(axis * angle) @ rotation_from_vector(roll)
        focal, height = float(truth.focal[1]), truth.size[1]
        depth = focal * board.square * board.rows / (fill * height) * float(1.0 + 0.25 * draw[3])
        center = depth * torch.stack([
            draw[4] * 0.45 * truth.size[0] / focal, draw[5] * 0.45 * height / focal, torch.ones_like(draw[4])
        ])  # fmt: skip
        translation = center - rotation @ middle
        pixels, valid = truth.project(board.points @ rotation.T + translation)
        if bool((valid & truth.inside(pixels)).all()):
            rotations.append(rotation)
            translations.append(translation)
    return torch.stack(rotations), torch.stack(translations)


def pixels_of(truth: Camera, poses: Motions, *, board: Board = BOARD, noise: float = 0.0, seed: int = 0) -> Tensor:
    """Corners (V, N, 2) with independent normal noise of `noise` pixels an axis."""
    rotation, translation = poses
    pixels, valid = truth.project(board.points @ rotation.transpose(-1, -2) + translation[:, None])
    assert bool(valid.all())
    generator = torch.Generator().manual_seed(seed + 1000)
    return pixels + noise * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)


def corner_pixels(count: int, poses: int, model: str = "opencv5", **noise: Any) -> Tensor:
    """Corners (V, N, 2) in so many poses, drawn from the seed `poses`, with the noise of `pixels_of`."""
    truth = camera(model)
    return pixels_of(truth, motions(truth, count, poses), **noise)


def observe(
    pixels: Tensor,
    *,
    board: Board = BOARD,
    size: tuple[int, int] = SIZE,
    names: Sequence[str] | None = None,
) -> Observations:
    """Pixels (V, N, 2) as an observations file, NaN as corners that were not seen."""
    names = names or [f"v{i:02}" for i in range(len(pixels))]
    views = [
        View(name=name, pixels=tuple(None if u != u or v != v else (u, v) for u, v in view.tolist()))
        for name, view in zip(names, pixels, strict=True)
    ]
    return Observations(board=board, image_size=size, views=tuple(views))


def calibration_record(board: BoardRecord, **more: Any) -> CalibrationRecord:
    """Of a calibration from one view."""
    return CalibrationRecord(
        rms=0.1, views=1, points=9, per_view_rms={"a": 0.1}, board=board, stop_reason="converged", iterations=3,
        kcal_version="0.2", created=datetime.datetime.now(datetime.UTC), **more,
    )  # fmt: skip
