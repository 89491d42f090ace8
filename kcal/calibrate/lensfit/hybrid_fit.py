"""One camera without a model to choose: base projection, learned field, pupil and board, amplitudes by evidence."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

import torch
from torch import Tensor

from kcal.calibrate.bundle.closed_form import homographies, poses_from_homographies
from kcal.calibrate.lensfit.board_modes import BoardModes, board_modes
from kcal.calibrate.lensfit.board_prior import BoardPrior
from kcal.calibrate.lensfit.evidence import (
    Hyperprior,
    PriorFamilies,
    maximize_evidence,
    prior_families,
    typical_hyperprior,
)
from kcal.calibrate.lensfit.fleet import LensPrior
from kcal.calibrate.lensfit.hybrid_problem import HybridProblem, HybridState
from kcal.calibrate.lensfit.measured_board import MeasuredBoard
from kcal.errors import InputError
from kcal.lens.base_map import angle_over_radius
from kcal.lens.camera import Camera
from kcal.lens.hybrid_terms import HybridForm
from kcal.lens.model import LensModel
from kcal.lens.zernike import ZernikeModes
from kcal.solve.lm import LMOptions, minimize

# R in half diagonals: the disc on which fields live reaches a little beyond the image's corners.
_REACH = 1.08
_ROUNDS = 6
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
        families: the priors that were used; of a board with a prior of its own, those after the change of variables.
        sigma: px, of a corner of weight one, tempering included.
        tempering: T, by which the data count less because residuals repeat within views.
        hyperparameters: (H,).
        log_evidence: of the last round.
        effective: number of parameters that the data determine.
        board_shapes: modes of the board.
        board_points: (N, 3) meters, the board as it was measured.
        rms: of the weighted residuals, px.
    """

    camera: Camera
    state: HybridState
    half: Tensor
    families: PriorFamilies
    sigma: float
    tempering: float
    hyperparameters: Tensor
    log_evidence: float
    effective: float
    board_shapes: BoardModes
    board_points: Tensor
    rms: float


def fit_hybrid(
    points: Tensor,
    pixels: Tensor,
    size: tuple[int, int],
    weights: Tensor | None = None,
    modes: ZernikeModes | None = None,
    board: Literal["printed", "exact"] | BoardPrior | MeasuredBoard = "printed",
    hyperprior: Hyperprior | None = None,
    lens: LensPrior | None = None,
) -> HybridFit:
    """Fit one camera.

    Args:
        points: (N, 3) the board's corners as ordered, meters.
        pixels: (V, N, 2), NaN where not seen.
        size: of the image.
        weights: (V, N) by which residuals are multiplied; one if not given.
        modes: of the field.
        board: how the board differs from the one that was ordered: as printers err, not at all, or as was measured.
        hyperprior: of the amplitudes; the typical one if not given.
        lens: what is known of it from cameras of its type; its modes are used.
    """
    weights = torch.ones_like(pixels[..., 0]) if weights is None else weights
    modes = modes or ZernikeModes()
    hyperprior = hyperprior or typical_hyperprior()
    if isinstance(board, MeasuredBoard):
        board = board.prior_for(points)
    ordered, own = points, board_modes(points)
    points, shown = board.applied(points, own) if isinstance(board, BoardPrior) else (points, own)
    focal, shape, rotation, translation = _base_start(ordered, pixels, size, weights)
    radius = _REACH * 0.5 * math.hypot(*size)
    distance = float(translation.norm(dim=-1).median())
    seen = torch.isfinite(pixels).all(-1) & (weights > 0)
    freedom = 2 * int(seen.sum()) - 6 * len(pixels)

    def constants(focal: float, shape: float) -> tuple[LensModel, PriorFamilies]:
        if lens is not None:
            usual = prior_families(lens.form, lens.focal, shown, size, distance)
            return LensModel(hybrid=lens.form), lens.families(usual)
        form = HybridForm(shape=shape, radius=radius / focal, modes=modes)
        return LensModel(hybrid=form), prior_families(form, focal, shown, size, distance)

    h = hyperprior.mean
    model, families = constants(focal, shape)
    held = torch.ones(len(families.mean), dtype=torch.bool)
    held[:4] = False
    params = torch.zeros(5 + model.size, dtype=torch.float64)
    params[:4] = torch.tensor([focal, focal, families.mean[1], families.mean[2]])
    if lens is not None:
        params[[0, 2, 3, *range(5, len(params))]] = lens.mean
        params[1] = params[0]
    state = HybridState(params, torch.zeros_like(shown.unit), rotation, translation)
    # The base alone: its focal length and shape are put into the constants until they stay.
    for _ in range(6):
        deviation = families.deviation(h)
        problem = HybridProblem(
            points,
            shown.shapes,
            pixels,
            weights,
            model,
            families.mean,
            torch.where(held, torch.inf, deviation.square().reciprocal()),
        )
        result = minimize(problem, state, LMOptions(max_iterations=15, tolerance=1e-6, initial_damping=1e-6))
        state = HybridState(*result.state)
        if lens is not None:
            break
        scale, bend = float(state.params[0]) / focal - 1.0, float(state.params[5])
        focal, shape = float(state.params[0]), shape + min(max(bend, -1.0), 1.0)
        model, families = constants(focal, shape)
        params = state.params.clone()
        params[5] = 0.0
        state = state._replace(params=params)
        if abs(scale) < 1e-3 and abs(bend) < 1e-3 * (1 + abs(shape)):
            break
    variance = 2.0 * float(result.cost) / freedom
    never = torch.zeros_like(held)
    if board == "exact":
        never[-len(shown.unit) :] = True
    tempering = 1.0

    def solve(state: HybridState, steps: int, gain: float) -> tuple[HybridProblem, HybridState, int]:
        precision = torch.where(never, torch.inf, variance / families.deviation(h).square())
        problem = HybridProblem(points, shown.shapes, pixels, weights, model, families.mean, precision)
        options = LMOptions(max_iterations=steps, tolerance=gain / freedom, initial_damping=1e-6)
        result = minimize(problem, state, options)
        return problem, HybridState(*result.state), int(result.iterations)

    for turn in range(_ROUNDS):
        problem, state, steps = solve(state, 8 if turn == 0 else 12, 0.1 if turn == 0 else 0.02)
        off = problem.without_poses(state)
        off[:, :-1][:, never] = 0.0
        K, g, c = _quadratic(off, problem.shared(state))
        if turn:
            deviation = torch.where(never, 0.0, families.deviation(h))
            tempering_new = _overdispersion(off, K, deviation, variance)
        else:
            tempering_new = 1.0
        h_new, noise, loss = maximize_evidence(
            K / tempering_new, g / tempering_new, c / tempering_new, freedom / tempering_new, families, h,
            variance / tempering, hyperprior,
        )  # fmt: skip
        change = float((h_new - h).abs().max())
        h, tempering, variance = h_new, tempering_new, noise * tempering_new
        if turn and change < 0.1 and steps <= 2:
            break
    problem, state, _ = solve(state, 10, 0.01)
    off = problem.without_poses(state)
    K, _, _ = _quadratic(off, problem.shared(state))
    deviation = torch.where(never, 0.0, families.deviation(h))
    inverse = _posterior_root(K, deviation, variance)
    half = inverse * deviation
    residuals = problem.residuals(state)
    if isinstance(board, BoardPrior):
        state = state._replace(board=board.mean + state.board @ board.half)
        half = torch.cat([half[:, : -len(board.mean)], half[:, -len(board.mean) :] @ board.half], 1)
    return HybridFit(
        camera=Camera(state.params, size=size, model=model),
        state=state,
        half=half,
        families=families,
        sigma=math.sqrt(variance),
        tempering=tempering,
        hyperparameters=h,
        log_evidence=-loss,
        effective=len(deviation) - float(inverse.square().sum()),
        board_shapes=own,
        board_points=ordered + torch.einsum("b,bkn->nk", state.board, own.shapes),
        rms=math.sqrt(float(residuals.square().sum()) / int(seen.sum())),
    )


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
    points: Tensor, pixels: Tensor, size: tuple[int, int], weights: Tensor
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
        for corner in _CORNERS:
            angle = math.radians(corner)
            root = math.sqrt(shape)
            focal = half / (math.tan(root * angle) / root if shape else angle)
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
