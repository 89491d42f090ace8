"""Convert and move rigid motions, given by a rotation matrix and a translation.

A step is six numbers: a rotation vector ω (radians) and a translation v (meters), R ← exp([ω]×) R, t ← t + v.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.checks import as_tensor
from kcal.errors import InputError


def rotation_from_vector(vector: Tensor) -> Tensor:
    """Convert rotation vectors (..., 3) in radians to matrices (..., 3, 3), differentiable also at zero.

    Example:
        >>> rotation_from_vector(torch.zeros(3)).diagonal().tolist()
        [1.0, 1.0, 1.0]
    """
    vector = as_tensor("vector", vector)
    if vector.shape[-1:] != (3,):
        raise InputError(f"vector: shape (..., 3) is needed, got {tuple(vector.shape)}")
    # Here and below: kornia takes long to load.
    from kornia.geometry.conversions import axis_angle_to_rotation_matrix

    flat: Tensor = axis_angle_to_rotation_matrix(vector.reshape(-1, 3))
    return flat.reshape(*vector.shape, 3)


def vector_from_rotation(rotation: Tensor) -> Tensor:
    """Convert rotation matrices (..., 3, 3) to rotation vectors (..., 3) of length at most π.

    Example:
        >>> vector_from_rotation(torch.eye(3)).tolist()
        [0.0, 0.0, 0.0]
    """
    rotation = as_tensor("rotation", rotation)
    if rotation.shape[-2:] != (3, 3):
        raise InputError(f"rotation: shape (..., 3, 3) is needed, got {tuple(rotation.shape)}")
    from kornia.geometry.conversions import rotation_matrix_to_axis_angle

    flat: Tensor = rotation_matrix_to_axis_angle(rotation.reshape(-1, 3, 3))
    return flat.reshape(*rotation.shape[:-2], 3)


def nearest_rotation(matrix: Tensor) -> Tensor:
    """Return the rotations closest to matrices (..., 3, 3) in the Frobenius norm (orthogonal Procrustes).

    Example:
        >>> nearest_rotation(2 * torch.eye(3)).diagonal().tolist()
        [1.0, 1.0, 1.0]
    """
    u, _, vh = torch.linalg.svd(matrix)
    sign = torch.linalg.det(u @ vh)
    u = torch.cat([u[..., :2], u[..., 2:] * sign[..., None, None]], -1)
    return u @ vh


def step_rows(by_point: Tensor, rotated: Tensor) -> Tensor:
    """Derivatives by the six numbers of a step, from derivatives by the moved point.

    Args:
        by_point: (..., 3, 2, N) derivatives of N pixels by their points in the moved frame.
        rotated: (..., 3, N) points after the rotation and before the translation.

    Returns:
        (..., 6, 2, N): by ω (through ω × point), then by v.
    """
    x, y, z = (rotated[..., i, None, :] for i in range(3))
    by_x, by_y, by_z = by_point.unbind(-3)
    turned = torch.stack([by_z * y - by_y * z, by_x * z - by_z * x, by_y * x - by_x * y], -3)
    return torch.cat([turned, by_point], -3)


def side_axes(rays: Tensor) -> tuple[Tensor, Tensor]:
    """Two directions that form an orthonormal frame with unit rays (..., N, 3); smooth except where z changes sign.

    Source: Duff et al., "Building an Orthonormal Basis, Revisited" (JCGT 2017).
    """
    x, y, z = rays.unbind(-1)
    sign = torch.where(z >= 0, 1.0, -1.0).to(z.dtype)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = torch.stack([1.0 + sign * x * x * a, sign * b, -sign * x], -1)
    return first, torch.stack([b, sign + y * y * a, -y], -1)
