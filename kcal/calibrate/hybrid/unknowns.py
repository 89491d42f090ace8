"""What is unknown of a hybrid camera and of the board that it saw, and the least squares of both under their priors."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.parameters import FreeParameters
from kcal.calibrate.problem.priors import GaussianPrior
from kcal.calibrate.problem.readout import Readout
from kcal.lens.model import LensModel


def hybrid_unknowns(model: LensModel, square: bool = True) -> FreeParameters:
    """What is free of a hybrid camera: focal length, principal point, and all coefficients; no skew.

    Square pixels have one focal length; others have that of the rows as the last of the camera's unknowns.
    """
    rest = range(5, 5 + model.size)
    rows = 0 if square else 3 + model.size
    return FreeParameters((0, 1, 2, 3, *rest), (0, rows, 1, 2, *(i - 2 for i in rest)))


def hybrid_problem(
    points: Tensor,
    shapes: Tensor,
    pixels: Tensor,
    weights: Tensor,
    model: LensModel,
    mean: Tensor,
    precision: Tensor,
    readout: Readout | None = None,
    stillness: Tensor | None = None,
    square: bool = True,
) -> BoardProblem:
    """Residuals of boards under a hybrid lens, with a normal prior on each unknown of lens and board.

    Args:
        points: (N, 3) the board's corners as ordered, meters.
        shapes: (B, 3, N) modes of the board.
        pixels: (V, N, 2), NaN where not seen.
        weights: (V, N) by which residuals are multiplied.
        model: of a hybrid lens.
        mean: (S,) of the prior on the unknowns of the camera and on the board.
        precision: (S,) its weight: the squared noise over the prior's variance. Infinite: held.
        readout: how views move while they are read; None: they stand still.
        stillness: (12,) the squared noise over the variance of each number of a motion.
        square: whether pixels are square; others have two focal lengths.
    """
    held = torch.isinf(precision)
    return BoardProblem(
        points,
        pixels,
        model,
        hybrid_unknowns(model, square),
        shapes=shapes,
        free_board=True,
        held=held,
        weights=weights,
        terms=[hybrid_prior(model, len(shapes), mean, precision, square)],
        readout=readout,
        stillness=stillness,
    )


def hybrid_prior(model: LensModel, shapes: int, mean: Tensor, precision: Tensor, square: bool = True) -> GaussianPrior:
    """The prior of `hybrid_problem`, with so many modes of the board."""
    leading, count, held = hybrid_unknowns(model, square).leading, 5 + model.size, torch.isinf(precision)
    index = torch.cat([torch.tensor(leading), torch.arange(count, count + shapes)])[~held]
    return GaussianPrior(index, mean[~held], precision[~held].sqrt())
