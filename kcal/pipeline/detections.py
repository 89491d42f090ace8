"""Detections: what detectors of other libraries return as one form, and their call."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import orjson
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from kcal.checks import as_points, require_finite
from kcal.errors import InputError
from kcal.lens.camera_conversions import ImageTransform
from kcal.texts import brief

# Read what detectors return, by its attributes: supervision, torchvision, ultralytics, kornia, arrays and JSON lines.
#
# A line of JSON describes one image, with pixels counted as the detector counts them:
#
#     {"time": 12.5, "size": [1920, 1080], "boxes": [[x1, y1, x2, y2], ...], "scores": [0.9, ...],
#      "categories": ["ship", ...], "tracks": ["7", null, ...], "keypoints": [[[x, y], ...], ...]}
#
# `boxes` is needed, the rest may be left out.

_KEYS = {"time", "size", "boxes", "scores", "categories", "tracks", "keypoints"}
# Half the side of the box that stands for a keypoint without one, pixels.
_AROUND_KEYPOINT = 8.0


# What a source has, as it counts pixels: `boxes`, and, if there are any, `score`, `category`, `track`, `keypoints`,
# `masks`, `size`, `time` as in `Detections`; `names` of categories; `centered`: keypoints count from pixel centers.
Raw = dict[str, Any]


def _raw_detections(source: Any) -> Raw:
    """What a detector returned, whichever it is; see `Detections.read`.

    Raises:
        InputError: nothing that is known, or values that are no detections.
    """
    readers: list[tuple[bool, Callable[[Any], Raw]]] = [
        (isinstance(source, (str, bytes)), _from_json),
        (isinstance(source, Mapping), _from_dict),
        (hasattr(source, "xyxy") and hasattr(source, "tracker_id"), _from_supervision),
        (hasattr(source, "boxes") and hasattr(source, "orig_shape"), _from_ultralytics),
        (hasattr(source, "to_tensor") and hasattr(source, "get_boxes_shape"), _from_kornia_boxes),
        (hasattr(source, "to_tensor") and hasattr(source, "transform_keypoints"), _from_kornia_keypoints),
        (isinstance(source, (Tensor, np.ndarray, Sequence)), _from_array),
    ]
    for fits, read in readers:
        if fits:
            return read(source)
    raise InputError(
        f"detections: {type(source).__name__} is not known; give an array (N, 4) of x1, y1, x2, y2, a dictionary with "
        "boxes, or the result of supervision, torchvision, ultralytics or kornia"
    )


def _as_numbers(name: str, values: Any) -> Tensor:
    """A float64 tensor on the device and in the graph of the values; integers are edges all the same."""
    if not isinstance(values, Tensor):
        half = isinstance(values, np.ndarray) and values.dtype == np.float16
        try:
            values = torch.as_tensor(values if half else np.asarray(values, dtype=np.float64))
        except (TypeError, ValueError) as error:
            raise InputError(f"detections: {name} are not numbers of one shape ({error})") from error
    if not values.is_floating_point():
        values = values.double()
    return as_points(name, values, values.shape[-1] if values.ndim else 1)


def _boxes(values: Any) -> Tensor:
    boxes = _as_numbers("boxes", values)
    return boxes.reshape(0, 4) if boxes.numel() == 0 else boxes


def _optional(values: Any, name: str) -> Tensor | None:
    return None if values is None else _as_numbers(name, values)


def _found_keypoints(values: Any) -> Tensor | None:
    """(N, K, 2): those at (0, 0) were not found, as in COCO, and are NaN."""
    points = _optional(values, "keypoints")
    if points is None or not len(points):
        return None
    points = points[..., :2]
    return torch.where((points == 0).all(-1, keepdim=True), torch.nan, points)


def _plain_list(values: Any) -> list | None:
    return None if values is None else [value.item() if hasattr(value, "item") else value for value in values]


def _from_array(source: Any) -> Raw:
    table = _boxes(source)
    if table.ndim != 2 or not 4 <= table.shape[1] <= 6:
        raise InputError(
            f"detections: shape (N, 4) to (N, 6) of x1, y1, x2, y2, score, class is needed, got {tuple(table.shape)}"
        )
    return dict(
        boxes=table[:, :4],
        score=table[:, 4] if table.shape[1] > 4 else None,
        category=table[:, 5].tolist() if table.shape[1] > 5 else None,
    )


def _from_dict(source: Mapping[str, Any]) -> Raw:
    """Of torchvision; `labels` may be names."""
    if "boxes" not in source:
        raise InputError(f"detections: the dictionary has no boxes, only {', '.join(map(str, source))}")
    return dict(
        boxes=_boxes(source["boxes"]),
        score=_optional(source.get("scores"), "scores"),
        category=_plain_list(source.get("labels")),
        track=_plain_list(source.get("tracks")),
        keypoints=_found_keypoints(source.get("keypoints")),
        masks=None if source.get("masks") is None else torch.as_tensor(source["masks"]),
    )


def _from_json(source: str | bytes) -> Raw:
    try:
        line = orjson.loads(source)
    except orjson.JSONDecodeError as error:
        raise InputError(f"detections: not a line of JSON ({error})") from error
    if not isinstance(line, dict) or "boxes" not in line or not set(line) <= _KEYS:
        raise InputError(f"detections: a JSON object with boxes, and else only {', '.join(sorted(_KEYS))}, is needed")
    size, time = line.get("size"), line.get("time")
    sides = size if isinstance(size, list) else []
    if size is not None and not (len(sides) == 2 and all(type(side) is int and side > 0 for side in sides)):
        raise InputError(f"detections: size must be [width, height], got {size}")
    if time is not None and type(time) not in (int, float):
        raise InputError(f"detections: time must be seconds, got {time!r}")
    categories, tracks = line.get("categories"), line.get("tracks")
    listed = isinstance(categories, list) and all(isinstance(name, (str, int)) for name in categories)
    if categories is not None and not listed:
        raise InputError(f"detections: categories must be a list of names or numbers, got {categories!r}")
    if tracks is not None and not isinstance(tracks, list):
        raise InputError(f"detections: tracks must be a list, got {tracks!r}")
    return dict(
        boxes=_boxes(line["boxes"]),
        score=_optional(line.get("scores"), "scores"),
        category=categories,
        track=tracks,
        keypoints=_found_keypoints(line.get("keypoints")),
        size=None if size is None else (size[0], size[1]),
        time=time,
    )


def _from_supervision(source: Any) -> Raw:
    """`supervision.Detections`; class names come from its `data`."""
    names, masks = (source.data or {}).get("class_name"), source.mask
    return dict(
        boxes=_boxes(source.xyxy),
        score=_optional(source.confidence, "confidence"),
        category=_plain_list(source.class_id if names is None else names),
        track=_plain_list(source.tracker_id),
        masks=None if masks is None else torch.from_numpy(np.asarray(masks, dtype=bool)),
        size=None if masks is None else (masks.shape[2], masks.shape[1]),
    )


def _from_ultralytics(source: Any) -> Raw:
    """One `Results` of ultralytics, or what has the same attributes; its boxes are in the original image."""
    boxes, (height, width) = source.boxes, source.orig_shape[:2]
    keypoints, masks = (getattr(source, name, None) for name in ("keypoints", "masks"))
    tracks = getattr(boxes, "id", None)
    whole = None if masks is None else torch.as_tensor(masks.data) > 0.5
    return dict(
        boxes=_boxes(boxes.xyxy),
        score=_optional(boxes.conf, "conf"),
        category=_plain_list(boxes.cls),
        track=None if tracks is None else [int(i) for i in tracks],
        keypoints=None if keypoints is None else _found_keypoints(keypoints.xy),
        # Others are in the letterboxed input: to be read with retina_masks=True.
        masks=whole if whole is not None and tuple(whole.shape[1:]) == (height, width) else None,
        size=(int(width), int(height)),
        names=source.names if isinstance(source.names, dict) else dict(enumerate(source.names)),
    )


def _from_kornia_boxes(source: Any) -> Raw:
    """`Boxes`: its exclusive xyxy counts from the first pixel's edge."""
    return dict(boxes=_one_image(source.to_tensor("xyxy")))


def _from_kornia_keypoints(source: Any) -> Raw:
    """`Keypoints` (N, 2): one for each object, with a small box around it."""
    points = _one_image(source.to_tensor())
    edges = points + 0.5
    boxes = torch.cat([edges - _AROUND_KEYPOINT, edges + _AROUND_KEYPOINT], -1)
    return dict(boxes=boxes, keypoints=points[:, None], centered=True)


def _one_image(values: Tensor) -> Tensor:
    if values.ndim == 3 and len(values) != 1:
        raise InputError(f"detections: one image at a time is needed, got a batch of {len(values)}")
    return _as_numbers("boxes", values.reshape(-1, values.shape[-1]))


# `Detections`: boxes, masks and keypoints of one image, as detectors return them, in pixels of the full image.

Anchor = Literal["center", "bottom"] | int


@dataclass(frozen=True, kw_only=True, eq=False)
class Detections:
    """A detector's boxes in one image.

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
                class, or a line of JSON (see `kcal.pipeline.detections`). Keypoints at (0, 0) of a dictionary or of
                ultralytics were not found.
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
        raw = _raw_detections(source)
        stated, boxes, masks, keypoints = raw.get("size"), raw["boxes"], raw.get("masks"), raw.get("keypoints")
        whole = size or stated
        if whole is None:
            raise InputError("detections: the image's size is needed; give size=(width, height)")
        if size is not None and stated is not None and tuple(size) != tuple(stated):
            raise InputError(f"detections: size {tuple(size)} was given, the source says {tuple(stated)}")
        if masks is not None:
            masks = masks if masks.dtype == torch.bool else masks > 0.5  # torchvision's are probabilities
            masks = masks[:, 0] if masks.ndim == 4 else masks
        if len(boxes) and bool((boxes.detach().abs() <= 1.0).all()):
            raise InputError("boxes: all lie between 0 and 1, as shares of the image do; multiply them by its size")
        score, known = raw.get("score"), {**(raw.get("names") or {}), **(names or {})}
        categories = ["object"] * len(boxes) if raw.get("category") is None else raw["category"]
        return cls(
            boxes=boxes - first_pixel,
            score=torch.ones_like(boxes[:, 0]).detach() if score is None else score,
            category=tuple(one if isinstance(one, str) else known.get(int(one), str(int(one))) for one in categories),
            track=tuple(None if one is None else str(one) for one in raw.get("track") or (None,) * len(boxes)),
            keypoints=None if keypoints is None else keypoints - (0.0 if raw.get("centered") else first_pixel),
            masks=masks,
            size=(int(whole[0]), int(whole[1])),
            time=raw.get("time") if time is None else time,
        )

    def _each(self, change: Callable[[Tensor], Tensor]) -> dict[str, Any]:
        own = {name: getattr(self, name) for name in ("boxes", "score", "keypoints", "masks")}
        return {name: change(value) for name, value in own.items() if value is not None}

    def to(self, device: torch.device | str) -> Detections:
        """The same on another device, in the same graph."""
        return dataclasses.replace(self, **self._each(lambda value: value.to(device)))

    def select(self, chosen: Tensor | ArrayLike) -> Detections:
        """Those that a mask (N,) or a list of numbers chooses."""
        numbers = torch.as_tensor(chosen, device=self.boxes.device)
        if numbers.dtype == torch.bool and len(numbers) == len(self):
            numbers = numbers.nonzero()[:, 0]
        elif len(numbers) and numbers.dtype not in (torch.int64, torch.int32):
            # A mask of uint8 would choose other categories than boxes.
            raise InputError(f"select: a mask of {len(self)} bool or whole numbers are needed, got {numbers}")
        numbers = numbers.long()
        category = tuple(self.category[i] for i in numbers.tolist())
        track = tuple(self.track[i] for i in numbers.tolist())
        return dataclasses.replace(self, **self._each(lambda value: value[numbers]), category=category, track=track)

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


# Call a user's detector, `package.module:callable`, on frames, and say in one line what is wrong with it.

# An image (H, W, 3) uint8 in, whatever `Detections.read` takes out.
Detector = Callable[[NDArray[np.uint8]], Any]


def load_detector(name: str) -> Detector:
    """Import the callable that `package.module:callable` names.

    Raises:
        InputError: no such module, one that fails, or nothing in it that can be called.

    Example:
        >>> load_detector("math:nothing")
        Traceback (most recent call last):
        kcal.errors.InputError: detector math:nothing: the module math has no 'nothing'
    """
    module_name, colon, path = name.partition(":")
    if not (module_name and colon and path):
        raise InputError(f"detector {name!r}: write package.module:callable")
    try:
        found: Any = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        raise InputError(f"detector {name}: no module {error.name!r} in this Python or this folder") from error
    except Exception as error:  # whatever a module of the user raises
        raise InputError(f"detector {name}: importing {module_name} fails: {_one_line(error)}") from error
    for part in path.split("."):
        if not hasattr(found, part):
            raise InputError(f"detector {name}: the module {module_name} has no {part!r}")
        found = getattr(found, part)
    if not callable(found):
        raise InputError(f"detector {name}: what it names, of type {type(found).__name__}, cannot be called")
    detector: Detector = found
    return detector


def detect_in(detector: Detector, image: NDArray[np.uint8], time: float, where: str) -> Detections:
    """The detections in one image.

    Args:
        detector: gets the image and returns what `Detections.read` takes, or a list with one such result.
        image: (H, W, 3) red, green and blue.
        time: seconds.
        where: names the image in messages.

    Raises:
        InputError: the detector fails, or returns something else.

    Example:
        >>> found = detect_in(lambda image: [[1.0, 2.0, 5.0, 6.0]], np.zeros((8, 8, 3), np.uint8), 0.5, "left image")
        >>> found.time, found.boxes.tolist()
        (0.5, [[0.5, 1.5, 4.5, 5.5]])
    """
    height, width = image.shape[:2]
    try:
        found = detector(image)
    except Exception as error:  # whatever a detector of the user raises
        raise InputError(f"the detector failed on the {where} at {time:.3f} s: {_one_line(error)}") from error
    # Detectors of batches return a list, here of one image's result.
    if isinstance(found, (list, tuple)) and len(found) == 1 and (isinstance(found[0], Mapping) or _is_result(found[0])):
        found = found[0]
    try:
        return Detections.read(found, size=(width, height), time=time)
    except InputError as error:
        raise InputError(f"what the detector returned for the {where} at {time:.3f} s: {error}") from error


def _is_result(value: Any) -> bool:
    return hasattr(value, "boxes") or hasattr(value, "xyxy")


def _one_line(error: Exception) -> str:
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
