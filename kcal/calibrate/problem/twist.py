"""How a pose takes a step: along a twist, so that long steps of many boards stay close to the linear model."""

from __future__ import annotations

import torch
from torch import Tensor


def apply_twist(rotation: Tensor, translation: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
    """Move rigid motions by the twist whose first-order effect is that of `kcal.lens.pose.step_rows`.

    A step is (ω, v): points turn by ω about the origin of their own frame, which itself moves by v. Applied
    separately, R ← exp([ω]×) R and t ← t + v, a rotation about any other center deviates from its arc by |ω|² |t| / 2.
    The exponential of the twist (ω, v - ω × t) follows the arc for any center. So boards can follow a rotation of the
    camera's axis, which rich lens models hardly determine, in a few long steps.

    Args:
        rotation: (..., 3, 3).
        translation: (..., 3) meters.
        step: (..., 6) radians and meters.

    Source: Murray, Li, Sastry: A Mathematical Introduction to Robotic Manipulation, Eq. 2.36.

    Example:
        >>> quarter = torch.tensor([0.0, 0.0, torch.pi / 2, -torch.pi / 2, 0.0, 0.0], dtype=torch.float64)
        >>> start = torch.eye(3).double(), torch.tensor([0.0, 1.0, 0.0]).double()
        >>> [round(x, 12) + 0.0 for x in apply_twist(*start, quarter)[1].tolist()]  # a quarter turn about the origin
        [-1.0, 0.0, 0.0]
    """
    turn, shift = step[..., :3], step[..., 3:]
    along = shift - torch.linalg.cross(turn, translation)
    square = (turn * turn).sum(-1, keepdim=True)
    near = square < 1e-4
    far = torch.where(near, 1.0, square)
    angle = far.sqrt()
    # sin a / a, (1 - cos a) / a² and (a - sin a) / a³, by their series where these would cancel.
    sine = torch.where(near, 1.0 - square * (1.0 - square / 20.0) / 6.0, torch.sin(angle) / angle)
    first = torch.where(near, 0.5 - square * (1.0 - square / 30.0) / 24.0, (1.0 - torch.cos(angle)) / far)
    second = torch.where(near, (1.0 - square * (1.0 - square / 42.0) / 20.0) / 6.0, (1.0 - sine) / far)
    # exp([ω]×) and its integral as linear maps of all columns at once: R, t, and the shift.
    columns = torch.cat([rotation, translation[..., None], along[..., None]], -1)
    turned = torch.linalg.cross(turn[..., None].expand_as(columns), columns, dim=-2)
    twice = torch.linalg.cross(turn[..., None].expand_as(columns), turned, dim=-2)
    moved = columns + sine[..., None] * turned + first[..., None] * twice
    screwed = along + first * turned[..., 4] + second * twice[..., 4]
    return moved[..., :3], moved[..., 3] + screwed
