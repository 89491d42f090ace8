"""Which detection of the left image is which of the right one: geometry, size, category and looks, one to one.

Pairs near one epipolar line (`kcal.pipeline.epipolar_band`) get their most likely point, at once on tensors. What no
point explains is the epipolar error; it is judged by the noise of the boxes and by what is not known of the rig. The
assignment with the least sum of costs is exact (`kcal.pipeline.one_to_one`); a detection may stay alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.corners.filters import as_gray
from kcal.errors import InputError
from kcal.lens.projection import Projection
from kcal.lens.rig import RigCovariance, StereoRig
from kcal.locate.max_likelihood import calibration_effect, unreached_direction
from kcal.locate.stereo import PairFit, PositionStatus, fit_pairs, inverse_range
from kcal.pipeline.appearance import appearance
from kcal.pipeline.detections import Anchor, Detections
from kcal.pipeline.epipolar_band import near_epipolar_lines
from kcal.pipeline.one_to_one import assign_groups

# Spread of the logarithm of an object's size between two views, besides what boxes err: it is seen from two sides.
_SIZE_SPREAD = 0.15
# Spread of 1 - correlation between two views of one object; of two objects it is 0.5 to 1.
_LOOKS_SPREAD = 0.25
# Of one image: more are a detector's fault, and their pairs grow with the square.
MOST_BOXES = 2000
# Numbers that are held at once while pairs are compared, some 100 MB with what is derived from them.
_AT_ONCE = 1 << 19


@dataclass(frozen=True, kw_only=True)
class AssociationOptions:
    """Options of `associate`.

    Args:
        box_sigma: standard deviation of a box's middle along each axis, pixels.
        nearest: smallest range, meters; 10 baselines if None.
        farthest: largest range, meters.
        gate: a pair is possible up to this many standard deviations, epipolar error, size and looks together.
        odds: a pair is ambiguous unless the best assignment with it is this many times as likely as the best one that
            pairs one of its members otherwise.
        same_category: whether only detections of the same category may be paired.
        anchor: pixel that stands for an object; see `Detections.anchors`.

    Raises:
        InputError: a value out of range.
    """

    box_sigma: float = 2.0
    nearest: float | None = None
    farthest: float = math.inf
    gate: float = 4.0
    odds: float = 20.0
    same_category: bool = True
    anchor: Anchor = "center"

    def __post_init__(self) -> None:
        if not (0 < self.box_sigma < math.inf and 0 < self.gate < math.inf and 1 <= self.odds < math.inf):
            raise InputError("association: box_sigma and gate are positive, and odds at least 1")
        if not 0 < (self.nearest or 1e-9) < self.farthest:
            raise InputError(f"association: 0 < nearest < farthest is needed, got {self.nearest} and {self.farthest}")


class Association(NamedTuple):
    """Pairs of detections; K pairs of N left and M right ones.

    Attributes:
        left: (K,) int64, numbers of the left detections, ascending.
        right: (K,) int64, those of the right ones.
        cost: (K,) squared standard deviations: minus twice the logarithm of the likelihood.
        ambiguous: (K,) bool: another pairing is about as likely.
        possible: (N, M) bool: which pairs were possible at all.
    """

    left: Tensor
    right: Tensor
    cost: Tensor
    ambiguous: Tensor
    possible: Tensor


@torch.no_grad()
def associate(
    rig: StereoRig,
    left: Detections,
    right: Detections,
    options: AssociationOptions | None = None,
    images: tuple[Tensor, Tensor] | None = None,
) -> Association:
    """Pair the detections of the left image with those of the right one.

    Args:
        rig: the calibrated cameras; with its `covariance`, errors of the calibration widen the epipolar gate.
        left: detections in the left camera's full image.
        right: detections in the right camera's.
        options: see `AssociationOptions`.
        images: gray levels (H, W) of both, if looks shall count.

    Raises:
        InputError: detections or images that are not of the cameras' size, more than 2,000 boxes in an image, or a
            missing keypoint.

    Example:
        >>> from kcal.rig import planned_rig
        >>> rig = planned_rig()
        >>> boxes = torch.tensor([[900.0, 500, 920, 520], [1000, 700, 1030, 720]])
        >>> left = Detections.read(boxes, size=(1920, 1080))
        >>> right = Detections.read(boxes.flip(0) - torch.tensor([16.0, 0, 16, 0]), size=(1920, 1080))
        >>> found = associate(rig, left, right)
        >>> found.left.tolist(), found.right.tolist(), found.ambiguous.tolist()
        ([0, 1], [1, 0], [False, False])
    """
    options = options or AssociationOptions()
    for word, camera, seen in (("left", rig.left, left), ("right", rig.right, right)):
        if seen.size != camera.size:
            raise InputError(f"the {word} detections are of an image {seen.size}, the camera has {camera.size}")
        if len(seen) > MOST_BOXES:
            raise InputError(f"{len(seen):,} {word} detections in one image; at most {MOST_BOXES:,} can be paired")
    near = torch.ones(len(left), len(right), dtype=torch.bool)
    if options.same_category:
        names = {name: number for number, name in enumerate({*left.category, *right.category})}
        kinds = [torch.tensor([names[name] for name in seen.category]).reshape(-1) for seen in (left, right)]
        near = kinds[0][:, None] == kinds[1]
    anchors = left.anchors(options.anchor), right.anchors(options.anchor)
    ranges = _nearest(rig, options), options.farthest
    near &= near_epipolar_lines(rig, *anchors, options.box_sigma, options.gate, ranges)
    cost = pair_costs(rig, left, right, options, near)
    if images is not None:
        gray = [as_gray(f"{word} image", image) for word, image in zip(("left", "right"), images, strict=True)]
        if [image.shape[::-1] for image in gray] != [rig.left.size, rig.right.size]:
            raise InputError("association: images of the cameras' sizes are needed")
        parts = right.boxes.split(64)
        looks = torch.cat([appearance(gray[0], left.boxes, gray[1], some) for some in parts], 1)
        cost = cost + ((1.0 - looks) / _LOOKS_SPREAD).square()
    possible = cost < options.gate**2
    costs = torch.where(possible, cost, torch.inf).numpy()
    chosen, ambiguous = assign_groups(costs, options.gate**2, 2.0 * math.log(options.odds))
    rows = torch.from_numpy(np.flatnonzero(chosen >= 0))
    columns = torch.from_numpy(chosen[chosen >= 0])
    return Association(rows, columns, cost[rows, columns], torch.from_numpy(ambiguous)[rows], possible)


def pair_costs(
    rig: StereoRig, left: Detections, right: Detections, options: AssociationOptions, among: Tensor | None = None
) -> Tensor:
    """(N, M) squared standard deviations of epipolar error, range and size of pairs; infinite where impossible.

    `among` (N, M) bool: the pairs that are compared; all of them if left out. Others are infinite.
    """
    cost = torch.full((len(left), len(right)), torch.inf, dtype=torch.float64)
    rows, columns = (torch.ones_like(cost, dtype=torch.bool) if among is None else among).nonzero(as_tuple=True)
    errors = 0 if rig.covariance is None else rig.covariance.half.shape[0]
    size = _AT_ONCE // (16 + 8 * errors) + 1
    for some, others in zip(rows.split(size), columns.split(size), strict=True):
        if len(some):
            cost[some, others] = _some_costs(rig, left, right, options, some, others)
    return cost


def _nearest(rig: StereoRig, options: AssociationOptions) -> float:
    return options.nearest if options.nearest is not None else 10.0 * float(rig.baseline)


def _some_costs(
    rig: StereoRig, left: Detections, right: Detections, options: AssociationOptions, rows: Tensor, columns: Tensor
) -> Tensor:
    """(L,) of the pairs of these numbers."""
    variance = options.box_sigma**2
    first, second = left.anchors(options.anchor)[rows], right.anchors(options.anchor)[columns]
    # Every coordinate has the same noise: the point does not depend on how large it is.
    found = fit_pairs(rig, first, second, by_camera=rig.covariance is not None)
    spread = variance * found.fit.covariance[5]
    if rig.covariance is not None:
        moved = calibration_effect(found.fit, found.scale, rig.covariance.half.T)[2]
        spread = spread + moved.square().sum(0)
    reach = inverse_range(found, spread, PositionStatus.BEARING_ONLY)
    beyond = (1.0 / options.farthest - reach.value).clamp_min(0.0)
    before = (reach.value - 1.0 / _nearest(rig, options)).clamp_min(0.0)
    total = epipolar_cost(found, variance, rig.covariance) + (torch.maximum(beyond, before) / reach.sigma).square()
    total = total + size_cost(found.fit.projections, left.boxes[rows], right.boxes[columns], options.box_sigma)
    return torch.where(found.usable & (reach.sigma > 0), total, torch.inf)


def epipolar_cost(found: PairFit, variance: float, covariance: RigCovariance | None) -> Tensor:
    """(N,) squared epipolar error over its variance: noise `variance` of every pixel coordinate, and the rig's.

    The combination of the four coordinates that no point explains is orthogonal to the rows of `gain`.
    """
    across = unreached_direction(found.fit)
    error = (across * found.fit.residual).sum(0)
    spread = torch.full_like(error, variance)
    if covariance is not None:
        moved = calibration_effect(found.fit._replace(gain=across[None]), found.scale, covariance.half.T)
        spread = spread + moved[0].square().sum(0)
    return error.square() / spread


def size_cost(
    projections: Sequence[Projection], left: Tensor, right: Tensor, box_sigma: float, parallax: Tensor | float = 0.0
) -> Tensor:
    """(L,) squared standard deviations between the sizes of boxes, given how much each camera magnifies there.

    `parallax` (L,): sine of the angle between the lines of sight. From another side, an object may have another size.
    """
    sizes = [boxes[:, 2:] - boxes[:, :2] for boxes in (left, right)]
    near, far = (torch.linalg.vector_norm(p.by_point, dim=(-3, -2)).log() for p in projections)
    ratio = (sizes[0] / sizes[1]).log() - (near - far)[:, None]
    # Middles of boxes err by box_sigma, so edges by √2 and sizes by twice as much.
    side = torch.as_tensor(parallax).reshape(-1, 1)
    spread = sum((2.0 * box_sigma / size).square() for size in sizes) + _SIZE_SPREAD**2 + side.square()
    return (ratio.square() / spread).sum(-1)
