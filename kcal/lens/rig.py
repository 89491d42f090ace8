"""`StereoRig`: two cameras and where one stands from the other."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from kcal.checks import as_points, keep_float64, require_finite
from kcal.errors import InputError
from kcal.lens.camera import Camera


class StereoRig(nn.Module):
    """Two cameras, rigidly joined.

    Convention: the rig frame is the left camera's frame, and `points_right = rotation @ points_left + translation`
    (meters). "Left" is only the first camera's name.

    Args:
        left: the first camera.
        right: the second camera.
        right_from_left_rotation: (3, 3) rotation matrix.
        right_from_left_translation: (3,) meters.

    Raises:
        InputError: wrong shapes, values that are not finite, or a matrix that is no rotation.

    Example:
        >>> camera = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080))
        >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        >>> float(rig.baseline)
        10.0
    """

    right_from_left_rotation: Tensor
    right_from_left_translation: Tensor

    def __init__(
        self, left: Camera, right: Camera, right_from_left_rotation: Tensor, right_from_left_translation: Tensor
    ) -> None:
        super().__init__()
        rotation = as_points("right_from_left_rotation", right_from_left_rotation, 3)
        translation = as_points("right_from_left_translation", right_from_left_translation, 3)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise InputError(
                f"rig pose: shapes (3, 3) and (3,) are needed, got {tuple(rotation.shape)} and "
                f"{tuple(translation.shape)}"
            )
        require_finite("rig rotation", rotation)
        require_finite("rig translation", translation)
        identity = torch.eye(3, dtype=torch.float64, device=rotation.device)
        if not torch.allclose(rotation @ rotation.T, identity, atol=1e-6) or torch.linalg.det(rotation) < 0:
            raise InputError("rig rotation: not a rotation matrix (R Rᵀ must be 1 and det R = +1)")
        self.left = left
        self.right = right
        self.register_buffer("right_from_left_rotation", rotation.detach().clone())
        self.register_buffer("right_from_left_translation", translation.detach().clone())

    @property
    def baseline(self) -> Tensor:
        """Distance between the cameras' centers, meters."""
        return torch.linalg.vector_norm(self.right_from_left_translation)

    def right_from_left(self, points_left: Tensor) -> Tensor:
        """Move points (..., N, 3) from the left camera's frame into the right camera's."""
        points = as_points("points_left", points_left, 3)
        return points @ self.right_from_left_rotation.T + self.right_from_left_translation

    def forward(self, points_left: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Project points (..., N, 3) of the rig frame: pixels_left, pixels_right (..., N, 2), valid in both."""
        pixels_left, valid_left = self.left.project(points_left)
        pixels_right, valid_right = self.right.project(self.right_from_left(points_left))
        return pixels_left, pixels_right, valid_left & valid_right

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:
        return super()._apply(keep_float64(fn), recurse)
