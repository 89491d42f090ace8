"""Linear triangulation (Eq. 9) from rays of two or more cameras, batched, with exact first and second derivatives."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.locate.angular import HORIZON, checked_views

# Below this gap of the squared singular values (the rays have unit length, the cameras a spread of one) the answer
# is not determined: all rays lie along the line through the camera centers.
_LEAST_GAP = 1e-18


def triangulate_linear(cam_from_world: Tensor, rays: Tensor, seen: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """The point nearest to all rays in the sense of Eq. 9: the right singular vector of the smallest singular value.

    For each camera the three rows of `ray x (R X + t) = 0` are stacked. Eq. 9 has the first two of them in pixels;
    with unit rays all pixels of a wide lens weigh alike, and the third row keeps rays far off axis well determined.
    Before the decomposition the world is moved to the middle of the camera centers and scaled by their spread, so
    that a far origin (ECEF) or an unlike unit costs no digits.

    Derivatives do not come from the decomposition's own backward pass, which divides by differences of *all*
    singular values: two chord steps on the eigenvalue equation need only the gap above the smallest. Two steps from
    an exact root make first and second derivatives exact.

    Args:
        cam_from_world: (..., C, 3, 4) matrices [R | t] with R a rotation; leading dimensions broadcast with those of
            `rays`. C is at least 2.
        rays: (..., N, C, 3) directions in each camera's frame, any length but zero.
        seen: (..., N, C) bool: which cameras saw what, two at least; what is False is not read. All, if left out.

    Returns:
        points (..., N, 3) in the world frame, float64, and valid (..., N): true where the point is finite, determined
        and in front of every camera along its ray. Points that are not valid are the middle of the camera centers.

    Raises:
        InputError: wrong shapes or dtypes.

    Source: the paper, Eq. 8 and 9 (the DLT of Hartley and Zisserman, section 12.2).

    Example:
        >>> left = torch.eye(3, 4, dtype=torch.float64)
        >>> right = left.clone()
        >>> right[0, 3] = -10.0
        >>> rays = torch.tensor([[[0.0, 0.0, 1.0], [-0.002, 0.0, 1.0]]], dtype=torch.float64)
        >>> points, valid = triangulate_linear(torch.stack([left, right]), rays)
        >>> round(points[0, 2].item(), 6), valid.tolist()
        (5000.0, [True])
    """
    cam_from_world, rays = checked_views(cam_from_world, rays)
    rotation, translation = cam_from_world[..., :3], cam_from_world[..., 3]
    centers = -(rotation.mT @ translation[..., None])[..., 0]
    middle = centers.mean(-2, keepdim=True)
    spread = torch.linalg.vector_norm(centers - middle, dim=-1).amax(-1, keepdim=True)
    spread = 2.0 * torch.where(spread > 0, spread, 1.0)
    local = (rotation @ (middle - centers)[..., None]) / spread[..., None, None]

    counts = torch.ones_like(rays[..., 0], dtype=torch.bool) if seen is None else seen
    length = torch.linalg.vector_norm(rays, dim=-1, keepdim=True)
    usable = ((torch.isfinite(length) & (length > 0))[..., 0] | ~counts).all(-1) & (counts.sum(-1) > 1)
    usable = usable[..., None, None]
    ahead = rays.new_tensor([0.0, 0.0, 1.0])
    units = torch.where(usable, rays, ahead)
    units = units / torch.linalg.vector_norm(units, dim=-1, keepdim=True)
    if seen is not None:
        units = torch.where(seen[..., None], units, 0.0)

    cameras = torch.cat([rotation, local], -1)[..., None, :, :, :]
    # (..., N, C, 3, 4): the ray crossed with each column of [R | t].
    system = torch.linalg.cross(*torch.broadcast_tensors(units[..., None], cameras), dim=-2).flatten(-3, -2)
    solution, determined = _null_vector(system)
    weight = solution[..., 3:]
    nearer = weight.abs() * HORIZON > torch.linalg.vector_norm(solution[..., :3], dim=-1, keepdim=True)
    finite = nearer & determined[..., None]
    local_points = torch.where(finite, solution[..., :3], 0.0) / torch.where(finite, weight, 1.0)

    in_cameras = (cameras[..., :3] @ local_points[..., None, :, None] + cameras[..., 3:])[..., 0]
    ahead_of_all = (((in_cameras * units).sum(-1) > 0) | ~counts).all(-1, keepdim=True)
    valid = finite & ahead_of_all & usable[..., 0, :]
    points = middle + spread[..., None, :] * torch.where(valid, local_points, 0.0)
    return points, valid[..., 0]


def _null_vector(system: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vector h minimizing |system h|, and whether it is unique; differentiable twice.

    G(h) = (M - λ(h)) h with M = systemᵀ system and λ the Rayleigh quotient vanishes at the answer. In the basis of
    the other singular vectors its Jacobian is diag(λ_i - λ), held fixed at the known root (a chord step).
    """
    with torch.no_grad():
        _, singular, basis = torch.linalg.svd(system, full_matrices=False)
        squared = singular * singular
        gap = squared[..., :3] - squared[..., 3:]
        determined = gap[..., 2] > _LEAST_GAP
        inverse_gap = torch.where(determined[..., None], 1.0 / torch.where(gap > _LEAST_GAP, gap, 1.0), 0.0)
        others, h = basis[..., :3, :].mT, basis[..., 3, :, None]
    for _ in range(2):
        residual = system @ h
        value = (residual * residual).sum((-2, -1), keepdim=True) / (h * h).sum((-2, -1), keepdim=True)
        # (system others)ᵀ residual, not othersᵀ (M h): a product of small numbers keeps its digits.
        gradient = (system @ others).mT @ residual - value * (others.mT @ h)
        h = h - others @ (inverse_gap[..., None] * gradient)
    return h[..., 0], determined
