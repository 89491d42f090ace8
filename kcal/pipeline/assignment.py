"""Which of one set belongs to which of another, one to one: detections of two images, and sightings of tracks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from kcal.pipeline.imm_filter import Beliefs, Timing
from kcal.pipeline.measurements import Anchored, Sightings, outer, product, rooted

# The best one-to-one assignment of two sets, some of which may stay alone, and how far the next best one is away.
#
# The assignment is exact (Crouse, "On implementing 2D rectangular assignment algorithms", 2016, by SciPy). What another
# assignment costs more is a shortest cycle through what the best one has chosen: n columns take one search, in place of
# n assignments.

Floats = NDArray[np.float64]
# Nothing weighs exactly zero in a sparse graph; sums of costs are not known better.
_NOTHING = 1e-12
# Elements of distances that are held at once.
_AT_ONCE = 1 << 22


def assign_groups(cost: Floats, alone: float, near: float) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """For each row its column or -1, and whether another pairing of the two costs less than `near` more.

    Args:
        cost: (N, M); infinite where a pair is impossible.
        alone: what a row and a column that stay alone cost together.
        near: costs.

    Example:
        >>> assign_groups(np.array([[1.0, 2.0], [2.0, 1.5]]), 16.0, 6.0)
        (array([0, 1]), array([ True,  True]))
    """
    chosen, rival = np.full(len(cost), -1), np.zeros(len(cost), dtype=bool)
    worth = cost < alone
    rows, columns = np.nonzero(worth)
    # Most pairs have no other one: they need no search.
    single = (worth.sum(1)[rows] == 1) & (worth.sum(0)[columns] == 1)
    chosen[rows[single]] = columns[single]
    rows, columns = np.unique(rows[~single]), np.unique(columns[~single])
    if len(rows):
        part = cost[np.ix_(rows, columns)]
        best, _ = best_assignment(part, alone)
        chosen[rows] = np.where(best >= 0, columns[best], -1)
        rival[rows] = _has_rival(np.minimum(part - alone, 0.0), best, near)
    return chosen, rival


def best_assignment(cost: Floats, alone: float) -> tuple[NDArray[np.int64], float]:
    """Columns of the rows, or -1, and the sum of costs, where two that stay alone cost `alone` together.

    Example:
        >>> best_assignment(np.array([[1.0, 9.0], [2.0, 9.0]]), 4.0)
        (array([ 0, -1]), 5.0)
    """
    # A pair that costs as much as two that stay alone is none.
    saved = np.minimum(cost - alone, 0.0)
    rows, columns = linear_sum_assignment(saved)
    worth = saved[rows, columns] < 0
    chosen = np.full(len(cost), -1)
    chosen[rows[worth]] = columns[worth]
    return chosen, float(saved[rows, columns].sum() + 0.5 * alone * sum(cost.shape))


def _has_rival(saved: Floats, best: NDArray[np.int64], near: float) -> NDArray[np.bool_]:
    """(N,) bool: giving a member of the row's pair another partner costs at most `near`, and less than leaving both.

    In the graph of the pairs, an edge from a to b says that the row of a takes the column of b. One more node stands
    for whatever is alone: an edge to it frees a row, or gives it a column that was alone; an edge from it frees a
    column, or gives it to a row that was alone. Every other assignment is made of cycles.
    """
    rows = np.flatnonzero(best >= 0)
    columns = best[rows]
    free_rows = np.setdiff1d(np.arange(len(saved)), rows)
    free_columns = np.setdiff1d(np.arange(saved.shape[1]), columns)
    count = len(rows)
    own = saved[rows, columns]
    step = np.zeros((count + 1, count + 1))
    step[:-1, :-1] = saved[np.ix_(rows, columns)] - own[:, None]
    leaving = saved[np.ix_(rows, free_columns)].min(1, initial=0.0)
    coming = saved[np.ix_(free_rows, columns)].min(0, initial=0.0)
    step[:-1, -1] = leaving - own
    step[-1, :-1] = coming
    # An edge that takes an impossible pair is none; its costs are those of staying alone.
    impossible = np.zeros_like(step, dtype=bool)
    impossible[:-1, :-1] = saved[np.ix_(rows, columns)] >= 0.0
    step[impossible] = np.inf
    np.fill_diagonal(step, np.inf)
    # Both alone: what they saved is lost.
    limit = np.minimum(near, -own * (1.0 - 1e-9))
    # Cycles of two, which are most of them; the last node counts where one of its edges gives another partner.
    around = step + step.T
    around[:-1, -1] = np.where((leaving < 0) | (coming < 0), around[:-1, -1], np.inf)
    found = around[:-1].min(1) < limit
    rest = np.flatnonzero(~found)
    if len(rest):
        found[rest] = _shortest_cycles(step, rest, near) < limit[rest]
    rival = np.zeros(len(saved), dtype=bool)
    rival[rows] = found
    return rival


def _shortest_cycles(step: Floats, nodes: NDArray[np.int64], near: float) -> Floats:
    """The length of the shortest cycle of three edges or more through each node; infinite beyond `near`.

    A cycle of two through the last node is left out: it says that both are alone.
    """
    # Potentials make all edges positive: no cycle is negative, because the assignment is the best one.
    potential = np.zeros(len(step))
    for _ in range(len(step)):
        lower = (potential[:, None] + step).min(0)
        if not (lower < potential - _NOTHING).any():
            break
        potential = np.minimum(potential, lower)
    weight = np.maximum(step + potential[:, None] - potential, 0.0) + _NOTHING
    keep = np.nonzero(weight < near)
    graph = scipy.sparse.csr_array((weight[keep], keep), shape=weight.shape)
    shortest = np.full(len(nodes), np.inf)
    size = max(1, _AT_ONCE // len(step))
    last = len(step) - 1
    for first in range(0, len(nodes), size):
        part = nodes[first : first + size]
        away, before = scipy.sparse.csgraph.dijkstra(graph, indices=part, limit=near, return_predecessors=True)
        back = away + weight[:, part].T
        # The way to the last node straight from here, and straight back.
        alone = before[:, last] == part
        back[alone, last] = np.inf
        back[np.arange(len(part)), part] = np.inf
        shortest[first : first + size] = back.min(1)
    return shortest


# Which sighting belongs to which track: gates, one-to-one assignment, and marks that several sightings claim.


class Scores(NamedTuple):
    """L possible matches of sightings with merged beliefs.

    Attributes:
        seen: the sightings in the tracks' frames.
        effect: (M, K + Q, L) of the shared errors on the innovation.
        innovation: (M, L).
        covariance: (M, M, L) of its noise.
        squared: (L,) squared Mahalanobis distance.
        log_density: (L,).
    """

    seen: Anchored
    effect: Tensor
    innovation: Tensor
    covariance: Tensor
    squared: Tensor
    log_density: Tensor

    def at(self, which: Tensor) -> Self:
        """The matches at some places."""
        return type(self)(self.seen.at(which), *(value.index_select(-1, which) for value in self[1:]))


class SeenFrom(NamedTuple):
    """Where V cameras stand, and what shared errors make of their attitude.

    Attributes:
        center: (V, 3) in the rig's frame.
        turned: (3, K, V) turn of a camera by each of the first K shared errors, radians; None: attitudes are exact.
    """

    center: Tensor
    turned: Tensor | None


class Candidates(NamedTuple):
    """L possible matches within the gate.

    Attributes:
        track: (L,) numbers of tracks.
        pair: (L,) numbers of sightings.
        scores: how well they match.
    """

    track: Tensor
    pair: Tensor
    scores: Scores


class Looks(NamedTuple):
    """How each of V cameras should see T tracks.

    Attributes:
        ray: (3, V, T) unit vectors in the rig's frame.
        spread: (V, T) squared radians: variance of both components across it.
        pace: (V, T) squared radians per second.
    """

    ray: Tensor
    spread: Tensor
    pace: Tensor


def looks_of(beliefs: Beliefs, frame: Tensor, home: Tensor, cameras: SeenFrom, root: Tensor | None) -> Looks:
    """Where cameras should see tracks.

    Args:
        beliefs: merged, (..., 1, T), predicted.
        frame: (3, 3, T).
        home: (3, T) origins of the frames.
        cameras: V of them.
        root: of the covariance of the shared errors; None: the identity.
    """
    mean, noise = beliefs.mean[:, 0], beliefs.noise[:, :, 0]
    back = frame.transpose(0, 1)
    apart = home[:, None] - cameras.center.T[..., None]  # (3, V, T)
    ray = product(back, torch.cat([mean[:2], torch.ones_like(mean[:1])])[:, None])[:, 0]
    line = ray[:, None] + mean[2] * apart
    length = line.square().sum(0).sqrt()
    unit = line / length
    # By x / z, y / z and 1 / z, in the frame of the rig: (3, 3, V, T).
    slope = torch.cat([back[:, :2, None].expand(-1, -1, *length.shape), apart[:, None]], 1)
    slope = (slope - outer(unit, (unit[:, None] * slope).sum(0))) / length
    random = (product(slope, noise[:3, :3, None]) * slope).sum((0, 1))
    moved = product(slope, beliefs.effect[:3, :, 0][:, :, None])
    if cameras.turned is not None:
        # A camera that is turned sees sightings and tracks turned alike: only what differs counts.
        turn = cameras.turned[..., None]  # (3, K, V, 1)
        turned = torch.linalg.cross(turn, unit[:, None], dim=0)
        rest = moved.shape[1] - turn.shape[1]
        moved = moved - torch.nn.functional.pad(turned, (0, 0, 0, 0, 0, rest))
    spread = random + rooted(moved, root).square().sum((0, 1))
    pace = (mean[3:].square().sum(0) + noise[3, 3] + noise[4, 4]) / length.square()
    return Looks(unit, spread, pace)


def nearby(looks: Looks, seen: Sightings, timing: Timing, gate: Tensor) -> Tensor:
    """(T, N) bool: sightings that are roughly where their first camera should see a track.

    Args:
        looks: at tracks.
        seen: N sightings.
        timing: of them.
        gate: largest squared Mahalanobis distance.
    """
    other = seen.direction / seen.direction.square().sum(0).sqrt()
    ray, spread, pace = (value.index_select(-2, seen.anchor) for value in looks)  # (3, N, T), (N, T), (N, T)
    apart = (ray - other[..., None]).square().sum(0)
    late = timing.delay.abs().amax(0)
    if len(timing.unsure):
        late = late + timing.unsure.amax(0)
    # Rows of unit noise: the inverse of their squares is the variance across.
    both = seen.late.sum(0)[:, :2].square().sum(0)
    own = 2.0 / both.amin(0).clamp_min(1e-12)
    return ((apart <= 2.0 * gate * (spread + own[:, None] + pace * late.square()[:, None])) & seen.usable[:, None]).T


def within(scores: Scores, track: Tensor, pair: Tensor, gate: Tensor) -> Candidates:
    """Those in front of the track and within the gate (L,)."""
    good = scores.seen.ahead & (scores.squared <= gate)
    which = good.nonzero()[:, 0]
    if len(which) < len(good):
        track, pair, scores = track[which], pair[which], scores.at(which)
    return Candidates(track, pair, scores)


def assigned(
    possible: Candidates, ends: Sequence[set[tuple[int, int]]], evidence: Sequence[float], tiers: Sequence[int]
) -> list[int]:
    """Rows of `possible` to accept: each track, sighting and mark at most once, with the largest sum of log densities.

    Args:
        possible: all matches inside the gates.
        ends: of N sightings, numbers of cameras and of their marks.
        evidence: (T,) of each track so far: settles between tracks that want the same mark by different sightings.
        tiers: (T,) tracks of tier 0 choose before those of tier 1; tracks of a negative tier do not choose.
    """
    track, pair, density = possible.track.tolist(), possible.pair.tolist(), possible.scores.log_density.tolist()
    used: set[tuple[int, int]] = set()
    done: set[int] = set()
    accepted: list[int] = []
    for tier in (0, 1):
        rows = [i for i, t in enumerate(track) if tiers[t] == tier]
        while rows := [
            i for i in rows
            if track[i] not in done and not ends[pair[i]] & used
        ]:  # fmt: skip
            chosen = _best_rows(rows, track, pair, density)
            for i in sorted(chosen, key=lambda i: -(evidence[track[i]] + density[i])):
                if not ends[pair[i]] & used:
                    accepted.append(i)
                    done.add(track[i])
                    used |= ends[pair[i]]
    return accepted


def _best_rows(rows: list[int], track: list[int], pair: list[int], density: list[float]) -> list[int]:
    """The rows of the best assignment, each track and pair once."""
    if len({track[i] for i in rows}) == len({pair[i] for i in rows}) == len(rows):
        return rows
    tracks, at_track = np.unique([track[i] for i in rows], return_inverse=True)
    pairs, at_pair = np.unique([pair[i] for i in rows], return_inverse=True)
    densities = np.array([density[i] for i in rows])
    # Worse than any that is possible: such a match is dropped afterwards.
    worst = densities.min() - (np.ptp(densities) + 1.0) * (len(tracks) + 1)
    gain = np.full((len(tracks), len(pairs)), worst)
    number = np.full(gain.shape, -1)
    gain[at_track, at_pair] = densities
    number[at_track, at_pair] = rows
    return [int(i) for i in number[linear_sum_assignment(gain, maximize=True)] if i >= 0]
