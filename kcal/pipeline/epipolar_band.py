"""Which pairs of pixels can be of one object at all: a cheap test that comes before any point is fitted.

Two rays meet where rayᵀ_right E ray_left is zero. How far it may be from zero follows, to first order, from the noise
of the pixels and the errors of the rig. Rays and their derivatives are computed once for each pixel, and a pair costs
a few products. Far from the line, the fit of a point may also stop at a false optimum; such pairs end here.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcal.lens.camera import Camera
from kcal.lens.rig import StereoRig
from kcal.lens.uncertainty import pixel_slopes

# The band is this many times as wide as the errors to first order say, for lenses that bend within it.
_SLACK = 1.5


# Ranges from the left camera and from the rig's middle differ by this ratio at most, from 2 baselines on.
_MIDDLE = 1.25
# Numbers that are held at once.
_AT_ONCE = 1 << 20


class _Rays(NamedTuple):
    """N rays of a camera, in the frame of the right one.

    Attributes:
        ray: (N, 3).
        by_pixel: (N, 3, 2) turns of it by a pixel.
        by_error: (N, 3, K) turns of it by the errors of the rig.
    """

    ray: Tensor
    by_pixel: Tensor
    by_error: Tensor

    def at(self, which: Tensor | tuple[Tensor, Tensor]) -> _Rays:
        return _Rays(*(value[which] for value in self))

    def split(self, moments: int) -> _Rays:
        """Those of so many moments: (B, N / B, ...)."""
        return _Rays(*(value.unflatten(0, (moments, -1)) for value in self))


def near_epipolar_lines(
    rig: StereoRig,
    left: Tensor,
    right: Tensor,
    sigma: float,
    gate: float,
    ranges: tuple[float, float] | None = None,
) -> Tensor:
    """(..., N, M) bool: False only where the epipolar error is beyond `gate` standard deviations for certain.

    Args:
        rig: the calibrated cameras; errors of its `covariance` widen the band.
        left: (..., N, 2) float64 pixels.
        right: (..., M, 2), with the same leading dimensions: moments, whose pixels are not compared with each other's.
        sigma: standard deviation of every pixel along each axis.
        gate: standard deviations.
        ranges: nearest and farthest, meters: pairs beyond them by as many standard deviations are left out, too.

    Example:
        >>> from kcal.rig import planned_rig
        >>> left = torch.tensor([[960.0, 540.0]], dtype=torch.float64)
        >>> right = torch.tensor([[944.0, 541.0], [944.0, 640.0]], dtype=torch.float64)
        >>> near_epipolar_lines(planned_rig(), left, right, 1.0, 4.0).tolist()
        [[True, False]]
    """
    rotation, shift = rig.right_from_left_rotation, rig.right_from_left_translation
    sizes = (rig.left.values.shape[-1], rig.right.values.shape[-1], 3, 3)
    known = shift.new_zeros(0, sum(sizes)) if rig.covariance is None else rig.covariance.half.to(shift)
    own = known.T.split(sizes)
    near = torch.zeros(*left.shape[:-1], right.shape[-2], dtype=torch.bool, device=left.device)
    if not near.numel():
        return near
    whole = near.reshape(-1, *near.shape[-2:])
    ray, by_pixel, by_error = _turns(rig.left, left.reshape(-1, 2), own[0])
    first = _Rays(ray @ rotation.T, rotation @ by_pixel, own[2] - rotation @ by_error).split(len(whole))
    other = _Rays(*_turns(rig.right, right.reshape(-1, 2), own[1])).split(len(whole))
    shifts = shift, own[3]
    errors, pairs = max(1, own[3].shape[1]), whole[0].numel()
    for moments in torch.arange(len(whole), device=left.device).split(_AT_ONCE // (32 * pairs) + 1):
        seen = other.at(moments)
        for rows in torch.arange(left.shape[-2], device=left.device).split(_AT_ONCE // (32 * right.shape[-2]) + 1):
            part = first.at((moments[:, None], rows))
            block = _possible(part, seen, shifts, sigma, _SLACK * gate, ranges)
            if len(known):
                # Exact where the bound on what the errors of the rig do leaves it open.
                for at, some, columns in (which.T for which in block.nonzero().split(_AT_ONCE // (8 * errors) + 1)):
                    certain = _certain(part.at((at, some)), seen.at((at, columns)), shifts, sigma, _SLACK * gate)
                    block[at, some, columns] = certain
            whole[moments[:, None], rows] = block
    return near


def _possible(
    first: _Rays,
    other: _Rays,
    shifts: tuple[Tensor, Tensor],
    sigma: float,
    gate: float,
    ranges: tuple[float, float] | None,
) -> Tensor:
    """(B, N, M) bool: each error of the rig as large as it can be beside the others."""
    shift, by_shift = shifts
    turned, rays = first.ray[..., None, :], other.ray[:, None]
    across = torch.linalg.cross(rays, shift.expand_as(rays))
    shifted = torch.linalg.cross(*torch.broadcast_tensors(turned, rays))
    error = (turned * across).sum(-1)
    # Derivatives of the error (B, N, M, 3) by turns of the left rays about the right camera's axes, and of right rays.
    by_turn = torch.linalg.cross(*torch.broadcast_tensors(turned, across))
    by_other = torch.linalg.cross(*torch.broadcast_tensors(rays, torch.linalg.cross(shift.expand_as(turned), turned)))
    marks = (by_turn @ first.by_pixel).square().sum(-1)
    marks = marks + (by_other.transpose(1, 2) @ other.by_pixel).square().sum(-1).mT
    moved = _length(by_turn, first.by_error) + _length(by_other.transpose(1, 2), other.by_error).mT
    moved = moved + _length(shifted, by_shift)
    # What products of two turns add at most.
    turns = first.by_pixel.square().sum((-2, -1))[..., None], other.by_pixel.square().sum((-2, -1))[:, None]
    second = (gate * sigma) ** 2 * (turns[0] + turns[1])
    baseline = torch.linalg.vector_norm(shift)
    near = error.abs() <= gate * ((sigma**2 * marks).sqrt() + moved) + second * baseline
    if ranges is None:
        return near
    # A point at the inverse distance q is seen where the cross product of its rays is q times that with the baseline.
    length = torch.linalg.vector_norm(across, dim=-1).clamp_min(1e-12)
    inverse = (shifted * across).sum(-1) / length.square()
    errors = first.by_error.square().sum((-2, -1))[..., None], other.by_error.square().sum((-2, -1))[:, None]
    own = [(sigma**2 * turn).sqrt() + error.sqrt() for turn, error in zip(turns, errors, strict=True)]
    stretch = (own[1] * baseline + by_shift.square().sum().sqrt()) / length
    reach = gate * ((own[0] + own[1]) / length + inverse.abs() * stretch) + second / length
    beyond = inverse + reach < 1.0 / (_MIDDLE * ranges[1])
    before = inverse - reach > _MIDDLE / ranges[0]
    # Near the baseline's own direction nothing is said of the distance.
    return near & ~((beyond | before) & (gate * stretch < 0.3))


def _length(by: Tensor, errors: Tensor) -> Tensor:
    """Of by (..., M, 3) times errors (..., 3, K), by the products of the errors with each other: no K for each pair."""
    return ((by @ (errors @ errors.mT)) * by).sum(-1).clamp_min(0.0).sqrt()


def _certain(first: _Rays, other: _Rays, shifts: tuple[Tensor, Tensor], sigma: float, gate: float) -> Tensor:
    """(L,) bool: the same of L pairs, with the errors of the rig together."""
    shift, by_shift = shifts
    across = torch.linalg.cross(other.ray, shift.expand_as(other.ray))
    by_turn = torch.linalg.cross(first.ray, across)[:, None]
    by_other = torch.linalg.cross(other.ray, torch.linalg.cross(shift.expand_as(first.ray), first.ray))[:, None]
    shifted = torch.linalg.cross(first.ray, other.ray)[:, None]
    marks = torch.cat([by_turn @ first.by_pixel, by_other @ other.by_pixel], -1)
    moved = by_turn @ first.by_error - by_other @ other.by_error + shifted @ by_shift
    variance = sigma**2 * marks.square().sum((1, 2)) + moved.square().sum((1, 2))
    turns = sum(ray.by_pixel.square().sum((1, 2)) for ray in (first, other))
    second = (gate * sigma) ** 2 * turns * torch.linalg.vector_norm(shift)
    return (first.ray * across).sum(-1).abs() <= gate * variance.sqrt() + second


def _turns(camera: Camera, pixels: Tensor, half: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rays (N, 3), turns of them (N, 3, 2) by a pixel and (N, 3, K) by the K errors of the camera's parameters."""
    rays, _ = camera.unproject(pixels)
    by_camera, by_motion, _ = pixel_slopes(camera, rays, torch.inf, list(range(len(half))))
    by_turn = by_motion[..., :3]
    turns = by_turn.mT @ torch.linalg.inv_ex(by_turn @ by_turn.mT)[0]
    return rays, turns, turns @ (by_camera @ half)
