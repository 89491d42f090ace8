"""The best one-to-one assignment of two sets, some of which may stay alone, and how far the next best one is away.

The assignment is exact (Crouse, "On implementing 2D rectangular assignment algorithms", 2016, by SciPy). What another
assignment costs more is a shortest cycle through what the best one has chosen: n columns take one search, in place of
n assignments.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

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
