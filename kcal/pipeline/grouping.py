"""`group_objects`: which detections of any number of cameras are of one thing, by where their lines of sight meet."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from kcal.errors import InputError
from kcal.locate.multi_localizer import MultiViewLocalizer, common_errors, posed_cameras
from kcal.pipeline.association import MOST_BOXES, AssociationOptions, fit_some, pair_costs
from kcal.pipeline.detections import Detections
from kcal.pipeline.epipolar_pencil import Floats, Ints, Meetings, StationSights, meetings, near_in_angle
from kcal.pipeline.one_to_one import assign_groups
from kcal.pipeline.pairs import ObjectViews

# Detections of things that most cameras see: found where lines of sight of two meet and those of others pass by.
#
# Each meeting of two lines of sight is looked up in trees of the other cameras' lines of sight. Those that enough
# cameras confirm are groups. Where r cameras may miss a thing, r + 1 pairs of cameras, no two of which share a camera,
# find all: one of these pairs sees it. At last, the marks of each camera are assigned to all groups together, one to
# one.

# Fewer views leave chance too much room where detections are dense.
FEWEST_VIEWS = 4
# Marks of a camera that are compared with one point.
_NEIGHBORS = 4
# Squared sigmas by which candidates may lose against the best one of a mark before they are fitted.
_BEHIND = 16.0
# Of a view that is left out: without a rest, points that two views tell would have no range.
_ALL_BUT = 0.999
# Share of all information that is known of each axis.
_REST = 1e-12
# Further than all lines of sight are apart.
_ELSEWHERE = 10.0


class ClearGroups(NamedTuple):
    """K groups of V cameras.

    Attributes:
        marks: (K, V) numbers of detections, -1 where there is none.
        rival: (K, V) bool: another assignment of this mark is about as likely.
    """

    marks: Ints
    rival: NDArray[np.bool_]


class _FittedGroups(NamedTuple):
    """M groups with their points.

    Attributes:
        marks: (M, V).
        point: (M, 3).
        normal: (M, 3, 3) its inverse covariance.
        squared: (M, V) squared sigmas by which lines of sight pass by.
    """

    marks: Ints
    point: Floats
    normal: Floats
    squared: Floats

    def at(self, which: Ints) -> _FittedGroups:
        """Some of them."""
        return _FittedGroups(self.marks[which], self.point[which], self.normal[which], self.squared[which])


class Confirming:
    """Lines of sight in trees, one for each camera.

    Args:
        lines: of all cameras.
        kind: (N,) numbers of what detections are of: groups are of one kind.
        axis: (V, 3) where cameras look, in the lines' frame.
        inner: (V,) cosine of the widest cone about the axis that is inside the image.
        there: cameras that have an image.
        gate: standard deviations of a possible pair.
        near: squared sigmas within which another grouping is about as likely.
        nearest: see `meetings`.
    """

    def __init__(
        self,
        lines: StationSights,
        kind: Ints,
        axis: Floats,
        inner: Floats,
        there: list[int],
        gate: float,
        near: float,
        nearest: float,
    ) -> None:
        self.lines, self.axis, self.inner, self.there = lines, axis, inner, there
        self.kind, self.gate, self.near, self.nearest = kind, gate, near, nearest
        # A fourth axis keeps kinds apart.
        self.place = np.column_stack([lines.ray, _ELSEWHERE * kind])

    def found(self, pair: tuple[int, int], misses: int, free: NDArray[np.bool_]) -> Ints:
        """(K, V) marks of groups that two cameras see, and all others but so many that have them in their images.

        Args:
            pair: of cameras.
            misses: how many cameras may miss a thing.
            free: (N,) which marks may be taken.
        """
        own, trees = self._trees(free)
        meet = meetings(self.lines, own[pair[0]], own[pair[1]], self.gate, self.nearest)
        meet = meet.at(self.kind[meet.first] == self.kind[meet.second])
        marks, cost = self._confirmed(meet, pair, misses, own, trees)
        marks = self._best(marks, cost)
        done = self._fit(marks)
        for _ in range(2):
            # Nearest to the point that all views tell, without those that contradict.
            marks, _ = self._nearest(done, own, trees)
            done = self._fit(np.unique(marks[(marks >= 0).sum(1) >= FEWEST_VIEWS], axis=0))
        return self._assigned(self._chosen(done, misses), own, trees).marks

    def settled(self, marks: Ints, free: NDArray[np.bool_]) -> ClearGroups:
        """Groups (K, V) with the marks of each camera assigned to all of them anew."""
        own, trees = self._trees(free)
        return self._assigned(self._fit(marks), own, trees)

    def _trees(self, free: NDArray[np.bool_]) -> tuple[list[Ints], dict[int, cKDTree]]:
        """Numbers of each camera's marks, and trees of them."""
        own = [np.flatnonzero(free & (self.lines.camera == c)) for c in range(len(self.axis))]
        return own, {c: cKDTree(self.place[own[c]]) for c in self.there if len(own[c])}

    def _confirmed(
        self, meet: Meetings, pair: tuple[int, int], misses: int, own: list[Ints], trees: dict[int, cKDTree]
    ) -> tuple[Ints, Floats]:
        """(M, V) marks of meetings that enough cameras confirm, and what these groups save (M,)."""
        marks = np.full((len(meet.first), len(self.axis)), -1)
        marks[:, pair[0]], marks[:, pair[1]] = meet.first, meet.second
        missed, saved = np.zeros(len(marks), dtype=np.int64), self.gate**2 - meet.squared
        for c in self.there:
            if c in pair:
                continue
            line = self._line(meet.point, c)
            away = np.linalg.norm(line, axis=1)
            look = line / away[:, None]
            mark = np.full(len(marks), -1)
            if c in trees:
                # Marks of one camera are about as good as each other.
                sigma = np.hypot(self.lines.wide(own[c][:1], away, c), meet.sigma) / away
                apart, place = trees[c].query(
                    np.column_stack([look, _ELSEWHERE * self.kind[meet.first]]),
                    distance_upper_bound=self.gate * float(sigma.max(initial=0.0)) + 1e-12,
                )
                squared = (apart / sigma) ** 2
                hit = squared < self.gate**2
                mark[hit] = own[c][place[hit]]
                saved = saved + np.where(hit, self.gate**2 - squared, 0.0)
            marks[:, c] = mark
            missed += (mark < 0) & (look @ self.axis[c] > self.inner[c])
            kept = missed <= misses
            marks, missed, saved, meet = marks[kept], missed[kept], saved[kept], meet.at(kept)
        several = (marks >= 0).sum(1) >= FEWEST_VIEWS
        return marks[several], saved[several]

    def _best(self, marks: Ints, saved: Floats) -> Ints:
        """Those that are about the best ones of some mark, each once."""
        best = np.full(len(self.lines.camera) + 1, -np.inf)
        np.maximum.at(best, marks, np.broadcast_to(np.where(marks >= 0, saved[:, None], -np.inf), marks.shape))
        good = (saved[:, None] >= best[marks] - self.near - _BEHIND) & (marks >= 0)
        return np.unique(marks[good.any(1)], axis=0)

    def _line(self, point: Floats, camera: int) -> Floats:
        """From a camera to points (M, 3), as light comes in."""
        line = point - self.lines.center[camera]
        return line + self.lines.bending * (line**2).sum(1)[:, None] * self.lines.up[camera]

    def _weights(self, marks: Ints, away: Floats) -> Floats:
        """(M, V) one over squared meters across lines of sight."""
        return np.stack([self.lines.wide(marks[:, c], away[:, c], c) for c in range(len(self.axis))], 1) ** -2.0

    def _lines(self, point: Floats) -> Floats:
        return np.stack([self._line(point, c) for c in range(len(self.axis))], 1)

    def _fit(self, marks: Ints) -> _FittedGroups:
        """The points (M, 3) nearest to lines of sight, in sigmas; where light bends from is known well enough."""
        there = marks >= 0
        across = _sideways(self.lines.ray[marks])
        center = self.lines.center
        middle = center.mean(0)
        point, weight, bent = None, there.astype(float), center - middle + np.zeros((len(marks), 1, 1))
        for _ in range(3):
            normal = (weight[..., None, None] * across).sum(1)
            # Lines of sight that are all alike tell no range; they must not stop the others.
            normal = normal + _REST * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
            right = (weight[..., None] * (across @ bent[..., None])[..., 0]).sum(1)
            point = np.linalg.solve(normal, right[..., None])[..., 0]
            apart = ((point[:, None] + middle - center) ** 2).sum(-1)
            weight = np.where(there, self._weights(marks, np.sqrt(apart)), 0.0)
            bent = center - middle - (self.lines.bending * apart)[..., None] * self.lines.up
        assert point is not None
        rest = (across @ (point[:, None] - bent)[..., None])[..., 0]
        return _FittedGroups(marks, point + middle, normal, weight * (rest**2).sum(-1))

    def _nearest(
        self, done: _FittedGroups, own: list[Ints], trees: dict[int, cKDTree]
    ) -> tuple[Ints, list[tuple[Ints, Floats]]]:
        """(M, V) marks nearest to points by all other views; and of each camera nearest marks and squared sigmas."""
        count = len(self.axis)
        marks, near = np.full_like(done.marks, -1), []
        lines = self._lines(done.point)
        away = np.linalg.norm(lines, axis=2, keepdims=True)
        kind = self.kind[done.marks.max(1)]
        for c in range(count):
            if c not in trees:
                near.append((np.full((len(marks), 1), -1), np.full((len(marks), 1), np.inf)))
                continue
            # What the point would be, and how well known, without this camera.
            across = _sideways(self.lines.ray[done.marks[:, c]])
            weight = np.where(
                done.marks[:, c] >= 0, _ALL_BUT / self.lines.wide(done.marks[:, c], away[:, c, 0], c) ** 2, 0.0
            )
            spread = np.linalg.inv(done.normal - weight[:, None, None] * across)
            moved = (spread @ (weight[:, None, None] * across) @ lines[:, c, :, None])[..., 0]
            at = lines[:, c] + moved
            at = at / np.linalg.norm(at, axis=1, keepdims=True)
            side = _sideways(at)
            wide = self.lines.wide(own[c][:1], away[:, c], c)
            noise = (side @ spread @ side + wide[..., None] ** 2 * np.eye(3)) / away[:, c, :, None] ** 2
            widest = np.sqrt(np.trace(noise, axis1=1, axis2=2).max(initial=0.0))
            apart, place = trees[c].query(
                np.column_stack([at, _ELSEWHERE * kind]), k=np.arange(min(_NEIGHBORS, len(own[c]))) + 1,
                distance_upper_bound=self.gate * widest,
            )  # fmt: skip
            there = np.isfinite(apart)
            number = np.where(there, own[c][np.where(there, place, 0)], -1)
            rest = self.lines.ray[number] - at[:, None]
            squared = (rest * np.linalg.solve(noise[:, None], rest[..., None])[..., 0]).sum(-1)
            squared = np.where(there & (squared < self.gate**2), squared, np.inf)
            near.append((number, squared))
            best = squared.argmin(1)[:, None]
            value = np.take_along_axis(squared, best, 1)[:, 0]
            marks[:, c] = np.where(np.isfinite(value), np.take_along_axis(number, best, 1)[:, 0], -1)
        return marks, near

    def _chosen(self, done: _FittedGroups, misses: int) -> _FittedGroups:
        """Groups in the order of what they save, as far as none is about as likely that has other marks."""
        views = (done.marks >= 0).sum(1)
        saved = (views - 1) * self.gate**2 - done.squared.sum(1)
        kept = np.flatnonzero(self._enough(done, misses))
        owner = np.full(len(self.lines.camera), -1)
        chosen: list[np.int64] = []
        clear: list[bool] = []
        for one in kept[np.argsort(-saved[kept], kind="stable")]:
            marks = done.marks[one][done.marks[one] >= 0]
            free = owner[marks] < 0
            holders, shared = np.unique(owner[marks][~free], return_counts=True)
            # Groups that differ in one mark, or share a few, are told apart by the assignment, mark by mark.
            if free.sum() >= FEWEST_VIEWS:
                owner[marks[free]] = len(chosen)
                chosen.append(one)
                clear.append(True)
            elif shared.max() < len(marks) - 1:
                for holder in holders:
                    clear[holder] &= bool(saved[chosen[holder]] - saved[one] >= self.near)
        return done.at(np.array(chosen, dtype=np.int64)[np.array(clear, dtype=bool)])

    def _assigned(self, done: _FittedGroups, own: list[Ints], trees: dict[int, cKDTree]) -> ClearGroups:
        marks, rival = np.full_like(done.marks, -1), np.zeros(done.marks.shape, dtype=bool)
        for c, (number, squared) in enumerate(self._nearest(done, own, trees)[1]):
            if c not in trees or not len(marks):
                continue
            cost = np.full((len(marks), len(own[c])), np.inf)
            row, column = np.nonzero(np.isfinite(squared))
            cost[row, np.searchsorted(own[c], number[row, column])] = squared[row, column]
            best, rival[:, c] = assign_groups(cost, self.gate**2, self.near)
            marks[:, c] = np.where(best >= 0, own[c][best], -1)
        several = (marks >= 0).sum(1) >= FEWEST_VIEWS
        return ClearGroups(marks[several], rival[several])

    def _enough(self, done: _FittedGroups, misses: int) -> NDArray[np.bool_]:
        """Which groups have views enough that do not contradict each other."""
        there = done.marks >= 0
        look = self._lines(done.point)
        look = look / np.linalg.norm(look, axis=2, keepdims=True)
        inside = np.zeros(len(self.axis), dtype=bool)
        inside[self.there] = True
        missed = ((look * self.axis).sum(-1) > self.inner) & ~there & inside
        # Mean and some standard deviations of chi-squared.
        freedom = 2.0 * there.sum(1) - 3.0
        good = done.squared.sum(1) < freedom + self.gate * np.sqrt(2.0 * np.maximum(freedom, 1.0))
        return (there.sum(1) >= FEWEST_VIEWS) & (missed.sum(1) <= misses) & good


def _sideways(ray: Floats) -> Floats:
    """(..., 3, 3) what of a vector lies across unit vectors (..., 3)."""
    result: Floats = np.eye(3) - ray[..., :, None] * ray[..., None, :]
    return result


def separate_pairs(center: Floats, axis: Floats, there: list[int]) -> list[tuple[int, int]]:
    """Pairs of cameras, no two with a camera in common, that see things from directions as different as possible.

    Example:
        >>> axis = np.array([[1.0, 0, 0], [0.8, 0.6, 0], [0, 1, 0], [0, 1, 0]])
        >>> separate_pairs(np.arange(12.0).reshape(4, 3), axis, [0, 1, 2, 3])
        [(0, 2), (1, 3)]
    """
    worth = sorted(
        (abs(float(axis[a] @ axis[b])), a, b) for a in there for b in there if a < b and (center[a] != center[b]).any()
    )
    pairs: list[tuple[int, int]] = []
    for _, a, b in worth:
        if not {a, b} & {c for pair in pairs for c in pair}:
            pairs.append((a, b))
    return pairs


# `group_objects`: which detections of any number of cameras are of one thing, by where their lines of sight meet.
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
    """Numbers of detections, -1 for cameras that have none, and what the group saves beside staying alone."""

    marks: tuple[int, ...]
    saved: float


def group_objects(
    localize: MultiViewLocalizer, seen: Sequence[Detections | None], options: AssociationOptions | None = None
) -> ObjectViews:
    """Group the detections that the cameras of a rig have at one moment.

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
        >>> from kcal.lens.rig import CameraRig
        >>> from kcal.locate import enu_from_cam
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> look = torch.stack([enu_from_cam(heading).T for heading in (0.0, 315.0, 45.0)])
        >>> places = torch.tensor([[0.0, 0, 30], [5000.0, 0, 40], [-5000.0, 0, 35]])
        >>> rig = CameraRig([camera] * 3, ["mill", "church", "mast"], look, places, refraction=0.0,
        ...                 origin=Origin(lat=45.0, lon=6.0, height=0.0))
        >>> pixels, _ = rig(torch.tensor([[0.0, 5000, 100], [400.0, 5500, 100]]))
        >>> boxes = [torch.cat([p - 5, p + 5], -1) for p in pixels.unbind(1)]
        >>> seen = [Detections.read(b, size=(1920, 1080), time=7.0) for b in (boxes[0], boxes[1].flip(0), boxes[2][:1])]
        >>> views = group_objects(MultiViewLocalizer(rig), seen)
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
        groups, ambiguous = scene.chosen()
    taken = {mark for group, doubt in zip(groups, ambiguous, strict=True) if not doubt for mark in group}
    alone = [mark for mark in range(len(scene.camera)) if mark not in taken]
    count = len(rig)
    rows = [*groups, *(tuple(mark if c == scene.camera[mark] else -1 for c in range(count)) for mark in alone)]
    marks = [each.anchors(options.anchor) for each in seen if each is not None]
    every = torch.cat(marks) if marks else scene.pixels
    place = every.device
    numbers = torch.tensor(rows, dtype=torch.long, device=place).reshape(-1, count)
    there = numbers >= 0
    pixels = torch.where(there[..., None], every[numbers.clamp_min(0)], torch.nan)
    score = scene.score.to(place)
    stamps = [math.nan if each is None else float(each.time or 0.0) for each in seen]
    known = [stamp for stamp in stamps if math.isfinite(stamp)]
    filled = [stamp if math.isfinite(stamp) else min(known, default=0.0) for stamp in stamps]
    time = torch.tensor(filled, dtype=torch.float64, device=place)
    firsts = [next(mark for mark in row if mark >= 0) for row in rows]
    return ObjectViews(
        pixels=pixels,
        seen=there,
        covariance=options.box_sigma**2 * torch.eye(2 * count).to(every).expand(len(rows), -1, -1),
        time=time.expand(len(rows), count),
        score=torch.where(there, score[numbers.clamp_min(0)], torch.inf).amin(-1) if rows else score[:0],
        category=tuple(scene.category[mark] for mark in firsts),
        ambiguous=torch.tensor([*ambiguous, *[False] * len(alone)], dtype=torch.bool, device=place),
    )


class _Scene:
    """Detections of all cameras, counted through."""

    def __init__(
        self, localize: MultiViewLocalizer, seen: Sequence[Detections | None], options: AssociationOptions
    ) -> None:
        self.localize, self.options, self.posed = localize, options, posed_cameras(localize)
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
        self.lines = self._lines()

    def chosen(self) -> tuple[list[tuple[int, ...]], list[bool]]:
        """Groups of two views and more, each detection once, and which are ambiguous."""
        groups, doubts, free = self._clear()
        self.own = [own[free[own]] for own in self.own]
        more, more_doubts = self._remaining()
        return groups + more, doubts + more_doubts

    def _clear(self) -> tuple[list[tuple[int, ...]], list[bool], NDArray[np.bool_]]:
        """Groups that most cameras see, which are ambiguous, and which marks are of none of these things."""
        posed, options = self.posed, self.options
        there = [c for c, own in enumerate(self.own) if len(own)]
        groups: list[tuple[int, ...]] = []
        doubts: list[bool] = []
        free = np.ones(len(self.camera), dtype=bool)
        if len(there) < FEWEST_VIEWS:
            return groups, doubts, free
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
            return groups, doubts, free
        settled = confirming.settled(all_found, every)
        # Without the marks that could as well be of another thing, if views enough are left.
        sure = np.where(settled.rival, -1, settled.marks)
        doubtful = (sure >= 0).sum(1) < FEWEST_VIEWS
        rows = np.where(doubtful[:, None], settled.marks, sure)
        number = {mark: i for i, row in enumerate(rows.tolist()) for mark in row}
        for group in self._fitted([tuple(row) for row in rows.tolist()]):
            which = number[max(group.marks)]
            groups.append(group.marks)
            doubts.append(bool(doubtful[which]))
            free[settled.marks[which][settled.marks[which] >= 0]] = False
        return groups, doubts, free

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

    def _lines(self) -> StationSights:
        """Lines of sight of all detections."""
        posed, common = self.posed, common_errors(self.localize)
        moved, turned, air = torch.zeros(len(self.own)).double(), torch.zeros(len(self.own)).double(), 0.0
        if common is not None:
            moved, turned = common.half[..., :6].square().sum(0).sqrt().unflatten(-1, (2, 3)).amax(-1).unbind(-1)
            air = float(common.bending.square().sum().sqrt())
        ray, sigma = torch.zeros(len(self.camera), 3, dtype=torch.float64), torch.ones(len(self.camera)).double()
        for c, own in enumerate(self.own):
            camera, pixels = posed.cameras[c], self.pixels[own]
            steps = torch.stack([pixels, pixels + torch.tensor([1.0, 0.0]), pixels + torch.tensor([0.0, 1.0])])
            rays, valid = camera.unproject(steps)
            # What has no line of sight stays alone.
            self.own[c] = own[valid[0].numpy()]
            slope = (rays[1:] - rays[:1]).square().sum((0, -1)) / 2.0
            ray[own] = rays[0] @ posed.rotation[c]
            sigma[own] = (slope * self.options.box_sigma**2 + turned[c].square()).sqrt()
        up = torch.zeros_like(posed.center) if posed.up is None else posed.up
        return StationSights(
            self.camera,
            ray.numpy(),
            sigma.numpy(),
            moved.numpy(),
            air,
            posed.center.numpy(),
            up.numpy(),
            float(posed.bending),
        )

    def _remaining(self) -> tuple[list[tuple[int, ...]], list[bool]]:
        """Groups of what no clear group has."""
        cameras, edges = range(len(self.own)), self._edges()
        candidates = self._fitted(_with_one_range(edges, self.camera, len(self.own), self.options.gate))
        near = 2.0 * math.log(self.options.odds)
        by_mark: dict[int, list[_Group]] = {}
        for group in candidates:
            for mark in group.marks:
                by_mark.setdefault(mark, []).append(group)
        groups: list[tuple[int, ...]] = []
        doubts: list[bool] = []
        used: set[int] = set()
        for group in sorted(candidates, key=lambda group: -group.saved):
            marks = {mark for mark in group.marks if mark >= 0}
            if marks & used:
                continue
            used |= marks
            rivals = (other for mark in marks for other in by_mark[mark] if not {*other.marks} <= {*group.marks, -1})
            groups.append(group.marks)
            doubts.append(any(group.saved - other.saved < near for other in rivals))
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
                groups.append(tuple(pair.get(c, -1) for c in cameras))
                doubts.append(bool(rival[one]))
                left[list(pair.values())] = False
        return groups, doubts

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
        found = pair_costs(
            self.localize, torch.from_numpy(self.camera[both]), self.pixels[both], self.boxes[both], self.options,
            self.options.nearest,
        )  # fmt: skip
        kept = found.cost.numpy() < self.options.gate**2
        return _Edges(both[kept, 0], both[kept, 1], *(value.numpy()[kept] for value in found))

    def _fitted(self, groups: list[tuple[int, ...]]) -> list[_Group]:
        """Groups of three views and more, fitted; one view that contradicts is left out."""
        from scipy.special import chdtri

        good, gate = [], self.options.gate**2
        for _ in range(2):
            again: set[tuple[int, ...]] = set()
            for start in range(0, len(groups), _AT_ONCE):
                part = groups[start : start + _AT_ONCE]
                numbers = torch.tensor(part)
                found = fit_some(
                    self.localize, list(range(len(self.own))), self.pixels[numbers.clamp_min(0)], numbers >= 0,
                    self.options.box_sigma,
                )  # fmt: skip
                chi2, falls = found.misfits()
                views = found.used.sum(-1)
                ahead = found.fitted & (found.fit.inverse > 0) & ~found.behind(self.posed.center)
                worst = falls.argmax(-1).tolist()
                for group, value, count, there, one in zip(
                    part, chi2.tolist(), views.tolist(), ahead.tolist(), worst, strict=True
                ):
                    if there and count > 2 and value < chdtri(2 * count - 3, 1e-4):
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
