"""Read what detectors return, by its attributes: supervision, torchvision, ultralytics, kornia, arrays and JSON lines.

A line of JSON describes one image, with pixels counted as the detector counts them:

    {"time": 12.5, "size": [1920, 1080], "boxes": [[x1, y1, x2, y2], ...], "scores": [0.9, ...],
     "categories": ["ship", ...], "tracks": ["7", null, ...], "keypoints": [[[x, y], ...], ...]}

`boxes` is needed, the rest may be left out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import orjson
import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.errors import InputError

_KEYS = {"time", "size", "boxes", "scores", "categories", "tracks", "keypoints"}
# Half the side of the box that stands for a keypoint without one, pixels.
_AROUND_KEYPOINT = 8.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class RawDetections:
    """Detections as their source counts pixels; `centered`: its keypoints are at pixel centers already."""

    boxes: Tensor
    score: Tensor | None = None
    category: Sequence[str | int | float] | None = None
    track: Sequence[object] | None = None
    keypoints: Tensor | None = None
    masks: Tensor | None = None
    size: tuple[int, int] | None = None
    time: float | None = None
    names: Mapping[int, str] | None = None
    centered: bool = False


def raw_detections(source: Any) -> RawDetections:
    """What a detector returned, whichever it is; see `Detections.read`.

    Raises:
        InputError: nothing that is known, or values that are no detections.
    """
    readers: list[tuple[bool, Callable[[Any], RawDetections]]] = [
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


def _plain_list(values: Any) -> list | None:
    return None if values is None else [value.item() if hasattr(value, "item") else value for value in values]


def _from_array(source: Any) -> RawDetections:
    table = _as_numbers("boxes", source)
    if table.numel() == 0:
        return RawDetections(boxes=table.reshape(0, 4))
    if table.ndim != 2 or not 4 <= table.shape[1] <= 6:
        raise InputError(
            f"detections: shape (N, 4) to (N, 6) of x1, y1, x2, y2, score, class is needed, got {tuple(table.shape)}"
        )
    return RawDetections(
        boxes=table[:, :4],
        score=table[:, 4] if table.shape[1] > 4 else None,
        category=table[:, 5].tolist() if table.shape[1] > 5 else None,
    )


def _from_dict(source: Mapping[str, Any]) -> RawDetections:
    """Of torchvision; `labels` may be names."""
    if "boxes" not in source:
        raise InputError(f"detections: the dictionary has no boxes, only {', '.join(map(str, source))}")
    keypoints = _optional(source.get("keypoints"), "keypoints")
    return RawDetections(
        boxes=_boxes(source["boxes"]),
        score=_optional(source.get("scores"), "scores"),
        category=_plain_list(source.get("labels")),
        track=_plain_list(source.get("tracks")),
        keypoints=None if keypoints is None or not len(keypoints) else keypoints[..., :2],
        masks=None if source.get("masks") is None else torch.as_tensor(source["masks"]),
    )


def _from_json(source: str | bytes) -> RawDetections:
    try:
        line = orjson.loads(source)
    except orjson.JSONDecodeError as error:
        raise InputError(f"detections: not a line of JSON ({error})") from error
    if not isinstance(line, dict) or "boxes" not in line or not set(line) <= _KEYS:
        raise InputError(f"detections: a JSON object with boxes, and else only {', '.join(sorted(_KEYS))}, is needed")
    size, time = line.get("size"), line.get("time")
    if size is not None and not (isinstance(size, list) and len(size) == 2 and all(type(v) is int for v in size)):
        raise InputError(f"detections: size must be [width, height], got {size}")
    if time is not None and type(time) not in (int, float):
        raise InputError(f"detections: time must be seconds, got {time!r}")
    categories = line.get("categories")
    if categories is not None and not (
        isinstance(categories, list) and all(isinstance(name, (str, int)) for name in categories)
    ):
        raise InputError(f"detections: categories must be a list of names or numbers, got {categories!r}")
    tracks = line.get("tracks")
    if tracks is not None and not isinstance(tracks, list):
        raise InputError(f"detections: tracks must be a list, got {tracks!r}")
    return RawDetections(
        boxes=_boxes(line["boxes"]),
        score=_optional(line.get("scores"), "scores"),
        category=categories,
        track=tracks,
        keypoints=_optional(line.get("keypoints"), "keypoints"),
        size=None if size is None else (size[0], size[1]),
        time=time,
    )


def _from_supervision(source: Any) -> RawDetections:
    """`supervision.Detections`; class names come from its `data`."""
    names = (source.data or {}).get("class_name")
    category = names if names is not None else source.class_id
    masks = source.mask
    return RawDetections(
        boxes=_boxes(source.xyxy),
        score=_optional(source.confidence, "confidence"),
        category=_plain_list(category),
        track=_plain_list(source.tracker_id),
        masks=None if masks is None else torch.from_numpy(np.asarray(masks, dtype=bool)),
        size=None if masks is None else (masks.shape[2], masks.shape[1]),
    )


def _from_ultralytics(source: Any) -> RawDetections:
    """One `Results` of ultralytics, or what has the same attributes; its boxes are in the original image."""
    boxes = source.boxes
    height, width = source.orig_shape[:2]
    keypoints = getattr(source, "keypoints", None)
    masks = getattr(source, "masks", None)
    whole = None
    if masks is not None:
        whole = torch.as_tensor(masks.data) > 0.5
        if tuple(whole.shape[1:]) != (height, width):
            whole = None  # in the letterboxed input: to be read with retina_masks=True
    return RawDetections(
        boxes=_boxes(boxes.xyxy),
        score=_optional(boxes.conf, "conf"),
        category=_plain_list(boxes.cls),
        track=_plain_list(None if getattr(boxes, "id", None) is None else [int(i) for i in boxes.id]),
        keypoints=None if keypoints is None else _as_numbers("keypoints", keypoints.xy),
        masks=whole,
        size=(int(width), int(height)),
        names=source.names if isinstance(source.names, dict) else dict(enumerate(source.names)),
    )


def _from_kornia_boxes(source: Any) -> RawDetections:
    """`Boxes`: its exclusive xyxy counts from the first pixel's edge."""
    return RawDetections(boxes=_one_image(source.to_tensor("xyxy")))


def _from_kornia_keypoints(source: Any) -> RawDetections:
    """`Keypoints` (N, 2): one for each object, with a small box around it."""
    points = _one_image(source.to_tensor())
    edges = points + 0.5
    boxes = torch.cat([edges - _AROUND_KEYPOINT, edges + _AROUND_KEYPOINT], -1)
    return RawDetections(boxes=boxes, keypoints=points[:, None], centered=True)


def _one_image(values: Tensor) -> Tensor:
    if values.ndim == 3 and len(values) != 1:
        raise InputError(f"detections: one image at a time is needed, got a batch of {len(values)}")
    return _as_numbers("boxes", values.reshape(-1, values.shape[-1]))
