"""Which detection of the left image is which of the right one: geometry, size, category and looks, one to one.

Pairs near one epipolar line (`kcal.pipeline.epipolar_band`) get their most likely point, at once on tensors. What no
point explains is the epipolar error; it is judged by the noise of the boxes and by what is not known of the rig. The
assignment with the least sum of costs is exact (`kcal.pipeline.one_to_one`); a detection may stay alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.checks import StatedModule, as_points, exportable
from kcal.corners.filters import as_gray
from kcal.dispatch import is_differentiated, still
from kcal.errors import InputError
from kcal.lens.rig import StereoRig
from kcal.locate.multi_localizer import MultiViewLocalizer
from kcal.locate.stations import stations_of
from kcal.pipeline.association_options import AssociationOptions
from kcal.pipeline.detections import Detections, box_anchors
from kcal.pipeline.epipolar_band import near_epipolar_lines
from kcal.pipeline.one_to_one import assign_groups
from kcal.pipeline.pair_costs import pair_costs
from kcal.texts import brief

# Spread of 1 - correlation between two views of one object; of two objects it is 0.5 to 1.
_LOOKS_SPREAD = 0.25
# Samples across a box, and how far patches may be shifted against each other, in samples: boxes err by that.
_SAMPLES = 16
_SHIFT = 4
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

    def __repr__(self) -> str:
        return brief(self)


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
    near = torch.ones(len(left), len(right), dtype=torch.bool, device=left.boxes.device)
    if options.same_category:
        names = {name: number for number, name in enumerate({*left.category, *right.category})}
        kinds = [near.new_tensor([names[name] for name in seen.category], dtype=torch.long) for seen in (left, right)]
        near = kinds[0][:, None] == kinds[1]
    anchors = left.anchors(options.anchor)[None], right.anchors(options.anchor)[None]
    pictures = None if images is None else (images[0][None], images[1][None])
    found = _paired(rig, anchors, (left.boxes[None], right.boxes[None]), near[None], options, pictures)
    (rows,) = (found.match[0] >= 0).nonzero(as_tuple=True)
    columns = found.match[0, rows]
    return Association(rows, columns, found.cost[0, rows, columns], found.ambiguous[0, rows], found.possible[0])


@exportable
class BoxPairs(NamedTuple):
    """Pairs of boxes of B moments; nothing in it is NaN.

    Attributes:
        match: (B, K) int64, number of the right box of each left one, -1 where it has none.
        mask: (B, K) bool, which left boxes have one.
        score: (B, K) exp(-cost / 2), the likelihood beside that of a perfect pair; 0 where there is none.
        ambiguous: (B, K) bool: another pairing is about as likely.
        left: (B, K, 2) what stands for the left boxes, for `StereoLocalizer`; the image's middle where `mask` is False.
        right: (B, K, 2) likewise of their right boxes.
    """

    match: Tensor
    mask: Tensor
    score: Tensor
    ambiguous: Tensor
    left: Tensor
    right: Tensor

    def __repr__(self) -> str:
        return brief(self)


class PairBoxes(StatedModule):
    """Pair the boxes of both images, for a batch of moments: `associate` as a module between detector and localizer.

    Matches are those of `associate`, moment by moment. Pixels and scores are differentiable by the boxes, with the
    pairing and the rig held as they are. The assignment itself runs on the CPU, whatever the device; inside
    `torch.compile` this module runs eagerly, and its batch stands for `vmap`.

    Args:
        rig: the calibrated cameras; with its `covariance`, errors of the calibration widen the epipolar gate.
        options: see `AssociationOptions`; `anchor` is "center" or "bottom".

    Example:
        >>> from kcal.rig import planned_rig
        >>> left = torch.tensor([[[900.0, 500, 920, 520], [1000, 700, 1030, 720]]])
        >>> right = left.flip(1) - torch.tensor([16.0, 0, 16, 0])
        >>> found = PairBoxes(planned_rig())(left, right)
        >>> found.match.tolist(), found.mask.tolist(), (found.left - found.right).tolist()
        ([[1, 0]], [[True, True]], [[[16.0, 0.0], [16.0, 0.0]]])
    """

    def __init__(self, rig: StereoRig, options: AssociationOptions | None = None) -> None:
        super().__init__()
        self.rig, self.options = rig, options or AssociationOptions()
        if isinstance(self.options.anchor, int):
            raise InputError("PairBoxes: boxes have no keypoints; anchor 'center' or 'bottom' is needed")

    @property
    def constants(self) -> object:
        """Options."""
        return self.options

    @torch.compiler.disable
    def forward(
        self,
        left: Tensor,
        right: Tensor,
        mask_left: Tensor | None = None,
        mask_right: Tensor | None = None,
        *,
        kinds: tuple[Tensor, Tensor] | None = None,
        images: tuple[Tensor, Tensor] | None = None,
    ) -> BoxPairs:
        """Pair boxes.

        Args:
            left: (B, K, 4) left, top, right and bottom edge in the left camera's full image, pixels.
            right: (B, M, 4) in the right camera's.
            mask_left: (B, K) bool, which are boxes at all; what is False is neither read nor paired.
            mask_right: (B, M) likewise.
            kinds: (B, K) and (B, M) integers, the categories; ignored unless `options.same_category`.
            images: gray levels (B, H, W) of both, if looks shall count; they carry no gradient.

        Raises:
            InputError: shapes or dtypes that do not fit, boxes that are not finite or without area, or more than 2,000.
        """
        sides = [
            _sound_boxes(f"{word} boxes", boxes, mask, camera.size)
            for word, boxes, mask, camera in (
                ("left", left, mask_left, self.rig.left), ("right", right, mask_right, self.rig.right)
            )
        ]  # fmt: skip
        boxes, masks = zip(*sides, strict=True)
        if len(left) != len(right):
            raise InputError(f"boxes of {len(left)} left and {len(right)} right images; as many of both are needed")
        near = masks[0][..., None] & masks[1][:, None]
        if kinds is not None and self.options.same_category:
            near = near & (kinds[0][..., None] == kinds[1][:, None])
        anchors = [box_anchors(some, str(self.options.anchor)) for some in boxes]
        found = _paired(self.rig, anchors, boxes, near, self.options, images)
        mask, score = found.match >= 0, torch.zeros_like(boxes[0][..., 0])
        moments, rows = mask.nonzero(as_tuple=True)
        columns = found.match[moments, rows]
        pixels, both = (
            torch.stack([one[moments, rows], other[moments, columns]], 1) for one, other in (anchors, boxes)
        )
        cost = found.cost[moments, rows, columns]
        if is_differentiated(both) and len(rows):
            fitted = _costs(still(self.rig), pixels, both, self.options)
            cost = cost + torch.nan_to_num(fitted - fitted.detach())
        middles = [0.5 * (score.new_tensor(camera.size) - 1.0) for camera in (self.rig.left, self.rig.right)]
        seen = [middle.expand(*mask.shape, 2).index_put((moments, rows), pixel)
                for middle, pixel in zip(middles, pixels.unbind(1), strict=True)]  # fmt: skip
        return BoxPairs(
            found.match, mask, score.index_put((moments, rows), (-0.5 * cost).exp()), found.ambiguous, *seen
        )


def _sound_boxes(name: str, boxes: Tensor, mask: Tensor | None, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Boxes (B, K, 4), harmless where there are none, and the mask."""
    boxes = as_points(name, boxes, 4)
    mask = torch.ones_like(boxes[..., 0], dtype=torch.bool) if mask is None else mask
    if boxes.ndim != 3 or mask.dtype != torch.bool or mask.shape != boxes.shape[:2]:
        raise InputError(
            f"{name} (B, K, 4) and a mask (B, K) of bool are needed, got {tuple(boxes.shape)} and "
            f"{tuple(mask.shape)} {mask.dtype}"
        )
    bad = ~(boxes.isfinite().all(-1) & (boxes[..., 2:] > boxes[..., :2]).all(-1)) & mask
    if bool(bad.any()):
        at = tuple(bad.nonzero()[0].tolist())
        raise InputError(f"{name}: number {at}, {boxes[at].tolist()}, is not finite or has no area; mask it")
    middle = 0.5 * (boxes.new_tensor(size) - 1.0)
    return torch.where(mask[..., None], boxes, torch.cat([middle - 0.5, middle + 0.5])), mask


class _Paired(NamedTuple):
    """Of B moments: right boxes (B, N) or -1, doubts (B, N), costs (B, N, M), and which pairs were possible."""

    match: Tensor
    ambiguous: Tensor
    cost: Tensor
    possible: Tensor


@torch.no_grad()
def _paired(
    rig: StereoRig,
    anchors: Sequence[Tensor],
    boxes: Sequence[Tensor],
    near: Tensor,
    options: AssociationOptions,
    images: tuple[Tensor, Tensor] | None,
) -> _Paired:
    """Pair anchors (B, N, 2) and (B, M, 2) of boxes (B, N, 4) and (B, M, 4) among those that are `near` (B, N, M)."""
    anchors, boxes = [some.detach() for some in anchors], [some.detach() for some in boxes]
    for word, some in zip(("left", "right"), boxes, strict=True):
        if some.shape[1] > MOST_BOXES:
            raise InputError(f"{some.shape[1]:,} {word} detections in one image; at most {MOST_BOXES:,} can be paired")
    ranges = _nearest(rig, options), options.farthest
    near = near & near_epipolar_lines(rig, anchors[0], anchors[1], options.box_sigma, options.gate, ranges)
    cost = association_costs(rig, anchors, boxes, near, options)
    if images is not None:
        shapes = [some.shape for some in images]
        if shapes != [(len(near), *camera.size[::-1]) for camera in (rig.left, rig.right)]:
            raise InputError("association: images of the cameras' sizes are needed, one of each for each moment")
        for one, first, second, left, right in zip(cost, *boxes, *images, strict=True):
            gray = as_gray("left image", left), as_gray("right image", right)
            looks = torch.cat([appearance(gray[0], first, gray[1], some) for some in second.split(64)], 1)
            one += ((1.0 - looks) / _LOOKS_SPREAD).square()
    possible = cost < options.gate**2
    if not len(near):
        return _Paired(near.new_zeros(near.shape[:2], dtype=torch.long), near.any(-1), cost, possible)
    # The assignment is SciPy's, on the CPU.
    costs = torch.where(possible, cost, torch.inf).cpu().numpy()
    done = [assign_groups(each, options.gate**2, 2.0 * math.log(options.odds)) for each in costs]
    chosen, doubts = (torch.from_numpy(np.stack(part)).to(cost.device) for part in zip(*done, strict=True))
    return _Paired(chosen, doubts & (chosen >= 0), cost, possible)


def _costs(rig: StereoRig, pixels: Tensor, boxes: Tensor, options: AssociationOptions) -> Tensor:
    """(L,) squared standard deviations of what no point explains, of range and size; pixels (L, 2, 2), boxes (L, 2, 4).

    Infinite where impossible; differentiable by both.
    """
    # Where a mast stands does not matter.
    alone = StereoRig(rig.left, rig.right, rig.right_from_left_rotation, rig.right_from_left_translation)
    alone.covariance = rig.covariance
    localize, both = MultiViewLocalizer(stations_of(alone)), torch.tensor([0, 1]).expand(len(pixels), 2)
    return pair_costs(localize, both, pixels, boxes, options, _nearest(rig, options)).cost


def association_costs(
    rig: StereoRig, anchors: Sequence[Tensor], boxes: Sequence[Tensor], among: Tensor, options: AssociationOptions
) -> Tensor:
    """(B, N, M) squared standard deviations of epipolar error, range and size of pairs; infinite where impossible.

    Of anchors (B, N, 2) and (B, M, 2) of boxes (B, N, 4) and (B, M, 4), where `among` (B, N, M) is true.
    """
    cost = torch.full_like(among, torch.inf, dtype=torch.float64)
    moments, rows, columns = among.nonzero(as_tuple=True)
    if len(rows):
        both = [torch.stack([one[moments, rows], other[moments, columns]], 1) for one, other in (anchors, boxes)]
        cost[moments, rows, columns] = _costs(rig, both[0], both[1], options)
    return cost


def _nearest(rig: StereoRig, options: AssociationOptions) -> float:
    return options.nearest if options.nearest is not None else 10.0 * float(rig.baseline.detach())


def appearance(left: Tensor, boxes_left: Tensor, right: Tensor, boxes_right: Tensor) -> Tensor:
    """Normalized correlation (N, M), -1 to 1, of the patches in boxes (N, 4) and (M, 4); 0 where one is flat.

    Args:
        left: (H, W) gray levels.
        boxes_left: (N, 4) edges in pixels.
        right: (H, W) gray levels.
        boxes_right: (M, 4).

    Example:
        >>> image = torch.rand(40, 60, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        >>> boxes = torch.tensor([[10.0, 10, 26, 26], [30, 10, 46, 26]], dtype=torch.float64)
        >>> (appearance(image, boxes, image.roll(2, 1), boxes) > 0.6).tolist()
        [[True, False], [False, True]]
    """
    templates = _patches(left, boxes_left, _SAMPLES)
    templates = templates - templates.mean((-2, -1), keepdim=True)
    windows = _patches(right, boxes_right, _SAMPLES + 2 * _SHIFT)
    products = torch.nn.functional.conv2d(windows[:, None], templates[:, None])  # (M, N, shifts, shifts)
    area = _SAMPLES**2
    mean = torch.nn.functional.avg_pool2d(windows[:, None], _SAMPLES, stride=1)
    power = torch.nn.functional.avg_pool2d(windows[:, None].square(), _SAMPLES, stride=1) - mean.square()
    norm = (area * power.clamp_min(0.0)).sqrt() * torch.linalg.vector_norm(templates, dim=(-2, -1))[None, :, None, None]
    # Rounding of flat patches is no likeness.
    scale = 1e-6 * area * (left.abs().amax() * right.abs().amax()).clamp_min(1e-12)
    found = torch.where(norm > scale, products / torch.where(norm > scale, norm, 1.0), 0.0)
    return found.amax((-2, -1)).T


def _patches(image: Tensor, boxes: Tensor, samples: int) -> Tensor:
    """(N, samples, samples) of the boxes; more samples than `_SAMPLES` reach beyond the box by as much."""
    height, width = image.shape
    at = (torch.arange(samples, dtype=image.dtype, device=image.device) - 0.5 * (samples - 1)) / _SAMPLES
    middle, size = 0.5 * (boxes[:, :2] + boxes[:, 2:]), boxes[:, 2:] - boxes[:, :2]
    x = middle[:, :1] + at * size[:, :1]
    y = middle[:, 1:] + at * size[:, 1:]
    grid = torch.stack(
        [(2.0 * x / (width - 1) - 1.0)[:, None].expand(-1, samples, -1),
         (2.0 * y / (height - 1) - 1.0)[:, :, None].expand(-1, -1, samples)], -1,
    )  # fmt: skip
    # One tall grid, because the image is the same for all.
    sampled = torch.nn.functional.grid_sample(
        image[None, None], grid.reshape(1, -1, samples, 2), padding_mode="border", align_corners=True
    )
    return sampled.reshape(len(boxes), samples, samples)
