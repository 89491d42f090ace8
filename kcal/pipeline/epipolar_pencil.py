"""Points where lines of sight of two cameras meet, found by sorting: no camera's marks are compared with all others'.

Planes through two cameras form a pencil. A line of sight of either is in one of them, told by an angle about the line
that joins the cameras; those that meet have equal angles. Angles are sorted, and each takes its neighbors within the
noise. Light bends, so planes are found roughly first; how far the lines of sight pass by each other is then compared at
the ranges where they do.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from kcal.pipeline.assignment import assign_groups

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
# Meters: light from the farthest targets bends by no more than on such a way.
FARTHEST_BEND_M = 1e5
# Ranges of lines of sight that cross at a flatter angle, in sigmas of it, are not known to first order.
_FLAT = 10.0


class StationSights(NamedTuple):
    """N lines of sight of C cameras, all in one frame.

    Attributes:
        camera: (N,) number of the camera of each.
        ray: (N, 3) unit vectors.
        sigma: (N,) radians, standard deviation along each axis across it.
        place: (C,) meters, that of each camera's place.
        air: that of `bending`, 1/m.
        center: (C, 3) meters.
        up: (C, 3) verticals at the cameras.
        bending: k / 2R, 1/m.
    """

    camera: Ints
    ray: Floats
    sigma: Floats
    place: Floats
    air: float
    center: Floats
    up: Floats
    bending: float

    def wide(self, which: Ints, range_: Floats, camera: int) -> Floats:
        """(...) meters: standard deviation across lines of sight of a camera, at ranges."""
        return np.sqrt((self.sigma[which] * range_) ** 2 + self.place[camera] ** 2 + (self.air * range_**2) ** 2)


class Meetings(NamedTuple):
    """Where pairs of lines of sight meet.

    Attributes:
        first: (L,) numbers of lines of sight.
        second: (L,).
        point: (L, 3).
        sigma: (L,) meters, of the worst axis.
        range: (L,) meters from the first camera.
        squared: (L,) by how much they pass by each other, squared sigmas.
    """

    first: Ints
    second: Ints
    point: Floats
    sigma: Floats
    range: Floats
    squared: Floats

    def at(self, which: NDArray[np.generic]) -> Meetings:
        """Some of them."""
        return Meetings(*(value[which] for value in self))


def meetings(lines: StationSights, rows: Ints, others: Ints, gate: float, nearest: float) -> Meetings:
    """Where lines of sight of one camera meet those of another within `gate` standard deviations.

    Those that cross at a small angle are left out: nothing linear is known of their range.

    Args:
        lines: of all cameras.
        rows: numbers of those of one camera.
        others: numbers of those of another.
        gate: standard deviations.
        nearest: meters; at smaller ranges, errors of the cameras' places are wider than the gate.

    Example:
        >>> ray = np.array([[0.0, 1.0, 0.0], [-0.6, 0.8, 0.0], [-0.6, 0.8, 0.01]])
        >>> lines = StationSights(np.array([0, 1, 1]), ray, np.full(3, 1e-3), np.zeros(2), 0.0,
        ...                    np.array([[0.0, 0, 0], [600.0, 0, 0]]), np.array([[0.0, 0, 1]] * 2), 0.0)
        >>> found = meetings(lines, np.array([0]), np.array([1, 2]), 4.0, 100.0)
        >>> found.second.tolist(), (found.point.round(6) + 0.0).tolist()
        ([1], [[0.0, 800.0, 0.0]])
    """
    first, second = near_in_angle(lines, rows, others, gate, nearest)
    if not len(first):
        return Meetings(first, second, np.zeros((0, 3)), *(np.zeros(0),) * 3)
    a, b = int(lines.camera[first[0]]), int(lines.camera[second[0]])
    shift = lines.center[b] - lines.center[a]
    length = float(np.linalg.norm(shift))
    base = shift / length
    u, v = lines.ray[first], lines.ray[second]
    near, far = _ranges(u, v, base, length)
    good = (near > 0) & (far > 0) & (near < FARTHEST_BEND_M) & (far < FARTHEST_BEND_M)
    first, second = first[good], second[good]
    u, v, near, far = (value[good] for value in (u, v, near, far))
    if lines.bending:
        # Straight lines to where the bent ones lead.
        u = u - (lines.bending * near)[:, None] * lines.up[a]
        v = v - (lines.bending * far)[:, None] * lines.up[b]
        near, far = _ranges(u, v, base, length)
    start, end = near[:, None] * u, shift + far[:, None] * v
    spread = lines.wide(first, near, a) ** 2, lines.wide(second, far, b) ** 2
    both = spread[0] + spread[1]
    squared = ((start - end) ** 2).sum(1) / both
    crossing = np.sqrt(np.maximum(1.0 - (u * v).sum(1) ** 2 / ((u * u).sum(1) * (v * v).sum(1)), 0.0))
    flat = crossing < _FLAT * np.sqrt(spread[0] / near**2 + spread[1] / far**2)
    kept = (squared < gate**2) & ~flat & (near > 0) & (far > 0)
    share = (spread[1] / both)[:, None]
    point = lines.center[a] + share * start + (1.0 - share) * end
    sigma = np.sqrt(both[kept]) / crossing[kept]
    return Meetings(first[kept], second[kept], point[kept], sigma, near[kept], squared[kept])


def near_in_angle(lines: StationSights, rows: Ints, others: Ints, gate: float, nearest: float) -> tuple[Ints, Ints]:
    """Pairs whose planes through both cameras are the same within the noise and what light may bend; see `meetings`.

    Cameras in one place have no such planes: no pairs.
    """
    if not len(rows) or not len(others):
        return rows[:0], others[:0]
    shift = lines.center[lines.camera[others[0]]] - lines.center[lines.camera[rows[0]]]
    length = float(np.linalg.norm(shift))
    if not length:
        return rows[:0], others[:0]
    base = shift / length
    across = np.cross(base, np.eye(3)[np.abs(base).argmin()])
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(base, across)])
    angles, widths = [], []
    for which in (rows, others):
        x, y = axes @ lines.ray[which].T
        angles.append(np.arctan2(y, x))
        unsure = lines.place[lines.camera[which[0]]] / nearest
        wide = gate * np.hypot(lines.sigma[which], unsure) + (lines.bending + gate * lines.air) * FARTHEST_BEND_M
        # Within the noise of the line through both cameras, any plane is possible.
        ratio = wide / np.maximum(np.hypot(x, y), 1e-12)
        widths.append(np.where(ratio < 1.0, np.arcsin(np.minimum(ratio, 1.0)), np.pi))
    # Around the circle: each angle of the others thrice.
    turns = (angles[1] + 2.0 * np.pi * np.array([[-1.0], [0.0], [1.0]])).ravel()
    order = np.argsort(turns)
    ordered, reach = turns[order], widths[0] + widths[1].max()
    low, high = np.searchsorted(ordered, angles[0] - reach), np.searchsorted(ordered, angles[0] + reach)
    count = high - low
    first = np.repeat(np.arange(len(rows)), count)
    place = np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(low, count)
    second = order[place] % len(others)
    kept = np.abs(ordered[place] - angles[0][first]) <= np.hypot(widths[0][first], widths[1][second])
    return rows[first[kept]], others[second[kept]]


def in_range(
    lines: StationSights, pairs: tuple[Ints, Ints], gate: float, ranges: tuple[float, float]
) -> NDArray[np.bool_]:
    """(L,) bool: pairs of straight lines that may meet between two ranges from the first camera, within the noise."""
    u, v = (lines.ray[which] for which in pairs)
    a, b = (lines.camera[which] for which in pairs)
    shift = lines.center[b] - lines.center[a]
    across = np.cross(shift, v)
    length = np.maximum(np.linalg.norm(across, axis=1), 1e-12)
    inverse = (np.cross(u, v) * across).sum(1) / length**2
    place = np.hypot(lines.place[a], lines.place[b])
    stretch = (lines.sigma[pairs[1]] * np.linalg.norm(shift, axis=1) + place) / length
    reach = gate * ((lines.sigma[pairs[0]] + lines.sigma[pairs[1]]) / length + np.abs(inverse) * stretch)
    # Near the line through both cameras nothing is said of the distance.
    return (gate * stretch > 0.3) | ((inverse + reach >= 1.0 / ranges[1]) & (inverse - reach <= 1.0 / ranges[0]))


def _ranges(u: Floats, v: Floats, base: Floats, length: float) -> tuple[Floats, Floats]:
    """Where lines along u and v from two points, `length` apart along `base`, are nearest to each other."""
    aa, bb, ab = (u * u).sum(1), (v * v).sum(1), (u * v).sum(1)
    along, back = u @ base, v @ base
    area = np.maximum(aa * bb - ab * ab, 1e-300)
    return length * (along * bb - back * ab) / area, length * (along * ab - back * aa) / area


# Detections of targets that most cameras see: found where lines of sight of two meet and those of others pass by.
#
# Each meeting of two lines of sight is looked up in trees of the other cameras' lines of sight. Those that enough
# cameras confirm are groups. Where r cameras may miss a target, r + 1 pairs of cameras, no two of which share a camera,
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


@dataclass(frozen=True, eq=False)
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

    lines: StationSights
    kind: Ints
    axis: Floats
    inner: Floats
    there: list[int]
    gate: float
    near: float
    nearest: float

    @functools.cached_property
    def place(self) -> Floats:
        """(N, 4) where lines of sight are in the trees: a fourth axis keeps kinds apart."""
        return np.column_stack([self.lines.ray, _ELSEWHERE * self.kind])

    def found(self, pair: tuple[int, int], misses: int, free: NDArray[np.bool_]) -> Ints:
        """(K, V) marks of groups that two cameras see, and all others but so many that have them in their images.

        Args:
            pair: of cameras.
            misses: how many cameras may miss a target.
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
        return self._assigned(self._chosen(done, misses), own, trees)[0]

    def settled(self, marks: Ints, free: NDArray[np.bool_]) -> tuple[Ints, NDArray[np.bool_]]:
        """Groups (K, V) with the marks of each camera assigned to all of them anew, -1 where there is none.

        Also where (K, V) another assignment of a mark is about as likely.
        """
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
                widest = self.gate * float(sigma.max(initial=0.0)) + 1e-12
                wanted = np.column_stack([look, _ELSEWHERE * self.kind[meet.first]])
                apart, place = trees[c].query(wanted, distance_upper_bound=widest)
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
            mark = done.marks[:, c]
            across = _sideways(self.lines.ray[mark])
            weight = np.where(mark >= 0, _ALL_BUT / self.lines.wide(mark, away[:, c, 0], c) ** 2, 0.0)
            spread = np.linalg.inv(done.normal - weight[:, None, None] * across)
            moved = (spread @ (weight[:, None, None] * across) @ lines[:, c, :, None])[..., 0]
            at = lines[:, c] + moved
            at = at / np.linalg.norm(at, axis=1, keepdims=True)
            side = _sideways(at)
            wide = self.lines.wide(own[c][:1], away[:, c], c)
            noise = (side @ spread @ side + wide[..., None] ** 2 * np.eye(3)) / away[:, c, :, None] ** 2
            widest = np.sqrt(np.trace(noise, axis1=1, axis2=2).max(initial=0.0))
            wanted = np.column_stack([at, _ELSEWHERE * kind])
            neighbors = np.arange(min(_NEIGHBORS, len(own[c]))) + 1
            apart, place = trees[c].query(wanted, k=neighbors, distance_upper_bound=self.gate * widest)
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

    def _assigned(
        self, done: _FittedGroups, own: list[Ints], trees: dict[int, cKDTree]
    ) -> tuple[Ints, NDArray[np.bool_]]:
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
        return marks[several], rival[several]

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
    return np.eye(3) - ray[..., :, None] * ray[..., None, :]


def separate_pairs(center: Floats, axis: Floats, there: list[int]) -> list[tuple[int, int]]:
    """Pairs of cameras, no two with a camera in common, that see targets from directions as different as possible.

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
