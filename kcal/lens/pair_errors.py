"""What is known of two cameras together, as errors of their lenses and of one pose relative to the other."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from torch import Tensor

from kcal.checks import as_covariance
from kcal.errors import InputError
from kcal.gaussian import half_of_covariance
from kcal.texts import brief


@dataclasses.dataclass(frozen=True, kw_only=True)
class RigCovariance:
    """The joint covariance of a rig's lenses and relative pose.

    The order is: the parameters of the left camera as in `Camera.names`, those of the right one, the rotation of
    right_from_left (3 radians: a rotation vector about the right camera's axes, `exp([ω]x) R`), its translation
    (3 meters), as in `kcal.lens.pose`.

    Args:
        half: (K, P) float64, P = the two cameras' parameters + 6: halfᵀ half is the covariance. As a root it loses
            nothing where coefficients are hardly determined one by one and their sum is.

    Example:
        >>> from kcal import Camera, Rig
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
        >>> sigma = torch.tensor([0, 1e-4, 0, 0, 0, 0], dtype=torch.float64)  # relative yaw
        >>> known = RigCovariance.of(rig, pose=torch.diag(sigma**2))
        >>> tuple(known.half.shape), tuple(known.matrix.shape)
        ((1, 16), (16, 16))
    """

    __repr__ = brief

    half: Tensor

    @classmethod
    def of(
        cls,
        rig: Any,
        *,
        left: Tensor | None = None,
        right: Tensor | None = None,
        pose: Tensor | None = None,
        joint: Tensor | None = None,
    ) -> RigCovariance:
        """Put parts together, each independent of the others and exact where left out; or take a `joint` matrix.

        Cameras and pose of a rig that was solved are not independent: errors of a lens are undone by the pose for all
        that was seen. Parts of a joint covariance taken as independent give intervals that are far too wide.

        Args:
            rig: the `Rig` of two cameras that they belong to.
            left: of the left camera's parameters, (5 + P, 5 + P).
            right: of the right camera's.
            pose: (6, 6) of the relative pose.
            joint: all of it, in place of the parts.

        Raises:
            InputError: a wrong shape, a matrix that is no covariance, or parts and a joint matrix together.
        """
        sizes = (*rig.sizes, 6)
        if joint is not None:
            if not (left is None and right is None and pose is None):
                raise InputError("rig covariance: give the joint matrix or its parts, not both")
            return cls(half=half_of_covariance(as_covariance("joint covariance", joint, sum(sizes))))
        names = ("left camera's covariance", "right camera's covariance", "pose covariance")
        parts = [as_covariance(*item) for item in zip(names, (left, right, pose), sizes, strict=True)]
        return cls(half=torch.block_diag(*map(half_of_covariance, parts)))

    @property
    def matrix(self) -> Tensor:
        """(P, P) the covariance."""
        return self.half.T @ self.half


def relative_root(root: Tensor, center: Tensor, right: Tensor, look: Tensor, *, back: bool = False) -> Tensor:
    """(K, P) `Rig.root` in the quantities of `Rig.relative_root`.

    Args:
        root: of two cameras.
        center: (2, 3) of the cameras, meters.
        right: (3, 3) rotation right_from_rig.
        look: (3, 3) rotation enu_from_rig.
        back: the inverse of it.
    """
    center, right = center.detach().to(root), right.detach().to(root)
    look, between = look.to(root), center[0] - center[1]
    crossed = torch.linalg.cross(between.expand(3, 3), torch.eye(3).to(root)).T
    by = torch.block_diag(torch.zeros(12, 12).to(root), torch.ones(1, 1).to(root))
    # Center and turn of both cameras; turn and shift of the relative pose, place and attitude.
    c0, t0, c1, t1 = turn, shift, place, attitude = [slice(at, at + 3) for at in (0, 3, 6, 9)]
    if back:
        by[c0, place], by[t0, attitude] = look.T, look.T
        by[t1, attitude], by[t1, turn] = look.T, -right.T
        by[c1, place], by[c1, shift] = look.T, -right.T
        by[c1, attitude], by[c1, turn] = crossed @ look.T, -crossed @ right.T
    else:
        by[turn, t0], by[turn, t1] = right, -right
        by[shift, c0], by[shift, c1], by[shift, t1] = right, -right, right @ crossed
        by[place, c0], by[attitude, t0] = look, look
    lenses, poses = root[:, :-13], root[:, -13:]
    found = poses @ by.T
    # A difference that is zero but for rounding is zero.
    found = torch.where(found.abs() > 1e-13 * (poses.abs() @ by.T.abs()), found, 0.0)
    return torch.cat([lenses, found], 1)
