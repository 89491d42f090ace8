"""What a calibration says of a camera and of the board that it saw, as square roots of information.

Covariances of rich lenses are nearly singular, and what nothing determines has none. Rows of whitened derivatives have
neither trouble: they are stacked with those of other data, and inverted once, at the end (Bierman, Factorization
Methods for Discrete Sequential Estimation, 1977).
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.checks import as_covariance
from kcal.errors import InputError

# Singular values of scaled rows below this share of the largest are rounding, not information.
_ROUNDING = 1e-13


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class CameraInformation:
    """What the data of one camera say, and what was assumed beforehand; together they are largest at the estimate.

    Convention: the unknowns x (U,) are parameters of the camera, then amplitudes of the modes of its board, if it has
    any. Near the estimate, the data's likelihood is exp(-½ ‖rows (x - estimate) + residuals‖²), and the prior is
    exp(-½ Σ ((x - mean) / sigma)²).

    Args:
        slots: for each of `Camera.names` the number of its unknown; those that are equal share one. -1: held.
        estimate: (U,) in the units of the parameters, and meters for the board.
        rows: (R, U) derivatives of the data's residuals, in standard deviations.
        residuals: (R,) of these rows at the estimate.
        mean: (U,) of the prior.
        sigma: (U,) of the prior; infinite where nothing was assumed.
        others: (Q, B + 1) what other cameras say of the board's unknowns, in standard deviations; the last column holds
            the residuals at the estimate. None: nothing. A rig with such a camera and these others uses their own rows.

    Raises:
        InputError: shapes that do not fit each other, or values that are not finite.

    Example:
        >>> focal = CameraInformation.from_covariance(torch.tensor([800.0, 800, 320, 240, 0]).double(),
        ...                                           torch.diag(torch.tensor([4.0, 4, 0, 0, 0])).double())
        >>> focal.slots, focal.rows.tolist()
        ((0, 1, -1, -1, -1), [[0.5, 0.0], [0.0, 0.5]])
    """

    slots: tuple[int, ...]
    estimate: Tensor
    rows: Tensor
    residuals: Tensor
    mean: Tensor
    sigma: Tensor
    others: Tensor | None = None

    def __post_init__(self) -> None:
        count = len(self.estimate)
        shapes = [tuple(t.shape) for t in (self.estimate, self.mean, self.sigma, self.residuals, self.rows)]
        if shapes != [(count,), (count,), (count,), (len(self.rows),), (len(self.rows), count)]:
            raise InputError(f"information: shapes that do not fit each other: {shapes}")
        if self.lens_size > count or not all(slot >= -1 for slot in self.slots):
            raise InputError(f"information: slots up to {self.lens_size - 1}, but {count} unknowns")
        others = [] if self.others is None else [self.others]
        if any(rows.shape[-1] != self.board_size + 1 for rows in others):
            raise InputError(
                f"information: rows of others have {others[0].shape[-1]} columns, not {self.board_size + 1}"
            )
        if not all(bool(t.isfinite().all()) for t in (self.estimate, self.rows, self.residuals, self.mean, *others)):
            raise InputError("information: values that are not finite")
        if not bool((self.sigma > 0).all()):
            raise InputError("information: sigmas of the prior must be positive")

    @classmethod
    def from_covariance(cls, params: Tensor, covariance: Tensor) -> CameraInformation:
        """Of a covariance (5 + P, 5 + P) of the parameters (5 + P,) of a camera; those without variance are held.

        Raises:
            InputError: a wrong shape, values that are not finite, or no covariance.
        """
        matrix = as_covariance("covariance of the camera's parameters", covariance, len(params))
        free = matrix.diagonal().nonzero()[:, 0]
        spread = matrix.diagonal()[free].sqrt()
        values, vectors = torch.linalg.eigh(matrix[free[:, None], free] / spread[:, None] / spread)
        # A variance that is zero to rounding would weigh infinitely much.
        known = values.clamp_min(_ROUNDING)
        places = {int(index): slot for slot, index in enumerate(free)}
        roots = (vectors / known.sqrt()) @ vectors.T
        return cls(
            slots=tuple(places.get(i, -1) for i in range(len(params))),
            estimate=params.detach()[free].double(),
            rows=roots / spread,
            residuals=roots.new_zeros(len(free)),
            mean=roots.new_zeros(len(free)),
            sigma=torch.full_like(spread, math.inf),
        )

    @property
    def lens_size(self) -> int:
        """How many of the unknowns are the camera's."""
        return max(self.slots, default=-1) + 1

    @property
    def board_size(self) -> int:
        """How many are the board's."""
        return len(self.estimate) - self.lens_size

    def data_rows(self) -> Tensor:
        """(R, U + 1) rows of the data; the last column holds their residuals at the estimate."""
        return torch.cat([self.rows, self.residuals[:, None]], 1)

    def prior_rows(self, *, board: bool) -> Tensor:
        """(Q, U + 1) likewise of the prior of the board's unknowns, or of the camera's."""
        known = self.sigma.isfinite() & ((torch.arange(len(self.sigma)) >= self.lens_size) == board)
        weight = torch.where(known, 1.0 / self.sigma, 0.0)
        rows = torch.cat([torch.diag(weight), ((self.estimate - self.mean) * weight)[:, None]], 1)
        return rows[known]

    def board_rows(self) -> Tensor:
        """(Q, U + 1) likewise of all that is known of the board otherwise: its prior, and what other cameras say."""
        prior = self.prior_rows(board=True)
        if self.others is None:
            return prior
        return torch.cat([prior, torch.cat([self.others.new_zeros(len(self.others), self.lens_size), self.others], 1)])

    def all_rows(self) -> Tensor:
        """(R + Q, U + 1) rows of data, priors, and what other cameras say of the board."""
        return torch.cat([self.data_rows(), self.prior_rows(board=False), self.board_rows()])

    def triangle(self) -> Tensor:
        """(U, U + 1) upper triangle of the data's rows, their residuals last; the rest says nothing of the unknowns."""
        return upper(self.data_rows())

    def half(self) -> Tensor:
        """(U, U): halfᵀ half is the covariance of the unknowns; what nothing determines has a very large one."""
        return posterior_half(self.all_rows()[:, :-1])

    def by_parameter(self, columns: Tensor) -> Tensor:
        """Columns (K, U) by the unknowns as columns (K, 5 + P) by the parameters: zeros for those held."""
        return columns @ self.selection().T

    def selection(self) -> Tensor:
        """(5 + P, U): the change of each parameter with each unknown."""
        out = self.rows.new_zeros(len(self.slots), len(self.estimate))
        for index, slot in enumerate(self.slots):
            if slot >= 0:
                out[index, slot] = 1.0
        return out

    def covariance(self) -> Tensor:
        """(5 + P, 5 + P) of the camera's parameters in the order of `Camera.names`, zero for those held."""
        half = self.by_parameter(self.half())
        return half.T @ half

    def without_board(self) -> CameraInformation:
        """What is said of the camera alone, whatever its board is."""
        count = self.lens_size
        if not self.board_size:
            return self
        # The board's columns first: below its triangle, rows say nothing of it.
        rows, board = torch.cat([self.data_rows(), self.board_rows()]), self.board_size
        order = [*range(count, count + board), *range(count), count + board]
        triangle = triangular(rows[:, order])[board : board + count, board:]
        return CameraInformation(
            slots=self.slots,
            estimate=self.estimate[:count],
            rows=triangle[:, :-1],
            residuals=triangle[:, -1],
            mean=self.mean[:count],
            sigma=self.sigma[:count],
        )


def triangular(rows: Tensor) -> Tensor:
    """(C, C) upper triangle with the same products as rows (R, C)."""
    missing = max(0, rows.shape[1] - len(rows))
    padded = torch.cat([rows, rows.new_zeros(missing, rows.shape[1])])
    return torch.linalg.qr(padded, mode="r")[1]


def upper(rows: Tensor) -> Tensor:
    """(C, C + 1) upper triangle of rows (R, C + 1); what is one already stays as it is, to the last bit."""
    if len(rows) == rows.shape[1] - 1 and not bool(rows.tril(-1).any()):
        return rows
    return triangular(rows)[:-1]


def unit_scale(rows: Tensor) -> Tensor:
    """(C,) factors that make the columns of rows (R, C) unit vectors; 1 for columns of zeros."""
    length = torch.linalg.vector_norm(rows, dim=0)
    return torch.where(length > 0, 1.0 / torch.where(length > 0, length, 1.0), 1.0)


def posterior_half(rows: Tensor) -> Tensor:
    """(U, U) whose product halfᵀ half is the inverse of rowsᵀ rows, from rows (R, U).

    Directions that the rows do not determine get a very large variance, which only rounding limits.

    Example:
        >>> posterior_half(torch.tensor([[2.0, 0], [0, 4.0]]).double()).abs().sum(0)
        tensor([0.5000, 0.2500], dtype=torch.float64)
    """
    change, _, known = whitened(rows, rows.new_zeros(len(rows)))
    return torch.where(known, change, change / _ROUNDING).T


class Whitened(NamedTuple):
    """Unknowns y in place of x: x = change (y - begin).

    Attributes:
        change: (U, U).
        begin: (U,) what y is at x = 0.
        known: (U,) whether y is a standard normal; nothing is known of the others.
    """

    change: Tensor
    begin: Tensor
    known: Tensor


def whitened(rows: Tensor, residuals: Tensor) -> Whitened:
    """Change variables so that ‖rows x + residuals‖² = Σ y² over the known y, and a constant; rows (R, U).

    Example:
        >>> whitened(torch.tensor([[2.0, 0.0]]).double(), torch.tensor([6.0]).double()).known
        tensor([ True, False])
    """
    triangle = triangular(torch.cat([rows, residuals[:, None]], 1))[: rows.shape[1]]
    scale = unit_scale(triangle[:, :-1])
    left, values, right = torch.linalg.svd(triangle[:, :-1] * scale)
    known = values > _ROUNDING * values[:1].sum()
    change = scale[:, None] * right.T / torch.where(known, values, 1.0)
    return Whitened(change, torch.where(known, left.T @ triangle[:, -1], 0.0), known)
