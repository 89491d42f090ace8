"""`TruthLens`: a camera behind a ray-traced lens, for simulations whose truth is no lens model of kcal.

Each pixel has a chief ray, and with it a line of sight in front of the camera (`kcal.sim.chief`). These lines do not
meet in one point: the entrance pupil moves with the angle, as in any wide lens, and more if pieces of glass are
decentered. The camera's origin is the point nearest to all lines. At infinity only their directions matter.

The lines are stored as Chebyshev sums over the image and a margin. `unproject` evaluates them, and `project` solves
them by Newton's method. `table_error` is their difference from direct tracing, measured when the lens is built.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.errors import InputError
from kcal.sim.chebyshev import tabulate
from kcal.sim.chief import ChiefRays, LinesOfSight, solve_2x2
from kcal.sim.prescription import PRESCRIPTIONS, Prescription
from kcal.sim.raytrace import Misalignment
from kcal.sim.rectangle import PixelRectangle

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
        prescription: a lens, or its name.
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
        InputError: an unknown name, a value out of range, or a lens that does not reach the image's corners.

    Example:
        >>> lens = TruthLens("machine-vision")
        >>> pixels, valid = lens.project(torch.tensor([[0.5, 0.0, 1.0], [0.0, 0.0, -1.0]]).double())
        >>> [round(value, 2) for value in pixels[0].tolist()], valid.tolist()
        ([1743.36, 539.5], [True, False])
        >>> lens.table_error < 1e-6
        True
    """

    def __init__(
        self,
        prescription: Prescription | str,
        *,
        focal: float | None = None,
        size: tuple[int, int] = (1920, 1080),
        center: tuple[float, float] | None = None,
        misalignment: Misalignment | None = None,
        sensor_tilt: tuple[float, float] = (0.0, 0.0),
        focal_mm: float = 2.8,
        wander: float = 0.1,
    ) -> None:
        if isinstance(prescription, str):
            if prescription not in PRESCRIPTIONS:
                raise InputError(f"prescription {prescription!r}: there are {', '.join(PRESCRIPTIONS)}")
            prescription = PRESCRIPTIONS[prescription]
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
        self._chief = ChiefRays.build(
            prescription,
            focal=self._focal,
            focal_mm=focal_mm,
            axis=center or ((size[0] - 1) / 2, (size[1] - 1) / 2),
            misalignment=misalignment or Misalignment(),
            sensor_tilt=sensor_tilt,
        )
        self._origin = self._chief.lines(self._probe(17)).nearest_point()
        self._window = PixelRectangle(
            -_TABLE_MARGIN, -_TABLE_MARGIN, self.size[0] + 2 * _TABLE_MARGIN, self.size[1] + 2 * _TABLE_MARGIN
        )
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

    def _probe(self, count: int) -> Tensor:
        x = torch.linspace(0, self.size[0] - 1, count, dtype=torch.float64)
        y = torch.linspace(0, self.size[1] - 1, count, dtype=torch.float64)
        return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)

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
