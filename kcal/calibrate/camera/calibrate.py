"""Calibrating one camera from views of a board (Algorithm 1 of the paper)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from kcal.calibrate.bundle.batching import Solve, Steps, alone, together
from kcal.calibrate.bundle.board_problem import BoardProblem
from kcal.calibrate.bundle.coefficient_prior import is_overparameterized
from kcal.calibrate.bundle.covariance import Uncertainty, uncertainty_of
from kcal.calibrate.bundle.parameters import Free
from kcal.calibrate.bundle.priors import Prior, Term
from kcal.calibrate.camera.options import CalibrationOptions, CameraCalibrationResult
from kcal.calibrate.camera.outliers import (
    OutlierRejection,
    RejectedCorner,
    RejectedView,
    check_share,
    corner_limits,
    corners_beyond,
    noise_scale,
    view_rms,
    views_beyond,
    without,
)
from kcal.calibrate.camera.prior_comparison import compare_with_prior, weak_prior_term
from kcal.calibrate.camera.record import camera_calibration
from kcal.calibrate.camera.solve import Solved, corner_problem, solve
from kcal.calibrate.camera.warnings import (
    NO_ERROR_BARS,
    check_focal,
    comparison_warnings,
    contradicted,
    rival_warnings,
    standing_out,
    warnings_of,
)
from kcal.calibrate.search.model_ladder import LEAST_NOISE, Progress
from kcal.corners.observations import Observations
from kcal.errors import KcalError
from kcal.lens.camera import Camera
from kcal.solve.lm import LMOptions
from kcal.solve.result import State, Status
from kcal.solve.robust import RobustLoss

__all__ = ["CalibrationOptions", "CameraCalibrationResult", "calibrate_camera", "calibrate_cameras"]

# To tell which corners are wrong: a loss that a few of them cannot pull, whose scale in units of the noise follows it.
_ROUGH = LMOptions(max_iterations=40, tolerance=1e-8)
_CAUCHY_SCALE, _CAUCHY_ROUNDS = 3.0, 4
# Rounds of leaving out and calibrating again; two are the rule.
_ROUNDS = 5


def _silent(_: str) -> None:
    return None


def calibrate_camera(
    observations: Observations, options: CalibrationOptions | None = None, progress: Progress = _silent
) -> CameraCalibrationResult:
    """Find a camera's intrinsics and lens from views of a board.

    Zhang's method (2000): homographies, closed-form intrinsics, poses and radial terms, then Levenberg-Marquardt on
    the reprojection error of all corners over all parameters, board poses eliminated by the Schur complement. Rich
    lens models are reached through the models nested in them, from several starts (see
    `kcal.calibrate.search.model_ladder`); board poses that settled in the mirrored tilt are found and solved again.

    Args:
        observations: the views of one camera.
        options: see `CalibrationOptions`.
        progress: told what has just been finished.

    Returns:
        the camera with its residuals and error bars. Skew stays 0 unless `free` or `fixed` name it.

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
    return alone(_calibrating(observations, options or CalibrationOptions(), progress))


def calibrate_cameras(
    observations: Sequence[Observations],
    options: CalibrationOptions | None = None,
    progress: Progress = _silent,
    *,
    device: torch.device | str = "cpu",
) -> list[CameraCalibrationResult | KcalError]:
    """Calibrate many cameras with the same options, as `calibrate_camera` calibrates one.

    Whatever several cameras must have minimized next is minimized as one batch (`kcal.calibrate.bundle.batching`):
    cameras of few views, whose time goes into starting operations on small tensors, take a fraction of the time that
    one call after the other takes. Boards of one batch must be equal; sets with other boards are calibrated beside
    them.

    Args:
        observations: the views of each camera; numbers of views, image sizes and missing corners may differ.
        options: of all of them.
        progress: told how many are finished.
        device: where batches are minimized. Results are on the CPU.

    Returns:
        for each camera what `calibrate_camera` returns, within the solver's tolerance, or the error that it would have
        raised: one bad set does not spoil the others. Of a rich model with several minima of nearly the same cost
        rounding may choose another one.

    Example:
        >>> from kcal.corners.board import Board
        >>> from kcal.corners.observations import View
        >>> board = Board(columns=3, rows=3, square=0.1)
        >>> view = View(name="a", pixels=[(100.0 * x, 100.0 * y) for y in range(1, 4) for x in range(1, 4)])
        >>> calibrate_cameras([Observations(board=board, image_size=(640, 480), views=[view])])
        [DegenerateError('1 view(s) of the board: at least 3 at different tilts are needed, 10 to 40 are good')]
    """
    options = options or CalibrationOptions()
    count = len(observations)
    return together(
        [_calibrating(seen, options, _silent) for seen in observations],
        torch.device(device),
        lambda done: progress(f"{done} of {count} cameras"),
    )


def _calibrating(
    observations: Observations, options: CalibrationOptions, progress: Progress
) -> Steps[CameraCalibrationResult]:
    if options.reject is not None:
        found = yield from _calibrate_rejecting(observations, options, options.reject, progress)
    else:
        found = judged(observations, (yield from solve(observations, options, progress)), options)
    found.camera.calibration = camera_calibration(found, observations)
    return found


def judged(observations: Observations, solved: Solved, options: CalibrationOptions) -> CameraCalibrationResult:
    """A solution with error bars and with what is to be doubted of it."""
    found = _result(observations, solved, options)
    doubts = rival_warnings(found.camera, found.sigma, solved.minimum, solved.plain_cost, solved.problem.residual_count)
    doubts += contradicted(solved.minimum.terms, solved.result.state, solved.views.prior_noise)
    doubts += standing_out(observations.names, _weighted_residuals(solved.problem, solved.result.state))
    return dataclasses.replace(found, warnings=(*found.warnings, *doubts))


def _weighted_residuals(problem: BoardProblem, state: State) -> Tensor:
    """(V, N, 2) of one camera, by the corners' weights; NaN where not seen."""
    residuals = problem.residuals(state).unflatten(-1, (2, -1)).transpose(-1, -2)
    return torch.where(problem.seen[:, 0, :, None], residuals, torch.nan)


def _calibrate_rejecting(
    observations: Observations, options: CalibrationOptions, rejection: OutlierRejection, progress: Progress
) -> Steps[CameraCalibrationResult]:
    """Calibrate, leave out what stands out, and calibrate again until nothing changes.

    Corners of the views that are left are judged anew in every round, so that one that was thrown out beside a worse
    one can come back. The result is that of `calibrate_camera` on what is left.
    """
    total = int(torch.isfinite(observations.pixels()).all(-1).sum())
    left = list(range(len(observations.views)))
    rejected = torch.zeros(len(left), observations.board.corners, dtype=torch.bool)
    gone: list[RejectedView] = []
    spent = 0
    for last in (*[False] * (_ROUNDS - 1), True):
        used = without(observations, left, rejected)
        solved = yield from solve(used, options, progress)
        spent += solved.spent
        every = without(observations, left, torch.zeros_like(rejected))
        if last:
            break
        residuals, steps = yield from _robust_residuals(every, solved, options)
        spent += steps
        beyond = corners_beyond(residuals)
        views = views_beyond(observations.board.points, residuals, every.pixels(), beyond)
        if not views and bool((beyond == rejected).all()):
            break
        seen, rms = torch.isfinite(every.pixels()).all(-1), view_rms(residuals, beyond)
        for i, reason in views.items():
            corners = int(seen[i].sum())
            gone.append(RejectedView(view=every.names[i], corners=corners, residual=float(rms[i]), reason=reason))
        kept = [i for i in range(len(left)) if i not in views]
        left, rejected = [left[i] for i in kept], beyond[kept]
        check_share(int(rejected.sum()) + sum(view.corners for view in gone), total, gone, rejection.limit)
        progress(f"{int(rejected.sum())} corners and {len(gone)} views left out")
    found = judged(used, dataclasses.replace(solved, spent=spent), options)
    problem = corner_problem(every, options, solved.minimum, solved.variance, None)
    plain = problem.pixel_errors(solved.result.state)[:, 0].norm(dim=-2)
    weighted = _weighted_residuals(problem, solved.result.state)
    limits = corner_limits(torch.where(rejected[..., None], torch.nan, weighted))
    corners_out = tuple(
        RejectedCorner(
            view=every.names[i],
            corner=n,
            residual=float(plain[i, n]),
            reason=f"{float(weighted[i, n].norm()):.2f} px off, noise explains {float(limits[i]):.2f} px"
            if bool(torch.isfinite(plain[i, n]))
            else "the lens model does not reach it",
        )
        for i, n in rejected.nonzero().tolist()
    )

    def spread_over(values: Tensor) -> Tensor:
        out = values.new_full((len(observations.views), *values.shape[1:]), torch.nan)
        out[left] = values
        return out

    return dataclasses.replace(
        found,
        observations=observations,
        per_view_rms=spread_over(found.per_view_rms),
        residuals=spread_over(found.residuals),
        cam_from_board_rotation=spread_over(found.cam_from_board_rotation),
        cam_from_board_translation=spread_over(found.cam_from_board_translation),
        rejected_corners=corners_out,
        rejected_views=tuple(gone),
    )


def _robust_residuals(
    observations: Observations, solved: Solved, options: CalibrationOptions
) -> Steps[tuple[Tensor, int]]:
    """Weighted residuals (V, N, 2) of all corners at a solution that a few wrong ones do not pull, and its trials.

    Infinite where the lens does not reach a corner at all.
    """
    # Poses of the views that are left, in their order.
    state, spent = solved.result.state, 0
    whole = corner_problem(observations, options, solved.minimum, solved.variance, None)
    for _ in range(_CAUCHY_ROUNDS):
        residuals = _weighted_residuals(whole, state)
        reached = torch.isfinite(residuals).all(-1)
        some = without(observations, range(len(observations.views)), whole.seen[:, 0] & ~reached)
        scale = max(_CAUCHY_SCALE * float(noise_scale(residuals.flatten(0, 1))), 1e-3)
        loss = RobustLoss(kind="cauchy", scale=scale)
        result = yield Solve(corner_problem(some, options, solved.minimum, solved.variance, loss), state, _ROUGH)
        spent += int(result.iterations)
        if result.status == Status.BAD_START:
            break
        state = result.state
    residuals = _weighted_residuals(whole, state)
    unreached = whole.seen[:, 0] & ~torch.isfinite(residuals).all(-1)
    return torch.where(unreached[..., None], torch.inf, residuals), spent


def _result(observations: Observations, found: Solved, options: CalibrationOptions) -> CameraCalibrationResult:
    problem, solved, model = found.problem, found.result, options.lens
    state = problem.tidy(solved.state)
    # A lens may fold just where a corner is: there rounding decides whether it has an image.
    if not bool(torch.isfinite(problem.cost(state))):
        state = solved.state
    s = problem.unpack(state)
    pixels = observations.pixels()
    camera = Camera(s.parameters[0], size=observations.image_size, model=model)
    residuals = problem.pixel_errors(state)[:, 0].transpose(-1, -2)
    seen = torch.isfinite(pixels).all(-1)
    squared = (residuals**2).sum(-1)
    per_view = torch.sqrt(squared.sum(-1) / seen.sum(-1))
    rms = float(torch.sqrt(squared.sum() / seen.sum()))
    uncertainty, doubts = _uncertainty(observations, found, options, state)
    free = problem.free[0]
    rules = options.rules(observations.image_size)
    held = tuple(name for name in camera.names if name in rules.fixed)
    slot = {camera.names[i]: k for i, k in zip(free.indices, free.slots, strict=True)}
    names = [" = ".join(name for name in slot if slot[name] == k) for k in range(len(free))]
    known, determined = uncertainty.determined.tolist(), uncertainty.determined
    if uncertainty.computed:
        check_focal({name: float(uncertainty.sigma[k]) for name, k in slot.items()}, s.parameters[0])
    else:
        # Unknown is not the same as undetermined by the views.
        determined = torch.ones_like(determined)
        doubts = [NO_ERROR_BARS, *doubts]
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
            name: float(uncertainty.sigma[slot[name]]) if name in slot and known[slot[name]] else None
            for name in camera.names
            if name in slot or name in held
        },
        fixed=held,
        led_by_prior=_led_by_prior(found, camera.names, slot, uncertainty),
        status=status,
        iterations=found.spent,
        covariance=_by_parameter(uncertainty, free, len(camera.names)),
        warnings=(*warnings_of(observations, camera, rms, per_view, determined, names, status), *doubts),
        observations=observations,
    )


def _uncertainty(
    observations: Observations, found: Solved, options: CalibrationOptions, state: State
) -> tuple[Uncertainty, list[str]]:
    """Covariance of the unknowns, and what a second opinion says of a rich model."""
    minimum, model = found.minimum, options.lens
    if not found.problem.shared_size:
        # Under a known camera and a flat board nothing is shared by the views.
        return Uncertainty(state[0].new_zeros(0, 0), torch.zeros(0, dtype=torch.bool)), []

    def problem_with(*terms: Term) -> BoardProblem:
        changed = dataclasses.replace(minimum, terms=terms)
        return corner_problem(observations, options, changed, found.variance, options.loss)

    # Walls before folds are no information about the lens.
    known = [term for term in minimum.terms if isinstance(term, Prior)]
    plain = problem_with(*known)
    linear, count = plain.linearize(state), plain.shared_size + 6 * len(state[-1])
    own = uncertainty_of(linear, plain.residual_count + plain.prior_count, count)
    unquestioned = options.weak_prior is not None or options.camera is not None or not minimum.rivals
    if not own.computed or not is_overparameterized(model) or unquestioned:
        return own, []
    noise = max((2.0 * float(linear.cost) / plain.residual_count) ** 0.5, LEAST_NOISE)
    start = minimum.rivals[0][1]
    mild = problem_with(*known, weak_prior_term(found.views, start, model, noise))
    opinion = compare_with_prior(found.views, mild, plain, start, state, own)
    return (own, []) if opinion is None else (opinion.uncertainty, comparison_warnings(opinion))


def _led_by_prior(
    found: Solved, names: Sequence[str], slot: Mapping[str, int], uncertainty: Uncertainty
) -> tuple[str, ...]:
    """Parameters whose variance would more than double without their prior."""
    led = []
    for term in found.minimum.terms:
        if isinstance(term, Prior):
            spread = found.views.prior_noise / term.weight
            for index, sigma in zip(term.index.tolist(), spread.tolist(), strict=True):
                if float(uncertainty.sigma[slot[names[index]]]) ** 2 > 0.5 * sigma**2:
                    led.append(names[index])
    return tuple(led)


def _by_parameter(uncertainty: Uncertainty, free: Free, count: int) -> Tensor:
    """(5 + P, 5 + P) from that of the unknowns: tied parameters alike, held ones exact."""
    out = uncertainty.covariance.new_zeros(count, count)
    slots, indices = torch.tensor(free.slots, dtype=torch.long), torch.tensor(free.indices, dtype=torch.long)
    out[indices[:, None], indices] = uncertainty.covariance[slots[:, None], slots]
    return out
