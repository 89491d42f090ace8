"""The captures with ordinary cameras that KCAL_DATA holds, and how each is split into halves.

The real wide lens: 93 views of mrcal's tour, how they are split, and the measure on held-out views.
"""

from __future__ import annotations

import math
import os
import re
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal import Board, Camera, Observations, detect
from kcal.calibrate.problem.state import warp_modes
from kcal.calibrate.problem.views import Views, poses_under
from kcal.corners.images import expand_images
from kcal.corners.refine import Refinement
from kcal.solve import LMOptions
from scripts.shared.captures import as_observations
from scripts.shared.page import timed

# Folders of images, and their boards. The squares of gloworm960 are not known; no figure depends on them.
FOLDERS = {"pi640": Board(columns=7, rows=7, square=0.0254), "gloworm960": Board(columns=8, rows=6, square=0.0254)}
CACHE = Path(tempfile.gettempdir(), "kcal-ordinary-corners")
STEREO_BOARD = Board(columns=9, rows=6, square=0.025)


class RealCapture(NamedTuple):
    """All views of one camera, in natural order of their names, and weights (V, N) of their residuals."""

    seen: Observations
    weight: Tensor

    def half(self, which: int) -> RealCapture:
        """Every other view."""
        return RealCapture(self.seen.subset(list(self.seen.names[which::2])), self.weight[which::2])


def names() -> list[str]:
    """All captures in KCAL_DATA."""
    files = sorted(path.name.removesuffix(".obs.json") for path in (data_folder() / "captures").glob("*.obs.json"))
    return [*files, *FOLDERS, "wide", "stereo_left", "stereo_right"]


def load(name: str) -> RealCapture:
    """A capture by name, or an observations file by its path; corners found in images are stored in `CACHE`.

    The cache is not aware of the detector's version: use another folder, or delete it, after a change.
    """
    folder = data_folder()
    if name == "wide":
        return wide_capture()
    if name in FOLDERS:
        seen = _detected(name, lambda: detect(expand_images([str(folder / "captures" / name)]), FOLDERS[name]))
    elif name.startswith("stereo_"):
        seen = _detected(name, lambda: stereo_images(name.removeprefix("stereo_")))
    else:
        path = folder / "captures" / f"{name}.obs.json"
        seen = Observations.load(path if path.exists() else Path(name))
    seen = seen.subset(sorted(seen.names, key=_natural))
    return RealCapture(seen, torch.isfinite(seen.pixels()).all(-1).double())


def _detected(name: str, detect: Callable[[], Observations]) -> Observations:
    path = CACHE / f"{name}.obs.json"
    if not path.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        detect().save(path)
    return Observations.load(path)


def _natural(name: str) -> list[tuple[int, str]]:
    """A key that sorts img2 before img10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def stereo_images(side: str, refine: Refinement = "erf") -> Observations:
    """OpenCV's own images of the left or the right camera, 13 views of a board of 9x6 corners."""
    images = expand_images([str(data_folder() / "opencv_stereo")])
    return detect([path for path in images if path.name.startswith(side)], STEREO_BOARD, refine)


EXACT = LMOptions(max_iterations=60, tolerance=1e-12)


def wide_capture() -> RealCapture:
    """Of the wide lens."""
    with np.load(data_folder() / "wide_lens_corners.npz") as data:
        corners, weight, size = data["corners"], data["weight"], data["image_size"]
        columns, rows = (int(n) for n in data["board_size"])
        board = Board(columns=columns, rows=rows, square=float(data["square_m"]))
    known = torch.from_numpy(weight)[..., None]
    covariance = torch.eye(2, dtype=torch.float64) / known[..., None] ** 2
    pixels = torch.where(known > 0, torch.from_numpy(corners), torch.nan)
    return RealCapture(
        as_observations(pixels, tuple(size.tolist()), board, covariance=covariance), known.clamp_min(0.0)[..., 0]
    )


def parts_of(split: str, views: int) -> list[np.ndarray]:
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
        (camera, points), spent = timed(fit, seen.subset([seen.names[i] for i in train]), weight[train])
        error, corners = held_out(camera, points, seen.subset([seen.names[i] for i in out]), weight[out])
        total, seconds, count = total + error, seconds + spent, count + corners
    return math.sqrt(total / count), seconds / len(parts)


def data_folder() -> Path:
    """What KCAL_DATA names."""
    folder = os.environ.get("KCAL_DATA")
    if not folder:
        raise SystemExit("set KCAL_DATA to the folder that holds the real captures")
    return Path(folder)
