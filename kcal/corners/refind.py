"""Find points of an image again in a later image of the same camera, which may have moved a little."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.corners.match import Matches, MatchOptions, MatchStatus, PatchMatch, fit_peak, joined, textured_patch
from kcal.corners.patch_correlation import highest_peak, weighted_correlation
from kcal.corners.patch_windows import grid_of, has_samples, image_windows, sample
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
    return joined([_found_again(before, after, pixel, reach, options) for pixel in pixels])


def _found_again(before: Tensor, after: Tensor, pixel: Tensor, reach: int, options: MatchOptions) -> PatchMatch:
    if not bool(torch.isfinite(pixel).all()):
        return PatchMatch(MatchStatus.NO_RAY)
    patch = pixel + grid_of((options.half,) * 2, pixel.device)
    template = textured_patch(before, patch)
    if isinstance(template, MatchStatus):
        return PatchMatch(template)
    wide = pixel + grid_of((options.half + reach,) * 2, pixel.device)
    window = image_windows(after, wide[None], 0, math.inf)
    usable = has_samples(window, wide[None])
    scores = weighted_correlation(template[None], torch.ones_like(template)[None], sample(window, wide[None]), usable)
    peak = highest_peak(scores, grid_of((reach,) * 2, pixel.device))
    return fit_peak(window, template, patch + peak.place[0], torch.zeros(2, dtype=torch.float64), peak, options)
