"""The priors of a camera's unknowns: families of Gaussians, whose amplitudes the evidence of the views sets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import KNOWN, BoardModes
from kcal.lens.field_modes import FieldModes
from kcal.lens.model import HybridForm
from kcal.lens.zernike import ZernikeModes

# After the hyperparameters of the modes: ln amplitudes of the pupil (in units of the board's range) and of the board:
# bending, stretch, print, trapezoid, single corners (in units of its extent): mean and sd of ln.
_MEAN = np.log([2e-4, 5e-4, 5e-4, 2e-4, 2e-4, 1e-4])
_SD = np.array([2.0, 1.5, 1.5, 1.5, 1.5, 1.5])
# Where the amplitudes of the board stand among the hyperparameters: the last five.
BOARD = -5
# Unknowns before the field's weights: focal length, principal point, shape, pupil; where the pupil stands among them.
LEADING_UNKNOWNS, PUPIL = 6, slice(4, 6)
# Those before the coefficients of the lens: focal length and principal point.
BEFORE_LENS = 3
# Unequal and skewed axes, in units of R: pixels are square.
SQUARE = 1e-4
# Of a focal length about that of the base projection, as a share of it: views that leave it open still tell it to no
# better than this, and where field and shape stand for it, it does not drift away (a mirror's image without a middle).
_FOCAL = 0.2
# Of the principal point about the middle, in diagonals.
_CENTER = 0.05
# Slopes of a port's normal to the optical axis: a few degrees.
_SLOPE = 0.05


class Hyperprior(NamedTuple):
    """A normal prior of the hyperparameters h.

    Attributes:
        mean: (H,).
        sd: (H,) standard deviations.
        most: (H,) largest values; None: there is no limit.
        by_hand: whether views move as by hand, because they are too few to tell (`kcal.calibrate.problem.state.FEW`).
    """

    mean: Tensor
    sd: Tensor
    most: Tensor | None = None
    by_hand: bool = False


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

    def with_board(self, board: BoardModes, modes: int, hyper: int) -> PriorFamilies:
        """The priors with another board, such as the same in other variables, in place of so many modes.

        Args:
            board: that the camera saw.
            modes: amplitudes of the board that these priors are of.
            hyper: number of the hyperparameters.
        """
        family = torch.where(board.family == KNOWN, -1, hyper + BOARD + board.family)
        zero = torch.zeros_like(board.unit)
        own = (zero, board.unit.log(), family, torch.full_like(family, -1), zero)
        return PriorFamilies(
            *(torch.cat([part[: len(part) - modes], new]) for part, new in zip(self, own, strict=True))
        )

    def with_port(self) -> PriorFamilies:
        """The priors of the same lens behind a flat port: ζ₃ and two slopes follow the pupil."""
        pupil, at, slope = PUPIL.start, LEADING_UNKNOWNS, math.log(_SLOPE)
        own = ([0.0] * 3, [float(self.log_unit[pupil]), slope, slope], [int(self.amplitude[pupil]), -1, -1], [-1] * 3)
        more = [each.new_tensor(values) for each, values in zip(self, (*own, [0.0] * 3), strict=True)]
        return PriorFamilies(*(torch.cat([each[:at], new, each[at:]]) for each, new in zip(self, more, strict=True)))

    def deviation(self, h: Tensor) -> Tensor:
        """(..., S) prior standard deviations, of hyperparameters (..., H)."""
        out = self.log_unit + torch.where(self.amplitude >= 0, h[..., self.amplitude], 0.0)
        return torch.exp(out - torch.where(self.decay >= 0, torch.exp(h[..., self.decay]), 0.0) * self.degree)

    def log_variance_slopes(self, h: Tensor) -> tuple[np.ndarray, np.ndarray]:
        """(S, H) first derivatives of 2 ln sd by h, and second ones, each by the same hyperparameter twice."""
        first = h.new_zeros(len(self.mean), len(h) + 1)
        # The last place takes what no hyperparameter sets.
        rows, count = torch.arange(len(self.mean)), len(h) + 1
        decays = -2.0 * torch.exp(torch.cat([h, h.new_zeros(1)]))[self.decay] * self.degree
        second = torch.zeros_like(first)
        second[rows, self.decay % count] = decays
        first[rows, self.amplitude % count] = 2.0
        return (first + second)[:, :-1].numpy(), second[:, :-1].numpy()


class LensPrior(NamedTuple):
    """What is known of a camera's lens before it is calibrated.

    Attributes:
        form: constants of the lens.
        focal: F₀, pixels.
        unknowns: (L,) focal length, principal point, coefficients; the focal length of the rows too where pixels are
            not square.
    """

    form: HybridForm
    focal: float
    unknowns: Hyperprior

    @property
    def square(self) -> bool:
        """Whether pixels are square."""
        return len(self.unknowns.mean) == BEFORE_LENS + len(self.form.names)

    def families(self, usual: PriorFamilies) -> PriorFamilies:
        """The usual priors with those of the lens replaced by these."""
        own = torch.arange(len(usual.mean)) < len(self.unknowns.mean)
        mean, log_unit = usual.mean.clone(), usual.log_unit.clone()
        mean[own], log_unit[own] = self.unknowns.mean, self.unknowns.sd.log()
        amplitude, decay = (torch.where(own, -1, index) for index in (usual.amplitude, usual.decay))
        return PriorFamilies(mean, log_unit, amplitude, decay, usual.degree)


def prior_families(
    form: HybridForm,
    focal: float,
    board: BoardModes,
    size: tuple[int, int],
    distance: float,
    aspect: float | None = None,
) -> PriorFamilies:
    """The priors of a camera and the board that it saw.

    Args:
        form: constants of the lens.
        focal: F₀, pixels.
        board: modes of the board.
        size: of the image.
        distance: typical distance of the board, meters.
        aspect: f_y / f_x of pixels that are not square, roughly; None: they are square.
    """
    diagonal = math.hypot(*size)
    corner = math.atan(0.5 * diagonal / focal)
    leading = [_FOCAL * focal, _CENTER * diagonal, _CENTER * diagonal, 1.0 + 0.5 / corner**2, distance, distance]
    rows = [] if aspect is None else [_FOCAL * aspect * focal]
    mean = torch.zeros(len(leading) + len(form.modes) + len(rows), dtype=torch.float64)
    mean[:4] = torch.tensor([focal, (size[0] - 1) / 2, (size[1] - 1) / 2, 0.5 - form.shape])
    if aspect is not None:
        mean[-1] = aspect * focal
    amplitude, decay, degree = zip(*form.modes.weight_priors, strict=True)
    by_pupil = len(form.modes.hyperprior)
    # Without an amplitude: how surely pixels are square.
    field_unit = [math.log(form.radius) + (math.log(SQUARE) if own is None else 0.0) for own in amplitude]
    none, more = [-1] * len(leading), [-1] * len(rows)
    families = PriorFamilies(
        mean,
        mean.new_tensor([*map(math.log, leading), *field_unit, *map(math.log, rows)]),
        torch.tensor([*none[:-2], by_pupil, by_pupil, *_numbers(amplitude), *more]),
        torch.tensor([*none, *_numbers(decay), *more]),
        torch.nn.functional.pad(mean.new_tensor(degree), (len(leading), len(rows))),
    ).with_board(board, 0, by_pupil + len(_MEAN))
    return families.with_port() if form.port else families


def _numbers(indices: Sequence[int | None]) -> list[int]:
    return [-1 if index is None else index for index in indices]


def typical_hyperprior(modes: FieldModes | None = None) -> Hyperprior:
    """The prior for a camera and a board of which nothing is known; modes default to those of the default field."""
    own = np.stack([_MEAN, _SD, np.full(len(_MEAN), np.inf)], 1)
    return Hyperprior(*torch.from_numpy(np.concatenate([(modes or ZernikeModes()).hyperprior, own]).T.copy()))
