"""Tabulate a camera, with a measured error bound."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.lookup import LookupCamera, chart_from_points, rays_from_chart
from kcal.lens.spline import RINGS, Spline, evaluate_spline, extend_nodes, filter_nodes

# Errors are measured on a lattice this many times finer than the cells; in between they may be larger by no more than
# the safety factor.
_FINER, _SAFETY = 4, 1.25
# Cells along the longer side: at first, and at most (8 MB per table).
_FEWEST, _MOST = 12, 700
# Share of the image's pixels with a ray: tables must cover the first, and are not refined beyond the second.
_REQUIRED, _ENOUGH = 0.9, 0.97

# Maps positions (N, 2) of a table's plane to exact values (N, 2), their validity, and whether they are in the image.
_Exact = Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]
# Maps positions, values from the table and exact values (N, 2) to errors in pixels (N,); infinite where unknown.
_Errors = Callable[[Tensor, Tensor, Tensor], Tensor]


class _Box(NamedTuple):
    low: tuple[float, float]
    high: tuple[float, float]


class _Table(NamedTuple):
    spline: Spline
    bound: float
    coverage: float


@torch.no_grad()
def bake(camera: Camera, tolerance: float = 1e-3) -> LookupCamera:
    """Tabulate both directions of a camera, with the coarsest tables that keep a tolerance.

    Reading a table takes the same time for every lens and needs no lens formula, which helps most for a hybrid lens.
    `kcal.io.lookup_file` stores tables for programs without torch.

    Errors are distances in pixels: for `project`, between the table's pixel and the camera's; for `unproject`, between
    a pixel and the projection of the table's ray. They are measured on a lattice four times finer than the cells, and
    `LookupCamera.bound` is the largest of them times 1.25. Cells that exceed the tolerance, or in which a point has no
    exact value, are never used. Along a fold that crosses the image, that is a strip of one cell; `coverage` tells how
    much is left.

    Args:
        camera: a single camera.
        tolerance: largest error in pixels, at least 1e-8.

    Raises:
        InputError: a batch of cameras, a tolerance below 1e-8, or one that tables of 700 cells do not reach.
        DegenerateError: no pixel of the image has a ray.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.2, 0.05])
        >>> lookup = bake(camera, tolerance=1e-4)
        >>> max(lookup.bound) <= 1e-4, lookup.coverage
        (True, (1.0, 1.0))
    """
    if camera.params.ndim != 1:
        raise InputError(f"bake: a single camera is needed, not a batch of {tuple(camera.params.shape[:-1])}")
    if not (math.isfinite(tolerance) and tolerance >= 1e-8):
        raise InputError(f"bake: the tolerance must be at least 1e-8 px, got {tolerance}")
    width, height = camera.size
    image = _Box((-0.5, -0.5), (width - 0.5, height - 0.5))

    def to_chart(pixels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        rays, valid = camera.unproject(pixels)
        p, q, usable = chart_from_points(rays)
        valid = valid & usable
        return torch.stack([p, q], -1), valid, valid & camera.inside(pixels)

    def reprojection_errors(pixels: Tensor, chart: Tensor, _: Tensor) -> Tensor:
        again, seen = camera.project_rays(rays_from_chart(chart))
        return torch.where(seen, torch.linalg.vector_norm(again - pixels, dim=-1), torch.inf)

    def to_pixels(chart: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        pixels, valid = camera.project_rays(rays_from_chart(chart))
        return pixels, valid, valid & camera.inside(pixels)

    def pixel_errors(_: Tensor, pixels: Tensor, exact: Tensor) -> Tensor:
        return torch.linalg.vector_norm(pixels - exact, dim=-1)

    seen = _chart_box(to_chart, image, camera.params)
    inverse = _fit_table("unproject", to_chart, reprojection_errors, image, tolerance, camera.params)
    forward = _fit_table("project", to_pixels, pixel_errors, seen, tolerance, camera.params)
    return LookupCamera(
        size=camera.size,
        pixels_from_chart=forward.spline,
        chart_from_pixels=inverse.spline,
        center=camera.center,
        bound=(forward.bound, inverse.bound),
        coverage=(forward.coverage, inverse.coverage),
        source=camera.fingerprint,
    )


def _lattice(low: Tensor, step: Tensor, rows: int, columns: int) -> Tensor:
    """Positions (rows, columns, 2), x along columns."""
    x = low[0] + step[0] * torch.arange(columns, dtype=torch.float64, device=low.device)
    y = low[1] + step[1] * torch.arange(rows, dtype=torch.float64, device=low.device)
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)


def _chart_box(to_chart: _Exact, image: _Box, like: Tensor) -> _Box:
    """The rectangle of the chart that contains the rays of the image, with a margin of 1 %."""
    low, high = like.new_tensor(image.low), like.new_tensor(image.high)
    chart, valid, _ = to_chart(_lattice(low, (high - low) / 128, 129, 129).reshape(-1, 2))
    if not bool(valid.any()):
        raise DegenerateError("bake: no pixel of the image has a ray; check the camera")
    least, most = chart[valid].amin(0), chart[valid].amax(0)
    margin = 0.01 * (most - least)
    (left, top), (right, bottom) = (least - margin).tolist(), (most + margin).tolist()
    return _Box((left, top), (right, bottom))


def _fit_table(name: str, exact: _Exact, errors: _Errors, box: _Box, tolerance: float, like: Tensor) -> _Table:
    """Refine a table until it keeps the tolerance on enough of the image."""
    low, high = like.new_tensor(box.low), like.new_tensor(box.high)
    cells = _FEWEST
    while True:
        table, worst = _build_table(exact, errors, low, high, cells, tolerance)
        # Where a fold crosses the image (worst is infinite), a strip along it is lost, however fine the table is.
        if worst <= tolerance or (math.isinf(worst) and table.coverage >= _ENOUGH):
            return table
        if cells == _MOST:
            break
        # Errors fall with the fourth power of the step at best; finer tables would take minutes only to fail.
        hopeless = math.isfinite(worst) and worst * (cells / _MOST) ** 4 > tolerance
        if hopeless and cells >= 4 * _FEWEST and table.coverage < _REQUIRED:
            raise InputError(
                f"bake: a table of {cells} cells is wrong by {worst:.3g} px in `{name}`, and {_MOST} cells would not "
                f"reach {tolerance:g} px; check the camera's focal lengths, or allow a larger tolerance"
            )
        # Errors fall with the fourth power of the step; the share lost along a fold falls a little faster than the
        # step.
        lost = (1.0 - table.coverage) / (1.0 - _ENOUGH)
        grown = 1.05 * (worst / tolerance) ** 0.25 if math.isfinite(worst) else lost**0.85
        cells = min(_MOST, math.ceil(cells * min(max(grown, 1.25), 4.0)))
    if table.coverage < _REQUIRED:
        raise InputError(
            f"bake: a table of {_MOST} cells keeps {tolerance:g} px in `{name}` on only {table.coverage:.1%} of "
            "the image; allow a larger tolerance"
        )
    return table


def _build_table(
    exact: _Exact, errors: _Errors, low: Tensor, high: Tensor, cells: int, tolerance: float
) -> tuple[_Table, float]:
    """A table of so many cells along the longer side, and its largest error inside the image."""
    extent = high - low
    columns, rows = (max(4, math.ceil(cells * float(side / extent.amax()))) for side in extent)
    step = extent / extent.new_tensor([columns, rows])
    nodes = _lattice(low - RINGS * step, step, rows + 1 + 2 * RINGS, columns + 1 + 2 * RINGS)
    values, known, _ = (value.unflatten(0, nodes.shape[:2]) for value in exact(nodes.flatten(0, 1)))
    values, known = extend_nodes(values.movedim(-1, 0), known)
    everywhere = torch.ones(rows, columns, dtype=torch.bool, device=low.device)
    spline = Spline(filter_nodes(values), low - step, step, everywhere)

    fine = _lattice(low, step / _FINER, rows * _FINER + 1, columns * _FINER + 1)
    truth, valid, asked = exact(fine.flatten(0, 1))
    found, _ = evaluate_spline(spline, fine[..., 0].flatten(), fine[..., 1].flatten())
    wrong = _SAFETY * torch.where(valid, errors(fine.flatten(0, 1), found.T, truth), torch.inf)
    wrong, asked = wrong.unflatten(0, fine.shape[:2]), asked.unflatten(0, fine.shape[:2])
    # The largest error of each cell, its edges included. Cells outside the image are not used.
    worst, seen = (
        torch.nn.functional.max_pool2d(part[None, None], _FINER + 1, _FINER)[0, 0] for part in (wrong, asked.double())
    )
    filled = torch.nn.functional.max_pool2d((~known).double()[None, None], 2 * RINGS + 2, 1)[0, 0] == 0
    usable = (worst <= tolerance) & (seen > 0) & filled
    # Coverage is counted in quarters of cells.
    spread = usable.repeat_interleave(_FINER, 0).repeat_interleave(_FINER, 1)
    here = asked[:-1, :-1] & asked[1:, 1:] & asked[:-1, 1:] & asked[1:, :-1]
    coverage = float((spread & here).sum() / here.sum().clamp(min=1))
    bound = float(worst[usable].max()) if bool(usable.any()) else 0.0
    return _Table(spline._replace(cells=usable), bound, coverage), float(worst[seen > 0].max())
