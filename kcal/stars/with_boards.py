"""One lens from boards and stars: boards tell the lens and its pupil where they were, stars the field at infinity."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.calibrate.hybrid.evidence import maximize_evidence
from kcal.calibrate.hybrid.families import PriorFamilies, typical_hyperprior
from kcal.calibrate.hybrid.fit import HybridFit
from kcal.calibrate.hybrid.quadratic import still_data
from kcal.calibrate.hybrid.unknowns import hybrid_unknowns
from kcal.calibrate.problem.parameters import FreeParameters
from kcal.errors import InputError
from kcal.gaussian import Gaussian, numbered
from kcal.lens.camera import Camera
from kcal.lens.information import LENS_SLOT, CameraInformation
from kcal.stars.lens_fit import CUT, StarLens, require_stars, star_lens
from kcal.stars.star_problem import StarField, StarProblem

_ROUNDS = 3
# While the lens is that of the boards alone, stars farther off than so many typical sigmas are left out.
_FIRST_CUT = 8.0
# Directions of the lens of which stars say at least so much as boards are compared.
_TOLD = 1.0
# Less probable by chance: boards and stars contradict each other.
_CONTRADICTION = 1e-4
# Residuals by which the noise is taken to be known while amplitudes are set.
_SURE = 1e4


class Agreement(NamedTuple):
    """How a lens from boards agrees with stars.

    Attributes:
        chi2: squared differences over their variances, in the directions of which stars say as much as boards or more.
        freedom: how many directions these are.
        by_chance: how probable so large a χ², or so large a difference in any one direction, is by chance.
        moved_px: by how much stars move the lens, RMS along an axis over the stars seen, after the images' rotations.
        stated_px: the standard deviation of that, as the boards stated it.

    Example:
        >>> Agreement(chi2=31.0, freedom=28, by_chance=0.3, moved_px=0.2, stated_px=0.3).contradiction is None
        True
    """

    chi2: float
    freedom: int
    by_chance: float
    moved_px: float
    stated_px: float

    @property
    def contradiction(self) -> str | None:
        """What to tell the user; None where chance explains the difference."""
        if self.by_chance > _CONTRADICTION:
            return None
        return (
            f"boards and stars contradict each other (χ² {self.chi2:.0f} in {self.freedom} directions): stars move "
            f"the lens by {self.moved_px:.2f} px, where the boards stated {self.stated_px:.2f} px. Are both of this "
            "camera, with the same focus, zoom and image size? Was one of them taken in another temperature? Calibrate "
            "by each alone and compare them with `kcal diff`"
        )


def refine_by_stars(
    fields: Sequence[StarField], rotations: Sequence[Tensor], boards: CameraCalibrationResult
) -> tuple[StarLens, Agreement]:
    """The posterior of a camera from boards and from the named stars of several images of it.

    The amplitudes of the default lens are those of largest evidence of both together.

    Args:
        fields: of each image.
        rotations: (3, 3) of each: camera from the frame of its directions, roughly.
        boards: the camera as boards calibrated it, which stays as it is.

    Raises:
        InputError: too few stars, or boards that do not say what they know of the camera.
    """
    require_stars(fields)
    whole = boards.information
    if whole is None:
        raise InputError("the boards do not say how well they know the camera, so that stars cannot refine it")
    lens = whole.without_board()
    free = [(index, slot) for index, slot in enumerate(lens.slots) if slot >= 0]
    unknowns = FreeParameters(*zip(*free, strict=True))
    leading = list(unknowns.leading)
    fit, model, parameters = StarProblem(fields, rotations), boards.camera.model, boards.camera.params.detach()
    fit.leave_out(parameters, model, _FIRST_CUT)
    sigma = lens.sigma
    for _ in range(_ROUNDS):
        parameters = fit.minimize(parameters, model, unknowns, _known_lens(lens, sigma), 10)
        fit.leave_out(parameters, model, CUT)
        # As `whitened` counts them.
        fit.variance = max(fit.variance, 1.0)
        told = fit.whitened(parameters, model, unknowns)
        if boards.hybrid is not None:
            sigma = _by_evidence(boards.hybrid, unknowns, lens, told, parameters[leading])
    known = _known_lens(lens, sigma)
    parameters = fit.minimize(parameters, model, unknowns, known, 10)
    told = fit.whitened(parameters, model, unknowns)
    change = parameters[leading] - lens.estimate
    refined = Camera(parameters, size=boards.camera.size, model=model)
    wide = dataclasses.replace(whole, sigma=torch.cat([sigma, whole.sigma[len(sigma) :]]))
    found = star_lens(fit, refined, known, told, _with_star_rows(wide, told, change))
    return found, _agreement_with(told, change, lens, *_star_noise(fit))


def joint_calibration(
    boards: CameraCalibrationResult, found: StarLens, agreement: Agreement
) -> CameraCalibrationResult:
    """The calibration by boards with camera, error bars and warnings of both; residuals stay those of boards alone.

    Args:
        boards: before.
        found: by `refine_by_stars`.
        agreement: likewise.
    """
    known = found.camera.calibration
    assert known is not None
    assert known.information is not None
    assert known.sigma is not None
    contradiction = agreement.contradiction
    return dataclasses.replace(
        boards,
        camera=found.camera,
        sigma={name: known.sigma[name] for name in boards.sigma},
        covariance=known.information.covariance(),
        information=known.information,
        warnings=boards.warnings + (() if contradiction is None else (contradiction,)),
    )


def _known_lens(lens: CameraInformation, sigma: Tensor) -> Gaussian:
    """What boards say of the lens, under a prior of standard deviations (S,)."""
    rows = dataclasses.replace(lens, sigma=sigma).all_rows()
    return Gaussian(numbered(LENS_SLOT, len(sigma)), lens.estimate, rows)


def _by_evidence(
    hybrid: HybridFit, unknowns: FreeParameters, lens: CameraInformation, stars: Tensor, x: Tensor
) -> Tensor:
    """(S,) standard deviations of the lens's unknowns beforehand, of largest evidence of boards and stars.

    Args:
        hybrid: how boards were fitted.
        unknowns: of the lens.
        lens: what boards say of them.
        stars: (S, S + 1) rows at x.
        x: (S,) the lens.
    """
    every = hybrid_unknowns(hybrid.model, hybrid.square)
    number = dict(zip(every.indices, every.slots, strict=True))
    kept = torch.tensor([number[index] for index in unknowns.leading])
    families = PriorFamilies(*(column[kept] for column in hybrid.families))
    boards = torch.cat([lens.rows, (lens.rows @ (x - lens.estimate) + lens.residuals)[:, None]], 1)
    # The noise is known already, which the last row says.
    noise = torch.nn.functional.pad(x.new_tensor([[math.sqrt(_SURE)]]), (len(x), 0))
    rows = torch.cat([boards, stars, noise]).T[None]
    data = still_data(rows, x - families.mean, _SURE)
    assert hybrid.model.hybrid is not None
    hyperprior = typical_hyperprior(hybrid.model.hybrid.modes)
    best = maximize_evidence(data, families, hybrid.hyperparameters, 1.0, hyperprior)
    return families.deviation(best.h)


def _with_star_rows(known: CameraInformation, stars: Tensor, change: Tensor) -> CameraInformation:
    """What boards and stars say together, at the lens's new estimate and the board's that follows it.

    Args:
        known: of lens and board, before.
        stars: (S, S + 1) rows of the lens, residuals at the new estimate.
        change: (S,) of the lens.
    """
    rows, count = known.all_rows(), len(change)
    aim = rows[:, :count] @ change + rows[:, -1]
    board = -torch.linalg.lstsq(rows[:, count:-1], aim[:, None]).solution[:, 0] if known.board_size else change[:0]
    step = torch.cat([change, board])
    wide = torch.cat([stars[:, :-1], stars.new_zeros(len(stars), known.board_size)], 1)
    others = known.others
    if others is not None:
        others = torch.cat([others[:, :-1], (others[:, -1] + others[:, :-1] @ board)[:, None]], 1)
    return dataclasses.replace(
        known,
        estimate=known.estimate + step,
        rows=torch.cat([known.rows, wide]),
        residuals=torch.cat([known.residuals + known.rows @ step, stars[:, -1]]),
        others=others,
    )


def _star_noise(fit: StarProblem) -> tuple[int, float]:
    """How many residuals of stars there are, and their sigma in px, as it counts."""
    weights = torch.cat([w / f.sigma for w, f in zip(fit.weights, fit.fields, strict=True)])
    count = int((weights > 0).sum())
    return 2 * count, math.sqrt(max(fit.variance, 1.0) * count / float(weights.square().sum()))


def _agreement_with(stars: Tensor, change: Tensor, lens: CameraInformation, count: int, sigma: float) -> Agreement:
    """Whether stars ask for more than the covariance of boards allows, to first order."""
    rows, residual = stars[:, :-1], stars[:, -1] - stars[:, :-1] @ change
    spread = rows @ lens.half().T
    left, told, _ = torch.linalg.svd(spread, full_matrices=False)
    use = told.square() > _TOLD
    squares = ((left.T @ residual).square() / (1.0 + told.square()))[use]
    chi2, freedom = float(squares.sum()), int(use.sum())
    # A change of focus is one direction, which the sum over many that agree would hide.
    by_chance = (
        min(float(stats.chi2.sf(chi2, freedom)), freedom * float(stats.chi2.sf(float(squares.max()), 1)))
        if freedom
        else 1.0
    )
    return Agreement(
        chi2=chi2,
        freedom=freedom,
        by_chance=min(2.0 * by_chance, 1.0),
        moved_px=sigma * math.sqrt(float((rows @ change).square().sum()) / count),
        stated_px=sigma * math.sqrt(float(spread.square().sum()) / count),
    )
