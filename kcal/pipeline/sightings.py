"""Turn pairs of pixels into what a filter measures: direction and inverse range, with every error's effect on them.

The maximum-likelihood point of a pair (`kcal.locate.max_likelihood`) has three numbers: two across the line of sight
and the inverse range. They are nearly linear in the pixels at any range. Four pixel coordinates leave a fourth number,
the miss of the two rays in units of its sigma, which says nothing of the place, but of clocks and pairings.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import torch
from torch import Tensor

from kcal.lens.projection import Projection
from kcal.locate.localizer import StereoLocalizer
from kcal.locate.max_likelihood import PointFit, calibration_effect, symmetric, unreached_direction
from kcal.locate.stereo import PositionStatus, fit_pairs
from kcal.pipeline.pairs import ObjectPairs


class Sightings(NamedTuple):
    """N pairs of one moment, in the rig frame.

    The four measured numbers are a, b (shares of `direction` along `sides`), the inverse range and the miss; the point
    is (direction + a * sides[0] + b * sides[1]) / inverse at a = b = 0.

    Attributes:
        direction: (N, 3), of unit length to first order.
        sides: (N, 2, 3) across it.
        inverse: (N,) one over meters; may be negative.
        noise: (N, 3, 3) covariance of a, b and `inverse` from noise in the pixels; that of the miss is one.
        miss: (N,) how far the rays miss each other, in sigmas.
        shared: (N, 4, K) effect of K independent unit errors on the four: of the calibration, and the two that last.
        late: (2, N, 4, 3) how the four move by rates of (a, b, inverse) if the left or the right mark is a second late.
        time: (N, 2) seconds.
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
        return self._replace(
            **{
                name: value[:, which] if name == "late" else value[which]
                for name, value in zip(self._fields, self, strict=True)
            }
        )


@torch.no_grad()
def sightings(localize: StereoLocalizer, pairs: ObjectPairs, lasting_px: float = 0.0) -> Sightings:
    """Measure pairs with a rig; the calibration's errors are those that `localize` includes.

    Args:
        localize: the rig and how well it is known.
        pairs: of one moment.
        lasting_px: standard deviation along each axis of errors of the right marks that stay as long as a target.
    """
    rig = localize.rig
    found = fit_pairs(rig, pairs.left, pairs.right, pairs.covariance, by_camera=True)
    fit, scale = found.fit, found.scale
    across = _miss_direction(fit, pairs.covariance)
    fourth = fit._replace(gain=torch.cat([fit.gain, across.mT[None]], 0))
    shared = pairs.left.new_zeros(len(pairs), 4, 0)
    if localize.calibration_factor is not None:
        shared = calibration_effect(fourth, scale) @ localize.calibration_factor
    gain = fourth.gain.movedim(-1, 0)  # (N, 4, 4 pixels)
    if lasting_px:
        shared = torch.cat([shared, lasting_px * gain[..., 2:]], -1)
    left = _pixel_slopes(fit.projections[0], (*fit.sides.unbind(0), torch.zeros_like(fit.direction)))
    turn = rig.right_from_left_rotation
    shift = (rig.right_from_left_translation / scale)[:, None].expand_as(fit.direction)
    right = _pixel_slopes(fit.projections[1], (*(turn @ side for side in fit.sides.unbind(0)), shift))
    late = torch.stack([gain[..., :2] @ left, gain[..., 2:] @ right])
    # From ρ in units of the rig's size to one over meters.
    unit = torch.stack([torch.ones_like(scale), torch.ones_like(scale), 1.0 / scale])
    four = torch.cat([unit, unit.new_ones(1)])
    usable = found.usable & (found.status != int(PositionStatus.BAD_COVARIANCE))
    return Sightings(
        direction=fit.direction.mT,
        sides=fit.sides.permute(2, 0, 1),
        inverse=fit.inverse / scale,
        noise=symmetric(fit.covariance) * unit[:, None] * unit,
        miss=-(across * fit.residual.mT).sum(-1),
        shared=shared * four[:, None],
        late=late * four[:, None] / unit,
        time=pairs.time,
        row=pairs.right[:, 1] / rig.right.size[1] - 0.5,
        usable=usable,
    )


def _miss_direction(fit: PointFit, covariance: Tensor) -> Tensor:
    """(N, 4) the combination of pixels with unit variance that the point cannot explain.

    The gain (3, 4, N) is (Jᵀ W J)⁻¹ Jᵀ W: what it maps to zero is W⁻¹ times what J does not reach.
    """
    kernel = unreached_direction(fit)
    white = torch.linalg.solve_ex(covariance, kernel)[0]
    variance = (kernel * white).sum(-1, keepdim=True)
    return white / variance.clamp_min(1e-300).sqrt()


def _pixel_slopes(projection: Projection, columns: tuple[Tensor, ...]) -> Tensor:
    """(N, 2, 3) derivatives of pixels by three unknowns that move the seen point along `columns` (3, N) each."""
    moved = torch.stack(columns)  # (3 unknowns, 3, N)
    return (moved[:, :, None] * projection.by_point).sum(1).permute(2, 1, 0)


class Anchored(NamedTuple):
    """Sightings in frames of tracks: x / z, y / z and 1 / z there, and the miss.

    Attributes:
        value: (N, 4).
        noise: (N, 4, 4).
        shared: (N, 4, K).
        late: (2, N, 4, 3), by rates of the first three.
        ahead: (N,) bool: in front of the frame's plane.
    """

    value: Tensor
    noise: Tensor
    shared: Tensor
    late: Tensor
    ahead: Tensor


def anchored(seen: Sightings, frame: Tensor) -> Anchored:
    """Express sightings in frames (N, 3, 3): rotations from the rig's axes."""
    ray = (frame @ seen.direction[..., None])[..., 0]
    ahead = seen.usable & (ray[..., 2] > 0.1)
    ray = torch.where(ahead[..., None], ray, ray.new_tensor([0.0, 0.0, 1.0]))
    along, inverse = ray[..., 2:], seen.inverse[..., None] / ray[..., 2:]
    place = torch.cat([ray[..., :2] / along, inverse], -1)
    sides = frame @ seen.sides.mT  # (N, 3, 2), columns a and b
    turn = torch.zeros(*ray.shape[:-1], 4, 4, dtype=ray.dtype, device=ray.device)
    turn[..., :2, :2] = (sides[..., :2, :] - place[..., :2, None] * sides[..., 2:, :]) / along[..., None]
    turn[..., 2:3, :2] = -inverse[..., None] * sides[..., 2:, :] / along[..., None]
    turn[..., 2, 2] = 1.0 / along[..., 0]
    turn[..., 3, 3] = 1.0
    noise = torch.zeros_like(turn)
    noise[..., :3, :3] = turn[..., :3, :3] @ seen.noise @ turn[..., :3, :3].mT
    noise[..., 3, 3] = 1.0
    back = torch.linalg.inv_ex(turn[..., :3, :3])[0]
    value = torch.cat([place, seen.miss[..., None]], -1)
    return Anchored(value, noise, turn @ seen.shared, turn @ seen.late @ back, ahead)
