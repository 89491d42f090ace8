"""`LookupCamera`: a camera as two tables, for programs that know neither lens formulas nor networks."""

from __future__ import annotations

import ast
import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.checks import StatedModule, as_points
from kcal.dispatch import finite_or, in_chunks, is_differentiated
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera

# Tabulate smooth functions of two variables by uniform bicubic B-splines, twice continuously differentiable.
#
# A spline is a table of coefficients c[j, i] of basis functions at origin + (i, j) · step. With t = (x - origin) /
# step, i = floor(t) and f = t - i, the four basis functions i - 1 to i + 2 count along each axis, with the weights
#
#     (1 - f)³ / 6,  (3 f³ - 6 f² + 4) / 6,  (-3 f³ + 3 f² + 3 f + 1) / 6,  f³ / 6
#
# Coefficients are computed from values at the same places by a short filter, c = v - δ²v / 6 + δ⁴v / 36 along each axis
# (de Boor's quasi-interpolant). Its error falls with the fourth power of the step like that of interpolation, which
# would need a system of equations. It is also local: unknown values in one corner of a table do not spread.

_FILTER = (1 / 36, -10 / 36, 54 / 36, -10 / 36, 1 / 36)
# Values needed beyond the outermost cell on each side: one for the basis functions, two for the filter.
RINGS = 3
# How a cubic, whose fourth differences vanish, continues beyond its last four values.
_CUBIC_STEP = (4.0, -6.0, 4.0, -1.0)


class Spline(NamedTuple):
    """A bicubic B-spline and the cells in which it may be used.

    Attributes:
        coefficients: (K, rows + 3, columns + 3) for a grid of rows x columns cells.
        origin: (2,) x and y of the first basis function; the first cell begins one step farther.
        step: (2,) width and height of a cell.
        cells: (rows, columns) bool, which cells may be used.
    """

    coefficients: Tensor
    origin: Tensor
    step: Tensor
    cells: Tensor


def filter_nodes(values: Tensor) -> Tensor:
    """Compute coefficients (..., R - 4, C - 4) from values (..., R, C) at the same places."""
    for axis in (-1, -2):
        parts = [weight * values.narrow(axis, k, values.shape[axis] - 4) for k, weight in enumerate(_FILTER)]
        values = sum(parts, values.new_zeros(()))
    return values


def extend_nodes(values: Tensor, known: Tensor, rings: int = 2 * RINGS) -> tuple[Tensor, Tensor]:
    """Continue values (K, R, C) beyond where they are `known` (R, C), by cubics along rows and columns.

    Each ring takes the mean over those of the four directions that have four known values in a row. A corner needs as
    many rings as its two sides together.

    Returns:
        values and known, extended by up to `rings` nodes; zero where still not known.
    """
    values = torch.where(known, values, 0.0)
    for _ in range(rings):
        total, count = torch.zeros_like(values), torch.zeros(known.shape, dtype=values.dtype, device=values.device)
        for axis in (-2, -1):
            for way in (1, -1):
                four = [_shifted(values, known, axis, way * k) for k in (1, 2, 3, 4)]
                usable = four[0][1] & four[1][1] & four[2][1] & four[3][1]
                ahead = sum(weight * value for weight, (value, _) in zip(_CUBIC_STEP, four, strict=True))
                total, count = total + torch.where(usable, ahead, 0.0), count + usable
        new = ~known & (count > 0)
        values = torch.where(new, total / count.clamp(min=1.0), values)
        known = known | new
    return values, known


def _shifted(values: Tensor, known: Tensor, axis: int, by: int) -> tuple[Tensor, Tensor]:
    """Shift values and mask along an axis; what enters from the other side is not known."""
    count = known.shape[axis]
    place = torch.arange(count, device=known.device)
    fresh = (place - by >= 0) & (place - by < count)
    fresh = fresh if axis == -1 else fresh[:, None]
    return values.roll(by, axis), known.roll(by, axis) & fresh


def _basis_weights(f: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The four weights at fractions f of a cell."""
    g = 1.0 - f
    first, last = g * g * g, f * f * f
    # The other two by symmetry: 4 - 6 f² + 3 f³ and the same of g.
    second = 4.0 - 6.0 * (f * f) + 3.0 * last
    third = 4.0 - 6.0 * (g * g) + 3.0 * first
    return first / 6.0, second / 6.0, third / 6.0, last / 6.0


def evaluate_spline(spline: Spline, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Evaluate the spline: values (K, ...) at finite x, y (...), and (...) whether these lie in usable cells.

    Elsewhere the values are finite but meaningless.
    """
    rows, columns = spline.cells.shape
    u = (x - spline.origin[0]) / spline.step[0]
    v = (y - spline.origin[1]) / spline.step[1]
    # The far edge belongs to the last cell. Clamped positions have no gradient and are not valid.
    inside = (u >= 1.0) & (u <= columns + 1.0) & (v >= 1.0) & (v <= rows + 1.0)
    u, v = torch.clamp(u, 1.0, columns + 1.0), torch.clamp(v, 1.0, rows + 1.0)
    i = torch.clamp(torch.floor(u.detach()), max=columns)
    j = torch.clamp(torch.floor(v.detach()), max=rows)
    across, down = _basis_weights(u - i), _basis_weights(v - j)
    i, j = i.to(torch.int64) - 1, j.to(torch.int64) - 1
    width = columns + 3
    table = spline.coefficients.flatten(-2)
    first = j * width + i
    value = torch.zeros_like(x)
    for k, weight in enumerate(down):
        line = sum(table[:, first + (k * width + m)] * w for m, w in enumerate(across))
        value = value + weight * line
    return value, inside & spline.cells.flatten()[j * columns + i]


# `LookupCamera`: a camera as two tables, for programs that know neither lens formulas nor networks.

_PARTS = Spline._fields


class LookupCamera(StatedModule):
    """A camera as bicubic tables of both directions, made by `bake`.

    A valid answer lies in the image, is also valid for the camera that was baked, and is off by at most `bound` pixels.
    Tables end where the image ends. They leave out a strip along a fold of the lens, so that `coverage` may be less
    than one.

    Convention: as `Camera`: x right, y down, z forward; pixel (0, 0) is the center of the first pixel. Directions are
    tabulated on the stereographic chart, where (X, Y, Z) with R = √(X² + Y² + Z²) lies at p = 2 X / (R + Z),
    q = 2 Y / (R + Z). Equal steps on it are about equal steps in the image for every lens, also beyond 90° off axis.
    With s = (p² + q²) / 4, the direction is (p, q, 1 - s) / (1 + s). The tables are float64 buffers of the state.

    Args:
        size: (width, height) of the image in pixels.
        pixels_from_chart: table of pixels (u, v) over the chart.
        chart_from_pixels: table of chart positions (p, q) over the image.
        center: (2,) principal point, the value of pixels that are not valid.
        bound: largest errors in pixels of `project` and of `unproject`.
        coverage: share of the pixels with a ray for which `project` and `unproject` are valid.
        source: fingerprint of the camera that was baked.

    Raises:
        InputError: tables whose shapes do not fit.

    Example:
        >>> from kcal import Camera
        >>> from kcal.lens import bake
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.2, 0.05])
        >>> lookup = bake(camera, tolerance=1e-3)
        >>> point = torch.tensor([[0.3, 0.2, 1.0]], dtype=torch.float64)
        >>> pixels, valid = lookup.project(point)
        >>> bool(valid), bool((pixels - camera.project(point)[0]).norm() < lookup.bound[0])
        (True, True)
    """

    center: Tensor

    def __init__(
        self,
        *,
        size: tuple[int, int],
        pixels_from_chart: Spline,
        chart_from_pixels: Spline,
        center: Tensor,
        bound: tuple[float, float],
        coverage: tuple[float, float],
        source: str = "",
    ) -> None:
        super().__init__()
        self.size = (int(size[0]), int(size[1]))
        self.bound, self.coverage, self.source = bound, coverage, source
        self.register_buffer("center", as_points("center", center, 2).detach().clone())
        for name, table in (("pixels_from_chart", pixels_from_chart), ("chart_from_pixels", chart_from_pixels)):
            if table.cells.ndim != 2 or table.coefficients.shape != (2, *(n + 3 for n in table.cells.shape)):
                raise InputError(
                    f"{name}: coefficients (2, rows + 3, columns + 3) are needed for cells (rows, columns), got "
                    f"{tuple(table.coefficients.shape)} and {tuple(table.cells.shape)}"
                )
            for part, value in zip(_PARTS, table, strict=True):
                self.register_buffer(f"{name}_{part}", value.detach().clone())

    @property
    def constants(self) -> object:
        """Size, errors, coverage and source, which come with the tables."""
        return self.size, self.bound, self.coverage, self.source

    def set_extra_state(self, state: Tensor) -> None:
        """Take the constants of the tables that are loaded."""
        self.size, self.bound, self.coverage, self.source = ast.literal_eval(bytes(state.tolist()).decode())

    @property
    def pixels_from_chart(self) -> Spline:
        """The table of `project`."""
        return Spline(*(getattr(self, f"pixels_from_chart_{part}") for part in _PARTS))

    @property
    def chart_from_pixels(self) -> Spline:
        """The table of `unproject`."""
        return Spline(*(getattr(self, f"chart_from_pixels_{part}") for part in _PARTS))

    def project(self, points_cam: Tensor) -> tuple[Tensor, Tensor]:
        """Map points (..., N, 3) to pixels (..., N, 2) and valid (..., N): in the image, and in a usable cell.

        Pixels that are not valid are set to the principal point. Gradients are those of the table.

        Raises:
            InputError: a wrong shape or an integer dtype.
        """
        points = as_points("points_cam", points_cam, 3)
        table = self.pixels_from_chart

        def one(points: Tensor) -> tuple[Tensor, Tensor]:
            p, q, usable = chart_from_points(points)
            pixels, valid = evaluate_spline(table, p, q)
            pixels = pixels.movedim(0, -1)
            valid = valid & usable & self.inside(pixels.detach())
            return torch.where(valid[..., None], pixels, self.center), valid

        return in_chunks(one, points, 1, differentiated=is_differentiated(points, self))

    def unproject(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Map pixels (..., N, 2) of the image to rays (..., N, 3) of length one and valid (..., N).

        Rays that are not valid are set to the optical axis. Gradients are those of the table.

        Raises:
            InputError: a wrong shape or an integer dtype.
        """
        pixels = as_points("pixels", pixels, 2)
        table = self.chart_from_pixels

        def one(pixels: Tensor) -> tuple[Tensor, Tensor]:
            u, v, finite = finite_or(pixels[..., 0], pixels[..., 1], self.center[0], self.center[1])
            chart, valid = evaluate_spline(table, u, v)
            valid = valid & finite
            return rays_from_chart(torch.where(valid, chart, 0.0).movedim(0, -1)), valid

        return in_chunks(one, pixels, 1, differentiated=is_differentiated(pixels, self))

    def inside(self, pixels: Tensor) -> Tensor:
        """Whether pixels (..., N, 2) lie in the image, whose edges are half a pixel beyond the outer pixel centers."""
        u, v = as_points("pixels", pixels, 2).unbind(-1)
        width, height = self.size
        return (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)

    def forward(self, points_cam: Tensor) -> tuple[Tensor, Tensor]:
        """The same as `project`."""
        return self.project(points_cam)

    def extra_repr(self) -> str:
        """Size, tables and errors, for `repr`."""
        cells = [f"{t.cells.shape[1]}x{t.cells.shape[0]}" for t in (self.pixels_from_chart, self.chart_from_pixels)]
        return f"size={self.size}, cells={' and '.join(cells)}, error at most {max(self.bound):.2g} px"


def chart_from_points(points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Map points (..., N, 3) to the stereographic chart: p, q (..., N), and a mask (..., N) of those on it.

    The origin, points straight behind the camera, and points that are not finite have no place; they get the axis's.
    """
    length = torch.linalg.vector_norm(points.detach(), dim=-1)
    behind = length + points[..., 2].detach() <= 1e-12 * length
    usable = (length > 0) & (length < torch.inf) & ~behind
    ahead = points.new_tensor([0.0, 0.0, 1.0])
    X, Y, Z = torch.where(usable[..., None], points, ahead).unbind(-1)
    scale = 2.0 / (torch.sqrt(X * X + Y * Y + Z * Z) + Z)
    return X * scale, Y * scale, usable


def rays_from_chart(chart: Tensor) -> Tensor:
    """Map positions (..., N, 2) on the chart to rays (..., N, 3) of length one.

    Example:
        >>> rays_from_chart(torch.tensor([[2.0, 0.0], [0.0, 0.0]], dtype=torch.float64)).tolist()
        [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    p, q = chart.unbind(-1)
    s = 0.25 * (p * p + q * q)
    scale = (1.0 + s).reciprocal()
    return torch.stack([p * scale, q * scale, (1.0 - s) * scale], -1)


# Tabulate a camera, with a measured error bound.

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
    image = camera.params.new_tensor([[-0.5, -0.5], [width - 0.5, height - 0.5]])

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

    seen = _chart_box(to_chart, image)
    inverse = _fit_table("unproject", to_chart, reprojection_errors, image, tolerance)
    forward = _fit_table("project", to_pixels, pixel_errors, seen, tolerance)
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


def _chart_box(to_chart: _Exact, image: Tensor) -> Tensor:
    """The rectangle (low, high) of the chart that contains the rays of the image, with a margin of 1 %."""
    low, high = image
    chart, valid, _ = to_chart(_lattice(low, (high - low) / 128, 129, 129).reshape(-1, 2))
    if not bool(valid.any()):
        raise DegenerateError("bake: no pixel of the image has a ray; check the camera")
    least, most = chart[valid].amin(0), chart[valid].amax(0)
    margin = 0.01 * (most - least)
    return torch.stack([least - margin, most + margin])


def _fit_table(name: str, exact: _Exact, errors: _Errors, box: Tensor, tolerance: float) -> _Table:
    """Refine a table until it keeps the tolerance on enough of the image."""
    low, high = box
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
