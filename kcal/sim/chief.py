"""Trace chief rays: from a pixel through the middle of the aperture stop to its line of sight in front of the lens."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.pose import rotation_from_vector
from kcal.sim.prescription import Prescription, focal_length
from kcal.sim.raytrace import Misalignment, Placed, place, trace

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


@dataclass(frozen=True, kw_only=True, eq=False)
class ChiefRays:
    """A lens with its sensor; see `build`.

    Convention: the camera frame (x right, y down, z forward, meters) has its origin in the front vertex.

    Args:
        surfaces: of the lens, in meters.
        stop: place of the aperture stop among them.
        sensor: its vertex (3,) and rotation (3, 3) in the lens's frame.
        axis: (2,) pixel at that vertex.
        pitch: meters per pixel.
        name: for messages.
    """

    surfaces: list[Placed]
    stop: int
    sensor: tuple[Tensor, Tensor]
    axis: Tensor
    pitch: float
    name: str

    @staticmethod
    def build(
        prescription: Prescription,
        *,
        focal: float,
        focal_mm: float,
        axis: tuple[float, float],
        misalignment: Misalignment,
        sensor_tilt: tuple[float, float],
    ) -> ChiefRays:
        """Place a lens of `focal_mm` millimeters before a sensor on which that is `focal` pixels."""
        scale = 1e-3 * focal_mm / focal_length(prescription)
        surfaces = place(prescription, 1e-3 * focal_mm, scale, misalignment)
        # Misalignment moves pieces of glass, not the barrel.
        length = scale * sum(surface.thickness for surface in prescription.surfaces)
        return ChiefRays(
            surfaces=surfaces,
            stop=prescription.stop,
            sensor=(
                torch.tensor([0.0, 0.0, length], dtype=torch.float64),
                rotation_from_vector(torch.tensor([*sensor_tilt, 0.0], dtype=torch.float64)),
            ),
            axis=torch.tensor(axis, dtype=torch.float64),
            pitch=1e-3 * focal_mm / focal,
            name=prescription.name,
        )

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
