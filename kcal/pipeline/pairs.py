"""Objects that several cameras see at one moment: `ObjectPairs`, and views of any number of cameras."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.checks import as_points, require_finite
from kcal.errors import InputError
from kcal.texts import brief

# `ObjectViews`: objects of one moment, each with its pixels in those of a rig's cameras that saw it.


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectViews:
    """Objects of one moment, seen by any of V cameras: what a tracker takes in.

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

    def __post_init__(self) -> None:
        count, cameras = len(self.category), self.seen.shape[-1]
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


# `ObjectPairs`: objects that both cameras of a rig see at one moment.


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectPairs:
    """Objects of one moment, each with its pixels in both images: from association and matching to tracks.

    Args:
        left: (N, 2) pixels of the left camera's full image.
        right: (N, 2) pixels of the right camera's full image.
        covariance: (N, 4, 4) of (u_left, v_left, u_right, v_right), px².
        time: (N, 2) seconds at which the left and the right image were exposed, float64.
        score: (N,) of the detections.
        category: N names.
        track: N names that the detector's own tracker gave, or None.
        ambiguous: (N,) bool: another pairing is about as likely.

    Raises:
        InputError: shapes or lengths that do not fit each other, values that are not finite, or a matrix that is not
            a covariance.

    Example:
        >>> pair = ObjectPairs(left=torch.tensor([[960.0, 540.0]]), right=torch.tensor([[944.0, 540.0]]),
        ...                    covariance=0.01 * torch.eye(4)[None], time=torch.zeros(1, 2).double(),
        ...                    score=torch.ones(1), category=("ship",), track=(None,),
        ...                    ambiguous=torch.zeros(1, dtype=torch.bool))
        >>> len(pair), pair.left.dtype
        (1, torch.float64)
    """

    __repr__ = brief

    left: Tensor
    right: Tensor
    covariance: Tensor
    time: Tensor
    score: Tensor
    category: tuple[str, ...]
    track: tuple[str | None, ...]
    ambiguous: Tensor

    def __post_init__(self) -> None:
        for name, last in (("left", (2,)), ("right", (2,)), ("covariance", (4, 4)), ("time", (2,)), ("score", ())):
            value = getattr(self, name)
            if name == "time" and isinstance(value, Tensor) and value.dtype != torch.float64:
                raise InputError(f"time: float64 is needed, got {value.dtype}; seconds lose milliseconds in float32")
            value = as_points(name, value, last[-1] if last else len(self.category))
            if value.shape != (len(self.category), *last):
                wanted = (len(self.category), *last)
                raise InputError(f"{name}: shape {wanted} is needed for its objects, got {tuple(value.shape)}")
            require_finite(name, value)
            object.__setattr__(self, name, value)
        if len(self.track) != len(self):
            raise InputError(f"track: {len(self)} names or None are needed, got {len(self.track)}")
        if self.ambiguous.dtype != torch.bool or self.ambiguous.shape != (len(self),):
            raise InputError(f"ambiguous: bool of shape ({len(self)},) is needed, got {tuple(self.ambiguous.shape)}")
        _require_covariances(self.covariance.detach())

    def __len__(self) -> int:
        return len(self.category)

    @property
    def views(self) -> ObjectViews:
        """The same as objects of a rig of two cameras."""
        return ObjectViews(
            pixels=torch.stack([self.left, self.right], 1),
            seen=torch.ones(len(self), 2, dtype=torch.bool, device=self.left.device),
            covariance=self.covariance,
            time=self.time,
            score=self.score,
            category=self.category,
            ambiguous=self.ambiguous,
        )

    @classmethod
    def from_matches(
        cls,
        matches: Mapping[str, Tensor],
        *,
        pixel_sigma: float = 1.0,
        time: tuple[float, float] = (0.0, 0.0),
        category: str = "point",
    ) -> ObjectPairs:
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
            >>> ObjectPairs.from_matches(found).right.tolist()
            [[944.0, 540.0]]
        """
        missing = [key for key in ("keypoints0", "keypoints1", "confidence") if key not in matches]
        if missing:
            raise InputError(f"matches: {missing[0]} is missing; the dictionary of a matcher of kornia is needed")
        if not 0 < pixel_sigma < math.inf:
            raise InputError(f"pixel_sigma: a positive number of pixels is needed, got {pixel_sigma}")
        if bool((matches.get("batch_indexes", torch.zeros(1)) != 0).any()):
            raise InputError("matches: one pair of images at a time is needed; `matched_pixels` takes a batch")
        count, place = len(matches["keypoints0"]), matches["keypoints0"].device
        return cls(
            left=matches["keypoints0"],
            right=matches["keypoints1"],
            covariance=(pixel_sigma**2 * torch.eye(4, dtype=torch.float64, device=place)).expand(count, 4, 4),
            time=torch.tensor(time, dtype=torch.float64, device=place).expand(count, 2),
            score=matches["confidence"],
            category=(category,) * count,
            track=(None,) * count,
            ambiguous=torch.zeros(count, dtype=torch.bool, device=place),
        )


class PixelPairs(NamedTuple):
    """Matches of a batch of B pairs of images, padded to K each, for `StereoLocalizer(left, right, mask=mask)`.

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
    missing = [key for key in ("keypoints0", "keypoints1", "confidence", "batch_indexes") if key not in matches]
    if missing:
        raise InputError(f"matches: {missing[0]} is missing; the dictionary of a matcher of kornia is needed")
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
