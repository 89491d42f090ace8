"""Simulate the corners of a board in many views, with noise, without rendering images."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.sim.board import BoardLike, BoardSize, LensLike, board_points, project_board
from kcal.sim.poses import PoseOptions, sample_board_poses
from kcal.sim.prescription import PRESCRIPTIONS
from kcal.sim.raytrace import Misalignment
from kcal.sim.truth import TruthLens

# The board of the paper: 6 x 7 corners, squares of 5 cm.
PAPER_BOARD = BoardSize(7, 6, 0.05)
# Misalignment of the sensor at a strength of 1: its tilt, and the axis's distance from its middle in pixels.
_SENSOR_TILT, _AXIS = math.radians(0.2), 8.0


class Capture(NamedTuple):
    """Views of a board and the truth about them.

    Attributes:
        pixels: (V, N, 2) corners with noise, in the order of `board_points`.
        true_pixels: (V, N, 2) without.
        rotation: (V, 3, 3) cam_from_board.
        translation: (V, 3) meters.
        points: (N, 3) corners on the board, meters.
    """

    pixels: Tensor
    true_pixels: Tensor
    rotation: Tensor
    translation: Tensor
    points: Tensor


def drawn_lens(
    name: str,
    strength: float,
    seed: int,
    *,
    focal: float | None = None,
    focal_mm: float = 2.8,
    wander: float = 0.1,
    scale: float = 1.0,
) -> TruthLens:
    """Draw a ray-traced lens with errors of assembly: a strength of 1 is ordinary, 3 poor, 0 perfect.

    A strength of 1 means one sigma along each axis: glass is decentered by the prescription's tolerance (22 µm of
    2.8 mm for the surveillance lens, with 0.2 degrees of tilt), the sensor is tilted by 0.2 degrees, and the axis meets
    it 8 px from its middle.

    Args:
        name: of a prescription: "surveillance", "machine-vision" or "webcam".
        strength: of the misalignment.
        seed: of its draw.
        focal: in pixels; the prescription's own if left out.
        focal_mm: see `TruthLens`.
        wander: see `TruthLens`.
        scale: of the image of 1920 x 1080 px, with the same lens and field of view; smaller for quick tests.

    Example:
        >>> lens = drawn_lens("machine-vision", 1.0, 7)
        >>> lens.size, round(float(lens.focal[0]))
        ((1920, 1080), 1600)
    """
    if name not in PRESCRIPTIONS:
        raise InputError(f"prescription {name!r}: there are {', '.join(PRESCRIPTIONS)}")
    generator = torch.Generator().manual_seed(seed)
    misalignment = Misalignment.draw(PRESCRIPTIONS[name], strength, generator)
    tilt, shift = (strength * torch.randn((2, 2), dtype=torch.float64, generator=generator)).tolist()
    size = round(1920 * scale), round(1080 * scale)
    return TruthLens(
        name,
        focal=scale * (PRESCRIPTIONS[name].focal if focal is None else focal),
        size=size,
        focal_mm=focal_mm,
        center=(0.5 * (size[0] - 1) + scale * _AXIS * shift[0], 0.5 * (size[1] - 1) + scale * _AXIS * shift[1]),
        misalignment=misalignment,
        sensor_tilt=(_SENSOR_TILT * tilt[0], _SENSOR_TILT * tilt[1]),
        wander=wander,
    )


def capture_corners(
    lens: LensLike,
    views: int,
    *,
    sigma: float,
    seed: int,
    board: BoardLike = PAPER_BOARD,
    fill: tuple[float, float] = (0.25, 0.8),
    options: PoseOptions | None = None,
) -> Capture:
    """Simulate the corners of a board in poses that cover the image, with Gaussian noise.

    Args:
        lens: true lens.
        views: how many.
        sigma: noise in pixels along each axis.
        seed: of poses and noise; another sigma scales the same noise.
        board: its size.
        fill: smallest and largest share of the image's width or height that the board takes.
        options: limits of tilt, roll and margins.

    Raises:
        InputError: see `sample_board_poses`; or a sigma that is negative.

    Example:
        >>> capture = capture_corners(drawn_lens("machine-vision", 1.0, 7), 10, sigma=0.1, seed=3)
        >>> tuple(capture.pixels.shape)
        (10, 42, 2)
    """
    if not 0 <= sigma < math.inf:
        raise InputError(f"sigma {sigma}: pixels, not negative, are needed")
    generator = torch.Generator().manual_seed(seed)
    poses = sample_board_poses(lens, board, views, generator, fill=fill, options=options)
    true = torch.stack([project_board(lens, pose, board)[0] for pose in poses])
    noise = torch.randn(true.shape, dtype=torch.float64, generator=generator)
    return Capture(
        true + sigma * noise,
        true,
        torch.stack([pose.rotation for pose in poses]),
        torch.stack([pose.translation for pose in poses]),
        board_points(board),
    )
