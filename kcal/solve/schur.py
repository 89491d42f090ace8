"""Least squares with many small blocks that are eliminated first."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Generic, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.solve.lm import BatchLinearization, S, State

# Least squares with many small local blocks that are coupled only through shared parameters.
#
# A board pose affects only its own view, intrinsics affect all views. Eliminating the local blocks (the Schur
# complement) leaves a small system in the shared parameters, so that the work grows linearly with the views.

# Added to local matrices of unit diagonal before unknowns are eliminated for good: some 50 roundings.
_OPEN = 1e-14


class Products(NamedTuple):
    """Products of derivatives and residuals: of L local unknowns of each view, and of S shared ones.

    Attributes:
        local: (..., V, L, L).
        right: (..., V, L, S + 1) of local with shared ones, and last with the residuals.
        score: (..., V, S + 1) of the shared ones, and last of the residuals, with the residuals of each view.
        total: (..., S + 1, S + 1) of the shared ones and the residuals, over all views.
    """

    local: Tensor
    right: Tensor
    score: Tensor
    total: Tensor

    @classmethod
    def of_rows(cls, rows: Tensor, local_size: int) -> Products:
        """From rows (..., V, L + S + 1, R) as those of `SchurProblem.rows`."""
        L, across = local_size, rows.transpose(-1, -2)
        # The residuals' own products beside those of the local unknowns: one pass over all rows.
        beside = matrix_product(rows, torch.cat([across[..., :L], across[..., -1:]], -1)).transpose(-1, -2)
        total = products_of(rows[..., L:, :].transpose(-3, -2).flatten(-2))
        return cls(beside[..., :L, :L], beside[..., :L, L:], beside[..., L, L:], total)

    def of_shared(self, moving: Tensor) -> Products:
        """The same of some of the shared unknowns, by their numbers (M,)."""
        kept = torch.cat([moving, moving.new_tensor([self.total.shape[-1] - 1])])
        right, score = self.right[..., kept], self.score[..., kept]
        return self._replace(right=right, score=score, total=self.total[..., kept[:, None], kept])

    @classmethod
    def together(cls, parts: Sequence[Products]) -> Products:
        """Of all views, from those of some each."""
        if len(parts) == 1:
            return parts[0]
        local, right, score, total = zip(*parts, strict=True)
        return cls(torch.cat(local, -3), torch.cat(right, -3), torch.cat(score, -2), sum(total[1:], start=total[0]))

    def off(self, count: int) -> Products:
        """The same with the first local unknowns eliminated: what these cannot explain."""
        own, beside = self.local[..., :count, :count], self.local[..., :count, count:]
        scale = column_scale(own.diagonal(dim1=-2, dim2=-1))[..., None]
        # A view that leaves its pose open loses a direction to rounding, and no more.
        root = torch.linalg.cholesky(_damped(own * scale * scale.transpose(-1, -2), own.new_tensor(_OPEN)[None]))
        half = torch.linalg.solve_triangular(
            root, torch.cat([beside, self.right[..., :count, :]], -1) * scale, upper=False
        )
        by_local, by_shared = half[..., : beside.shape[-1]], half[..., beside.shape[-1] :]
        flat = by_shared.flatten(-3, -2).transpose(-1, -2)
        return Products(
            self.local[..., count:, count:] - by_local.transpose(-1, -2) @ by_local,
            self.right[..., count:, :] - by_local.transpose(-1, -2) @ by_shared,
            self.score - (by_shared.transpose(-1, -2) @ by_shared[..., -1:])[..., 0],
            self.total - products_of(flat),
        )


class SchurLinearization(BatchLinearization):
    """Normal equations, built from one block per view.

    Args:
        local: (..., V, L, L) products of the derivatives by the local parameters.
        right: (..., V, L, S + 1) their products with the derivatives by the shared ones, and last the gradient.
        total: (..., S + 1, S + 1) summed over the views: products of the derivatives by the shared parameters, their
            gradient, and the sum of squares.
    """

    def __init__(self, local: Tensor, right: Tensor, total: Tensor) -> None:
        shared, gradient = total[..., :-1, :-1], total[..., :-1, -1]
        self._local_scale = column_scale(local.diagonal(dim1=-2, dim2=-1))
        self._shared_scale = column_scale(shared.diagonal(dim1=-2, dim2=-1))
        scale = torch.cat([self._shared_scale, torch.ones_like(total[..., -1, -1:])], -1)
        self._local = local * self._local_scale[..., :, None] * self._local_scale[..., None, :]
        self._right = right * self._local_scale[..., :, None] * scale[..., None, None, :]
        self._shared = shared * self._shared_scale[..., :, None] * self._shared_scale[..., None, :]
        self._shared_gradient = gradient * self._shared_scale
        self.cost = 0.5 * total[..., -1, -1]

    @classmethod
    def of_gram(cls, gram: Tensor, local_size: int, shared_gram: Tensor | None = None) -> SchurLinearization:
        """From what each view contributes.

        Args:
            gram: (..., V, L + S + 1, L + S + 1): for each view the products of its rows, see `SchurProblem.rows`.
            local_size: L.
            shared_gram: (..., S + 1, S + 1): such products of residuals that depend on the shared parameters alone, or
                None.
        """
        L = local_size
        total = gram[..., L:, L:].sum(-3)
        if shared_gram is not None:
            total = total + shared_gram
        return cls(gram[..., :L, :L], gram[..., :L, L:], total)

    def solve(self, shared: Tensor, local: Tensor, damping: Tensor | None = None) -> State:
        """The solution of the system for another right side ((..., S), (..., V, L)); not damped if not told."""
        out = copy.copy(self)
        out._right = torch.cat([self._right[..., :-1], (local * self._local_scale)[..., None]], -1)
        out._shared_gradient = shared * self._shared_scale
        (by_shared, by_local), _ = out.step(torch.zeros_like(self.cost) if damping is None else damping)
        return -by_shared, -by_local

    def _reduce(self, damping: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Eliminate the local blocks: reduced matrix, reduced gradient, roots R of the blocks, R⁻¹[B, g], failures."""
        root, info = torch.linalg.cholesky_ex(_damped(self._local, damping[..., None]))
        half = torch.linalg.solve_triangular(root, self._right, upper=False)
        # One product over all views at once.
        product = products_of(half.flatten(-3, -2).transpose(-1, -2))
        matrix = _damped(self._shared, damping) - product[..., :-1, :-1]
        return matrix, self._shared_gradient - product[..., :-1, -1], root, half, (info != 0).any(-1)

    def step(self, damping: Tensor) -> tuple[State, Tensor]:
        """See `Linearization.step`; the step is (shared (..., S), local (..., V, L))."""
        matrix, gradient, root, half, failed = self._reduce(damping)
        factor, info = torch.linalg.cholesky_ex(matrix)
        shared = -torch.cholesky_solve(gradient[..., None], factor)[..., 0]
        left = half[..., -1] + (half[..., :-1] @ shared[..., None, :, None])[..., 0]
        local = -torch.linalg.solve_triangular(root.transpose(-1, -2), left[..., None], upper=True)[..., 0]
        squared = (shared * shared).sum(-1) + (local * local).sum((-2, -1))
        along = (self._shared_gradient * shared).sum(-1) + (self._right[..., -1] * local).sum((-2, -1))
        predicted = 0.5 * (damping * squared - along)
        predicted = torch.where(failed | (info != 0), torch.nan, predicted)
        return (shared * self._shared_scale, local * self._local_scale), predicted

    def information(self) -> tuple[Tensor, Tensor]:
        """The reduced normal matrix of the shared parameters, scaled, with the scale of each: (..., S, S), (..., S).

        Its inverse, multiplied by scale ⊗ scale and by the noise variance, is the covariance of the shared
        parameters with the local ones free.
        """
        matrix, *_ = self._reduce(torch.zeros_like(self.cost))
        return matrix, self._shared_scale


def without_local(rows: Tensor, local_size: int) -> Tensor:
    """(V, S + 1, R): rows (V, L + S + 1, R) off what each view's L local parameters can do, by QR."""
    local = rows[:, :local_size].transpose(-1, -2)
    basis, _ = torch.linalg.qr(local * column_scale(local.square().sum(1, keepdim=True)))
    others = rows[:, local_size:]
    return others - (others @ basis) @ basis.transpose(-1, -2)


def column_scale(diagonal: Tensor) -> Tensor:
    """Scale of each column; the parameter of a zero column never moves."""
    return torch.where(diagonal > 0, diagonal, 1.0).rsqrt()


def matrix_product(one: Tensor, other: Tensor) -> Tensor:
    """Products of matrices, many of which are small: two to four times faster by NumPy than by torch on a processor."""
    if one.device.type == "cpu" and not (one.requires_grad or other.requires_grad):
        return torch.from_numpy(np.matmul(one.numpy(), other.numpy()))
    return one @ other


def products_of(rows: Tensor) -> Tensor:
    """(..., S, S) products of rows (..., S, R) with each other."""
    if rows.ndim == 2 and rows.device.type == "cpu" and not rows.requires_grad:
        # NumPy makes one half and mirrors it.
        own = rows.numpy()
        return torch.from_numpy(own @ own.T)
    return rows @ rows.transpose(-1, -2)


def _damped(matrix: Tensor, damping: Tensor) -> Tensor:
    out = matrix.clone()
    out.diagonal(dim1=-2, dim2=-1).add_(damping[..., None])
    return out


class SchurProblem(ABC, Generic[S]):
    """Base of problems with shared parameters, and local ones in each of V views.

    Subclasses define `rows`, `residuals` and `retract`. With a robust loss the cost is not half the squared length of
    the rows' residuals, so that they override `view_cost` as well.
    """

    batch: tuple[int, ...]
    local_size: int
    residual_count: int
    joint = False

    @abstractmethod
    def residuals(self, state: S) -> Tensor:
        """(..., V, R) residuals."""

    @abstractmethod
    def rows(self, state: S) -> Tensor:
        """(..., V, L + S + 1, R).

        For each view the derivatives of its R residuals by its L local parameters, by the S shared ones, and the
        residuals themselves.
        """

    @abstractmethod
    def retract(self, state: S, step: State) -> S:
        """Apply a step (shared (..., S), local (..., V, L))."""

    def select(self, elements: Tensor) -> SchurProblem[S] | None:
        """See `Problem.select`; None unless a subclass overrides it."""
        return None

    def shared_gram(self, state: S) -> Tensor | None:
        """(..., S + 1, S + 1), see `SchurLinearization.of_gram`: of priors and barriers; None without any."""
        return None

    def shared_cost(self, state: S) -> Tensor | None:
        """(...) the cost of these; None without any."""
        gram = self.shared_gram(state)
        return None if gram is None else 0.5 * gram[..., -1, -1]

    def view_cost(self, state: S) -> Tensor:
        """(..., V) the cost of each view."""
        residuals = self.residuals(state)
        return 0.5 * (residuals * residuals).sum(-1)

    def cost(self, state: S) -> Tensor:
        """See `Problem.cost`."""
        cost, shared = self.view_cost(state).sum(-1), self.shared_cost(state)
        return cost if shared is None else cost + shared

    def gram(self, state: S) -> Tensor:
        """(..., V, L + S + 1, L + S + 1) products of the rows of each view."""
        rows = self.rows(state)
        return rows @ rows.transpose(-1, -2)

    def linearize(self, state: S) -> SchurLinearization:
        """See `Problem.linearize`."""
        return SchurLinearization.of_gram(self.gram(state), self.local_size, self.shared_gram(state))


# Small items eliminated before a system is damped: each has a few unknowns of its own and few residuals more.
#
# A match between two images has three unknowns and four residuals, so that one residual is left, the epipolar one. With
# 20,000 of them the products of all rows of each item would fill the memory; the residuals that are left do not
# (variable projection: G. Golub and V. Pereyra 1973).


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
