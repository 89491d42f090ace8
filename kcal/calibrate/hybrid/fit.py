"""One camera without a model to choose: base projection, learned field, pupil and board, amplitudes by evidence."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.hybrid.base_fit import fit_base
from kcal.calibrate.hybrid.board_modes import STRETCH, BoardModes, board_modes
from kcal.calibrate.hybrid.evidence import WORTH, Amplitudes, posterior_root
from kcal.calibrate.hybrid.families import BEFORE_LENS, BOARD, PUPIL, LensPrior, PriorFamilies, typical_hyperprior
from kcal.calibrate.hybrid.fitted_views import (
    LAST,
    Estimate,
    FittedViews,
    Rounds,
    columns_may_be_read,
    expected_estimate,
    hybrid_unknowns,
    motion_is_worth,
    moved_by_amplitudes,
    run_rounds,
)
from kcal.calibrate.hybrid.measured_board import BoardPrior, MeasuredBoard, off_by
from kcal.calibrate.hybrid.network_fit import FieldTraining, train_network
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.state import BENDS, FEW, BoardState, MotionSigma, Readout, motion_sigma, stillness, widening
from kcal.calibrate.problem.views import among, information_of
from kcal.errors import DegenerateError, InputError
from kcal.gaussian import triangular
from kcal.lens.camera import Camera
from kcal.lens.field_modes import FieldModes
from kcal.lens.information import CameraInformation
from kcal.lens.model import LEADING, PORT, LensModel, angle_over_radius
from kcal.lens.projection import INTRINSICS, pupil_depth
from kcal.lens.uncertainty import pixel_covariance
from kcal.lens.zernike import ZernikeModes
from kcal.solve.schur import products_of
from kcal.texts import brief

# Decide whether pixels are square, from a fit with two focal lengths and what a board's stretch explains of them.

# Stretch that a print may have whatever this board's amplitude is, in units of its extent to each side: one tenth of a
# percent, or two of its length. Boards that are upright in all views do not tell it from the aspect of pixels.
_PRINTED = 1e-3
# Standard deviations beyond which pixels are not square: seven nats.
_CLEAR = 3.75
# Share by which two focal lengths may differ for their lens to be a start for one with square pixels.
_NEARLY = 0.03


def aspect_score(rounds: Rounds) -> float:
    """Standard deviations by which the aspect ratio that a fit with two focal lengths found is off one."""
    score = _standing(rounds)
    if pixels_are_square(score):
        return score
    # Amplitudes as they are to be expected: those of largest evidence may state the ratio too surely.
    return _standing(rounds._replace(estimate=expected_estimate(rounds)))


def _standing(rounds: Rounds) -> float:
    """As `aspect_score`, at the amplitudes of the rounds, with a wide prior of the board's stretch."""
    estimate, data = rounds.estimate, rounds.data
    families, h = estimate.families, estimate.amplitudes.h.clone()
    h[BOARD + STRETCH] = h[BOARD + STRETCH].clamp_min(math.log(_PRINTED))
    deviation = torch.where(rounds.capture.held(estimate), 0.0, families.deviation(h))
    still = data.integrated(estimate.amplitudes.log_ratio).data
    half = posterior_root(still.K, deviation, estimate.variance) * deviation
    x = half.T @ (half @ (still.g + still.K @ still.at)) / estimate.variance + families.mean
    columns, rows = 0, len(x) - len(rounds.capture.board.unit) - 1
    aspect = float(x[rows] / x[columns])
    slope = torch.zeros_like(x)
    slope[rows], slope[columns] = 1.0 / x[columns], -aspect / x[columns]
    return (aspect - 1.0) / float((half @ slope).norm())


def pixels_are_square(score: float) -> bool:
    """Whether an aspect ratio so many standard deviations from one is explained by noise."""
    return not abs(score) > _CLEAR


def with_square_pixels(estimate: Estimate, board: BoardModes) -> Estimate | None:
    """The estimate with one focal length in place of two; None where the two differ by more than a few percent."""
    params = estimate.state.parameters.clone()
    if not abs(float(params[1] / params[0]) - 1.0) < _NEARLY:
        return None
    params[:2] = params[:2].mean()
    rows = len(estimate.families.mean) - len(board.unit) - 1
    families = PriorFamilies(*(torch.cat([part[:rows], part[rows + 1 :]]) for part in estimate.families))
    return estimate._replace(families=families, state=estimate.state._replace(parameters=params))


# Decide whether the camera looks through a flat port into water: rays then start on the port's normal.
#
# The entrance pupil of a lens comes forward with the angle, or a flat port of it does in air. Behind a flat port under
# water it recedes, by gap μ (cos θ / √(1 - μ² sin² θ) - 1).

# Meters per square radian by which no lens's entrance pupil recedes: traced ones come forward by as much.
_RECEDES = 3e-3


def pupil_recedes(rounds: Rounds) -> bool:
    """Whether rays towards the image's corners start farther back than central ones, more than glass and chance do."""
    estimate = rounds.estimate
    form, params = estimate.model.hybrid, estimate.state.parameters
    assert form is not None
    radius = 0.5 * math.hypot(*rounds.capture.size) / params[0]
    square = (radius * angle_over_radius(form.shape * radius**2)) ** 2
    depth = pupil_depth(square, params[len(INTRINSICS) :])
    if not depth < -_RECEDES * square:
        return False
    deviation = torch.where(rounds.capture.held(estimate), 0.0, estimate.deviation)
    still = rounds.data.integrated(estimate.amplitudes.log_ratio).data
    half = posterior_root(still.K, deviation, estimate.variance) * deviation
    return bool(depth < -_CLEAR * (half[:, PUPIL] @ torch.stack([square, square**2])).norm())


def behind_port(estimate: Estimate) -> Estimate:
    """The same with the terms of a port, which are zero as yet."""
    form, state, at = estimate.model.hybrid, estimate.state, len(INTRINSICS) + len(LEADING)
    assert form is not None
    parameters = torch.cat([state.parameters[:at], state.parameters.new_zeros(len(PORT)), state.parameters[at:]])
    return estimate._replace(
        model=LensModel(hybrid=dataclasses.replace(form, port=True)),
        families=estimate.families.with_port(),
        state=state._replace(parameters=parameters),
    )


# Find where a fit of one camera settles: base projection, then rounds of solver and evidence, and what these decide.
#
# Decided are whether pixels are square, whether views moved while they were read, and whether rows or columns were
# read.


# Degrees of one direction within which all boards are alike: halves of 49 views within 5.1 gave 999 ± 31 and
# 589 ± 14 px; those of 25 views within 7.2 agree within their error bars.
_ALIKE = 6.0
# The same in the first rounds, which are not converged: later ones of such views drift on.
_SURELY_ALIKE = 5.7


class AlikeError(DegenerateError):
    """All boards are tilted alike, as those of any part of the views then are."""


def check_tilts(rotation: Tensor, within: float = _ALIKE) -> None:
    """Raise `AlikeError` where all views (V, 3, 3), cam_from_board, show the board tilted alike within these degrees.

    Whatever shape of the print or of the lens that tilts all of them alike is then taken for the focal length.
    """
    normals = torch.nn.functional.normalize(rotation[..., 2] * rotation[..., 2, 2:].sign(), dim=-1)
    middle = torch.nn.functional.normalize(normals.sum(0), dim=0)
    apart = float(torch.rad2deg(torch.acos((normals @ middle).clamp(max=1.0))).max())
    if apart < within:
        raise AlikeError(
            f"the board is tilted alike in all {len(rotation)} views (within {apart:.1f}° of one direction): they do "
            "not determine the focal length, which other views of the same kind give otherwise; add views with the "
            "board tilted by 30 to 45 degrees to the left, right, top and bottom"
        )


class FitStart(NamedTuple):
    """A start for another fit of the same views, for example with other weights.

    Attributes:
        estimate: camera, board, poses, motions and amplitudes.
        readout: how views move while they are read; None: they stand still.
        square: whether pixels are square.
        residuals: (V, N, 2) projected minus observed, pixels, weights left out; NaN where a corner did not count.
        iterations: trial steps of the solver.
        displaced: (N, 2) meters by which corners are off their places beside the board's modes; None: not yet.
        settled: amplitudes stay as they are, which are those of error bars.
    """

    estimate: Estimate
    readout: Readout | None
    square: bool
    residuals: Tensor
    iterations: int
    displaced: Tensor | None = None
    settled: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class FitOptions:
    """What is known of a camera and its board before a fit, and what the views are asked.

    Args:
        modes: of the field; None: those of the start or of the lens, or else of the default lens.
        board: how it differs from the one that was ordered: as printers err, not at all, or as was measured.
        square: whether pixels are square; None: the views tell.
        motion: views may move while they are read; False: they stand still.
        bending: the board may bend by view, where the evidence says so; False: it is stiff.
        corners: each corner of the board may be off its place by itself, where the evidence says so.
        focal: roughly known, pixels, for the start.
        robust: bound the weight of corners that are far off, so that a few wrong ones change nothing. Error bars of
            such a fit mean nothing; it tells which corners to leave out.
        lens: what is known of it from cameras of its type; its modes are used.
        training: of the network that the field is; None: it is not trained.
        likely: error bars for amplitudes of largest evidence: of a fit from which another begins.
    """

    __repr__ = brief

    modes: FieldModes | None = None
    board: Literal["printed", "exact"] | BoardPrior | MeasuredBoard = "printed"
    square: bool | None = None
    motion: bool = True
    bending: bool = True
    corners: bool = True
    focal: float | None = None
    robust: bool = False
    lens: LensPrior | None = None
    training: FieldTraining | None = None
    likely: bool = False

    def known_board(self, points: Tensor) -> BoardPrior | None:
        """What is known of a board (N, 3) that differs from the ordered one by more than printers err."""
        if isinstance(self.board, MeasuredBoard):
            return self.board.prior_for(points)
        return self.board if isinstance(self.board, BoardPrior) else None


def settle(
    points: Tensor,
    pixels: Tensor,
    size: tuple[int, int],
    weights: Tensor,
    options: FitOptions,
    *,
    start: FitStart | None = None,
    progress: Callable[[str], object] = lambda _: None,
    weigh: Callable[[Tensor], Tensor] | None = None,
) -> Rounds:
    """Settle amplitudes, camera, board, poses and motions, with arguments as of `fit_hybrid`."""
    lens, square, modes, known = options.lens, options.square, options.modes, options.known_board(points)
    if start is not None:
        form = start.estimate.model.hybrid
        assert form is not None
        modes = form.modes
    elif lens is not None:
        modes = lens.form.modes
    modes = modes or ZernikeModes()
    hyperprior, exact = typical_hyperprior(modes)._replace(by_hand=len(pixels) < FEW), options.board == "exact"
    ordered, shown = points, board_modes(points)
    moves = Readout(center=points.mean(0), distance=1.0, size=size)
    if known is not None:
        points, shown = known.applied(points, shown)
    capture = FittedViews(
        points=points,
        board=shown,
        pixels=pixels,
        size=size,
        weights=weights,
        hyperprior=hyperprior,
        readout=start.readout if start else moves if options.motion else None,
        square=start.square if start is not None else lens.square if lens is not None else square is True,
        robust=options.robust,
        exact=exact,
        heights=board_modes(ordered).heights if options.bending and start is None and not exact else None,
        corners=options.corners and not exact and not options.robust,
    )

    rough = weigh is not None

    def run(capture: FittedViews, estimate: Estimate, spent: int, rough: bool = rough) -> Rounds:
        return run_rounds(capture, estimate, spent=spent, rough=rough, progress=progress)

    def begin(capture: FittedViews, rough: bool = rough) -> Rounds:
        estimate, steps = fit_base(capture, modes, options.focal, lens)
        progress("base projection")
        if capture.readout is not None:
            distance = float(estimate.state.translation.norm(dim=-1).median())
            readout = dataclasses.replace(capture.readout, distance=distance)
            capture = dataclasses.replace(capture, readout=readout)
        check = None if weigh is None else tilted
        return run_rounds(capture, estimate, cold=True, spent=steps, rough=rough, progress=progress, reweigh=check)

    def tilted(capture: FittedViews, estimate: Estimate) -> FittedViews:
        check_tilts(estimate.state.rotation, _SURELY_ALIKE)
        return capture

    if start is not None:
        estimate = start.estimate
        state, h = estimate.state, estimate.amplitudes.h
        if known is not None:
            state, h = state._replace(board=known.in_units(state.board)), h.clone()
            # Nothing depends on them any more, so that they are no reason for another round.
            h[BOARD:] = hyperprior.mean[BOARD:]
        families = estimate.families.with_board(shown, len(state.board), len(h))
        estimate = estimate._replace(families=families, state=state, amplitudes=estimate.amplitudes._replace(h=h))
        if start.displaced is not None and known is None and capture.corners:
            capture = dataclasses.replace(capture, board=shown.with_corners())
            estimate = estimate.with_board(capture.board)
            estimate.state.board[-start.displaced.numel() :] = start.displaced.T.flatten()
        if start.settled:
            data = capture.data(capture.problem(estimate), estimate)
            return Rounds(capture, capture.readout, estimate, data, math.nan, start.iterations, True)
        return run(capture, estimate, start.iterations)
    undecided = square is None and lens is None
    # Whether pixels are square is known well enough before amplitudes have converged.
    rounds = begin(capture, rough or undecided)
    if rough:
        # Rounds of such views do not converge, and what they would decide does not matter.
        check_tilts(rounds.estimate.state.rotation)
    if undecided:
        score = aspect_score(rounds)
        one = dataclasses.replace(rounds.capture, square=pixels_are_square(score))
        near = with_square_pixels(rounds.estimate, shown) if one.square else rounds.estimate
        readout, most = rounds.readout, rounds.gained + 0.5 * score**2
        if near is None:
            rounds = begin(dataclasses.replace(one, readout=readout))
        elif one.square or not rough:
            rounds = run(one, near, rounds.steps)
            if one.square and capture.hyperprior.by_hand:
                # Two focal lengths can end far off where views are few, and square pixels that begin there stay there.
                rounds = min(rounds, begin(one), key=lambda each: each.untempered_loss)
            # Motion along columns and the aspect of pixels look alike: with square pixels it may explain what the
            # aspect did, and that is no more than the nats that the aspect was worth.
            hidden = one.square and one.readout is None and not most < WORTH
            if hidden and readout is not None and motion_is_worth(rounds, readout):
                rounds = run(dataclasses.replace(one, readout=readout), near, rounds.steps)
    if capture.readout is not None and columns_may_be_read(rounds):
        by_columns = dataclasses.replace(capture.readout, columns=True)
        other = begin(dataclasses.replace(capture, square=rounds.capture.square, readout=by_columns))
        if other.untempered_loss < rounds.untempered_loss:
            rounds = other
    if lens is None and pupil_recedes(rounds):
        rounds = run(rounds.capture, behind_port(rounds.estimate), rounds.steps)
    if weigh is None:
        return rounds
    capture, estimate = rounds.capture, rounds.estimate
    errors = capture.problem(estimate).pixel_errors(estimate.state)
    check_shown(errors)
    # How the board bends was asked under the first weights.
    capture = dataclasses.replace(capture, weights=weigh(capture.by_corner(errors)), heights=None)
    return run(capture, estimate, rounds.steps, rough=False)


def check_shown(errors: Tensor) -> None:
    """Raise `InputError` where a corner has no image under the lens that was found: errors that are not finite."""
    if not bool(torch.isfinite(errors).all()):
        raise InputError(
            "the lens cannot show all corners where they are: are all views of this board and this camera? Rejection "
            "of outliers leaves wrong views out"
        )


# Pixels that a mode can move any point by, below which it is left out.
_UNFELT = 1e-6
# Times that corners are put when they are shown, of views that move: each time the rest falls to a hundredth.
_READ_AGAIN = 3


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class HybridFit:
    """A camera, its board, and the uncertainty of both.

    Args:
        model: of the lens.
        size: (width, height) of the image.
        state: parameters, board, poses, motions.
        half: (S, S); halfᵀ half is the covariance of parameters and board.
        information: the same before anything was inverted, with data and priors apart.
        sigma: px, of a corner of weight one, tempering included.
        wider: by which variances are larger than the posterior's, where views are few or few moved; else 1.
        tempering: dispersion factor that divides the weight of all data: residuals within a view are correlated.
        hyperparameters: (H,) of largest evidence.
        expected: (H,) the same with the mean squares of amplitudes, which set the priors.
        families: the priors that these set; of a board with a prior of its own, those after the change of variables.
        log_evidence: of the last round, of data that count less by the tempering where views stand still.
        effective: number of parameters that the data determine.
        square: whether pixels are square.
        readout: how views move while they are read, and how the board bends in them; None: neither.
        log_ratio: logarithms of standard deviations over the noise: of motions as in `MotionSigma`, and of bending.
        relative: (V,) how much the board bends in each view, relative to the others; None: it is stiff.
        displaced: (N, 2) meters by which corners are off their places beside these modes; None: no evidence of it.
        board_shapes: modes of the board.
        board_points: (N, 3) meters, the board as it was measured.
        residuals: (V, N, 2) projected minus observed, pixels, weights left out; NaN where a corner did not count.
        weights: (V, N) by which the residuals were multiplied.
        weighted_rms: sqrt(mean w² ‖r‖²), pixels.
        iterations: trial steps of the solver.
        converged: whether the hyperparameters converged.

    Example:
        >>> from kcal.lens import rotation_from_vector
        >>> points = torch.cartesian_prod(torch.arange(6.0), torch.arange(7.0), torch.zeros(1)).double() * 0.05
        >>> truth = Camera.build(focal=(800, 800), center=(322, 238), size=(640, 480), model="pinhole")
        >>> tilts = torch.tensor([[0.5, 0, 0], [-0.5, 0.1, 0], [0, 0.5, 0.2], [0.1, -0.5, 0]], dtype=torch.float64)
        >>> shift = torch.tensor([-0.12, -0.15, 0.6], dtype=torch.float64)
        >>> pixels = truth.project(points @ rotation_from_vector(tilts).transpose(-1, -2) + shift)[0]
        >>> fit = fit_hybrid(points, pixels, (640, 480))
        >>> fit.converged, fit.effective < 20, fit.covariance.shape == 2 * fit.camera.params.shape
        (True, True, True)
    """

    __repr__ = brief

    model: LensModel
    size: tuple[int, int]
    state: BoardState
    half: Tensor
    information: CameraInformation
    sigma: float
    wider: float
    tempering: float
    hyperparameters: Tensor
    expected: Tensor
    families: PriorFamilies
    log_evidence: float
    effective: float
    square: bool
    readout: Readout | None
    log_ratio: np.ndarray
    relative: Tensor | None
    displaced: Tensor | None
    board_shapes: BoardModes
    board_points: Tensor
    residuals: Tensor
    weights: Tensor
    weighted_rms: float
    iterations: int
    converged: bool

    @functools.cached_property
    def camera(self) -> Camera:
        """The camera; made when it is asked for, because it measures its lens."""
        return Camera(self.state.parameters, size=self.size, model=self.model)

    @property
    def rms(self) -> float:
        """sqrt(mean ‖r‖²) over the corners, pixels, all counting alike."""
        return float(self.residuals.square().sum(-1).nanmean().sqrt())

    @property
    def stillness(self) -> Tensor:
        """(M,) the squared noise over the variance of each number of any view; () where views stand still."""
        return stillness(self.log_ratio)

    @property
    def own_stillness(self) -> Tensor:
        """The same of the views of this fit, (V, M) where the board bends more in some than in others."""
        return stillness(self.log_ratio, self.relative)

    @property
    def motion_sigma(self) -> MotionSigma | None:
        """Standard deviations of motions; None where views stand still."""
        moves = self.readout is not None and self.readout.moves
        return motion_sigma(self.log_ratio, self.sigma**2 / self.tempering) if moves else None

    @property
    def bends(self) -> Tensor | None:
        """(V, N) meters by which the board bends in each view beside its shape in all of them; None: it is stiff."""
        if self.readout is None or self.readout.bends is None:
            return None
        return self.state.motion[:, -BENDS:] @ self.readout.bends

    def problem(self, points: Tensor, pixels: Tensor, weights: Tensor, mean: Tensor, precision: Tensor) -> BoardProblem:
        """The problem of this lens, board and motion, for given data and priors; see `FittedViews.problem_under`."""
        views = FittedViews(
            points=off_by(points, self.displaced), board=self.board_shapes, pixels=pixels, size=self.size,
            weights=weights, hyperprior=typical_hyperprior(), readout=self.readout, square=self.square,
        )  # fmt: skip
        return views.problem_under(self.model, mean, precision, self.own_stillness)

    def residuals_of(self, pixels: Tensor) -> Tensor:
        """(V, N, 2) as `residuals`, of any corners of the same views; infinite where the lens has no image of one."""
        if self.readout is None:
            return self._shown(pixels) - pixels
        at = pixels
        for _ in range(_READ_AGAIN):
            shown = self._shown(at)
            at = torch.where(shown.isfinite(), shown, at)
        return self._shown(at) - pixels

    def _shown(self, read: Tensor) -> Tensor:
        """(V, N, 2) pixels of all corners that are read when pixels (V, N, 2) are; infinite without an image."""
        state, points = self.state, self.board_points.T.expand(len(read), 3, -1)
        shift: Tensor | float = 0.0
        if self.readout is not None:
            points, shift, _ = self.readout.moved(state.motion, self.readout.time(read), self.board_points.T)
        placed = state.rotation @ points + state.translation[..., None] + shift
        found, valid = self.camera.project(placed.transpose(-1, -2))
        return torch.where(valid[..., None], found, torch.inf)

    def only(self, views: Sequence[int]) -> HybridFit:
        """This fit with some of its views, where the others had no weight in it."""
        return self._with_views(lambda values: values[list(views)])

    def among(self, views: Sequence[int], count: int) -> HybridFit:
        """This fit with entries for `count` views: NaN for those that it did not use."""
        return self._with_views(lambda values: among(values, views, count))

    def _with_views(self, change: Callable[[Tensor], Tensor]) -> HybridFit:
        own, relative = self.state, None if self.relative is None else change(self.relative)
        rotation, translation, motion = map(change, (own.rotation, own.translation, own.motion))
        state = own._replace(rotation=rotation, translation=translation, motion=motion)
        residuals, weights = change(self.residuals), change(self.weights)
        return dataclasses.replace(self, state=state, relative=relative, residuals=residuals, weights=weights)

    @property
    def as_start(self) -> FitStart:
        """A start for another fit."""
        amplitudes = Amplitudes(self.hyperparameters, self.sigma**2 / self.tempering, self.log_ratio)
        estimate = Estimate(self.model, self.families, self.state, amplitudes, self.tempering, self.relative)
        return FitStart(estimate, self.readout, self.square, self.residuals, self.iterations, self.displaced)

    @property
    def settled(self) -> FitStart:
        """A start for a fit of fewer of its views with the same amplitudes."""
        start = self.as_start
        amplitudes = start.estimate.amplitudes._replace(h=self.expected)
        return start._replace(estimate=start.estimate._replace(amplitudes=amplitudes), settled=True)

    @property
    def covariance(self) -> Tensor:
        """(5 + P, 5 + P) of the camera's parameters in the order of `Camera.names`: fx and fy alike, skew held."""
        unknowns = hybrid_unknowns(self.model, self.square)
        return unknowns.by_parameter(self.half.T @ self.half, len(self.state.parameters))


def _by_amplitudes(half: Tensor, moved: Tensor, camera: Camera, square: bool) -> float:
    """How many times larger variances in the image are if the best lens moves by rows (H, S), too."""
    unknowns, places = hybrid_unknowns(camera.model, square), camera.grid(9, 7).reshape(-1, 2)
    by_each = (unknowns.by_parameter(rows.T @ rows, len(camera.params)) for rows in (half, moved))
    own, more = (pixel_covariance(camera, places, one).diagonal(dim1=1, dim2=2).nansum() for one in by_each)
    return 1.0 + float(more / own)


def fit_hybrid(
    points: Tensor,
    pixels: Tensor,
    size: tuple[int, int],
    weights: Tensor | None = None,
    options: FitOptions | None = None,
    *,
    start: HybridFit | FitStart | None = None,
    progress: Callable[[str], object] = lambda _: None,
    weigh: Callable[[Tensor], Tensor] | None = None,
) -> HybridFit:
    """Fit one camera.

    Args:
        points: (N, 3) the board's corners as ordered, meters, z = 0.
        pixels: (V, N, 2), NaN where not seen.
        size: (width, height) of the image.
        weights: (V, N) by which residuals are multiplied; 0 leaves a corner out. None: all count alike.
        options: what is known beforehand; by default nothing.
        start: an earlier fit of the same views with other weights or another board, to begin with.
        progress: called after each step.
        weigh: makes weights (V, N) in place of these from residuals (V, N, 2) of the first rounds, without a start.

    Raises:
        InputError: no start explains the corners.
        DegenerateError: the board is seen from one side only, or from too few, so that no projection is found.
    """
    weights = torch.ones_like(pixels[..., 0]) if weights is None else weights
    options = options or FitOptions()
    begun, robust = start.as_start if isinstance(start, HybridFit) else start, options.robust
    rounds = settle(points, pixels, size, weights, options, start=begun, progress=progress, weigh=weigh)
    ordered, own, known = points, board_modes(points), options.known_board(points)
    if options.training is not None:
        rounds = train_network(rounds, options.training, progress)
    capture, likely = rounds.capture, rounds.estimate
    # Error bars are for amplitudes as they are to be expected (`kcal.calibrate.hybrid.evidence`).
    set_before = robust or options.likely or (begun is not None and begun.settled)
    estimate = likely if set_before else expected_estimate(rounds)
    model, families, state, (h, _, log_ratio, _), tempering, relative = estimate
    variance = estimate.variance
    # Modes that the evidence holds so closely to zero that no pixel feels them are left out, error bars included.
    assert model.hybrid is not None
    peaks = torch.tensor(model.hybrid.modes.peaks, dtype=torch.float64)
    first = BEFORE_LENS + len(model.hybrid.leading)
    field = slice(first, first + len(peaks))
    unfelt = families.deviation(h)[field] * float(state.parameters[0]) * peaks < _UNFELT
    held = capture.held(estimate)
    held[field] |= unfelt
    if bool(unfelt.any()):
        parameters = state.parameters.clone()
        parameters[len(INTRINSICS) + len(model.hybrid.leading) :][unfelt] = families.mean[field][unfelt]
        estimate = estimate._replace(state=state._replace(parameters=parameters))
    problem, estimate, steps = capture.solved(estimate, LAST, last_step=True, held=held)
    reduced, displaced = problem.reduced_rows(estimate.state), None if known is None else known.corners
    if capture.board.displaced:
        # From here on they are integrated out, at their best.
        count, modes = 2 * len(points), capture.board.without_corners()
        offset, weight = estimate.state.board[-count:], math.sqrt(variance) / families.deviation(h)[-count:]
        prior = torch.nn.functional.pad(torch.diag(weight), (0, reduced.shape[1] - count))
        prior[:, -1] = weight * offset
        reduced = torch.cat([reduced[:, -1 - count : -1], reduced[:, : -1 - count], reduced[:, -1:]], 1)
        reduced = triangular(torch.cat([reduced, prior]))[count:, count:]
        own_offset, held = offset.view(2, -1).T, held[:-count]
        displaced = own_offset if displaced is None else displaced + own_offset
        capture = dataclasses.replace(capture, points=off_by(capture.points, own_offset), board=modes)
        estimate = estimate.with_board(modes)
        problem, families = capture.problem(estimate, held), estimate.families
    state = estimate.state
    K = products_of(reduced[:, :-1].T)
    deviation = torch.where(held, 0.0, families.deviation(h))
    inverse = posterior_root(K, deviation, variance)
    errors = problem.pixel_errors(state)
    if not robust:
        check_shown(errors)
    half, wider = inverse * deviation, 1.0 if capture.readout is None else widening(len(pixels))
    if capture.hyperprior.by_hand:
        camera = Camera(state.parameters, size=size, model=model)
        wider = 1.0 if robust else _by_amplitudes(half, moved_by_amplitudes(rounds), camera, capture.square)
    half = math.sqrt(wider) * half
    information = information_of(problem, state, math.sqrt(wider * variance), reduced)
    if known is not None:
        mean, root = known.whole.mean_and_half()
        state = state._replace(board=mean + state.board @ root)
        information = known.in_modes(information, state.board, wider)
        half = torch.cat([half[:, : -len(mean)], half[:, -len(mean) :] @ root], 1)
    fit = HybridFit(
        model=model,
        size=size,
        state=state,
        half=half,
        information=information,
        sigma=math.sqrt(variance),
        wider=wider,
        tempering=tempering,
        hyperparameters=likely.amplitudes.h,
        expected=h,
        families=families,
        log_evidence=-rounds.loss,
        square=capture.square,
        readout=capture.readout,
        log_ratio=log_ratio,
        relative=relative,
        displaced=displaced,
        effective=len(deviation) - float(inverse.square().sum()),
        board_shapes=own,
        board_points=off_by(ordered + torch.einsum("b,bkn->nk", state.board, own.shapes), displaced),
        residuals=capture.by_corner(errors),
        weights=capture.weights,
        weighted_rms=math.nan,
        iterations=rounds.steps + steps,
        converged=rounds.converged,
    )
    residuals = fit.residuals
    if capture.readout is not None:
        # With each corner read exactly when it is shown.
        again = fit.residuals_of(pixels)
        residuals = torch.where(again.isfinite() & capture.seen[..., None], again, residuals)
    weighted = float((capture.weights[..., None] * residuals).square().nansum()) / int(capture.seen.sum())
    return dataclasses.replace(fit, residuals=residuals, weighted_rms=math.sqrt(weighted))
