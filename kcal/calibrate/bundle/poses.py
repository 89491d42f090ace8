"""Board poses under known cameras: refining each view alone, and finding those that settled in the wrong tilt."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from kcal.calibrate.bundle.batching import Solve, Steps, alone
from kcal.calibrate.bundle.board_problem import BoardProblem
from kcal.calibrate.bundle.closed_form import flipped_poses
from kcal.lens.model import LensModel
from kcal.lens.residual import Field
from kcal.solve.lm import LMOptions
from kcal.solve.result import State

# Enough to tell which of two tilts fits; what is chosen is refined with everything else afterwards.
_ROUGH = LMOptions(max_iterations=10, tolerance=1e-4)
# After so many steps a twin that is still this many times worse has no chance, which is true of most.
_GLANCE = LMOptions(max_iterations=4, tolerance=1e-4)
_HOPELESS = 30.0


def refine_poses(
    board_points: Tensor,
    pixels: Tensor,
    models: list[LensModel],
    state: State,
    options: LMOptions,
    fields: Sequence[Field | None] = (),
    whitening: Tensor | None = None,
) -> tuple[State, Tensor]:
    """Minimize over each view's board pose alone, everything else held.

    Args:
        board_points: (N, 3).
        pixels: (V, C, N, 2).
        models: one lens model a camera.
        state: as `BoardState.pack` gives it.
        options: of the solver.
        fields: what corrects each lens, see `BoardProblem`.
        whitening: (V, C, N, 2, 2) weights of the corners, see `BoardProblem`.

    Returns:
        the state with refined board poses, and the cost of each view (V,); NaN where a start had none.
    """
    return alone(refining(board_points, pixels, models, state, options, fields, whitening))


def refining(
    board_points: Tensor,
    pixels: Tensor,
    models: list[LensModel],
    state: State,
    options: LMOptions,
    fields: Sequence[Field | None] = (),
    whitening: Tensor | None = None,
) -> Steps[tuple[State, Tensor]]:
    """`refine_poses` as steps of a calibration."""
    views = len(pixels)
    problem = BoardProblem(
        board_points,
        pixels[:, None],
        models,
        [() for _ in models],
        whitening=None if whitening is None else whitening[:, None],
        fields=fields,
        batch=(views,),
    )
    *shared, rotation, translation = state
    start = (*(t.expand(views, *t.shape) for t in shared), rotation[:, None], translation[:, None])
    result = yield Solve(problem, start, options)
    *_, rotation, translation = result.state
    return (*shared, rotation[:, 0], translation[:, 0]), result.cost


def unflip(
    board_points: Tensor,
    pixels: Tensor,
    models: list[LensModel],
    state: State,
    fields: Sequence[Field | None] = (),
) -> tuple[State, list[int]]:
    """Replace every board pose whose twin with the opposite tilt fits better (see `flipped_poses`).

    A view far away or nearly face-on has two poses of almost equal cost, and a solver that starts at the wrong one
    stays there: measured on 200 and more views, one or two such views raise the RMS of a whole calibration by up to
    a quarter.

    Args:
        board_points: (N, 3).
        pixels: (V, C, N, 2).
        models: one lens model a camera.
        state: with board poses that are already refined.
        fields: what corrects each lens, see `BoardProblem`.

    Returns:
        the state with the better poses, roughly refined, and the indices of the views that changed.
    """
    return alone(unflipping(board_points, pixels, models, state, fields))


def unflipping(
    board_points: Tensor,
    pixels: Tensor,
    models: list[LensModel],
    state: State,
    fields: Sequence[Field | None] = (),
) -> Steps[tuple[State, list[int]]]:
    """`unflip` as steps of a calibration."""
    problem = BoardProblem(board_points, pixels, models, [() for _ in models], fields=fields)
    cost = 0.5 * (problem.residuals(state) ** 2).sum(-1)
    flipped = flipped_poses(board_points, state)
    twin, cost_twin = yield from refining(board_points, pixels, models, flipped, _GLANCE, fields)
    near = (cost_twin < _HOPELESS * cost).nonzero()[:, 0]
    *shared, rotation, translation = state
    if not len(near):
        return state, []
    start = (*shared, twin[-2][near], twin[-1][near])
    twin, cost_twin = yield from refining(board_points, pixels[near], models, start, _ROUGH, fields)
    better = cost_twin < 0.999 * cost[near]
    changed = near[better]
    rotation, translation = rotation.clone(), translation.clone()
    rotation[changed], translation[changed] = twin[-2][better], twin[-1][better]
    return (*shared, rotation, translation), changed.tolist()
