"""The real wide lens: 93 views of mrcal's tour, how they are split, and the measure on held-out views."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from kcal import Board, Camera, Observations, View
from kcal.calibrate.problem.state import warp_modes
from kcal.calibrate.problem.views import Views, poses_under
from kcal.solve import LMOptions

EXACT = LMOptions(max_iterations=60, tolerance=1e-12)


def load() -> tuple[Observations, np.ndarray]:
    with np.load(data_folder() / "wide_lens_corners.npz") as data:
        corners, weight, size = data["corners"], data["weight"], data["image_size"]
        columns, rows = (int(n) for n in data["board_size"])
        board = Board(columns=columns, rows=rows, square=float(data["square_m"]))
    views = []
    for i, (points, weights) in enumerate(zip(corners.tolist(), weight.tolist(), strict=True)):
        pixels = tuple((p[0], p[1]) if w > 0 else None for p, w in zip(points, weights, strict=True))
        covariance = tuple((1 / w**2, 0.0, 1 / w**2) if w > 0 else None for w in weights)
        views.append(View(name=f"{i:03d}", pixels=pixels, covariance=covariance))
    seen = Observations(board=board, image_size=(int(size[0]), int(size[1])), views=tuple(views))
    return seen, np.maximum(weight, 0.0)


def folds(split: str, views: int) -> list[np.ndarray]:
    """Views held out, as in the peers' comparison."""
    if split == "evenodd":
        return [np.arange(0, views, 2), np.arange(1, views, 2)]
    blocks = np.array_split(np.arange(views), int(split.removeprefix("blocks")))
    order = np.random.default_rng(0).permutation(len(blocks))
    return [np.sort(np.concatenate([blocks[i] for i in order[k::5]])) for k in range(5)]


def warped(seen: Observations, warp: torch.Tensor) -> torch.Tensor:
    """Corners (N, 3) of a board that bulges."""
    points = seen.board.points.clone()
    points[:, 2] = warp @ warp_modes(points)[:, 2]
    return points


def held_out(camera: Camera, points: torch.Tensor, seen: Observations, weight: torch.Tensor) -> tuple[float, int]:
    """Sum of w² |r|² over views of a board (N, 3) whose poses are solved again, and how many corners."""
    pixels = torch.where((weight > 0)[..., None], seen.pixels(), torch.nan)
    whitening = weight[..., None, None] * torch.eye(2, dtype=torch.float64)
    _, cost = poses_under(camera, Views(board_points=points, pixels=pixels, whitening=whitening), EXACT)
    return 2.0 * float(torch.nan_to_num(cost, nan=math.inf).sum()), int((weight > 0).sum())


def over_parts(
    fit: Callable[[Observations, torch.Tensor], tuple[Camera, torch.Tensor]], seen: Observations, weight: torch.Tensor,
    parts: Sequence[np.ndarray],
) -> tuple[float, float]:  # fmt: skip
    """Held-out RMS over all parts of the views, pixels, and CPU seconds of one fit, a camera and its board (N, 3)."""
    total, seconds, count = 0.0, 0.0, 0
    for out in parts:
        train = np.setdiff1d(np.arange(len(seen.views)), out)
        start = time.process_time()
        camera, points = fit(seen.subset([seen.names[i] for i in train]), weight[train])
        seconds += time.process_time() - start
        error, corners = held_out(camera, points, seen.subset([seen.names[i] for i in out]), weight[out])
        total, count = total + error, count + corners
    return math.sqrt(total / count), seconds / len(parts)


def data_folder() -> Path:
    """What KCAL_DATA names."""
    folder = os.environ.get("KCAL_DATA")
    if not folder:
        raise SystemExit("set KCAL_DATA to the folder that holds the real captures")
    return Path(folder)
