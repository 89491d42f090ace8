"""`LookupCamera`: a camera as two tables, for programs that know neither lens formulas nor networks."""

from __future__ import annotations

import ast

import torch
from torch import Tensor

from kcal.checks import StatedModule, as_points
from kcal.dispatch import finite_or, in_chunks, is_differentiated
from kcal.errors import InputError
from kcal.lens.spline import Spline, evaluate_spline

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
