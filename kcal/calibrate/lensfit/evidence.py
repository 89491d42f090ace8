"""How large each family of unknowns may be, told by the data: amplitudes and noise that maximize the evidence.

Near a solution residuals are linear in lens and board: chi²(x) = c - 2 gᵀx + xᵀKx, poses eliminated. With Gaussian
priors of variances D(h) the unknowns can be integrated out, and

    -2 ln p(data | h, σ²) = ν ln σ² + rss/σ² + |y|² + ln |I + √D K √D / σ²|,   x = √D y at its best,

is minimized over the hyperparameters h (log amplitudes and decays) and the noise, together with a broad log-normal
prior on h (type-II maximum likelihood, MacKay 1992; restricted maximum likelihood, Patterson and Thompson 1971).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import minimize as lbfgs
from torch import Tensor

from kcal.calibrate.bundle.views import LEAST_NOISE
from kcal.calibrate.lensfit.board_modes import KNOWN, BoardModes
from kcal.lens.field_modes import FieldModes
from kcal.lens.hybrid_terms import HybridForm
from kcal.lens.zernike import ZernikeModes

# After the hyperparameters of the modes: ln amplitudes of the pupil (in units of the board's range) and of the board:
# bending, stretch, print (in units of its extent): mean and sd of ln.
_MEAN = np.log([2e-4, 5e-4, 5e-4, 2e-4])
_SD = np.array([2.0, 1.5, 1.5, 1.5])
# Where the amplitudes of the board stand among the hyperparameters: the last three.
BOARD = -3
# Where the pupil stands among the unknowns.
_PUPIL = 4
# Unequal and skewed axes, in units of R: pixels are square.
SQUARE, ANALOG = 1e-4, 2e-3
# Of the principal point about the middle, in diagonals.
_CENTER = 0.05


class Hyperprior(NamedTuple):
    """A normal prior of the hyperparameters h.

    Attributes:
        mean: (H,).
        sd: (H,) standard deviations.
    """

    mean: Tensor
    sd: Tensor


class PriorFamilies(NamedTuple):
    """Which hyperparameters set the standard deviation of each unknown: ln sd = ln unit + ln h[amplitude] - h[decay] x.

    Attributes:
        mean: (S,).
        log_unit: (S,).
        amplitude: (S,) index of the log amplitude, -1 where the standard deviation is the unit.
        decay: (S,) index of the log decay, -1 where there is none.
        degree: (S,) x above.

    Example:
        >>> one = torch.ones(1, dtype=torch.float64)
        >>> families = PriorFamilies(0 * one, 0 * one, torch.tensor([0]), torch.tensor([1]), 2 * one)
        >>> h = torch.tensor([0.3, 0.5], dtype=torch.float64).log()
        >>> round(float(families.deviation(h)), 4)  # 0.3 exp(-0.5 * 2)
        0.1104
    """

    mean: Tensor
    log_unit: Tensor
    amplitude: Tensor
    decay: Tensor
    degree: Tensor

    def with_board(self, board: BoardModes) -> PriorFamilies:
        """The same camera, and another board, or the same in other variables."""
        lens = len(self.mean) - len(board.unit)
        family = torch.where(board.family == KNOWN, -1, self.amplitude[_PUPIL] + 1 + board.family)
        return self._replace(
            log_unit=torch.cat([self.log_unit[:lens], board.unit.log()]),
            amplitude=torch.cat([self.amplitude[:lens], family]),
        )

    def deviation(self, h: Tensor) -> Tensor:
        """(S,) prior standard deviations."""
        out = self.log_unit + torch.where(self.amplitude >= 0, h[self.amplitude], 0.0)
        return torch.exp(out - torch.where(self.decay >= 0, torch.exp(h[self.decay]), 0.0) * self.degree)

    def slopes(self, h: Tensor) -> Tensor:
        """(H, S) derivatives of 2 ln sd by h."""
        out = torch.zeros(len(h), len(self.mean), dtype=h.dtype)
        column = torch.arange(len(self.mean))
        some = self.amplitude >= 0
        out[self.amplitude[some], column[some]] = 2.0
        some = self.decay >= 0
        out[self.decay[some], column[some]] -= 2.0 * torch.exp(h[self.decay[some]]) * self.degree[some]
        return out


def prior_families(
    form: HybridForm,
    focal: float,
    board: BoardModes,
    size: tuple[int, int],
    distance: float,
    square: float = SQUARE,
) -> PriorFamilies:
    """The priors of a camera and the board that it saw.

    Args:
        form: constants of the lens.
        focal: F₀, pixels.
        board: modes of the board.
        size: of the image.
        distance: typical distance of the board, meters.
        square: standard deviation of aspect and skew.
    """
    diagonal = math.hypot(*size)
    corner = math.atan(0.5 * diagonal / focal)
    leading = [focal, _CENTER * diagonal, _CENTER * diagonal, 1.0 + 0.5 / corner**2, distance, distance]
    mean = torch.zeros(len(leading) + len(form.modes) + len(board.unit), dtype=torch.float64)
    mean[:4] = torch.tensor([focal, (size[0] - 1) / 2, (size[1] - 1) / 2, 0.5 - form.shape])
    amplitude, decay, degree = zip(*form.modes.weight_priors, strict=True)
    by_pupil = len(form.modes.hyperprior)
    # Without an amplitude: how surely pixels are square.
    field_unit = [math.log(form.radius) + (math.log(square) if own is None else 0.0) for own in amplitude]
    none = [-1] * len(leading)
    board_family = torch.where(board.family == KNOWN, -1, by_pupil + 1 + board.family)
    return PriorFamilies(
        mean,
        torch.cat([torch.tensor([*map(math.log, leading), *field_unit], dtype=torch.float64), board.unit.log()]),
        torch.cat([torch.tensor([*none[:-2], by_pupil, by_pupil, *_numbers(amplitude)]), board_family]),
        torch.cat([torch.tensor([*none, *_numbers(decay)]), torch.full_like(board.family, -1)]),
        torch.cat([torch.tensor([0.0] * len(leading) + [*degree], dtype=torch.float64), torch.zeros_like(board.unit)]),
    )


def _numbers(indices: Sequence[int | None]) -> list[int]:
    return [-1 if index is None else index for index in indices]


def typical_hyperprior(modes: FieldModes | None = None) -> Hyperprior:
    """That of a camera and a board of which nothing is known; without modes, for the default field."""
    mean, sd = np.array((modes or ZernikeModes()).hyperprior).T
    return Hyperprior(
        torch.from_numpy(np.concatenate([mean, _MEAN])),
        torch.from_numpy(np.concatenate([sd, _SD])),
    )


class Quadratic(NamedTuple):
    """Data near a solution: chi²(x) = c - 2 gᵀx + xᵀKx, poses eliminated.

    Attributes:
        K: (S, S).
        g: (S,).
        c: number.
        freedom: ν, residuals without those that poses take up.
    """

    K: Tensor
    g: Tensor
    c: float
    freedom: float


class _Root(NamedTuple):
    """The same without squares: chi²(x) = |rows x - target|² + rest.

    Attributes:
        rows: (R, S).
        target: (R,).
        rest: number.
    """

    rows: Tensor
    target: Tensor
    rest: float


def _root(data: Quadratic) -> _Root:
    # In units of the diagonal, below which nothing but rounding is left of directions that the data do not determine.
    scale = data.K.diagonal().clamp_min(1e-300).rsqrt()
    values, vectors = torch.linalg.eigh(data.K * scale[:, None] * scale)
    kept = values > len(values) * torch.finfo(values.dtype).eps * values[-1]
    root, vectors = values[kept].sqrt(), vectors[:, kept]
    target = vectors.T @ (scale * data.g) / root
    return _Root((vectors * root).T / scale, target, max(data.c - float(target @ target), 0.0))


def negative_log_evidence(data: Quadratic, families: PriorFamilies, v: np.ndarray) -> tuple[float, np.ndarray]:
    """The negative logarithm of the evidence of v = (h, ln σ²), (H + 1,), and its gradient."""
    return _negative_log_evidence(_root(data), data.freedom, families, v)


def _negative_log_evidence(
    data: _Root, freedom: float, families: PriorFamilies, v: np.ndarray
) -> tuple[float, np.ndarray]:
    here, s = torch.from_numpy(v[:-1]), math.exp(0.5 * v[-1])
    d = families.deviation(here) / s
    size = len(d)
    # Rows of data and priors, and the last column their target. Never squared: amplitudes may be so wide, or so close
    # to zero, that a factor of the normal matrix would be rounding.
    stacked = torch.zeros(len(data.rows) + size, size + 1, dtype=d.dtype)
    stacked[: len(data.rows), :-1], stacked[: len(data.rows), -1] = data.rows * d, data.target / s
    stacked[len(data.rows) :].fill_diagonal_(1.0)
    triangle = torch.linalg.qr(stacked, mode="r")[1]
    root, corner = triangle[:size, :size], float(triangle[size, size])
    inverse = torch.linalg.solve_triangular(root, torch.eye(size, dtype=d.dtype), upper=True)
    y2, kept = (inverse @ triangle[:size, -1]).square(), inverse.square().sum(1)
    chi2 = corner**2 - float(y2.sum()) + data.rest / s**2
    value = 0.5 * (freedom * v[-1] + corner**2 + data.rest / s**2) + float(root.diagonal().abs().log().sum())
    by_h = (families.slopes(here) @ (0.5 * (1.0 - y2 - kept))).numpy()
    return value, np.append(by_h, 0.5 * (freedom - (size - float(kept.sum())) - chi2))


def maximize_evidence(
    data: Quadratic,
    families: PriorFamilies,
    h: Tensor,
    variance: float,
    hyperprior: Hyperprior | None = None,
) -> tuple[Tensor, float, float]:
    """The hyperparameters and the noise variance of largest evidence, and its negative logarithm.

    Args:
        data: what the views say.
        families: the priors.
        h: start.
        variance: start.
        hyperprior: of h; the typical one of the default field if not given.
    """
    mean, sd = (part.numpy() for part in hyperprior or typical_hyperprior())
    root = _root(data)

    def objective(v: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = _negative_log_evidence(root, data.freedom, families, v)
        z = (v[:-1] - mean) / sd
        return value + 0.5 * float(z @ z), slope + np.append(z / sd, 0.0)

    start = np.append(h.numpy(), math.log(variance))
    # The last bound is open: where all are closed, L-BFGS-B makes its first trial at the bounds.
    bounds: list[tuple[float, float | None]] = [(m - 5 * s, m + 5 * s) for m, s in zip(mean, sd, strict=True)]
    bounds.append((max(start[-1] - 8, 2.0 * math.log(LEAST_NOISE)), None))
    found = lbfgs(
        objective,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        # To the maximum, not to wherever rounding lets the steps become small: 1e-2 of ln amplitude is 5e-3 sigma.
        options={"maxiter": 200, "ftol": 1e-12, "gtol": 1e-4, "maxcor": 20},
    )
    return torch.from_numpy(found.x[:-1].copy()), math.exp(found.x[-1]), float(found.fun)
