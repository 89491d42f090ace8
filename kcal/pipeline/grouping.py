"""`group_objects`: which detections of any number of cameras are of one target; and lines of JSON to such objects."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import orjson
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.checks import chi2_tail
from kcal.errors import InputError
from kcal.files import read_bytes
from kcal.lens.rig import Rig
from kcal.locate.localizer import Localizer
from kcal.locate.marks import Marks
from kcal.pipeline.assignment import assign_groups
from kcal.pipeline.association import MOST_BOXES, AssociationOptions, fit_some, pair_costs, station_sights
from kcal.pipeline.detections import Detections
from kcal.pipeline.epipolar_pencil import FEWEST_VIEWS, Confirming, near_in_angle, separate_pairs
from kcal.pipeline.pairing import ObjectViews, pair_objects

# `group_objects`: which detections of any number of cameras are of one target, by where their lines of sight meet.
#
# Two lines of sight that come close are a possible pair, with an inverse range from the first of them. Pairs of one
# detection with others whose inverse ranges agree are a possible group; all its views are then fitted together, with
# every error that the cameras share. The likeliest groups are taken first; what remains is paired as `associate` pairs.

# Rows of fits that are done at once.
_AT_ONCE = 4096
# Meters: at smaller ranges than this, or than `nearest`, a first look may miss what errors of places explain.
_NEAREST_M = 1000.0


class _Edges(NamedTuple):
    """Possible pairs: numbers of two detections (all cameras counted through), cost, inverse range and its sigma."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    cost: NDArray[np.float64]
    inverse: NDArray[np.float64]
    sigma: NDArray[np.float64]


class _Group(NamedTuple):
    """Numbers of detections, -1 for cameras that have none, what the group saves beside staying alone, and doubts."""

    marks: tuple[int, ...]
    saved: float
    doubt: bool = False


def group_objects(
    localize: Localizer, seen: Sequence[Detections | None], options: AssociationOptions | None = None
) -> ObjectViews:
    """Group the detections that the cameras of a rig have at one time.

    Works on the CPU; pixels come back on the device and in the graph of the detections.

    Rows of one camera alone are those that no group has, and those of ambiguous groups once more: a tracker gives them
    to the track that they continue.

    Args:
        localize: the rig and how well it is known.
        seen: detections of each camera in turn, with times; None: this camera has no image.
        options: of the association; without `nearest` there is no smallest range.

    Raises:
        InputError: detections that are not of a camera's size, or without a time; more than 2,000 boxes in an image.

    Example:
        >>> from kcal import Camera, Origin
        >>> from kcal.lens.rig import Rig
        >>> from kcal.locate import enu_from_cam
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> look = torch.stack([enu_from_cam(heading).T for heading in (0.0, 315.0, 45.0)])
        >>> places = torch.tensor([[0.0, 0, 30], [5000.0, 0, 40], [-5000.0, 0, 35]])
        >>> rig = Rig([camera] * 3, ["mill", "church", "mast"], look, center=places, refraction=0.0,
        ...                 origin=Origin(lat=45.0, lon=6.0, height=0.0))
        >>> pixels, _ = rig(torch.tensor([[0.0, 5000, 100], [400.0, 5500, 100]]))
        >>> boxes = [torch.cat([p - 5, p + 5], -1) for p in pixels.unbind(1)]
        >>> seen = [Detections.read(b, size=(1920, 1080), time=7.0) for b in (boxes[0], boxes[1].flip(0), boxes[2][:1])]
        >>> views = group_objects(Localizer(rig), seen)
        >>> views.seen.tolist(), views.ambiguous.tolist()
        ([[True, True, True], [True, True, False]], [False, False])
    """
    options, rig = options or AssociationOptions(), localize.rig
    if len(seen) != len(rig):
        raise InputError(f"detections of {len(rig)} cameras are needed, got {len(seen)}")
    for name, camera, each in zip(rig.names, rig.each, seen, strict=True):
        if each is None:
            continue
        if each.size != camera.size:
            raise InputError(f"the detections of {name} are of an image {each.size}, the camera has {camera.size}")
        if each.time is None:
            raise InputError(f"the detections of {name} need a time")
        if len(each) > MOST_BOXES:
            raise InputError(f"{len(each):,} detections of {name} in one image; at most {MOST_BOXES:,} can be grouped")
    with torch.no_grad():
        here = localize if rig.center.device.type == "cpu" else copy.deepcopy(localize).cpu()
        scene = _Scene(here, [None if each is None else each.to("cpu") for each in seen], options)
        found = scene.chosen()
    taken = {mark for one in found if not one.doubt for mark in one.marks}
    alone = [mark for mark in range(len(scene.camera)) if mark not in taken]
    count = len(rig)
    rows = [one.marks for one in found]
    rows += [tuple(mark if c == scene.camera[mark] else -1 for c in range(count)) for mark in alone]
    marks = [each.anchors(options.anchor) for each in seen if each is not None]
    every = torch.cat(marks) if marks else scene.pixels
    place = every.device
    numbers = torch.tensor(rows, dtype=torch.long, device=place).reshape(-1, count)
    there = numbers >= 0
    pixels = torch.where(there[..., None], every[numbers.clamp_min(0)], torch.nan)
    score = scene.score.to(place)
    early = min((each.time or 0.0 for each in seen if each is not None), default=0.0)
    stamps = [early if each is None else each.time or 0.0 for each in seen]
    time = torch.tensor(stamps, dtype=torch.float64, device=place)
    firsts = [next(mark for mark in row if mark >= 0) for row in rows]
    return ObjectViews(
        pixels=pixels,
        seen=there,
        covariance=options.box_sigma**2 * torch.eye(2 * count).to(every).expand(len(rows), -1, -1),
        time=time.expand(len(rows), count),
        score=torch.where(there, score[numbers.clamp_min(0)], torch.inf).amin(-1) if rows else score[:0],
        category=tuple(scene.category[mark] for mark in firsts),
        ambiguous=torch.tensor([*(one.doubt for one in found), *[False] * len(alone)], dtype=torch.bool, device=place),
    )


class _Scene:
    """Detections of all cameras, counted through."""

    def __init__(self, localize: Localizer, seen: Sequence[Detections | None], options: AssociationOptions) -> None:
        self.localize, self.options, self.posed = localize, options, localize.posed
        self.nearest = options.nearest or _NEAREST_M
        there = [(c, each) for c, each in enumerate(seen) if each is not None]
        none = torch.zeros(0, dtype=torch.float64)
        self.camera = np.repeat([c for c, _ in there], [len(each) for _, each in there]).astype(np.int64)
        self.pixels = torch.cat([none.reshape(0, 2), *(each.anchors(options.anchor) for _, each in there)])
        self.boxes = torch.cat([none.reshape(0, 4), *(each.boxes for _, each in there)])
        self.score = torch.cat([none, *(each.score for _, each in there)])
        self.category = [name for _, each in there for name in each.category]
        names = {name: number for number, name in enumerate(dict.fromkeys(self.category))}
        self.kind = np.array([names[name] for name in self.category], dtype=np.int64)
        self.own = [np.flatnonzero(self.camera == c) for c in range(len(localize.rig))]
        self.lines, valid = station_sights(localize, self.camera, self.pixels, options.box_sigma)
        # What has no line of sight stays alone.
        self.own = [own[valid[own]] for own in self.own]

    def chosen(self) -> list[_Group]:
        """Groups of two views and more, each detection once."""
        groups, free = self._clear()
        self.own = [own[free[own]] for own in self.own]
        return groups + self._remaining()

    def _clear(self) -> tuple[list[_Group], NDArray[np.bool_]]:
        """Groups that most cameras see, and which marks are of none of these targets."""
        posed, options = self.posed, self.options
        there = [c for c, own in enumerate(self.own) if len(own)]
        groups: list[_Group] = []
        free = np.ones(len(self.camera), dtype=bool)
        if len(there) < FEWEST_VIEWS:
            return groups, free
        cameras = range(len(self.own))
        axis, inner = (np.stack(value) for value in zip(*(self._middle(c) for c in cameras), strict=True))
        near = 2.0 * math.log(options.odds)
        kind = self.kind if options.same_category else np.zeros_like(self.kind)
        confirming = Confirming(self.lines, kind, axis, inner, there, options.gate, near, self.nearest)
        pairs = separate_pairs(posed.center.numpy(), axis, there)
        every = np.zeros(len(self.camera), dtype=bool)
        every[np.concatenate(self.own)] = True
        found = [np.zeros((0, len(self.own)), dtype=np.int64)]
        left = every.copy()
        for misses in range(len(pairs)):
            for pair in pairs[: misses + 1]:
                found.append(confirming.found(pair, misses, left))
                left[found[-1][found[-1] >= 0]] = False
        all_found = np.concatenate(found)
        if not len(all_found):
            return groups, free
        settled, rival = confirming.settled(all_found, every)
        # Without the marks that could as well be of another target, if views enough are left.
        sure = np.where(rival, -1, settled)
        doubtful = (sure >= 0).sum(1) < FEWEST_VIEWS
        rows = np.where(doubtful[:, None], settled, sure)
        number = {mark: i for i, row in enumerate(rows.tolist()) for mark in row}
        for group in self._fitted([tuple(row) for row in rows.tolist()]):
            which = number[max(group.marks)]
            groups.append(group._replace(doubt=bool(doubtful[which])))
            free[settled[which][settled[which] >= 0]] = False
        return groups, free

    def _middle(self, c: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where a camera looks, and the cosine of the widest cone about it that is inside its image."""
        camera, turn = self.localize.rig.each[c], self.localize.rig.rotation[c]
        width, height = camera.size
        u, v = (torch.arange(count, dtype=torch.float64) for count in (width, height))
        edge = torch.cat(
            [torch.stack([u, torch.full_like(u, end)], 1) for end in (0.0, height - 1.0)]
            + [torch.stack([torch.full_like(v, end), v], 1) for end in (0.0, width - 1.0)]
        )
        middle = camera.unproject(0.5 * torch.tensor([[width - 1.0, height - 1.0]], dtype=torch.float64))[0][0]
        rays, valid = camera.unproject(edge)
        widest = torch.where(valid, rays @ middle, -1.0).amax()
        return (turn.T @ middle).numpy(), widest.numpy()

    def _remaining(self) -> list[_Group]:
        """Groups of what no clear group has."""
        cameras, edges = range(len(self.own)), self._edges()
        candidates = self._fitted(_with_one_range(edges, self.camera, len(self.own), self.options.gate))
        near = 2.0 * math.log(self.options.odds)
        by_mark: dict[int, list[_Group]] = {}
        for group in candidates:
            for mark in group.marks:
                by_mark.setdefault(mark, []).append(group)
        groups: list[_Group] = []
        used: set[int] = set()
        for group in sorted(candidates, key=lambda group: -group.saved):
            marks = {mark for mark in group.marks if mark >= 0}
            if marks & used:
                continue
            used |= marks
            rivals = (other for mark in marks for other in by_mark[mark] if not {*other.marks} <= {*group.marks, -1})
            groups.append(group._replace(doubt=any(group.saved - other.saved < near for other in rivals)))
        alone = self.options.gate**2
        left = np.ones(len(self.camera), dtype=bool)
        left[list(used)] = False
        for i, j in itertools.combinations(cameras, 2):
            possible = left[edges.first] & left[edges.second]
            possible &= (self.camera[edges.first] == i) & (self.camera[edges.second] == j)
            rows, row = np.unique(edges.first[possible], return_inverse=True)
            columns, column = np.unique(edges.second[possible], return_inverse=True)
            cost = np.full((len(rows), len(columns)), np.inf)
            cost[row, column] = edges.cost[possible]
            best, rival = assign_groups(cost, alone, near)
            for one in np.flatnonzero(best >= 0):
                pair = {i: int(rows[one]), j: int(columns[best[one]])}
                saved = alone - float(cost[one, best[one]])
                groups.append(_Group(tuple(pair.get(c, -1) for c in cameras), saved, bool(rival[one])))
                left[list(pair.values())] = False
        return groups

    def _edges(self) -> _Edges:
        """Possible pairs of all cameras."""
        pairs = []
        for i, j in itertools.combinations(range(len(self.own)), 2):
            if len(self.own[i]) and len(self.own[j]):
                near = near_in_angle(self.lines, self.own[i], self.own[j], self.options.gate, self.nearest)
                pairs.append(np.stack(near, 1))
        both = np.concatenate([np.zeros((0, 2), dtype=np.int64), *pairs])
        if self.options.same_category:
            both = both[self.kind[both[:, 0]] == self.kind[both[:, 1]]]
        if not len(both):
            return _Edges(both[:, 0], both[:, 1], *(np.zeros(0),) * 3)
        cameras, options = torch.from_numpy(self.camera[both]), self.options
        found = pair_costs(self.localize, cameras, self.pixels[both], self.boxes[both], options, options.nearest)
        kept = found.cost.numpy() < self.options.gate**2
        return _Edges(both[kept, 0], both[kept, 1], *(value.numpy()[kept] for value in found))

    def _fitted(self, groups: list[tuple[int, ...]]) -> list[_Group]:
        """Groups of three views and more, fitted; one view that contradicts is left out."""
        good, gate = [], self.options.gate**2
        cameras = list(range(len(self.own)))
        for _ in range(2):
            again: set[tuple[int, ...]] = set()
            for start in range(0, len(groups), _AT_ONCE):
                part = groups[start : start + _AT_ONCE]
                numbers = torch.tensor(part)
                pixels = self.pixels[numbers.clamp_min(0)]
                found = fit_some(self.localize, cameras, pixels, numbers >= 0, self.options.box_sigma)
                chi2, falls = found.misfits()
                views = found.used.sum(-1)
                ahead = found.fitted & (found.fit.inverse > 0) & ~found.behind(self.posed.center)
                worst = falls.argmax(-1).tolist()
                fits = zip(part, chi2.tolist(), views.tolist(), ahead.tolist(), worst, strict=True)
                for group, value, count, there, one in fits:
                    if there and count > 2 and float(chi2_tail(value, 2 * count - 3)) > 1e-4:
                        good.append(_Group(group, (count - 1) * gate - value))
                    elif count > 3:
                        again.add(tuple(-1 if c == one else mark for c, mark in enumerate(group)))
            groups = sorted(again - {group.marks for group in good})
        return good


def _with_one_range(edges: _Edges, camera: NDArray[np.int64], cameras: int, gate: float) -> list[tuple[int, ...]]:
    """Groups of three detections and more whose inverse ranges from the first one agree."""
    if cameras < 3:
        return []
    order = np.argsort(edges.first, kind="stable")
    first, second, _, inverse, sigma = (value[order] for value in edges)
    bounds = np.flatnonzero(np.diff(first)) + 1
    found: set[tuple[int, ...]] = set()
    for at in np.split(np.arange(len(first)), bounds):
        if len(at) < 2:
            continue
        apart = np.abs(inverse[at, None] - inverse[at]) / np.hypot(sigma[at, None], sigma[at])
        apart[camera[second[at]][:, None] == camera[second[at]]] = np.inf
        for row, other in zip(*np.nonzero(apart < gate), strict=True):
            # The nearest of each camera beside these two.
            marks = [-1] * cameras
            marks[camera[first[at[0]]]] = int(first[at[0]])
            both = apart[row] + apart[other]
            for place in np.argsort(both, kind="stable")[::-1]:
                if both[place] < 2 * gate:
                    marks[camera[second[at[place]]]] = int(second[at[place]])
            for place in (row, other):
                marks[camera[second[at[place]]]] = int(second[at[place]])
            found.add(tuple(marks))
    return sorted(found)


# Lines of JSON to pairs: one line for each time step, as a detector's program writes them.
#
# A line has the detections of both images, or pairs that are matched already:
#
#     {"left": {"time": 12.50, "boxes": [[x1, y1, x2, y2], ...], ...}, "right": {...}}
#     {"time": [12.50, 12.51], "left": [[u, v], ...], "right": [[u, v], ...], "sigma": 0.2, "categories": [...], ...}
#
# Of a rig of many cameras, those that have an image are named:
#
#     {"cameras": {"mill": {"time": 12.50, "boxes": [...], ...}, "mast": {...}}}
#
# Detections are those of `kcal.pipeline.detections`. In lines of pairs, `time` may be one number for both; `sigma` (px)
# or `covariance` (N x 4 x 4), `scores`, `categories` and `ambiguous` may be left out, and pixel (0, 0) is the center of
# the first pixel.

_PAIR_KEYS = {"time", "left", "right", "sigma", "covariance", "scores", "categories", "ambiguous"}


class Moment(NamedTuple):
    """What cameras saw at one time: seconds of the first camera's image, and pairs or views, possibly none."""

    time: float
    pairs: ObjectViews


def read_moment(line: str | bytes, rig: Rig | Localizer, options: AssociationOptions, pixel_sigma: float) -> Moment:
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
    if isinstance(rig, Localizer):
        return _named_cameras(content, rig, options)
    if not isinstance(content, dict) or not {"left", "right"} <= set(content):
        raise InputError("a JSON object with left and right is needed")
    if isinstance(content["left"], dict) and isinstance(content["right"], dict):
        if set(content) != {"left", "right"}:
            raise InputError("with detections, a line has left and right only; time is that of each")
        sides = (content["left"], rig.left.size), (content["right"], rig.right.size)
        left, right = (Detections.read(orjson.dumps(seen), size=size) for seen, size in sides)
        if left.time is None or right.time is None:
            raise InputError("detections of both images need a time")
        return Moment(left.time, pair_objects(rig, left, right, options=options))
    return _pairs_of_line(content, pixel_sigma)


def marks_of_lines(path: Path, localize: Localizer) -> Marks:
    """What a detector saw, as marks with their `time`: a row for each object of each line (`read_moment`).

    Raises:
        InputError: a line that cannot be read, or none that shows anything.
    """
    rig = localize.rig
    paired = rig if rig.is_pair and rig.names == ("left", "right") else localize
    noise = float(localize.pixel_sigma)
    seen = []
    for number, line in enumerate(read_bytes(path).splitlines(), 1):
        if line.strip():
            try:
                seen.append(read_moment(line, paired, AssociationOptions(), noise).pairs)
            except InputError as error:
                raise InputError(f"{path}: line {number}: {error}") from None
    names = [track or kind for views in seen for track, kind in zip(views.track, views.category, strict=True)]
    if not names:
        raise InputError(f"{path}: nothing was seen by the cameras in {len(seen)} lines")
    # Of the first camera that saw it.
    first = torch.cat([views.time.gather(1, views.seen.int().argmax(1, keepdim=True))[:, 0] for views in seen])
    return Marks(
        [f"{name} {number}" for number, name in enumerate(names, 1)],
        torch.cat([views.pixels.masked_fill(~views.seen[..., None], torch.nan) for views in seen]),
        torch.cat([views.covariance for views in seen]),
        extras={"time": [repr(time) for time in first.tolist()]},
    )


def _named_cameras(content: Any, localize: Localizer, options: AssociationOptions) -> Moment:
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
    time = _table([stamp if isinstance(stamp, list) else [stamp, stamp]], "time (seconds, or those of both images)", 2)
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
    pairs = ObjectViews.of_pairs(
        left,
        right,
        covariance=covariance,
        time=time.expand(count, 2),
        score=_table([[score] for score in scores], "scores", 1)[:, 0],
        category=tuple(categories),
        ambiguous=torch.tensor(ambiguous, dtype=torch.bool),
    )
    return Moment(float(time[0, 0]), pairs)


def _table(values: Any, name: str, width: int) -> Tensor:
    rows = values if isinstance(values, list) else [None]
    fine = (isinstance(row, list) and len(row) == width and all(type(v) in (int, float) for v in row) for row in rows)
    if not all(fine):
        raise InputError(f"{name}: rows of {width} numbers are needed")
    return torch.tensor(rows, dtype=torch.float64).reshape(-1, width)
