"""Calibration as a layer of a network: from corners to a camera, with gradients through the solution."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor

from kcal.calibrate.camera.advice import check_directions
from kcal.calibrate.camera.result import CalibrationOptions
from kcal.calibrate.camera.solve import solve_corners
from kcal.calibrate.hybrid.fit import HybridFit, fit_hybrid
from kcal.calibrate.hybrid.measured_board import MeasuredBoard
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.parameters import CoefficientPrior, GaussianPrior, Term, is_overparameterized
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import Views, noise_variance, uncertainty_of
from kcal.checks import StatedModule, as_points, as_tensor, require_finite
from kcal.dispatch import is_differentiated
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.lens.projection import parameter_names, project_components
from kcal.solve.hessian import HessianSolve, implicit_step, newton_minimum
from kcal.solve.lm import LMOptions, map_state
from kcal.texts import brief
from kcal.threads import in_one_thread

# A minimum to rounding with its exact Hessian, for derivatives; or the reason why there is none.

_POLISH = LMOptions(max_iterations=200, tolerance=1e-13)


def exact_minimum(problem: BoardProblem, state: BoardState) -> tuple[BoardState, HessianSolve]:
    """The minimum next to a state to rounding, and systems with the Hessian there.

    Raises:
        DegenerateError: there is none, or the views do not determine a parameter.
    """
    state, found = newton_minimum(problem, state, _POLISH)
    if problem.shared_size:
        count = problem.shared_size + found.zero[1].numel()
        known = uncertainty_of(found.linear, float(noise_variance(found.linear, problem.residual_count, count)))
        names = [*problem.free.labels(parameter_names(problem.model)), *(["the board's warp"] * 2)]
        lost = [name for name, sure in zip(names, known.determined.tolist(), strict=False) if not sure]
        if lost:
            raise DegenerateError(
                f"the views do not determine {', '.join(dict.fromkeys(lost))}, and the solution has no derivatives: "
                "fix parameters, choose a smaller model, add views or priors"
            )
        spread = problem.free.by_parameter(known.matrix, len(state.parameters))
        check_directions(state.parameters, problem.model, problem.points(state), problem.seen, spread, state.rotation)
    return state, found


# A camera's minimum as tensors of autograd's graph: the parametric problem's and the default lens's alike.

Backward = Literal["implicit", "unroll", "none"]
# A problem of detached or of differentiable data.
ProblemOf = Callable[..., BoardProblem]

# Steps that are recorded by backward="unroll"; each multiplies the error of the derivative by the share of the
# curvature that the Gauss-Newton approximation omits.
_UNROLLED = 8


def differentiated(
    problem_of: ProblemOf, data: tuple[Tensor, ...], state: BoardState, found: HessianSolve, backward: Backward
) -> BoardState:
    """A minimum with its derivatives by the data.

    Args:
        problem_of: makes the problem of data.
        data: which may require gradients.
        state: the minimum, detached.
        found: systems with the Hessian there.
        backward: "implicit" (exact first derivatives), "unroll" (recorded steps, derivatives of any order) or "none".
    """
    if backward == "unroll":
        recorded = problem_of(*data)
        for _ in range(_UNROLLED):
            step, _ = recorded.linearize(state).step(found.zero[0].new_zeros(()))
            state = recorded.retract(state, step)
    elif backward == "implicit" and is_differentiated(*data):
        problem, here = problem_of(*(tensor.detach() for tensor in data)), state

        def cost(shared: Tensor, local: Tensor, *values: Tensor) -> Tensor:
            return problem_of(*values).cost(problem.retract(here, (shared, local)))

        state = problem.retract(state, implicit_step(cost, found, data))
    return state


# Calibration as a layer of a network: from corners to a camera, with gradients through the solution.

# Pixels of a corner's noise along an axis, against which priors of parametric models count.
_CORNER_SIGMA = 0.2


@dataclasses.dataclass(frozen=True, kw_only=True)
class CalibratedViews:
    """A camera and the poses of its boards, as tensors of autograd's graph, on the device of the corners.

    Args:
        parameters: (5 + P,) fx, fy, cx, cy, skew, coefficients.
        board_warp: (2,) meters; zeros unless it is estimated.
        cam_from_board_rotation: (V, 3, 3).
        cam_from_board_translation: (V, 3) meters.
        residuals: (V, N, 2) projected minus observed, pixels; 0 where a corner was not seen.
        model: the lens model.
        size: (width, height) of the image.
        reach: radius on the plane z = 1 of the outermost corner, to which a weak prior refers.
        fit: with the default lens, the fit that set its amplitudes.
        hybrid: likewise, the state of camera, board, poses and motions under these.
    """

    __repr__ = brief

    parameters: Tensor
    board_warp: Tensor
    cam_from_board_rotation: Tensor
    cam_from_board_translation: Tensor
    residuals: Tensor
    model: LensModel
    size: tuple[int, int]
    reach: float
    fit: HybridFit | None = None
    hybrid: BoardState | None = None

    def project(self, points_cam: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (..., N, 2) of points (..., N, 3) of the camera's frame, and whether the lens is regular there.

        Differentiable by the parameters and the points; 0 where it is not regular.
        """
        points = as_points("points_cam", points_cam, 3).transpose(-1, -2)
        seen = project_components(points, self.parameters, self.model)
        return torch.where(seen.regular[..., None, :], seen.pixels, 0.0).transpose(-1, -2), seen.regular

    def camera(self, *, differentiable: bool = False) -> Camera:
        """The camera; `differentiable`: in the graph, so that what is computed with it has gradients by the corners.

        A differentiable camera has its parameters as a buffer: it is no leaf, so that an optimizer does not move it and
        `deepcopy` refuses it.
        """
        camera = Camera(self.parameters.detach(), size=self.size, model=self.model)
        return camera.attached(self.parameters) if differentiable else camera

    def to(self, device: torch.device | str) -> CalibratedViews:
        """The same on another device; `fit` and `hybrid`, from which a next calibration starts, stay on the CPU."""
        moved: dict[str, Any] = {n: own.to(device) for n, own in vars(self).items() if isinstance(own, Tensor)}
        return dataclasses.replace(self, **moved)

    def state(self) -> BoardState:
        """As a state of `BoardProblem`, out of the graph."""
        pose = self.cam_from_board_rotation, self.cam_from_board_translation
        return map_state(lambda part: part.detach().cpu(), BoardState.still(self.parameters, self.board_warp, *pose))


@in_one_thread
def calibrate_views(
    pixels: Tensor,
    board_points: Tensor,
    size: tuple[int, int],
    options: CalibrationOptions | None = None,
    *,
    mask: Tensor | None = None,
    prior_means: Tensor | None = None,
    corner_sigma: float | None = None,
    start: CalibratedViews | None = None,
    backward: Backward = "implicit",
) -> CalibratedViews:
    """Calibrate one camera, with gradients by the corners, the board's points and the means of the priors.

    With the default lens, the corners themselves tell amplitudes of lens, board and motion, and the noise; these count
    as constants of the gradient, and a start keeps them.

    With a parametric model the solution x minimizes
    c(x) = ½ Σ ρ(‖projected - observed‖²) + ½ Σ (corner_sigma / σ_k)² (x_k - mean_k)², where all corners count alike; a
    weak prior adds such terms for the coefficients, for the outermost corner that was found.

    "implicit" differentiates the condition ∂c/∂x = 0: dx/dd = -H⁻¹ ∂²c/∂x∂d with the exact Hessian H of c, which
    includes the curvature of residuals and of the robust loss; systems with it are solved by conjugate gradients. Work
    and memory grow linearly with the views, and nothing is computed before a gradient is requested.
    "unroll" records eight Gauss-Newton steps at the solution: nearly the same derivatives, and of any order. "none"
    carries no gradient.

    The work is done on the CPU, whose small, dense systems are no work for a GPU; what is found, and the gradients, are
    on the device of the corners.

    Args:
        pixels: (V, N, 2) corners; NaN where not seen.
        board_points: (N, 3) meters, in the order of the corners, near the plane z = 0. A board's warp is as wide as
            its outermost corners; where several tie, they share the derivative of that width.
        size: (width, height) of the image in pixels.
        options: as for `calibrate_camera`; `reject` is refused, because leaving out corners is not continuous.
        mask: (V, N) bool, which corners count; None: those that are finite.
        prior_means: (Q,) in the order of `options.priors`, in place of their means.
        corner_sigma: with a parametric model, pixels of a corner's noise along an axis, against which priors count, 0.2
            if left out. Given, not measured, so that the cost is a function of the data alone.
        start: an earlier solution of nearly the same data, in place of the search, for training loops. The result is
            the minimum next to it.
        backward: see above.

    Returns:
        The camera and the poses. Apart from rounding, values do not depend on `backward`.

    Raises:
        InputError: wrong shapes or values.
        DegenerateError: too few views, or no derivative, because the data do not determine a parameter, or because the
            solution is a saddle or at a barrier. Fix parameters, choose a smaller model, or add priors.

    Example:
        >>> from kcal import Board
        >>> from kcal.lens import rotation_from_vector
        >>> board = Board(columns=7, rows=6, square=0.05).points
        >>> truth = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> tilts = torch.tensor([[0.5, 0, 0], [-0.5, 0.1, 0], [0, 0.5, 0.2], [0.1, -0.5, 0]], dtype=torch.float64)
        >>> shift = torch.tensor([-0.15, -0.14, 0.7], dtype=torch.float64)
        >>> pixels, _ = truth.project(board @ rotation_from_vector(tilts).transpose(-1, -2) + shift)
        >>> pixels = pixels.requires_grad_(True)
        >>> found = calibrate_views(pixels, board, (640, 480), CalibrationOptions(model="pinhole"))
        >>> (by_pixels,) = torch.autograd.grad(found.parameters[2], pixels)  # of cx
        >>> [round(float(value), 9) + 0.0 for value in by_pixels.sum((0, 1))]  # all corners one pixel to the right
        [1.0, 0.0]
    """
    options = options or CalibrationOptions()
    checked = _checked(pixels, board_points, options, mask, prior_means, corner_sigma, backward)
    device, (pixels, board_points, means) = checked[0].device, (tensor.cpu() for tensor in checked)
    if start is not None and (start.hybrid is not None) != options.hybrid:
        raise InputError("calibrate_views: the start is of another lens model")
    fit: HybridFit | None = None
    data = (pixels, board_points) if options.hybrid else (pixels, board_points, means)
    fixed = tuple(tensor.detach() for tensor in data)
    if options.hybrid:
        problem_of, begin, fit = _default_problem(fixed, size, options, start)
        state, found = newton_minimum(problem_of(*fixed), begin, _POLISH)
        placed = fixed[1] @ state.rotation.mT + state.translation[:, None]
        angle = torch.atan2(placed[..., :2].norm(dim=-1), placed[..., 2])
        reach = float(torch.where(torch.isfinite(pixels).all(-1), angle, 0.0).max())
    else:
        sigma = _CORNER_SIGMA if corner_sigma is None else corner_sigma
        problem_of, begin, reach = _parametric_problem(fixed, size, options, sigma, start)
        problem = problem_of(*fixed)
        state, found = exact_minimum(problem, problem.tidy(begin))
    state = differentiated(problem_of, data, state, found, backward)
    at = problem_of(*(fixed if backward == "none" else data))
    return CalibratedViews(
        parameters=state.parameters,
        board_warp=state.board if fit is None else state.parameters.new_zeros(2),
        cam_from_board_rotation=state.rotation,
        cam_from_board_translation=state.translation,
        residuals=at.pixel_errors(state).transpose(-1, -2),
        model=options.lens if fit is None else fit.model,
        size=size,
        reach=reach,
        fit=fit,
        hybrid=None if fit is None else state,
    ).to(device)


def _parametric_problem(
    data: tuple[Tensor, ...],
    size: tuple[int, int],
    options: CalibrationOptions,
    sigma: float,
    start: CalibratedViews | None,
) -> tuple[ProblemOf, BoardState, float]:
    """The problem of data with a parametric model, where to begin, and the radius of the outermost corner."""
    pixels, board_points, means = data
    constraints = options.constraints(size)
    known = [parameter_names(options.lens).index(name) for name in options.priors]
    weights = torch.tensor([sigma / spread for _, spread in options.priors.values()], dtype=torch.float64)

    def problem_of(corners: Tensor, board: Tensor, mean: Tensor) -> BoardProblem:
        terms: list[Term] = [GaussianPrior(torch.tensor(known), mean, weights)] if known else []
        if options.weak_prior is not None and options.camera is None and is_overparameterized(options.lens):
            prior = CoefficientPrior(options.weak_prior, reach)
            terms.append(prior.term(options.lens, sigma, {*options.fixed, *options.priors}))
        views = Views(board_points=board, pixels=corners, loss=options.loss, free_warp=options.board_warp)
        return views.problem(options.lens, constraints.free_parameters(options.lens), terms=terms)

    if start is None:
        priors = {n: (float(m), s) for (n, (_, s)), m in zip(options.priors.items(), means, strict=True)}
        changed = dataclasses.replace(options, priors=priors)
        begin = solve_corners(board_points, pixels, size, changed, lambda _: None).result.state
        reach = Views(board_points=board_points, pixels=pixels).observed_radius(begin)
    else:
        begin, reach = start.state(), start.reach
        if start.model != options.lens or len(begin.translation) != len(pixels):
            raise InputError("calibrate_views: the start is of another lens model or another number of views")
    return problem_of, begin, reach


def _default_problem(
    data: tuple[Tensor, ...], size: tuple[int, int], options: CalibrationOptions, start: CalibratedViews | None
) -> tuple[ProblemOf, BoardState, HybridFit]:
    """The problem of data with the default lens, where to begin, and the fit whose amplitudes are held.

    Amplitudes of lens, board and motions, and the noise, come from the evidence of the corners, or from the start; they
    count as constants of the gradient, which is that of the most probable camera under them.
    """
    pixels, board_points = data
    if isinstance(options.board, MeasuredBoard):
        raise InputError("calibrate_views: a measured board has no gradients; give its corners as board_points")
    if start is None or start.fit is None or start.hybrid is None:
        fit = fit_hybrid(board_points, pixels, size, options=options.of_fit(size))
        begin = fit.state
    else:
        fit, begin = start.fit, BoardState(*(part.detach() for part in start.hybrid))
        if len(begin.translation) != len(pixels):
            raise InputError("calibrate_views: the start is of another number of views")
    families = fit.families
    precision = fit.sigma**2 / families.deviation(fit.expected).square()
    if options.board == "exact":
        precision[-len(fit.board_shapes.unit) :] = torch.inf

    def problem_of(corners: Tensor, points: Tensor) -> BoardProblem:
        return fit.problem(points, corners, torch.ones_like(corners[..., 0]), families.mean, precision)

    return problem_of, begin, fit


class CalibrationLayer(StatedModule):
    """`calibrate_views` as a module: calibrates in its forward pass, carries gradients in its backward pass.

    Args:
        size: (width, height) of the image in pixels.
        options: as for `calibrate_camera`; the default lens if left out.
        backward: "implicit" (exact first derivatives), "unroll" (derivatives of any order, more memory) or "none".
        corner_sigma: with a parametric model, pixels of a corner's noise along an axis, against which priors count.

    Convention: float64 whatever comes in; half precision of the network around it stays outside.

    Example:
        >>> layer = CalibrationLayer((640, 480), CalibrationOptions(model="pinhole"), backward="none")
        >>> layer
        CalibrationLayer(size=(640, 480), model=pinhole, backward=none)
    """

    def __init__(
        self,
        size: tuple[int, int],
        options: CalibrationOptions | None = None,
        *,
        backward: Backward = "implicit",
        corner_sigma: float | None = None,
    ) -> None:
        super().__init__()
        self.size, self.options = size, options or CalibrationOptions()
        self.backward, self.corner_sigma = backward, corner_sigma

    def forward(
        self,
        pixels: Tensor,
        board_points: Tensor,
        mask: Tensor | None = None,
        prior_means: Tensor | None = None,
        start: CalibratedViews | None = None,
    ) -> CalibratedViews:
        """See `calibrate_views`."""
        return calibrate_views(
            pixels,
            board_points,
            self.size,
            self.options,
            mask=mask,
            prior_means=prior_means,
            corner_sigma=self.corner_sigma,
            start=start,
            backward=self.backward,
        )

    @property
    def constants(self) -> object:
        """All that it is made with."""
        return self.size, vars(self.options), self.backward, self.corner_sigma

    def __call__(self, *args: Any, **kwargs: Any) -> CalibratedViews:
        """See `forward`."""
        result: CalibratedViews = super().__call__(*args, **kwargs)
        return result

    def extra_repr(self) -> str:
        """One line for people."""
        return f"size={self.size}, model={self.options.model}, backward={self.backward}"


def _checked(
    pixels: Tensor,
    board_points: Tensor,
    options: CalibrationOptions,
    mask: Tensor | None,
    prior_means: Tensor | None,
    corner_sigma: float | None,
    backward: str,
) -> tuple[Tensor, Tensor, Tensor]:
    """Corners (NaN where they do not count), board points and prior means as float64."""
    if backward not in ("implicit", "unroll", "none"):
        raise InputError(f"calibrate_views: backward must be implicit, unroll or none, got {backward!r}")
    if backward != "none" and is_differentiated(options.camera):
        raise InputError(
            "calibrate_views: there are no derivatives by the parameters that options.camera holds; freeze it with "
            "requires_grad_(False)"
        )
    if options.reject is not None:
        raise InputError("calibrate_views: `reject` is not continuous; use a robust loss or a mask")
    if corner_sigma is not None and options.hybrid:
        raise InputError("calibrate_views: the default lens measures the noise of corners; leave corner_sigma out")
    if corner_sigma is not None and not 0 < corner_sigma < float("inf"):
        raise InputError(f"calibrate_views: corner_sigma must be positive pixels, got {corner_sigma}")
    pixels, board_points = as_points("pixels", pixels, 2), as_points("board_points", board_points, 3)
    if pixels.ndim != 3 or board_points.ndim != 2 or pixels.shape[1] != len(board_points):
        raise InputError(
            f"calibrate_views: pixels (V, N, 2) and board points (N, 3) are needed, got {tuple(pixels.shape)} and "
            f"{tuple(board_points.shape)}"
        )
    require_finite("board_points", board_points)
    if mask is not None:
        mask = torch.as_tensor(mask)
        if mask.shape != pixels.shape[:-1] or mask.dtype != torch.bool:
            raise InputError(f"calibrate_views: the mask must be bool {tuple(pixels.shape[:-1])}")
        if not bool(torch.isfinite(pixels[mask]).all()):
            raise InputError("calibrate_views: the mask includes corners that are not finite")
        pixels = torch.where(mask[..., None], pixels, torch.nan)
    if prior_means is None:
        prior_means = pixels.new_tensor([mean for mean, _ in options.priors.values()])
    prior_means = as_tensor("prior_means", prior_means)
    if prior_means.shape != (len(options.priors),):
        raise InputError(
            f"calibrate_views: {len(options.priors)} prior means are needed, got shape {tuple(prior_means.shape)}"
        )
    return pixels, board_points, prior_means.to(torch.float64)
