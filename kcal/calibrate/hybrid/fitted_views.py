"""Views to which a hybrid camera is fitted, what is unknown of it, and the least squares of both."""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import BoardModes
from kcal.calibrate.hybrid.evidence import ViewData, view_data
from kcal.calibrate.hybrid.families import PUPIL, Hyperprior, PriorFamilies
from kcal.calibrate.problem.board_problem import POSE, TURN, BoardProblem
from kcal.calibrate.problem.parameters import FreeParameters, GaussianPrior, GaussianTerm
from kcal.calibrate.problem.state import BoardState, Readout, stillness
from kcal.calibrate.problem.views import LEAST_NOISE
from kcal.gaussian import Gaussian, numbered
from kcal.lens.camera import Camera
from kcal.lens.information import LENS_SLOT
from kcal.lens.model import LensModel
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.problem import RobustLoss

# What is unknown of a hybrid camera and of the board that it saw, and the least squares of both under their priors.


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
    turning: bool = False,
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
        readout: how views move while they are read, and how the board bends in them; None: neither.
        stillness: (M,) or (V, M) the squared noise over the variance of each of these numbers.
        square: whether pixels are square; others have two focal lengths.
        turning: points are (V, N, 3) and infinitely far, so that poses are rotations.
    """
    held = torch.isinf(precision)
    return BoardProblem(
        points, pixels, model, hybrid_unknowns(model, square), shapes=shapes, free_board=True, held=held,
        weights=weights, terms=[hybrid_prior(model, len(shapes), mean, precision, square)], readout=readout,
        stillness=stillness, turning=turning,
    )  # fmt: skip


def hybrid_prior(model: LensModel, shapes: int, mean: Tensor, precision: Tensor, square: bool = True) -> GaussianPrior:
    """The prior of `hybrid_problem`, with so many modes of the board."""
    leading, count, held = hybrid_unknowns(model, square).leading, 5 + model.size, torch.isinf(precision)
    index = torch.cat([torch.tensor(leading), torch.arange(count, count + shapes)])[~held]
    return GaussianPrior(index, mean[~held], precision[~held].sqrt())


# Views to which a hybrid camera is fitted, where a fit stands, and the least squares of both.

# The logarithms of motions' standard deviations over the noise, of views that stand still.
NO_MOTION = np.zeros(0)


class Estimate(NamedTuple):
    """Where a fit stands; last how much the board bends in each view (V,), relative to the others (None: alike)."""

    model: LensModel
    families: PriorFamilies
    state: BoardState
    hyperparameters: Tensor
    log_ratio: np.ndarray
    variance: float
    tempering: float
    relative: Tensor | None = None

    @property
    def stillness(self) -> Tensor:
        """The squared noise over the variance of each number of a view."""
        return stillness(self.log_ratio, self.relative)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class FittedViews:
    """What a camera is fitted to.

    Args:
        points: (N, 3) the board as it was before, meters.
        board: how it may differ.
        pixels: (V, N, 2), NaN where not seen.
        size: (width, height) of the image.
        weights: (V, N) by which residuals are multiplied.
        hyperprior: of the amplitudes.
        readout: how views move while they are read, and how the board bends in them; None: neither.
        square: whether pixels are square.
        robust: bound the weight of corners that are far off.
        exact: the board does not differ.
        heights: (12, N) of the corners by which the board may bend by view, meters, if the evidence says so, or None.
        turning: views show points (V, N, 3) that are infinitely far, such as stars: poses are rotations, nothing
            depends on the pupil, and errors do not repeat within a view.
        known: what other data say of the lens, by the numbers of its unknowns, in standard deviations as weighted
            residuals are then, too; unknowns that it does not name are held. None: nothing.
    """

    points: Tensor
    board: BoardModes
    pixels: Tensor
    size: tuple[int, int]
    weights: Tensor
    hyperprior: Hyperprior
    readout: Readout | None = None
    square: bool = True
    robust: bool = False
    exact: bool = False
    heights: Tensor | None = None
    turning: bool = False
    known: Gaussian | None = None

    @functools.cached_property
    def _kept(self) -> list[tuple[LensModel, Tensor, BoardProblem]]:
        """The last problem, with its lens and what was held."""
        return []

    @property
    def seen(self) -> Tensor:
        """(V, N)."""
        return torch.isfinite(self.pixels).all(-1) & (self.weights > 0)

    def by_corner(self, errors: Tensor) -> Tensor:
        """(V, N, 2) errors (V, 2, N) of pixels; NaN where a corner does not count."""
        return torch.where(self.seen[..., None], errors.transpose(-1, -2), torch.nan)

    def of_corners(self, kept: Tensor) -> FittedViews:
        """These views, standing still, with some corners of the board alone, by their numbers."""
        return dataclasses.replace(
            self,
            points=self.points[kept],
            board=self.board._replace(shapes=self.board.shapes[..., kept]),
            pixels=self.pixels[:, kept],
            weights=self.weights[:, kept],
            readout=None,
            heights=None,
        )

    @property
    def freedom(self) -> int:
        """Residuals without those that poses take up."""
        return 2 * int(self.seen.sum()) - (TURN if self.turning else POSE) * len(self.pixels)

    def held(self, estimate: Estimate) -> Tensor:
        """(S,) whether an unknown keeps its value, whatever the views show: of an exact board, of a pupil of stars."""
        held = torch.zeros_like(estimate.families.mean, dtype=torch.bool)
        if self.known is not None:
            named = set(self.known.slots)
            return torch.tensor([slot not in named for slot in numbered(LENS_SLOT, len(held))])
        held[PUPIL] = self.turning
        held[len(held) - len(self.board.unit) :] = self.exact
        return held

    def _told(self, model: LensModel) -> list[GaussianTerm]:
        """What other data say of the lens, as residuals."""
        if self.known is None:
            return []
        leading = hybrid_unknowns(model, self.square).leading
        numbers = dict(zip(numbered(LENS_SLOT, len(leading)), leading, strict=True))
        return [GaussianTerm(torch.tensor([numbers[slot] for slot in self.known.slots]), self.known, 1.0)]

    def problem(self, estimate: Estimate, held: Tensor | None = None) -> BoardProblem:
        """The least squares at amplitudes of an estimate, unknowns (S,) being held: those of `held` if not given."""
        never = self.held(estimate) if held is None else held
        deviation = estimate.families.deviation(estimate.hyperparameters)
        precision = torch.where(never, torch.inf, estimate.variance / deviation.square())
        fixed, still, kept = torch.isinf(precision), estimate.stillness, self._kept
        if kept and kept[0][0] is estimate.model and torch.equal(kept[0][1], fixed):
            # What corners say at the last state serves under other priors, too.
            problem = kept[0][2]
        else:
            problem = hybrid_problem(
                self.points, self.board.shapes, self.pixels, self.weights, estimate.model, estimate.families.mean,
                precision, self.readout, still, self.square, self.turning,
            )  # fmt: skip
            kept[:] = [(estimate.model, fixed, problem)]
        prior = hybrid_prior(estimate.model, len(self.board.shapes), estimate.families.mean, precision, self.square)
        problem = problem.with_priors([prior, *self._told(estimate.model)], still)
        if self.robust:
            return problem.with_weights(_cauchy_weights(problem, estimate.state, self.weights))
        return problem

    def solved(
        self, estimate: Estimate, effort: tuple[int, float], last_step: bool = False, held: Tensor | None = None
    ) -> tuple[BoardProblem, Estimate, int]:
        """The problem, the estimate with its solution, and the trial steps.

        Without a last step the solution is where the problem was linearized: what is linear in lens and board, as the
        evidence is, follows from there.
        """
        problem = self.problem(estimate, held)
        steps, gain = effort
        options = LMOptions(
            max_iterations=steps, tolerance=gain / self.freedom, initial_damping=1e-10, last_step=last_step
        )
        result = minimize(problem, estimate.state, options)
        return problem, estimate._replace(state=result.state), int(result.iterations)

    def data(self, problem: BoardProblem, estimate: Estimate) -> ViewData:
        """What the views say near an estimate."""
        state, products = estimate.state, problem.products(estimate.state).off(problem.pose)
        count = problem.unknown_count
        if len(problem.moving) < count:
            # Unknowns that are held are among the others, of which nothing is said.
            place, size = torch.cat([problem.moving, torch.tensor([count])]), count + 1
            total = products.total.new_zeros(size, size)
            total[place[:, None], place] = products.total
            right, score = (
                part.new_zeros(*part.shape[:-1], size).index_copy_(-1, place, part)
                for part in (products.right, products.score)
            )
            products = products._replace(right=right, score=score, total=total)
        if self.known is not None:
            told = self.known.placed(numbered(LENS_SLOT, count), problem.unknowns(state)).products
            products = products._replace(total=products.total + told)
        found = view_data(products, problem.unknowns(state) - estimate.families.mean, state.motion, self.freedom)
        return found._replace(relative=estimate.relative)


def _cauchy_weights(problem: BoardProblem, state: BoardState, weights: Tensor) -> Tensor:
    """(V, N) weights of a Cauchy loss at a state, its scale three robust standard deviations; 0 without an image."""
    length = (problem.pixel_errors(state) * weights[:, None]).norm(dim=1)
    shown = torch.isfinite(length) & problem.seen
    # Of two normal components, the median length is 1.18 standard deviations.
    scale = max(3.0 * float(length[shown].median()) / 1.18, LEAST_NOISE)
    return torch.where(shown, weights * RobustLoss(kind="cauchy", scale=scale).weight(length.square()).sqrt(), 0.0)


# Poses and motions of views that were held out, under a camera and a board that stay as they are.

_EFFORT = LMOptions(max_iterations=60, tolerance=1e-12, initial_damping=1e-6)


def moving_residuals(
    camera: Camera,
    board_points: Tensor,
    pixels: Tensor,
    rotation: Tensor,
    translation: Tensor,
    readout: Readout,
    stillness: Tensor,
) -> Tensor:
    """Residuals of views whose poses and motions are solved for, the camera and its board being held.

    A lens is judged by views that were not fitted. Of views that moved while they were read the motion is unknown too,
    and would be counted as an error of the lens.

    Args:
        camera: of any model.
        board_points: (N, 3) the board, meters.
        pixels: (V, N, 2), NaN where not seen.
        rotation: (V, 3, 3) cam_from_board, to begin with; a view without a pose is NaN and stays so.
        translation: (V, 3) meters.
        readout: how views are read.
        stillness: (M,) the squared noise over the variance of each number of a view.

    Returns:
        (V, N, 2) projected minus seen, pixels; NaN where not seen.
    """
    posed = rotation.flatten(1).isfinite().all(1)
    out = torch.full_like(pixels, torch.nan)
    if not bool(posed.any()):
        return out
    params = camera.params.detach()
    some = pixels[posed]
    problem = BoardProblem(
        board_points,
        some,
        camera.model,
        readout=readout,
        stillness=stillness,
    )
    motion = rotation.new_zeros(len(some), readout.numbers)
    state = BoardState.flat(params, rotation[posed], translation[posed])._replace(motion=motion)
    out[posed] = problem.corner_residuals(minimize(problem, state, _EFFORT).state)
    return out
