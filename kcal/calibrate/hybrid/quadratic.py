"""Data near a solution as a quadratic form of lens and board, with poses and motions eliminated.

Near a solution x₀ residuals are linear in the unknowns: chi² = c - 2 gᵀδ + δᵀKδ with δ = x - x₀, poses eliminated.
(About x₀, because about zero all digits of c would cancel where noise is small.) Motions of views
(`kcal.calibrate.problem.readout`) are integrated out under a normal prior: with U their columns off the poses, R their
prior standard deviations in units of the noise, and M = (UᵀU + R⁻²)⁻¹, a view's AᵀA becomes AᵀA - AᵀU M UᵀA, and
ln det(R UᵀU R + I) is added to -2 ln p.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kcal.calibrate.problem.readout import AMPLITUDES, MOTION, stillness
from kcal.solve.schur import Products, matrix_product, products_of

Array = npt.NDArray[np.float64]


class Quadratic(NamedTuple):
    """Data near a solution: chi² = c - 2 gᵀδ + δᵀKδ at x = `at` + δ, poses eliminated.

    These are the normal equations of a `kcal.gaussian.Gaussian`, because the evidence forms them under hundreds of
    priors.

    Attributes:
        products: (S + 1, S + 1) of its rows, K and in the last row and column -g and c.
        freedom: ν, residuals without those that poses take up.
        at: (S,) x₀.
    """

    products: Tensor
    freedom: float
    at: Tensor

    @property
    def K(self) -> Tensor:
        """(S, S)."""
        return self.products[:-1, :-1]

    @property
    def g(self) -> Tensor:
        """(S,)."""
        return -self.products[:-1, -1]

    @property
    def c(self) -> float:
        """χ² at x₀."""
        return float(self.products[-1, -1])

    def tempered(self, tempering: float) -> Quadratic:
        """The same data, counting less."""
        return Quadratic(self.products / tempering, self.freedom / tempering, self.at) if tempering != 1.0 else self


class ViewData(NamedTuple):
    """Data near a solution, of views that moved by M = 12 numbers each while they were read, or stood still, M = 0.

    Attributes:
        still: as if they had stood still.
        own: (V, M, M) UᵀU of each view.
        cross: (V, M, S + 1) Uᵀ [A, r], A being the rows and r their residuals as if all views had stood still.
        score: (V, S) Aᵀ r of each view.
    """

    still: Quadratic
    own: Tensor
    cross: Tensor
    score: Tensor

    @property
    def moving(self) -> bool:
        """Whether views moved."""
        return self.own.shape[-1] > 0

    def integrated(self, log_ratio: Array) -> Integrated:
        """With motions integrated out, whose standard deviation over the noise has these logarithms by order."""
        if not self.moving:
            return Integrated(self.still, 0.0, self.own, self.cross)
        ratio = np.repeat(np.exp(log_ratio), MOTION // AMPLITUDES)
        matrix = self.own * torch.from_numpy(ratio[:, None] * ratio)
        matrix.diagonal(dim1=-2, dim2=-1).add_(1.0)
        root = torch.linalg.cholesky(matrix)
        _, ones, _ = torch.broadcast_tensors(root, torch.eye(MOTION, dtype=root.dtype), root)
        inverse = torch.linalg.solve_triangular(root, ones, upper=False)
        half = matrix_product(inverse * torch.from_numpy(ratio), self.cross)
        data = self.still._replace(products=self.still.products - products_of(half.flatten(0, 1).T))
        log_determinant = 2.0 * float(root.diagonal(dim1=-2, dim2=-1).log().sum())
        return Integrated(data, log_determinant, inverse, half)

    def scores(self, log_ratio: Array) -> Tensor:
        """(V, S) derivatives of each view's -½ chi² by the shared unknowns, motions integrated out."""
        if not self.moving:
            return self.score
        matrix = self.own + torch.diag(stillness(log_ratio))
        best = torch.linalg.solve(matrix, self.cross[..., -1:])
        return self.score - (self.cross[..., :-1].transpose(1, 2) @ best)[..., 0]


class Integrated(NamedTuple):
    """Data with motions integrated out, and what derivatives by the motions' standard deviations need.

    Attributes:
        data: the quadratic form of lens and board.
        log_determinant: ln det(R UᵀU R + I), over the views.
        inverse: (V, 12, 12) of the Cholesky factor of that.
        half: (V, 12, S + 1) inverse times R Uᵀ [A, r].
    """

    data: Quadratic
    log_determinant: float
    inverse: Tensor
    half: Tensor

    def slopes(
        self, step: Array, inverse: Tensor, deviation: Array, y: Array, variance: float, tempering: float
    ) -> Slopes:
        """Derivatives of -ln p by the logarithms of the ratios.

        Each first one is the sum over motions of 1 less the posterior's second moment in units of the prior. The
        second ones are those of any Gaussian amplitudes (`kcal.calibrate.hybrid.evidence`), motions among them.

        Args:
            step: (S,) δ of the best lens and board.
            inverse: (S, S) Q, QᵀQ being their posterior covariance in units of their priors.
            deviation: (S,) standard deviations of these.
            y: (S,) the best lens and board in the same units.
            variance: of the noise.
            tempering: by which the data count less.
        """
        own = self.inverse.transpose(1, 2) @ self.inverse  # of motions whose lens and board are known
        size = len(step)
        direction = inverse.new_zeros(size + 1, size + 1)
        direction[:-1, 0], direction[-1, 0] = torch.from_numpy(step), 1.0
        torch.mul(torch.from_numpy(deviation)[:, None], inverse.T, out=direction[:-1, 1:])
        reach = matrix_product(self.half.flatten(0, 1), direction).view(self.half.shape)
        E = matrix_product(self.inverse.transpose(1, 2) / math.sqrt(variance * tempering), reach)
        mean, others, kept = E[..., 0], E[..., 1:], own.diagonal(dim1=1, dim2=2)
        by_order = (AMPLITUDES, MOTION // AMPLITUDES)
        G = others @ others.transpose(1, 2)
        moment = mean.square() + G.diagonal(dim1=1, dim2=2)
        first = ((1.0 - kept) / tempering - moment).sum(0).view(by_order).sum(1)
        # By pairs of orders: within a view, and across all views.
        within = (-0.5 * own.square() / tempering - own * (mean[:, :, None] * mean[:, None]) - own * G).sum(0)
        within.diagonal().add_((0.5 * kept / tempering + 0.5 * moment).sum(0))
        second = 4.0 * within.view(*by_order, *by_order).sum((1, 3))
        orders = others.unflatten(1, by_order).transpose(0, 1).flatten(1, 2)
        along = (orders.transpose(1, 2) @ mean.unflatten(1, by_order).transpose(0, 1).reshape(AMPLITUDES, -1, 1))[
            ..., 0
        ]
        # Of E times the inverse, a row for each motion, only sums over motions are wanted.
        mixed = along @ inverse
        if orders.shape[1] < orders.shape[2]:
            # Few views have fewer rows than there are unknowns.
            pairs = (
                products_of(orders.flatten(0, 1)).square().unflatten(0, (AMPLITUDES, -1)).unflatten(2, (AMPLITUDES, -1))
            )
            across, squared = pairs.sum((1, 3)), matrix_product(orders, inverse).square().sum(1)
        else:
            spread = torch.stack([products_of(rows.T) for rows in orders])
            across, squared = (
                spread.flatten(1) @ spread.flatten(1).T,
                (matrix_product(spread, inverse) * inverse).sum(1),
            )
        second -= 4.0 * (along @ along.T) + 2.0 * across
        Y = torch.from_numpy(y)
        by_variance = -(2.0 * mixed * Y + squared)
        by_noise = mean.square().sum(0).view(by_order).sum(1) + 2.0 * mixed @ Y + squared.sum(-1)
        return Slopes(first.numpy(), second.numpy(), by_variance.numpy(), by_noise.numpy())


class Slopes(NamedTuple):
    """Derivatives of -ln p by the logarithms of the ratios: first; second; mixed, by 2 ln of priors' sds and ln σ²."""

    first: Array
    second: Array
    by_variance: Array
    by_noise: Array


def view_data(products: Products, x: Tensor, motion: Tensor, freedom: float) -> ViewData:
    """From products off the poses, by motions and by lens and board, at lens and board x and motions (V, M)."""
    own, cross, score, total = products
    if motion.shape[1]:
        # As if all views had stood still: motions are unknowns whose prior is about zero.
        along = (motion[:, None] @ cross)[:, 0]
        moved = (motion[:, None] @ own)[:, 0]
        total, cross = total.clone(), cross.clone()
        change = along.sum(0)
        total[-1] -= change
        total[:, -1] -= change
        total[-1, -1] += (moved * motion).sum()
        cross[..., -1] -= moved
        score = score - along
    return ViewData(still=Quadratic(total, freedom, x), own=own, cross=cross, score=score[:, :-1])


def still_data(rows: Tensor, x: Tensor, freedom: float) -> ViewData:
    """From rows (V, S + 1, R) of views without poses and motions, at lens and board x; the residuals last."""
    return view_data(Products.of_rows(rows, 0), x, rows.new_zeros(len(rows), 0), freedom)


def overdispersion(score: Tensor, K: Tensor, deviation: Tensor, variance: float) -> float:
    """How much more the scores (V, S) of views scatter than independent corners explain, in determined directions."""
    score = score - score.mean(0)
    inverse = posterior_root(K, deviation, variance)
    effective = len(K) - float(inverse.square().sum())
    scattered = float((inverse @ (score * deviation / variance).T).square().sum()) * len(score) / (len(score) - 1)
    return max(1.0, scattered / effective)


def posterior_root(K: Tensor, deviation: Tensor, variance: float) -> Tensor:
    """M of MᵀM = (I + √D K √D / σ²)⁻¹."""
    # By eigenvalues: with wrong corners K is so large that a Cholesky factor loses the I to rounding.
    values, vectors = torch.linalg.eigh(K * deviation[:, None] * deviation / variance)
    return (1.0 + values.clamp_min(0.0)).rsqrt()[:, None] * vectors.T
