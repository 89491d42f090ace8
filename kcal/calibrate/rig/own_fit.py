"""How well each source of a rig fits itself: what its items leave over where nothing else is known of the cameras.

Marks by hand are often worse than their sigmas say. Beside a thousand good matches that hardly shows in the χ² of all,
yet the marks pull at the cameras as if they were right, and what they contradict then looks wrong. So each source is
asked alone, with what is known of the lenses: what the others say of the cameras, right or wrong, does not enter. Its
sigmas are multiplied by what its own residuals tell (a variance component, Förstner 1979, of each source by itself).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.rig.blocks import Kind, RigState
from kcal.calibrate.rig.problem import RigProblem
from kcal.gaussian import inverse_root

# Eigenvalues of a scaled normal matrix below this share of the largest are rounding.
_RANK_TOLERANCE = 1e-10


class Least(NamedTuple):
    """The least χ² of some rows, how many unknowns they determine, and where it is.

    Attributes:
        chi2: the least.
        rank: number of unknowns that are determined.
        step: (S,) to the minimum.
        root: (S, R) of the covariance there.
    """

    chi2: float
    rank: int
    step: Tensor
    root: Tensor


def least(gram: Tensor) -> Least:
    """The minimum of rows whose products (S + 1, S + 1) are given, residuals last."""
    N, g = gram[:-1, :-1], gram[:-1, -1]
    scale = torch.where(N.diagonal() > 0, N.diagonal(), 1.0).rsqrt()
    root, _ = inverse_root(N * scale[:, None] * scale, scale, _RANK_TOLERANCE)
    pull = g @ root
    return Least(float(gram[-1, -1] - pull.square().sum()), root.shape[1], -root @ pull, root)


class OwnFit(NamedTuple):
    """The χ² of a source alone, and its degrees of freedom."""

    chi2: float
    freedom: int


def own_fits(problem: RigProblem, state: RigState) -> dict[Kind, OwnFit]:
    """The fit of each source of items alone, with what is known beforehand, from their rows at a solution of all.

    Boards have none: their corners' noise is estimated as it is.
    """
    prior, found = problem.prior_rows(state), dict[Kind, OwnFit]()
    known = prior @ prior.T
    for block, gram in zip(problem.blocks, problem.block_grams(state), strict=True):
        if block.kind != "boards":
            alone = least(gram + known)
            rows = int((block.counts - block.size).sum()) + prior.shape[1]
            found[block.kind] = OwnFit(alone.chi2, rows - alone.rank)
    return found
