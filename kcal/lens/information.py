"""What a calibration says of a camera and of the board that it saw, as Gaussians (`kcal.gaussian`)."""

from __future__ import annotations

import dataclasses
import functools
import math

import torch
from torch import Tensor

from kcal.checks import as_covariance
from kcal.errors import InputError
from kcal.gaussian import Gaussian, Slots, numbered
from kcal.texts import brief

# Names of the unknowns: (LENS_SLOT, 0), ... of the camera, (BOARD_SLOT, 0), ... of its board.
LENS_SLOT, BOARD_SLOT = "lens", "board"
# Products of larger numbers, and of inverses of smaller ones, may overflow on the way to a covariance.
_MOST = 1e100


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class CameraInformation:
    """The likelihood of one camera's data and its priors; their product is largest at the estimate.

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
        InputError: shapes that do not fit each other, or values that are not finite or whose squares would not be.

    Example:
        >>> focal = CameraInformation.from_covariance(torch.tensor([800.0, 800, 320, 240, 0]).double(),
        ...                                           torch.diag(torch.tensor([4.0, 4, 0, 0, 0])).double())
        >>> focal.slots, focal.rows.tolist()
        ((0, 1, -1, -1, -1), [[0.5, 0.0], [0.0, 0.5]])
    """

    __repr__ = brief

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
        weights = 1.0 / self.sigma
        numbers = (self.estimate, self.mean, self.residuals, (self.estimate - self.mean) * weights, *others)
        rows = torch.cat([self.rows, weights[None]]).abs()
        if any(not bool((number.abs() <= _MOST).all()) for number in (*numbers, rows)):
            raise InputError(f"information: numbers beyond {_MOST:.0e}, or sigmas of the prior below {1 / _MOST:.0e}")
        if bool(((rows > 0).any(0) & (rows < 1.0 / _MOST).all(0)).any()):
            raise InputError(f"information: the data and the prior say less than {1 / _MOST:.0e} of an unknown")

    @classmethod
    def from_covariance(cls, params: Tensor, covariance: Tensor) -> CameraInformation:
        """From a camera's parameters (5 + P,) and their covariance (5 + P, 5 + P); those without variance are held.

        Raises:
            InputError: a wrong shape, values that are not finite, or no covariance.
        """
        matrix = as_covariance("covariance of the camera's parameters", covariance, len(params))
        free = matrix.diagonal().nonzero()[:, 0]
        places = {int(index): slot for slot, index in enumerate(free)}
        known = Gaussian.from_covariance(
            numbered(LENS_SLOT, len(free)), params.detach()[free].double(), matrix[free[:, None], free]
        )
        return cls(
            slots=tuple(places.get(i, -1) for i in range(len(params))),
            estimate=known.at,
            rows=known.rows[:, :-1],
            residuals=known.rows[:, -1],
            mean=torch.zeros_like(known.at),
            sigma=torch.full_like(known.at, math.inf),
        )

    @property
    def lens_size(self) -> int:
        """How many of the unknowns are the camera's."""
        return max(self.slots, default=-1) + 1

    @property
    def board_size(self) -> int:
        """How many of the unknowns are the board's."""
        return len(self.estimate) - self.lens_size

    @property
    def lens(self) -> Slots:
        """Names of the camera's unknowns."""
        return numbered(LENS_SLOT, self.lens_size)

    @property
    def board(self) -> Slots:
        """Names of the board's unknowns."""
        return numbered(BOARD_SLOT, self.board_size)

    @property
    def data(self) -> Gaussian:
        """What the data say, about the estimate."""
        return Gaussian((*self.lens, *self.board), self.estimate, torch.cat([self.rows, self.residuals[:, None]], 1))

    @property
    def lens_prior(self) -> Gaussian:
        """The prior of the camera: only of unknowns that have one."""
        return self._prior(range(self.lens_size))

    @property
    def board_prior(self) -> Gaussian:
        """The prior of the board."""
        return self._prior(range(self.lens_size, len(self.estimate)))

    def _prior(self, numbers: range) -> Gaussian:
        finite = self.sigma.isfinite().tolist()
        known = [number for number in numbers if finite[number]]
        slots = (*self.lens, *self.board)
        return Gaussian.independent(tuple(slots[number] for number in known), self.mean[known], self.sigma[known])

    @property
    def board_message(self) -> Gaussian:
        """What the data say of the board: the camera, with its prior, is integrated out."""
        return (self.data + self.lens_prior).marginal(self.board)

    @property
    def told(self) -> Gaussian:
        """What other cameras say of the board."""
        at = self.estimate[self.lens_size :]
        return Gaussian(self.board, at, at.new_zeros(0, len(at) + 1) if self.others is None else self.others)

    @property
    def whole(self) -> Gaussian:
        """Data, priors, and what other cameras say of the board, about the estimate."""
        return self.data + self.lens_prior + self.board_prior + self.told

    def with_data(self, data: Gaussian) -> CameraInformation:
        """What is known when other data take the place of these: the same priors, about the same estimate."""
        rows = data.placed(self.data.slots, self.estimate).rows
        return dataclasses.replace(self, rows=rows[:, :-1], residuals=rows[:, -1])

    def changed(self, by: Tensor, *, prior: bool = False) -> CameraInformation:
        """What is known after a change of the camera by columns (5 + P, K), each times a standard normal amount.

        The prior is one of the camera before, or as well of the changed one: then it stays a prior.
        """
        count, amounts = self.lens_size, numbered("change", by.shape[1])
        lens = torch.linalg.pinv(self.selection()[:, :count]) @ by
        step = torch.cat([torch.eye(count, dtype=by.dtype), -lens], 1)
        data = self.data if prior else self.data + self.lens_prior
        before = data.replaced(self.lens, self.estimate[:count], step, (*self.lens, *amounts))
        zero = by.new_zeros(len(amounts))
        both = before + Gaussian.independent(amounts, zero, zero + 1.0)
        rows = both.marginal((*self.lens, *self.board)).rows
        sigma = self.sigma if prior else torch.where(torch.arange(len(self.sigma)) < count, math.inf, self.sigma)
        return dataclasses.replace(self, rows=rows[:, :-1], residuals=rows[:, -1], sigma=sigma)

    def half(self) -> Tensor:
        """(U, U): halfᵀ half is the covariance of the unknowns; what nothing determines has a very large one."""
        return self._half

    @functools.cached_property
    def _half(self) -> Tensor:
        return self.whole.half()

    def by_parameter(self, columns: Tensor) -> Tensor:
        """Columns (K, U) by the unknowns as columns (K, 5 + P) by the parameters: zeros for those held."""
        return columns @ self.selection().T

    def selection(self) -> Tensor:
        """(5 + P, U): the change of each parameter with each unknown."""
        places = torch.arange(len(self.estimate), device=self.rows.device)
        return (torch.tensor(self.slots, device=self.rows.device)[:, None] == places).to(self.rows.dtype)

    def covariance(self) -> Tensor:
        """(5 + P, 5 + P) of the camera's parameters in the order of `Camera.names`, zero for those held."""
        half = self.by_parameter(self.half())
        return half.T @ half

    def without_board(self) -> CameraInformation:
        """What is known of the camera alone: the board is integrated out."""
        count = self.lens_size
        if not self.board_size:
            return self
        alone = (self.data + self.board_prior + self.told).marginal(self.lens).rows
        return CameraInformation(
            slots=self.slots,
            estimate=self.estimate[:count],
            rows=alone[:, :-1],
            residuals=alone[:, -1],
            mean=self.mean[:count],
            sigma=self.sigma[:count],
        )
