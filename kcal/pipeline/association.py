"""Which object of the left image is which of the right one: bands, costs, and one assignment."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.checks import StatedModule, as_points, exportable
from kcal.corners.patches import as_gray
from kcal.dispatch import is_differentiated, still
from kcal.errors import InputError
from kcal.lens.camera_like import check_single
from kcal.lens.rig import Rig
from kcal.locate.localizer import Localizer
from kcal.locate.views import CommonErrors, PosedCameras, ViewsFit, common_variance, fit_views
from kcal.pipeline.assignment import assign_groups
from kcal.pipeline.detections import Anchor, Detections, box_anchors
from kcal.pipeline.epipolar_pencil import StationSights, in_range, near_in_angle
from kcal.texts import briefly

# `AssociationOptions`: which detections may be of one object.


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


# Which pairs of pixels can be of one object at all: a cheap test that comes before any point is fitted.
#
# Far from the epipolar line, the fit of a point may also stop at a false optimum; such pairs end here.

# The band is this many times as wide as the errors to first order say, for lenses that bend within it, and whose pixels
# are wider one way than the other.
_SLACK = 2.0
# Ranges from the left camera and from the rig's middle differ by this ratio at most, from 2 baselines on.
_MIDDLE = 1.25


def station_sights(
    localize: Localizer, camera: NDArray[np.int64], pixels: Tensor, sigma: float
) -> tuple[StationSights, NDArray[np.bool_]]:
    """Lines of sight of pixels (N, 2) of cameras (N,), with noise `sigma` px and common errors; which exist."""
    posed, common = localize.posed, localize.common
    place, air = torch.zeros_like(posed.center[:, 0]), 0.0
    if common is not None:
        place = common.half[..., :3].square().sum(0).sqrt().amax(-1)
        air = float(common.bending.square().sum().sqrt())
    ray, wide = posed.center.new_zeros(len(camera), 3), posed.center.new_ones(len(camera))
    there = torch.zeros_like(wide, dtype=torch.bool)
    for c, lens in enumerate(posed.cameras):
        own = torch.from_numpy(np.flatnonzero(camera == c)).to(ray.device)
        marks = pixels[own]
        steps = marks.new_tensor([[0, 0], [1, 0], [0, 1]])[:, None]
        rays, valid = lens.unproject(marks + steps)
        slope = (rays[1:] - rays[:1]).square().sum((0, -1)) / 2.0
        ray[own], there[own] = rays[0] @ posed.rotation[c], valid[0]
        wide[own] = (slope * (sigma**2 + common_variance(posed, common, c, ray[own]).amax(-1))).sqrt()
    up = torch.zeros_like(posed.center) if posed.up is None else posed.up
    rays_of, wide_of, apart, center, up_of = (one.cpu().numpy() for one in (ray, wide, place, posed.center, up))
    sights = StationSights(camera, rays_of, wide_of, apart, air, center, up_of, float(posed.bending))
    return sights, there.cpu().numpy()


def near_lines(localize: Localizer, anchors: Sequence[Tensor], options: AssociationOptions, nearest: float) -> Tensor:
    """(B, N, M) bool: False only for pixels (B, N, 2) and (B, M, 2) that certainly do not show one point.

    Args:
        localize: of two cameras, with weights by all errors.
        anchors: left and right pixels.
        options: their noise, the gate, and the largest range.
        nearest: the smallest range, meters.
    """
    (moments, rows), columns = anchors[0].shape[:2], anchors[1].shape[1]
    near, count = np.zeros((moments, rows, columns), dtype=bool), moments * rows
    if near.size:
        camera = np.repeat([0, 1], [count, moments * columns])
        pixels = torch.cat([some.flatten(0, 1) for some in anchors])
        lines, there = station_sights(localize, camera, pixels, options.box_sigma)
        gate, ranges = _SLACK * options.gate, (nearest / _MIDDLE, options.farthest * _MIDDLE)
        left, right = (part.reshape(moments, -1) for part in np.split(np.arange(len(camera)), [count]))
        for own, other in zip(left, right, strict=True):
            first, second = near_in_angle(lines, own[there[own]], other[there[other]], gate, nearest)
            kept = in_range(lines, (first, second), gate, ranges)
            near[first[kept] // rows, first[kept] % rows, (second[kept] - count) % columns] = True
    return torch.from_numpy(near).to(anchors[0].device)


# What a pair of detections costs: squared standard deviations of what no point explains, of its range and its size.

# Spread of the logarithm of an object's size between two views, besides what boxes err: it is seen from two sides.
_SIZE_SPREAD = 0.15
# Numbers that are held at once while pairs are compared, some 100 MB with what is derived from them.
_PAIRS_AT_ONCE = 1 << 19


class PairCosts(NamedTuple):
    """Of L pairs of detections.

    Attributes:
        cost: (L,) squared standard deviations: minus twice the logarithm of the likelihood; infinite where impossible.
        inverse: (L,) one over meters, from the first camera.
        sigma: (L,) its standard deviation.
    """

    cost: Tensor
    inverse: Tensor
    sigma: Tensor


def fit_some(localize: Localizer, cameras: list[int], pixels: Tensor, seen: Tensor, noise: float) -> ViewsFit:
    """Points of pixels (N, C, 2) of some cameras, with all errors that each camera's marks share."""
    posed, common = localize.posed, localize.common
    lenses = [posed.cameras[c] for c in cameras]
    up = None if posed.up is None else posed.up[cameras]
    part = PosedCameras(lenses, posed.rotation[cameras], posed.center[cameras], up, posed.bending)
    if common is not None:
        common = CommonErrors(tuple(common.lens[c] for c in cameras), common.half[:, cameras], common.bending)
    return fit_views(part, pixels, seen, noise=noise, shared=common, differentiated=is_differentiated(pixels))


def pair_costs(
    localize: Localizer,
    cameras: Tensor,
    pixels: Tensor,
    boxes: Tensor,
    options: AssociationOptions,
    nearest: float | None,
) -> PairCosts:
    """Compare pairs of detections of any two cameras; differentiable by pixels and boxes.

    Args:
        localize: the rig and how well it is known.
        cameras: (L, 2) numbers of two cameras each, on the CPU; pairs of the same two stand together.
        pixels: (L, 2, 2) what stands for the objects.
        boxes: (L, 2, 4) x1, y1, x2, y2.
        options: of the association.
        nearest: smallest range, meters; None: any.

    Example:
        >>> from kcal.rig import planned_rig
        >>> localize = Localizer(planned_rig(), weights="all")
        >>> pixels = torch.tensor([[[960.0, 540.0], [944.0, 540.0]]]).double()
        >>> boxes, both = torch.cat([pixels - 5.0, pixels + 5.0], -1), torch.tensor([[0, 1]])
        >>> found = pair_costs(localize, both, pixels, boxes, AssociationOptions(), 100.0)
        >>> round(float(found.cost), 6), round(1.0 / float(found.inverse))
        (0.0, 1000)
    """
    errors = 0 if localize.errors is None else len(localize.errors)
    count = _PAIRS_AT_ONCE // (16 + 8 * errors) + 1
    if len(cameras) > count:
        each = zip(cameras.split(count), pixels.split(count), boxes.split(count), strict=True)
        parts = [pair_costs(localize, *some, options, nearest) for some in each]
        return PairCosts(*(torch.cat(values) for values in zip(*parts, strict=True)))
    which, place = np.unique(cameras.numpy(), return_inverse=True)
    at = torch.from_numpy(place).reshape(-1, 2).to(pixels.device)
    rows = torch.arange(len(cameras), device=pixels.device)[:, None]
    spread = pixels.new_zeros(len(cameras), len(which), 2).index_put((rows, at), pixels)
    seen = torch.zeros(spread.shape[:2], dtype=torch.bool, device=pixels.device)
    seen[rows, at] = True
    found = fit_some(localize, which.tolist(), spread, seen, options.box_sigma)
    fit = found.fit
    total = found.chi2
    length = fit.direction.square().sum(0).sqrt()
    inverse = fit.inverse / (found.scale * length)
    variance = found.variance * fit.covariance[5]
    known = variance.detach() > 0
    sigma = torch.where(known, torch.where(known, variance, 1.0).sqrt() / (found.scale * length), 0.0)
    beyond = (1.0 / options.farthest - inverse).clamp_min(0.0)
    before = (inverse - 1.0 / nearest).clamp_min(0.0) if nearest else torch.zeros_like(inverse)
    total = total + (torch.maximum(beyond, before) / torch.where(known, sigma, 1.0)).square()
    magnified = torch.stack([torch.linalg.vector_norm(p.by_point, dim=(-3, -2)) for p in fit.projections], 1)
    rays = found.rays[rows, at]
    parallax = torch.linalg.vector_norm(torch.linalg.cross(rays[:, 0], rays[:, 1]), dim=-1)
    total = total + size_cost(magnified[rows, at], boxes, options.box_sigma, parallax)
    # On different sides of the line that joins the cameras, lines of sight meet nowhere: a false optimum.
    apart = localize.rig.center[cameras[:, 1].to(rays.device)] - localize.rig.center[cameras[:, 0].to(rays.device)]
    along = (rays * apart[:, None]).sum(-1).prod(-1)
    one_side = apart.square().sum(-1) * (rays[:, 0] * rays[:, 1]).sum(-1) > along
    good = found.fitted & one_side & known & (found.used.sum(-1) == 2)
    return PairCosts(torch.where(good, total, torch.inf), inverse, sigma)


def size_cost(magnified: Tensor, boxes: Tensor, box_sigma: float, parallax: Tensor) -> Tensor:
    """(L,) squared standard deviations between the sizes of boxes (L, 2, 4), given how much cameras magnify (L, 2).

    `parallax` (L,): sine of the angle between the lines of sight. From another side, an object may have another size.
    """
    sizes = boxes[..., 2:] - boxes[..., :2]
    ratio = (sizes[:, 0] / sizes[:, 1]).log() - (magnified[:, 0] / magnified[:, 1]).log()[:, None]
    # Middles of boxes err by box_sigma, so edges by √2 and sizes by twice as much.
    spread = (2.0 * box_sigma / sizes).square().sum(1) + _SIZE_SPREAD**2 + parallax.square()[:, None]
    return (ratio.square() / spread).sum(-1)


# Which detection of the left image is which of the right one: geometry, size, category and looks, one to one.
#
# Pairs near one epipolar line get their most likely point, at once on tensors. What no
# point explains is the epipolar error; it is judged by the noise of the boxes and by what is not known of the rig. The
# assignment with the least sum of costs is exact (`kcal.pipeline.assignment`); a detection may stay alone.

# Spread of 1 - correlation between two views of one object; of two objects it is 0.5 to 1.
_LOOKS_SPREAD = 0.25
# Samples across a box, and how far patches may be shifted against each other, in samples: boxes err by that.
_SAMPLES = 16
_SHIFT = 4
# Of one image: more are a detector's fault, and their pairs grow with the square.
MOST_BOXES = 2000


@briefly
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
    rig: Rig,
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


@briefly
@exportable
class BoxPairs(NamedTuple):
    """Pairs of boxes of B time steps; nothing in it is NaN.

    Attributes:
        match: (B, K) int64, number of the right box of each left one, -1 where it has none.
        mask: (B, K) bool, which left boxes have one.
        score: (B, K) exp(-cost / 2), the likelihood beside that of a perfect pair; 0 where there is none.
        ambiguous: (B, K) bool: another pairing is about as likely.
        left: (B, K, 2) what stands for the left boxes, for `Localizer`; the image's middle where `mask` is False.
        right: (B, K, 2) likewise of their right boxes.
    """

    match: Tensor
    mask: Tensor
    score: Tensor
    ambiguous: Tensor
    left: Tensor
    right: Tensor


class PairBoxes(StatedModule):
    """Pair the boxes of both images, for a batch of time steps: `associate` as a module between detector and localizer.

    Matches are those of `associate`, each time step alone. Pixels and scores are differentiable by the boxes, with the
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

    def __init__(self, rig: Rig, options: AssociationOptions | None = None) -> None:
        super().__init__()
        check_single(rig.names, rig.each, "PairBoxes")
        self.rig, self.options = rig, options or AssociationOptions()
        if isinstance(self.options.anchor, int):
            raise InputError("PairBoxes: boxes have no keypoints; anchor 'center' or 'bottom' is needed")

    @property
    def constants(self) -> object:
        """Options."""
        return self.options

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
        if torch.compiler.is_compiling():
            # As a decorator it would load the compiler, 1.6 s, in every program that pairs boxes.
            return torch.compiler.disable(self.forward)(left, right, mask_left, mask_right, kinds=kinds, images=images)
        first = _sound_boxes("left boxes", left, mask_left, self.rig.left.size)
        second = _sound_boxes("right boxes", right, mask_right, self.rig.right.size)
        boxes, masks = zip(first, second, strict=True)
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
            fitted = _costs(_unplaced(still(self.rig)), pixels, both, self.options, _nearest(self.rig, self.options))
            cost = cost + torch.nan_to_num(fitted - fitted.detach())
        middles = [0.5 * (score.new_tensor(camera.size) - 1.0) for camera in (self.rig.left, self.rig.right)]
        seen = [middle.expand(*mask.shape, 2).index_put((moments, rows), pixel)
                for middle, pixel in zip(middles, pixels.unbind(1), strict=True)]  # fmt: skip
        score = score.index_put((moments, rows), (-0.5 * cost).exp())
        return BoxPairs(found.match, mask, score, found.ambiguous, *seen)


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
    """Of B time steps: right boxes (B, N) or -1, doubts (B, N), costs (B, N, M), and which pairs were possible."""

    match: Tensor
    ambiguous: Tensor
    cost: Tensor
    possible: Tensor


@torch.no_grad()
def _paired(
    rig: Rig,
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
    localize, nearest = _unplaced(rig), _nearest(rig, options)
    near = near & near_lines(localize, anchors, options, nearest)
    cost = torch.full_like(near, torch.inf, dtype=torch.float64)
    moments, rows, columns = near.nonzero(as_tuple=True)
    if len(rows):
        both = [torch.stack([one[moments, rows], other[moments, columns]], 1) for one, other in (anchors, boxes)]
        cost[moments, rows, columns] = _costs(localize, both[0], both[1], options, nearest)
    if images is not None:
        shapes = [some.shape for some in images]
        if shapes != [(len(near), *camera.size[::-1]) for camera in (rig.left, rig.right)]:
            raise InputError("association: images of the cameras' sizes are needed, one of each for each time step")
        for one, first, second, left, right in zip(cost, *boxes, *images, strict=True) if len(rows) else ():
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


def _unplaced(rig: Rig) -> Localizer:
    """With weights by all errors of two cameras; where their mast stands does not matter."""
    alone = copy.copy(rig)
    alone.mounting = None
    return Localizer(alone, weights="all")


def _costs(localize: Localizer, pixels: Tensor, boxes: Tensor, options: AssociationOptions, nearest: float) -> Tensor:
    """(L,) squared standard deviations, given pixels (L, 2, 2) and boxes (L, 2, 4) of left and right."""
    both = torch.tensor([0, 1]).expand(len(pixels), 2)
    return pair_costs(localize, both, pixels, boxes, options, nearest).cost


def _nearest(rig: Rig, options: AssociationOptions) -> float:
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
    return torch.where(norm > scale, products / torch.where(norm > scale, norm, 1.0), 0.0).amax((-2, -1)).T


def _patches(image: Tensor, boxes: Tensor, samples: int) -> Tensor:
    """(N, samples, samples) of the boxes; more samples than `_SAMPLES` reach beyond the box by as much."""
    height, width = image.shape
    at = (torch.arange(samples, dtype=image.dtype, device=image.device) - 0.5 * (samples - 1)) / _SAMPLES
    middle, size = 0.5 * (boxes[:, :2] + boxes[:, 2:]), boxes[:, 2:] - boxes[:, :2]
    x = middle[:, :1] + at * size[:, :1]
    y = middle[:, 1:] + at * size[:, 1:]
    across = (2.0 * x / (width - 1) - 1.0)[:, None].expand(-1, samples, -1)
    down = (2.0 * y / (height - 1) - 1.0)[:, :, None].expand(-1, -1, samples)
    grid = torch.stack([across, down], -1)
    # One tall grid, because the image is the same for all.
    sampled = torch.nn.functional.grid_sample(
        image[None, None], grid.reshape(1, -1, samples, 2), padding_mode="border", align_corners=True
    )
    return sampled.reshape(len(boxes), samples, samples)
