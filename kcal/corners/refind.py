"""Find points of an image again in a later image of the same camera, which may have moved a little."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.corners.match import (
    RIVAL_DISTANCE,
    Matches,
    MatchOptions,
    MatchStatus,
    PatchMatch,
    blurred_window,
    fit_shift,
    patch_correlation,
    sample_window,
)
from kcal.errors import InputError


@torch.no_grad()
def find_again(
    before: Tensor, after: Tensor, pixels: Tensor, reach: int = 40, options: MatchOptions | None = None
) -> Matches:
    """Find what was at given pixels of one image in another one of the same camera.

    The patch around each pixel is correlated with every place within `reach`, and the best place is refined by least
    squares, as in `kcal.corners.match.match_points`. Light may have changed; scale and direction may not.

    Args:
        before: (H, W) gray levels of the old image.
        after: (H, W) of the new one.
        pixels: (N, 2) in the old image.
        reach: pixels by which things may have moved along each axis.
        options: `half`, `min_score` and `max_rival` of `MatchOptions`.

    Returns:
        Pixels of the new image with covariance, status and correlation; `off_line` is 0 where one was found.

    Raises:
        InputError: images of unlike sizes, or pixels of another shape.

    Example:
        >>> image = torch.rand(15, 20, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        >>> before = torch.nn.functional.interpolate(image[None, None], scale_factor=8, mode="bicubic")[0, 0]
        >>> found = find_again(before, before.roll((-5, 3), (0, 1)), torch.tensor([[80.0, 60.0]]))
        >>> [round(value, 2) for value in found.pixels[0].tolist()]
        [83.0, 55.0]
    """
    options = options or MatchOptions()
    pixels = as_points("pixels", pixels, 2)
    if pixels.ndim != 2 or before.ndim != 2 or before.shape != after.shape:
        raise InputError(
            f"pixels (N, 2) and two images of one size are needed, got {tuple(pixels.shape)}, {tuple(before.shape)} "
            f"and {tuple(after.shape)}"
        )
    numbers = torch.full((len(pixels), 8), math.nan, dtype=torch.float64)
    found = Matches(
        numbers[:, :2], numbers[:, 2:6].unflatten(1, (2, 2)), torch.zeros(len(pixels), dtype=torch.int64),
        numbers[:, 6], numbers[:, 7],
    )  # fmt: skip
    for row, pixel in enumerate(pixels):
        match = _found_again(before, after, pixel, reach, options)
        found.status[row], found.score[row], found.off_line[row] = int(match.status), match.score, match.off_line
        found.pixels[row], found.covariance[row] = match.pixel, match.covariance
    return found


def _found_again(before: Tensor, after: Tensor, pixel: Tensor, reach: int, options: MatchOptions) -> PatchMatch:
    if not bool(torch.isfinite(pixel).all()):
        return PatchMatch(MatchStatus.NO_RAY)
    axis = torch.arange(-options.half, options.half + 1, dtype=torch.float64)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    patch = pixel + torch.stack([x, y], -1).reshape(-1, 2)
    size = torch.tensor([before.shape[1], before.shape[0]])
    if not bool(((patch >= 1) & (patch <= size - 2)).all()):
        return PatchMatch(MatchStatus.OUTSIDE)
    template = sample_window(blurred_window(before, patch), patch)
    if not float(template.std()) > 1e-6 * max(1.0, float(template.abs().max())):
        return PatchMatch(MatchStatus.FLAT)
    steps = torch.arange(-reach, reach + 1, dtype=torch.float64)
    dy, dx = torch.meshgrid(steps, steps, indexing="ij")
    moves = torch.stack([dx, dy], -1).reshape(-1, 2)
    window = blurred_window(after, patch, reach + 2)
    scores = []
    for part in moves.split(512):
        where = patch + part[:, None]
        usable = ((where >= 1) & (where <= size - 2)).all(-1).all(-1)
        scores.append(torch.where(usable, patch_correlation(sample_window(window, where), template), -torch.inf))
    score = torch.cat(scores)
    best = int(score.argmax())
    top = float(score[best])
    if not top >= options.min_score:
        return PatchMatch(MatchStatus.OUTSIDE if top == -math.inf else MatchStatus.NO_MATCH, top)
    board = score.reshape(len(steps), -1)
    peaks = (torch.nn.functional.max_pool2d(board[None, None], 3, 1, 1)[0, 0] == board).reshape(-1)
    away = torch.linalg.vector_norm(moves - moves[best], dim=-1) > RIVAL_DISTANCE
    if bool((peaks & away & (score > options.max_rival * top)).any()):
        return PatchMatch(MatchStatus.AMBIGUOUS, top)
    return fit_shift(window, template, patch + moves[best], torch.zeros(2, dtype=torch.float64), top, options)
