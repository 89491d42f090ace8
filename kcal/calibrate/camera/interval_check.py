"""Are the error bars of a calibration true? Simulate its very capture many times, refit, and compare.

The camera that was found, and the board and the motions that it saw, are drawn from what the calibration leaves open;
the poses stay, and so do the corners that were seen, their weights and their noise. Each capture is fitted by what
fitted the real one: amplitudes, noise and motion are found anew by the evidence. The fit begins at the found camera,
which takes a third to two thirds of the time and ends within 0.002 σ of a fit from nothing in the median
(docs/measured/ordinary.md). One linear step with the evidence held would not do: it repeats what is stated, whatever
that is.

A lens or a board that the model cannot describe does not show here, because it is not simulated. The capture's own
views (`kcal.calibrate.camera.trust`) and a second capture (`against_capture`) show it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.camera.calibrate import calibrate_camera
from kcal.calibrate.camera.hybrid import corner_weights
from kcal.calibrate.camera.result import CalibrationOptions, CameraCalibrationResult
from kcal.calibrate.camera.solve import calibrate_parametric
from kcal.calibrate.hybrid.fit import HybridFit, fit_hybrid
from kcal.calibrate.hybrid.fitted_views import hybrid_unknowns
from kcal.corners.observations import Observations
from kcal.errors import InputError, KcalError
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.difference import CameraDifference, camera_difference
from kcal.lens.rig import half_of_covariance
from kcal.lens.uncertainty import pixel_covariance, pixel_errors
from kcal.texts import brief
from kcal.threads import in_one_thread

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
        own: (R, P) squares of these errors over the covariances that the refitted camera states itself.
    """

    seed: int
    errors: Tensor
    own: Tensor


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class IntervalCheck:
    """Errors of repeated captures, against what one capture states.

    Args:
        pixels: (rows, columns, 2) the places.
        ranges: meters; infinity for directions.
        stated: (R, rows, columns, 2, 2) px² the covariance that the calibration states.
        errors: (K, R, rows, columns, 2) px of K refits; NaN where a camera has no image.
        own: (K, R, rows, columns) squares of the errors over the covariances that the refits state.
        failed: refits that could not be calibrated.
    """

    pixels: Tensor
    ranges: tuple[float, ...]
    stated: Tensor
    errors: Tensor
    own: Tensor
    failed: int

    @property
    def squares(self) -> Tensor:
        """(K, R, rows, columns) squares of the errors over the covariance that is stated: χ² of two degrees."""
        half = torch.linalg.cholesky(self.stated)
        away = torch.linalg.solve_triangular(half, self.errors[..., None], upper=False)
        return away.square().sum((-1, -2))

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
    def own_shares(self) -> list[float]:
        """As `shares`, of the ellipses that each refit states itself."""
        return [float(value) for value in _share_within(self.own, (-1, -2)).mean(0)]

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
        camera = _possible_camera(result, random)
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
            errors = torch.stack([pixel_errors(again, drawn.camera, places, at=at) for at in ranges])
            known = torch.stack([pixel_covariance(again, places, at=at) for at in ranges])
            yield Refit(seed, errors, _own_squares(errors, known))
        except KcalError:
            lost = torch.full((len(ranges), len(places)), torch.nan, dtype=torch.float64)
            yield Refit(seed, lost[..., None].expand(-1, -1, 2), lost)


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
    shape = (len(ranges), *pixels.shape[:2])
    errors = torch.stack([one.errors for one in kept]).reshape(len(kept), *shape, 2)
    return IntervalCheck(
        pixels=pixels,
        ranges=tuple(ranges),
        stated=torch.where(known[..., None, None], stated, eye),
        errors=torch.where(known[..., None], errors, torch.nan),
        own=torch.stack([one.own for one in kept]).reshape(len(kept), *shape),
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


def _own_squares(errors: Tensor, covariance: Tensor) -> Tensor:
    """(...) of errors (..., 2) over covariances (..., 2, 2); NaN where these are."""
    good = covariance.isfinite().all(-1).all(-1) & errors.isfinite().all(-1)
    eye = torch.eye(2, dtype=torch.float64)
    solved = torch.linalg.solve(torch.where(good[..., None, None], covariance, eye), errors.nan_to_num(0.0)[..., None])
    return torch.where(good, (errors.nan_to_num(0.0)[..., None] * solved).sum((-1, -2)), torch.nan)


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


def _possible_camera(result: CameraCalibrationResult, random: torch.Generator) -> Camera:
    half = half_of_covariance(result.covariance)
    change = torch.randn(len(half), dtype=torch.float64, generator=random) @ half
    return result.camera.with_parameters(result.camera.params.detach() + change)
