"""Where errors of positions come from besides the marks: the calibration, and how the rig stands on the Earth."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.checks import require_finite
from kcal.errors import InputError
from kcal.lens.rig import StereoRig

# Eigenvalues below minus this share of the largest are no rounding: the matrix is no covariance.
_NEGATIVE = 1e-9


def checked_covariance(name: str, matrix: Tensor | None, size: int) -> Tensor:
    """`matrix` as float64, (size, size) and a covariance; zeros for None."""
    if matrix is None:
        return torch.zeros(size, size, dtype=torch.float64)
    if not isinstance(matrix, Tensor) or tuple(matrix.shape) != (size, size):
        shape = tuple(matrix.shape) if isinstance(matrix, Tensor) else type(matrix).__name__
        raise InputError(f"{name}: a covariance of shape ({size}, {size}) is needed, got {shape}")
    matrix = matrix.detach().to(torch.float64)
    require_finite(name, matrix)
    scale = matrix.diagonal().clamp_min(0.0).sqrt()
    # Entries have different units: compare them as correlations.
    unit = matrix / torch.where(scale > 0, scale, 1.0)[:, None] / torch.where(scale > 0, scale, 1.0)[None, :]
    if not torch.allclose(unit, unit.T, atol=1e-9) or float(torch.linalg.eigvalsh(unit)[0]) < -_NEGATIVE * size:
        raise InputError(f"{name}: not a covariance; it must be symmetric and have no negative eigenvalue")
    return 0.5 * (matrix + matrix.T)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RigCovariance:
    """How well a rig is known: one joint covariance, so that what is correlated stays so.

    The order is: the parameters of the left camera as in `Camera.names`, those of the right one, the rotation of
    right_from_left (3 radians: a rotation vector about the right camera's axes, `exp([ω]x) R`), its translation
    (3 meters), as in `kcal.lens.pose` and in `RigCalibrationResult`.

    Args:
        matrix: (P, P) float64, P = the two cameras' parameters + 6.

    Example:
        >>> from kcal.lens.camera import Camera
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
        >>> sigma = torch.tensor([0, 1e-4, 0, 0, 0, 0], dtype=torch.float64)  # relative yaw
        >>> known = RigCovariance.of(rig, pose=torch.diag(sigma**2))
        >>> tuple(known.matrix.shape)
        (16, 16)
    """

    matrix: Tensor

    @classmethod
    def of(
        cls,
        rig: StereoRig,
        *,
        left: Tensor | None = None,
        right: Tensor | None = None,
        pose: Tensor | None = None,
        joint: Tensor | None = None,
    ) -> RigCovariance:
        """Put parts together, each independent of the others and exact where left out; or check a `joint` matrix.

        Args:
            rig: the rig that they belong to.
            left: of the left camera's parameters, (5 + P, 5 + P).
            right: of the right camera's.
            pose: (6, 6) of the relative pose.
            joint: all of it, in place of the parts.

        Raises:
            InputError: a wrong shape, a matrix that is no covariance, or parts and a joint matrix together.
        """
        sizes = (rig.left.values.shape[-1], rig.right.values.shape[-1], 6)
        if joint is not None:
            if not (left is None and right is None and pose is None):
                raise InputError("rig covariance: give the joint matrix or its parts, not both")
            return cls(matrix=checked_covariance("joint covariance", joint, sum(sizes)))
        names = ("left camera's covariance", "right camera's covariance", "pose covariance")
        parts = [checked_covariance(*item) for item in zip(names, (left, right, pose), sizes, strict=True)]
        return cls(matrix=torch.block_diag(*parts))

    def factor(self) -> Tensor:
        """(P, K) with factor @ factor.T = matrix, K being its rank."""
        scale = self.matrix.diagonal().sqrt()
        safe = torch.where(scale > 0, scale, 1.0)
        values, vectors = torch.linalg.eigh(self.matrix / safe[:, None] / safe[None, :])
        kept = values > 1e-14 * values[-1].clamp_min(1e-300)
        return scale[:, None] * vectors[:, kept] * values[kept].sqrt()


def checked_link(calibration: RigCovariance | None, mounting: Tensor | None, link: Tensor) -> Tensor:
    """`link` as float64: (P, 6), and one covariance together with those of calibration (P, P) and mounting (6, 6)."""
    if calibration is None or mounting is None:
        raise InputError("link: it needs the covariances of both the calibration and the mounting")
    size = len(calibration.matrix)
    if not isinstance(link, Tensor) or tuple(link.shape) != (size, 6):
        raise InputError(f"link: a covariance of the calibration with the mounting, ({size}, 6), is needed")
    upper = torch.cat([calibration.matrix, link.to(calibration.matrix)], 1)
    lower = torch.cat([link.T.to(calibration.matrix), mounting.to(calibration.matrix)], 1)
    return checked_covariance("covariance of calibration and mounting", torch.cat([upper, lower]), size + 6)[
        :size, size:
    ]


def mounting_covariance(
    *, origin_m: Sequence[float] = (0.0, 0.0, 0.0), attitude_deg: Sequence[float] = (0.0, 0.0, 0.0)
) -> Tensor:
    """(6, 6) covariance of how a rig stands: east, north, up of its origin, and small turns about these axes.

    Args:
        origin_m: one sigma of the left camera's position, meters east, north, up.
        attitude_deg: one sigma of turns about the east, north and up axes, degrees; the last is the heading's.

    Example:
        >>> mounting_covariance(origin_m=(0.02, 0.02, 0.04), attitude_deg=(0, 0, 0.1)).diagonal()[:3].tolist()
        [0.0004, 0.0004, 0.0016]
    """
    values = torch.tensor([*origin_m, *attitude_deg], dtype=torch.float64)
    if values.shape != (6,) or not bool((torch.isfinite(values) & (values >= 0)).all()):
        raise InputError("mounting: three sigmas of the origin and three of the attitude are needed, none negative")
    return torch.diag(torch.cat([values[:3], torch.deg2rad(values[3:])]) ** 2)
