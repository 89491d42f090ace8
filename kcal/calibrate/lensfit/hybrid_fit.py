"""One camera without a model to choose: base projection, learned field, pupil and board, amplitudes by evidence."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.bundle.closed_form import homographies, poses_from_homographies
from kcal.calibrate.bundle.views import LEAST_NOISE
from kcal.calibrate.lensfit.board_modes import BoardModes, board_modes
from kcal.calibrate.lensfit.evidence import (
    SQUARE,
    PriorFamilies,
    maximize_evidence,
    prior_families,
    typical_hyperprior,
)
from kcal.calibrate.lensfit.hybrid_problem import HybridProblem, HybridState, hybrid_unknowns
from kcal.errors import DegenerateError, InputError
from kcal.lens.base_map import angle_over_radius
from kcal.lens.camera import Camera
from kcal.lens.field_modes import FieldModes
from kcal.lens.hybrid_terms import LEADING, HybridForm
from kcal.lens.model import LensModel
from kcal.lens.zernike import ZernikeModes
from kcal.solve.lm import LMOptions, minimize

# R in half diagonals: the disc on which fields live reaches a little beyond the image's corners.
_REACH = 1.08
_ROUNDS = 6
# Pixels that a mode can move any point by, below which it is left out.
_UNFELT = 1e-6
# Unknowns before the field's weights: focal length, principal point, shape, pupil.
_LEADING = 6
# Shapes and angles of the image's corner from which the base projection is begun.
_SHAPES = (1.0, 0.25, 0.0)
_CORNERS = (12.0, 20.0, 30.0, 42.0, 55.0, 68.0, 80.0)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class HybridFit:
    """A camera, its board, and what is not known of both.

    Args:
        camera: the camera.
        state: parameters, board, poses.
        half: (S, S); halfᵀ half is the covariance of parameters and board.
        sigma: px, of a corner of weight one, tempering included.
        tempering: T, by which the data count less because residuals repeat within views.
        hyperparameters: (H,).
        families: the priors that these set.
        log_evidence: of the last round.
        effective: number of parameters that the data determine.
        board_shapes: modes of the board.
        board_points: (N, 3) meters, the board as it was measured.
        residuals: (V, N, 2) projected minus observed, pixels, weights left out; NaN where a corner did not count.
        weighted_rms: sqrt(mean w² ‖r‖²), pixels.
        iterations: trial steps of the solver.
        converged: whether the hyperparameters came to rest.
    """

    camera: Camera
    state: HybridState
    half: Tensor
    sigma: float
    tempering: float
    hyperparameters: Tensor
    families: PriorFamilies
    log_evidence: float
    effective: float
    board_shapes: BoardModes
    board_points: Tensor
    residuals: Tensor
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

    def among(self, views: Sequence[int], count: int) -> HybridFit:
        """This fit of some views as one of `count` views: NaN for the others."""

        def of_all(values: Tensor) -> Tensor:
            out = values.new_full((count, *values.shape[1:]), torch.nan)
            out[list(views)] = values
            return out

        state = self.state._replace(rotation=of_all(self.state.rotation), translation=of_all(self.state.translation))
        return dataclasses.replace(self, state=state, residuals=of_all(self.residuals))

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
    exact_board: bool = False,
    square: float = SQUARE,
    focal: float | None = None,
    start: HybridFit | None = None,
    progress: Callable[[str], object] = lambda _: None,
) -> HybridFit:
    """Fit one camera.

    Args:
        points: (N, 3) the board's corners as ordered, meters, z = 0.
        pixels: (V, N, 2), NaN where not seen.
        size: (width, height) of the image.
        weights: (V, N) by which residuals are multiplied; 0 leaves a corner out. None: all count alike.
        modes: of the field.
        exact_board: whether the board is as ordered.
        square: standard deviation of the pixels' aspect and skew.
        focal: roughly known, pixels, for the start.
        start: an earlier fit of the same views with other weights, to begin with.
        progress: called after each step.

    Raises:
        InputError: no start explains the corners.
        DegenerateError: the board is seen from one side only, or from too few, so that no projection is found.
    """
    weights = torch.ones_like(pixels[..., 0]) if weights is None else weights
    board = board_modes(points)
    seen = torch.isfinite(pixels).all(-1) & (weights > 0)
    freedom = 2 * int(seen.sum()) - 6 * len(pixels)
    if start is None:
        estimate, spent = _base_alone(points, pixels, size, weights, modes or ZernikeModes(), board, square, focal)
        progress("base projection")
    else:
        form = start.camera.model.hybrid
        assert form is not None
        estimate = _Estimate(
            start.camera.model, start.families, start.state, start.hyperparameters, start.sigma**2, start.tempering
        )
        spent = 0
    model, families, state, h, variance, tempering = estimate
    form = model.hybrid
    assert form is not None
    hyperprior = typical_hyperprior(form.modes)
    never = torch.zeros_like(families.mean, dtype=torch.bool)
    if exact_board:
        never[-len(board.unit) :] = True

    def solve(steps: int, gain: float) -> tuple[HybridProblem, HybridState, int]:
        precision = torch.where(never, torch.inf, variance / families.deviation(h).square())
        problem = HybridProblem(points, board.shapes, pixels, weights, model, families.mean, precision)
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
        h_new, noise, loss = maximize_evidence(
            K / tempering, g / tempering, c / tempering, freedom / tempering, families, h, variance / former, hyperprior
        )
        change = float((h_new - h).abs().max())
        h, variance = h_new, noise * tempering
        progress(f"evidence, round {turn + 1}")
        if not first and change < 0.1 and steps <= 2:
            converged = True
            break
    # Modes that the evidence holds so closely to zero that no pixel feels them are left out, error bars included.
    peaks = torch.tensor(form.modes.peaks, dtype=torch.float64)
    shift = families.deviation(h)[_LEADING : -len(board.unit)] * float(state.params[0]) * peaks
    never[_LEADING : -len(board.unit)] |= shift < _UNFELT
    state.params[5 + len(LEADING) :][shift < _UNFELT] = 0.0
    problem, state, steps = solve(10, 0.01)
    off = problem.without_poses(state)
    K, _, _ = _quadratic(off, problem.shared(state))
    deviation = torch.where(never, 0.0, families.deviation(h))
    inverse = _posterior_root(K, deviation, variance)
    residuals = problem.residuals(state).transpose(-1, -2) / weights[..., None]
    return HybridFit(
        camera=Camera(state.params, size=size, model=model),
        state=state,
        half=inverse * deviation,
        sigma=math.sqrt(variance),
        tempering=tempering,
        hyperparameters=h,
        families=families,
        log_evidence=-loss,
        effective=len(deviation) - float(inverse.square().sum()),
        board_shapes=board,
        board_points=points + torch.einsum("b,bkn->nk", state.board, board.shapes),
        residuals=torch.where(seen[..., None], residuals, torch.nan),
        weighted_rms=math.sqrt(float(problem.residuals(state).square().sum()) / int(seen.sum())),
        iterations=spent + steps,
        converged=converged,
    )


class _Estimate(NamedTuple):
    model: LensModel
    families: PriorFamilies
    state: HybridState
    hyperparameters: Tensor
    variance: float
    tempering: float


def _base_alone(
    points: Tensor,
    pixels: Tensor,
    size: tuple[int, int],
    weights: Tensor,
    modes: FieldModes,
    board: BoardModes,
    square: float,
    known_focal: float | None,
) -> tuple[_Estimate, int]:
    """Fit the base projection alone: its focal length and shape become constants of the lens. Also the trial steps."""
    focal, shape, rotation, translation = _base_start(points, pixels, size, weights, known_focal)
    radius = _REACH * 0.5 * math.hypot(*size)
    distance = float(translation.norm(dim=-1).median())
    h, spent = typical_hyperprior(modes).mean, 0

    def constants(focal: float, shape: float) -> tuple[LensModel, PriorFamilies]:
        form = HybridForm(shape=shape, radius=radius / focal, modes=modes)
        return LensModel(hybrid=form), prior_families(form, focal, board, size, distance, square)

    model, families = constants(focal, shape)
    held = torch.ones(len(families.mean), dtype=torch.bool)
    held[:4] = False
    params = torch.zeros(5 + model.size, dtype=torch.float64)
    params[:4] = torch.tensor([focal, focal, families.mean[1], families.mean[2]])
    state = HybridState(params, torch.zeros_like(board.unit), rotation, translation)
    for _ in range(6):
        precision = torch.where(held, torch.inf, families.deviation(h).square().reciprocal())
        problem = HybridProblem(points, board.shapes, pixels, weights, model, families.mean, precision)
        result = minimize(problem, state, LMOptions(max_iterations=15, tolerance=1e-6, initial_damping=1e-6))
        spent += int(result.iterations)
        state = HybridState(*result.state)
        scale, bend = float(state.params[0]) / focal - 1.0, float(state.params[5])
        focal, shape = float(state.params[0]), shape + min(max(bend, -1.0), 1.0)
        if not (0 < focal < math.inf and abs(shape) <= 10):
            raise DegenerateError(
                "the views do not determine the focal length: they are parallel to the image or too similar; add views "
                "with the board tilted by 30 to 45 degrees in different directions"
            )
        model, families = constants(focal, shape)
        params = state.params.clone()
        params[5] = 0.0
        state = state._replace(params=params)
        if abs(scale) < 1e-3 and abs(bend) < 1e-3 * (1 + abs(shape)):
            break
    freedom = 2 * int(problem.seen.sum()) - 6 * len(pixels)
    variance = max(2.0 * float(result.cost) / freedom, LEAST_NOISE**2)
    return _Estimate(model, families, state, h, variance, 1.0), spent


def _quadratic(off: Tensor, x: Tensor) -> tuple[Tensor, Tensor, float]:
    """K, g, c of chi²(x) = c - 2 gᵀx + xᵀKx for absolute x, from rows off the poses at x."""
    flat = off.transpose(0, 1).flatten(1)
    target = x @ flat[:-1] - flat[-1]
    return flat[:-1] @ flat[:-1].T, flat[:-1] @ target, float(target @ target)


def _posterior_root(K: Tensor, deviation: Tensor, variance: float) -> Tensor:
    """L⁻¹ of I + √D K √D / σ² = L Lᵀ."""
    A = K * deviation[:, None] * deviation / variance
    A.diagonal().add_(1.0)
    return torch.linalg.solve_triangular(torch.linalg.cholesky(A), torch.eye(len(A), dtype=A.dtype), upper=False)


def _overdispersion(off: Tensor, K: Tensor, deviation: Tensor, variance: float) -> float:
    """How much more the scores of views scatter than independent corners explain, over the determined directions."""
    score = (off[:, :-1] @ off[:, -1, :, None])[..., 0]
    score = score - score.mean(0)
    inverse = _posterior_root(K, deviation, variance)
    effective = len(K) - float(inverse.square().sum())
    scattered = float((inverse @ (score * deviation / variance).T).square().sum()) * len(off) / (len(off) - 1)
    return max(1.0, scattered / effective)


def _base_start(
    points: Tensor, pixels: Tensor, size: tuple[int, int], weights: Tensor, known: float | None
) -> tuple[float, float, Tensor, Tensor]:
    """Focal length, shape and poses: the base projection, among several, under which homographies fit best."""
    seen = torch.isfinite(pixels).all(-1) & (weights > 0)
    middle = torch.tensor([(size[0] - 1) / 2, (size[1] - 1) / 2], dtype=torch.float64)
    offset = torch.where(seen[..., None], pixels - middle, 0.0)
    away = offset.norm(dim=-1)
    half = 0.5 * math.hypot(*size)
    pinhole = torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64)
    best: tuple[float, float, float, Tensor, Tensor] | None = None
    for shape in _SHAPES:
        s = torch.tensor(shape, dtype=torch.float64)
        root = math.sqrt(shape)
        angles = [math.radians(corner) for corner in _CORNERS]
        focals = [half / (math.tan(root * angle) / root if shape else angle) for angle in angles]
        for focal in focals if known is None else [known]:
            theta = away / focal * angle_over_radius(s * (away / focal) ** 2)
            usable = seen & (theta < math.radians(80.0))
            ideal = offset * (torch.tan(theta) / away.clamp_min(1e-9))[..., None]
            ideal = torch.where(usable[..., None], ideal, torch.nan)
            if bool((usable.sum(-1) < 6).any()):
                continue
            rotation, translation = poses_from_homographies(homographies(points, ideal), pinhole)
            cam = points @ rotation.transpose(-1, -2) + translation[:, None]
            there = torch.atan2(cam[..., :2].norm(dim=-1), cam[..., 2])
            direction = cam[..., :2] / cam[..., :2].norm(dim=-1, keepdim=True).clamp_min(1e-12)
            turned = theta[..., None] * offset / away.clamp_min(1e-9)[..., None]
            error = torch.where(usable, (there[..., None] * direction - turned).norm(dim=-1) * focal, 0.0)
            value = float(error.square().sum() / usable.sum())
            if math.isfinite(value) and (best is None or value < best[0]):
                best = value, focal, shape, rotation, translation
    if best is None:
        raise InputError("no start explains the corners: are all views of this board and from this camera?")
    return best[1:]
