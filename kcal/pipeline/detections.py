"""`Detections`: boxes, masks and keypoints of one image, as detectors return them, in pixels of the full image."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from kcal.checks import as_points, require_finite
from kcal.errors import InputError
from kcal.lens.image_transform import ImageTransform
from kcal.pipeline.detectors import RawDetections, raw_detections
from kcal.texts import brief

Anchor = Literal["center", "bottom"] | int


@dataclass(frozen=True, kw_only=True, eq=False)
class Detections:
    """What a detector found in one image.

    Convention: pixel (0, 0) is the center of the first pixel, as everywhere in kcal. Detectors mostly count from the
    first pixel's upper left *edge*; `read` subtracts the half pixel.

    Tensors stay on the device and in the graph of what was read, so that a loss on positions reaches a detector's
    boxes and keypoints. Half precision is refused: it rounds a pixel near 1920 to 1 px.

    Args:
        boxes: (N, 4) left, top, right and bottom edge, pixels; floating point.
        score: (N,) confidence.
        category: N names.
        track: N names of the detector's own tracker, or None.
        keypoints: (N, K, 2) pixels, or None; what is not finite was not found.
        masks: (N, H, W) bool in the image's size, or None.
        size: (width, height) of the image.
        time: seconds at which the image was exposed; None for a single image.

    Raises:
        InputError: shapes or lengths that do not fit each other, values that are not finite, or a box without area.

    Example:
        >>> found = Detections.read(torch.tensor([[100.0, 50.0, 112.0, 62.0]]), size=(640, 480))
        >>> found.boxes.tolist(), found.anchors("bottom").tolist()
        ([[99.5, 49.5, 111.5, 61.5]], [[105.5, 61.5]])
    """

    __repr__ = brief

    boxes: Tensor
    score: Tensor
    category: tuple[str, ...]
    track: tuple[str | None, ...]
    keypoints: Tensor | None = None
    masks: Tensor | None = None
    size: tuple[int, int]
    time: float | None = None

    def __post_init__(self) -> None:
        count = len(self.category)
        boxes, score = as_points("boxes", self.boxes, 4), as_points("score", self.score, count)
        if boxes.shape != (count, 4) or score.shape != (count,) or len(self.track) != count:
            raise InputError(
                f"detections: {count} categories, but boxes {tuple(boxes.shape)}, score {tuple(score.shape)} and "
                f"{len(self.track)} tracks"
            )
        require_finite("boxes", boxes.detach())
        require_finite("score", score.detach())
        if not bool((boxes[:, 2:] > boxes[:, :2]).all()):
            number = int((boxes[:, 2:] <= boxes[:, :2]).any(-1).nonzero()[0])
            raise InputError(f"boxes: number {number}, {boxes[number].tolist()}, has no area; x1, y1, x2, y2 is needed")
        object.__setattr__(self, "boxes", boxes)
        object.__setattr__(self, "score", score)
        if self.keypoints is not None:
            points = as_points("keypoints", self.keypoints, 2)
            if points.ndim != 3 or len(points) != count:
                raise InputError(f"keypoints: shape ({count}, K, 2) is needed, got {tuple(points.shape)}")
            object.__setattr__(self, "keypoints", points)
        wanted = (count, self.size[1], self.size[0])
        if self.masks is not None and (self.masks.dtype != torch.bool or tuple(self.masks.shape) != wanted):
            raise InputError(f"masks: bool of shape {wanted} is needed, got {tuple(self.masks.shape)}")
        if self.time is not None and not abs(self.time) < float("inf"):
            raise InputError(f"time: seconds are needed, got {self.time}")

    def __len__(self) -> int:
        return len(self.category)

    @classmethod
    def read(
        cls,
        source: Any,
        *,
        size: tuple[int, int] | None = None,
        time: float | None = None,
        names: dict[int, str] | None = None,
        first_pixel: float = 0.5,
    ) -> Detections:
        """Detections of one image from what a detector returns; no other package is imported.

        Args:
            source: `Detections` of supervision, a dictionary of torchvision (`boxes`, `labels`, `scores`, `masks`,
                `keypoints`), one `Results` of ultralytics or what has its attributes (masks with `retina_masks=True`
                only), `Boxes` or `Keypoints` of kornia, an array or tensor (N, 4) to (N, 6) of x1, y1, x2, y2, score,
                class, or a line of JSON (see `kcal.pipeline.detectors`).
            size: (width, height) of the image, where the source does not say.
            time: seconds at which the image was exposed, where the source does not say.
            names: of classes, where the source has numbers only.
            first_pixel: what the detector calls the center of the first pixel: 0.5 for those that count from the
                image's edge, as all above do (kornia's keypoints count from the center, and are left as they are); 0
                for those that count from pixel centers.

        Raises:
            InputError: an unknown source, missing image size, or values that are no detections.

        Example:
            >>> line = '{"size": [640, 480], "time": 12.5, "boxes": [[100, 50, 112, 62]], "categories": ["ship"]}'
            >>> Detections.read(line).category
            ('ship',)
        """
        raw = raw_detections(source)
        count = len(raw.boxes)
        image_size = size or raw.size
        if image_size is None:
            raise InputError("detections: the image's size is needed; give size=(width, height)")
        if size is not None and raw.size is not None and tuple(size) != tuple(raw.size):
            raise InputError(f"detections: size {tuple(size)} was given, the source says {tuple(raw.size)}")
        masks = raw.masks
        if masks is not None and masks.dtype != torch.bool:
            masks = masks > 0.5  # torchvision's are probabilities
        if masks is not None and masks.ndim == 4:
            masks = masks[:, 0]
        return cls(
            boxes=raw.boxes - first_pixel,
            score=torch.ones_like(raw.boxes[:, 0]).detach() if raw.score is None else raw.score,
            category=_category_names(raw, count, names or {}),
            track=tuple(None if track is None else str(track) for track in raw.track or (None,) * count),
            keypoints=None if raw.keypoints is None else raw.keypoints - (0.0 if raw.centered else first_pixel),
            masks=masks,
            size=(int(image_size[0]), int(image_size[1])),
            time=raw.time if time is None else time,
        )

    def to(self, device: torch.device | str) -> Detections:
        """The same on another device, in the same graph."""
        own = {name: getattr(self, name) for name in ("boxes", "score", "keypoints", "masks")}
        moved = {name: value.to(device) for name, value in own.items() if value is not None}
        return dataclasses.replace(self, **moved)

    def select(self, chosen: Tensor) -> Detections:
        """Those that a mask (N,) or a list of numbers chooses."""
        numbers = chosen.nonzero()[:, 0] if chosen.dtype == torch.bool else chosen
        return dataclasses.replace(
            self,
            boxes=self.boxes[numbers],
            score=self.score[numbers],
            category=tuple(self.category[i] for i in numbers.tolist()),
            track=tuple(self.track[i] for i in numbers.tolist()),
            keypoints=None if self.keypoints is None else self.keypoints[numbers],
            masks=None if self.masks is None else self.masks[numbers],
        )

    def anchors(self, anchor: Anchor = "center") -> Tensor:
        """Pixels (N, 2) that stand for the objects.

        Args:
            anchor: `"center"` of the box, `"bottom"`: the middle of its lower edge, or the number of a keypoint.

        Raises:
            InputError: an unknown name, or a keypoint that there is not.
        """
        if not isinstance(anchor, int):
            return box_anchors(self.boxes, anchor)
        if self.keypoints is None or not 0 <= anchor < self.keypoints.shape[1]:
            raise InputError(f"anchor {anchor}: these detections have no such keypoint")
        return self.keypoints[:, anchor]

    def to_full(self, transform: ImageTransform) -> Detections:
        """Detections in the full image, of those in an input image that `transform` made from it.

        Boxes and keypoints are moved exactly; what lies in the padding stays beyond the full image's edge. Masks are
        sampled at the centers of the full image's pixels.

        Raises:
            InputError: a transform to an image of another size.
        """
        if transform.size != self.size:
            raise InputError(f"the transform leads to an image {transform.size}, the detections are of {self.size}")
        masks = self.masks
        if masks is not None:
            width, height = transform.full
            grid = torch.meshgrid(torch.arange(float(width)), torch.arange(float(height)), indexing="xy")
            at = transform.to_input(torch.stack(grid, -1).to(masks.device)).round().long()
            inside = ((at >= 0) & (at < at.new_tensor(self.size))).all(-1)
            masks = masks[:, at[..., 1].clamp(0, self.size[1] - 1), at[..., 0].clamp(0, self.size[0] - 1)] & inside
        return dataclasses.replace(
            self,
            boxes=transform.to_full(self.boxes.reshape(-1, 2)).reshape(-1, 4),
            keypoints=None if self.keypoints is None else transform.to_full(self.keypoints),
            masks=masks,
            size=transform.full,
        )


def box_anchors(boxes: Tensor, anchor: str) -> Tensor:
    """Pixels (..., 2) of boxes (..., 4): their `"center"`, or `"bottom"`, the middle of the lower edge.

    Raises:
        InputError: an unknown name.
    """
    left, top, right, bottom = boxes.unbind(-1)
    if anchor not in ("center", "bottom"):
        raise InputError(f"anchor {anchor!r}: 'center', 'bottom' or the number of a keypoint is needed")
    return torch.stack([0.5 * (left + right), bottom if anchor == "bottom" else 0.5 * (top + bottom)], -1)


def _category_names(raw: RawDetections, count: int, names: dict[int, str]) -> tuple[str, ...]:
    if raw.category is None:
        return ("object",) * count
    known = {**(raw.names or {}), **names}
    return tuple(
        category if isinstance(category, str) else known.get(int(category), str(int(category)))
        for category in raw.category
    )
