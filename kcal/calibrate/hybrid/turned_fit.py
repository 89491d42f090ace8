"""Fit one camera of several: views turned to one order, and what its data say about board, amplitudes and lens."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_orders import find_turns, quarter_turns, turned_corners
from kcal.calibrate.hybrid.board_prior import BoardPrior, printed_prior
from kcal.calibrate.hybrid.families import BOARD
from kcal.calibrate.hybrid.fit import HybridFit, fit_hybrid
from kcal.calibrate.hybrid.fleet import LensPrior, hyper_likelihood
from kcal.calibrate.hybrid.quadratic import Quadratic
from kcal.corners.observations import Observations
from kcal.gaussian import Gaussian, numbered
from kcal.lens.information import BOARD_SLOT, LENS_SLOT
from kcal.lens.zernike import ZernikeModes

# How a board differs from the one that was ordered: as printers err, not at all, or as others tell.
Shape = Literal["printed", "exact"] | BoardPrior

# Until no view is to be turned: two are enough as a rule.
_MOST_FITS = 5


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class CameraFit:
    """One of several cameras.

    Args:
        fit: the camera, with poses of the corners as they are turned.
        turns: (V,) quarter turns of the board by which the corners of each view were read from another end.
        message: what its data say about the board.
        hyper: what its data say about the amplitudes of lenses; None unless it is one of a type.
        lens: likewise about its own lens, in the form of the fit.
        board: which of the boards it saw; -1 for an exact one.
        nats: log evidence that it shares its board with the others of that board, against a board of its own. Of a
            camera that shares none: the same with the board that is most like its own, negative. With a measured board:
            that it is this one. NaN if there is nothing to compare.
    """

    fit: HybridFit
    turns: Tensor
    message: Gaussian
    hyper: Gaussian | None = None
    lens: Gaussian | None = None
    board: int = -1
    nats: float = math.nan


def fit_turned(
    seen: Observations,
    weights: Tensor | None,
    modes: ZernikeModes | None,
    turns: Tensor | None,
    shape: Shape,
    one_type: bool = False,
    lens: LensPrior | None = None,
    start: HybridFit | None = None,
    first: HybridFit | None = None,
) -> CameraFit:
    """Fit one camera, turn its views that were read from another end, and fit again until none is left.

    Args:
        seen: what it saw.
        weights: (V, N) of the corners; one if not given.
        modes: of the field.
        turns: (V,) quarter turns that are known already.
        shape: of the board.
        one_type: the camera is one of a type, so that it tells of its lens, too.
        lens: what is known of the lens.
        start: an earlier fit of the views with these turns, to begin with.
        first: such a fit with these weights, board and lens, which is taken as it is.
    """
    board, pixels = seen.board, seen.pixels()
    weights = torch.ones_like(pixels[..., 0]) if weights is None else weights
    turns = torch.zeros(len(pixels), dtype=torch.long) if turns is None else turns
    for attempt in range(_MOST_FITS):
        ordered, weighted = (turned_corners(values, board, turns) for values in (pixels, weights))
        if first is not None and attempt == 0:
            fit = first
        else:
            fit = fit_hybrid(board.points, ordered, seen.image_size, weighted, modes, shape, lens=lens, start=start)
        if shape == "exact" or len(quarter_turns(board)) == 1 or attempt == _MOST_FITS - 1:
            break
        prior = printed_prior(fit.board_shapes, fit.expected[BOARD:]) if shape == "printed" else shape.whole
        deviation = fit.families.deviation(fit.expected)[: -len(fit.state.board)]
        more = find_turns(_absolute_rows(fit, board.points, ordered, weighted), board, prior, deviation, fit.sigma**2)
        if not bool(more.any()):
            break
        turns, start = (turns + more) % 4, None
    message = fit.information.board_message.weighted(math.sqrt(fit.wider))
    found = CameraFit(fit=fit, turns=turns, message=message)
    return _with_its_type(found, board.points, ordered, weighted, shape) if one_type else found


def _with_its_type(camera: CameraFit, points: Tensor, pixels: Tensor, weights: Tensor, shape: Shape) -> CameraFit:
    """With what its data say about the amplitudes of lenses, and about its lens."""
    fit = camera.fit
    deviation = fit.families.deviation(fit.expected)
    of_board = numbered(BOARD_SLOT, len(fit.state.board))
    of_lens = numbered(LENS_SLOT, len(deviation) - len(of_board))
    mean = fit.families.mean[: len(of_lens)]
    flat = _absolute_rows(fit, points, pixels, weights).transpose(1, 2).flatten(0, 1)
    # The target is absolute, so that the residuals at the mean of lens and board are its negative.
    flat[:, -1] *= -1.0
    pixels_of = Gaussian((*of_lens, *of_board), torch.cat([mean, torch.zeros_like(fit.state.board)]), flat)
    data = pixels_of.weighted(1.0 / fit.sigma)
    if shape == "exact":
        lens_alone = data.conditioned(of_board).compressed()
        pixels_of = pixels_of.conditioned(of_board).placed(pixels_of.slots, pixels_of.at)
    elif shape == "printed":
        sigma = deviation[len(of_lens) :]
        lens_alone = (data + Gaussian.independent(of_board, torch.zeros_like(sigma), sigma)).marginal(of_lens)
    else:
        lens_alone = (data + shape.whole).marginal(of_lens)
        # In the variables of the fit's priors.
        at, half = shape.whole.mean_and_half()
        pixels_of = pixels_of.replaced(of_board, at, half.T, of_board)
    freedom = 2 * int((torch.isfinite(pixels).all(-1) & (weights > 0)).sum()) - 6 * len(pixels)
    hyper = _about_hyperparameters(fit, pixels_of.weighted(fit.tempering**-0.5), freedom / fit.tempering)
    return dataclasses.replace(camera, hyper=hyper, lens=lens_alone)


def _absolute_rows(fit: HybridFit, points: Tensor, pixels: Tensor, weights: Tensor) -> Tensor:
    """(V, S + 1, R) derivatives by lens and board off poses and motions, and the target of these rows, pixels."""
    count = len(fit.state.board)
    mean = torch.cat([fit.families.mean[:-count], torch.zeros_like(fit.state.board)])
    problem = fit.problem(points, pixels, weights, mean, torch.zeros_like(mean))
    rows = problem.off_poses(fit.state)
    rows[:, -1] = torch.einsum("s,vsn->vn", problem.unknowns(fit.state) - mean, rows[:, :-1]) - rows[:, -1]
    return rows


def _about_hyperparameters(fit: HybridFit, data: Gaussian, freedom: float) -> Gaussian:
    """What the data say, in pixels and about the mean of the fit's priors."""
    quadratic = Quadratic(data.products, freedom, torch.zeros_like(fit.families.mean))
    return hyper_likelihood(quadratic, fit.families, fit.hyperparameters, fit.sigma**2 / fit.tempering)
