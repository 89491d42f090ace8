"""Which detection of the left image is which of the right one: geometry, size, category and looks, one to one.

Pairs near one epipolar line (`kcal.pipeline.epipolar_band`) get their most likely point, at once on tensors. What no
point explains is the epipolar error; it is judged by the noise of the boxes and by what is not known of the rig. The
assignment with the least sum of costs is exact (`kcal.pipeline.one_to_one`); a detection may stay alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.corners.filters import as_gray
from kcal.errors import InputError
from kcal.lens.rig import StereoRig
from kcal.locate.multi_localizer import MultiViewLocalizer
from kcal.locate.stations import stations_of
from kcal.pipeline.appearance import appearance
from kcal.pipeline.association_options import AssociationOptions
from kcal.pipeline.detections import Detections
from kcal.pipeline.epipolar_band import near_epipolar_lines
from kcal.pipeline.one_to_one import assign_groups
from kcal.pipeline.pair_costs import pair_costs

# Spread of 1 - correlation between two views of one object; of two objects it is 0.5 to 1.
_LOOKS_SPREAD = 0.25
# Of one image: more are a detector's fault, and their pairs grow with the square.
MOST_BOXES = 2000


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
    cost = association_costs(rig, left, right, options, near)
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


def association_costs(
    rig: StereoRig, left: Detections, right: Detections, options: AssociationOptions, among: Tensor | None = None
) -> Tensor:
    """(N, M) squared standard deviations of epipolar error, range and size of pairs; infinite where impossible.

    `among` (N, M) bool: the pairs that are compared; all of them if left out. Others are infinite.
    """
    cost = torch.full((len(left), len(right)), torch.inf, dtype=torch.float64)
    rows, columns = (torch.ones_like(cost, dtype=torch.bool) if among is None else among).nonzero(as_tuple=True)
    if not len(rows):
        return cost
    # Where a mast stands does not matter.
    alone = StereoRig(rig.left, rig.right, rig.right_from_left_rotation, rig.right_from_left_translation)
    alone.covariance = rig.covariance
    cost[rows, columns] = pair_costs(
        MultiViewLocalizer(stations_of(alone)),
        torch.tensor([0, 1]).expand(len(rows), 2),
        torch.stack([left.anchors(options.anchor)[rows], right.anchors(options.anchor)[columns]], 1),
        torch.stack([left.boxes[rows], right.boxes[columns]], 1),
        options,
        _nearest(rig, options),
    ).cost
    return cost


def _nearest(rig: StereoRig, options: AssociationOptions) -> float:
    return options.nearest if options.nearest is not None else 10.0 * float(rig.baseline)
