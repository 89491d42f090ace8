"""Which pair belongs to which track: gates, one-to-one assignment, and marks that several pairs claim."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from kcal.pipeline.imm_filter import Beliefs, Timing
from kcal.pipeline.measurements import Anchored, Sightings
from kcal.pipeline.small_matrices import product


class Scores(NamedTuple):
    """L possible matches of sightings with merged beliefs.

    Attributes:
        seen: the sightings in the tracks' frames.
        effect: (4, K + 3, L) of the shared errors on the innovation.
        innovation: (4, L).
        covariance: (4, 4, L) of its noise.
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
        return type(self)(self.seen.at(which), *(value[..., which] for value in self[1:]))


class Candidates(NamedTuple):
    """L possible matches within the gate.

    Attributes:
        track: (L,) numbers of tracks.
        pair: (L,) numbers of pairs.
        scores: how well they match.
    """

    track: Tensor
    pair: Tensor
    scores: Scores


def nearby(beliefs: Beliefs, frame: Tensor, seen: Sightings, timing: Timing, root: Tensor, gate: Tensor) -> Tensor:
    """(T, N) bool: pairs that are roughly in the direction of a track.

    Args:
        beliefs: merged, (..., 1, T), predicted.
        frame: (3, 3, T).
        seen: N pairs.
        timing: of the pairs.
        root: of the covariance of the shared errors.
        gate: largest squared Mahalanobis distance.
    """
    mean, noise = beliefs.mean[:, 0], beliefs.noise[:, :, 0]
    ray = torch.cat([mean[:2], torch.ones_like(mean[:1])])
    ray = product(frame.transpose(0, 1), ray[:, None])[:, 0]
    ray, other = (value / value.square().sum(0).sqrt() for value in (ray, seen.direction))
    apart = (ray[:, :, None] - other[:, None]).square().sum(0)
    spread = product(beliefs.effect[:2, :, 0], root[..., None]).square().sum((0, 1))
    # A mark that is late has moved on.
    pace = mean[3:5].square().sum(0) + noise[3, 3] + noise[4, 4]
    late = timing.delay.abs().amax(0) + timing.unsure
    reach = (noise[0, 0] + noise[1, 1] + spread)[:, None] + seen.noise[0, 0] + seen.noise[1, 1]
    reach = reach + seen.shared[:2].square().sum((0, 1)) + pace[:, None] * late.square()
    return (apart <= 2.0 * gate * reach) & seen.usable


def within(scores: Scores, track: Tensor, pair: Tensor, gate: float) -> Candidates:
    """Those in front of the track and within the gate."""
    good = scores.seen.ahead & (scores.squared <= gate)
    which = good.nonzero()[:, 0]
    if len(which) < len(good):
        track, pair, scores = track[which], pair[which], scores.at(which)
    return Candidates(track, pair, scores)


def mark_numbers(left: Tensor, right: Tensor) -> NDArray[np.int64]:
    """(N, 2) numbers of the left and right marks: pairs with the same number share a mark.

    Example:
        >>> left = torch.tensor([[1.0, 2.0], [1.0, 2.0]])
        >>> mark_numbers(left, left + torch.tensor([[0.0], [1.0]])).tolist()
        [[0, 0], [0, 1]]
    """
    numbers = []
    for marks in (left, right):
        known: dict[tuple[float, ...], int] = {}
        numbers.append([known.setdefault(tuple(mark), len(known)) for mark in marks.tolist()])
    return np.array(numbers, dtype=np.int64).T


def assigned(
    possible: Candidates, marks: NDArray[np.int64], evidence: Sequence[float], tiers: Sequence[int]
) -> list[int]:
    """Rows of `possible` to accept: each track, pair and mark at most once, with the largest sum of log densities.

    Args:
        possible: all matches inside the gates.
        marks: from `mark_numbers`.
        evidence: (T,) of each track so far: settles between tracks that want the same mark by different pairs.
        tiers: (T,) tracks of tier 0 choose before those of tier 1; tracks of a negative tier do not choose.
    """
    track, pair, density = possible.track.tolist(), possible.pair.tolist(), possible.scores.log_density.tolist()
    ends = [tuple(both) for both in marks.tolist()]
    left: set[int] = set()
    right: set[int] = set()
    done: set[int] = set()
    accepted: list[int] = []
    for tier in (0, 1):
        rows = [i for i, t in enumerate(track) if tiers[t] == tier]
        while rows := [
            i for i in rows
            if track[i] not in done and ends[pair[i]][0] not in left and ends[pair[i]][1] not in right
        ]:  # fmt: skip
            chosen = _best_rows(rows, track, pair, density)
            for i in sorted(chosen, key=lambda i: -(evidence[track[i]] + density[i])):
                first, second = ends[pair[i]]
                if first not in left and second not in right:
                    accepted.append(i)
                    done.add(track[i])
                    left.add(first)
                    right.add(second)
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
