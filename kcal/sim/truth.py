"""Simulated cameras as truth: traced lenses as exact fields, their chief rays and their Chebyshev form."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.errors import InputError
from kcal.lens.pose import rotation_from_vector
from kcal.sim.raytrace import Misalignment, Prescription, focal_length, place, trace

# Rectangles of pixels.


class PixelRectangle(NamedTuple):
    """A rectangle of pixels; it may reach beyond the image."""

    left: int
    top: int
    width: int
    height: int


def pixel_axes(window: PixelRectangle) -> tuple[Tensor, Tensor]:
    """Return the positions x of every column (width,) and y of every row (height,), float64."""
    x = window.left + torch.arange(window.width, dtype=torch.float64)
    y = window.top + torch.arange(window.height, dtype=torch.float64)
    return x, y


def grow(window: PixelRectangle, by: int) -> PixelRectangle:
    """Add `by` pixels on every side."""
    return PixelRectangle(window.left - by, window.top - by, window.width + 2 * by, window.height + 2 * by)


# Tabulate smooth functions of a pixel as sums of Chebyshev polynomials, exact to rounding, with derivatives.


@dataclass(frozen=True, eq=False)
class ChebyshevTable:
    """K functions on a rectangle of pixels; see `tabulate`.

    Args:
        window: the rectangle.
        coefficients: (degree + 1, K, degree + 1), of x and of y.
    """

    window: PixelRectangle
    coefficients: Tensor

    def values(self, pixels: Tensor) -> Tensor:
        """Return the values (N, K) at pixels (N, 2)."""
        across, down = (self._basis(pixels, axis)[0] for axis in (0, 1))
        left = (across @ self.coefficients.flatten(1)).unflatten(-1, self.coefficients.shape[1:])
        return (left @ down[..., None])[..., 0]

    def with_slopes(self, pixels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return values (N, K), and their derivatives by x and by y, per pixel."""
        (across, across_slope), (down, down_slope) = (self._basis(pixels, axis) for axis in (0, 1))
        left, left_slope = (basis @ self.coefficients.flatten(1) for basis in (across, across_slope))
        left, left_slope = (value.unflatten(-1, self.coefficients.shape[1:]) for value in (left, left_slope))
        sums = [
            (part @ basis[..., None])[..., 0] for part, basis in ((left, down), (left_slope, down), (left, down_slope))
        ]
        return sums[0], sums[1], sums[2]

    def _basis(self, pixels: Tensor, axis: int) -> tuple[Tensor, Tensor]:
        """Chebyshev polynomials (N, degree + 1) along an axis, and their derivatives per pixel."""
        start, extent = (self.window.left, self.window.width) if axis == 0 else (self.window.top, self.window.height)
        half = 0.5 * (extent - 1)
        t = (pixels[:, axis] - start) / half - 1
        degree = len(self.coefficients) - 1
        values, slopes = [torch.ones_like(t), t], [torch.zeros_like(t), torch.ones_like(t)]
        for _ in range(degree - 1):
            values.append(2 * t * values[-1] - values[-2])
            slopes.append(2 * values[-2] + 2 * t * slopes[-1] - slopes[-2])
        return torch.stack(values[: degree + 1], -1), torch.stack(slopes[: degree + 1], -1) / half


def tabulate(function: Callable[[Tensor], Tensor], window: PixelRectangle, degree: int) -> ChebyshevTable:
    """Interpolate a function of pixels, (N, 2) to (N, K), over a window at Chebyshev points.

    Example:
        >>> table = tabulate(lambda pixels: torch.exp(pixels / 100), PixelRectangle(-10, -10, 120, 80), 12)
        >>> [round(value, 9) for value in table.values(torch.tensor([[50.0, 20.0]]).double())[0].tolist()]
        [1.648721271, 1.221402758]
    """
    order = torch.arange(degree + 1, dtype=torch.float64)
    # Chebyshev points of the first kind are the cosines of these.
    angles = math.pi * (order + 0.5) / (degree + 1)
    t = torch.cos(angles)
    x = window.left + 0.5 * (window.width - 1) * (t + 1)
    y = window.top + 0.5 * (window.height - 1) * (t + 1)
    grid = torch.stack(torch.meshgrid(x, y, indexing="ij"), -1)
    sampled = function(grid.reshape(-1, 2)).unflatten(0, grid.shape[:2])
    # The discrete cosine transform: T_j at node i is cos(j θ_i).
    transform = torch.cos(order[:, None] * angles) * (2.0 / (degree + 1))
    transform[0] *= 0.5
    return ChebyshevTable(window, torch.einsum("ai,ijk,bj->akb", transform, sampled, transform).contiguous())


# Trace chief rays: from a pixel through the middle of the aperture stop to its line of sight in front of the lens.

_AIM_STEPS = 40
_SLOPE_NUDGE = 1e-6  # of a slope, for derivatives
_LONGEST_STEP = 0.2  # change of a slope in one step
_AIM_GOAL, _AIM_ERROR = 1e-8, 1e-6  # pixels


class LinesOfSight(NamedTuple):
    """The line of sight of each pixel: the points (x, y) + z (slope_x, slope_y) at every depth z.

    Attributes:
        origins: (N, 2) meters, where it crosses the plane z = 0.
        slopes: (N, 2).
    """

    origins: Tensor
    slopes: Tensor

    def spatial(self) -> tuple[Tensor, Tensor]:
        """A point (N, 3) and the unit direction (N, 3) of each line."""
        return torch.nn.functional.pad(self.origins, (0, 1)), _unit(self.slopes)

    def nearest_point(self) -> Tensor:
        """(3,) the point nearest to all lines, by least squares."""
        at, heading = self.spatial()
        across = torch.eye(3, dtype=torch.float64) - heading[:, :, None] * heading[:, None, :]
        return torch.linalg.solve(across.sum(0), (across @ at[..., None])[..., 0].sum(0))


class ChiefRays:
    """A lens of `focal_mm` millimeters before a sensor on which that is `focal` pixels.

    Convention: the camera frame (x right, y down, z forward, meters) has its origin in the front vertex.

    Attributes:
        surfaces: of the lens, in meters.
        stop: place of the aperture stop among them.
        sensor: its vertex (3,) and rotation (3, 3) in the lens's frame.
        axis: (2,) pixel at that vertex.
        pitch: meters per pixel.
        name: for messages.
    """

    def __init__(
        self, prescription: Prescription, focal: float, focal_mm: float, axis: tuple[float, float],
        misalignment: Misalignment, sensor_tilt: tuple[float, float],
    ) -> None:  # fmt: skip
        scale = 1e-3 * focal_mm / focal_length(prescription)
        self.surfaces = place(prescription, 1e-3 * focal_mm, scale, misalignment)
        self.stop, self.name, self.pitch = prescription.stop, prescription.name, 1e-3 * focal_mm / focal
        self.axis = torch.tensor(axis, dtype=torch.float64)
        # Misalignment moves pieces of glass, not the barrel.
        length = scale * sum(surface.thickness for surface in prescription.surfaces)
        turn = rotation_from_vector(torch.tensor([*sensor_tilt, 0.0], dtype=torch.float64))
        self.sensor = torch.tensor([0.0, 0.0, length], dtype=torch.float64), turn

    def lines(self, pixels: Tensor) -> LinesOfSight:
        """Find the lines of sight of pixels (N, 2), in front of the lens.

        The chief ray that lands on a pixel is found by Newton's method in its slopes at the stop; from there it is
        traced backward through the front of the lens.

        Raises:
            InputError: no chief ray reaches a pixel.
        """
        slopes = (pixels - self.axis) / self._pixels_per_slope()
        for _ in range(_AIM_STEPS):
            landed, valid = self.land(slopes)
            error = landed - pixels
            off = torch.linalg.vector_norm(error, dim=-1)
            if bool((off < _AIM_GOAL).all()):
                break
            across, down = (
                (self.land(slopes + slopes.new_tensor(nudge))[0] - landed) / _SLOPE_NUDGE
                for nudge in ((_SLOPE_NUDGE, 0.0), (0.0, _SLOPE_NUDGE))
            )
            step = solve_2x2(across, down, error)
            length = torch.linalg.vector_norm(step, dim=-1, keepdim=True)
            slopes = slopes - step * (_LONGEST_STEP / length.clamp_min(1e-300)).clamp_max(1.0)
        missed = ~(valid & (off < _AIM_ERROR))
        stop = self.surfaces[self.stop].vertex.expand(len(pixels), 3)
        rays = trace(self.surfaces[: self.stop], stop, -_unit(slopes), backward=True)
        missed |= ~rays.valid | ~(rays.directions[:, 2] < 0)
        if bool(missed.any()):
            raise InputError(
                f"lens {self.name}: no chief ray reaches {int(missed.sum())} of {len(pixels)} pixels; a smaller image, "
                "a longer focal length or less misalignment is needed"
            )
        # Light travels along +z, but the camera looks along -z: mirroring changes nothing in a lens.
        points = rays.points * rays.points.new_tensor([1.0, 1.0, -1.0])
        slopes = -rays.directions[:, :2] / rays.directions[:, 2:]
        return LinesOfSight(points[:, :2] - points[:, 2:] * slopes, slopes)

    def land(self, slopes: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (N, 2) of the chief rays that leave the stop with slopes (N, 2), and whether they get there."""
        stop = self.surfaces[self.stop].vertex.expand(len(slopes), 3)
        rays = trace(self.surfaces[self.stop + 1 :], stop, _unit(slopes))
        vertex, rotation = self.sensor
        local, heading = (rays.points - vertex) @ rotation, rays.directions @ rotation
        at = local - heading * (local[:, 2:] / heading[:, 2:])
        # The image is upside down.
        return self.axis - at[:, :2] / self.pitch, rays.valid

    def _pixels_per_slope(self) -> float:
        small = torch.tensor([[1e-4, 0.0], [-1e-4, 0.0]], dtype=torch.float64)
        landed, _ = self.land(small)
        return float(landed[0, 0] - landed[1, 0]) / 2e-4


def solve_2x2(across: Tensor, down: Tensor, right: Tensor) -> Tensor:
    """Solve for (N, 2) steps, the columns of whose matrices are `across` and `down`, each (N, 2)."""
    determinant = across[:, 0] * down[:, 1] - across[:, 1] * down[:, 0]
    x = down[:, 1] * right[:, 0] - down[:, 0] * right[:, 1]
    y = across[:, 0] * right[:, 1] - across[:, 1] * right[:, 0]
    return torch.stack([x, y], -1) / determinant[:, None]


def _unit(slopes: Tensor) -> Tensor:
    return torch.nn.functional.normalize(torch.cat([slopes, torch.ones_like(slopes[:, :1])], -1), dim=-1)


# `TruthLens`: a camera behind a ray-traced lens, for simulations whose truth is no lens model of kcal.
#
# Each pixel has a chief ray, and with it a line of sight in front of the camera. These lines do not
# meet in one point: the entrance pupil moves with the angle, as in any wide lens, and more if pieces of glass are
# decentered. The camera's origin is the point nearest to all lines. At infinity only their directions matter.
#
# The lines are stored as Chebyshev sums over the image and a margin. `unproject` evaluates them, and `project` solves
# them by Newton's method. `table_error` is their difference from direct tracing, measured when the lens is built.

_TABLE_MARGIN = 64  # pixels around the image that are tabulated too: blurred images look past the edge
_DEGREES = (20, 28, 36, 48)
_TABLE_GOAL = 1e-8  # pixels
_PROJECT_STEPS = 12
_STEP_GOAL, _PROJECT_ERROR = 1e-9, 1e-7  # pixels
_POINTS_AT_ONCE = 1 << 14


class TruthLens:
    """A camera whose lens is traced ray by ray.

    Convention: as `kcal.lens.camera.Camera`: x right, y down, z forward, meters; pixel (0, 0) is the center of the
    first pixel. All tensors are float64; nothing here is differentiable.

    Args:
        prescription: of the lens.
        focal: paraxial focal length in pixels; that of the prescription if left out.
        size: (width, height) in pixels.
        center: pixel in which the barrel's axis meets the sensor; the image's center if left out.
        misalignment: how the glass is decentered and tilted; shares of the focal length, and radians.
        sensor_tilt: turn of the sensor about x and y, radians.
        focal_mm: focal length in millimeters, which sets the size of the lens and with it the effect of the moving
            pupil at close range.
        wander: share of the pupil's motion that is kept: with 0 all lines of sight meet, 1 is the real lens. The
            default has the effect of a board ten times as large and as far away. With 1 the surveillance lens moves
            corners at 1 m by 0.09 px RMS against those at infinity, which no lens model of kcal describes.

    Attributes:
        size: (width, height) in pixels.
        low: (2,) first pixel of the margin around the image for which the lens is known as well.
        high: (2,) the last one.
        table_error: largest difference between the table and tracing, pixels, at 256 places between the nodes.

    Raises:
        InputError: a value out of range, or a lens that does not reach the image's corners.

    Example:
        >>> from kcal.sim.raytrace import SURVEILLANCE
        >>> lens = TruthLens(SURVEILLANCE)
        >>> pixels, valid = lens.project(torch.tensor([[0.5, 0.0, 1.0], [0.0, 0.0, -1.0]]).double())
        >>> [round(value, 2) for value in pixels[0].tolist()], valid.tolist()
        ([1682.81, 539.5], [True, False])
        >>> lens.table_error < 1e-6
        True
    """

    def __init__(
        self,
        prescription: Prescription,
        *,
        focal: float | None = None,
        size: tuple[int, int] = (1920, 1080),
        center: tuple[float, float] | None = None,
        misalignment: Misalignment | None = None,
        sensor_tilt: tuple[float, float] = (0.0, 0.0),
        focal_mm: float = 2.8,
        wander: float = 0.1,
    ) -> None:
        focal = prescription.focal if focal is None else focal
        for name, value in (("focal", focal), ("focal_mm", focal_mm)):
            if not 0 < value < math.inf:
                raise InputError(f"{name} {value}: a positive number is needed")
        if not 0 <= wander <= 1:
            raise InputError(f"wander {wander}: a share from 0 to 1 is needed")
        if min(size) < 1:
            raise InputError(f"image size {size}: width and height must be positive")
        self.size = (int(size[0]), int(size[1]))
        self._focal, self._wander = float(focal), float(wander)
        axis = center or ((size[0] - 1) / 2, (size[1] - 1) / 2)
        glass = misalignment or Misalignment()
        self._chief = ChiefRays(prescription, self._focal, focal_mm, axis, glass, sensor_tilt)
        probed = (torch.linspace(0, extent - 1, 17, dtype=torch.float64) for extent in self.size)
        pixels = torch.stack(torch.meshgrid(*probed, indexing="xy"), -1).reshape(-1, 2)
        self._origin = self._chief.lines(pixels).nearest_point()
        self._window = grow(PixelRectangle(0, 0, *self.size), _TABLE_MARGIN)
        low = torch.tensor([self._window.left, self._window.top], dtype=torch.float64)
        extent = torch.tensor([self._window.width - 1, self._window.height - 1], dtype=torch.float64)
        self.low, self.high = low, low + extent
        for degree in _DEGREES:
            self._table = tabulate(lambda pixels: torch.cat(self.trace(pixels), -1), self._window, degree)
            self.table_error = self._measure()
            if self.table_error < _TABLE_GOAL:
                break
        self._start = self._fit_start()

    @property
    def focal(self) -> Tensor:
        """(2,) paraxial focal length in pixels, along x and y."""
        return torch.full((2,), self._focal, dtype=torch.float64)

    def inside(self, pixels: Tensor) -> Tensor:
        """Whether pixels (..., N, 2) lie on the image, whose edges are half a pixel beyond the outer centers."""
        pixels = as_points("pixels", pixels, 2)
        return ((pixels >= -0.5) & (pixels <= torch.tensor(self.size, dtype=torch.float64) - 0.5)).all(-1)

    def covers(self, pixels: Tensor) -> Tensor:
        """Whether pixels (..., N, 2) lie on the image or in the margin for which the lens is known."""
        pixels = as_points("pixels", pixels, 2)
        return ((pixels >= self.low) & (pixels <= self.high)).all(-1)

    def trace(self, pixels: Tensor) -> LinesOfSight:
        """Trace the lines of sight of pixels (N, 2) without the table; raise `InputError` where there are none."""
        lines = self._chief.lines(pixels)
        at = lines.origins + self._origin[2] * lines.slopes - self._origin[:2]
        return LinesOfSight(self._wander * at, lines.slopes)

    def lines(self, pixels: Tensor) -> LinesOfSight:
        """Read the lines of sight of pixels (N, 2) that the lens covers from the table."""
        values = torch.cat([self._table.values(part) for part in pixels.split(_POINTS_AT_ONCE)])
        return LinesOfSight(values[:, :2], values[:, 2:])

    def unproject(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Return the directions of pixels (..., N, 2) at infinity: unit rays (..., N, 3), valid (..., N).

        Pixels outside the image and its margin are not valid; their ray is the axis.
        """
        pixels = as_points("pixels", pixels, 2)
        valid = self.covers(pixels)
        safe = torch.where(valid[..., None], pixels, self._chief.axis)
        rays = self.lines(safe.reshape(-1, 2)).spatial()[1].reshape(*safe.shape[:-1], 3)
        return torch.where(valid[..., None], rays, rays.new_tensor([0.0, 0.0, 1.0])), valid

    def project(self, points_cam: Tensor) -> tuple[Tensor, Tensor]:
        """Return the pixels (..., N, 2) of points, and valid (..., N): in front, and within the image or its margin.

        For a point at infinity scale its direction up: at 1e9 m the pupil's motion has no effect. Pixels that are not
        valid contain the axis.
        """
        points = as_points("points_cam", points_cam, 3)
        if points.numel() == 0:
            return points[..., :2], points[..., 0] > 0
        parts = [self._project(part) for part in points.reshape(-1, 3).split(_POINTS_AT_ONCE)]
        pixels = torch.cat([part[0] for part in parts]).reshape(*points.shape[:-1], 2)
        return pixels, torch.cat([part[1] for part in parts]).reshape(points.shape[:-1])

    def _project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        ahead = (points[:, 2] > 0) & torch.isfinite(points).all(-1)
        safe = torch.where(ahead[:, None], points, points.new_tensor([0.0, 0.0, 1.0]))
        nearness, target = 1.0 / safe[:, 2:], safe[:, :2] / safe[:, 2:]
        weights, scale = self._start
        # The polynomial is not valid far outside the image: clamped, it starts at the image's edge.
        pixels = (_monomials((target / scale).clamp(-1.2, 1.2)) @ weights).clamp(self.low, self.high)
        for _ in range(_PROJECT_STEPS):
            sums = self._table.with_slopes(pixels)
            value, across, down = (part[:, 2:] + nearness * part[:, :2] for part in sums)
            error = value - target
            moved = (pixels - solve_2x2(across, down, error)).clamp(self.low, self.high)
            settled = (moved - pixels).abs().amax() < _STEP_GOAL
            pixels = moved
            if bool(settled):
                break
        # Newton's method stops at the edge of the table for points that the lens does not see.
        valid = ahead & (error.abs().amax(-1) * self._focal < _PROJECT_ERROR)
        return torch.where(valid[:, None], pixels, self._chief.axis), valid

    def _measure(self) -> float:
        share = torch.quasirandom.SobolEngine(2).draw(256, dtype=torch.float64)
        pixels = self.low + share * (self.high - self.low)
        # Slopes, and origins as they count at a distance of one meter.
        off = self._table.values(pixels) - torch.cat(self.trace(pixels), -1)
        return float(off.abs().max() * self._focal)

    def _fit_start(self) -> tuple[Tensor, Tensor]:
        """Fit a polynomial from slopes to pixels, which starts Newton's method; return it and its scale of slopes."""
        share = torch.stack(torch.meshgrid(*(torch.linspace(0, 1, 33, dtype=torch.float64),) * 2, indexing="xy"), -1)
        pixels = self.low + share.reshape(-1, 2) * (self.high - self.low)
        slopes = self.lines(pixels).slopes
        scale = slopes.abs().amax(0)
        return torch.linalg.lstsq(_monomials(slopes / scale), pixels).solution, scale


def _monomials(slopes: Tensor) -> Tensor:
    """Products of powers up to total degree 9, (N, 55)."""
    x, y = slopes.unbind(-1)
    return torch.stack([x**i * y**j for i in range(10) for j in range(10 - i)], -1)
