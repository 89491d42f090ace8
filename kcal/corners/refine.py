"""Sub-pixel refinement by name: kcal's saddle, OpenCV's and scikit-image's methods, all with the same verdicts."""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import cv2
import numpy as np
import torch
from skimage.feature import corner_subpix
from torch import Tensor

from kcal.checks import as_points
from kcal.corners.erf import erf_saddle
from kcal.corners.grid import line_bend, neighbors
from kcal.corners.images import Gray
from kcal.corners.saddle import MAX_MOVE, MOVE_SHARE, SQUARE_SHARE, Refined, Status, saddle
from kcal.errors import InputError

Refinement = Literal["erf", "saddle", "opencv", "skimage", "none"]

SECOND_BLUR = 0.12  # of the square side: blur above which the erf fit is repeated from its own corners
_OPENCV_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)


def refine_corners(
    image: Gray,
    pixels: Tensor,
    side: Tensor,
    method: Refinement = "erf",
    grid: tuple[int, int] | None = None,
) -> Refined:
    """Move corners to sub-pixel places.

    * `erf`: `kcal.corners.saddle.saddle`, then `kcal.corners.erf.erf_saddle` from there: the most accurate of these on
      real and on rendered boards, with a covariance and the blur of each corner.
    * `saddle`: `kcal.corners.saddle.saddle` alone, nearly as good on squares below 10 px, faster.
    * `opencv`: `cv2.cornerSubPix` (W. Förstner's condition that gradients point at the corner) with a half-window of
      0.35 of the smallest square at each corner, within 2 to 11 px. Results carry float32 precision.
    * `skimage`: `skimage.feature.corner_subpix` (W. Förstner and E. Gülch 1987, with a statistical test), an
      independent cross-check, slow. It gives up on blurred corners.
    * `none`: the starts as they are.

    Args:
        image: (H, W) uint8 or uint16, used at full depth.
        pixels: (N, 2) starts; NaN where a corner was not seen.
        side: (N,) smallest side in pixels of the squares round each corner.
        method: one of the names above.
        grid: (columns, rows) where the corners are all those of a board, row by row: `erf` then allows for lines that
            the lens bends.

    Returns:
        Corners (N, 2), NaN where a corner left the image, moved further than 2 px or 0.3 of the square, or was given
        up by the method; and a `Status` for each.

    Raises:
        InputError: an unknown method, or shapes that do not fit.

    Example:
        >>> x = np.arange(40.0)
        >>> image = np.outer(np.tanh(x - 19.3), np.tanh(x - 20.6)) * 100 + 128
        >>> start = torch.tensor([[20.0, 20.0]])
        >>> found = refine_corners(image.round().astype(np.uint8), start, torch.tensor([15.0]), "opencv")
        >>> [round(value, 1) for value in found.pixels[0].tolist()]
        [20.6, 19.3]
    """
    if method not in get_args(Refinement):
        raise InputError(f"refine {method!r}: choose one of {', '.join(get_args(Refinement))}")
    pixels = as_points("pixels", pixels, 2)
    if pixels.ndim != 2 or side.shape != pixels.shape[:1]:
        raise InputError(f"pixels {tuple(pixels.shape)} and side {tuple(side.shape)}: (N, 2) and (N,) are needed")
    if method in ("erf", "saddle"):
        # Only the surroundings of the corners become float64; float32 holds 16 bits exactly.
        light = torch.from_numpy(image if image.dtype == np.uint8 else image.astype(np.float32))
        found = saddle(light, pixels, side)
        return found if method == "saddle" else _erf(light, pixels, found, side, _extremes(image), grid)

    height, width = image.shape
    seen = torch.isfinite(pixels).all(-1)
    if method == "none":
        moved, margin = pixels, torch.zeros_like(side)
    else:
        margin = (SQUARE_SHARE * side).floor().clamp(2, 11 if method == "opencv" else 6)
        x, y = pixels.unbind(-1)
        usable = seen & (x >= margin) & (x <= width - 1 - margin) & (y >= margin) & (y <= height - 1 - margin)
        step = _opencv if method == "opencv" else _skimage
        moved = pixels.clone()
        for half in margin[usable].unique().int().tolist():
            chosen = usable & (margin == half)
            moved[chosen] = step(image, pixels[chosen], half)
    return _judge(pixels, moved, seen, side, margin, (width, height))


def _erf(
    light: Tensor,
    start: Tensor,
    found: Refined,
    side: Tensor,
    levels: tuple[float, float],
    grid: tuple[int, int] | None,
) -> Refined:
    """The erf fit from the saddle's corners; where the saddle has given up, its reason stays, or saturation is it."""
    settled = found.status == Status.GOOD
    fit = _fit(light, torch.where(settled[:, None], found.pixels, start), found.pixels, side, levels, grid)
    blurred = settled & (fit.blur > SECOND_BLUR * side)
    if grid is not None and bool(blurred.any()):
        # There a corner depends on where the next ones are, and the saddle's error would go from one to the other.
        better = torch.where((fit.status == Status.GOOD)[:, None], fit.pixels, found.pixels)
        fit = _fit(light, torch.where(settled[:, None], better, start), better, side, levels, grid)
    nan = float("nan")
    return Refined(
        torch.where(settled[:, None], fit.pixels, nan),
        torch.where(settled | (fit.status == Status.SATURATED), fit.status, found.status),
        torch.where(settled[:, None, None], fit.covariance, nan),
        torch.where(settled, fit.blur, nan),
    )


class _Full(NamedTuple):
    pixels: Tensor
    status: Tensor
    covariance: Tensor
    blur: Tensor


def _fit(
    light: Tensor,
    start: Tensor,
    known: Tensor,
    side: Tensor,
    levels: tuple[float, float],
    grid: tuple[int, int] | None,
) -> _Full:
    bend = line_bend(known, *grid) if grid is not None else None
    around = neighbors(known, *grid) if grid is not None else None
    fit = erf_saddle(light, start, side, bend=bend, around=around, levels=levels)
    assert fit.covariance is not None
    assert fit.blur is not None
    return _Full(fit.pixels, fit.status, fit.covariance, fit.blur)


def _extremes(image: Gray) -> tuple[float, float]:
    """The gray levels at which a pixel is saturated; a camera's 10, 12 or 14 bits may fill 16 or not."""
    brightest = int(image.max())
    full = max(255, 2 ** brightest.bit_length() - 1)
    return 0.0, float(brightest if brightest > 0.999 * full else full)


def _opencv(image: Gray, start: Tensor, half: int) -> Tensor:
    corners = np.ascontiguousarray(start.numpy(), dtype=np.float32)
    depth = image if image.dtype == np.uint8 else image.astype(np.float32)
    found = cv2.cornerSubPix(depth, corners, (half, half), (-1, -1), _OPENCV_STOP)
    return torch.from_numpy(found.reshape(-1, 2).astype(np.float64))


def _skimage(image: Gray, start: Tensor, half: int) -> Tensor:
    rows_columns = np.rint(start.numpy()[:, ::-1]).astype(np.int64)
    found = corner_subpix(image.astype(np.float64), rows_columns, window_size=2 * half + 1)
    return torch.from_numpy(np.ascontiguousarray(found[:, ::-1], dtype=np.float64))


def _judge(start: Tensor, moved: Tensor, seen: Tensor, side: Tensor, margin: Tensor, size: tuple[int, int]) -> Refined:
    given_up = ~torch.isfinite(moved).all(-1)
    x, y = torch.where((seen & given_up)[:, None], start, moved).unbind(-1)
    inside = (x >= margin) & (x <= size[0] - 1 - margin) & (y >= margin) & (y <= size[1] - 1 - margin)
    near = torch.linalg.vector_norm(moved - start, dim=-1) < (MOVE_SHARE * side).clamp(max=MAX_MOVE)
    status = torch.zeros(len(start), dtype=torch.int64)
    for code, passed in (
        (Status.MOVED, near),
        (Status.NO_SADDLE, ~given_up),
        (Status.OUTSIDE, inside),
        (Status.MISSING, seen),
    ):
        status = torch.where(passed, status, int(code))
    return Refined(torch.where((status == Status.GOOD)[:, None], moved, float("nan")), status)
