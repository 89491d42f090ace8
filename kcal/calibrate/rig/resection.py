"""Find a camera's pose from rays and known points alone, as a start for an adjustment."""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

from kcal.lens.pose import rotation_between

# Every pose from three points (or, where the position is known, from two directions) is tried, and the one that the
# other points agree with best is taken, so that wrong points do no harm while they are the minority.

# Most subsets that are tried.
_SAMPLES = 400
# Radians: all rays that are farther off than this count alike.
_GROSS = 5e-3
# Centers that are farther apart, in distances of the points, are other places.
_ELSEWHERE = 0.01


def poses_from_three(rays: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Poses (..., 4, 3, 3) and centers (..., 4, 3) of a camera that sees three points (..., 3, 3) along unit rays.

    NaN where a solution is not real. Source: Grunert (1841), as written down by Haralick, Lee, Ottenberg and Nölle
    (1994), Int. J. Computer Vision 13 (3), Eq. 9 and 8.
    """
    one, other = [1, 0, 0], [2, 2, 1]
    aa, bb, cc = (points[..., one, :] - points[..., other, :]).square().sum(-1).unbind(-1)
    alpha, beta, gamma = (rays[..., one, :] * rays[..., other, :]).sum(-1).unbind(-1)
    p, q, s, c = (aa - cc) / bb, (aa + cc) / bb, aa / bb, cc / bb
    squares = p**2 - 1 + 2 * p**2 * beta**2 + 2 * (1 - c) * alpha**2
    quartic = torch.stack(
        [
            (p - 1) ** 2 - 4 * c * alpha**2,
            4 * (p * (1 - p) * beta - (1 - q) * alpha * gamma + 2 * c * alpha**2 * beta),
            2 * (squares - 4 * q * alpha * beta * gamma + 2 * (1 - s) * gamma**2),
            4 * (-p * (1 + p) * beta + 2 * s * gamma**2 * beta - (1 - q) * alpha * gamma),
            (1 + p) ** 2 - 4 * s * gamma**2,
        ],
        -1,
    )
    v = _real_roots(quartic)
    p, alpha, beta, gamma = (value[..., None] for value in (p, alpha, beta, gamma))
    u = ((p - 1) * v**2 - 2 * p * beta * v + 1 + p) / (2 * (gamma - v * alpha))
    first = torch.sqrt(bb[..., None] / (1 + v**2 - 2 * v * beta))
    lengths = first[..., None] * torch.stack([torch.ones_like(u), u, v], -1)
    good = torch.isfinite(lengths).all(-1) & (lengths > 0).all(-1)
    safe = torch.where(good[..., None], lengths, 1.0)
    in_camera = safe[..., None] * rays[..., None, :, :]
    middle, known = in_camera.mean(-2, keepdim=True), points.mean(-2, keepdim=True)
    rotation = rotation_between((points - known)[..., None, :, :], in_camera - middle)
    center = known - (rotation.transpose(-1, -2) @ middle.transpose(-1, -2))[..., 0]
    return torch.where(good[..., None, None], rotation, torch.nan), torch.where(good[..., None], center, torch.nan)


def _real_roots(coefficients: Tensor) -> Tensor:
    """Real roots (..., 4) of quartics with coefficients (..., 5), highest first; NaN where not real."""
    companion = torch.zeros(*coefficients.shape[:-1], 4, 4, dtype=coefficients.dtype)
    lead = torch.where(coefficients[..., :1] == 0, 1e-300, coefficients[..., :1])
    companion[..., 0, :] = (-coefficients[..., 1:] / lead).nan_to_num(0.0, 0.0, 0.0)
    companion[..., 1:, :3] = torch.eye(3, dtype=coefficients.dtype)
    roots = torch.linalg.eigvals(companion)
    # Noise parts a double root into two that are nearly real: their common real part is a start.
    near = roots.imag.abs() <= 0.05 * roots.abs()
    return torch.where(near, roots.real, torch.nan)


def _samples(count: int, size: int) -> Tensor:
    """(K, size) indices: all subsets, or some hundreds drawn with a fixed seed."""
    if math.comb(count, size) <= _SAMPLES:
        return torch.tensor(list(itertools.combinations(range(count), size)))
    generator = torch.Generator().manual_seed(count)
    return torch.stack([torch.randperm(count, generator=generator)[:size] for _ in range(_SAMPLES)])


def _score(rays: Tensor, rotation: Tensor, directions: Tensor) -> Tensor:
    """(...) sum of squared angles between rays (M, 3) and R directions (..., M, 3), each cut at the gross one."""
    unit = directions / torch.linalg.vector_norm(directions, dim=-1, keepdim=True)
    squared = (unit @ rotation.transpose(-1, -2) - rays).square().sum(-1)
    return squared.clamp_max(_GROSS**2).sum(-1).nan_to_num(math.inf)


def consensus_rotation(rays: Tensor, directions: Tensor) -> tuple[Tensor, float]:
    """The rotation that most of the rays (M, 3) and directions (M, 3), M at least 2, agree on, and its score."""
    chosen = _samples(len(rays), 2)
    rotation = rotation_between(directions[chosen], rays[chosen])
    score = _score(rays, rotation, directions.expand(len(chosen), -1, -1))
    best = int(score.argmin())
    return rotation[best], float(score[best])


def consensus_pose(rays: Tensor, points: Tensor, near: Tensor | None = None) -> tuple[Tensor, Tensor, float] | None:
    """The pose that most of the rays (M, 3) to known points (M, 3) agree on.

    Args:
        rays: unit, in the camera's frame.
        points: meters.
        near: (3,) the camera's center, if it was measured; then two points do, otherwise three or better four.

    Returns:
        rotation (3, 3), center (3,) and the score, smaller being better; None if the points do not suffice.
    """
    found: list[tuple[Tensor, Tensor, float]] = []
    if near is not None and len(rays) >= 2:
        towards = points - near
        towards = towards / torch.linalg.vector_norm(towards, dim=-1, keepdim=True)
        rotation, score = consensus_rotation(rays, towards)
        found.append((rotation, near, score))
    if len(rays) >= 3:
        chosen = _samples(len(rays), 3)
        rotations, centers = (value.flatten(0, 1) for value in poses_from_three(rays[chosen], points[chosen]))
        scores = _score(rays, rotations, points - centers[:, None])
        best = int(scores.argmin())
        if math.isfinite(float(scores[best])):
            found.append((rotations[best], centers[best], float(scores[best])))
    return min(found, key=lambda pose: pose[2]) if found else None


def distinct_poses(
    rays: Tensor, points: Tensor, known: Tensor, most: int, awry: float = math.inf
) -> list[tuple[Tensor, Tensor]]:
    """Poses, other than at a known center (3,), that three of the rays (M, 3) to points (M, 3) allow; the best first.

    Args:
        rays: unit, in the camera's frame.
        points: meters.
        known: (3,) center of the pose that is not wanted.
        most: how many at most.
        awry: radians that the others may be off at most, all together.
    """
    chosen = _samples(len(rays), 3)
    rotations, centers = (value.flatten(0, 1) for value in poses_from_three(rays[chosen], points[chosen]))
    scores = _score(rays, rotations, points - centers[:, None])
    distance = float((points.mean(0) - known).norm())
    found: list[tuple[Tensor, Tensor]] = []
    for i in scores.argsort().tolist():
        others = torch.stack([known, *(center for _, center in found)])
        if not float(scores[i]) < awry**2 or math.isinf(float(scores[i])):
            break
        if float((others - centers[i]).norm(dim=-1).min()) > _ELSEWHERE * distance:
            found.append((rotations[i], centers[i]))
        if len(found) == most:
            break
    return found
