"""Fit the base projection of a hybrid lens: where its field is evaluated, and from where its fit begins."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import KNOWN, STRETCH, BoardModes, board_modes
from kcal.calibrate.hybrid.evidence import Amplitudes
from kcal.calibrate.hybrid.families import BOARD, LensPrior, PriorFamilies, prior_families, typical_hyperprior
from kcal.calibrate.hybrid.fitted_views import Estimate, FittedViews, hybrid_unknowns
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import LEAST_NOISE, homographies, poses_from_homographies
from kcal.errors import DegenerateError, InputError
from kcal.lens.field_modes import FieldModes
from kcal.lens.model import HybridForm, LensModel, angle_over_radius, radius_over_angle
from kcal.lens.zernike import ZernikeModes
from kcal.solve.lm import LMOptions, minimize

# R in half diagonals: the disc on which fields live reaches a little beyond the image's corners.
_REACH = 1.08
# Shapes and angles of the image's corner from which the base projection is begun.
_SHAPES = (1.0, 0.25, 0.0)
_CORNERS = (12.0, 20.0, 30.0, 42.0, 55.0, 68.0, 80.0)
# Views by which the start is chosen: its projection among several, and that fitted.
_SOME, _VIEWS = 15, 60
# Boards of more corners are shown by some of them: so many of each view.
_LARGE, _BY_VIEW = 1000, 100
# Corners that a view needs at least, and how far off the axis they are at most, radians.
_FEWEST, _STEEPEST = 6, math.radians(80.0)
_PINHOLE = torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64)
# How many times smaller the squared misfit of another focal length must be than that of the one that was given.
_DOUBT = 2.0
# Changes of focal length and shape after which these are constants of the lens: what is left is their square.
_NEAR = 0.02
# Columns of the board that are not as far apart as its rows: standard deviation of the difference, the least that is no
# error of the print, and how many times larger the squared misfit must be without it; changes that are tried.
_UNEQUAL, _NO_PRINT, _WITHOUT, _CHANGES = 0.15, 0.02, 1.5, (-0.2, 0.25)
# A field that is held at zero, as small as there is one.
_NO_FIELD = ZernikeModes(radial=0, decentered=0, astigmatic=1, other=0)


class Base(NamedTuple):
    """A base projection with the poses of the views under it.

    Attributes:
        focal: F, pixels.
        shape: s of the projection.
        aspect: f_y / f_x; None: pixels are square.
        state: the camera's parameters, the board's stretch where that was found, and poses.
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
    capture = FittedViews(
        points=points,
        board=_no_modes(points),
        pixels=pixels,
        size=size,
        weights=weights,
        hyperprior=typical_hyperprior(_NO_FIELD),
        square=square,
        exact=True,
    )
    return _base_of(capture, known_focal, exact_focal)


def _no_modes(points: Tensor) -> BoardModes:
    """A board that does not differ from the one that was ordered."""
    return BoardModes(points.new_zeros(0, 3, len(points)), points.new_zeros(0), torch.zeros(0, dtype=torch.long))


def _base_of(
    capture: FittedViews, known_focal: float | None, exact_focal: bool = False, stretch: BoardModes | None = None
) -> Base:
    pixels, weights, points = capture.pixels, capture.weights, capture.points
    # Of many views some tell which projection it is; the poses of all follow from it.
    some = slice(None, None, 1 + (len(pixels) - 1) // _VIEWS)
    few = dataclasses.replace(capture, pixels=pixels[some], weights=weights[some])
    mode = stretch
    if len(points) > _LARGE:
        each = [view.nonzero()[:, 0] for view in few.seen]
        spread = torch.cat([own[:: 1 + (len(own) - 1) // _BY_VIEW] for own in each]).unique()
        few, mode = few.of_corners(spread), stretch and stretch._replace(shapes=stretch.shapes[..., spread])
    start = _base_start(few, known_focal, None, exact_focal)
    base = _settled_base(few, start, exact_focal)
    if stretch and mode and (other := _unequal(few, start, base, known_focal, mode)) is not None:
        base, points = other, points + other.state.board * stretch.shapes[0].T
    if len(base.state.rotation) == len(pixels):
        return base
    offset = torch.where(capture.seen[..., None], pixels - base.state.parameters[2:4], 0.0)
    if base.aspect is not None:
        offset = offset / torch.tensor([1.0, base.aspect], dtype=torch.float64)
    ideal, usable = _through_base(offset, capture.seen, base.focal, base.shape)
    if bool((usable.sum(-1) < _FEWEST).any()):
        return _settled_base(capture, _base_start(capture, known_focal, None, exact_focal), exact_focal)
    poses = poses_from_homographies(homographies(points, ideal), _PINHOLE)
    state = base.state._replace(rotation=poses[0], translation=poses[1], motion=pixels.new_zeros(len(pixels), 0))
    return base._replace(state=state)


def _unequal(
    capture: FittedViews, start: Base, plain: Base, known_focal: float | None, stretch: BoardModes
) -> Base | None:
    """The projection with a board whose columns are not as far apart as its rows, if that explains views far better."""
    unit, begun, least = stretch.unit / _UNEQUAL, plain.state._replace(board=torch.zeros_like(stretch.unit)), start
    for change in _CHANGES:
        points = capture.points + change * unit * stretch.shapes[0].T
        try:
            other = _base_start(dataclasses.replace(capture, points=points), known_focal, None)
        except InputError:
            continue
        if _DOUBT * other.variance < least.variance:
            least, begun = other, other.state._replace(board=change * unit)
    base = plain if least is start else least
    found = _settled_base(dataclasses.replace(capture, board=stretch, exact=False), base._replace(state=begun), False)
    large = bool(found.state.board.abs() > _NO_PRINT * unit)
    return found if large and plain.variance > _WITHOUT * found.variance else None


def _settled_base(capture: FittedViews, base: Base, exact_focal: bool) -> Base:
    h = typical_hyperprior(_NO_FIELD).mean
    for _ in range(6):
        model, families = _with_constants(base, capture.size, _NO_FIELD, capture.board)
        state = base.state
        if not len(state.parameters):
            state = state._replace(parameters=_leading(model, base.focal, families))
        state, variance, steps = _solve_base(capture, model, families, state, h, exact_focal)
        scale, bend = float(state.parameters[0]) / base.focal - 1.0, float(state.parameters[5])
        base = Base(
            float(state.parameters[0]),
            base.shape + min(max(bend, -1.0), 1.0),
            None if capture.square else float(state.parameters[1]) / float(state.parameters[0]),
            state._replace(parameters=torch.cat([state.parameters[:5], torch.zeros_like(state.parameters[5:])])),
            variance,
            base.steps + steps,
        )
        if not (0 < base.focal < math.inf and abs(base.shape) <= 10 and 0.1 < (base.aspect or 1.0) < 10):
            raise DegenerateError(
                "the views do not determine the focal length: they are parallel to the image or too similar; add views "
                "with the board tilted by 30 to 45 degrees in different directions"
            )
        if not capture.robust and abs(scale) < _NEAR and abs(bend) < _NEAR * (1 + abs(base.shape)):
            break
    return base


def may_be_unequal(points: Tensor, pixels: Tensor, size: tuple[int, int]) -> bool:
    """Whether a board whose columns are not as far apart as its rows explains views far better; as `fit_projection`."""
    capture = FittedViews(
        points=points,
        board=board_modes(points),
        pixels=pixels,
        size=size,
        weights=torch.ones_like(pixels[..., 0]),
        hyperprior=typical_hyperprior(_NO_FIELD),
        square=False,
    )
    estimate, _ = fit_base(capture, _NO_FIELD)
    return bool(estimate.state.board.any())


def fit_base(
    capture: FittedViews, modes: FieldModes, known_focal: float | None = None, lens: LensPrior | None = None
) -> tuple[Estimate, int]:
    """Fit the base projection, whose focal length and shape become constants of the lens; also the trial steps."""
    board, h = capture.board, capture.hyperprior.mean
    if lens is not None:
        return _fit_known(capture, lens)
    flat = dataclasses.replace(capture, board=_no_modes(capture.points), readout=None, exact=True)
    first = (board.family == STRETCH).nonzero()[:1, 0]
    # A board that was measured is known, in modes of its own.
    mode = None
    if len(first) and not capture.exact:
        across, own = (x.amax() - x.amin() for x in (capture.points[:, 0], board.shapes[first][0, 0]))
        mode = BoardModes(board.shapes[first], (_UNEQUAL * across / own)[None], torch.tensor([KNOWN]))
    base = _base_of(flat, known_focal, stretch=mode)
    model, families = _with_constants(base, capture.size, modes, board)
    params = torch.zeros(5 + model.size, dtype=torch.float64)
    params[:5] = base.state.parameters[:5]
    amplitudes = torch.zeros_like(board.unit)
    if len(base.state.board):
        amplitudes[first] = base.state.board
        h = h.clone()
        h[BOARD + STRETCH] = (base.state.board.abs() / board.unit[first]).log()
    state = base.state._replace(parameters=params, board=amplitudes)
    return Estimate(model, families, state, Amplitudes(h, base.variance)), base.steps


def _fit_known(capture: FittedViews, lens: LensPrior) -> tuple[Estimate, int]:
    """As `fit_base`, for a camera of a known type, whose constants and typical field are given."""
    start = _base_start(capture, None, lens)
    aspect = None if capture.square else 1.0
    families = lens.families(prior_families(lens.form, lens.focal, capture.board, capture.size, start.distance, aspect))
    model = LensModel(hybrid=lens.form)
    params = _leading(model, lens.focal, families)
    unknowns = hybrid_unknowns(model, capture.square)
    params[list(unknowns.indices)] = unknowns.expand(lens.unknowns.mean)
    state = start.state._replace(parameters=params, board=torch.zeros_like(capture.board.unit))
    still = dataclasses.replace(capture, readout=None, exact=True)
    h = capture.hyperprior.mean
    state, variance, steps = _solve_base(still, model, families, state, h, False)
    return Estimate(model, families, state, Amplitudes(h, variance)), steps


def _with_constants(
    base: Base, size: tuple[int, int], modes: FieldModes, board: BoardModes
) -> tuple[LensModel, PriorFamilies]:
    """A lens on a base projection, and its priors."""
    form = HybridForm(shape=base.shape, radius=_REACH * 0.5 * math.hypot(*size) / base.focal, modes=modes)
    return LensModel(hybrid=form), prior_families(form, base.focal, board, size, base.distance, base.aspect)


def _leading(model: LensModel, focal: float, families: PriorFamilies) -> Tensor:
    """(5 + P,) parameters of the base projection alone."""
    params = torch.zeros(5 + model.size, dtype=torch.float64)
    params[:4] = torch.tensor([focal, focal, families.mean[1], families.mean[2]])
    return params


def _solve_base(
    capture: FittedViews, model: LensModel, families: PriorFamilies, state: BoardState, h: Tensor, exact_focal: bool
) -> tuple[BoardState, float, int]:
    """Solve for poses, focal length, principal point and shape; field, pupil and board are held.

    Returns:
        the state, the variance of residuals along an axis, px², and the trial steps.
    """
    held = torch.ones(len(families.mean), dtype=torch.bool)
    held[int(exact_focal) : 4] = False
    if not capture.square:
        held[-1 - len(capture.board.unit)] = False
    if not capture.exact:
        held[len(held) - len(capture.board.unit) :] = False
    problem = capture.problem(Estimate(model, families, state, Amplitudes(h, 1.0)), held)
    found = minimize(problem, state, LMOptions(max_iterations=15, tolerance=1e-4, initial_damping=1e-6))
    return found.state, max(2.0 * float(found.cost) / capture.freedom, LEAST_NOISE**2), int(found.iterations)


def _base_start(capture: FittedViews, known: float | None, lens: LensPrior | None, exact: bool = False) -> Base:
    """Focal length, shape and poses: the base projection, among several, under which homographies fit best.

    A roughly known focal length is taken unless another one fits clearly better; an exact one is taken.
    """
    points, size, seen = capture.points, capture.size, capture.seen
    middle = torch.tensor([(size[0] - 1) / 2, (size[1] - 1) / 2], dtype=torch.float64)
    offset = torch.where(seen[..., None], capture.pixels - middle, 0.0)
    half = 0.5 * math.hypot(*size)
    angles = torch.tensor(_CORNERS, dtype=torch.float64).deg2rad()
    radii = [(s, m) for s in _SHAPES for m in (angles * radius_over_angle(s * angles**2)).tolist()]
    usual = [(s, half / m) for s, m in radii]
    told = [] if known is None else [(s, known) for s in _SHAPES]
    tried = [*told, *([] if exact else usual)] if lens is None else [(lens.form.shape, lens.focal)]
    # All at once: a view's homography takes few numbers.
    shapes, focals = torch.tensor(tried, dtype=torch.float64).unbind(-1)
    ideals, usables = _through_base(offset, seen, focals[:, None, None], shapes[:, None, None])
    possible = ~(usables.sum(-1) < _FEWEST).any(-1)
    shapes, focals, ideals, usables = (each[possible] for each in (shapes, focals, ideals, usables))
    if not len(shapes):
        raise InputError("no start explains the corners: are all views of this board and from this camera?")
    some = slice(None, None, 1 + (len(offset) - 1) // _SOME)
    whole, offset, usables = ideals, offset[some], usables[:, some]
    rotations, translations = (
        part.unflatten(0, usables.shape[:2])
        for part in poses_from_homographies(homographies(points, ideals[:, some].flatten(0, 1)), _PINHOLE)
    )
    cam = points @ rotations.transpose(-1, -2) + translations[..., None, :]
    away = cam[..., :2].norm(dim=-1)
    there = torch.atan2(away, cam[..., 2])
    # In pixels: angles near 80 degrees hardly differ, and such a projection would win for a narrow lens.
    found = focals[:, None, None] * there * radius_over_angle(shapes[:, None, None] * there**2)
    errors = (found / away.clamp_min(1e-12))[..., None] * cam[..., :2] - offset
    squared = torch.where(usables, errors.square().sum(-1), 0.0).sum(-1) / usables.sum(-1)
    # By the median view: a few wrong views do not decide.
    values = squared.median(-1).values
    if known is not None:
        values = torch.where(focals == known, values, _DOUBT * values)
    best = int(torch.where(values.isfinite(), values, math.inf).argmin())
    if not math.isfinite(float(values[best])):
        raise InputError("no start explains the corners: are all views of this board and from this camera?")
    poses = poses_from_homographies(homographies(points, whole[best]), _PINHOLE)
    empty = points.new_zeros(0)
    state, aspect = BoardState.still(empty, empty, *poses), None if capture.square else 1.0
    return Base(float(focals[best]), float(shapes[best]), aspect, state, float(values[best]), 0)


def _through_base(offset: Tensor, seen: Tensor, focal: Tensor | float, shape: Tensor | float) -> tuple[Tensor, Tensor]:
    """Corners (..., V, N, 2) on the plane z = 1 from offsets (V, N, 2) to the principal point; NaN where not usable.

    Also which are usable: seen, and not so far off the axis that the plane shows them poorly. Focal length, pixels, and
    shape are numbers, or (..., 1, 1).
    """
    away = offset.norm(dim=-1)
    theta = away / focal * angle_over_radius(shape * (away / focal) ** 2)
    usable = seen & (theta < _STEEPEST)
    ideal = offset * (torch.tan(theta) / away.clamp_min(1e-9))[..., None]
    return torch.where(usable[..., None], ideal, torch.nan), usable
