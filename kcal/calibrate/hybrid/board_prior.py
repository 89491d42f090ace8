"""What is known of a board, as Gaussians over the amplitudes of its modes: as printed, and what cameras tell of it.

Near its solution the data of one camera are a Gaussian of lens and board. With the lens integrated out, a message about
the board remains. Messages of several cameras and a prior are stacked; together they give mean, covariance, evidence.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import KNOWN, BoardModes
from kcal.calibrate.hybrid.evidence import maximize_evidence
from kcal.calibrate.hybrid.families import BOARD, Hyperprior, PriorFamilies, typical_hyperprior
from kcal.calibrate.hybrid.quadratic import still_data
from kcal.gaussian import Gaussian, numbered, stacked
from kcal.lens.information import BOARD_SLOT, CameraInformation


class BoardPrior(NamedTuple):
    """A board before a camera is calibrated.

    Attributes:
        own: as it was printed, or as it was measured.
        told: what other cameras say of a printed one; None: it was measured.
    """

    own: Gaussian
    told: Gaussian | None = None

    @property
    def whole(self) -> Gaussian:
        """Both together."""
        return self.own if self.told is None else self.own + self.told

    def applied(self, points: Tensor, modes: BoardModes) -> tuple[Tensor, BoardModes]:
        """Change variables: the mean board, and modes whose amplitudes have unit variance and no hyperparameter.

        Args:
            points: (N, 3) the board as ordered, meters.
            modes: of that board.
        """
        mean, half = self.whole.mean_and_half()
        shapes = torch.einsum("ab,bkn->akn", half, modes.shapes)
        unit = torch.ones_like(modes.unit)
        known = BoardModes(shapes, unit, torch.full_like(modes.family, KNOWN))
        return points + torch.einsum("b,bkn->nk", mean, modes.shapes), known

    def in_amplitudes(self, units: Tensor) -> Tensor:
        """(B,) amplitudes of the board's own modes, from the variables (B,) of `applied`."""
        mean, half = self.whole.mean_and_half()
        return mean + units @ half

    def in_units(self, amplitudes: Tensor) -> Tensor:
        """The inverse of `in_amplitudes`."""
        mean, half = self.whole.mean_and_half()
        return torch.linalg.solve_triangular(half, (amplitudes - mean)[None], upper=False, left=False)[0]

    def in_modes(self, known: CameraInformation, amplitudes: Tensor) -> CameraInformation:
        """What is known of a camera and of the variables of `applied`, by the board's own modes and what others told.

        Args:
            known: with these variables as the board's unknowns.
            amplitudes: (B,) of the modes at the estimate.
        """
        if self.told is None:
            # Modes of a board that was measured are not its own: what is said of the camera, whatever the board is.
            return known.without_board()
        lens = known.lens_size
        by_modes = known.rows[:, lens:] @ self.whole.compressed().rows[:, :-1]
        mean, half = self.own.mean_and_half()
        return dataclasses.replace(
            known,
            estimate=torch.cat([known.estimate[:lens], amplitudes]),
            rows=torch.cat([known.rows[:, :lens], by_modes], 1),
            mean=torch.cat([known.mean[:lens], mean]),
            sigma=torch.cat([known.sigma[:lens], half.diagonal()]),
            others=self.told.placed(known.board, amplitudes).rows,
        )


def evidence(prior: Gaussian, messages: Sequence[Gaussian]) -> float:
    """Logarithm of the prior's integral over the messages' likelihoods."""
    return stacked([prior, *messages]).log_integral() - prior.log_integral()


def printed_prior(modes: BoardModes, amplitudes: Tensor) -> Gaussian:
    """The prior of a printed board, from the ln amplitudes (4,) of its families of modes."""
    sigma = modes.unit * torch.exp(amplitudes[modes.family])
    return Gaussian.independent(numbered(BOARD_SLOT, len(sigma)), torch.zeros_like(sigma), sigma)


def printed_board(
    modes: BoardModes, messages: Sequence[Gaussian], hyperprior: Hyperprior | None = None
) -> tuple[Gaussian, float]:
    """The prior of a printed board whose amplitudes maximize the evidence of all messages, and its logarithm.

    Args:
        modes: of the board.
        messages: of the cameras that saw it.
        hyperprior: of the amplitudes; the typical one if not given.
    """
    prior, unit = hyperprior or typical_hyperprior(), modes.unit
    prior = Hyperprior(prior.mean[BOARD:], prior.sd[BOARD:])
    zero, none = torch.zeros_like(unit), torch.full_like(modes.family, -1)
    families = PriorFamilies(zero, unit.log(), modes.family, none, zero)
    data = still_data(stacked(messages).placed(numbered(BOARD_SLOT, len(unit)), zero).rows.T[None], zero, 0.0)
    # Messages are in standard deviations already.
    found = maximize_evidence(data, families, prior.mean, 1.0, prior, known_noise=True)
    return printed_prior(modes, found.h), -found.loss
