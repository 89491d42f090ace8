"""Fit the base projection of a hybrid lens: where its field is evaluated, and from where its fit begins."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.bundle.closed_form import homographies, poses_from_homographies
from kcal.calibrate.bundle.views import LEAST_NOISE
from kcal.calibrate.lensfit.board_modes import BoardModes
from kcal.calibrate.lensfit.families import PriorFamilies, prior_families
from kcal.calibrate.lensfit.fleet import LensPrior
from kcal.calibrate.lensfit.hybrid_problem import HybridProblem, HybridState, hybrid_unknowns
from kcal.errors import DegenerateError, InputError
from kcal.lens.base_map import angle_over_radius, radius_over_angle
from kcal.lens.field_modes import FieldModes
from kcal.lens.hybrid_terms import HybridForm
from kcal.lens.model import LensModel
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.robust import RobustLoss

# R in half diagonals: the disc on which fields live reaches a little beyond the image's corners.
_REACH = 1.08
# Shapes and angles of the image's corner from which the base projection is begun.
_SHAPES = (1.0, 0.25, 0.0)
_CORNERS = (12.0, 20.0, 30.0, 42.0, 55.0, 68.0, 80.0)


# The logarithms of motions' standard deviations over the noise, of views that stand still.
NO_MOTION = np.zeros(0)


class Estimate(NamedTuple):
    """Where a fit stands."""

    model: LensModel
    families: PriorFamilies
    state: HybridState
    hyperparameters: Tensor
    log_ratio: np.ndarray
    variance: float
    tempering: float


def fit_base(
    points: Tensor,
    pixels: Tensor,
    size: tuple[int, int],
    weights: Tensor,
    modes: FieldModes,
    board: BoardModes,
    square: bool,
    known_focal: float | None,
    robust: bool,
    h: Tensor,
    lens: LensPrior | None,
) -> tuple[Estimate, int]:
    """Fit the base projection alone: its focal length and shape become constants of the lens. Also the trial steps.

    Pixels that are not square have two focal lengths here already: between square and stretched ones, amplitudes of the
    board have other local maxima of the evidence.
    """
    focal, shape, rotation, translation = _base_start(points, pixels, size, weights, known_focal, lens)
    aspect = None if square else 1.0
    radius = _REACH * 0.5 * math.hypot(*size)
    distance = float(translation.norm(dim=-1).median())
    spent = 0

    def constants(focal: float, shape: float, aspect: float | None) -> tuple[LensModel, PriorFamilies]:
        if lens is not None:
            usual = prior_families(lens.form, lens.focal, board, size, distance, aspect)
            return LensModel(hybrid=lens.form), lens.families(usual)
        form = HybridForm(shape=shape, radius=radius / focal, modes=modes)
        return LensModel(hybrid=form), prior_families(form, focal, board, size, distance, aspect)

    model, families = constants(focal, shape, aspect)
    held = torch.ones(len(families.mean), dtype=torch.bool)
    held[:4] = False
    if not square:
        held[-1 - len(board.unit)] = False
    params = torch.zeros(5 + model.size, dtype=torch.float64)
    params[:4] = torch.tensor([focal, focal, families.mean[1], families.mean[2]])
    if lens is not None:
        unknowns = hybrid_unknowns(model, square)
        params[list(unknowns.indices)] = unknowns.expand(lens.mean)
    still = rotation.new_zeros(len(rotation), 0)
    state = HybridState(params, torch.zeros_like(board.unit), rotation, translation, still)
    for _ in range(6):
        precision = torch.where(held, torch.inf, families.deviation(h).square().reciprocal())
        problem = HybridProblem(points, board.shapes, pixels, weights, model, families.mean, precision, square=square)
        if robust:
            problem = problem.with_weights(cauchy_weights(problem, state, weights))
        result = minimize(problem, state, LMOptions(max_iterations=15, tolerance=1e-6, initial_damping=1e-6))
        spent += int(result.iterations)
        state = HybridState(*result.state)
        if lens is not None:
            break
        scale, bend = float(state.params[0]) / focal - 1.0, float(state.params[5])
        focal, shape = float(state.params[0]), shape + min(max(bend, -1.0), 1.0)
        aspect = None if square else float(state.params[1]) / focal
        if not (0 < focal < math.inf and abs(shape) <= 10 and (aspect is None or 0.1 < aspect < 10)):
            raise DegenerateError(
                "the views do not determine the focal length: they are parallel to the image or too similar; add views "
                "with the board tilted by 30 to 45 degrees in different directions"
            )
        model, families = constants(focal, shape, aspect)
        params = state.params.clone()
        params[5] = 0.0
        state = state._replace(params=params)
        if not robust and abs(scale) < 1e-3 and abs(bend) < 1e-3 * (1 + abs(shape)):
            break
    freedom = 2 * int(problem.seen.sum()) - 6 * len(pixels)
    variance = max(2.0 * float(result.cost) / freedom, LEAST_NOISE**2)
    return Estimate(model, families, state, h, NO_MOTION, variance, 1.0), spent


def cauchy_weights(problem: HybridProblem, state: HybridState, weights: Tensor) -> Tensor:
    """(V, N) weights of a Cauchy loss at a state, its scale three robust standard deviations; 0 without an image."""
    length = (problem.errors(state) * weights[:, None]).norm(dim=1)
    shown = torch.isfinite(length) & problem.seen
    # Of two normal components, the median length is 1.18 standard deviations.
    scale = max(3.0 * float(length[shown].median()) / 1.18, LEAST_NOISE)
    return torch.where(shown, weights * RobustLoss(kind="cauchy", scale=scale).weight(length.square()).sqrt(), 0.0)


def _base_start(
    points: Tensor, pixels: Tensor, size: tuple[int, int], weights: Tensor, known: float | None, lens: LensPrior | None
) -> tuple[float, float, Tensor, Tensor]:
    """Focal length, shape and poses: the base projection, among several, under which homographies fit best."""
    seen = torch.isfinite(pixels).all(-1) & (weights > 0)
    middle = torch.tensor([(size[0] - 1) / 2, (size[1] - 1) / 2], dtype=torch.float64)
    offset = torch.where(seen[..., None], pixels - middle, 0.0)
    away = offset.norm(dim=-1)
    half = 0.5 * math.hypot(*size)
    pinhole = torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64)
    best: tuple[float, float, float, Tensor, Tensor] | None = None
    angles = torch.tensor(_CORNERS, dtype=torch.float64).deg2rad()
    radii = [(s, m) for s in _SHAPES for m in (angles * radius_over_angle(s * angles**2)).tolist()]
    usual = dict.fromkeys((s, known or half / m) for s, m in radii)
    for shape, focal in usual if lens is None else [(lens.form.shape, lens.focal)]:
        s = torch.tensor(shape, dtype=torch.float64)
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
        # In pixels: angles near 80 degrees hardly differ, and such a projection would win for a narrow lens.
        found = (focal * there * radius_over_angle(s * there**2))[..., None] * direction
        error = torch.where(usable, (found - offset).norm(dim=-1), 0.0)
        # By the median view: a few wrong views do not decide.
        value = float((error.square().sum(-1) / usable.sum(-1)).median())
        if math.isfinite(value) and (best is None or value < best[0]):
            best = value, focal, shape, rotation, translation
    if best is None:
        raise InputError("no start explains the corners: are all views of this board and from this camera?")
    return best[1:]
