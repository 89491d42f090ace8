"""One camera without a model to choose: base projection, learned field, pupil and board, amplitudes by evidence."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Literal

import torch
from torch import Tensor

from kcal.calibrate.bundle.views import among
from kcal.calibrate.lensfit.base_fit import Estimate, cauchy_weights, fit_base
from kcal.calibrate.lensfit.board_modes import BoardModes, board_modes
from kcal.calibrate.lensfit.board_prior import BoardPrior
from kcal.calibrate.lensfit.evidence import (
    SQUARE,
    Hyperprior,
    PriorFamilies,
    Quadratic,
    maximize_evidence,
    typical_hyperprior,
)
from kcal.calibrate.lensfit.fleet import LensPrior
from kcal.calibrate.lensfit.hybrid_problem import HybridProblem, HybridState, hybrid_unknowns
from kcal.calibrate.lensfit.measured_board import MeasuredBoard
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.field_modes import FieldModes
from kcal.lens.hybrid_terms import LEADING
from kcal.lens.information import CameraInformation, triangular
from kcal.lens.model import LensModel
from kcal.lens.zernike import ZernikeModes
from kcal.solve.lm import LMOptions, minimize

_ROUNDS = 6
# Pixels that a mode can move any point by, below which it is left out.
_UNFELT = 1e-6
# Unknowns before the field's weights: focal length, principal point, shape, pupil.
_LEADING = 6


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class HybridFit:
    """A camera, its board, and what is not known of both.

    Args:
        camera: the camera.
        state: parameters, board, poses.
        half: (S, S); halfᵀ half is the covariance of parameters and board.
        information: the same before anything was inverted, with data and priors apart.
        sigma: px, of a corner of weight one, tempering included.
        tempering: T, by which the data count less because residuals repeat within views.
        hyperparameters: (H,).
        families: the priors that these set; of a board with a prior of its own, those after the change of variables.
        log_evidence: of the last round.
        effective: number of parameters that the data determine.
        board_shapes: modes of the board.
        board_points: (N, 3) meters, the board as it was measured.
        residuals: (V, N, 2) projected minus observed, pixels, weights left out; NaN where a corner did not count.
        weights: (V, N) by which the residuals were multiplied.
        weighted_rms: sqrt(mean w² ‖r‖²), pixels.
        iterations: trial steps of the solver.
        converged: whether the hyperparameters came to rest.

    Example:
        >>> from kcal.lens.pose import rotation_from_vector
        >>> points = torch.cartesian_prod(torch.arange(6.0), torch.arange(7.0), torch.zeros(1)).double() * 0.05
        >>> truth = Camera.build(focal=(800, 800), center=(322, 238), size=(640, 480), model="pinhole")
        >>> tilts = torch.tensor([[0.5, 0, 0], [-0.5, 0.1, 0], [0, 0.5, 0.2], [0.1, -0.5, 0]], dtype=torch.float64)
        >>> shift = torch.tensor([-0.12, -0.15, 0.6], dtype=torch.float64)
        >>> pixels = truth.project(points @ rotation_from_vector(tilts).transpose(-1, -2) + shift)[0]
        >>> fit = fit_hybrid(points, pixels, (640, 480))
        >>> fit.converged, fit.effective < 20, fit.covariance.shape == 2 * fit.camera.params.shape
        (True, True, True)
    """

    camera: Camera
    state: HybridState
    half: Tensor
    information: CameraInformation
    sigma: float
    tempering: float
    hyperparameters: Tensor
    families: PriorFamilies
    log_evidence: float
    effective: float
    board_shapes: BoardModes
    board_points: Tensor
    residuals: Tensor
    weights: Tensor
    weighted_rms: float
    iterations: int
    converged: bool

    @property
    def rms(self) -> float:
        """sqrt(mean ‖r‖²) over the corners, pixels, all counting alike."""
        return float(self.residuals.square().sum(-1).nanmean().sqrt())

    def residuals_of(self, pixels: Tensor) -> Tensor:
        """(V, N, 2) as `residuals`, of any corners of the same views; infinite where the lens has no image of one."""
        state = self.state
        found, valid = self.camera.project(
            self.board_points @ state.rotation.transpose(-1, -2) + state.translation[:, None]
        )
        return torch.where(valid[..., None], found, torch.inf) - pixels

    def only(self, views: Sequence[int]) -> HybridFit:
        """This fit with some of its views; the others were left out of it."""
        at, state = list(views), self.state
        state = state._replace(rotation=state.rotation[at], translation=state.translation[at])
        return dataclasses.replace(self, state=state, residuals=self.residuals[at], weights=self.weights[at])

    def among(self, views: Sequence[int], count: int) -> HybridFit:
        """This fit of some views as one of `count` views: NaN for the others."""
        rotation, translation, residuals, weights = (
            among(values, views, count)
            for values in (self.state.rotation, self.state.translation, self.residuals, self.weights)
        )
        state = self.state._replace(rotation=rotation, translation=translation)
        return dataclasses.replace(self, state=state, residuals=residuals, weights=weights)

    @property
    def covariance(self) -> Tensor:
        """(5 + P, 5 + P) of the camera's parameters in the order of `Camera.names`: fx and fy alike, skew held."""
        unknowns = hybrid_unknowns(self.camera.model)
        count = len(self.state.params)
        onto = self.half.new_zeros(len(self.half), count)
        onto[list(unknowns.slots), list(unknowns.indices)] = 1.0
        root = self.half @ onto
        return root.T @ root


def fit_hybrid(
    points: Tensor,
    pixels: Tensor,
    size: tuple[int, int],
    weights: Tensor | None = None,
    modes: FieldModes | None = None,
    board: Literal["printed", "exact"] | BoardPrior | MeasuredBoard = "printed",
    square: float = SQUARE,
    focal: float | None = None,
    start: HybridFit | None = None,
    robust: bool = False,
    hyperprior: Hyperprior | None = None,
    lens: LensPrior | None = None,
    progress: Callable[[str], object] = lambda _: None,
) -> HybridFit:
    """Fit one camera.

    Args:
        points: (N, 3) the board's corners as ordered, meters, z = 0.
        pixels: (V, N, 2), NaN where not seen.
        size: (width, height) of the image.
        weights: (V, N) by which residuals are multiplied; 0 leaves a corner out. None: all count alike.
        modes: of the field.
        board: how it differs from the one that was ordered: as printers err, not at all, or as was measured.
        square: standard deviation of the pixels' aspect and skew.
        focal: roughly known, pixels, for the start.
        start: an earlier fit of the same views with other weights or another board, to begin with.
        robust: bound the weight of corners that are far off, so that a few wrong ones change nothing. Error bars of
            such a fit mean nothing; it tells which corners to leave out.
        hyperprior: of the amplitudes; the typical one if not given.
        lens: what is known of it from cameras of its type; its modes are used.
        progress: called after each step.

    Raises:
        InputError: no start explains the corners.
        DegenerateError: the board is seen from one side only, or from too few, so that no projection is found.
    """
    weights = torch.ones_like(pixels[..., 0]) if weights is None else weights
    if start is not None:
        form = start.camera.model.hybrid
        assert form is not None
        modes = form.modes
    elif lens is not None:
        modes = lens.form.modes
    modes = modes or ZernikeModes()
    hyperprior = hyperprior or typical_hyperprior(modes)
    if isinstance(board, MeasuredBoard):
        board = board.prior_for(points)
    ordered, own = points, board_modes(points)
    points, shown = board.applied(points, own) if isinstance(board, BoardPrior) else (points, own)
    seen = torch.isfinite(pixels).all(-1) & (weights > 0)
    freedom = 2 * int(seen.sum()) - 6 * len(pixels)
    if start is None:
        estimate, spent = fit_base(
            points, pixels, size, weights, modes, shown, square, focal, robust, hyperprior.mean, lens
        )
        progress("base projection")
    else:
        state = start.state
        if isinstance(board, BoardPrior):
            state = state._replace(board=torch.zeros_like(board.mean))
        families, h = start.families.with_board(shown), start.hyperparameters
        estimate = Estimate(start.camera.model, families, state, h, start.sigma**2, start.tempering)
        spent = start.iterations
    model, families, state, h, variance, tempering = estimate
    never = torch.zeros_like(families.mean, dtype=torch.bool)
    if board == "exact":
        never[-len(shown.unit) :] = True

    def solve(steps: int, gain: float) -> tuple[HybridProblem, HybridState, int]:
        precision = torch.where(never, torch.inf, variance / families.deviation(h).square())
        problem = HybridProblem(points, shown.shapes, pixels, weights, model, families.mean, precision)
        if robust:
            problem = problem.with_weights(cauchy_weights(problem, state, weights))
        options = LMOptions(max_iterations=steps, tolerance=gain / freedom, initial_damping=1e-6)
        result = minimize(problem, state, options)
        return problem, HybridState(*result.state), int(result.iterations)

    converged = False
    for turn in range(_ROUNDS):
        first = turn == 0 and start is None
        problem, state, steps = solve(8 if first else 12, 0.1 if first else 0.02)
        spent += steps
        off = problem.without_poses(state)
        off[:, :-1][:, never] = 0.0
        K, g, c = _quadratic(off, problem.shared(state))
        former = tempering
        if not first:
            found = _overdispersion(off, K, torch.where(never, 0.0, families.deviation(h)), variance)
            # More tempering leaves fewer parameters, over which the scores scatter less, and so on: the mean of both
            # ends this where the new value alone swings forever (OpenCV's left camera, between 1 and 2).
            tempering = found if turn < 2 else math.sqrt(tempering * found)
        data = Quadratic(K / tempering, g / tempering, c / tempering, freedom / tempering)
        h_new, noise, loss = maximize_evidence(data, families, h, variance / former, hyperprior)
        change = float((h_new - h).abs().max())
        h, variance = h_new, noise * tempering
        progress(f"evidence, round {turn + 1}")
        if not first and change < 0.1 and steps <= 2:
            converged = True
            break
    # Modes that the evidence holds so closely to zero that no pixel feels them are left out, error bars included.
    peaks = torch.tensor(modes.peaks, dtype=torch.float64)
    shift = families.deviation(h)[_LEADING : -len(shown.unit)] * float(state.params[0]) * peaks
    never[_LEADING : -len(shown.unit)] |= shift < _UNFELT
    mean = families.mean[_LEADING : -len(shown.unit)]
    state.params[5 + len(LEADING) :] = torch.where(shift < _UNFELT, mean, state.params[5 + len(LEADING) :])
    problem, state, steps = solve(10, 0.01)
    off = problem.without_poses(state)
    K, _, _ = _quadratic(off, problem.shared(state))
    deviation = torch.where(never, 0.0, families.deviation(h))
    inverse = _posterior_root(K, deviation, variance)
    errors = problem.errors(state)
    if not robust and not bool(torch.isfinite(errors).all()):
        raise InputError(
            "the lens cannot show all corners where they are: are all views of this board and this camera? Rejection "
            "of outliers leaves wrong views out"
        )
    half = inverse * deviation
    information = _from_rows(off, problem.shared(state), families.mean, deviation, variance, model)
    if isinstance(board, BoardPrior):
        state = state._replace(board=board.mean + state.board @ board.half)
        information = board.in_modes(information, state.board)
        half = torch.cat([half[:, : -len(board.mean)], half[:, -len(board.mean) :] @ board.half], 1)
    return HybridFit(
        camera=Camera(state.params, size=size, model=model),
        state=state,
        half=half,
        information=information,
        sigma=math.sqrt(variance),
        tempering=tempering,
        hyperparameters=h,
        families=families,
        log_evidence=-loss,
        effective=len(deviation) - float(inverse.square().sum()),
        board_shapes=own,
        board_points=ordered + torch.einsum("b,bkn->nk", state.board, own.shapes),
        residuals=torch.where(seen[..., None], errors.transpose(-1, -2), torch.nan),
        weights=weights,
        weighted_rms=math.sqrt(float((errors * problem.weights).square().sum()) / int(seen.sum())),
        iterations=spent + steps,
        converged=converged,
    )


def _from_rows(
    off: Tensor, x: Tensor, mean: Tensor, deviation: Tensor, variance: float, model: LensModel
) -> CameraInformation:
    """What rows off the poses (V, S + 1, R), at unknowns x (S,) less their mean, say of all that is not held."""
    kept = deviation.nonzero()[:, 0]
    rows = off.transpose(0, 1).flatten(1)[[*kept.tolist(), -1]].T / math.sqrt(variance)
    triangle = triangular(rows)[:-1]
    unknowns, place = hybrid_unknowns(model), {int(k): slot for slot, k in enumerate(kept)}
    slots = dict(zip(unknowns.indices, unknowns.slots, strict=True))
    return CameraInformation(
        slots=tuple(place.get(slots.get(i, -1), -1) for i in range(5 + model.size)),
        estimate=(x + mean)[kept],
        rows=triangle[:, :-1],
        residuals=triangle[:, -1],
        mean=mean[kept],
        sigma=deviation[kept],
    )


def _quadratic(off: Tensor, x: Tensor) -> tuple[Tensor, Tensor, float]:
    """K, g, c of chi²(x) = c - 2 gᵀx + xᵀKx for absolute x, from rows off the poses at x."""
    flat = off.transpose(0, 1).flatten(1)
    target = x @ flat[:-1] - flat[-1]
    return flat[:-1] @ flat[:-1].T, flat[:-1] @ target, float(target @ target)


def _posterior_root(K: Tensor, deviation: Tensor, variance: float) -> Tensor:
    """M of MᵀM = (I + √D K √D / σ²)⁻¹."""
    # By eigenvalues: with wrong corners K is so large that a Cholesky factor loses the I to rounding.
    values, vectors = torch.linalg.eigh(K * deviation[:, None] * deviation / variance)
    return (1.0 + values.clamp_min(0.0)).rsqrt()[:, None] * vectors.T


def _overdispersion(off: Tensor, K: Tensor, deviation: Tensor, variance: float) -> float:
    """How much more the scores of views scatter than independent corners explain, over the determined directions."""
    score = (off[:, :-1] @ off[:, -1, :, None])[..., 0]
    score = score - score.mean(0)
    inverse = _posterior_root(K, deviation, variance)
    effective = len(K) - float(inverse.square().sum())
    scattered = float((inverse @ (score * deviation / variance).T).square().sum()) * len(off) / (len(off) - 1)
    return max(1.0, scattered / effective)
