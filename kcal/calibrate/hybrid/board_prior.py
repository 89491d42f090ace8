"""What cameras tell about the board that they saw, as Gaussians over the amplitudes of its modes.

Near its solution the data of one camera are a quadratic form over lens and board. With the lens integrated out under
its prior, a message remains: exp(-½ |R a - d|²) of the board's amplitudes a. Messages of several cameras and a prior
multiply: their rows are stacked, and one QR decomposition gives mean, covariance and evidence, all in square-root form.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import KNOWN, BoardModes
from kcal.calibrate.hybrid.families import BOARD, Hyperprior, typical_hyperprior
from kcal.lens.information import CameraInformation


class BoardMessage(NamedTuple):
    """What the data of one camera say about the amplitudes a of its board: likelihood exp(-½ |root a - target|²).

    Attributes:
        root: (R, B) per meter.
        target: (R,).
    """

    root: Tensor
    target: Tensor

    def turned(self, turn: Tensor) -> BoardMessage:
        """The same message about the amplitudes a' = turn a; turns (B, B) are orthogonal."""
        return self._replace(root=self.root @ turn.T)


class BoardPrior(NamedTuple):
    """A Gaussian over the amplitudes of a board's modes.

    Attributes:
        mean: (B,) meters.
        half: (B, B); halfᵀ half is the covariance.
        sigma: (B,) of a printed board's modes, whose mean is zero, before others told of it; None: it is not made so.
        told: what they told.
    """

    mean: Tensor
    half: Tensor
    sigma: Tensor | None = None
    told: BoardMessage | None = None

    def applied(self, points: Tensor, modes: BoardModes) -> tuple[Tensor, BoardModes]:
        """Change variables: the mean board, and modes whose amplitudes have unit variance and no hyperparameter.

        Args:
            points: (N, 3) the board as ordered, meters.
            modes: of that board.
        """
        shapes = torch.einsum("ab,bkn->akn", self.half, modes.shapes)
        unit = torch.ones_like(modes.unit)
        known = BoardModes(shapes, unit, torch.full_like(modes.family, KNOWN))
        return points + torch.einsum("b,bkn->nk", self.mean, modes.shapes), known

    def in_modes(self, known: CameraInformation, amplitudes: Tensor) -> CameraInformation:
        """What is known of a camera and of the variables of `applied`, by the board's own modes and what others told.

        Args:
            known: with these variables as the board's unknowns.
            amplitudes: (B,) of the modes at the estimate.
        """
        if self.sigma is None or self.told is None:
            # Modes of a board that was measured are not its own: what is said of the camera, whatever the board is.
            return known.without_board()
        lens = known.lens_size
        by_modes = torch.linalg.solve_triangular(self.half, known.rows[:, lens:].T, upper=False).T
        residuals = self.told.root @ amplitudes - self.told.target
        return dataclasses.replace(
            known,
            estimate=torch.cat([known.estimate[:lens], amplitudes]),
            rows=torch.cat([known.rows[:, :lens], by_modes], 1),
            mean=torch.cat([known.mean[:lens], torch.zeros_like(amplitudes)]),
            sigma=torch.cat([known.sigma[:lens], self.sigma]),
            others=torch.cat([self.told.root, residuals[:, None]], 1),
        )


class BoardPosterior(NamedTuple):
    """A prior and messages, multiplied.

    Attributes:
        board: mean and covariance.
        log_evidence: ln of the prior's integral over the messages' likelihoods.
    """

    board: BoardPrior
    log_evidence: float


def message_from_rows(rows: Tensor, lens_deviation: Tensor, variance: float) -> BoardMessage:
    """Integrate the lens out.

    Args:
        rows: (R, S + 1) derivatives by lens and board, and their absolute target, pixels.
        lens_deviation: (L,) of the lens's prior, whose mean is zero.
        variance: of the rows' noise, px².
    """
    count, boards = len(lens_deviation), rows.shape[1] - 1 - len(lens_deviation)
    scaled = rows / math.sqrt(variance)
    prior = torch.eye(count, rows.shape[1], dtype=rows.dtype)
    stacked = torch.cat([torch.cat([scaled[:, :count] * lens_deviation, scaled[:, count:]], 1), prior])
    triangle = torch.linalg.qr(stacked, mode="r")[1][count : count + boards]
    return BoardMessage(triangle[:, count:-1], triangle[:, -1])


def multiplied(prior: BoardPrior, messages: Sequence[BoardMessage]) -> BoardPosterior:
    """The posterior of the board, and the evidence of the messages."""
    size = len(prior.mean)
    rows = [torch.cat([m.root @ prior.half.T, (m.target - m.root @ prior.mean)[:, None]], 1) for m in messages]
    # A row of zeros keeps the triangle square where there is nothing but the prior.
    stacked = torch.cat([torch.eye(size, size + 1, dtype=prior.mean.dtype), *rows, prior.mean.new_zeros(1, size + 1)])
    triangle = torch.linalg.qr(stacked, mode="r")[1]
    root, target, rest = triangle[:size, :size], triangle[:size, -1:], triangle[size, -1]
    mean = torch.linalg.solve_triangular(root, target, upper=True)[:, 0]
    half = torch.linalg.solve_triangular(root.T, prior.half, upper=False)
    log_evidence = -root.diagonal().abs().log().sum() - 0.5 * rest.square()
    return BoardPosterior(BoardPrior(prior.mean + prior.half.T @ mean, half), float(log_evidence))


def merged(messages: Sequence[BoardMessage]) -> BoardMessage:
    """All that they say, in one message of few rows."""
    rows = torch.cat([torch.cat([m.root, m.target[:, None]], 1) for m in messages])
    triangle = torch.linalg.qr(rows, mode="r")[1]
    return BoardMessage(triangle[:, :-1], triangle[:, -1])


def told_by_others(prior: BoardPrior, message: BoardMessage) -> BoardPrior:
    """A printed board after others told of it."""
    return multiplied(prior, [message]).board._replace(sigma=prior.half.diagonal(), told=message)


def printed_prior(modes: BoardModes, amplitudes: Tensor) -> BoardPrior:
    """The prior of a printed board, from the ln amplitudes (4,) of its families of modes."""
    return BoardPrior(torch.zeros_like(modes.unit), torch.diag(modes.unit * torch.exp(amplitudes[modes.family])))


def printed_board(
    modes: BoardModes, messages: Sequence[BoardMessage], hyperprior: Hyperprior | None = None
) -> tuple[BoardPrior, float]:
    """The prior of a printed board whose amplitudes maximize the evidence of all messages, and its logarithm.

    Args:
        modes: of the board.
        messages: of the cameras that saw it.
        hyperprior: of the amplitudes; the typical one if not given.
    """
    prior = hyperprior or typical_hyperprior()
    mean, deviation = prior.mean[BOARD:].numpy(), prior.sd[BOARD:].numpy()
    family = modes.family.numpy()

    def objective(h: np.ndarray) -> tuple[float, np.ndarray]:
        prior = printed_prior(modes, torch.from_numpy(h))
        (at, half, *_), log_evidence = multiplied(prior, messages)
        by_deviation = 1.0 - ((at.square() + half.square().sum(0)) / prior.half.diagonal().square()).numpy()
        z = (h - mean) / deviation
        slope = np.bincount(family, by_deviation, len(h))
        return 0.5 * float(z @ z) - log_evidence, slope + z / deviation

    bounds = list(zip(mean - 5 * deviation, mean + 5 * deviation, strict=True))
    # Here, because SciPy takes long to load.
    from scipy.optimize import minimize as lbfgs

    found = lbfgs(objective, mean, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 60, "gtol": 1e-3})
    return printed_prior(modes, torch.from_numpy(found.x.copy())), -float(found.fun)
