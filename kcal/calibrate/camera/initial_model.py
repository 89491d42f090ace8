"""Initial values: closed forms and the simplest model, or board poses under a known camera."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from kcal.calibrate.bundle.batching import minimize
from kcal.calibrate.bundle.board_problem import BoardState
from kcal.calibrate.bundle.closed_form import (
    homographies,
    intrinsics_candidates,
    poses_from_homographies,
    radial_start,
)
from kcal.calibrate.bundle.poses import poses_under, unflip
from kcal.calibrate.bundle.views import CameraViews
from kcal.calibrate.camera.checks import least_planar
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.lens.projection import INTRINSICS
from kcal.solve.lm import LMOptions
from kcal.solve.result import SolverStatus

# A first fit worse than this many pixels is retried from other focal lengths.
_SUSPICIOUS_RMS = 2.0


def first_model(
    views: CameraViews, model: LensModel, focal: float | None, solver: LMOptions, names: Sequence[str]
) -> tuple[BoardState, BoardState, int]:
    """Solve the first model from closed forms.

    Args:
        views: the data.
        model: the first model.
        focal: a focal length to try first, or None.
        solver: options.
        names: of the views, for the message.

    Returns:
        the solution, the initial state without distortion, and the trial steps spent.
    """
    homography = homographies(views.board_points, views.pixels)
    candidates = intrinsics_candidates(homography, views.size)
    if focal is not None:
        center = [(views.size[0] - 1) / 2, (views.size[1] - 1) / 2]
        candidates.insert(0, torch.tensor([focal, focal, *center], dtype=torch.float64))
    problem, impose = views.lens_problem(model), views.constraints.impose
    best: tuple[float, BoardState, BoardState] | None = None
    spent = 0
    for candidate in candidates:
        zero = torch.zeros(len(INTRINSICS) + model.size, dtype=torch.float64)
        zero[:4] = candidate
        zero = impose(zero, model)
        poses = poses_from_homographies(homography, zero[:4])
        undistorted = BoardState.flat(zero, *poses)
        lens = zero.clone()
        if model.numerator >= 2:
            k1, k2 = (len(INTRINSICS) + i for i in model.numerator_index[:2])
            lens[[k1, k2]] = radial_start(views.board_points, views.pixels, zero[:4], *poses)
        for parameters in (impose(lens, model), zero):
            result = minimize(problem, undistorted._replace(parameters=parameters), solver)
            spent += int(result.iterations)
            if result.status != SolverStatus.BAD_START:
                break
        state, flipped = unflip(views, model, result.state)
        if flipped:
            result = minimize(problem, state, solver)
            spent += int(result.iterations)
        cost = float(result.cost)
        if cost == cost and (best is None or cost < best[0]):
            best = (cost, result.state, undistorted)
        if best is not None and (2.0 * best[0] / views.corner_count) ** 0.5 < _SUSPICIOUS_RMS:
            break
    if best is None:
        raise InputError(
            "no initial values explain the corners. Look first at "
            f"{least_planar(views.board_points, views.pixels, names)}: remove what is not this board and this camera"
        )
    return best[1], best[2], spent


def known_model(camera: Camera, views: CameraViews, names: Sequence[str]) -> BoardState:
    """Begin with a known camera and the board poses under it."""
    camera = Camera(camera.params.detach().cpu(), size=camera.size, model=camera.model)
    if camera.size != views.size:
        raise InputError(f"the known camera is of {camera.size} px, the observations of {views.size} px")
    state, _ = poses_under(camera, views, LMOptions(max_iterations=30))
    poor = state.translation.isnan().any(-1).nonzero()[:, 0].tolist()
    if poor:
        raise InputError(
            f"view {names[poor[0]]!r}: the known camera gives too few of its corners a ray; remove the view, or "
            "calibrate without a known camera"
        )
    return state
