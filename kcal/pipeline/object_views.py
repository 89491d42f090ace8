"""`ObjectViews`: objects of one moment, each with its pixels in those of a rig's cameras that saw it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.checks import as_points
from kcal.errors import InputError
from kcal.texts import brief


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
