"""Triangulation of rays of two or more cameras: by the smallest turns, by Eq. 9; and what there is besides pixels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.dispatch import CHUNK, is_differentiated, is_traced, known_true
from kcal.errors import InputError
from kcal.lens.pose import side_axes
from kcal.texts import briefly

# Triangulation in closed form, without a decomposition: the point that needs the smallest turns of the rays.
#
# Two rays that do not meet are each turned into a common plane through both cameras, where they do. The plane that
# makes the sum of squared sines of the two angles smallest is an eigenvector of a 2x2 matrix, so that the whole is some
# fifty multiplications a point. More than two rays give three linear equations in the position, weighed so that angles
# and not meters are made small. Both work in a local frame and stay regular for points at infinity.
#
# Unlike the mid-point of the two lines, which a vertical error between the rays pulls nearer, neither is biased by what
# the rays miss each other across the epipolar plane.

# Sine of the angle between a ray and the baseline: below, both rays meet everywhere on the line through the cameras.
EPIPOLE = 1e-9
# Points farther than this many baselines are at infinity for float64.
HORIZON = 1e12
# Beyond this cosine (84°) the directions of the two rays around the baseline have no common plane worth the name.
_SAME_SIDE = 0.1


Method = Literal["linear", "angular"]


@briefly
class Found(NamedTuple):
    """Points (..., N, 3) and whether each is determined, finite and in front of every camera along its ray (..., N)."""

    points: Tensor
    valid: Tensor


def triangulate_pairs(rays_left: Tensor, rays_right: Tensor, right_from_left: tuple[Tensor, Tensor]) -> Found:
    """The point of each pair of rays with the smallest sum of squared sines of angular errors.

    Args:
        rays_left: (..., N, 3) in the left camera's frame, any length but zero.
        rays_right: (..., N, 3) in the right camera's frame, likewise.
        right_from_left: rotation (3, 3) and translation (3,), meters; the cameras must not stand in the same place.

    Returns:
        Points in the left camera's frame; zeros where not valid. Gradients are exact, and zero there.

    Source: Lee and Civera, "Closed-Form Optimal Two-View Triangulation Based on Angular Errors" (ICCV 2019), the L2
    cost; the plane's direction here is exact to third order in the angle by which the rays miss each other.

    Example:
        >>> left = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
        >>> right = torch.tensor([[-0.002, 0.0, 1.0]], dtype=torch.float64)
        >>> pose = torch.eye(3, dtype=torch.float64), torch.tensor([-10.0, 0.0, 0.0], dtype=torch.float64)
        >>> found = triangulate_pairs(left, right, pose)
        >>> round(found.points[0, 2].item(), 6), found.valid.tolist()
        (5000.0, [True])
    """
    rotation, translation = right_from_left
    baseline = -translation @ rotation
    length = torch.linalg.vector_norm(baseline)
    axes = baseline_axes(baseline)
    axes_right = rotation @ axes
    whole = is_traced() or is_differentiated(rays_left, rays_right, rotation, translation)
    if whole or rays_left.shape[-2] <= CHUNK:
        return meeting_points(rays_left @ axes, rays_right @ axes_right, axes, length)
    pieces = zip(rays_left.split(CHUNK, -2), rays_right.split(CHUNK, -2), strict=True)
    found = [meeting_points(left @ axes, right @ axes_right, axes, length) for left, right in pieces]
    points, valid = zip(*found, strict=True)
    return Found(torch.cat(points, -2), torch.cat(valid, -1))


def meeting_points(left: Tensor, right: Tensor, axes: Tensor, length: Tensor) -> Found:
    """As `triangulate_pairs`, of rays (..., N, 3) in axes along the baseline and across it.

    Args:
        left: of the left camera.
        right: of the right one.
        axes: (3, 3) columns: the axes in the frame of the result.
        length: of the baseline, meters.
    """
    x0, p0, q0 = left.unbind(-1)
    x1, p1, q1 = right.unbind(-1)
    squared0, squared1 = torch.addcmul(p0 * p0, q0, q0), torch.addcmul(p1 * p1, q1, q1)
    norm0, norm1 = torch.addcmul(squared0, x0, x0), torch.addcmul(squared1, x1, x1)
    with torch.no_grad():
        # Not so for rays of length zero, along the baseline, or not finite.
        usable = (squared0 > EPIPOLE**2 * norm0) & (squared1 > EPIPOLE**2 * norm1) & (norm0 + norm1 < torch.inf)
        every = known_true(usable)
    if not every:
        x0, p0, q0 = torch.where(usable, x0, 0.0), torch.where(usable, p0, 1.0), torch.where(usable, q0, 0.0)
        x1, p1, q1 = torch.where(usable, x1, 0.0), torch.where(usable, p1, 1.0), torch.where(usable, q1, 0.0)
        squared0, squared1 = torch.addcmul(p0 * p0, q0, q0), torch.addcmul(p1 * p1, q1, q1)
        norm0, norm1 = torch.addcmul(squared0, x0, x0), torch.addcmul(squared1, x1, x1)
    # Their directions around the baseline, each weighed by the square of the sine of its angle with it.
    w0, w1 = torch.sqrt(squared0) / norm0, torch.sqrt(squared1) / norm1
    p, q = torch.addcmul(w0 * p0, w1, p1), torch.addcmul(w0 * q0, w1, q1)
    norm = torch.addcmul(p * p, q, q)
    with torch.no_grad():
        sided = norm > (_SAME_SIDE * torch.addcmul(w0 * w0 * norm0, w1 * w1, norm1)) ** 2
    scale = torch.where(sided, norm, 1.0).rsqrt()
    p, q = p * scale, q * scale
    y0, y1 = torch.addcmul(p0 * p, q0, q), torch.addcmul(p1 * p, q1, q)
    # The sine of the parallax, times the rays' lengths.
    sine = torch.addcmul(x0 * y1, x1, y0, value=-1.0)
    with torch.no_grad():
        valid = usable & sided & (sine * HORIZON > torch.sqrt(norm0 * norm1))
    along = length * y1 / torch.where(valid, sine, torch.inf)
    across = along * y0
    return Found(torch.stack([along * x0, across * p, across * q], -1) @ axes.mT, valid)


def baseline_axes(baseline: Tensor) -> Tensor:
    """(3, 3) rotation whose first column is along a baseline."""
    axis = baseline / torch.linalg.vector_norm(baseline)
    other = torch.where(axis[1].abs() < 0.9, axis.new_tensor([0.0, 1.0, 0.0]), axis.new_tensor([1.0, 0.0, 0.0]))
    second = torch.linalg.cross(axis, other)
    second = second / torch.linalg.vector_norm(second)
    return torch.stack([axis, torch.linalg.cross(second, axis), second], -1)


def triangulate_angular(cam_from_world: Tensor, rays: Tensor, seen: Tensor | None = None) -> Found:
    """Points nearest in angle to the rays of two or more cameras, in closed form.

    Two cameras: `triangulate_pairs`. More: the rows `ray x (R X + t) = 0` of Eq. 9 are solved for the point's
    direction from the first camera and its inverse distance, which needs no decomposition and is well conditioned at
    any range; a second pass weighs each camera by its distance from the point, so that angles are made small.

    Args:
        cam_from_world: (..., C, 3, 4) matrices [R | t]; leading dimensions broadcast with those of `rays`.
        rays: (..., N, C, 3) directions in each camera's frame, any length but zero.
        seen: (..., N, C) bool: which cameras saw what, two at least; what is False is not read. All, if left out.

    Returns:
        Points in the world frame; the center of the first camera that saw it where not valid.

    Raises:
        InputError: wrong shapes or dtypes.

    Example:
        >>> cameras = torch.eye(3, 4, dtype=torch.float64).repeat(3, 1, 1)
        >>> cameras[1, 0, 3], cameras[2, 0, 3] = -10.0, -20.0
        >>> rays = torch.tensor([[[0.0, 0.0, 1.0], [-0.002, 0.0, 1.0], [-0.004, 0.0, 1.0]]], dtype=torch.float64)
        >>> [round(value, 6) for value in triangulate_angular(cameras, rays).points[0].abs().tolist()]
        [0.0, 0.0, 5000.0]
    """
    cam_from_world, rays, seen = checked_rays(cam_from_world, rays, seen)
    rotation, translation = cam_from_world[..., :3], cam_from_world[..., 3]
    if rays.shape[-2] == 2:
        seen = torch.ones_like(rays[..., 0], dtype=torch.bool) if seen is None else seen
        lead = torch.broadcast_shapes(rotation.shape[:-3], rays.shape[:-3], seen.shape[:-2])
        if rotation.ndim == 3:
            return _two_rays(rotation, translation, rays, seen)
        each = (rotation, 3), (translation, 2), (rays, 3), (seen, 2)
        found = torch.func.vmap(_two_rays)(*(
            value.expand(*lead, *value.shape[-own:]).flatten(0, -own - 1) for value, own in each
        ))  # fmt: skip
        return Found(*(value.reshape(*lead, *value.shape[1:]) for value in found))
    centers = -(rotation.mT @ translation[..., None])[..., 0]
    length = torch.linalg.vector_norm(rays, dim=-1, keepdim=True)
    usable = torch.isfinite(length) & (length > 0)
    units = torch.where(usable, rays, rays.new_tensor([0.0, 0.0, 1.0]))
    units = units / torch.linalg.vector_norm(units, dim=-1, keepdim=True)
    directions = torch.stack([units[..., c, :] @ rotation[..., c, :, :] for c in range(rays.shape[-2])], -2)
    if seen is None:
        ray, first, sound = directions[..., 0, :], centers[..., :1, :], usable.all(-2)[..., 0]
    else:
        one = first_seen(seen)[..., None]
        ray, first = (one * directions).sum(-2), (one * centers[..., None, :, :]).sum(-2)
        sound = (usable[..., 0] | ~seen).all(-1) & (seen.sum(-1) > 1)
        ray = torch.where(sound[..., None], ray, ray.new_tensor([0.0, 0.0, 1.0]))
    points, valid = _several_rays(ray, directions.unbind(-2), first[..., None, :] - centers[..., None, :, :], seen)
    valid = valid & sound
    return Found(first + torch.where(valid[..., None], points, 0.0), valid)


def _two_rays(rotation: Tensor, translation: Tensor, rays: Tensor, seen: Tensor) -> Found:
    """`triangulate_pairs` for two cameras, rotations (2, 3, 3) and translations (2, 3); not where one is blind."""
    turn = rotation[1] @ rotation[0].mT
    left, right = torch.where(seen.all(-1)[..., None, None], rays, 0.0).unbind(-2)
    found = triangulate_pairs(left, right, (turn, translation[1] - turn @ translation[0]))
    world = (found.points - translation[0]) @ rotation[0]
    one = (seen[..., 1] & ~seen[..., 0])[..., None]
    return Found(torch.where(one, -translation[1] @ rotation[1], world), found.valid)


def first_seen(seen: Tensor) -> Tensor:
    """(..., C) bool: true for the first camera alone of those that saw something.

    Example:
        >>> first_seen(torch.tensor([False, True, True])).tolist()
        [False, True, False]
    """
    return seen & (seen.to(torch.int64).cumsum(-1) == 1)


def checked_rays(cam_from_world: Tensor, rays: Tensor, seen: Tensor | None) -> tuple[Tensor, Tensor, Tensor | None]:
    """Matrices (..., C, 3, 4) and rays (..., N, C, 3) as float64, and who saw what (..., N, C); shapes are checked."""
    cam_from_world = as_points("cam_from_world", cam_from_world, 4)
    rays = as_points("rays", rays, 3)
    if cam_from_world.ndim < 3 or cam_from_world.shape[-2] != 3 or cam_from_world.shape[-3] < 2:
        raise InputError(f"cam_from_world: shape (..., C >= 2, 3, 4) is needed, got {tuple(cam_from_world.shape)}")
    if rays.ndim < 3 or rays.shape[-2] != cam_from_world.shape[-3]:
        raise InputError(
            f"rays: shape (..., N, {cam_from_world.shape[-3]}, 3) is needed to fit the cameras, got {tuple(rays.shape)}"
        )
    if seen is not None:
        seen = torch.as_tensor(seen, device=rays.device)
        if seen.dtype != torch.bool or seen.ndim < 2 or seen.shape[-1] != rays.shape[-2]:
            raise InputError(
                f"seen: bool of shape (..., N, {rays.shape[-2]}) is needed, got {seen.dtype} of {tuple(seen.shape)}"
            )
    return cam_from_world, rays, seen


def _several_rays(ray: Tensor, world: Sequence[Tensor], shifts: Tensor, seen: Tensor | None) -> tuple[Tensor, Tensor]:
    """Points from the camera with the ray `ray`; `shifts` (..., 1 or N, C, 3) lead from each center to its own."""
    spread = torch.linalg.vector_norm(shifts, dim=-1).amax(-1)
    spread = torch.where(spread > 0, spread, 1.0)
    shifts = shifts / spread[..., None, None]
    e1, e2 = side_axes(ray)
    counts = [None] * len(world) if seen is None else [one.to(ray.dtype) for one in seen.unbind(-1)]
    weights: list[Tensor | None] = list(counts)
    for _ in range(2):
        rows = [_across_ray(w, (e1, e2, shifts[..., c, :], -ray), weights[c]) for c, w in enumerate(world)]
        p, q, u, r, v, s, f, g, h = (torch.stack(terms).sum(0) for terms in zip(*rows, strict=True))
        # The upper 2x2 block is never worse than the identity, from the first camera; of what nobody saw it is zero.
        area = p * r - q * q
        scale = torch.where(area > 0, area, 1.0).reciprocal()
        first, second = (r * u - q * v) * scale, (p * v - q * u) * scale
        left = s - first * u - second * v
        determined = left > EPIPOLE**2
        inverse = (h - first * f - second * g) / torch.where(determined, left, 1.0)
        a = (r * f - q * g) * scale - first * inverse
        b = (p * g - q * f) * scale - second * inverse
        direction = ray + a[..., None] * e1 + b[..., None] * e2
        places = [direction + inverse[..., None] * shifts[..., c, :] for c in range(len(world))]
        nearness = [(point * point).sum(-1).clamp_min(EPIPOLE**2).reciprocal() for point in places]
        weights = [near if own is None else near * own for near, own in zip(nearness, counts, strict=True)]
    ahead = torch.stack([(point * w).sum(-1) > 0 for point, w in zip(places, world, strict=True)], -1)
    ahead = (ahead if seen is None else ahead | ~seen).all(-1)
    valid = determined & (inverse * HORIZON > 1.0) & ahead
    return spread[..., None] * direction / torch.where(valid, inverse, torch.inf)[..., None], valid


def _across_ray(w: Tensor, columns: tuple[Tensor, Tensor, Tensor, Tensor], weight: Tensor | None) -> list[Tensor]:
    """(x · y) - (w · x)(w · y) of the columns across the ray w: six of the matrix, three of the right side."""
    on = [(w * column).sum(-1) for column in columns]
    found = []
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2), (0, 3), (1, 3), (2, 3)):
        product = (columns[i] * columns[j]).sum(-1) - on[i] * on[j]
        found.append(product if weight is None else product * weight)
    return found


# Linear triangulation (Eq. 9) from rays of two or more cameras, batched, with exact first and second derivatives.

# Below this gap of the squared singular values (the rays have unit length, the cameras a spread of one) the answer
# is not determined: all rays lie along the line through the camera centers.
_LEAST_GAP = 1e-18


def triangulate_linear(cam_from_world: Tensor, rays: Tensor, seen: Tensor | None = None) -> Found:
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
    cam_from_world, rays, seen = checked_rays(cam_from_world, rays, seen)
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
    units = torch.where(usable & counts[..., None], rays, ahead)
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
    return Found(middle + spread[..., None, :] * torch.where(valid, local_points, 0.0), valid[..., 0])


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


def triangulate(
    cam_from_world: Tensor, rays: Tensor, seen: Tensor | None = None, *, method: Method = "angular"
) -> Found:
    """Points nearest to the rays of two or more cameras, in closed form: by the smallest turns, or linear (Eq. 9).

    Args:
        cam_from_world: (..., C, 3, 4) matrices [R | t] with R a rotation; leading dimensions broadcast with those of
            `rays`. C is at least 2.
        rays: (..., N, C, 3) directions in each camera's frame, any length but zero.
        seen: (..., N, C) bool: which cameras saw what, two at least; what is False is not read. All, if left out.
        method: "angular" or "linear": see `triangulate_angular` and `triangulate_linear`. What is most likely depends
            on the noise of pixels, not of rays: see `kcal.Localizer`.

    Raises:
        InputError: wrong shapes or dtypes, another method.

    Example:
        >>> cameras = torch.eye(3, 4, dtype=torch.float64).repeat(3, 1, 1)
        >>> cameras[1, 0, 3], cameras[2, 0, 3] = -10.0, -20.0
        >>> rays = torch.tensor([[[0.0, 0.0, 1.0], [-0.002, 0.0, 1.0], [-0.004, 0.0, 1.0]]], dtype=torch.float64)
        >>> [round(value, 6) for value in triangulate(cameras, rays).points[0].abs().tolist()]
        [0.0, 0.0, 5000.0]
    """
    solvers = {"angular": triangulate_angular, "linear": triangulate_linear}
    if method not in solvers:
        raise InputError(f"method {method!r}: of rays, angular or linear is needed")
    return solvers[method](cam_from_world, rays, seen)


# What there is besides pixels when a point is sought: who saw it, how light bends, which height it has.

# Meters: light from beyond is bent as if it came from there; nothing on the Earth is seen so far.
LIGHT_HORIZON = 5e5


class Surroundings(NamedTuple):
    """What there may be besides pixels.

    Attributes:
        present: (..., C, N) bool: which camera saw what; all of them if None.
        up: (C, 3) the vertical at each camera, in its axes; straight lines of sight if None.
        bending: 1/m: light from the horizontal distance d comes from bending * d² too high: k / 2R.
        held: (..., 3, N) row of (a, b, ρ) that stays as it is at the start, over its sigma: a stated height.
        held_off: (..., N) by how much it is too high, over its sigma: zeros, with derivatives.
    """

    present: Tensor | None = None
    up: Tensor | None = None
    bending: Tensor | float = 0.0
    held: Tensor | None = None
    held_off: Tensor | float = 0.0


def length_of_one(scale: Tensor, inverse: Tensor) -> Tensor:
    """Meters of one in the units of ρ-scaled points, at most as far as anything on the Earth is seen."""
    return scale / torch.maximum(inverse.abs(), scale / LIGHT_HORIZON)


def lifted(seen: Tensor, around: Surroundings, unit: Tensor | float) -> Tensor:
    """By how much (..., C, 3, N) points are seen higher than `seen` in each camera's axes; one of it is `unit` m."""
    assert around.up is not None
    up = around.up[..., None]
    along = (seen * up).sum(-2, keepdim=True)
    level = seen.square().sum(-2, keepdim=True) - along * along
    return around.bending * unit * level * up
