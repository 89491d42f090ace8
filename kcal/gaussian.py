"""Gaussians as square roots of information, over unknowns that have names.

What is known of a camera, a board, a rig or a type of lens is one `Gaussian`: rows of whitened derivatives. Rows of
other data are stacked below them, what is not asked for is integrated out by QR, and all is inverted once, at the end
(Bierman, Factorization Methods for Discrete Sequential Estimation, 1977). So covariances of rich lenses, which are
nearly singular, and unknowns that nothing determines, which have none, are no trouble.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Hashable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.dispatch import is_differentiated
from kcal.errors import InputError

# Singular values of scaled rows below this share of the largest are rounding, not information.
_ROUNDING = 1e-13

Slots = tuple[Hashable, ...]


def numbered(name: Hashable, count: int) -> Slots:
    """Names of unknowns of one kind: (name, 0), (name, 1), ..."""
    return tuple((name, number) for number in range(count))


@dataclasses.dataclass(frozen=True, eq=False)
class Gaussian:
    """exp(-½ ‖A (x - at) + r‖²) of unknowns x with names; not normalized, and nothing need be determined.

    Args:
        slots: (U,) the names of the unknowns, each once.
        at: (U,) the place about which the rows are stated.
        rows: (R, U + 1): A, and as the last column r, the residuals there, in standard deviations.

    Raises:
        ValueError: shapes that do not fit each other, or a name that occurs twice.

    Example:
        >>> one = Gaussian.independent(("x", "y"), torch.tensor([3.0, 0.0]), torch.tensor([0.5, 1.0]))
        >>> other = Gaussian(("y", "x"), torch.zeros(2), torch.tensor([[1.0, -1.0, 2.0]]))  # y = x - 2 ± 1
        >>> both = one + other
        >>> both.slots, [round(value, 3) for value in both.mean.tolist()]
        (('x', 'y'), [2.889, 0.444])
    """

    slots: Slots
    at: Tensor
    rows: Tensor

    def __post_init__(self) -> None:
        if self.at.shape != (len(self.slots),) or self.rows.shape[1:] != (len(self.slots) + 1,):
            raise ValueError(f"{len(self.slots)} unknowns at {tuple(self.at.shape)} with rows {tuple(self.rows.shape)}")
        if len(set(self.slots)) < len(self.slots):
            raise ValueError("an unknown occurs twice")

    @classmethod
    def independent(cls, slots: Slots, mean: Tensor, sigma: Tensor) -> Gaussian:
        """Of independent unknowns with these means and standard deviations."""
        return cls(slots, mean, torch.nn.functional.pad(torch.diag(1.0 / sigma), (0, 1)))

    @classmethod
    def from_covariance(cls, slots: Slots, mean: Tensor, covariance: Tensor) -> Gaussian:
        """Of a covariance (U, U) whose diagonal is positive."""
        spread = covariance.diagonal().sqrt()
        values, vectors = torch.linalg.eigh(covariance / spread[:, None] / spread)
        # A variance that is zero to rounding would weigh infinitely much.
        roots = (vectors / values.clamp_min(_ROUNDING).sqrt()) @ vectors.T
        return cls(slots, mean, torch.nn.functional.pad(roots / spread, (0, 1)))

    def __add__(self, other: Gaussian) -> Gaussian:
        """What both say, see `stacked`."""
        return stacked([self, other])

    def placed(self, slots: Slots, at: Tensor) -> Gaussian:
        """The same about another place (U',), with columns in another order; of further unknowns it says nothing."""
        if slots == self.slots and at is self.at:
            return self
        number = {slot: column for column, slot in enumerate(slots)}
        where = [number[slot] for slot in self.slots]
        rows = self.rows.new_zeros(len(self.rows), len(slots) + 1)
        rows[:, where] = self.rows[:, :-1]
        rows[:, -1] = self.rows[:, -1] + self.rows[:, :-1] @ (at[where] - self.at)
        return Gaussian(slots, at, rows)

    def marginal(self, slots: Slots) -> Gaussian:
        """What is said of some unknowns, whatever the others are, in as many rows as there are unknowns at most."""
        others = tuple(slot for slot in self.slots if slot not in set(slots))
        number = {slot: column for column, slot in enumerate(self.slots)}
        order = [number[slot] for slot in (*others, *slots)]
        count, triangle = len(others), triangular(self.rows[:, [*order, len(order)]])
        kept = triangle[count:-1, count:]
        corner = triangle[:count, :count]
        length = torch.linalg.vector_norm(corner, dim=0)
        if bool((corner.diagonal().abs() <= _ROUNDING * length).any()):
            # Rows of unknowns that nothing determines say something of the rest.
            left, values, _ = torch.linalg.svd(corner * unit_scale(corner))
            free = left[:, values <= _ROUNDING * values[:1].sum()]
            kept = triangular(torch.cat([free.T @ triangle[:count, count:], kept]))[:-1]
        return Gaussian(slots, self.at[order[count:]], kept)

    def conditioned(self, slots: Slots) -> Gaussian:
        """What is said of the others while some unknowns are held where they are."""
        others = [number for number, slot in enumerate(self.slots) if slot not in set(slots)]
        names = tuple(self.slots[number] for number in others)
        return Gaussian(names, self.at[others], self.rows[:, [*others, len(self.slots)]])

    def replaced(self, old: Slots, begin: Tensor, change: Tensor, new: Slots) -> Gaussian:
        """In other variables z (Z,) about zero, after all others: the old ones are begin + change z; change (U', Z)."""
        gone = {slot: number for number, slot in enumerate(self.slots)}
        columns = [gone.pop(slot) for slot in old]
        rest, moved = list(gone.values()), self.rows[:, columns]
        residual = self.rows[:, -1] + moved @ (begin - self.at[columns])
        rows = torch.cat([self.rows[:, rest], moved @ change, residual[:, None]], 1)
        return Gaussian((*gone, *new), torch.cat([self.at[rest], change.new_zeros(len(new))]), rows)

    def named(self, slots: Slots) -> Gaussian:
        """The same under other names."""
        return dataclasses.replace(self, slots=slots)

    def weighted(self, weight: float) -> Gaussian:
        """Rows times a weight: one over the noise of rows in pixels, or less than one for data that count less."""
        return dataclasses.replace(self, rows=self.rows * weight)

    def compressed(self) -> Gaussian:
        """The same in U rows, an upper triangle; what is one already stays as it is, to the last bit."""
        if len(self.rows) == len(self.slots) and not bool(self.rows.tril(-1).any()):
            return self
        return dataclasses.replace(self, rows=self._triangle[:-1])

    @functools.cached_property
    def _triangle(self) -> Tensor:
        return triangular(self.rows)

    @property
    def products(self) -> Tensor:
        """(U + 1, U + 1) of the rows: the normal equations, and χ² at the place."""
        return self.rows.T @ self.rows

    @property
    def mean(self) -> Tensor:
        """(U,) of rows that determine all unknowns."""
        return self.mean_and_half()[0]

    def mean_and_half(self) -> tuple[Tensor, Tensor]:
        """(U,), and the lower triangle (U, U) whose halfᵀ half is the covariance, of rows that determine everything."""
        triangle = self.compressed().rows
        eye = torch.eye(len(self.slots), dtype=triangle.dtype)
        half = torch.linalg.solve_triangular(triangle[:, :-1], eye, upper=True).T
        return self.at - half.T @ triangle[:, -1], half

    def half(self) -> Tensor:
        """(U, U): halfᵀ half is the covariance of the unknowns; what nothing determines has a very large one."""
        return posterior_half(self.rows[:, :-1])

    def log_integral(self) -> float:
        """Logarithm of ∫ dx, less ½ U ln 2π, of rows that determine all unknowns.

        That of a prior and data together less that of the prior alone is the logarithm of the data's evidence.
        """
        diagonal = self._triangle.diagonal()
        return float(-diagonal[:-1].abs().log().sum() - 0.5 * diagonal[-1].square())


def stacked(gaussians: Sequence[Gaussian]) -> Gaussian:
    """What all of them say: the product of the densities, each unknown about its place in the first that has it."""
    places: dict[Hashable, Tensor] = {}
    for one in gaussians:
        if not places.keys() >= set(one.slots):
            places |= {slot: at for slot, at in zip(one.slots, one.at, strict=True) if slot not in places}
    slots, first = tuple(places), gaussians[0]
    at = first.at if len(slots) == len(first.slots) else torch.stack(list(places.values()))
    return Gaussian(slots, at, torch.cat([one.placed(slots, at).rows for one in gaussians]))


def triangular(rows: Tensor) -> Tensor:
    """(C, C) upper triangle with the same products as rows (R, C)."""
    missing = max(0, rows.shape[1] - len(rows))
    return torch.linalg.qr(torch.cat([rows, rows.new_zeros(missing, rows.shape[1])]), mode="r")[1]


def half_of_covariance(matrix: Tensor) -> Tensor:
    """(K, P) with halfᵀ half = matrix (P, P), K being its rank."""
    if is_differentiated(matrix):
        raise InputError("the root of a covariance has no derivatives; give RigCovariance(half=...)")
    scale = matrix.diagonal().sqrt()
    safe = torch.where(scale > 0, scale, 1.0)
    values, vectors = torch.linalg.eigh(matrix / safe[:, None] / safe[None, :])
    kept = values > 1e-14 * values[-1:].sum().clamp_min(1e-300)
    return (scale[:, None] * vectors[:, kept] * values[kept].sqrt()).T


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


class Covariance:
    """Covariance of unknowns from their normal equations, of which some directions may be open.

    What is not finite determines nothing: the covariance is NaN then, and `computed` is False.

    Args:
        information: (S, S) of unknowns over their scale.
        scale: (S,).
        variance: by which the covariance is multiplied.
        tolerance: eigenvalues below this share of the largest are rounding, and their directions open.
        lost: a function of the unknowns with more than this share of its length in open directions is not determined.

    Attributes:
        root: (S, K) with root rootᵀ the covariance of what is determined.
        open: (S, O) orthonormal directions of the scaled unknowns that are open.

    Example:
        >>> known = Covariance(torch.diag(torch.tensor([4.0, 0.0])).double(), torch.ones(2).double())
        >>> known.sigma.tolist(), known.determined.tolist()
        ([0.5, inf], [True, False])
    """

    def __init__(
        self, information: Tensor, scale: Tensor, variance: float = 1.0, *, tolerance: float = 1e-12, lost: float = 1e-6
    ) -> None:
        self.computed = bool(information.isfinite().all()) and math.isfinite(variance)
        self._scale, self._least_lost = scale, lost
        values, vectors = torch.linalg.eigh(information if self.computed else torch.eye(len(scale)).to(scale))
        floor = tolerance * values[-1:].sum()
        known = values > floor
        along = scale[:, None] * vectors * math.sqrt(max(variance, 0.0) if self.computed else math.nan)
        self.root, self.open = along[:, known] * values[known].rsqrt(), vectors[:, ~known]
        # The smallest variance that an open direction can have.
        self._floor = along[:, ~known] * floor.rsqrt()

    @property
    def matrix(self) -> Tensor:
        """(S, S) of all unknowns; with the smallest possible variance along directions that are open."""
        return self.root @ self.root.T + self._floor @ self._floor.T

    @property
    def complete(self) -> bool:
        """Whether nothing is open."""
        return not self.open.shape[1]

    def of(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Covariance (K, K) of K linear functions (K, S) of a step, and which of them are determined.

        What is not determined has infinite variance, and no covariance with anything.
        """
        factor, lost = rows @ self.root, self._lost(rows)
        matrix = factor @ factor.T
        matrix = torch.where(lost[:, None] | lost[None, :], 0.0, 0.5 * (matrix + matrix.T))
        return matrix + torch.diag(torch.where(lost, torch.inf, 0.0)), ~lost

    def variances(self, rows: Tensor) -> Tensor:
        """(K,) variances of K linear functions (K, S) of a step; infinite for what is not determined."""
        return torch.where(self._lost(rows), torch.inf, (rows @ self.root).square().sum(-1))

    def half_of(self, rows: Tensor) -> Tensor | None:
        """(S, K) root of the covariance of K linear functions (K, S) of a step; None where one is not determined."""
        return None if bool(self._lost(rows).any()) else (rows @ self.root).T

    @property
    def sigma(self) -> Tensor:
        """(S,) standard deviations as in `matrix`, infinite where not determined."""
        return torch.where(self.determined, self.matrix.diagonal().sqrt(), torch.inf)

    @property
    def determined(self) -> Tensor:
        """(S,) which unknowns are determined."""
        return ~self._lost(torch.eye(len(self._scale)).to(self._scale))

    def _lost(self, rows: Tensor) -> Tensor:
        """(K,) which functions are not determined."""
        scaled = rows * self._scale
        length = scaled.square().sum(-1)
        share = (scaled @ self.open).square().sum(-1)
        return (share > self._least_lost * torch.where(length > 0, length, 1.0)) | (not self.computed)


class Whitened(NamedTuple):
    """Unknowns y in place of x: x = change (y - begin).

    Attributes:
        change: (U, U).
        begin: (U,) what y is at x = 0; (U, Q) where residuals depend on more than x.
        known: (U,) whether y is a standard normal; nothing is known of the others.
    """

    change: Tensor
    begin: Tensor
    known: Tensor


def whitened(rows: Tensor, residuals: Tensor) -> Whitened:
    """Change variables so that ‖rows x + residuals‖² = Σ y² over the known y, and a constant; rows (R, U).

    Residuals (R, Q) times any vector (Q,) may stand for residuals (R,); `begin` is multiplied by it, too.

    Example:
        >>> whitened(torch.tensor([[2.0, 0.0]]).double(), torch.tensor([6.0]).double()).known
        tensor([ True, False])
    """
    count, beside = rows.shape[1], residuals if residuals.ndim == 2 else residuals[:, None]
    triangle = triangular(torch.cat([rows, beside], 1))[:count]
    scale = unit_scale(triangle[:, :count])
    left, values, right = torch.linalg.svd(triangle[:, :count] * scale)
    known = values > _ROUNDING * values[:1].sum()
    change = scale[:, None] * right.T / torch.where(known, values, 1.0)
    begin = torch.where(known[:, None], left.T @ triangle[:, count:], 0.0)
    return Whitened(change, begin.reshape(count, *residuals.shape[1:]), known)
