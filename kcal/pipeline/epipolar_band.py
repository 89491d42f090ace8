"""Which pairs of pixels can be of one object at all: a cheap test that comes before any point is fitted.

Two rays meet where rayᵀ_right E ray_left is zero. How far it may be from zero follows, to first order, from the noise
of the pixels and the errors of the rig. Rays and their derivatives are computed once for each pixel, and a pair costs
a few products. Far from the line, the fit of a point may also stop at a false optimum; such pairs end here.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.lens.camera import Camera
from kcal.lens.rig import StereoRig
from kcal.lens.uncertainty import pixel_slopes

# The band is this many times as wide as the errors to first order say, for lenses that bend within it.
_SLACK = 1.5


def near_epipolar_lines(rig: StereoRig, left: Tensor, right: Tensor, sigma: float, gate: float) -> Tensor:
    """(N, M) bool: False only where the epipolar error is beyond `gate` standard deviations for certain.

    Args:
        rig: the calibrated cameras; errors of its `covariance` widen the band.
        left: (N, 2) float64 pixels.
        right: (M, 2).
        sigma: standard deviation of every pixel along each axis.
        gate: standard deviations.

    Example:
        >>> from kcal.rig import planned_rig
        >>> left = torch.tensor([[960.0, 540.0]], dtype=torch.float64)
        >>> right = torch.tensor([[944.0, 541.0], [944.0, 640.0]], dtype=torch.float64)
        >>> near_epipolar_lines(planned_rig(), left, right, 1.0, 4.0).tolist()
        [[True, False]]
    """
    rotation, shift = rig.right_from_left_rotation, rig.right_from_left_translation
    sizes = (rig.left.values.shape[-1], rig.right.values.shape[-1], 3, 3)
    known = shift.new_zeros(0, sum(sizes)) if rig.covariance is None else rig.covariance.half
    own = known.T.split(sizes)
    rays_left, by_left, effect_left = _turns(rig.left, left, own[0])
    rays_right, by_right, effect_right = _turns(rig.right, right, own[1])
    turned = (rays_left @ rotation.T)[:, None]
    across = torch.linalg.cross(rays_right, shift.expand_as(rays_right))[None]
    error = (turned * across).sum(-1)
    # Derivatives of the error (N, M, 3) by turns of the left rays about the right camera's axes, and of the right rays.
    by_turn = torch.linalg.cross(*torch.broadcast_tensors(turned, across))
    normal = torch.linalg.cross(shift.expand_as(turned), turned)
    by_other = torch.linalg.cross(*torch.broadcast_tensors(rays_right[None], normal))
    shifted = torch.linalg.cross(*torch.broadcast_tensors(turned, rays_right[None]))
    by_left, by_other = rotation @ by_left, by_other.movedim(1, 0)
    marks = torch.cat([by_turn @ by_left, (by_other @ by_right).movedim(0, 1)], -1)
    moved = by_turn @ (own[2] - rotation @ effect_left) - (by_other @ effect_right).movedim(0, 1) + shifted @ own[3]
    variance = sigma**2 * marks.square().sum(-1) + moved.square().sum(-1)
    # What products of two turns add at most.
    reach = (_SLACK * gate * sigma) ** 2
    second = by_left.square().sum((1, 2))[:, None] + by_right.square().sum((1, 2))
    return ~(error.abs() > _SLACK * gate * variance.sqrt() + reach * rig.baseline * second)


def _turns(camera: Camera, pixels: Tensor, half: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rays (N, 3), turns of them (N, 3, 2) by a pixel and (N, 3, K) by the K errors of the camera's parameters."""
    rays, _ = camera.unproject(pixels)
    by_camera, by_motion, _ = pixel_slopes(camera, rays, torch.inf, list(range(len(half))))
    by_turn = by_motion[..., :3]
    turns = by_turn.mT @ torch.linalg.inv_ex(by_turn @ by_turn.mT)[0]
    return rays, turns, turns @ (by_camera @ half)
