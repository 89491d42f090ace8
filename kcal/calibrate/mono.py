"""Calibrating one camera from views of a board (Algorithm 1 of the paper)."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from kcal.calibrate.covariance import spread
from kcal.calibrate.init import (
    homographies,
    intrinsics_candidates,
    poses_from_homographies,
    radial_start,
    spread_out,
)
from kcal.calibrate.ladder import Progress, climb, steps_to
from kcal.calibrate.poses import unflip
from kcal.calibrate.problem import BoardProblem
from kcal.calibrate.verdict import check_focal, rival_warnings, warnings_of
from kcal.calibrate.views import Views, free_parameters
from kcal.calibrate.weights import whitening
from kcal.corners.observations import Observations
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.lens.projection import INTRINSICS
from kcal.solve.lm import LMOptions, minimise
from kcal.solve.result import Result, State, Status
from kcal.solve.robust import RobustLoss

_MINIMUM_VIEWS = 3
_MINIMUM_CORNERS = 6
# RMS distance in pixels of a view's corners from the line that fits them best, below which they show no plane.
_MINIMUM_WIDTH = 0.5
# A first fit worse than this many pixels is retried from other focal lengths.
_SUSPICIOUS_RMS = 2.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class CalibrationOptions:
    """Options of `calibrate_camera`.

    Args:
        model: lens model, by name or as a `LensModel`.
        board_warp: estimate how the board bends (two more parameters).
        weighted: let corners count by their covariances where all views have them (`kcal.calibrate.weights`);
            False minimises the plain RMS, as OpenCV does.
        loss: a robust loss of each corner's residual in pixels, for data with wrong corners, or None. It is used after
            a plain solution has been found; a scale of some three times the noise is good.
        focal: roughly known focal length in pixels (from EXIF or the field of view), tried first as a start, or None.
        solver: options of the Levenberg-Marquardt solver.
    """

    model: LensModel | str = "opencv5"
    board_warp: bool = False
    weighted: bool = True
    loss: RobustLoss | None = None
    focal: float | None = None
    solver: LMOptions = dataclasses.field(
        default_factory=lambda: LMOptions(max_iterations=1000, tolerance=1e-12, flatness=2e-6)
    )

    def __post_init__(self) -> None:
        if self.focal is not None and not 0 < self.focal < float("inf"):
            raise InputError(f"CalibrationOptions: focal must be positive pixels, got {self.focal}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraCalibrationResult:
    """A calibrated camera and what it rests on.

    Args:
        camera: the camera.
        rms: sqrt(mean ‖r‖²) over all corners, pixels (Eq. 5), plain also where the corners were weighted.
        weighted_rms: likewise of what was minimised, by the corners' weights and under the robust loss; None where all
            corners counted alike.
        per_view_rms: (V,) likewise for each view, in the order of the observations.
        residuals: (V, N, 2) projected minus observed, pixels; NaN where a corner was not seen.
        cam_from_board_rotation: (V, 3, 3).
        cam_from_board_translation: (V, 3) metres.
        board_warp: (2,) metres of bend along x and y, or None if not estimated.
        sigma: name -> standard deviation of each free parameter; None where the data do not determine it.
        status: why the solver stopped.
        iterations: trial steps of the solver, all starts and models together.
        warnings: sentences about what the user should doubt.
    """

    camera: Camera
    rms: float
    weighted_rms: float | None
    per_view_rms: Tensor
    residuals: Tensor
    cam_from_board_rotation: Tensor
    cam_from_board_translation: Tensor
    board_warp: Tensor | None
    sigma: dict[str, float | None]
    status: Status
    iterations: int
    warnings: tuple[str, ...]


def _silent(_: str) -> None:
    return None


def calibrate_camera(
    observations: Observations, options: CalibrationOptions | None = None, progress: Progress = _silent
) -> CameraCalibrationResult:
    """Find a camera's intrinsics and lens from views of a board.

    Zhang's method (2000): homographies, closed-form intrinsics, poses and radial terms, then Levenberg-Marquardt on
    the reprojection error of all corners over all parameters, board poses eliminated by the Schur complement. Rich
    lens models are reached through the models nested in them, from several starts (see `kcal.calibrate.ladder`);
    board poses that settled in the mirrored tilt are found and solved again.

    Args:
        observations: the views of one camera.
        options: see `CalibrationOptions`.
        progress: told what has just been finished.

    Returns:
        the camera with its residuals and error bars. Skew stays 0.

    Raises:
        DegenerateError: fewer than three views, too few corners for the model, or views that do not determine the
            focal length (all parallel to the image, for example).
        InputError: the data and the model do not fit at all.

    Example:
        >>> from kcal.corners.board import Board
        >>> from kcal.corners.observations import View
        >>> from kcal.lens.pose import rotation_from_vector
        >>> board = Board(columns=7, rows=6, square=0.05)
        >>> truth = Camera.build(focal=(800, 805), center=(322, 238), size=(640, 480), coefficients=[-0.1, 0.02])
        >>> tilts = torch.tensor([[0.5, 0, 0], [-0.5, 0.1, 0], [0, 0.5, 0.2], [0.1, -0.5, 0]], dtype=torch.float64)
        >>> views = []
        >>> for i, rotation in enumerate(rotation_from_vector(tilts)):
        ...     points = board.points @ rotation.T + torch.tensor([-0.15, -0.12, 0.6], dtype=torch.float64)
        ...     views.append(View(name=str(i), pixels=truth.project(points)[0].tolist()))
        >>> seen = Observations(board=board, image_size=(640, 480), views=views)
        >>> result = calibrate_camera(seen)
        >>> round(float(result.camera.focal[0]), 6), result.rms < 1e-6
        (800.0, True)
    """
    options = options or CalibrationOptions()
    model = LensModel.named(options.model)
    board = observations.board.points
    pixels = observations.pixels()
    _check(observations, pixels, model, options.board_warp)

    solver = options.solver
    ladder = steps_to(model)
    first, cold, spent = _first(board, pixels, observations.image_size, ladder[0], options)
    progress(f"start ({ladder[0]})")
    seen = pixels[:, None]
    views = Views(board_points=board, pixels=seen, size=observations.image_size, free_warp=options.board_warp)
    minimum = climb(views, first, cold, ladder, solver, progress)
    spent += minimum.iterations

    # The first model's poses were looked at; look once more under another lens.
    result = minimum.result
    problem = views.problem(model, terms=minimum.terms)
    if len(ladder) > 1:
        state, flipped = unflip(board, seen, [model], result.state)
        if flipped:
            result = minimise(problem, state, solver)
            spent += int(result.iterations)
    plain_cost = float(result.cost)
    covariances = observations.covariances() if options.weighted else None
    weights = None
    if covariances is not None:
        # The residuals of the plain solution tell how much there is beyond the corners' own noise.
        weights = whitening(covariances, 2.0 * plain_cost / problem.residual_count)[:, None]
    if weights is not None or options.loss is not None:
        problem = BoardProblem(
            board,
            seen,
            [model],
            problem.free,
            free_warp=options.board_warp,
            whitening=weights,
            loss=options.loss,
            terms=minimum.terms,
        )
        result = minimise(problem, result.state, solver)
        spent += int(result.iterations)
    solved = _result(observations, problem, result, spent, model)
    doubts = rival_warnings(solved.camera, solved.sigma, minimum, plain_cost, problem.residual_count)
    return dataclasses.replace(solved, warnings=(*solved.warnings, *doubts))


def _check(observations: Observations, pixels: Tensor, model: LensModel, warp: bool) -> None:
    seen = torch.isfinite(pixels).all(-1).sum(-1)
    if len(pixels) < _MINIMUM_VIEWS:
        raise DegenerateError(
            f"{len(pixels)} view(s) of the board: at least {_MINIMUM_VIEWS} at different tilts are needed, "
            "10 to 40 are good"
        )
    poor = (seen < _MINIMUM_CORNERS).nonzero()[:, 0].tolist()
    if poor:
        raise InputError(
            f"view {observations.names[poor[0]]!r} has {int(seen[poor[0]])} corners; at least {_MINIMUM_CORNERS} are "
            "needed: remove the view"
        )
    on_line = (~spread_out(observations.board.points, pixels)).nonzero()[:, 0].tolist()
    if on_line:
        raise InputError(
            f"view {observations.names[on_line[0]]!r}: all its corners, or all but one, lie on one line: that leaves "
            "the board's pose open; remove the view"
        )
    centred = torch.nan_to_num(pixels - pixels.nanmean(1, keepdim=True))
    width = torch.linalg.svdvals(centred)[:, 1] / seen.sqrt()
    thin = (width < _MINIMUM_WIDTH).nonzero()[:, 0].tolist()
    if thin:
        raise InputError(
            f"view {observations.names[thin[0]]!r}: its corners coincide or the board is seen edge-on; remove the view"
        )
    unknowns = 4 + model.size + 2 * warp + 6 * len(pixels)
    if 2 * int(seen.sum()) <= unknowns:
        raise DegenerateError(
            f"{int(seen.sum())} corners cannot determine {unknowns} parameters: add views or choose a smaller model"
        )


def _first(
    board: Tensor, pixels: Tensor, size: tuple[int, int], model: LensModel, options: CalibrationOptions
) -> tuple[State, State, int]:
    """The first model's solution, a start without distortion, both from the closed forms, and the trials spent."""
    homography = homographies(board, pixels)
    spent = 0
    best: tuple[float, State, State] | None = None
    candidates = intrinsics_candidates(homography, size)
    if options.focal is not None:
        centre = [(size[0] - 1) / 2, (size[1] - 1) / 2]
        candidates.insert(0, torch.tensor([options.focal, options.focal, *centre], dtype=torch.float64))
    for intrinsics in candidates:
        rotation, translation = poses_from_homographies(homography, intrinsics)
        zero = torch.zeros(len(INTRINSICS) + model.size, dtype=torch.float64)
        zero[:4] = intrinsics
        lens = zero.clone()
        if model.numerator >= 2:
            k1, k2 = (len(INTRINSICS) + i for i in model.numerator_index[:2])
            lens[[k1, k2]] = radial_start(board, pixels, intrinsics, rotation, translation)
        rest = (
            torch.zeros(2, dtype=torch.float64),
            torch.zeros(0, 3, 3, dtype=torch.float64),
            torch.zeros(0, 3, dtype=torch.float64),
            rotation,
            translation,
        )
        problem = BoardProblem(board, pixels[:, None], [model], [free_parameters(model)], free_warp=options.board_warp)
        cold: State = (zero, *rest)
        for start in ((lens, *rest), cold):
            result = minimise(problem, start, options.solver)
            spent += int(result.iterations)
            if result.status != Status.BAD_START:
                break
        state, flipped = unflip(board, pixels[:, None], [model], result.state)
        if flipped:
            result = minimise(problem, state, options.solver)
            spent += int(result.iterations)
        cost = float(result.cost)
        if cost == cost and (best is None or cost < best[0]):
            best = (cost, result.state, cold)
        if best is not None and _rms(best[0], pixels) < _SUSPICIOUS_RMS:
            break
    if best is None:
        raise InputError("no start explains the corners: are all views of this board and from this camera?")
    return best[1], best[2], spent


def _rms(cost: float, pixels: Tensor) -> float:
    return float((2.0 * cost / int(torch.isfinite(pixels).all(-1).sum())) ** 0.5)


def _result(
    observations: Observations, problem: BoardProblem, solved: Result, spent: int, model: LensModel
) -> CameraCalibrationResult:
    state = problem.tidy(solved.state)
    s = problem.unpack(state)
    pixels = observations.pixels()
    camera = Camera(s.parameters[0], size=observations.image_size, model=model)
    residuals = problem.pixel_errors(state)[:, 0].transpose(-1, -2)
    seen = torch.isfinite(pixels).all(-1)
    squared = (residuals**2).sum(-1)
    per_view = torch.sqrt(squared.sum(-1) / seen.sum(-1))
    rms = float(torch.sqrt(squared.sum() / seen.sum()))
    count = problem.shared_size + 6 * len(pixels)
    uncertainty = spread(problem.linearise(state), problem.residual_count, count)
    names = [name for name in camera.names if name != "skew"]
    check_focal(uncertainty, s.parameters[0])
    status = Status(int(solved.status))
    return CameraCalibrationResult(
        camera=camera,
        rms=rms,
        weighted_rms=float(torch.sqrt(2.0 * solved.cost / seen.sum())) if problem.whitened or problem.robust else None,
        per_view_rms=per_view,
        residuals=torch.where(seen[..., None], residuals, torch.nan),
        cam_from_board_rotation=s.first_from_board_rotation,
        cam_from_board_translation=s.first_from_board_translation,
        board_warp=s.warp if problem.free_warp else None,
        sigma={
            name: float(sigma) if bool(known) else None for name, sigma, known in zip(names, *uncertainty, strict=False)
        },
        status=status,
        iterations=spent,
        warnings=tuple(warnings_of(observations, camera, rms, per_view, uncertainty, names, status)),
    )
