"""Match keypoints of two images along epipolar lines, both ways."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcal.corners.keypoints import Keypoints, pose_between
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import side_axes
from kcal.lens.rig import StereoRig

# The second best descriptor must be so much farther away, without any geometry and along an epipolar line.
_FREE_RATIO, _GUIDED_RATIO = 0.75, 0.9
# Pixels that a keypoint may be off its epipolar line, before the pose is refined and while it is guessed.
BAND, _FIRST_BAND = 3.0, 2.0
# Baselines of the nearest things that are matched.
_NEAREST = 3.0
# Matches without which a guessed pose is chance.
_FEWEST = 20
_AT_ONCE = 1024
_NO_SECOND = 2.0


def rough_rig(cameras: tuple[Camera, Camera], points: tuple[Keypoints, Keypoints], name: str) -> StereoRig:
    """How the right camera roughly stands, with a baseline of one, from keypoints alone.

    Raises:
        InputError: the images have too little in common.
    """
    everything = torch.ones(len(points[0].pixels), dtype=torch.bool)
    pairs = _both_ways(points, [everything], [torch.ones(len(points[1].pixels), dtype=torch.bool)], None, _FREE_RATIO)
    sides = zip(cameras, points, strict=True)
    rays = [camera.unproject(own.pixels[pairs[:, k]]) for k, (camera, own) in enumerate(sides)]
    good = rays[0][1] & rays[1][1] & (rays[0][0][:, 2] > 0.1) & (rays[1][0][:, 2] > 0.1)
    first, second = rays[0][0][good], rays[1][0][good]
    count = 0
    if len(first) >= _FEWEST:
        tolerance = _FIRST_BAND / float(cameras[0].focal[0].detach())
        rotation, shift, inside = pose_between(first, second, tolerance)
        count = int(inside.sum())
    if count < _FEWEST:
        raise InputError(
            f"{name}: both images have only {count} features in common; {_FEWEST} are needed. Are they of the same "
            "scene and moment, and is left left?"
        )
    return StereoRig(cameras[0], cameras[1], rotation, shift)


class _Epipolar:
    """Keypoints by the angle of their epipolar planes about the baseline, and the angle from the baseline's direction.

    Attributes:
        turn: (N,) radians about the baseline.
        along: (N,) radians from the baseline's direction, from the left to the right camera.
        valid: (N,) whether there is a ray.
    """

    def __init__(self, rig: StereoRig, side: int, pixels: Tensor) -> None:
        rotation, shift = rig.right_from_left_rotation, rig.right_from_left_translation
        axis = -(rotation.T @ shift)
        axis = axis / torch.linalg.vector_norm(axis)
        rays, self.valid = (rig.right if side else rig.left).unproject(pixels)
        if side:
            rays = rays @ rotation
        ahead = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        ahead = ahead - (ahead @ axis) * axis
        if float(ahead.norm()) < 1e-3:
            ahead = side_axes(axis[None])[0][0]
        ahead = ahead / torch.linalg.vector_norm(ahead)
        self.turn = torch.atan2(rays @ torch.linalg.cross(ahead, axis), rays @ ahead)
        self.along = torch.acos((rays @ axis).clamp(-1.0, 1.0))


def guided_matches(rig: StereoRig, points: tuple[Keypoints, Keypoints]) -> Tensor:
    """(M, 2) indices of keypoints that are each other's best along the epipolar line, at a positive distance."""
    sides = [_Epipolar(rig, side, own.pixels) for side, own in enumerate(points)]
    band = BAND / float(rig.left.focal[0].detach())
    return _both_ways(points, [sides[0].turn, sides[0].along, sides[0].valid],
                      [sides[1].turn, sides[1].along, sides[1].valid], band, _GUIDED_RATIO)  # fmt: skip


def _both_ways(
    points: tuple[Keypoints, Keypoints], left: list[Tensor], right: list[Tensor], band: float | None, ratio: float
) -> Tensor:
    """(M, 2) mutual best matches that are clearly better than the second best.

    Args:
        points: keypoints of both images.
        left: turn, along and valid of the left ones (see `_Epipolar`); anything without a band.
        right: of the right ones.
        band: radians that turns may differ by; None: every keypoint is compared with every other.
        ratio: the second best must be farther than the best over this.
    """
    first, second = (own.descriptors for own in points)
    orders = [torch.arange(len(own)) if band is None else side[0].argsort() for own, side in
              zip((first, second), (left, right), strict=True)]  # fmt: skip
    best = [torch.full((len(own),), -1, dtype=torch.long) for own in (first, second)]
    column_score = torch.full((len(second),), -math.inf)
    clear = torch.zeros(len(first), dtype=torch.bool)
    if not len(first) or not len(second):
        return torch.zeros(0, 2, dtype=torch.long)
    turns = None if band is None else right[0][orders[1]].contiguous()
    for rows in orders[0].split(_AT_ONCE):
        columns = orders[1]
        if band is not None and turns is not None:
            ends = torch.stack([left[0][rows[0]] - band, left[0][rows[-1]] + band])
            low, high = torch.searchsorted(turns, ends).tolist()
            columns = orders[1][low:high]
        if not len(columns):
            continue
        score = first[rows] @ second[columns].T
        if band is not None:
            apart = (left[0][rows, None] - right[0][columns]).abs()
            parallax = right[1][columns] - left[1][rows, None]
            near = (apart < band) & (parallax > -band) & (parallax < 1.0 / _NEAREST)
            score = torch.where(near & left[2][rows, None] & right[2][columns], score, -1.0)
        top = score.topk(min(2, score.shape[1]), dim=1)
        distance = (2.0 - 2.0 * top.values).clamp_min(0.0).sqrt()
        other = distance[:, 1] if distance.shape[1] > 1 else torch.full_like(distance[:, 0], _NO_SECOND)
        best[0][rows] = columns[top.indices[:, 0]]
        clear[rows] = (top.values[:, 0] > -0.5) & (distance[:, 0] < ratio * other)
        values, at = score.max(0)
        better = values > column_score[columns]
        column_score[columns[better]] = values[better]
        best[1][columns[better]] = rows[at[better]]
    index = (clear & (best[0] >= 0)).nonzero()[:, 0]
    mutual = best[1][best[0][index]] == index
    return torch.stack([index, best[0][index]], 1)[mutual]
