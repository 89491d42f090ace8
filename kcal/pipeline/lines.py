"""Lines of JSON to pairs: one line for each moment, as a detector's program writes them.

A line has the detections of both images, or pairs that are matched already:

    {"left": {"time": 12.50, "boxes": [[x1, y1, x2, y2], ...], ...}, "right": {...}}
    {"time": [12.50, 12.51], "left": [[u, v], ...], "right": [[u, v], ...], "sigma": 0.2, "categories": [...], ...}

Of a rig of many cameras, those that have an image are named:

    {"cameras": {"mill": {"time": 12.50, "boxes": [...], ...}, "mast": {...}}}

Detections are those of `kcal.pipeline.detections`.
In lines of pairs, `time` may be one number for both; `sigma` (px) or
`covariance` (N x 4 x 4), `scores`, `categories` and `ambiguous` may be left out, and pixel (0, 0) is the center of the
first pixel.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import orjson
import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.rig import StereoRig
from kcal.locate.multi_localizer import MultiViewLocalizer
from kcal.pipeline.association import AssociationOptions
from kcal.pipeline.detections import Detections
from kcal.pipeline.grouping import group_objects
from kcal.pipeline.pairing import pair_objects
from kcal.pipeline.pairs import ObjectPairs, ObjectViews

_PAIR_KEYS = {"time", "left", "right", "sigma", "covariance", "scores", "categories", "ambiguous"}


class Moment(NamedTuple):
    """What cameras saw at one moment: seconds of the first camera's image, and pairs or views, possibly none."""

    time: float
    pairs: ObjectPairs | ObjectViews


def read_moment(
    line: str | bytes, rig: StereoRig | MultiViewLocalizer, options: AssociationOptions, pixel_sigma: float
) -> Moment:
    """Read one line.

    Args:
        line: see the module.
        rig: pairs the detections, or groups those of many cameras.
        options: of the pairing; its `box_sigma` is the noise of the anchors.
        pixel_sigma: of pairs that state none, px.

    Raises:
        InputError: no JSON, or values that are no detections or pairs.

    Example:
        >>> from kcal.rig import planned_rig
        >>> line = '{"time": 3.5, "left": [[960, 540]], "right": [[944, 540]]}'
        >>> read_moment(line, planned_rig(), AssociationOptions(), 0.3).pairs.time.tolist()
        [[3.5, 3.5]]
    """
    try:
        content = orjson.loads(line)
    except orjson.JSONDecodeError as error:
        raise InputError(f"not a line of JSON ({error})") from error
    if isinstance(rig, MultiViewLocalizer):
        return _named_cameras(content, rig, options)
    if not isinstance(content, dict) or not {"left", "right"} <= set(content):
        raise InputError("a JSON object with left and right is needed")
    if isinstance(content["left"], dict) and isinstance(content["right"], dict):
        if set(content) != {"left", "right"}:
            raise InputError("with detections, a line has left and right only; time is that of each")
        left, right = (
            Detections.read(orjson.dumps(content[side]), size=camera.size)
            for side, camera in (("left", rig.left), ("right", rig.right))
        )
        if left.time is None or right.time is None:
            raise InputError("detections of both images need a time")
        return Moment(left.time, pair_objects(rig, left, right, options=options))
    return _pairs_of_line(content, pixel_sigma)


def _named_cameras(content: Any, localize: MultiViewLocalizer, options: AssociationOptions) -> Moment:
    names = localize.rig.names
    each = content.get("cameras") if isinstance(content, dict) else None
    if not isinstance(each, dict) or set(content) != {"cameras"} or not each or not set(each) <= set(names):
        raise InputError(f'{{"cameras": {{NAME: detections, ...}}}} is needed, with names of {", ".join(names)}')
    seen = [
        Detections.read(orjson.dumps(each[name]), size=camera.size) if name in each else None
        for name, camera in zip(names, localize.rig.each, strict=True)
    ]
    times = [found.time for found in seen if found is not None]
    if times[0] is None:
        raise InputError("detections of all cameras need a time")
    return Moment(times[0], group_objects(localize, seen, options))


def _pairs_of_line(content: dict[str, Any], pixel_sigma: float) -> Moment:
    if not set(content) <= _PAIR_KEYS or "time" not in content:
        raise InputError(f"a line of pairs needs a time, and may have only {', '.join(sorted(_PAIR_KEYS))}")
    left, right = (_table(content[side], side, 2) for side in ("left", "right"))
    count = len(left)
    stamp = content["time"]
    time = _table([stamp if isinstance(stamp, list) else [stamp, stamp]], "time", 2)
    sigma = _table([[content.get("sigma", pixel_sigma)]], "sigma", 1)
    if not bool(sigma > 0):
        raise InputError(f"sigma: a positive number of pixels is needed, got {float(sigma)}")
    covariance = (sigma**2 * torch.eye(4, dtype=torch.float64)).expand(count, 4, 4)
    if "covariance" in content:
        given = content["covariance"]
        if not isinstance(given, list) or len(given) != count or not count:
            raise InputError(f"covariance: a list of {count} matrices is needed")
        covariance = torch.stack([_table(each, "covariance", 4) for each in given])
    categories = content.get("categories", ["object"] * count)
    ambiguous = content.get("ambiguous", [False] * count)
    for name, values, kind in (("categories", categories, str), ("ambiguous", ambiguous, bool)):
        if not isinstance(values, list) or len(values) != count or not all(type(v) is kind for v in values):
            raise InputError(f"{name}: a list of {count} is needed")
    scores = content.get("scores", [1.0] * count)
    if not isinstance(scores, list) or len(scores) != count:
        raise InputError(f"scores: a list of {count} is needed")
    pairs = ObjectPairs(
        left=left,
        right=right,
        covariance=covariance,
        time=time.expand(count, 2),
        score=_table([[score] for score in scores], "scores", 1)[:, 0],
        category=tuple(categories),
        track=(None,) * count,
        ambiguous=torch.tensor(ambiguous, dtype=torch.bool),
    )
    return Moment(float(time[0, 0]), pairs)


def _table(values: Any, name: str, width: int) -> Tensor:
    rows = values if isinstance(values, list) else [None]
    if not all(
        isinstance(row, list) and len(row) == width and all(type(v) in (int, float) for v in row) for row in rows
    ):
        raise InputError(f"{name}: rows of {width} numbers are needed")
    return torch.tensor(rows, dtype=torch.float64).reshape(-1, width)
