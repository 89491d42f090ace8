"""Which detection of the left image is which of the right one: geometry, size, category and looks, one to one.

Every pair of detections gets its most likely point, at once on tensors. What no point explains is the epipolar error;
it is judged by the noise of the boxes and by what is not known of the rig. The assignment with the least sum of costs
is exact (Crouse, "On implementing 2D rectangular assignment algorithms", 2016, by SciPy); a detection may stay alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from kcal.corners.filters import as_gray
from kcal.errors import InputError
from kcal.lens.rig import RigCovariance, StereoRig
from kcal.locate.max_likelihood import by_pose, calibration_effect
from kcal.locate.stereo import PairFit, PositionStatus, fit_pairs, inverse_range
from kcal.pipeline.detections import Anchor, Detections
from kcal.pipeline.looks import appearance

# Spread of the logarithm of an object's size between two views, besides what boxes err: it is seen from two sides.
_SIZE_SPREAD = 0.15
# Spread of 1 - correlation between two views of one object; of two objects it is 0.5 to 1.
_LOOKS_SPREAD = 0.25
_FORBIDDEN = 1e9


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
        InputError: detections or images that are not of the cameras' size, or a missing keypoint.

    Example:
        >>> from kcal.locate.budget import planned_rig
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
    cost = pair_costs(rig, left, right, options)
    if images is not None:
        gray = [as_gray(f"{word} image", image) for word, image in zip(("left", "right"), images, strict=True)]
        if [image.shape[::-1] for image in gray] != [rig.left.size, rig.right.size]:
            raise InputError("association: images of the cameras' sizes are needed")
        cost = cost + ((1.0 - appearance(gray[0], left.boxes, gray[1], right.boxes)) / _LOOKS_SPREAD).square()
    possible = cost < options.gate**2
    if options.same_category:
        names = {name: number for number, name in enumerate({*left.category, *right.category})}
        kinds = [torch.tensor([names[name] for name in seen.category]).reshape(-1) for seen in (left, right)]
        possible &= kinds[0][:, None] == kinds[1]
    chosen, ambiguous = _assigned(torch.where(possible, cost, _FORBIDDEN).numpy(), options)
    rows = torch.from_numpy(np.flatnonzero(chosen >= 0))
    columns = torch.from_numpy(chosen[chosen >= 0])
    return Association(rows, columns, cost[rows, columns], torch.from_numpy(ambiguous)[rows], possible)


def pair_costs(rig: StereoRig, left: Detections, right: Detections, options: AssociationOptions) -> Tensor:
    """(N, M) squared standard deviations of epipolar error, range and size of all pairs; infinite where impossible."""
    rows, columns = len(left), len(right)
    if not rows * columns:
        return torch.zeros(rows, columns, dtype=torch.float64)
    first = left.anchors(options.anchor)[:, None].expand(rows, columns, 2).reshape(-1, 2)
    second = right.anchors(options.anchor)[None].expand(rows, columns, 2).reshape(-1, 2)
    noise = (options.box_sigma**2 * torch.eye(4, dtype=torch.float64)).expand(len(first), 4, 4)
    found = fit_pairs(rig, first, second, noise, by_camera=rig.covariance is not None)
    cost = epipolar_cost(found, options.box_sigma**2, rig.covariance)
    variance = found.fit.covariance[5]
    if rig.covariance is not None:
        moved = calibration_effect(found.fit, found.scale)[..., 2, :] @ rig.covariance.half.T
        variance = variance + moved.square().sum(-1)
    reach = inverse_range(found, variance, PositionStatus.BEARING_ONLY)
    nearest = options.nearest if options.nearest is not None else 10.0 * float(rig.baseline)
    beyond = (1.0 / options.farthest - reach.value).clamp_min(0.0)
    before = (reach.value - 1.0 / nearest).clamp_min(0.0)
    cost = cost + (torch.maximum(beyond, before) / reach.sigma).square()
    cost = cost + _size_cost(found, left, right, options.box_sigma)
    return torch.where(found.usable & (reach.sigma > 0), cost, torch.inf).reshape(rows, columns)


def epipolar_cost(found: PairFit, variance: float, covariance: RigCovariance | None) -> Tensor:
    """(N,) squared epipolar error over its variance: noise `variance` of every pixel coordinate, and the rig's.

    The combination of the four coordinates that no point explains is orthogonal to the rows of `gain`.
    """
    fit = found.fit
    rows = fit.gain.movedim(-1, 0)
    # The vector across three others in four dimensions, by their minors.
    across = torch.stack(
        [(-1.0) ** i * torch.linalg.det(rows[:, :, [k for k in range(4) if k != i]]) for i in range(4)], -1
    )
    across = torch.nn.functional.normalize(across, dim=-1)
    error = (across * fit.residual.mT).sum(-1)
    spread = torch.full_like(error, variance)
    if covariance is not None:
        left, right = (projection.by_camera for projection in fit.projections)
        pose = by_pose(fit, 1)
        pose = torch.cat([pose[:3], pose[3:] / found.scale])
        unit = across.mT
        slopes = [(unit[:2] * left).sum(1), (unit[2:] * right).sum(1), (unit[2:] * pose).sum(1)]
        spread = spread + (torch.cat(slopes).T @ covariance.half.T).square().sum(-1)
    return error.square() / spread


def _size_cost(found: PairFit, left: Detections, right: Detections, box_sigma: float) -> Tensor:
    """(N * M,) squared standard deviations between the sizes, given how much each lens magnifies there."""
    sizes = [seen.boxes[:, 2:] - seen.boxes[:, :2] for seen in (left, right)]
    ratio = sizes[0].log()[:, None] - sizes[1].log()
    near, far = (torch.linalg.vector_norm(p.by_point, dim=(-3, -2)).log() for p in found.fit.projections)
    ratio = ratio - (near - far).reshape(len(left), len(right), 1)
    # Middles of boxes err by box_sigma, so edges by √2 and sizes by twice as much.
    relative = [2.0 * box_sigma / size for size in sizes]
    spread = relative[0].square()[:, None] + relative[1].square() + _SIZE_SPREAD**2
    return (ratio.square() / spread).sum(-1).reshape(-1)


def _assigned(cost: np.ndarray, options: AssociationOptions) -> tuple[np.ndarray, np.ndarray]:
    """For each row its column or -1, and whether another pairing of the two is nearly as good."""
    chosen, least = _best_assignment(cost, options.gate**2)
    ambiguous = np.zeros(len(cost), dtype=bool)
    for i in np.flatnonzero(chosen >= 0):
        j = chosen[i]
        rivals = np.count_nonzero(cost[i] < _FORBIDDEN) + np.count_nonzero(cost[:, j] < _FORBIDDEN)
        if rivals == 2:
            continue
        without = cost.copy()
        without[i, j] = _FORBIDDEN
        other, more = _best_assignment(without, options.gate**2)
        elsewhere = other[i] >= 0 or j in other
        ambiguous[i] = elsewhere and more - least < 2.0 * math.log(options.odds)
    return chosen, ambiguous


def _best_assignment(cost: np.ndarray, alone: float) -> tuple[np.ndarray, float]:
    """Columns of the rows, or -1, and the sum of costs, where two detections that stay alone cost `alone` together."""
    rows, columns = cost.shape
    whole = np.full((rows + columns, rows + columns), _FORBIDDEN)
    whole[:rows, :columns] = cost
    whole[rows:, columns:] = 0.0
    whole[np.arange(rows), columns + np.arange(rows)] = 0.5 * alone
    whole[rows + np.arange(columns), np.arange(columns)] = 0.5 * alone
    at = linear_sum_assignment(whole)[1]
    chosen = np.where(at[:rows] < columns, at[:rows], -1)
    return chosen, float(whole[np.arange(len(at)), at].sum())
