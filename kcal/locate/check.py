"""A check anyone can understand: do the squares of the board come out as large as they are?"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.errors import DegenerateError, InputError
from kcal.lens.rig import StereoRig
from kcal.locate.stereo import PositionStatus
from kcal.locate.triangulate import Triangulate


class Sides(NamedTuple):
    """Triangulated distances between neighboring corners, meters: their mean and standard deviation."""

    mean: float
    spread: float


def triangulated_sides(rig: StereoRig, columns: int, rows: int, pixels: Tensor, points: Tensor | None = None) -> Sides:
    """Triangulate every corner of boards seen by both cameras and measure the sides of the squares.

    Args:
        rig: the rig to check.
        columns: inner corners in a row.
        rows: inner corners in a column.
        pixels: (P, 2, columns * rows, 2) corners of P pairs, left and right, row by row; NaN where not seen.
        points: (columns * rows, 3) of a board whose sides differ, such as an AprilGrid: each side then counts as that
            of its first two points, if it has the right length. All sides are alike if not given.

    Returns:
        Mean and standard deviation over all sides whose two corners were seen by both cameras.

    Raises:
        InputError: a shape that does not fit.
        DegenerateError: no side could be triangulated.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
        >>> corners = torch.tensor([[0, 0, 5], [0.1, 0, 5], [0, 0.1, 5], [0.1, 0.1, 5]], dtype=torch.float64)
        >>> left, right, _ = rig(corners)
        >>> round(triangulated_sides(rig, 2, 2, torch.stack([left, right])[None]).mean, 9)
        0.1
    """
    pixels = as_points("pixels", pixels, 2)
    if pixels.ndim != 4 or pixels.shape[1:3] != (2, columns * rows):
        raise InputError(f"pixels: shape (P, 2, {columns * rows}, 2) is needed, got {tuple(pixels.shape)}")
    known = None if points is None else as_points("points", points, 3)
    if known is not None and known.shape != (columns * rows, 3):
        raise InputError(f"points: shape ({columns * rows}, 3) is needed, got {tuple(known.shape)}")
    located = Triangulate(rig)(pixels[:, 0], pixels[:, 1])
    points = torch.where((located.status == PositionStatus.OK)[..., None], located.points, torch.nan)
    sides = _grid_sides(points, columns, rows)
    if known is not None:
        ordered = _grid_sides(known[None], columns, rows)
        sides = sides / ordered * ordered[:, :1]
    sides = sides[torch.isfinite(sides)]
    if len(sides) < 2:
        raise DegenerateError("no side of a square could be triangulated")
    return Sides(float(sides.mean()), float(sides.std()))


def _grid_sides(points: Tensor, columns: int, rows: int) -> Tensor:
    """Distances (P, S) of neighbors along rows, then along columns, of points (P, rows * columns, 3)."""
    grid = points.unflatten(1, (rows, columns))
    steps = [(grid[:, :, 1:] - grid[:, :, :-1]).flatten(1, 2), (grid[:, 1:] - grid[:, :-1]).flatten(1, 2)]
    return torch.linalg.vector_norm(torch.cat(steps, 1), dim=-1)
