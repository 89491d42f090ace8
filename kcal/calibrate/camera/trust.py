"""Whether to trust a calibration: halves of its views, a reference, its residuals, and its capture simulated again."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.camera.advice import unreached_share
from kcal.calibrate.camera.calibrate import calibrate_camera
from kcal.calibrate.camera.hybrid import calibrate_hybrid, corner_weights
from kcal.calibrate.camera.one_camera import lenses_by_view
from kcal.calibrate.camera.result import COPY, CalibrationOptions, CameraCalibrationResult, OutlierRejection, Progress
from kcal.calibrate.camera.solve import calibrate_parametric
from kcal.calibrate.camera.warnings import board_distances, corner_pupil, distance_text
from kcal.calibrate.hybrid.fit import HybridFit, fit_hybrid
from kcal.calibrate.hybrid.fitted_views import hybrid_unknowns, moving_residuals
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import Views, refine_poses
from kcal.corners.observations import Observations
from kcal.errors import InputError, KcalError
from kcal.gaussian import half_of_covariance
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.difference import CameraDifference, camera_difference
from kcal.lens.uncertainty import ParaxialFocal, image_sigma, paraxial_focal, pixel_covariance, pixel_errors
from kcal.solve.lm import LMOptions
from kcal.texts import brief
from kcal.threads import in_one_thread

# Check a calibration against itself: halves of its views, a reference fit, and structure in its residuals.
#
# Error bars say what noise does to a camera if its model is right. What a wrong model does shows in other ways: cameras
# from two halves of the views differ by more than their error bars, the hybrid lens with a printed board finds what the
# chosen model leaves out, and residuals repeat in places where noise would not.

# Views that each half must have: fewer often do not determine a camera.
FEWEST_IN_HALF = 6
# Cells of the image over which residuals are averaged, and corners that each needs.
_COLUMNS, _ROWS, _FEWEST_IN_CELL = 8, 6, 10
POSES = LMOptions(max_iterations=60, tolerance=1e-12)
# RMS of corners that a half did not see over that of fitted ones: 1.01 to 1.19 in clean captures of 12 to 22 views, 1.5
# to 2.1 with 5 coefficients on a wide lens (tuning seeds of scripts/check/verdict.py).
PREDICTED = 1.25
# Angle from the axis, beyond which corners are those of a fisheye.
_WIDE = math.radians(55.0)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class HalvesDifference:
    """Cameras from two halves of the views.

    Args:
        label: how the views were divided.
        alike: whether both halves are alike by construction (every other view), or differ in time or by name.
        difference: of the two cameras, against what their error bars say.
        held_out: RMS in pixels of each half's corners under the camera and board of the other, with board poses, and
            motions where views move, solved again.
        own: RMS of the corners in the fits that used them.
        still: as `held_out`, with nothing but poses solved again.
    """

    label: str
    alike: bool
    difference: CameraDifference
    held_out: float
    own: float
    still: float = math.nan

    @property
    def excess(self) -> float:
        """RMS over the image of what the error bars do not explain, pixels; 0 where they explain all of it."""
        return unexplained(self.difference)


class ResidualStructure(NamedTuple):
    """Mean squares of averages of residuals over what independent noise would leave; 1 without structure.

    Attributes:
        image: of averages over parts of the image, where a wrong lens model shows.
        board: of averages over views for each corner of the board, where a wrong board shows.
        neighbors: correlation of residuals of neighboring corners in a view, 0 without structure.
        neighbors_sigma: its standard deviation by chance.
    """

    image: float
    board: float
    neighbors: float
    neighbors_sigma: float


class PlainLens(NamedTuple):
    """How a plain lens predicts views where this camera predicts them badly.

    Attributes:
        model: of the plain lens.
        held_out: RMS in pixels of each half's corners under its camera of the other half, with poses solved again.
        own: likewise under this lens.
    """

    model: str
    held_out: float
    own: float


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Examination:
    """Results of the checks that `examine` makes of a calibration.

    Args:
        halves: cameras from halves of the views; empty where there are too few views.
        reference: the hybrid lens with a printed board, fitted to the same views; None where that was calibrated.
        model: difference of the camera from the reference.
        structure: of the residuals.
        failures: what could not be checked, and why.
        plain: of a hybrid lens whose halves predict each other badly, how a plain lens predicts them.
    """

    __repr__ = brief

    halves: tuple[HalvesDifference, ...]
    reference: CameraCalibrationResult | None
    model: CameraDifference | None
    structure: ResidualStructure
    failures: tuple[str, ...] = ()
    plain: PlainLens | None = None


def unexplained(found: CameraDifference, level: float = 1e-3) -> float:
    """RMS over the image of a difference beyond its error bars, pixels; 0 where chance may explain it at that level."""
    if found.probability is None or found.ratio is None or found.probability >= level or found.ratio <= 1.0:
        return 0.0
    return found.rms * math.sqrt(1.0 - found.ratio**-2)


@in_one_thread
def examine(
    result: CameraCalibrationResult, options: CalibrationOptions, progress: Progress = lambda _: None
) -> Examination:
    """Calibrate halves of the views, and the reference where another model or board was chosen.

    Args:
        result: the calibration.
        options: with which it was made.
        progress: called after each fit.

    Example:
        >>> from kcal import Board, Camera, View
        >>> from kcal.lens import rotation_from_vector
        >>> board, views = Board(columns=7, rows=6, square=0.05), []
        >>> truth = Camera.build(focal=(800, 800), center=(322, 238), size=(640, 480), model="pinhole")
        >>> tilts = torch.tensor([[0.5, 0, 0], [-0.5, 0.1, 0], [0, 0.5, 0.2], [0.1, -0.5, 0]], dtype=torch.float64)
        >>> for i, rotation in enumerate(rotation_from_vector(tilts)):
        ...     points = board.points @ rotation.T + torch.tensor([-0.15, -0.14, 0.7], dtype=torch.float64)
        ...     views.append(View(name=str(i), pixels=truth.project(points)[0].tolist()))
        >>> options = CalibrationOptions()
        >>> result = calibrate_camera(Observations(board=board, image_size=(640, 480), views=views), options)
        >>> examine(result, options).failures
        ('4 views are too few to compare halves: 12 are needed',)
    """
    seen = result.observations
    used = [name for name, rms in zip(seen.names, result.per_view_rms.tolist(), strict=True) if not math.isnan(rms)]
    seen = seen.subset(used)
    halves, failures = [], []
    plain: PlainLens | None = None
    if len(used) < 2 * FEWEST_IN_HALF:
        failures.append(f"{len(used)} views are too few to compare halves: {2 * FEWEST_IN_HALF} are needed")
    else:
        for label, alike, parts in _splits(used):
            try:
                halves.append(_compare(seen, parts, options, label, alike, result))
                progress(label)
                if options.hybrid and alike and halves[-1].held_out > PREDICTED * halves[-1].own:
                    plain = _plain_lens(result.camera, seen, parts, options, halves[-1].still)
            except KcalError as error:
                failures.append(f"{label}: {str(error).split(' (')[0]}")  # without the names of views
    reference, model = None, None
    if not (options.hybrid and options.board == "printed"):
        try:
            own = CalibrationOptions(
                weighted=options.weighted, reject=options.reject, motion=options.motion, bending=options.bending,
                focal=float(paraxial_focal(result.camera).value[0]),
            )  # fmt: skip
            reference = calibrate_camera(seen, own)
            model = camera_difference(result.camera, reference.camera)
        except KcalError as error:
            failures.append(f"reference with a hybrid lens: {error}")
        progress("reference")
    return Examination(
        halves=tuple(halves),
        reference=reference,
        model=model,
        structure=residual_structure(result.residuals, seen_pixels(result), seen.image_size, result.observations),
        failures=tuple(failures),
        plain=plain,
    )


def stored_options(camera: Camera) -> CalibrationOptions:
    """The options that give a camera again from its views, as far as its file tells.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="opencv4")
        >>> str(stored_options(camera).model)
        'opencv4'
    """
    record = camera.calibration.record if camera.calibration else None
    asked = record is not None and any(not one.reason.startswith(COPY) for one in record.excluded)
    reject = OutlierRejection() if asked else None
    if camera.model.hybrid is None:
        warp = record is not None and record.board_warp is not None
        return CalibrationOptions(model=camera.model, board_warp=warp, reject=reject)
    moved = record.board_deviation if record else None
    exact = moved is not None and not any(any(corner) for corner in moved)
    left = record.without if record else ()
    motion, bending = (name not in left for name in ("motion", "bending"))
    return CalibrationOptions(board="exact" if exact else "printed", reject=reject, motion=motion, bending=bending)


def seen_pixels(result: CameraCalibrationResult) -> Tensor:
    """(V, N, 2) corners that counted; NaN for the others."""
    return torch.where(result.residuals.isfinite(), result.observations.pixels(), torch.nan)


def _splits(names: list[str]) -> list[tuple[str, bool, tuple[list[str], list[str]]]]:
    """Every other view; and by the beginning of names where there are two kinds of them, else by order."""
    kinds: dict[str, list[str]] = {}
    for name in names:
        kinds.setdefault(re.split(r"\d", name.rpartition("/")[2], maxsplit=1)[0], []).append(name)
    if len(kinds) == 2 and min(map(len, kinds.values())) >= FEWEST_IN_HALF:
        (one, first), (other, second) = kinds.items()
        label = f"images {one}… and {other}…"
    else:
        middle = len(names) // 2
        label, first, second = "first and second half", names[:middle], names[middle:]
    return [("every other view", True, (names[::2], names[1::2])), (label, False, (first, second))]


def _half(
    seen: Observations, options: CalibrationOptions, whole: CameraCalibrationResult | None
) -> CameraCalibrationResult:
    """A calibration of some views, from that of all on where one is given."""
    if not options.hybrid:
        # A parametric lens stands for OpenCV's, which nobody asks whether it is one camera's.
        return calibrate_parametric(seen, options, lambda _: None)
    if whole is not None and whole.hybrid is not None and options.reject is None:
        # What views may have at all, and how much of it, those of the whole decided.
        own = [whole.observations.names.index(name) for name in seen.names]
        start, theta = whole.hybrid.only(own), whole.by_view
        with contextlib.suppress(KcalError, ArithmeticError, torch.linalg.LinAlgError):
            if theta is None:
                return calibrate_hybrid(seen, options, lambda _: None, start.settled)
            found = calibrate_hybrid(seen, options, lambda _: None, start)
            moving = lenses_by_view(found, options, lambda _: None, theta[own])
            if isinstance(moving, CameraCalibrationResult):
                return moving
    return calibrate_camera(seen, options)


def _compare(
    seen: Observations,
    parts: tuple[list[str], list[str]],
    options: CalibrationOptions,
    label: str,
    alike: bool,
    whole: CameraCalibrationResult | None = None,
) -> HalvesDifference:
    results = [_half(seen.subset(part), options, whole) for part in parts]
    sums, corners = torch.zeros(3, dtype=torch.float64), 0
    for fitted, other in (results, results[::-1]):
        views = Views(board_points=fitted.board_points, pixels=seen_pixels(other))
        poses = other.cam_from_board_rotation, other.cam_from_board_translation
        start = BoardState.flat(fitted.camera.params.detach(), *poses)
        solved = refine_poses(views, fitted.camera.model, start, POSES)
        squares, still = held_out_squares(fitted.camera, views, fitted.hybrid, *solved)
        sums += torch.stack([squares.sum(), other.residuals.square().nansum(), still.sum()])
        corners += int(other.residuals[..., 0].isfinite().sum())
    held_out, own, still_rms = (sums / corners).sqrt().tolist()
    apart = camera_difference(results[0].camera, results[1].camera)
    return HalvesDifference(label=label, alike=alike, difference=apart, held_out=held_out, own=own, still=still_rms)


def _plain_lens(
    camera: Camera, seen: Observations, parts: tuple[list[str], list[str]], options: CalibrationOptions, own: float
) -> PlainLens | None:
    """How OpenCV's lens of this camera's kind predicts the halves; None where it does not fit."""
    rays, valid = camera.unproject(seen.pixels())
    wide = float(rays[valid][:, 2].min()) < math.cos(_WIDE)
    model = "fisheye4" if wide else "opencv5"
    try:
        found = _compare(seen, parts, CalibrationOptions(model=model, reject=options.reject), "", True)
    except KcalError:
        return None
    return PlainLens(model, found.held_out, own)


def held_out_squares(
    camera: Camera, views: Views, judge: HybridFit | None, poses: BoardState, cost: Tensor
) -> tuple[Tensor, Tensor]:
    """(V,) squared residuals of held-out views with solved poses, and with motions as of the judge's views.

    Then with poses alone, whose cost is (V,). Infinite where a view has no pose.
    """
    squares = torch.nan_to_num(2.0 * cost, nan=math.inf)
    if judge is None or judge.readout is None:
        return squares, squares
    residuals = moving_residuals(
        camera, views.board_points, views.pixels, poses.rotation, poses.translation, judge.readout, judge.stillness
    )
    if views.whitening is not None:
        residuals = torch.einsum("vnij,vnj->vni", views.whitening, residuals)
    return torch.where(squares.isfinite(), residuals.square().nansum((1, 2)), torch.inf), squares


def residual_structure(
    residuals: Tensor, pixels: Tensor, size: tuple[int, int], observations: Observations
) -> ResidualStructure:
    """Whether residuals repeat where noise would not.

    Args:
        residuals: (V, N, 2) pixels, NaN where not seen.
        pixels: (V, N, 2) where they are.
        size: of the image.
        observations: whose board tells which corners are neighbors.
    """
    seen = residuals.isfinite().all(-1) & pixels.isfinite().all(-1)
    variance = float(residuals[seen].square().mean().clamp_min(1e-18))
    spread = residuals.nan_to_num(0.0)
    column = (pixels[..., 0] / size[0] * _COLUMNS).nan_to_num(0.0).long().clamp(0, _COLUMNS - 1)
    row = (pixels[..., 1] / size[1] * _ROWS).nan_to_num(0.0).long().clamp(0, _ROWS - 1)
    cell = (row * _COLUMNS + column)[seen]
    counts = torch.zeros(_COLUMNS * _ROWS, dtype=torch.float64).index_add(0, cell, torch.ones_like(cell).double())
    sums = torch.zeros(len(counts), 2, dtype=torch.float64).index_add(0, cell, residuals[seen])
    many = counts >= _FEWEST_IN_CELL
    image = float((sums[many].square() / counts[many, None]).mean() / variance) if bool(many.any()) else 1.0
    often = seen.sum(0)
    board = spread.sum(0)[often > 0].square() / often[often > 0, None]
    grid, shown = (
        values.unflatten(1, (observations.board.rows, observations.board.columns)) for values in (spread, seen)
    )
    products = [
        ((a * b).sum(-1))[both]
        for a, b, both in (
            (grid[:, 1:], grid[:, :-1], shown[:, 1:] & shown[:, :-1]),
            (grid[:, :, 1:], grid[:, :, :-1], shown[:, :, 1:] & shown[:, :, :-1]),
        )
    ]
    both = torch.cat(products) / (2.0 * variance)
    return ResidualStructure(
        image=image,
        board=float(board.mean()) / variance,
        neighbors=float(both.mean()) if len(both) else 0.0,
        neighbors_sigma=math.sqrt(0.5 / max(len(both), 1)),
    )


# Sum up a calibration in the few numbers that tell whether a camera can be trusted.


@dataclasses.dataclass(frozen=True, kw_only=True)
class CalibrationSummary:
    """The figures of a calibration to read first.

    Args:
        center: px, standard deviation of a point at infinity in the middle of the image, after the best-fit rotation
            (`kcal.lens.uncertainty.pixel_covariance`).
        border: its median along the image's border.
        worst: its largest value in the image; NaN where the camera has no error bars.
        unreached: share of the image that no board reached.
        pupil: meters by which the entrance pupil of the image's farthest corner lies before that of its middle; None
            without a hybrid lens.
        pupil_sigma: its standard deviation.
        focal: the focal lengths on the optical axis, with their standard deviations.

    Example:
        >>> CalibrationSummary(center=0.05, border=0.2, worst=0.5, unreached=0.1).pupil is None
        True
    """

    center: float
    border: float
    worst: float
    unreached: float
    pupil: float | None = None
    pupil_sigma: float | None = None
    focal: ParaxialFocal | None = None


def summarize(result: CameraCalibrationResult) -> CalibrationSummary:
    """Sum up one calibration.

    Example:
        >>> from kcal import Board, Camera, Observations, View, calibrate_camera
        >>> from kcal.lens import rotation_from_vector
        >>> board, views = Board(columns=7, rows=6, square=0.05), []
        >>> truth = Camera.build(focal=(800, 800), center=(322, 238), size=(640, 480), model="pinhole")
        >>> tilts = torch.tensor([[0.5, 0, 0], [-0.5, 0.1, 0], [0, 0.5, 0.2], [0.1, -0.5, 0]], dtype=torch.float64)
        >>> for i, rotation in enumerate(rotation_from_vector(tilts)):
        ...     points = board.points @ rotation.T + torch.tensor([-0.15, -0.14, 0.7], dtype=torch.float64)
        ...     views.append(View(name=str(i), pixels=truth.project(points)[0].tolist()))
        >>> result = calibrate_camera(Observations(board=board, image_size=(640, 480), views=views))
        >>> brief = summarize(result)
        >>> 0 < brief.center < brief.border < brief.worst, 0 < brief.unreached < 1
        (True, True)
    """
    camera = result.camera
    center = border = worst = math.nan
    if camera.calibration is not None and camera.calibration.known(camera.params) is not None:
        sigma = image_sigma(camera)
        rows, columns = sigma.shape
        edge = torch.cat([sigma[0], sigma[-1], sigma[1:-1, 0], sigma[1:-1, -1]])
        center, border = float(sigma[rows // 2, columns // 2]), float(edge.nanmedian())
        worst = float(sigma[sigma.isfinite()].max())
    pupil = corner_pupil(camera, result.covariance)
    return CalibrationSummary(
        center=center,
        border=border,
        worst=worst,
        unreached=unreached_share(result.observations),
        pupil=None if pupil is None else pupil.depth,
        pupil_sigma=None if pupil is None else pupil.sigma,
        focal=paraxial_focal(camera),
    )


def distances_text(result: CameraCalibrationResult) -> str:
    """The board's size and how far away it was, so that centimeters in place of millimeters are noticed.

    The board in millimeters from outer corner to outer corner, and distances in meters.
    """
    board = result.observations.board
    nearest, farthest = board_distances(result)
    width, height = (1e3 * side for side in board.extent)
    return (
        f"board {board.record}: {width:g} x {height:g} mm; "
        f"nearest view {distance_text(nearest)}, farthest {distance_text(farthest)}"
    )


# Are the error bars of a calibration true? Simulate its very capture many times, refit, and compare.
#
# The camera that was found, and the board and the motions that it saw, are drawn from what the calibration leaves open;
# the poses stay, and so do the corners that were seen, their weights and their noise. Each capture is fitted by what
# fitted the real one: amplitudes, noise and motion are found anew by the evidence. The fit begins at the found camera,
# which takes a third to two thirds of the time and ends within 0.002 σ of a fit from nothing in the median
# (docs/measured/ordinary.md). One linear step with the evidence held would not do: it repeats what is stated, whatever
# that is.
#
# A lens or a board that the model cannot describe does not show here, because it is not simulated. The capture's own
# views (`kcal.calibrate.camera.trust`) and a second capture (`against_capture`) show it.

# A normal vector of two components has a squared length beyond this once in twenty times.
CHI2 = -2.0 * math.log(0.05)
# Columns and rows of the places that are compared.
GRID = (25, 17)
# Intervals are true if they contain the truth in so large a share of refits and places, which is the convention of the
# tests of kcal.locate, or if so few refits do not refute it.
ENOUGH = 0.90
# Refits from which anything is said.
FEWEST = 10


class Refit(NamedTuple):
    """One simulated capture that was fitted again.

    Attributes:
        seed: of its noise and of its true camera.
        errors: (R, P, 2) px of the refitted camera at each range and place, after the best-fit rotation; NaN without an
            image. All NaN where the fit failed.
    """

    seed: int
    errors: Tensor


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class IntervalCheck:
    """Errors of repeated captures, against what one capture states.

    Args:
        pixels: (rows, columns, 2) the places.
        ranges: meters; infinity for directions.
        stated: (R, rows, columns, 2, 2) px² the covariance that the calibration states.
        errors: (K, R, rows, columns, 2) px of K refits; NaN where a camera has no image.
        failed: refits that could not be calibrated.
    """

    pixels: Tensor
    ranges: tuple[float, ...]
    stated: Tensor
    errors: Tensor
    failed: int

    @property
    def squares(self) -> Tensor:
        """(K, R, rows, columns) squares of the errors over the covariance that is stated: χ² of two degrees."""
        half = torch.linalg.cholesky(self.stated)
        return torch.linalg.solve_triangular(half, self.errors[..., None], upper=False).square().sum((-1, -2))

    @property
    def coverage(self) -> Tensor:
        """(R, rows, columns) share of the refits whose error is within the stated 95 % ellipse."""
        return _share_within(self.squares, 0)

    @property
    def shares(self) -> list[tuple[float, float]]:
        """Such a share over the image for each range, with its standard error: places of one refit go together."""
        each = _share_within(self.squares, (-1, -2))
        error = each.std(0) / math.sqrt(len(each)) if len(each) > 1 else torch.full_like(each[0], torch.inf)
        return list(zip(each.mean(0).tolist(), error.tolist(), strict=True))

    @property
    def factors(self) -> list[float]:
        """By which stated σ must be multiplied at each range so that 95 % of the errors are within."""
        return [math.sqrt(float(torch.quantile(one[one.isfinite()], 0.95)) / CHI2) for one in self.squares.unbind(1)]

    @property
    def rms(self) -> list[tuple[float, float]]:
        """RMS over the image, px, of the errors and of what is stated, at each range."""
        seen = self.errors.square().sum(-1).nanmean((0, 2, 3)).sqrt()
        told = self.stated.diagonal(dim1=-2, dim2=-1).sum(-1).nanmean((1, 2)).sqrt()
        return list(zip(seen.tolist(), told.tolist(), strict=True))

    @property
    def true(self) -> bool:
        """Whether the intervals hold at all ranges, as far as so many refits tell."""
        return all(share + 2.0 * error >= ENOUGH for share, error in self.shares)

    __repr__ = brief


def _share_within(squares: Tensor, axes: int | tuple[int, ...]) -> Tensor:
    known = squares.isfinite()
    return ((squares < CHI2) & known).sum(axes) / known.sum(axes)


class SimulatedCapture(NamedTuple):
    """A capture as the found camera may have seen it.

    Attributes:
        camera: the true one.
        pixels: (V, N, 2) its corners with noise; NaN where none was seen, and where one was left out.
        seen: the real capture, without views that were left out.
        fit: of the real capture, with the hybrid lens.
    """

    camera: Camera
    pixels: Tensor
    seen: Observations
    fit: HybridFit | None

    def calibrated(self, options: CalibrationOptions, *, warm: bool = True) -> Camera:
        """The camera that this capture gives, with its error bars; `warm`: the fit begins at that of the real one."""
        if self.fit is not None:
            own = dataclasses.replace(options.of_fit(self.seen.image_size), focal=None, training=None)
            fit = fit_hybrid(
                self.seen.board.points, self.pixels, self.seen.image_size, self.fit.weights, own,
                start=self.fit if warm else None,
            )  # fmt: skip
            fit.camera.calibration = CameraCalibration(information=fit.information)
            return fit.camera
        views = []
        for view, corners in zip(self.seen.views, self.pixels.tolist(), strict=True):
            moved = view.model_copy(update={"pixels": tuple((u, v) for u, v in corners)})
            views.append(moved.keeping([not math.isnan(u) for u, _ in corners]))
        drawn = self.seen.model_copy(update={"views": tuple(views)})
        return calibrate_parametric(drawn, dataclasses.replace(options, reject=None), lambda _: None).camera


def simulated_capture(result: CameraCalibrationResult, options: CalibrationOptions, seed: int) -> SimulatedCapture:
    """Draw a true camera and its capture from what a calibration says."""
    random = torch.Generator().manual_seed(seed)
    used = result.per_view_rms.isfinite().nonzero()[:, 0].tolist()
    seen = result.observations.subset([result.observations.names[i] for i in used])
    counted = result.residuals[used].isfinite()
    pixels = torch.where(counted, seen.pixels(), torch.nan)
    fit = None if result.hybrid is None else result.hybrid.only(used)
    if fit is not None:
        truth = _possible_fit(fit, random)
        camera, clean, weights = truth.camera, truth.residuals_of(pixels) + pixels, fit.weights
    else:
        half = half_of_covariance(result.covariance)
        change = torch.randn(len(half), dtype=torch.float64, generator=random) @ half
        camera = result.camera.with_parameters(result.camera.params.detach() + change)
        rotation, translation = result.cam_from_board_rotation[used], result.cam_from_board_translation[used]
        clean, valid = camera.project(result.board_points @ rotation.mT + translation[:, None])
        clean = torch.where(valid[..., None] & counted, clean, torch.nan)
        weights = corner_weights(seen, result.residuals[used]) if options.weighted else counted[..., 0].double()
    noise = torch.randn(pixels.shape, dtype=torch.float64, generator=random)
    drawn = clean + result.noise / weights.clamp_min(1e-9)[..., None] * noise
    return SimulatedCapture(camera, torch.where(drawn.isfinite(), drawn, torch.nan), seen, fit)


def simulated_refits(
    result: CameraCalibrationResult, options: CalibrationOptions, ranges: Sequence[float], seeds: Iterable[int]
) -> Iterator[Refit]:
    """Simulate the capture of a calibration, and calibrate each time.

    Args:
        result: the calibration.
        options: with which it was made.
        ranges: meters, at which errors are compared; infinity for directions.
        seeds: one for each capture.

    Example:
        >>> from kcal import Board, View
        >>> from kcal.lens import rotation_from_vector
        >>> board, views = Board(columns=7, rows=6, square=0.05), []
        >>> truth = Camera.build(focal=(800, 800), center=(322, 238), size=(640, 480), model="pinhole")
        >>> tilts = torch.tensor([[0.5, 0, 0], [-0.5, 0.1, 0], [0, 0.5, 0.2], [0.1, -0.5, 0]], dtype=torch.float64)
        >>> for i, rotation in enumerate(rotation_from_vector(tilts)):
        ...     points = board.points @ rotation.T + torch.tensor([-0.15, -0.14, 0.7], dtype=torch.float64)
        ...     pixels = truth.project(points)[0]
        ...     views.append(View(name=str(i), pixels=(pixels + 0.1 * torch.sin(1e3 * pixels)).tolist()))
        >>> options = CalibrationOptions(motion=False)
        >>> result = calibrate_camera(Observations(board=board, image_size=(640, 480), views=views), options)
        >>> found = interval_check(result, [math.inf], simulated_refits(result, options, [math.inf], range(3)))
        >>> found.errors.shape, found.failed
        (torch.Size([3, 1, 17, 25, 2]), 0)
    """
    places = result.camera.grid(*GRID).reshape(-1, 2)
    for seed in seeds:
        drawn = simulated_capture(result, options, seed)
        try:
            again = drawn.calibrated(options)
            yield Refit(seed, torch.stack([pixel_errors(again, drawn.camera, places, at=at) for at in ranges]))
        except KcalError:
            yield Refit(seed, torch.full((len(ranges), len(places), 2), torch.nan, dtype=torch.float64))


@in_one_thread
def interval_check(result: CameraCalibrationResult, ranges: Sequence[float], refits: Iterable[Refit]) -> IntervalCheck:
    """Compare refits with what a calibration states.

    Raises:
        InputError: no refit could be calibrated.
    """
    done = list(refits)
    kept = [one for one in done if bool(one.errors.isfinite().any())]
    if not kept:
        raise InputError(f"none of {len(done)} simulated captures could be calibrated: nothing can be said")
    pixels = result.camera.grid(*GRID)
    stated = torch.stack([pixel_covariance(result.camera, pixels, at=at) for at in ranges])
    # Where the camera has no ray, there is nothing to compare.
    eye = torch.eye(2, dtype=torch.float64).expand_as(stated)
    known = stated.isfinite().all(-1).all(-1)
    errors = torch.stack([one.errors for one in kept]).unflatten(2, pixels.shape[:2])
    return IntervalCheck(
        pixels=pixels,
        ranges=tuple(ranges),
        stated=torch.where(known[..., None, None], stated, eye),
        errors=torch.where(known[..., None], errors, torch.nan),
        failed=len(done) - len(kept),
    )


@in_one_thread
def against_capture(
    result: CameraCalibrationResult, second: Observations, options: CalibrationOptions, ranges: Sequence[float]
) -> list[CameraDifference]:
    """Calibrate a second capture of the same camera, and compare both at each range with what their error bars say.

    Raises:
        KcalError: the second capture cannot be calibrated, or has images of another size.
    """
    again = calibrate_camera(second, options)
    return [camera_difference(result.camera, again.camera, at=at) for at in ranges]


def _possible_fit(fit: HybridFit, random: torch.Generator) -> HybridFit:
    """A camera, a board and motions that the calibration takes for possible; poses as they are."""
    unknowns, state = hybrid_unknowns(fit.model, fit.square), fit.state
    # Error bars of few moving views are wider than the posterior, which is what the refits are to tell.
    change = torch.randn(len(fit.half), dtype=torch.float64, generator=random) @ fit.half / math.sqrt(fit.wider)
    parameters = state.parameters.clone()
    parameters[list(unknowns.indices)] += change[list(unknowns.slots)]
    board = state.board + change[len(change) - len(state.board) :]
    motion = state.motion
    if fit.readout is not None:
        spread = (fit.sigma**2 / fit.tempering / fit.own_stillness).sqrt()
        motion = spread * torch.randn(motion.shape, dtype=torch.float64, generator=random)
    moved = torch.einsum("b,bkn->nk", board - state.board, fit.board_shapes.shapes)
    return dataclasses.replace(
        fit,
        state=state._replace(parameters=parameters, board=board, motion=motion),
        board_points=fit.board_points + moved,
    )
