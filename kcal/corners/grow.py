"""Grow a grid of checkerboard corners: predict the next ones from those beside them, and see whether they are there."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kcal.corners.grid import sides
from kcal.corners.grid_check import MIN_OUTER, MIN_SQUARE, step_along
from kcal.corners.saddle import CornerStatus, saddle

MAX_MISS = 0.25  # of the square: distance of a corner from where its neighbors predict it
MIN_CONTRAST = 0.15  # of the corners beside it; a hard shadow leaves a quarter


def grown_grid(image: npt.NDArray[np.generic], grid: Tensor, most: int) -> Tensor:
    """Extend a grid of corners (rows, columns, 2) to its neighbors in the image, up to `most` lines each way.

    Each neighbor is predicted from the corners beside it and refined; squares must alternate on all its four sides.
    """
    light = torch.from_numpy(image.astype(np.float32))
    while True:
        before = torch.nn.functional.pad(grid, (0, 0, 1, 1, 1, 1), value=torch.nan)
        grid = _extended(image, light, before)
        known = torch.isfinite(grid).all(-1)
        rows, columns = known.any(1).nonzero()[:, 0], known.any(0).nonzero()[:, 0]
        grid = grid[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        if int(known.sum()) == int(torch.isfinite(before).all(-1).sum()) or max(grid.shape[:2]) > most:
            return grid


def filled_grid(image: npt.NDArray[np.generic], grid: Tensor, free: float) -> Tensor:
    """Find the corners that a board's grid (rows, columns, 2) lacks.

    Args:
        image: (H, W).
        grid: corners; NaN where missing.
        free: how far around a corner, as a share of its squares, nothing else is printed; at most 0.5.
    """
    light = torch.from_numpy(image.astype(np.float32))
    while True:
        before, grid = grid, _extended(image, light, grid, min(1.0, 2.0 * free))
        if int(torch.isfinite(grid).sum()) == int(torch.isfinite(before).sum()):
            return grid


def _extended(image: npt.NDArray[np.generic], light: Tensor, grid: Tensor, free: float = 1.0) -> Tensor:
    """The grid with the neighbors of its corners; only `free` of the half squares around them is looked at."""
    known = torch.isfinite(grid).all(-1)
    predicted, (along, down) = _predicted(grid), local_steps(grid)
    new = ~known & torch.isfinite(predicted + along + down).all(-1)
    if not bool(new.any()):
        return grid
    places, along, down = predicted[new], along[new], down[new]
    side = torch.minimum(torch.linalg.vector_norm(along, dim=-1), torch.linalg.vector_norm(down, dim=-1))
    refined = saddle(light, places, (free * side).clamp_min(1.0))
    apart = torch.linalg.vector_norm(refined.pixels - places, dim=-1)
    good = (refined.status == CornerStatus.GOOD) & (side >= MIN_SQUARE) & (apart < MAX_MISS * side)
    good &= _are_corners(image, grid, refined.pixels, free * along, free * down, new, free)
    grid = grid.clone()
    grid[new] = torch.where(good[:, None], refined.pixels, torch.nan)
    return grid


def local_steps(grid: Tensor) -> tuple[Tensor, Tensor]:
    """Mean steps along rows and down columns near each corner (rows, columns, 2), NaN where none is known nearby."""
    steps = []
    for dim in (1, 0):
        step = grid.diff(dim=dim)
        pad = (0, 0, 1, 1, 0, 0) if dim == 1 else (0, 0, 0, 0, 1, 1)
        step = torch.nn.functional.pad(step, pad, value=torch.nan)
        both = torch.stack([step.narrow(dim, 0, grid.shape[dim]), step.narrow(dim, 1, grid.shape[dim])]).nanmean(0)
        around = torch.nn.functional.pad(both, (0, 0, 1, 1, 1, 1), value=torch.nan)
        near = [around[i : i + grid.shape[0], j : j + grid.shape[1]] for i in range(3) for j in range(3)]
        steps.append(torch.stack(near).nanmean(0))
    return steps[0], steps[1]


def _predicted(grid: Tensor) -> Tensor:
    """Where the corners beside each place predict it: by quadratics along lines, or straight ones where too few are."""
    third: list[Tensor] = []
    second: list[Tensor] = []
    for side in range(4):
        turned = sides(grid)[side]
        padded = torch.nn.functional.pad(turned, (0, 0, 0, 0, 0, 3), value=torch.nan)
        one, two, three = (padded[k : k + len(turned)] for k in (1, 2, 3))
        for values, guess in ((third, 3 * one - 3 * two + three), (second, 2 * one - two)):
            guess = guess if side in (0, 2) else guess.flip(0)
            values.append(guess if side < 2 else guess.transpose(0, 1))
    straight = torch.stack(second).nanmean(0)
    curved = torch.stack(third).nanmean(0)
    return torch.where(torch.isfinite(curved), curved, straight)


def checkered(grid: Tensor) -> Tensor:
    """1 and -1 in turn, (rows, columns)."""
    i, j = torch.meshgrid(torch.arange(grid.shape[0]), torch.arange(grid.shape[1]), indexing="ij")
    return 1.0 - 2.0 * ((i + j) % 2)


def _are_corners(
    image: npt.NDArray[np.generic],
    grid: Tensor,
    places: Tensor,
    along: Tensor,
    down: Tensor,
    new: Tensor,
    free: float,
) -> Tensor:
    """Whether squares alternate on all four sides of new places (N, 2), in step with the corners known in `grid`."""
    own_along, own_down = (free * step for step in local_steps(grid))
    known = (step_along(image, grid, own_along, own_down) - step_along(image, grid, own_along, -own_down)) / 2
    known = known * checkered(grid)
    around = torch.nn.functional.pad(known, (2, 2, 2, 2), value=torch.nan)
    near = [around[i : i + known.shape[0], j : j + known.shape[1]] for i in range(5) for j in range(5)]
    typical = torch.stack(near).nanmedian(0).values[new] * checkered(grid)[new]
    four = torch.stack(
        [
            step_along(image, places, along, down),
            -step_along(image, places, along, -down),
            step_along(image, places, down, along),
            -step_along(image, places, down, -along),
        ]
    ) / torch.where(typical == 0, torch.nan, typical)
    return (four.amin(0) > MIN_OUTER * four.amax(0)) & (four.mean(0) > MIN_CONTRAST)
