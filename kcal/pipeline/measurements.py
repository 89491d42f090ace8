"""Turn pairs of pixels into what a filter measures: direction and inverse range, with every error's effect on them.

The maximum-likelihood point of a pair (`kcal.locate.max_likelihood`) has three numbers: two across the line of sight
and the inverse range. They are nearly linear in the pixels at any range. Four pixel coordinates leave a fourth number,
the miss of the two rays in units of its sigma, which says nothing of the place, but of clocks and pairings.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import torch
from torch import Tensor

from kcal.locate.localizer import StereoLocalizer
from kcal.locate.max_likelihood import PointFit, calibration_effect, symmetric, unreached_direction
from kcal.locate.stereo import PositionStatus, fit_pairs
from kcal.pipeline.small_matrices import congruent, eliminate, outer, product, solved


class Sightings(NamedTuple):
    """N pairs of one moment, in the rig frame; the last axis of all counts them.

    The four measured numbers are a, b (shares of `direction` along `sides`), the inverse range and the miss; the point
    is (direction + a * sides[0] + b * sides[1]) / inverse at a = b = 0.

    Attributes:
        direction: (3, N), of unit length to first order.
        sides: (2, 3, N) across it.
        inverse: (N,) one over meters; may be negative.
        noise: (4, 4, N) covariance of the four from noise in the pixels; that of the miss is one.
        miss: (N,) how far the rays miss each other, in sigmas.
        shared: (4, K, N) effect of K independent unit errors on the four: of the calibration, and the two that last.
        late: (2, 4, 3, N) how the four move by rates of (a, b, inverse) if the left or the right mark is a second late.
        time: (2, N) seconds.
        row: (N,) row of the right mark, -0.5 at the top of the image to 0.5 at its bottom.
        usable: (N,) bool: the rays exist and are not along the baseline.
    """

    direction: Tensor
    sides: Tensor
    inverse: Tensor
    noise: Tensor
    miss: Tensor
    shared: Tensor
    late: Tensor
    time: Tensor
    row: Tensor
    usable: Tensor

    def at(self, which: Tensor) -> Self:
        """The sightings at some places."""
        return type(self)(*(value[..., which] for value in self))


@torch.no_grad()
def sightings(
    localize: StereoLocalizer,
    left: Tensor,
    right: Tensor,
    covariance: Tensor,
    time: Tensor,
    lasting_px: float = 0.0,
) -> Sightings:
    """Measure N pairs of one moment; the calibration's errors are those that `localize` includes.

    Args:
        localize: the rig and how well it is known.
        left: (N, 2) pixels.
        right: (N, 2).
        covariance: (N, 4, 4) of the four coordinates.
        time: (N, 2) seconds.
        lasting_px: standard deviation along each axis of errors of the right marks that stay as long as a target.
    """
    rig = localize.rig
    found = fit_pairs(rig, left, right, covariance, by_camera=True)
    fit, scale = found.fit, found.scale
    across = _miss_direction(fit, covariance.movedim(0, -1))
    gain = torch.cat([fit.gain, across[None]])  # (4, 4 pixels, N)
    shared = gain[:, :0]
    if localize.calibration_factor is not None:
        shared = calibration_effect(fit._replace(gain=gain), scale, localize.calibration_factor)
    if lasting_px:
        shared = torch.cat([shared, lasting_px * gain[:, 2:]], 1)
    by_left = product(gain[:, :2], fit.jacobian[:, :2].transpose(0, 1))
    # Where both marks are late, the point is: its three numbers move as they do, and the miss does not.
    both = torch.eye(4, 3, dtype=gain.dtype, device=gain.device)[..., None]
    # From ρ in units of the rig's size to one over meters.
    unit = torch.stack([torch.ones_like(scale), torch.ones_like(scale), 1.0 / scale])[:, None]
    four = torch.cat([unit, torch.ones_like(unit[:1])])[:, None]
    noise = symmetric(fit.covariance).movedim(0, -1) * four[:3] * unit
    last = torch.eye(4, dtype=gain.dtype, device=gain.device)[3]
    usable = found.usable & (found.status != int(PositionStatus.BAD_COVARIANCE))
    return Sightings(
        direction=fit.direction,
        sides=fit.sides,
        inverse=fit.inverse / scale,
        noise=torch.nn.functional.pad(noise, (0, 0, 0, 1, 0, 1)) + outer(last, last)[..., None],
        miss=-(across * fit.residual).sum(0),
        shared=shared * four,
        late=torch.stack([by_left, both - by_left]) * four / unit,
        time=time.T,
        row=right[:, 1] / rig.right.size[1] - 0.5,
        usable=usable,
    )


def _miss_direction(fit: PointFit, covariance: Tensor) -> Tensor:
    """(4, N) the combination of pixels with unit variance that the point cannot explain.

    The gain (3, 4, N) is (Jᵀ W J)⁻¹ Jᵀ W: what it maps to zero is W⁻¹ times what J does not reach.
    """
    kernel = unreached_direction(fit)
    white = solved(eliminate(covariance, kernel[:, None]))[:, 0]
    return white / (kernel * white).sum(0).clamp_min(1e-300).sqrt()


class Anchored(NamedTuple):
    """Sightings in frames of tracks: x / z, y / z and 1 / z there, and the miss.

    Attributes:
        value: (4, N).
        noise: (4, 4, N).
        shared: (4, K, N).
        late: (2, 4, 3, N), by rates of the first three.
        ahead: (N,) bool: in front of the frame's plane.
    """

    value: Tensor
    noise: Tensor
    shared: Tensor
    late: Tensor
    ahead: Tensor

    def at(self, which: Tensor) -> Self:
        """The sightings at some places."""
        return type(self)(*(value[..., which] for value in self))


def anchored(seen: Sightings, frame: Tensor) -> Anchored:
    """Express sightings in frames (3, 3, N): rotations from the rig's axes."""
    ray = (frame * seen.direction).sum(1)
    ahead = seen.usable & (ray[2] > 0.1)
    axis = torch.eye(3, dtype=ray.dtype, device=ray.device)[2, :, None]
    ray = torch.where(ahead, ray, axis)
    along, inverse = ray[2], seen.inverse / ray[2]
    place = torch.cat([ray[:2] / along, inverse[None]])
    sides = product(frame, seen.sides.transpose(0, 1)) / along  # (3, 2, N), columns a and b
    # x / z, y / z, 1 / z by a, b and the inverse range along `direction`.
    by_sides = torch.cat([sides[:2], torch.zeros_like(sides[:1])]) - place[:, None] * sides[2]
    unit = torch.eye(4, dtype=ray.dtype, device=ray.device)
    turn = torch.cat([by_sides, (axis / along)[:, None]], 1)
    turn = torch.nn.functional.pad(turn, (0, 0, 0, 1, 0, 1)) + outer(unit[3], unit[3])[..., None]
    # And back: the matrix is [A 0; r d], whose inverse is [A⁻¹ 0; -r A⁻¹ / d, 1 / d].
    (a, b), (c, d) = by_sides[:2]
    inverse_sides = torch.stack([d, -b, -c, a]).unflatten(0, (2, 2)) / (a * d - b * c)
    last = torch.cat([-along * (by_sides[2, :, None] * inverse_sides).sum(0), along[None]])
    back = torch.cat([torch.nn.functional.pad(inverse_sides, (0, 0, 0, 1)), last[None]])
    return Anchored(
        value=torch.cat([place, seen.miss[None]]),
        noise=congruent(turn, seen.noise),
        shared=product(turn, seen.shared),
        late=torch.stack([product(product(turn, late), back) for late in seen.late]),
        ahead=ahead,
    )
