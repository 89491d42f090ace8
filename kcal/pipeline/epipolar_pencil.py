"""Points where lines of sight of two cameras meet, found by sorting: no camera's marks are compared with all others'.

Planes through two cameras form a pencil. A line of sight of either is in one of them, told by an angle about the line
that joins the cameras; those that meet have equal angles. Angles are sorted, and each takes its neighbors within the
noise. Light bends, so planes are found roughly first; how far the lines of sight pass by each other is then compared at
the ranges where they do.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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
    none = Meetings(*(np.zeros(0, dtype=np.int64),) * 2, np.zeros((0, 3)), *(np.zeros(0),) * 3)
    if not len(rows) or not len(others):
        return none
    a, b = int(lines.camera[rows[0]]), int(lines.camera[others[0]])
    shift = lines.center[b] - lines.center[a]
    length = float(np.linalg.norm(shift))
    if not length:
        return none
    base = shift / length
    first, second = near_in_angle(lines, rows, others, gate, nearest)
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
    return Meetings(
        first[kept], second[kept], point[kept], np.sqrt(both[kept]) / crossing[kept], near[kept], squared[kept]
    )


def near_in_angle(lines: StationSights, rows: Ints, others: Ints, gate: float, nearest: float) -> tuple[Ints, Ints]:
    """Pairs whose planes through both cameras are the same within the noise and what light may bend; see `meetings`.

    Cameras in one place have no such planes: no pairs.
    """
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
        widths.append(np.minimum(wide / np.maximum(np.hypot(x, y), 1e-12), np.pi))
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


def _ranges(u: Floats, v: Floats, base: Floats, length: float) -> tuple[Floats, Floats]:
    """Where lines along u and v from two points, `length` apart along `base`, are nearest to each other."""
    aa, bb, ab = (u * u).sum(1), (v * v).sum(1), (u * v).sum(1)
    along, back = u @ base, v @ base
    area = np.maximum(aa * bb - ab * ab, 1e-300)
    return length * (along * bb - back * ab) / area, length * (along * ab - back * aa) / area
