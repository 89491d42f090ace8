"""Small items eliminated before a system is damped: each has a few unknowns of its own and few residuals more.

A match between two images has three unknowns and four residuals, so that one residual is left, the epipolar one. With
20,000 of them the products of all rows of each item would fill the memory; the residuals that are left do not (variable
projection: G. Golub and V. Pereyra 1973).
"""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.solve.result import State
from kcal.solve.schur import SchurLinearization, column_scale


class EliminatedItems:
    """V items without their own unknowns.

    Args:
        rows: (V, L + S + 1, R), R > L, see `kcal.solve.schur.SchurProblem.rows`.
        size: L.

    Attributes:
        rows: (V, S + 1, R - L) derivatives and, last, residuals that an item's own unknowns cannot change.
    """

    def __init__(self, rows: Tensor, size: int) -> None:
        local = rows[:, :size].mT
        self._scale = column_scale(local.square().sum(1))
        basis, self._factor = torch.linalg.qr(local * self._scale[:, None], mode="complete")
        turned = rows[:, size:] @ basis
        self._inside, self.rows = turned[..., :size], turned[..., size:].contiguous()
        self._factor = self._factor[:, :size]

    @property
    def gram(self) -> Tensor:
        """(S + 1, S + 1) products of `rows`, summed over all items."""
        flat = self.rows.transpose(0, 1).flatten(1)
        return flat @ flat.T

    def step(self, shared: Tensor, damping: Tensor) -> tuple[Tensor, Tensor]:
        """Steps (V, L) of the items' own unknowns that follow a step (S,) of the shared ones, and what they gain ().

        They are damped; what is gained is predicted beyond the fall of the squares of `rows`.
        """
        before = self._inside[:, -1]
        off = before + shared @ self._inside[:, :-1]
        normal = self._factor.mT @ self._factor
        normal.diagonal(dim1=-2, dim2=-1).add_(damping)
        step = -torch.linalg.solve_ex(normal, self._factor.mT @ off[..., None])[0][..., 0]
        left = off + (self._factor @ step[..., None])[..., 0]
        return step * self._scale, 0.5 * (before.square().sum() - left.square().sum())

    def response(self) -> tuple[Tensor, Tensor]:
        """How the best local unknowns of each view follow the shared ones.

        Returns:
            Derivatives A (V, L, S) of the best local unknowns by the shared ones, and the inverse (V, L, L) of each
            local normal matrix. With Σ the covariance of the shared unknowns, that of the local ones of views v and w
            is A_v Σ A_wᵀ, plus that inverse times the noise variance where v = w.
        """
        eye = torch.eye(self._factor.shape[-1], dtype=self._factor.dtype).expand_as(self._factor)
        inverse = torch.linalg.solve_triangular(self._factor, eye, upper=True) * self._scale[..., None]
        return -inverse @ self._inside[:, :-1].mT, inverse @ inverse.mT


class PartlyEliminated:
    """A `Linearization` of items that are eliminated first, beside others.

    Args:
        rest: of the others and of the eliminated items' `rows`.
        own: the items.
        first: how many local steps come before theirs.
        cost: of everything, if it is not half the sum of squares.
    """

    def __init__(self, rest: SchurLinearization, own: EliminatedItems, first: int, cost: Tensor) -> None:
        self._rest, self._own, self._first, self.cost = rest, own, first, cost

    def step(self, damping: Tensor) -> tuple[State, Tensor]:
        """See `Linearization.step`."""
        (shared, others), predicted = self._rest.step(damping)
        step, gain = self._own.step(shared, damping)
        padded = torch.nn.functional.pad(step, (others.shape[-1] - step.shape[-1], 0))
        local = torch.cat([others[: self._first], padded, others[self._first :]])
        return (shared, local), predicted + gain

    def blend(self, mask: Tensor, other: PartlyEliminated) -> PartlyEliminated:
        """See `Linearization.blend`; there is one element only."""
        return other if bool(mask) else self

    def information(self) -> tuple[Tensor, Tensor]:
        """See `SchurLinearization.information`."""
        return self._rest.information()
