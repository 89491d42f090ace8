"""`pair_objects`: from the detections of both images to pairs of pixels with covariance, in one call."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.corners.match import MatchStatus
from kcal.errors import InputError
from kcal.lens.rig import StereoRig
from kcal.pipeline.association import associate
from kcal.pipeline.association_options import AssociationOptions
from kcal.pipeline.detections import Detections
from kcal.pipeline.disparity import ObjectDisparity
from kcal.pipeline.pairs import ObjectPairs


def pair_objects(
    rig: StereoRig,
    left: Detections,
    right: Detections,
    images: tuple[Tensor, Tensor] | None = None,
    *,
    options: AssociationOptions | None = None,
    disparity: ObjectDisparity | None = None,
) -> ObjectPairs:
    """Pair the detections of both images, and match the image inside the boxes where there are images.

    Where matching succeeds, both pixels share the error of the anchor, `options.box_sigma`, and the right one has the
    small error of the match besides, so that ranges are exact and bearings as good as boxes are. Where it is refused,
    the pixels are those of the boxes, each with its own `box_sigma`.

    Args:
        rig: the calibrated cameras.
        left: detections in the left camera's full image.
        right: detections in the right camera's.
        images: gray levels (H, W) of both.
        options: of the association.
        disparity: the module that matches; `ObjectDisparity(rig)` if left out.

    Raises:
        InputError: see `associate` and `ObjectDisparity`; or only one of the images has a time.

    Example:
        >>> from kcal.rig import planned_rig
        >>> boxes = torch.tensor([[900.0, 500, 920, 520], [1000, 700, 1030, 720]])
        >>> left = Detections.read(boxes, size=(1920, 1080))
        >>> right = Detections.read(boxes - torch.tensor([16.0, 0, 16, 0]), size=(1920, 1080))
        >>> pair_objects(planned_rig(), left, right).right.tolist()
        [[893.5, 509.5], [998.5, 709.5]]
    """
    options = options or AssociationOptions()
    if (left.time is None) != (right.time is None):
        raise InputError("pair_objects: one image has a time, the other has none; give both, or none for single images")
    found = associate(rig, left, right, options, images)
    first, second = left.select(found.left), right.select(found.right)
    anchors = first.anchors(options.anchor)
    pixels = second.anchors(options.anchor)
    noise = options.box_sigma**2 * torch.eye(4).to(anchors)
    covariance = noise.repeat(len(first), 1, 1)
    if images is not None and len(first):
        match = disparity or ObjectDisparity(rig)
        done = match(*images, first.boxes, second.anchors(), anchors_left=anchors, masks=first.masks)
        good = done.status == int(MatchStatus.GOOD)
        pixels = torch.where(good[:, None], done.pixels, pixels)
        own, slope = noise[:2, :2], done.by_anchor
        shared = torch.cat(
            [torch.cat([own.expand_as(slope), own @ slope.mT], -1),
             torch.cat([slope @ own, slope @ own @ slope.mT + done.covariance], -1)], -2,
        )  # fmt: skip
        covariance = torch.where(good[:, None, None], 0.5 * (shared + shared.mT), covariance)
    return ObjectPairs(
        left=anchors,
        right=pixels,
        covariance=covariance,
        time=anchors.new_tensor([left.time or 0.0, right.time or 0.0]).expand(len(first), 2),
        score=torch.minimum(first.score, second.score),
        category=first.category,
        track=tuple(one or other for one, other in zip(first.track, second.track, strict=True)),
        ambiguous=found.ambiguous,
    )
