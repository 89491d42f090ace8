"""Objects that cameras see at one time, and how detections and all their pixels become pairs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import kcal.corners.patches as patches
from kcal.checks import StatedModule, as_points, as_tensor, exportable, require_finite
from kcal.corners.match import MatchStatus
from kcal.dispatch import still
from kcal.errors import InputError
from kcal.lens.rig import Rig
from kcal.locate.stereo import flagged
from kcal.pipeline.association import AssociationOptions, associate
from kcal.pipeline.detections import Detections
from kcal.texts import brief, briefly

# `ObjectViews`: objects of one time step, each with its pixels in those of a rig's cameras that saw it.


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectViews:
    """Objects of one time step, seen by any of V cameras: the input of a tracker.

    Several rows may have the same mark: the tracker then settles whose it is. A row with one camera alone is a bearing:
    it continues a track and begins none.

    Args:
        pixels: (N, V, 2) of each camera's full image, in the order of the rig's cameras; what is NaN was not seen.
        seen: (N, V) bool.
        covariance: (N, 2 V, 2 V) of (u, v) of all cameras in turn, px²; what was not seen does not matter.
        time: (N, V) seconds at which the images were exposed, float64.
        score: (N,) of the detections.
        category: N names.
        ambiguous: (N,) bool: another grouping is about as likely.
        track: N names that the detector's own tracker gave, or None; none if left out.

    Raises:
        InputError: shapes that do not fit each other, or times that are not finite where something was seen.

    Example:
        >>> views = ObjectViews(pixels=torch.zeros(1, 3, 2), seen=torch.tensor([[True, False, True]]),
        ...                     covariance=torch.eye(6)[None], time=torch.zeros(1, 3).double(),
        ...                     score=torch.ones(1), category=("smoke",), ambiguous=torch.zeros(1, dtype=torch.bool))
        >>> len(views), views.cameras
        (1, 3)
    """

    __repr__ = brief

    pixels: Tensor
    seen: Tensor
    covariance: Tensor
    time: Tensor
    score: Tensor
    category: tuple[str, ...]
    ambiguous: Tensor
    track: tuple[str | None, ...] = ()

    def __post_init__(self) -> None:
        count, cameras = len(self.category), self.seen.shape[-1]
        if len(self.track) not in (0, count):
            raise InputError(f"track: {count} names or None are needed, got {len(self.track)}")
        object.__setattr__(self, "track", self.track or (None,) * count)
        wanted = {
            "pixels": (count, cameras, 2), "seen": (count, cameras), "time": (count, cameras), "score": (count,),
            "covariance": (count, 2 * cameras, 2 * cameras), "ambiguous": (count,),
        }  # fmt: skip
        for name, shape in wanted.items():
            value = getattr(self, name)
            if tuple(value.shape) != shape:
                raise InputError(f"{name}: shape {shape} is needed for its objects, got {tuple(value.shape)}")
        for name in ("seen", "ambiguous"):
            if getattr(self, name).dtype != torch.bool:
                raise InputError(f"{name}: bool is needed, got {getattr(self, name).dtype}")
        if self.time.dtype != torch.float64:
            raise InputError(f"time: float64 is needed, got {self.time.dtype}; seconds lose milliseconds in float32")
        for name, last in (("pixels", 2), ("covariance", 2 * cameras)):
            object.__setattr__(self, name, as_points(name, getattr(self, name), last))
        # What is not finite was not seen: one such row loses no other.
        finite = torch.isfinite(self.pixels).all(-1)
        own = self.covariance.diagonal(dim1=-2, dim2=-1).unflatten(-1, (cameras, 2))
        object.__setattr__(self, "seen", self.seen & finite & torch.isfinite(own).all(-1))
        if not bool(torch.isfinite(self.time[self.seen]).all()):
            raise InputError("time: finite seconds are needed where something was seen")

    def __len__(self) -> int:
        return len(self.category)

    @property
    def cameras(self) -> int:
        """V."""
        return int(self.seen.shape[-1])

    @property
    def left(self) -> Tensor:
        """(N, 2) pixels of the first camera."""
        return self.pixels[:, 0]

    @property
    def right(self) -> Tensor:
        """(N, 2) pixels of the last camera."""
        return self.pixels[:, -1]

    @classmethod
    def of_pairs(
        cls,
        left: Tensor,
        right: Tensor,
        *,
        covariance: Tensor,
        time: Tensor,
        score: Tensor,
        category: tuple[str, ...],
        ambiguous: Tensor | None = None,
        track: tuple[str | None, ...] = (),
    ) -> ObjectViews:
        """Objects that both cameras of a rig see.

        Args:
            left: (N, 2) pixels of the left camera's full image.
            right: (N, 2) pixels of the right camera's full image.
            covariance: (N, 4, 4) of (u_left, v_left, u_right, v_right), px².
            time: (N, 2) seconds at which the left and the right image were exposed, float64.
            score: (N,) of the detections.
            category: N names.
            ambiguous: (N,) bool: another pairing is about as likely; none if left out.
            track: N names that the detector's own tracker gave, or None.

        Raises:
            InputError: shapes that do not fit each other, values that are not finite, or a matrix that is not a
                covariance.

        Example:
            >>> ship = ObjectViews.of_pairs(
            ...     torch.tensor([[960.0, 540.0]]), torch.tensor([[944.0, 540.0]]), covariance=torch.eye(4)[None],
            ...     time=torch.zeros(1, 2).double(), score=torch.ones(1), category=("ship",))
            >>> len(ship), ship.seen.tolist()
            (1, [[True, True]])
        """
        count, own = len(category), dict(left=left, right=right, covariance=covariance, time=time, score=score)
        for (name, value), last in zip(own.items(), ((2,), (2,), (4, 4), (2,), ()), strict=True):
            if name == "time" and isinstance(value, Tensor) and value.dtype != torch.float64:
                raise InputError(f"time: float64 is needed, got {value.dtype}; seconds lose milliseconds in float32")
            own[name] = as_points(name, value, last[-1] if last else count)
            if own[name].shape != (count, *last):
                raise InputError(f"{name}: shape {(count, *last)} is needed for its objects, got {tuple(value.shape)}")
            require_finite(name, own[name])
        _require_covariances(own["covariance"].detach())
        pixels = torch.stack([own.pop("left"), own.pop("right")], 1)
        seen = torch.ones_like(pixels[..., 0], dtype=torch.bool)
        ambiguous = ~seen[:, 0] if ambiguous is None else ambiguous
        return cls(pixels=pixels, seen=seen, category=category, ambiguous=ambiguous, track=track, **own)

    @classmethod
    def from_matches(
        cls,
        matches: Mapping[str, Tensor],
        *,
        pixel_sigma: float = 1.0,
        time: tuple[float, float] = (0.0, 0.0),
        category: str = "point",
    ) -> ObjectViews:
        """Points that a matcher of kornia found in both full images, for example LoFTR or `LocalFeatureMatcher`.

        Args:
            matches: `keypoints0` and `keypoints1` (N, 2) of the left and right image, `confidence` (N,), as the
                matcher returned them. Kornia counts pixels from the center of the first one, as kcal does.
            pixel_sigma: standard deviation of a keypoint along each axis, pixels.
            time: seconds at which the left and the right image were exposed.
            category: of all points.

        Raises:
            InputError: a key is missing, or matches of several pairs of images.

        Example:
            >>> found = {"keypoints0": torch.tensor([[960.0, 540.0]]), "keypoints1": torch.tensor([[944.0, 540.0]]),
            ...          "confidence": torch.tensor([0.9])}
            >>> ObjectViews.from_matches(found).right.tolist()
            [[944.0, 540.0]]
        """
        _require_keys(matches, "keypoints0", "keypoints1", "confidence")
        if not 0 < pixel_sigma < math.inf:
            raise InputError(f"pixel_sigma: a positive number of pixels is needed, got {pixel_sigma}")
        if bool((matches.get("batch_indexes", torch.zeros(1)) != 0).any()):
            raise InputError("matches: one pair of images at a time is needed; `matched_pixels` takes a batch")
        count, place = len(matches["keypoints0"]), matches["keypoints0"].device
        return cls.of_pairs(
            matches["keypoints0"],
            matches["keypoints1"],
            covariance=(pixel_sigma**2 * torch.eye(4, dtype=torch.float64, device=place)).expand(count, 4, 4),
            time=torch.tensor(time, dtype=torch.float64, device=place).expand(count, 2),
            score=matches["confidence"],
            category=(category,) * count,
        )


def _require_keys(matches: Mapping[str, Tensor], *keys: str) -> None:
    missing = [key for key in keys if key not in matches]
    if missing:
        raise InputError(f"matches: {missing[0]} is missing; the dictionary of a matcher of kornia is needed")


def mark_numbers(pixels: Tensor, seen: Tensor) -> NDArray[np.int64]:
    """(N, V) numbers of the marks of pixels (N, V, 2), -1 where nothing was seen: rows that share one share a mark.

    Example:
        >>> pixels = torch.tensor([[[1.0, 2.0], [1.0, 0.0]], [[1.0, 2.0], [2.0, 0.0]]])
        >>> mark_numbers(pixels, torch.ones(2, 2, dtype=torch.bool)).tolist()
        [[0, 0], [0, 1]]
    """
    numbers = []
    for marks, there in zip(pixels.unbind(1), seen.T.tolist(), strict=True):
        known: dict[tuple[float, ...], int] = {}
        rows = zip(marks.tolist(), there, strict=True)
        numbers.append([known.setdefault(tuple(mark), len(known)) if one else -1 for mark, one in rows])
    return np.array(numbers, dtype=np.int64).reshape(len(numbers), len(pixels)).T


@briefly
class PixelPairs(NamedTuple):
    """Matches of a batch of B pairs of images, padded to K each, for `Localizer(left, right, mask=mask)`.

    Attributes:
        left: (B, K, 2) pixels of the left images; 0 where `mask` is False.
        right: (B, K, 2) likewise.
        score: (B, K) as the matcher has it; 0 where there is none.
        mask: (B, K) bool.
    """

    left: Tensor
    right: Tensor
    score: Tensor
    mask: Tensor


def matched_pixels(matches: Mapping[str, Tensor], batch: int) -> PixelPairs:
    """Matches of kornia's `LoFTR` or `LocalFeatureMatcher` as padded batches, in the graph of the keypoints.

    For descriptors that were matched one pair of images at a time, give `lafs0`, `lafs1` (1, N, 2, 3) and `idxs` (M, 2)
    as `kornia.feature.match_smnn` returns them: each is then a match of image 0.

    Args:
        matches: `keypoints0` and `keypoints1` (M, 2), `confidence` (M,), `batch_indexes` (M,); or `lafs0`, `lafs1`,
            `idxs` and, if there are any, `confidence`.
        batch: B, how many pairs of images there were.

    Raises:
        InputError: a key is missing, or a match of an image beyond the batch.

    Example:
        >>> found = {"keypoints0": torch.tensor([[9.0, 5.0], [7.0, 6.0], [3.0, 2.0]]), "keypoints1": torch.rand(3, 2),
        ...          "confidence": torch.tensor([0.9, 0.8, 0.7]), "batch_indexes": torch.tensor([1, 0, 1])}
        >>> pairs = matched_pixels(found, 2)
        >>> pairs.mask.tolist(), pairs.left[1].tolist()
        ([[True, False], [True, True]], [[9.0, 5.0], [3.0, 2.0]])
    """
    if "idxs" in matches:
        numbers = matches["idxs"]
        centers = [matches[name][0, :, :, 2] for name in ("lafs0", "lafs1") if name in matches]
        if len(centers) != 2:
            raise InputError("matches: idxs need lafs0 and lafs1, (1, N, 2, 3) each")
        left, right = (center[numbers[:, side]] for side, center in enumerate(centers))
        own = {"confidence": torch.ones_like(left[:, 0]), **matches, "keypoints0": left, "keypoints1": right}
        matches = {**own, "batch_indexes": torch.zeros_like(numbers[:, 0])}
    _require_keys(matches, "keypoints0", "keypoints1", "confidence", "batch_indexes")
    image = matches["batch_indexes"].long()
    if bool(((image < 0) | (image >= batch)).any()):
        raise InputError(f"matches: batch_indexes reach {int(image.max())}; the batch has {batch} pairs of images")
    of = image[:, None] == torch.arange(batch, device=image.device)
    # How many matches of the same image come before.
    place = (of.cumsum(0) - 1).gather(1, image[:, None])[:, 0]
    most = int(of.sum(0).max()) if batch else 0

    def padded(name: str, last: int) -> Tensor:
        values = as_points(name, matches[name].reshape(-1, last), last)
        return values.new_zeros(batch, most, last).index_put((image, place), values)

    mask = torch.zeros(batch, most, dtype=torch.bool, device=image.device)
    mask[image, place] = True
    return PixelPairs(padded("keypoints0", 2), padded("keypoints1", 2), padded("confidence", 1)[..., 0], mask)


def _require_covariances(covariance: Tensor) -> None:
    """Raise unless every one of (N, 4, 4) is symmetric without a negative eigenvalue."""
    scale = covariance.diagonal(dim1=-2, dim2=-1).amax(-1).clamp_min(torch.finfo(torch.float64).tiny)
    unit = covariance / scale[:, None, None]
    lopsided = (unit - unit.mT).abs().amax((-2, -1)) > 1e-9 if len(unit) else unit.new_zeros(0, dtype=torch.bool)
    bad = lopsided | (torch.linalg.eigvalsh(unit).amin(-1) < -1e-9)
    if bool(bad.any()):
        raise InputError(
            f"covariance: {int(bad.sum())} of {len(bad)} are not symmetric or have a negative eigenvalue, first "
            f"number {int(bad.nonzero()[0])}"
        )


# `pair_objects`: from detections of both images to pairs of pixels, and `ObjectDisparity` from all their pixels.

# `ObjectDisparity`: where an object of the left image is in the right one, from all its pixels, to a fraction of one.
#
# The box or mask of the left image says which pixels count. They are compared on a common plane
# (`kcal.corners.patches`): correlation finds the shift, and a least-squares fit with contrast and brightness
# refines it (W. Förstner 1982; F. Ackermann, "Digital image correlation", 1984). Pixels that do not fit, of the
# background or of what stands in front, lose their weight (J. W. Tukey's biweight).

# Steps of a patch from its middle at most; larger objects get steps of powers of two pixels.
_LARGEST_HALF = 24
# Radii of the ellipse in a box, in halves of its sides, between which the weight falls from one to zero.
_FULL, _NONE = 0.85, 1.15


@dataclass(frozen=True, kw_only=True)
class DisparityOptions:
    """Options of `ObjectDisparity`.

    Args:
        search: pixels along the epipolar line, to each side of the right anchor, that are searched.
        max_off_line: largest accepted distance from the epipolar line, pixels.
        min_score: smallest accepted correlation.
        max_rival: largest accepted ratio of another place's correlation to the best one.
        max_sigma: largest accepted standard deviation of the disparity, pixels.
        min_share: smallest share of the object that must be seen unhidden and unsaturated in both images.
        brightest: gray level from which a pixel is saturated; that of the image's dtype if None, and none for floating
            point.

    Raises:
        InputError: a value out of range.
    """

    search: float = 9.0
    max_off_line: float = 2.0
    min_score: float = 0.6
    max_rival: float = 0.95
    max_sigma: float = 0.5
    min_share: float = 0.5
    brightest: float | None = None

    def __post_init__(self) -> None:
        if not (1 <= self.search <= 200 and 0 < self.max_off_line <= 20 and 0 < self.max_sigma < math.inf):
            raise InputError("disparity options: search 1 to 200 px, max_off_line up to 20 px, positive max_sigma")
        if not all(0 < share <= 1 for share in (self.min_score, self.max_rival, self.min_share)):
            raise InputError("disparity options: min_score, max_rival and min_share lie between 0 and 1")


@briefly
@exportable
class ObjectDisparities(NamedTuple):
    """Objects found in the right image; nothing in it is NaN.

    Attributes:
        pixels: (N, 2) float64 in the right image, of what is at the left anchors; the right anchors unless GOOD.
        covariance: (N, 2, 2) px² of `pixels`, given the left anchors; an infinite diagonal unless GOOD.
        status: (N,) int64 of `MatchStatus`.
        score: (N,) best correlation, -1 to 1; 0 where there is none.
        off_line: (N,) px, distance from the epipolar line; 0 where there is none.
        by_anchor: (N, 2, 2) derivatives of `pixels` by the left anchors.
    """

    pixels: Tensor
    covariance: Tensor
    status: Tensor
    score: Tensor
    off_line: Tensor
    by_anchor: Tensor


class ObjectDisparity(StatedModule):
    """Match the image inside boxes: the module between a detector's boxes and `Localizer`.

    Gradients of `pixels` reach both images by the implicit function theorem; the scale of the biweight, the rig and the
    boxes count as constants. The other results carry none.

    Args:
        rig: the calibrated cameras.
        options: see `DisparityOptions`.

    Example:
        >>> from kcal.rig import planned_rig
        >>> texture = torch.rand(135, 240, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        >>> left = torch.nn.functional.interpolate(255 * texture[None, None], scale_factor=8, mode="bicubic")[0, 0]
        >>> match = ObjectDisparity(planned_rig())
        >>> boxes = torch.tensor([[939.5, 519.5, 963.5, 543.5]])
        >>> found = match(left, left.roll(-16, 1), boxes, torch.tensor([[934.0, 532.0]]))  # a box is off by 1.5 px
        >>> [round(value, 2) for value in found.pixels[0].tolist()], MatchStatus(int(found.status[0])).name
        ([935.5, 531.5], 'GOOD')
    """

    def __init__(self, rig: Rig, options: DisparityOptions | None = None) -> None:
        super().__init__()
        self.rig = rig
        self.options = options or DisparityOptions()

    def forward(
        self,
        left: Tensor,
        right: Tensor,
        boxes: Tensor,
        anchors_right: Tensor,
        *,
        anchors_left: Tensor | None = None,
        masks: Tensor | None = None,
    ) -> ObjectDisparities:
        """Find the objects of the left image in the right one.

        Args:
            left: (H, W) gray levels of the left camera.
            right: (H, W) of the right camera.
            boxes: (N, 4) left, top, right, bottom edge in the left image.
            anchors_right: (N, 2) roughly where the boxes' middles are in the right image: the middles of its boxes.
            anchors_left: (N, 2) points of the left image, as far away as the objects, that are wanted in the right one;
                the middles of the boxes if left out.
            masks: (N, H, W) bool of the left image, in place of an ellipse in each box.

        Raises:
            InputError: images that do not fit the cameras or are not finite, or shapes that are wrong or unlike.
        """
        boxes, aims = as_points("boxes", boxes, 4).detach(), as_points("anchors_right", anchors_right, 2).detach()
        middle = 0.5 * (boxes[..., :2] + boxes[..., 2:])
        starts = middle if anchors_left is None else as_points("anchors_left", anchors_left, 2).detach()
        if boxes.ndim != 2 or aims.shape != middle.shape or starts.shape != middle.shape:
            raise InputError(
                f"boxes (N, 4) and anchors (N, 2) are needed, got {tuple(boxes.shape)}, {tuple(aims.shape)} and "
                f"{tuple(starts.shape)}"
            )
        for word, image, camera in (("left", left, self.rig.left), ("right", right, self.rig.right)):
            require_finite(f"{word} image", as_tensor(f"{word} image", image).detach())
            if tuple(image.shape) != camera.size[::-1]:
                raise InputError(
                    f"{word} image {tuple(image.shape)}: the {word} camera needs (H, W) = {camera.size[::-1]}"
                )
        wanted = (len(boxes), *self.rig.left.size[::-1])
        if masks is not None and tuple(masks.shape) != wanted:
            raise InputError(f"masks: shape {wanted} is needed, got {tuple(masks.shape)}")
        found = ObjectDisparities(
            pixels=aims.clone(),
            covariance=torch.diag(aims.new_full((2,), math.inf)).repeat(len(aims), 1, 1),
            status=torch.full((len(aims),), int(MatchStatus.NO_RAY), device=aims.device),
            score=aims.new_zeros(len(aims)),
            off_line=aims.new_zeros(len(aims)),
            by_anchor=torch.eye(2).to(aims).repeat(len(aims), 1, 1),
        )
        finite = (boxes.isfinite().all(-1) & aims.isfinite().all(-1) & starts.isfinite().all(-1)).nonzero()[:, 0]
        size = (boxes[:, 2:] - boxes[:, :2]).amax(-1)
        halves = (0.5 * _NONE * size).clamp_min(3.0)
        levels = (halves / _LARGEST_HALF).log2().ceil().clamp_min(0.0)
        for level in levels[finite].unique().tolist():
            chosen = finite[levels[finite] == level]
            own = None if masks is None else masks[chosen]
            half = math.ceil(float(halves[chosen].max()) / 2**level)
            part = _Objects(boxes[chosen], middle[chosen], starts[chosen], aims[chosen], own, half, int(level))
            done = self._match(left, right, part)
            both = zip(found, done, strict=True)
            found = ObjectDisparities(*(whole.index_put((chosen,), some) for whole, some in both))
        return found

    def _match(self, left: Tensor, right: Tensor, objects: _Objects) -> ObjectDisparities:
        rig, options, level = still(self.rig), self.options, objects.level
        device = objects.boxes.device
        rotation = rig.right_from_left_rotation
        with torch.no_grad():
            planes = patches.object_planes(rig, objects.left, objects.right, torch.full_like(objects.left[:, 0], level))
            step = planes.step[:, None, None, None]
            grid = patches.grid_of((objects.half,) * 2, device)
            here, seen = patches.plane_pixels(rig.left, planes, planes.left[:, None, None] + step * grid)
            here = torch.where(seen[..., None], here, objects.left[:, None, None])
            search = math.ceil(options.search / 2**level) + 1, math.ceil(options.max_off_line / 2**level) + 1
            wide = patches.grid_of((objects.half + search[0], objects.half + search[1]), device)
            # On the epipolar line: the row of the left anchor.
            aim = torch.stack([planes.right[:, 0], torch.zeros_like(planes.step)], -1)
            there, shown = patches.plane_pixels(rig.right, planes, aim[:, None, None] + step * wide, rotation)
            there = torch.where(shown[..., None], there, objects.right[:, None, None])
        first = patches.image_windows(left, here, level, _brightest(left, options))
        second = patches.image_windows(right, there, level, _brightest(right, options))
        template = patches.sample(first, here)
        with torch.no_grad():
            base = objects.weight(here) * (seen & patches.has_samples(first, here))
            outside = planes.valid & (base.sum((1, 2)) < options.min_share * objects.weight(here).sum((1, 2)))
            saturated = (patches.sample(first, here, saturated=True) > 0.02) & (base > 0)
            clear = torch.where(saturated, 0.0, base)
            usable = shown & patches.has_samples(second, there)
            scores = patches.weighted_correlation(template, clear, patches.sample(second, there), usable)
            _, best, score, rival, edge = patches.highest_peak(scores, patches.grid_of(search, device))
            start = aim + planes.step[:, None] * best
            beyond = patches.grid_of((objects.half + 1,) * 2, device)
            places, _ = patches.plane_pixels(rig.right, planes, start[:, None, None] + step * beyond, rotation)
            moved = places[:, 1:-1, 1:-1]
            slopes = patches.slopes_of(places)
            saturated |= (patches.sample(second, moved, saturated=True) > 0.02) & (base > 0)
            weight = torch.where(saturated | ~patches.has_samples(second, moved), 0.0, base)
            wanted, named = patches.plane_places(rig.left, planes, objects.anchors)
            bright = (base * saturated).sum((1, 2)) / base.sum((1, 2)).clamp_min(1e-12)
            searched = (scores > -1.0).flatten(1).any(1)
            textured = patches.is_textured(template, weight)
            # What is named last counts first.
            status = flagged(
                torch.full_like(score, int(MatchStatus.GOOD), dtype=torch.int64),
                (rival > options.max_rival * score, MatchStatus.AMBIGUOUS),
                (edge | (score < options.min_score), MatchStatus.NO_MATCH),
                (~textured, MatchStatus.FLAT),
                (bright > 1.0 - options.min_share, MatchStatus.SATURATED),
                (outside | ~searched & textured, MatchStatus.OUTSIDE),
                (~(planes.valid & named), MatchStatus.NO_RAY),
            )
            found = status == int(MatchStatus.GOOD)
        fit = patches.fit_shifts(template, second, moved, slopes, weight, found)
        column = start + planes.step[:, None] * fit.shift
        pixels, _ = patches.plane_pixels(rig.right, planes, (wanted + column - planes.left)[:, None], rotation)
        with torch.no_grad():
            at = objects.half
            middle = slopes[:, at, at]
            covariance = middle @ fit.covariance @ middle.mT
            own = patches.slopes_of(here[:, at - 1 : at + 2, at - 1 : at + 2])[:, 0, 0]
            by_anchor = middle @ torch.linalg.inv_ex(own)[0]
            off_line = (column[:, 1] / planes.step).abs() * 2**level
            sigma = covariance.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
            status = flagged(
                status,
                (found & (off_line > options.max_off_line), MatchStatus.OFF_LINE),
                (found & ~(sigma < options.max_sigma), MatchStatus.FLAT),
                (found & (fit.share < options.min_share), MatchStatus.OCCLUDED),
                (found & ~fit.converged, MatchStatus.NOT_CONVERGED),
            )
            good = status == int(MatchStatus.GOOD)
            score = torch.where(score > -1.0, score, 0.0)
            infinite = torch.diag(covariance.new_full((2,), math.inf))
            covariance = torch.where(good[:, None, None], covariance, infinite)
        return ObjectDisparities(
            torch.where(good[:, None], pixels[:, 0], objects.right), covariance, status, score,
            torch.where(good, off_line, 0.0), torch.where(good[:, None, None], by_anchor, torch.eye(2).to(by_anchor)),
        )  # fmt: skip

    @property
    def constants(self) -> object:
        """Options."""
        return self.options


class _Objects(NamedTuple):
    """Objects of one level of blur: boxes, middles, left anchors, right middles, masks; patches reach `half` steps."""

    boxes: Tensor
    left: Tensor
    anchors: Tensor
    right: Tensor
    masks: Tensor | None
    half: int
    level: int

    def weight(self, pixels: Tensor) -> Tensor:
        """(N, h, w) how much pixels (N, h, w, 2) of the left image belong to the object, 0 to 1."""
        if self.masks is not None:
            height, width = self.masks.shape[1:]
            column = pixels[..., 0].round().long().clamp(0, width - 1)
            row = pixels[..., 1].round().long().clamp(0, height - 1)
            number = torch.arange(len(pixels), device=pixels.device)[:, None, None]
            return self.masks[number, row, column].double()
        middle = 0.5 * (self.boxes[:, :2] + self.boxes[:, 2:])[:, None, None]
        half = 0.5 * (self.boxes[:, 2:] - self.boxes[:, :2])[:, None, None]
        radius = torch.linalg.vector_norm((pixels - middle) / half, dim=-1)
        return ((_NONE - radius) / (_NONE - _FULL)).clamp(0.0, 1.0)


def _brightest(image: Tensor, options: DisparityOptions) -> float:
    if options.brightest is not None:
        return options.brightest
    return math.inf if image.dtype.is_floating_point else float(torch.iinfo(image.dtype).max)


# `pair_objects`: from the detections of both images to pairs of pixels with covariance, in one call.


def pair_objects(
    rig: Rig,
    left: Detections,
    right: Detections,
    images: tuple[Tensor, Tensor] | None = None,
    *,
    options: AssociationOptions | None = None,
    disparity: ObjectDisparity | None = None,
) -> ObjectViews:
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
        upper = torch.cat([own.expand_as(slope), own @ slope.mT], -1)
        lower = torch.cat([slope @ own, slope @ own @ slope.mT + done.covariance], -1)
        shared = torch.cat([upper, lower], -2)
        covariance = torch.where(good[:, None, None], 0.5 * (shared + shared.mT), covariance)
    return ObjectViews.of_pairs(
        anchors,
        pixels,
        covariance=covariance,
        time=anchors.new_tensor([left.time or 0.0, right.time or 0.0]).expand(len(first), 2),
        score=torch.minimum(first.score, second.score),
        category=first.category,
        ambiguous=found.ambiguous,
        track=tuple(one or other for one, other in zip(first.track, second.track, strict=True)),
    )
