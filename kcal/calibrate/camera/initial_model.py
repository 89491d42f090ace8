"""Where a calibration begins: closed forms and the simplest model, or a known camera; and all board poses under it."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.calibrate.bundle.batching import Solve, Steps
from kcal.calibrate.bundle.closed_form import (
    homographies,
    intrinsics_candidates,
    poses_from_homographies,
    radial_start,
    spread_out,
)
from kcal.calibrate.bundle.poses import refining, unflipping
from kcal.calibrate.bundle.views import Views
from kcal.calibrate.camera.options import CalibrationOptions
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.lens.projection import INTRINSICS
from kcal.solve.lm import LMOptions
from kcal.solve.result import SolverStatus, State

# A first fit worse than this many pixels is retried from other focal lengths.
_SUSPICIOUS_RMS = 2.0


def first_model(
    board: Tensor,
    pixels: Tensor,
    size: tuple[int, int],
    model: LensModel,
    options: CalibrationOptions,
    solver: LMOptions,
) -> Steps[tuple[State, State, int]]:
    """The first model's solution, a start without distortion, both from the closed forms, and the trials spent."""
    homography = homographies(board, pixels)
    spent = 0
    best: tuple[float, State, State] | None = None
    candidates = intrinsics_candidates(homography, size)
    rules, focal = options.rules(size), options.start_focal(size)
    if focal is not None:
        center = [(size[0] - 1) / 2, (size[1] - 1) / 2]
        candidates.insert(0, torch.tensor([focal, focal, *center], dtype=torch.float64))
    views = Views(board_points=board, pixels=pixels[:, None], size=size, free_warp=options.board_warp, rules=rules)
    for candidate in candidates:
        zero = torch.zeros(len(INTRINSICS) + model.size, dtype=torch.float64)
        zero[:4] = candidate
        zero = rules.impose(zero, model)
        intrinsics = zero[:4]
        rotation, translation = poses_from_homographies(homography, intrinsics)
        lens = zero.clone()
        if model.numerator >= 2:
            k1, k2 = (len(INTRINSICS) + i for i in model.numerator_index[:2])
            lens[[k1, k2]] = radial_start(board, pixels, intrinsics, rotation, translation)
        lens = rules.impose(lens, model)
        rest = (
            torch.zeros(2, dtype=torch.float64),
            torch.zeros(0, 3, 3, dtype=torch.float64),
            torch.zeros(0, 3, dtype=torch.float64),
            rotation,
            translation,
        )
        problem = views.problem(model)
        cold: State = (zero, *rest)
        for start in ((lens, *rest), cold):
            result = yield Solve(problem, start, solver)
            spent += int(result.iterations)
            if result.status != SolverStatus.BAD_START:
                break
        state, flipped = yield from unflipping(board, pixels[:, None], [model], result.state)
        if flipped:
            result = yield Solve(problem, state, solver)
            spent += int(result.iterations)
        cost = float(result.cost)
        if cost == cost and (best is None or cost < best[0]):
            best = (cost, result.state, cold)
        if best is not None and _rms(best[0], pixels) < _SUSPICIOUS_RMS:
            break
    if best is None:
        raise InputError("no start explains the corners: are all views of this board and from this camera?")
    return best[1], best[2], spent


def posed(board: Tensor, pixels: Tensor, names: tuple[str, ...], camera: Camera) -> Steps[State]:
    """Board poses under a known camera, refined one by one, both tilts of each tried."""
    seen = torch.isfinite(pixels).all(-1)
    camera = Camera(camera.params.detach().double().cpu(), size=camera.size, model=camera.model)
    rays, valid = camera.unproject(torch.nan_to_num(pixels))
    used = seen & valid & (rays[..., 2] > 0)
    ideal = torch.where(used[..., None], rays[..., :2] / rays[..., 2:], torch.nan)
    poor = (~spread_out(board, ideal)).nonzero()[:, 0].tolist()
    if poor:
        raise InputError(f"view {names[poor[0]]!r}: the known camera gives its corners too few rays")
    pinhole = torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64)
    poses = poses_from_homographies(homographies(board, ideal), pinhole)
    empty = torch.zeros(0, 3, 3, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.float64)
    state: State = (camera.params, torch.zeros(2, dtype=torch.float64), *empty, *poses)
    views = pixels[:, None]
    state, _ = yield from refining(board, views, [camera.model], state, LMOptions(max_iterations=30))
    state, _ = yield from unflipping(board, views, [camera.model], state)
    return state


def _rms(cost: float, pixels: Tensor) -> float:
    return float((2.0 * cost / int(torch.isfinite(pixels).all(-1).sum())) ** 0.5)
