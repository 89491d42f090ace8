"""Two ray-traced cameras, rigidly joined."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kcal.lens.pose import rotation_from_vector
from kcal.sim.captures import drawn_lens
from kcal.sim.truth import TruthLens


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueRig:
    """Two ray-traced cameras; the convention is `StereoRig`'s.

    Args:
        left: the first camera, whose frame is the rig's.
        right: the second camera.
        right_from_left_rotation: (3, 3).
        right_from_left_translation: (3,) meters.
    """

    left: TruthLens
    right: TruthLens
    right_from_left_rotation: Tensor
    right_from_left_translation: Tensor

    @property
    def baseline(self) -> Tensor:
        """Distance between the cameras' origins, meters."""
        return torch.linalg.vector_norm(self.right_from_left_translation)

    def right_from_left(self, points_left: Tensor) -> Tensor:
        """Move points (..., N, 3) from the left camera's frame into the right camera's."""
        return points_left @ self.right_from_left_rotation.T + self.right_from_left_translation

    def __call__(self, points_left: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Project points (..., N, 3) of the left frame: pixels_left, pixels_right (..., N, 2), valid in both."""
        pixels_left, valid_left = self.left.project(points_left)
        pixels_right, valid_right = self.right.project(self.right_from_left(points_left))
        return pixels_left, pixels_right, valid_left & valid_right


def drawn_rig(
    lens: str, strength: float, seed: int, *, focal_mm: float = 2.8, wander: float = 0.1, scale: float = 1.0
) -> TrueRig:
    """Draw two cameras 10 m apart whose lenses have one design and separate errors of assembly.

    The right camera is toed in by 0.34 degrees, and turned by 0.17 degrees in pitch and 0.46 in roll.

    Args:
        lens: name of a prescription.
        strength: of the misalignment, see `kcal.sim.captures.drawn_lens`.
        seed: of both draws.
        focal_mm: see `TruthLens`.
        wander: see `TruthLens`.
        scale: of the image, see `kcal.sim.captures.drawn_lens`.

    Example:
        >>> rig = drawn_rig("surveillance", 1.0, 3)
        >>> round(float(rig.baseline), 3), rig.left.size
        (10.0, (1920, 1080))
    """
    rotation = rotation_from_vector(torch.tensor([0.003, 0.006, -0.008], dtype=torch.float64))
    center = torch.tensor([10.0, 0.04, -0.06], dtype=torch.float64)
    left, right = (
        drawn_lens(lens, strength, 2 * seed + side, focal_mm=focal_mm, wander=wander, scale=scale) for side in (0, 1)
    )
    return TrueRig(
        left=left,
        right=right,
        right_from_left_rotation=rotation,
        right_from_left_translation=-rotation @ center,
    )
