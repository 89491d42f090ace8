"""Small matrices, many at once: rows and columns are the first axes, and the last ones count the matrices.

One operation then runs along many matrices, where `@` takes them one by one; a compiler makes loops over consecutive
numbers of it.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


def product(first: Tensor, second: Tensor) -> Tensor:
    """Of matrices (R, M, ...) and (M, C, ...).

    Example:
        >>> first, second = torch.rand(2, 3, 10), torch.rand(3, 4, 10)
        >>> torch.allclose(product(first, second).movedim(-1, 0), first.movedim(-1, 0) @ second.movedim(-1, 0))
        True
    """
    return (first[:, :, None] * second).sum(1)


def outer(first: Tensor, second: Tensor) -> Tensor:
    """(R, C, ...) from vectors (R, ...) and (C, ...)."""
    return first[:, None] * second


def congruent(slope: Tensor, covariance: Tensor) -> Tensor:
    """Slope covariance slopeᵀ: (R, R, ...) from (R, M, ...) and (M, M, ...)."""
    return product(product(slope, covariance), slope.transpose(0, 1))


def squared(root: Tensor) -> Tensor:
    """Root rootᵀ: (R, R, ...) from (R, M, ...)."""
    return product(root, root.transpose(0, 1))


def rooted(effect: Tensor, root: Tensor | None) -> Tensor:
    """Effect root: (R, M, ...) from (R, K, ...) and one root (K, M) for all; None: the identity."""
    return effect if root is None else torch.tensordot(effect, root, ([1], [0])).movedim(-1, 1)


class Eliminated(NamedTuple):
    """Gauss's elimination of symmetric positive S (R, R, ...) beside columns B (R, C, ...): S = L D Lᵀ.

    No rows are exchanged, which positive matrices do not need, whatever the units of their rows.

    Attributes:
        pivots: (R, ...) of D; positive, also where rounding left none.
        rows: (R, R, ...) of D Lᵀ, upper triangular.
        columns: (R, C, ...) L⁻¹ B.
    """

    pivots: Tensor
    rows: Tensor
    columns: Tensor


def eliminate(matrix: Tensor, columns: Tensor) -> Eliminated:
    """See `Eliminated`.

    Example:
        >>> done = eliminate(torch.tensor([[4.0, 2.0], [2.0, 3.0]])[..., None], torch.tensor([[2.0], [5.0]])[..., None])
        >>> done.pivots[:, 0].tolist(), done.columns[:, 0, 0].tolist()
        ([4.0, 2.0], [2.0, 4.0])
    """
    size = len(matrix)
    rest, upper, pivots = torch.cat([matrix, columns], 1), [], []
    for step in range(size):
        row = rest[0]
        pivots.append(row[step].clamp_min(1e-300))
        upper.append(row)
        if step < size - 1:
            below = rest[1:]
            rest = torch.addcmul(below, (below[:, step] / pivots[-1])[:, None], row, value=-1.0)
    whole = torch.stack(upper)
    return Eliminated(torch.stack(pivots), whole[:, :size], whole[:, size:])


def solved(done: Eliminated) -> Tensor:
    """(R, C, ...) S⁻¹ B."""
    size = len(done.rows)
    found = [done.columns[-1] / done.pivots[-1]]
    for step in range(size - 2, -1, -1):
        known = (done.rows[step, step + 1 :, None] * torch.stack(found)).sum(0)
        found.insert(0, (done.columns[step] - known) / done.pivots[step])
    return torch.stack(found)


def mahalanobis(covariance: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
    """valueᵀ covariance⁻¹ value and the logarithm of the determinant, (...) each, from (R, R, ...) and (R, ...)."""
    done = eliminate(covariance, value[:, None])
    return (done.columns[:, 0].square() / done.pivots).sum(0), done.pivots.log().sum(0)
