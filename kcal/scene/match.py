"""Match what both cameras of a rig see in pairs of images, for `kcal.calibrate.rig`."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.rig.adjustment import LOSS, ROUGHLY, Adjustment, possible
from kcal.calibrate.rig.marks import Features
from kcal.calibrate.rig.source import Start
from kcal.calibrate.rig.sources import Baseline, RigData
from kcal.calibrate.rig.unknowns import held
from kcal.corners.images import Gray
from kcal.corners.match import Keypoints, keypoints, pose_between
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import side_axes
from kcal.lens.rig import Rig
from kcal.scene.common_errors import line_errors, pose_variance_ratio, smooth_effects, with_common_errors
from kcal.scene.refine import Stillness, refine_matches, still_there
from kcal.texts import briefly

# Match keypoints of two images along epipolar lines, both ways.

# The second best descriptor must be so much farther away, without any geometry and along an epipolar line.
_FREE_RATIO, _GUIDED_RATIO = 0.75, 0.9
# Pixels that a keypoint may be off its epipolar line, before the pose is refined and while it is guessed.
BAND, _FIRST_BAND = 3.0, 2.0
# Baselines of the nearest points that are matched.
_NEAREST = 3.0
# Matches without which a guessed pose is chance.
_NEEDED = 20
_AT_ONCE = 1024
_NO_SECOND = 2.0


def rough_rig(cameras: tuple[Camera, Camera], points: tuple[Keypoints, Keypoints], name: str) -> Rig:
    """How the right camera roughly stands, with a baseline of one, from keypoints alone.

    Raises:
        InputError: the images have too little in common.
    """
    pairs = _both_ways(points, None, _FREE_RATIO)
    sides = zip(cameras, points, strict=True)
    rays = [camera.unproject(own.pixels[pairs[:, k]]) for k, (camera, own) in enumerate(sides)]
    good = rays[0][1] & rays[1][1] & (rays[0][0][:, 2] > 0.1) & (rays[1][0][:, 2] > 0.1)
    first, second = rays[0][0][good], rays[1][0][good]
    count = 0
    if len(first) >= _NEEDED:
        rotation, shift, inside = pose_between(first, second, _FIRST_BAND / float(cameras[0].focal[0].detach()))
        count = int(inside.sum())
    if count < _NEEDED:
        raise InputError(
            f"{name}: both images have only {count} features in common; {_NEEDED} are needed. Are they of the same "
            "scene and time, and is left left?"
        )
    return Rig.pair(cameras[0], cameras[1], rotation, shift)


class _Epipolar:
    """Keypoints by the angle of their epipolar planes about the baseline, and the angle from the baseline's direction.

    Attributes:
        turn: (N,) radians about the baseline.
        along: (N,) radians from the baseline's direction, from the left to the right camera.
        valid: (N,) whether there is a ray.
    """

    def __init__(self, rig: Rig, side: int, pixels: Tensor) -> None:
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


def guided_matches(rig: Rig, points: tuple[Keypoints, Keypoints]) -> Tensor:
    """(M, 2) indices of keypoints that are each other's best along the epipolar line, at a positive distance."""
    left, right = (_Epipolar(rig, side, own.pixels) for side, own in enumerate(points))
    return _both_ways(points, (left, right, BAND / float(rig.left.focal[0].detach())), _GUIDED_RATIO)


def _both_ways(
    points: tuple[Keypoints, Keypoints], near: tuple[_Epipolar, _Epipolar, float] | None, ratio: float
) -> Tensor:
    """(M, 2) mutual best matches that are clearly better than the second best.

    Args:
        points: keypoints of both images.
        near: the left and the right ones, and radians that turns may differ by; None: every keypoint is compared with
            every other.
        ratio: the second best must be farther than the best over this.
    """
    first, second = (own.descriptors for own in points)
    orders = [side.turn.argsort() for side in near[:2]] if near else [torch.arange(len(own)) for own in (first, second)]
    best = [torch.full((len(own),), -1, dtype=torch.long) for own in (first, second)]
    column_score = torch.full((len(second),), -math.inf)
    clear = torch.zeros(len(first), dtype=torch.bool)
    if not len(first) or not len(second):
        return torch.zeros(0, 2, dtype=torch.long)
    for rows in orders[0].split(_AT_ONCE):
        columns = orders[1]
        if near is not None:
            left, right, band = near
            ends = torch.stack([left.turn[rows[0]] - band, left.turn[rows[-1]] + band])
            low, high = torch.searchsorted(right.turn[columns].contiguous(), ends).tolist()
            columns = columns[low:high]
        if not len(columns):
            continue
        score = first[rows] @ second[columns].T
        if near is not None:
            apart = (left.turn[rows, None] - right.turn[columns]).abs()
            parallax = right.along[columns] - left.along[rows, None]
            close = (apart < band) & (parallax > -band) & (parallax < 1.0 / _NEAREST)
            score = torch.where(close & left.valid[rows, None] & right.valid[columns], score, -1.0)
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


# Keypoints of an image: more tell little more and cost as much again.
_KEYPOINTS = 8000
# Cells across and down the left image among which matches are spread, and the most of one pair.
_CELLS = (32, 18)
# Matches of all pairs together, and of one pair: of fewer, in the dark, a third were wrong.
MOST, _FEWEST = 10_000, 60
# Of a baseline of one: it only sets the scale of a rig that is thrown away.
_UNIT_SIGMA = 1e-3


@briefly
class ImagePair(NamedTuple):
    """Two images taken at the same time.

    Attributes:
        name: of the pair, in messages and of its matches.
        left: (H, W) gray levels.
        right: (H, W) gray levels.
    """

    name: str
    left: Gray
    right: Gray


@dataclasses.dataclass(frozen=True, kw_only=True)
class PairCounts:
    """How many matches of a pair were kept and left out.

    Args:
        name: of the pair.
        matched: keypoints that are each other's best along the epipolar line.
        untextured: left out: no sub-pixel match, too little texture, or only a part of a patch is the same point.
        off_line: left out: off the epipolar line by more than noise explains.
        moved: left out: not there in the other pairs, or at another range.
        thinned: left out: others in the same part of the image are better.
        used: those that are left.
    """

    name: str
    matched: int
    untextured: int
    off_line: int
    moved: int
    thinned: int
    used: int


@briefly
class SceneMatches(NamedTuple):
    """Matches of all pairs as features of unknown range, and counts of those left out."""

    features: Features
    counts: tuple[PairCounts, ...]


class MatchedPair(NamedTuple):
    """Matches (M,) of a pair.

    Attributes:
        pixels: (M, 2, 2) left and right.
        covariance: (M, 2, 2) px² of the right one, the left one being given.
        share: (M,) see `kcal.scene.refine.RefinedMatches`.
        counts: what became of the others.
        rig: with a baseline of one, as these matches make it.
    """

    pixels: Tensor
    covariance: Tensor
    share: Tensor
    counts: PairCounts
    rig: Rig

    def at(self, which: Tensor, **counts: Any) -> MatchedPair:
        """Those at some places."""
        counted = dataclasses.replace(self.counts, **counts)
        pixels, covariance, share = self.pixels[which], self.covariance[which], self.share[which]
        return MatchedPair(pixels, covariance, share, counted, self.rig)


def scene_features(cameras: tuple[Camera, Camera], pairs: Sequence[ImagePair], most: int = MOST) -> SceneMatches:
    """Find and match features of the scene, checked along epipolar lines, both ways, and in time.

    Nothing is known of how the cameras stand but what the images tell; lenses are taken as calibrated. Each match has
    the covariance of its least-squares fit, widened by what its error has in common with those of others
    (`kcal.scene.common_errors`); errors that are smooth over the image are effects that all share
    (`kcal.scene.common_errors`). Where there are several pairs, what is not there in the others, or is there at another
    range, is left out: vehicles, waves, clouds, leaves.

    Args:
        cameras: left and right, calibrated.
        pairs: images of one time each; days apart is good.
        most: matches of all pairs together, evenly spread over the image.

    Raises:
        InputError: no pairs, a picture that is in two pairs, images of another size than the cameras', or too little
            in common.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(500, 500), center=(239.5, 159.5), size=(480, 320), model="pinhole")
        >>> scene_features((camera, camera), [])
        Traceback (most recent call last):
        ...
        kcal.errors.InputError: scene: no pair of images
    """
    return scene_of(cameras, pairs, [match_scene(cameras, pair) for pair in pairs], most)


@torch.no_grad()
def scene_of(
    cameras: tuple[Camera, Camera], pairs: Sequence[ImagePair], found: Sequence[MatchedPair], most: int = MOST
) -> SceneMatches:
    """Features from the matches of each pair (`match_scene`); see `scene_features`."""
    if not pairs:
        raise InputError("scene: no pair of images")
    _refuse_repeated(pairs)
    return counted(still_matches(pairs, found), cameras[0].size, most)


@torch.no_grad()
def still_matches(pairs: Sequence[ImagePair], found: Sequence[MatchedPair]) -> list[MatchedPair]:
    """The matches of some pairs without what is not still in the others."""
    return [_still(pairs, found, k) for k in range(len(pairs))] if len(pairs) > 1 else list(found)


@torch.no_grad()
def counted(found: Sequence[MatchedPair], size: tuple[int, int], most: int = MOST) -> SceneMatches:
    """Matches of some pairs, spread over the image, as features with what their errors have in common."""
    each = math.ceil(most / len(found))
    found = [_thinned(one, size, each) for one in found]
    names = tuple(f"{one.counts.name} {i}" for one in found for i in range(len(one.pixels)))
    pixels, lines = [one.pixels for one in found], [line_errors(one.rig, one.pixels) for one in found]
    covariance = with_common_errors(lines, pixels, [one.covariance for one in found], [one.share for one in found])
    ratio, places = pose_variance_ratio(lines, pixels, covariance, size), torch.cat(pixels)
    effects = smooth_effects(places, torch.cat([one.across for one in lines]), size)
    features = dataclasses.replace(_features(names, places, ratio * torch.cat(covariance)), effects=effects)
    return SceneMatches(features, tuple(one.counts for one in found))


def _refuse_repeated(pairs: Sequence[ImagePair]) -> None:
    """Raise `InputError` for a picture that is in two pairs: its errors would count as independent."""
    for side in ("left", "right"):
        names: dict[bytes, str] = {}
        for pair in pairs:
            picture = np.ascontiguousarray(getattr(pair, side)).tobytes()
            first = names.setdefault(hashlib.sha256(picture).digest(), pair.name)
            if first != pair.name:
                raise InputError(
                    f"{pair.name}: the {side} image is that of {first}; each pair must be of another time: remove one"
                )


def _features(names: tuple[str, ...], pixels: Tensor, covariance: Tensor) -> Features:
    """Features of unknown range; the left pixel says which point is meant, and each has half of the uncertainty."""
    nothing = torch.zeros(len(names), dtype=torch.float64)
    return Features(
        names=names,
        pixels=pixels,
        inverse_range=nothing,
        inverse_range_sigma=torch.full_like(nothing, torch.inf),
        covariance=0.5 * covariance[:, None].expand(-1, 2, 2, 2),
    )


@torch.no_grad()
def match_scene(cameras: tuple[Camera, Camera], pair: ImagePair) -> MatchedPair:
    """Matches of one pair.

    Raises:
        InputError: images of another size than the cameras', or too little in common.
    """
    for side, image, camera in zip(("left", "right"), (pair.left, pair.right), cameras, strict=True):
        if image.shape[::-1] != tuple(camera.size):
            raise InputError(
                f"{pair.name}: the {side} image has {image.shape[1]}x{image.shape[0]} pixels, its camera "
                f"{camera.size[0]}x{camera.size[1]}"
            )
    points = keypoints(pair.left, _KEYPOINTS), keypoints(pair.right, _KEYPOINTS)
    rig = rough_rig(cameras, points, pair.name)
    pixels = _guided(rig, points)
    if len(pixels) >= _FEWEST:
        # A pose from so many matches is good to a small part of the band in which the next ones are looked for.
        rig, _ = _posed(rig, pixels, torch.eye(2, dtype=torch.float64).expand(len(pixels), 2, 2))
        pixels = _guided(rig, points)
    matched = len(pixels)
    refined = refine_matches(rig, as_floats(pair), pixels[:, 0], pixels[:, 1]) if matched else None
    fine = 0 if refined is None else int(refined.good.sum())
    if refined is None or fine < _FEWEST:
        raise InputError(
            f"{pair.name}: only {fine} features were matched to a fraction of a pixel, {_FEWEST} are needed: is an "
            "image blurred, or is there fog?"
        )
    pixels = torch.stack([pixels[:, 0], refined.right], 1)[refined.good]
    covariance, share = refined.covariance[refined.good], refined.share[refined.good]
    rig, over = _posed(rig, pixels, covariance)
    good = over <= 1.0
    counts = PairCounts(
        name=pair.name, matched=matched, untextured=matched - fine, off_line=int((~good).sum()), moved=0, thinned=0,
        used=int(good.sum()),
    )  # fmt: skip
    return MatchedPair(pixels[good], covariance[good], share[good], counts, rig)


def _guided(rig: Rig, points: tuple[Keypoints, Keypoints]) -> Tensor:
    index = guided_matches(rig, points)
    return torch.stack([own.pixels[index[:, k]] for k, own in enumerate(points)], 1)


def as_floats(pair: ImagePair) -> tuple[Tensor, Tensor]:
    """Both images (H, W) float32."""
    return torch.from_numpy(pair.left.astype(np.float32)), torch.from_numpy(pair.right.astype(np.float32))


def _posed(rig: Rig, pixels: Tensor, covariance: Tensor) -> tuple[Rig, Tensor]:
    """The rig (baseline of one) that most of the matches make, and each one's χ² over its limit."""
    count = len(pixels)
    features = _features(tuple(map(str, range(count))), pixels, covariance)
    cameras = rig.left, rig.right
    scale = Baseline(first=0, second=1, length=1.0, sigma=_UNIT_SIGMA)
    data = RigData(cameras=cameras, names=("left", "right"), features=features, baselines=(scale,))
    turn, shift = rig.right_from_left_rotation, rig.right_from_left_translation
    start = Start(
        rotation=torch.stack([torch.eye(3, dtype=torch.float64), turn]),
        center=torch.stack([torch.zeros(3, dtype=torch.float64), -turn.T @ shift]),
    )
    work = Adjustment(data, start, held(cameras), 1.0)
    mask = possible(work, ~work.none())
    work.solve(mask, ROUGHLY, LOSS)
    over = work.over_limit(mask, work.squares(mask))
    # What has no projection, or is behind both cameras.
    over = torch.where(mask & (work.state.items[:, 3] >= -_UNIT_SIGMA), over, torch.inf)
    rotation, center = work.state.rotation, work.state.center
    return Rig.pair(*cameras, rotation[1] @ rotation[0].T, rotation[1] @ (center[0] - center[1])), over


def _still(pairs: Sequence[ImagePair], found: Sequence[MatchedPair], k: int) -> MatchedPair:
    """The matches of pair k without what is not still in any other pair."""
    own = found[k]
    others = [pairs[j] for j in range(len(pairs)) if j != k]
    # Two others tell enough, far apart in the list.
    chosen = [others[0], others[-1]] if len(others) > 1 else others
    image, _ = as_floats(pairs[k])
    verdicts = torch.stack([still_there(own.rig, image, as_floats(one), own.pixels, own.covariance) for one in chosen])
    good = (verdicts == int(Stillness.STILL)).any(0) & ~(verdicts == int(Stillness.ELSEWHERE)).any(0)
    return own.at(good, moved=int((~good).sum()), used=int(good.sum()))


def _thinned(found: MatchedPair, size: tuple[int, int], most: int) -> MatchedPair:
    """The best in each part of the image, as many as wanted."""
    columns, rows = _CELLS
    place = (found.pixels[:, 0] / torch.tensor(size) * torch.tensor(_CELLS)).long()
    cell = place[:, 1].clamp(0, rows - 1) * columns + place[:, 0].clamp(0, columns - 1)
    worst = found.covariance.diagonal(dim1=-2, dim2=-1).sum(-1)
    order = worst.argsort()
    order = order[cell[order].argsort(stable=True)]
    _, counts = cell[order].unique_consecutive(return_counts=True)
    rank = torch.arange(len(order)) - (counts.cumsum(0) - counts).repeat_interleave(counts)
    # The best of each cell, then the second best; of these the better ones first.
    by_sigma = worst[order].argsort(stable=True)
    kept = order[by_sigma[rank[by_sigma].argsort(stable=True)[:most]]].sort().values
    return found.at(kept, thinned=len(order) - len(kept), used=len(kept))
