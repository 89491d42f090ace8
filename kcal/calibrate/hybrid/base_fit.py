"""Fit the base projection of a hybrid lens: where its field is evaluated, and from where its fit begins."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import BoardModes
from kcal.calibrate.hybrid.families import PriorFamilies, prior_families, typical_hyperprior
from kcal.calibrate.hybrid.fleet import LensPrior
from kcal.calibrate.hybrid.unknowns import hybrid_problem, hybrid_unknowns
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.closed_form import homographies, poses_from_homographies
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import LEAST_NOISE
from kcal.errors import DegenerateError, InputError
from kcal.lens.base_map import angle_over_radius, radius_over_angle
from kcal.lens.field_modes import FieldModes
from kcal.lens.hybrid_terms import HybridForm
from kcal.lens.model import LensModel
from kcal.lens.zernike import ZernikeModes
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.result import Result
from kcal.solve.robust import RobustLoss

# R in half diagonals: the disc on which fields live reaches a little beyond the image's corners.
_REACH = 1.08
# Shapes and angles of the image's corner from which the base projection is begun.
_SHAPES = (1.0, 0.25, 0.0)
_CORNERS = (12.0, 20.0, 30.0, 42.0, 55.0, 68.0, 80.0)
# Views by which the start is chosen.
_VIEWS = 60
# Corners that a view needs at least, and how far off the axis they are at most, radians.
_FEWEST, _STEEPEST = 6, math.radians(80.0)
_PINHOLE = torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64)
# How many times smaller the squared misfit of another focal length must be than that of the one that was given.
_DOUBT = 2.0
# A field that is held at zero, as small as there is one.
_NO_FIELD = ZernikeModes(radial=0, decentered=0, astigmatic=1, other=0)
# The logarithms of motions' standard deviations over the noise, of views that stand still.
NO_MOTION = np.zeros(0)


class Estimate(NamedTuple):
    """Where a fit stands."""

    model: LensModel
    families: PriorFamilies
    state: BoardState
    hyperparameters: Tensor
    log_ratio: np.ndarray
    variance: float
    tempering: float


class Base(NamedTuple):
    """A base projection with the poses of the views under it.

    Attributes:
        focal: F, pixels.
        shape: s of the projection.
        aspect: f_y / f_x; None: pixels are square.
        state: the camera's parameters, the board as it was, and poses.
        variance: of residuals along an axis, px².
        steps: trial steps.
    """

    focal: float
    shape: float
    aspect: float | None
    state: BoardState
    variance: float
    steps: int

    @property
    def distance(self) -> float:
        """Typical distance of the board, meters."""
        return float(self.state.translation.norm(dim=-1).median())


def fit_projection(
    points: Tensor,
    pixels: Tensor,
    size: tuple[int, int],
    weights: Tensor,
    square: bool = True,
    known_focal: float | None = None,
    robust: bool = False,
    *,
    exact_focal: bool = False,
) -> Base:
    """Fit focal length, principal point and shape of the base projection, for any lens from narrow to fisheye.

    Pixels that are not square have two focal lengths here already: between square and stretched ones, amplitudes of the
    board have other local maxima of the evidence.

    Args:
        points: (N, 3) of the board, meters.
        pixels: (V, N, 2), NaN where not seen.
        size: (width, height) of the image.
        weights: (V, N) by which residuals are multiplied.
        square: whether pixels are square.
        known_focal: roughly, pixels; None: it is found.
        robust: bound the weight of corners that are far off.
        exact_focal: `known_focal` is not changed.

    Raises:
        InputError: no projection explains the corners.
        DegenerateError: the views do not determine the focal length.

    Example:
        >>> from kcal import Camera
        >>> from kcal.lens import rotation_from_vector
        >>> points = torch.cartesian_prod(torch.arange(6.0), torch.arange(7.0), torch.zeros(1)).double() * 0.05
        >>> truth = Camera.build(focal=(800, 800), center=(322, 238), size=(640, 480), model="pinhole")
        >>> tilts = torch.tensor([[0.5, 0, 0], [-0.5, 0.1, 0], [0, 0.5, 0.2], [0.1, -0.5, 0]], dtype=torch.float64)
        >>> shift = torch.tensor([-0.12, -0.15, 0.6], dtype=torch.float64)
        >>> pixels = truth.project(points @ rotation_from_vector(tilts).transpose(-1, -2) + shift)[0]
        >>> base = fit_projection(points, pixels, (640, 480), torch.ones(4, 42))
        >>> round(base.focal, 1), abs(base.shape - 1.0) < 1e-2  # a perspective image
        (800.0, True)
    """
    # Of many views some tell which projection it is; the poses of all follow from it.
    some = slice(None, None, 1 + (len(pixels) - 1) // _VIEWS)
    base = _fit_some(points, pixels[some], size, weights[some], square, known_focal, robust, exact_focal)
    if len(base.state.rotation) == len(pixels):
        return base
    seen = torch.isfinite(pixels).all(-1) & (weights > 0)
    params = base.state.parameters
    offset = torch.where(seen[..., None], pixels - params[2:4], 0.0)
    if base.aspect is not None:
        offset = offset / torch.tensor([1.0, base.aspect], dtype=torch.float64)
    ideal, usable = _through_base(offset, seen, base.focal, base.shape)
    if bool((usable.sum(-1) < _FEWEST).any()):
        return _fit_some(points, pixels, size, weights, square, known_focal, robust, exact_focal)
    poses = poses_from_homographies(homographies(points, ideal), _PINHOLE)
    state = base.state._replace(rotation=poses[0], translation=poses[1], motion=pixels.new_zeros(len(pixels), 0))
    return base._replace(state=state)


def _fit_some(
    points: Tensor,
    pixels: Tensor,
    size: tuple[int, int],
    weights: Tensor,
    square: bool,
    known_focal: float | None,
    robust: bool,
    exact_focal: bool,
) -> Base:
    focal, shape, rotation, translation = _base_start(points, pixels, size, weights, known_focal, None, exact_focal)
    flat = BoardModes(points.new_zeros(0, 3, len(points)), points.new_zeros(0), torch.zeros(0, dtype=torch.long))
    state = BoardState.still(points.new_zeros(0), flat.unit, rotation, translation)
    base = Base(focal, shape, None if square else 1.0, state, 0.0, 0)
    h = typical_hyperprior(_NO_FIELD).mean
    for _ in range(6):
        model, families = _with_constants(base, size, _NO_FIELD, flat)
        state = base.state
        if not len(state.parameters):
            state = state._replace(parameters=_leading(model, base.focal, families))
        held = _held(families, flat, square, exact_focal)
        problem, result = _solve_base(points, pixels, weights, (model, families), state, h, held, robust, flat)
        state = result.state
        scale, bend = float(state.parameters[0]) / base.focal - 1.0, float(state.parameters[5])
        base = Base(
            float(state.parameters[0]),
            base.shape + min(max(bend, -1.0), 1.0),
            None if square else float(state.parameters[1]) / float(state.parameters[0]),
            state._replace(parameters=torch.cat([state.parameters[:5], torch.zeros_like(state.parameters[5:])])),
            _residual_variance(problem, result),
            base.steps + int(result.iterations),
        )
        if not (0 < base.focal < math.inf and abs(base.shape) <= 10 and 0.1 < (base.aspect or 1.0) < 10):
            raise DegenerateError(
                "the views do not determine the focal length: they are parallel to the image or too similar; add views "
                "with the board tilted by 30 to 45 degrees in different directions"
            )
        if not robust and abs(scale) < 1e-3 and abs(bend) < 1e-3 * (1 + abs(base.shape)):
            break
    return base


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
    """Fit the base projection alone: its focal length and shape become constants of the lens. Also the trial steps."""
    if lens is not None:
        return _fit_known(points, pixels, size, weights, board, square, robust, h, lens)
    base = fit_projection(points, pixels, size, weights, square, known_focal, robust)
    model, families = _with_constants(base, size, modes, board)
    params = torch.zeros(5 + model.size, dtype=torch.float64)
    params[:5] = base.state.parameters[:5]
    state = base.state._replace(parameters=params, board=torch.zeros_like(board.unit))
    return Estimate(model, families, state, h, NO_MOTION, base.variance, 1.0), base.steps


def _fit_known(
    points: Tensor,
    pixels: Tensor,
    size: tuple[int, int],
    weights: Tensor,
    board: BoardModes,
    square: bool,
    robust: bool,
    h: Tensor,
    lens: LensPrior,
) -> tuple[Estimate, int]:
    """Likewise for a camera of a known type, whose constants and typical field are given."""
    _, _, rotation, translation = _base_start(points, pixels, size, weights, None, lens)
    aspect = None if square else 1.0
    distance = float(translation.norm(dim=-1).median())
    families = lens.families(prior_families(lens.form, lens.focal, board, size, distance, aspect))
    model = LensModel(hybrid=lens.form)
    params = _leading(model, lens.focal, families)
    unknowns = hybrid_unknowns(model, square)
    params[list(unknowns.indices)] = unknowns.expand(lens.unknowns.mean)
    state = BoardState.still(params, torch.zeros_like(board.unit), rotation, translation)
    held = _held(families, board, square, False)
    problem, result = _solve_base(points, pixels, weights, (model, families), state, h, held, robust, board)
    estimate = Estimate(model, families, result.state, h, NO_MOTION, _residual_variance(problem, result), 1.0)
    return estimate, int(result.iterations)


def _with_constants(
    base: Base, size: tuple[int, int], modes: FieldModes, board: BoardModes
) -> tuple[LensModel, PriorFamilies]:
    """A lens on a base projection, and its priors."""
    form = HybridForm(shape=base.shape, radius=_REACH * 0.5 * math.hypot(*size) / base.focal, modes=modes)
    families = prior_families(form, base.focal, board, size, base.distance, base.aspect)
    return LensModel(hybrid=form), families


def _leading(model: LensModel, focal: float, families: PriorFamilies) -> Tensor:
    """(5 + P,) parameters of the base projection alone."""
    params = torch.zeros(5 + model.size, dtype=torch.float64)
    params[:4] = torch.tensor([focal, focal, families.mean[1], families.mean[2]])
    return params


def _held(families: PriorFamilies, board: BoardModes, square: bool, focal: bool) -> Tensor:
    """(S,) all unknowns but focal length, principal point and shape: field, pupil and board are held."""
    held = torch.ones(len(families.mean), dtype=torch.bool)
    held[int(focal) : 4] = False
    if not square:
        held[-1 - len(board.unit)] = False
    return held


def _solve_base(
    points: Tensor,
    pixels: Tensor,
    weights: Tensor,
    lens: tuple[LensModel, PriorFamilies],
    state: BoardState,
    h: Tensor,
    held: Tensor,
    robust: bool,
    board: BoardModes,
) -> tuple[BoardProblem, Result[BoardState]]:
    """Solve for what is not held, and for poses; pixels are square if the lens has no focal length of the rows."""
    model, families = lens
    square = len(families.mean) == len(hybrid_unknowns(model)) + len(board.unit)
    precision = torch.where(held, torch.inf, families.deviation(h).square().reciprocal())
    problem = hybrid_problem(points, board.shapes, pixels, weights, model, families.mean, precision, square=square)
    if robust:
        problem = problem.with_weights(cauchy_weights(problem, state, weights))
    return problem, minimize(problem, state, LMOptions(max_iterations=15, tolerance=1e-6, initial_damping=1e-6))


def _residual_variance(problem: BoardProblem, result: Result[BoardState]) -> float:
    freedom = 2 * int(problem.seen.sum()) - 6 * len(problem.seen)
    return max(2.0 * float(result.cost) / freedom, LEAST_NOISE**2)


def cauchy_weights(problem: BoardProblem, state: BoardState, weights: Tensor) -> Tensor:
    """(V, N) weights of a Cauchy loss at a state, its scale three robust standard deviations; 0 without an image."""
    length = (problem.pixel_errors(state) * weights[:, None]).norm(dim=1)
    shown = torch.isfinite(length) & problem.seen
    # Of two normal components, the median length is 1.18 standard deviations.
    scale = max(3.0 * float(length[shown].median()) / 1.18, LEAST_NOISE)
    return torch.where(shown, weights * RobustLoss(kind="cauchy", scale=scale).weight(length.square()).sqrt(), 0.0)


def _base_start(
    points: Tensor,
    pixels: Tensor,
    size: tuple[int, int],
    weights: Tensor,
    known: float | None,
    lens: LensPrior | None,
    exact: bool = False,
) -> tuple[float, float, Tensor, Tensor]:
    """Focal length, shape and poses: the base projection, among several, under which homographies fit best.

    A roughly known focal length is taken unless another one fits clearly better; an exact one is taken.
    """
    seen = torch.isfinite(pixels).all(-1) & (weights > 0)
    middle = torch.tensor([(size[0] - 1) / 2, (size[1] - 1) / 2], dtype=torch.float64)
    offset = torch.where(seen[..., None], pixels - middle, 0.0)
    half = 0.5 * math.hypot(*size)
    best: tuple[float, float, float, Tensor] | None = None
    angles = torch.tensor(_CORNERS, dtype=torch.float64).deg2rad()
    radii = [(s, m) for s in _SHAPES for m in (angles * radius_over_angle(s * angles**2)).tolist()]
    usual = [(s, half / m) for s, m in radii]
    told = [] if known is None else [(s, known) for s in _SHAPES]
    tried = [*told, *([] if exact else usual)] if lens is None else [(lens.form.shape, lens.focal)]
    for shape, focal in tried:
        s = torch.tensor(shape, dtype=torch.float64)
        ideal, usable = _through_base(offset, seen, focal, shape)
        if bool((usable.sum(-1) < _FEWEST).any()):
            continue
        rotation, translation = poses_from_homographies(homographies(points, ideal), _PINHOLE)
        cam = points @ rotation.transpose(-1, -2) + translation[:, None]
        there = torch.atan2(cam[..., :2].norm(dim=-1), cam[..., 2])
        direction = cam[..., :2] / cam[..., :2].norm(dim=-1, keepdim=True).clamp_min(1e-12)
        # In pixels: angles near 80 degrees hardly differ, and such a projection would win for a narrow lens.
        found = (focal * there * radius_over_angle(s * there**2))[..., None] * direction
        error = torch.where(usable, (found - offset).norm(dim=-1), 0.0)
        # By the median view: a few wrong views do not decide.
        value = float((error.square().sum(-1) / usable.sum(-1)).median())
        value *= 1.0 if known is None or focal == known else _DOUBT
        if math.isfinite(value) and (best is None or value < best[0]):
            best = value, focal, shape, ideal
    if best is None:
        raise InputError("no start explains the corners: are all views of this board and from this camera?")
    _, focal, shape, ideal = best
    return focal, shape, *poses_from_homographies(homographies(points, ideal), _PINHOLE)


def _through_base(offset: Tensor, seen: Tensor, focal: float, shape: float) -> tuple[Tensor, Tensor]:
    """Corners (V, N, 2) on the plane z = 1 from their offsets to the principal point, pixels; NaN where not usable.

    Also which are usable: seen, and not so far off the axis that the plane shows them poorly.
    """
    away = offset.norm(dim=-1)
    s = torch.tensor(shape, dtype=torch.float64)
    theta = away / focal * angle_over_radius(s * (away / focal) ** 2)
    usable = seen & (theta < _STEEPEST)
    ideal = offset * (torch.tan(theta) / away.clamp_min(1e-9))[..., None]
    return torch.where(usable[..., None], ideal, torch.nan), usable
