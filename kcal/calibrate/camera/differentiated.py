"""A camera's minimum as tensors of autograd's graph: the parametric problem's and the default lens's alike."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor

from kcal.calibrate.camera.options import CalibrationOptions
from kcal.calibrate.hybrid.fit import HybridFit, fit_hybrid
from kcal.calibrate.hybrid.measured_board import MeasuredBoard
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.state import BoardState
from kcal.dispatch import is_differentiated
from kcal.errors import InputError
from kcal.solve.hessian import HessianSolve, implicit_step, newton_minimum
from kcal.solve.lm import LMOptions

Backward = Literal["implicit", "unroll", "none"]
S = TypeVar("S")
# A problem of detached or of differentiable data.
ProblemOf = Callable[..., Any]

# Steps that are recorded by backward="unroll"; each multiplies the error of the derivative by the share of the
# curvature that the Gauss-Newton approximation omits.
_UNROLLED = 8
_POLISH = LMOptions(max_iterations=200, tolerance=1e-13)


def differentiated(
    problem_of: ProblemOf, data: tuple[Tensor, ...], state: S, found: HessianSolve, backward: Backward
) -> S:
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
            value: Tensor = problem_of(*values).cost(problem.retract(here, (shared, local)))
            return value

        state = problem.retract(state, implicit_step(cost, found, data))
    return state


def hybrid_views(
    pixels: Tensor,
    board_points: Tensor,
    size: tuple[int, int],
    options: CalibrationOptions,
    start: tuple[HybridFit, BoardState] | None,
    backward: Backward,
) -> tuple[BoardState, Tensor, HybridFit]:
    """The default camera, with gradients by the corners and the board's points.

    Amplitudes of lens, board and motions, and the noise, come from the evidence of the corners, or from the start; they
    count as constants of the gradient, which is that of the most probable camera under them.

    Args:
        pixels: (V, N, 2), NaN where not seen.
        board_points: (N, 3) meters.
        size: (width, height) of the image.
        options: with the hybrid lens.
        start: fit and state of nearly the same data, whose amplitudes are kept.
        backward: see `differentiated`.

    Returns:
        the state; residuals (V, N, 2) projected minus observed, pixels, 0 where a corner was not seen; and the fit
        whose amplitudes and noise were held.
    """
    if isinstance(options.board, MeasuredBoard):
        raise InputError("calibrate_views: a measured board has no gradients; give its corners as board_points")
    data = (pixels, board_points)
    fixed = tuple(tensor.detach() for tensor in data)
    if start is None:
        fit = fit_hybrid(
            fixed[1], fixed[0], size, modes=options.modes, board=options.board, motion=options.motion,
            focal=options.start_focal(size), training=None if options.modes is None else options.training,
        )  # fmt: skip
        begin = fit.state
    else:
        fit, begin = start[0], BoardState(*(part.detach() for part in start[1]))
    families = fit.families
    precision = fit.sigma**2 / families.deviation(fit.expected).square()
    if options.board == "exact":
        precision[-len(fit.board_shapes.unit) :] = torch.inf

    def problem_of(corners: Tensor, points: Tensor) -> BoardProblem:
        weights = torch.ones_like(corners[..., 0])
        return fit.problem(points, corners, weights, families.mean, precision)

    state, found = newton_minimum(problem_of(*fixed), begin, _POLISH)
    state = differentiated(problem_of, data, state, found, backward)
    at = problem_of(*(fixed if backward == "none" else data))
    return state, at.pixel_errors(state).transpose(-1, -2), fit
