"""Refine corners by a named method: kcal's own, OpenCV's or scikit-image's, all with the same statuses."""

from __future__ import annotations

import math
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor, nn

import kcal.corners.saddle as saddles
from kcal.checks import as_points, require_finite
from kcal.corners.erf import erf_saddle
from kcal.corners.grid import line_bend, local_side, neighbors
from kcal.corners.images import Gray
from kcal.errors import InputError
from kcal.opencv import cv2
from kcal.texts import brief

Refinement = Literal["erf", "saddle", "opencv", "skimage", "none"]

SECOND_BLUR = 0.12  # of the square side: blur above which the erf fit is repeated from its own corners
# Edges are jagged where the camera sharpened them, or its pixels do not resolve them: the fits of more than this share
# of the corners do not converge, or find less blur (px) than pixels (0.29) and any lens leave. Jagged edges are blurred
# by `SMOOTHING` px before the fit, unless squares are so small that this costs corners.
MAX_UNSETTLED, MIN_BLUR, SMOOTHING = 0.02, 0.36, 0.8
_OPENCV_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)


def refine_corners(
    image: Gray, pixels: Tensor, side: Tensor, method: Refinement = "erf", grid: tuple[int, int] | None = None
) -> saddles.Refined:
    """Refine corners to a fraction of a pixel.

    * `erf`: `kcal.corners.saddle.saddle`, then `kcal.corners.erf.erf_saddle` from there. The most accurate of these on
      real and on rendered boards, with a covariance and the blur of each corner.
    * `saddle`: `kcal.corners.saddle.saddle` alone. Faster, and nearly as accurate on squares below 10 px.
    * `opencv`: `cv2.cornerSubPix` (W. Förstner's condition that gradients point at the corner) with a half-window of
      0.35 of the smallest square at each corner, within 2 to 11 px. Results have float32 precision.
    * `skimage`: `skimage.feature.corner_subpix` (W. Förstner and E. Gülch 1987, with a statistical test). An
      independent cross-check: a calibration of real images ends at 0.19 px for 0.16 of `erf` (OpenCV's samples) and
      0.55 for 0.38 (a small camera), and where the two disagree tells nothing of a corner's residual.
    * `none`: the starts as they are.

    Args:
        image: (H, W) uint8 or uint16, used at full depth.
        pixels: (N, 2) starts; NaN where a corner was not seen.
        side: (N,) smallest side in pixels of the squares around each corner.
        method: one of the names above.
        grid: (columns, rows) if the corners are all those of a board, row by row. `erf` then models lines that the
            lens bends, and neighboring lines.

    Returns:
        Corners (N, 2) with the `CornerStatus` of each. NaN where a corner left the image, moved farther than 2 px or
        0.3 of the square, or where the method failed.

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
        return _of_one_image(light, pixels, side, method, grid, _saturation_levels(int(image.max())))

    height, width = image.shape
    seen = torch.isfinite(pixels).all(-1)
    if method == "none":
        moved, margin = pixels, torch.zeros_like(side)
    else:
        margin = (saddles.SQUARE_SHARE * side).floor().clamp(2, 11 if method == "opencv" else 6)
        usable = seen & saddles.inside_image(pixels, margin, width, height)
        step = _opencv if method == "opencv" else _skimage
        moved = pixels.clone()
        for half in margin[usable].unique().int().tolist():
            chosen = usable & (margin == half)
            moved[chosen] = step(image, pixels[chosen], half)
    failed = ~torch.isfinite(moved).all(-1)
    place = torch.where((seen & failed)[:, None], pixels, moved)
    distance = torch.linalg.vector_norm(moved - pixels, dim=-1)
    checks = (
        (saddles.CornerStatus.MISSING, seen),
        (saddles.CornerStatus.OUTSIDE, saddles.inside_image(place, margin, width, height)),
        (saddles.CornerStatus.NO_SADDLE, ~failed),
        (saddles.CornerStatus.MOVED, distance < (saddles.MOVE_SHARE * side).clamp(max=saddles.MAX_MOVE)),
    )
    return saddles.Refined(*saddles.with_status(moved, checks))


class RefineCorners(nn.Module):
    """`refine_corners` as a module between a network's image or rough corners and `CalibrationLayer`.

    Corners are differentiable by the image, with `erf` by the implicit function theorem; starts, covariance and blur
    carry no gradient. What the corners of an image know together (light, bent and neighboring lines) counts as constant
    of the gradient, which with `grid` is a fifth of what noise does to a corner. A corner that fails is NaN, which
    `CalibrationLayer` takes as not seen. Images are fitted one after the other.

    Args:
        method: "erf", or "saddle", which is faster and states no covariance.
        grid: (columns, rows) if the corners are all those of a board, row by row.

    Raises:
        InputError: another method; those of OpenCV and scikit-image have no gradients.

    Example:
        >>> x = torch.arange(40.0, dtype=torch.float64)
        >>> image = torch.outer(torch.erf((x - 19.3) / 1.4), torch.erf((x - 20.6) / 1.4)) * 0.3 + 0.5
        >>> image.requires_grad_(True)  # doctest: +ELLIPSIS
        tensor(...)
        >>> found = RefineCorners()(image[None, None], torch.tensor([[[20.5, 19.5]]]), torch.tensor([[15.0]]))
        >>> [round(value, 6) for value in found.pixels[0, 0].tolist()], found.pixels.requires_grad
        ([20.6, 19.3], True)
    """

    __repr__ = brief

    def __init__(self, method: Literal["erf", "saddle"] = "erf", grid: tuple[int, int] | None = None) -> None:
        super().__init__()
        if method not in ("erf", "saddle"):
            raise InputError(f"RefineCorners: {method!r} has no gradients; choose erf or saddle, or use detect_board")
        self.method, self.grid = method, grid

    def forward(self, image: Tensor, pixels: Tensor, side: Tensor | None = None) -> saddles.Refined:
        """Refine corners.

        Args:
            image: (B, 1, H, W) gray levels, uint8, or floating point of any scale.
            pixels: (B, N, 2) starts, to about a pixel; NaN where a corner was not seen.
            side: (B, N) smallest side in pixels of the squares around each corner; measured in `grid` if left out.

        Returns:
            Pixels (B, N, 2), status (B, N), covariance (B, N, 2, 2) and blur (B, N), on the device of the image.

        Raises:
            InputError: shapes or values that do not fit, or neither `side` nor `grid`.
        """
        pixels = as_points("pixels", pixels, 2).detach()
        if not isinstance(image, Tensor) or image.ndim != 4 or image.shape[1] != 1 or len(image) != len(pixels):
            found = tuple(image.shape) if isinstance(image, Tensor) else type(image).__name__
            raise InputError(f"image (B, 1, H, W) and pixels (B, N, 2) are needed, got {found}, {tuple(pixels.shape)}")
        if side is None and self.grid is None:
            raise InputError("RefineCorners: side is needed, (B, N) pixels, or a module with a grid that tells it")
        if image.is_floating_point():
            require_finite("image", image.detach())
        if not pixels.numel():
            return saddles.Refined(pixels, pixels[..., 0].long())
        done = []
        for number, light in enumerate(image[:, 0]):
            known = side[number] if side is not None else local_side(pixels[number], *(self.grid or (0, 0)))
            levels = None if light.is_floating_point() else _saturation_levels(int(light.max()))
            done.append(_of_one_image(light, pixels[number], known, self.method, self.grid, levels))
        parts = {name: [getattr(each, name) for each in done] for name in saddles.Refined._fields}
        return saddles.Refined(**{name: torch.stack(part) for name, part in parts.items() if part[0] is not None})

    def extra_repr(self) -> str:
        """One line for people."""
        return f"method={self.method}, grid={self.grid}"


def _of_one_image(
    light: Tensor,
    start: Tensor,
    side: Tensor,
    method: str,
    grid: tuple[int, int] | None,
    levels: tuple[float, float] | None,
) -> saddles.Refined:
    """Refine the corners of one image (H, W): by the saddle alone, or by the erf fit from there.

    Where the saddle failed, its reason stays, unless it is saturation.
    """
    if method == "saddle":
        return saddles.saddle(light, start, side)
    with torch.no_grad():
        found = saddles.saddle(light, start, side)
    settled = (found.status == saddles.CornerStatus.GOOD)[:, None]

    def fitted(known: Tensor) -> saddles.Refined:
        bend = line_bend(known, *grid) if grid is not None else None
        around = neighbors(known, *grid) if grid is not None else None
        begin = torch.where(settled, known, start)
        return erf_saddle(light, begin, side, bend=bend, around=around, levels=levels)

    fit = fitted(found.pixels)
    if _is_jagged(fit, settled[:, 0]):
        jagged, sharp = fit, light
        from kornia.filters import gaussian_blur2d  # kornia takes long to load

        whole = light if light.is_floating_point() else light.float()
        reach = 2 * math.ceil(4.0 * SMOOTHING) - 1
        light = gaussian_blur2d(whole[None, None], (reach, reach), (SMOOTHING, SMOOTHING))[0, 0]
        fit = fitted(found.pixels)
        saturated = jagged.status == saddles.CornerStatus.SATURATED
        fit = fit._replace(status=torch.where(saturated, int(saddles.CornerStatus.SATURATED), fit.status))
        before, now = (int((each.status == saddles.CornerStatus.GOOD).sum()) for each in (jagged, fit))
        if now < before:
            fit, light = jagged, sharp
    assert fit.blur is not None
    if grid is not None and bool((settled[:, 0] & (fit.blur > SECOND_BLUR * side)).any()):
        # There a corner depends on where its neighbors are, and errors of the saddle would pass between them.
        fit = fitted(torch.where((fit.status == saddles.CornerStatus.GOOD)[:, None], fit.pixels, found.pixels))
    assert fit.covariance is not None
    assert fit.blur is not None
    status = torch.where(settled[:, 0] | (fit.status == saddles.CornerStatus.SATURATED), fit.status, found.status)
    good = status == saddles.CornerStatus.GOOD
    return saddles.Refined(
        torch.where(good[:, None], fit.pixels, math.nan),
        status,
        torch.where(good[:, None, None], fit.covariance, math.nan),
        torch.where(good, fit.blur, math.nan),
    )


def _is_jagged(fit: saddles.Refined, settled: Tensor) -> bool:
    assert fit.blur is not None
    unsettled = settled & (fit.status == saddles.CornerStatus.NOT_CONVERGED)
    good = fit.status == saddles.CornerStatus.GOOD
    if int(unsettled.sum()) > MAX_UNSETTLED * int(settled.sum()):
        return True
    return bool(good.any()) and float(fit.blur[good].median()) < MIN_BLUR


def _saturation_levels(brightest: int) -> tuple[float, float]:
    """The gray levels at which a pixel is saturated; a camera's 10, 12 or 14 bits may fill 16 or not."""
    full = max(255, 2 ** brightest.bit_length() - 1)
    return 0.0, float(brightest if brightest > 0.999 * full else full)


def _opencv(image: Gray, start: Tensor, half: int) -> Tensor:
    corners = np.ascontiguousarray(start.numpy(), dtype=np.float32)
    depth = image if image.dtype == np.uint8 else image.astype(np.float32)
    found = cv2.cornerSubPix(depth, corners, (half, half), (-1, -1), _OPENCV_STOP)
    return torch.from_numpy(found.reshape(-1, 2).astype(np.float64))


def _skimage(image: Gray, start: Tensor, half: int) -> Tensor:
    from skimage.feature import corner_subpix  # which loads scipy.stats, half a second

    rows_columns = np.rint(start.numpy()[:, ::-1]).astype(np.int64)
    found = corner_subpix(image.astype(np.float64), rows_columns, window_size=2 * half + 1)
    return torch.from_numpy(np.ascontiguousarray(found[:, ::-1], dtype=np.float64))
