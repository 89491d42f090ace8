"""Errors and stated sigmas of corners in pictures whose truth is known, as they were when last looked at.

Thousandths of a pixel: mean error, root of the mean square, how errors go with the corner's number, mean stated sigma
along both axes and their covariance's root. A slip of a weight, a window or a limit changes these long before a board
is lost. After a change that is meant: KCAL_WRITE_CORNERS=1 and this file print them anew.
"""

from __future__ import annotations

import functools
import os

import numpy as np
import pytest
import torch
from board_render import homography, render
from numpy.typing import NDArray
from torch import Tensor

from kcal.corners.board import Board
from kcal.corners.detect import detect_board
from kcal.corners.grid import local_side
from kcal.corners.match import refine_point
from kcal.corners.refine import refine_corners
from kcal.corners.saddle import CornerStatus
from kcal.errors import InputError
from kcal.lens.camera import Camera
from scripts.shared.printed_board import Paper, pose

CAMERA = Camera.build(focal=(260, 262), center=(143, 107), size=(288, 216), coefficients=[-0.1, 0.02])
# Pattern, size of a square, tilt, distance, blur, noise, shift.
PRINTED = {
    "circles": ("circles:5x4", "30mm", (0.5, -0.3, 0.2), 0.28, 0.8, 1.5),
    "asymmetric": ("asymmetric:3x5", "30mm", (-0.3, 0.5, 0.4), 0.35, 0.7, 1.0),
    "charuco": ("charuco:6x4", "30mm", (0.4, 0.3, 0.2), 0.27, 0.7, 1.5),
    "charuco, steep": ("charuco:6x4", "30mm", (0.1, -0.8, -1.4), 0.25, 0.5, 1.0),
    "april": ("aprilgrid:3x2", "40mm", (0.3, -0.4, 0.3), 0.26, 0.7, 1.5),
    "april, turned": ("aprilgrid:3x2", "40mm", (0.1, 0.4, 2.8), 0.28, 0.6, 1.0),
}  # fmt: skip
# Refinement, square in pixels, tilt, roll, blur, noise, kind.
CHECKERED = {
    "sharp": ("erf", 24.0, (0.1, 0.2), 0.1, 0.5, 1.5, np.uint8),
    "blurred": ("erf", 20.0, (0.25, -0.1), 0.6, 2.2, 2.0, np.uint8),
    "small": ("erf", 9.0, (-0.15, 0.1), -0.2, 0.8, 1.0, np.uint8),
    "steep, 16 bits": ("erf", 22.0, (0.4, 0.3), -0.4, 0.9, 2.0, np.uint16),
    "saddle": ("saddle", 22.0, (0.2, 0.2), 0.3, 1.0, 2.0, np.uint8),
    "saddle, small": ("saddle", 11.0, (0.2, 0.1), -0.3, 0.7, 1.0, np.uint8),
}
BEFORE: dict[str, tuple[float, ...]] = {
    "circles": (20.0, 1.222, -0.989, 3.679, 0.168, -0.691, 4.224, 3.925, -1.282),
    "asymmetric": (15.0, -1.756, 0.292, 8.288, 0.469, -4.282, 2.352, 2.393, -0.864),
    "charuco": (24.0, 1.509, -1.133, 5.412, 0.19, -0.407, 5.587, 5.767, 1.735),
    "charuco, steep": (24.0, 1.116, 0.847, 3.869, -0.586, -0.603, 4.632, 4.861, 2.597),
    "april": (24.0, 0.337, 0.916, 3.854, -0.766, 0.331, 4.119, 3.873, -1.269),
    "april, turned": (24.0, 0.816, -0.505, 3.406, 0.186, -1.217, 2.5, 2.506, -0.465),
    "sharp": (35.0, 0.592, -0.647, 2.788, 0.786, -0.194, 2.871, 2.79, 0.313),
    "blurred": (35.0, 0.019, -0.204, 8.146, 0.882, -0.169, 8.786, 8.701, 0.301),
    "small": (35.0, 0.007, -0.278, 3.464, -0.361, 0.253, 3.915, 3.916, -0.141),
    "steep, 16 bits": (32.0, 1.004, -1.522, 6.587, -1.849, -0.834, 5.642, 5.47, -0.892),
    "saddle": (35.0, -0.371, 1.743, 9.981, 0.322, -0.467),
    "saddle, small": (35.0, -1.228, -0.865, 5.086, 0.236, 0.955),
}

# Of a single point: place, covariance xx, xy, yy in millionths.
POINT = (20764.8, 17439.1, 20438.2, -4561.61, 17772.5)


@functools.cache
def paper(pattern: str, square: str) -> Paper:
    return Paper(Board.parse(pattern, square), cell_mm=0.5)


def printed(name: str) -> tuple[NDArray[np.uint8], Board, Tensor]:
    pattern, square, tilt, distance, blur, noise = PRINTED[name]
    sheet = paper(pattern, square)
    image, truth = sheet.shoot(CAMERA, *pose(sheet.board, tilt, distance), blur, noise)
    return image, sheet.board, truth


def summary(found: Tensor, covariance: Tensor | None, truth: Tensor) -> tuple[float, ...]:
    good = torch.isfinite(found).all(1)
    error = found[good] - truth[good]
    along = torch.linspace(-1.0, 1.0, len(found)).double()[good]
    values = [*error.mean(0), error.square().mean().sqrt(), *(along[:, None] * error).mean(0)]
    if covariance is not None:
        spread = covariance[good]
        cross = spread[:, 0, 1].mean()
        values += [*spread.diagonal(dim1=1, dim2=2).sqrt().mean(0), cross.sign() * cross.abs().sqrt()]
    return (float(good.sum()), *(round(1e3 * float(value), 3) for value in values))


@pytest.mark.parametrize("name", [*PRINTED, *CHECKERED])
def test_as_before(name: str) -> None:
    if name in PRINTED:
        image, board, truth = printed(name)
        found = detect_board(image, board)
    else:
        refine, square, tilt, roll, blur, noise, kind = CHECKERED[name]
        board = Board(columns=7, rows=5, square=0.03)
        place = homography(board, (288, 216), square, tilt, roll, (3.3, -2.6))
        image, truth = render(board, (288, 216), place, blur, noise, 1, 4, dtype=kind)
        found = detect_board(image, board, refine)
    assert found.pixels is not None, found.reason
    now = summary(found.pixels, found.covariance, truth)
    if os.environ.get("KCAL_WRITE_CORNERS"):
        print(f'    "{name}": {now},')
        return
    assert now == pytest.approx(BEFORE[name], abs=0.2, rel=0.01)


def corner_image(noise: float = 1.0, beside: float = 40.0) -> Tensor:
    """A corner at 20.6, 17.3 and an edge some 15 px beside it, which a wider window takes for a part of it."""
    x = torch.arange(40.0, dtype=torch.float64)
    image = 100 * torch.outer(torch.sigmoid(2 * (x - 17.3)), torch.sigmoid(1.5 * (x - 20.6)))
    image += beside * torch.sigmoid(2 * (x[None] + 0.2 * x[:, None] - 38.0))
    return image + noise * torch.randn(40, 40, generator=torch.Generator().manual_seed(0)).double()


def test_a_point_as_before() -> None:
    found = refine_point(corner_image(), torch.tensor([20.0, 18.0]))
    covariance = found.covariance.flatten()[[0, 1, 3]]
    assert (1e3 * found.pixel).tolist() == pytest.approx(POINT[:2], abs=2.0)
    assert (1e6 * covariance).tolist() == pytest.approx(POINT[2:], rel=0.01)


def test_room_and_reach_of_a_point() -> None:
    """Five pixels from the border of the picture, three from where the mark is: on both sides."""
    image = corner_image(0.0, 0.0)
    corner = refine_point(image, torch.tensor([20.0, 18.0])).pixel
    assert corner.tolist() == pytest.approx([20.7, 17.4], abs=0.1)
    for x, y, good in ((2.0, 2.1, True), (2.2, 2.3, False), (-2.9, 0.0, True), (-3.1, 0.0, False), (0.0, -3.1, False)):
        at = corner + torch.tensor([x, y])
        if good:
            assert refine_point(image, at).pixel.tolist() == pytest.approx(corner.tolist(), abs=0.01)
        else:
            with pytest.raises(InputError, match="more than 3 px away"):
                refine_point(image, at)
    for cut, good in ((15, True), (16, False)):
        part, at = image[:, cut:], torch.tensor([20.0 - cut, 18.0])
        if good:
            refine_point(part, at)
        else:
            with pytest.raises(InputError, match="within 5 px"):
                refine_point(part, at)


@pytest.mark.parametrize("blur", [0.7, 1.5])
def test_the_blur_of_corners(blur: float) -> None:
    """That of the picture and of a pixel's area, variance 1/12 px²; none where a corner is not good."""
    board = Board(columns=5, rows=4, square=0.03)
    image, truth = render(board, (200, 160), homography(board, (200, 160), 22.0, roll=0.2), blur, 1.0, 1, 4)
    start = truth.clone()
    start[0] = torch.nan
    found = refine_corners(image, start, local_side(truth, 5, 4), grid=(5, 4))
    assert found.status.tolist() == [int(CornerStatus.MISSING)] + [int(CornerStatus.GOOD)] * 19
    assert found.blur is not None
    assert found.covariance is not None
    assert bool(found.blur[0].isnan() & found.pixels[0].isnan().all() & found.covariance[0].isnan().all())
    assert found.blur[1:].tolist() == pytest.approx([(blur**2 + 1.0 / 12.0) ** 0.5] * 19, rel=0.1)
