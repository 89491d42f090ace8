"""Find where on the optical axis the ray to a point starts: the entrance pupil of the hybrid lens.

Seen from the front, the entrance pupil of a real lens moves along the axis with the angle. The ray at the angle θ
starts at (0, 0, d) with

    d = ζ₁ θ² + ζ₂ θ⁴,   θ = atan2(ρ, Z - d),   ρ = √(X² + Y²)

in meters: such a camera is not central (Gennery 2006; mrcal's tour of noncentral projection). θ is the angle of the ray
itself, so that all points of a ray have the same pixel. The equation is solved by Newton's method, which takes one step
from d = 0 for points at long range and two at 1 m. For points at infinity the pupil has no effect.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcal.dispatch import is_differentiated, known_true
from kcal.lens.plane import angle_over_distance
from kcal.lens.zernike import unbind_last

# Meters at which a point is as good as infinitely far: an entrance pupil has no effect there. Scaling by a power of two
# rounds nothing.
FAR = 2.0**40
# Newton's steps at most, and where all points take the same number. Points at long range need one, those at 1 m two,
# and those at some five times the movement of the pupil all.
_STEPS = 5
# A step below this, relative to the distance, leaves an error of rounding: errors are squared at each step.
_LAST_STEP = 1e-6


class Pupil(NamedTuple):
    """Where rays start, and what its derivatives need; every tensor is (..., N).

    Attributes:
        depth: d, meters.
        found: whether the equation is solved. For points about as close as the pupil moves it has no unique solution.
        square: θ² of the ray.
        rate: derivative of ζ₁ θ² + ζ₂ θ⁴ by d, divided by ρ².
        gain: 1 / (1 - rate ρ²), the derivative of the solution by a shift of the right side.
        meter: what a meter measures in the units of the points.
    """

    depth: Tensor
    found: Tensor
    square: Tensor
    rate: Tensor
    gain: Tensor
    meter: Tensor | float

    def by_point(self, X: Tensor, Y: Tensor, below: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Derivatives of the depth by X, Y and Z of the point; `below` is Z - d."""
        slope = self.rate * self.gain
        return slope * below * X, slope * below * Y, -slope * (X * X + Y * Y)

    def by_coefficients(self) -> tuple[Tensor, Tensor]:
        """Derivatives of the depth by ζ₁ and ζ₂."""
        first = self.meter * self.gain * self.square
        return first, first * self.square

    def by_meter(self, coefficients: Tensor) -> Tensor:
        """Derivative of the depth by what a meter measures, of points that stay as they are."""
        return self.gain * pupil_depth(self.square, coefficients)


def pupil_depth(square: Tensor, coefficients: Tensor) -> Tensor:
    """D of rays with given θ² (..., N), for a hybrid lens (..., P)."""
    first, second = unbind_last(coefficients[..., 1:3])
    return (first + second * square) * square


def ray_starts(
    X: Tensor, Y: Tensor, Z: Tensor, coefficients: Tensor, meter: Tensor | float = 1.0
) -> tuple[Tensor, Tensor]:
    """Find the depth (..., N) at which the rays to points start, for a hybrid lens (..., P), and whether it was found.

    Points and depth are in units of which a meter is `meter` (..., N). At infinity that is 0, and the pupil stays.

    Two of Newton's steps are in the autograd graph; at a solution these have its exact first and second derivatives.
    """
    with torch.no_grad():
        depth = torch.zeros_like(Z)
        for _ in range(_STEPS):
            wanted, pupil = _pupil_at(X, Y, Z, coefficients, depth, meter)
            step = (wanted - depth) * pupil.gain
            depth = depth + step
            found = pupil.found & (step * step <= _LAST_STEP**2 * (X * X + Y * Y + Z * Z))
            if known_true(found):
                break
    if is_differentiated(X, Y, Z, coefficients, meter if isinstance(meter, Tensor) else None):
        for _ in range(2):
            wanted, pupil = _pupil_at(X, Y, Z, coefficients, depth, meter)
            depth = depth + (wanted - depth) * pupil.gain
    return depth, found


def entrance_pupil(X: Tensor, Y: Tensor, Z: Tensor, coefficients: Tensor, meter: Tensor | float = 1.0) -> Pupil:
    """As `ray_starts`, with what closed-form derivatives need."""
    depth, found = ray_starts(X, Y, Z, coefficients, meter)
    _, pupil = _pupil_at(X, Y, Z, coefficients, depth, meter)
    return pupil._replace(found=found)


def _pupil_at(
    X: Tensor, Y: Tensor, Z: Tensor, coefficients: Tensor, depth: Tensor, meter: Tensor | float
) -> tuple[Tensor, Pupil]:
    """The right side of the equation for a ray that starts at `depth`."""
    first, second = unbind_last(coefficients[..., 1:3])
    across, below = X * X + Y * Y, Z - depth
    ratio = angle_over_distance(X, Y, below)
    square = ratio * ratio * across
    # θ² grows by 2 θ ρ / R² with d.
    rate = 2.0 * meter * (first + 2.0 * second * square) * ratio / (across + below * below)
    gain = (1.0 - rate * across).reciprocal()
    return meter * (first + second * square) * square, Pupil(depth, gain > 0, square, rate, gain, meter)
