"""Ray-traced lenses, boards as they are printed, and captures of boards by such lenses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from kcal import Board, Camera, Observations, View
from kcal.lens import LensModel
from kcal.lens.model import HybridForm, radius_over_angle
from kcal.lens.projection import project_components
from kcal.lens.zernike import ZernikeModes
from kcal.sim.captures import LensLike, PrintedBoard
from kcal.sim.truth import TruthLens
from scripts.shared.captures import capture_corners

BOARD = Board(columns=7, rows=6, square=0.05)


def printed(points: Tensor, seed: int) -> Tensor:
    """The board as a printer and a wall leave it."""
    return points + PrintedBoard(BOARD.columns, BOARD.rows, BOARD.square, seed).errors(points)


def capture(lens: LensLike, views: int, sigma: float, seed: int, *more: Any, **options: Any) -> Observations:
    """Views of a board by a lens, as those of `captures`, which has further options, with noise of one size."""
    return captures(lens, views, [sigma], seed, *more, **options)[0]


def captures(
    lens: LensLike,
    views: int,
    sigmas: Sequence[float],
    seed: int,
    points: Tensor = BOARD.points,
    fill: tuple[float, float] = (0.25, 0.8),
    posed_by: LensLike | None = None,
) -> list[Observations]:
    """Views of a board, whose corners truly are at `points`, with noise of several sizes, each drawn by itself.

    `posed_by` is a lens that draws poses sooner.
    """
    found = capture_corners(posed_by or lens, views, sigma=1.0, seed=seed, fill=fill)
    seen, valid = lens.project(points @ found.rotation.transpose(-1, -2) + found.translation[:, None])
    # Poses that another lens drew may reach beyond this one's image.
    valid &= ((seen > -0.5) & (seen < seen.new_tensor(lens.size) - 0.5)).all(-1)
    noise = found.pixels - found.true_pixels
    # Noise of other corners is other noise.
    noisy = (seen + sigma * noise.roll(k, 1) for k, sigma in enumerate(sigmas))
    return [as_observations(torch.where(valid[..., None], pixels, torch.nan), lens.size) for pixels in noisy]


def as_observations(
    pixels: Tensor,
    size: tuple[int, int],
    board: Board = BOARD,
    *,
    covariance: Tensor | None = None,
    names: Sequence[str] = (),
) -> Observations:
    """Corners (V, N, 2) of a board, NaN where not seen, with covariances (V, N, 2, 2) if given, as observations."""
    spread = [None] * len(pixels) if covariance is None else covariance.flatten(-2)[..., [0, 1, 3]].tolist()
    views = []
    for i, (view, own) in enumerate(zip(pixels.tolist(), spread, strict=True)):
        corners = tuple(None if u != u else (u, v) for u, v in view)
        known = own and tuple(c and (a, b, d) for c, (a, b, d) in zip(corners, own, strict=True))
        views.append(View(name=names[i] if names else f"{i:03d}", pixels=corners, covariance=known))
    return Observations(board=board, image_size=size, views=tuple(views))


def as_camera(lens: TruthLens) -> Camera:
    """The lens itself as a camera of kcal: a hybrid lens that follows its rays, so that kcal's rigs can take it.

    Its pixels are within 3e-4 px of the truth from 30 m to infinity. Its origin is on the lens's axis where rays along
    the axis start, some mm from that of the truth.
    """
    pixels = grid(lens, 41)
    rays = lens.unproject(pixels)[0]
    middle = 0.5 * (torch.tensor(lens.size, dtype=torch.float64) - 1.0)
    theta, radius = torch.atan2(rays[:, :2].norm(dim=-1), rays[:, 2]), (pixels - middle).norm(dim=-1)
    best = (math.inf, 0.0, 0.0)
    for shape in torch.linspace(-1.0, 1.5, 251, dtype=torch.float64):
        plane = theta * radius_over_angle(shape * theta**2)
        focal = float(plane @ radius / (plane @ plane))
        best = min(best, (float((focal * plane - radius).square().sum()), float(shape), focal))
    _, shape, focal = best
    model = LensModel(
        hybrid=HybridForm(shape=shape, radius=0.54 * math.hypot(*lens.size) / focal, modes=ZernikeModes())
    )
    points = torch.cat([rays * 30.0, rays * 300.0, rays * 1e9])
    target = lens.project(points)[0].T
    origin, values = torch.zeros(3, dtype=torch.float64), torch.zeros(5 + model.size, dtype=torch.float64)
    values[:4] = torch.tensor([focal, focal, *middle.tolist()])
    free = [0, 2, 3, *range(5, len(values))]  # Aspect and skew are modes of the field.
    for _ in range(4):
        found = project_components((points - origin).T, values, model, free)
        slopes = torch.cat([-found.by_point, found.by_camera]).flatten(1).T
        scale = slopes.norm(dim=0)
        off = (target - found.pixels).reshape(-1, 1)
        step = torch.linalg.lstsq(slopes / scale, off, driver="gelsd").solution[:, 0] / scale
        origin, values[free] = origin + step[:3], values[free] + step[3:]
    return Camera(values, size=lens.size, model=model)


def grid(lens: TruthLens, count: int) -> Tensor:
    """(count², 2) pixels from edge to edge of the image."""
    x, y = (torch.linspace(0, extent - 1, count, dtype=torch.float64) for extent in lens.size)
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)
