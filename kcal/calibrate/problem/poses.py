"""Board poses under a known camera: find and refine each view alone, and correct those that stopped at a wrong tilt."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.calibrate.problem.closed_form import flipped_poses, homographies, poses_from_homographies, spread_out
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import Views
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.solve.lm import LMOptions, minimize

# Enough to tell which of two tilts fits; the chosen one is refined with everything else afterwards.
_ROUGH = LMOptions(max_iterations=10, tolerance=1e-4)
# Most flipped poses are still this many times worse after four steps, and are dropped.
_FIRST_STEPS = LMOptions(max_iterations=4, tolerance=1e-4)
_HOPELESS = 30.0


def poses_under(camera: Camera, views: Views, options: LMOptions) -> tuple[BoardState, Tensor]:
    """Find each view's board pose under a known camera: in closed form from its rays, refined, with both tilts tried.

    Args:
        camera: a single camera; it stays as it is.
        views: V views of a board.
        options: of the solver.

    Returns:
        the state, and the cost of each view (V,) as in `refine_poses`. Both are NaN for a view whose corners with a ray
        do not determine a homography (`spread_out`).
    """
    ideal, valid = camera.normalize(views.pixels)
    ideal = torch.where(valid[..., None], ideal, torch.nan)
    good = spread_out(views.board_points, ideal).nonzero()[:, 0]
    count = len(views.pixels)
    rotation, translation = ideal.new_full((count, 3, 3), torch.nan), ideal.new_full((count, 3), torch.nan)
    cost = ideal.new_full((count,), torch.nan)
    if len(good):
        some, model = views.some(good), camera.model
        pinhole = torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64)
        poses = poses_from_homographies(homographies(views.board_points, ideal[good]), pinhole)
        state, cost[good] = refine_poses(some, model, BoardState.flat(camera.params.detach(), *poses), options)
        state, flipped = unflip(some, model, state)
        if flipped:
            state, cost[good] = refine_poses(some, model, state, options)
        rotation[good], translation[good] = state.rotation, state.translation
    return BoardState.flat(camera.params.detach(), rotation, translation), cost


def refine_poses(views: Views, model: LensModel, state: BoardState, options: LMOptions) -> tuple[BoardState, Tensor]:
    """Minimize over each view's board pose alone, with everything else held.

    Args:
        views: V views of a board.
        model: the lens model.
        state: whose poses are the initial ones.
        options: of the solver.

    Returns:
        the state with refined board poses, and the cost of each view (V,), without a robust loss; NaN where the initial
        pose had none.
    """
    count, weights = len(views.pixels), views.whitening
    each = Views(
        board_points=views.board_points,
        pixels=views.pixels[:, None],
        whitening=None if weights is None else weights[:, None],
    )
    camera = state.parameters.expand(count, -1), state.board.expand(count, -1)
    start = BoardState.still(*camera, state.rotation[:, None], state.translation[:, None])
    result = minimize(each.problem(model, batch=(count,)), start, options)
    poses = result.state
    return state._replace(rotation=poses.rotation[:, 0], translation=poses.translation[:, 0]), result.cost


def unflip(views: Views, model: LensModel, state: BoardState) -> tuple[BoardState, list[int]]:
    """Replace every board pose whose counterpart with the opposite tilt fits better (see `flipped_poses`).

    A view from far away or nearly face-on has two poses of almost equal cost, and a solver that starts at the wrong one
    stays there. In 200 and more measured views, one or two such views raise the RMS of a whole calibration by up to a
    quarter.

    Args:
        views: V views of a board.
        model: the lens model.
        state: with board poses that are already refined.

    Returns:
        the state with the better poses, roughly refined, and the indices of the views that changed.
    """
    cost = 0.5 * (views.problem(model).residuals(state) ** 2).sum(-1)
    rotation, translation = flipped_poses(views.board_points, state.rotation, state.translation)
    flipped = state._replace(rotation=rotation, translation=translation)
    flipped, flipped_cost = refine_poses(views, model, flipped, _FIRST_STEPS)
    near = (flipped_cost < _HOPELESS * cost).nonzero()[:, 0]
    if not len(near):
        return state, []
    flipped, flipped_cost = refine_poses(views.some(near), model, flipped.views(near), _ROUGH)
    better = flipped_cost < 0.999 * cost[near]
    changed = near[better]
    rotation, translation = state.rotation.clone(), state.translation.clone()
    rotation[changed], translation[changed] = flipped.rotation[better], flipped.translation[better]
    return state._replace(rotation=rotation, translation=translation), changed.tolist()
