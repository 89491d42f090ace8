"""Ranges, with their error bars, from the disparities of rectified images."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from kcal.checks import Float64Module, as_points, exportable, scalar
from kcal.errors import InputError
from kcal.lens.images import StereoRectification, as_disparity
from kcal.locate.localizer import Localizer
from kcal.texts import briefly

# Pixels for the derivatives of resampling, whose curvature is far below that of lenses over a pixel.
_STEP = 0.25
# Pixels located at a time.
_PIECE = 1 << 15


@briefly
@exportable
class RangeImage(NamedTuple):
    """Distances from the left camera, meters, each (..., H, W).

    Attributes:
        range: infinite where there is none.
        sigma: one standard deviation, from the disparity and from the rig's covariance; infinite where there is none.
        low: of the 95 % interval.
        high: likewise; infinite where the range has no upper bound.
        valid: whether there is a range.
    """

    range: Tensor
    sigma: Tensor
    low: Tensor
    high: Tensor
    valid: Tensor


class DisparityRanges(Float64Module):
    """Map disparities of rectified images to ranges and their standard deviations.

    Every pixel is located by `Localizer` in the images as they were taken, so that lenses, entrance pupils and
    the joint covariance of the rig (`Rig.covariance`, exact if there is none) count in full. Results carry no
    gradients; those of `StereoRectification.points` and `Localizer` do.

    Args:
        rectification: of the images.
        disparity_sigma: standard deviation of a disparity, px.

    Raises:
        InputError: a sigma that is not positive.

    Example:
        >>> from kcal import Camera, Rig
        >>> camera = Camera.build(focal=(500, 500), center=(319.5, 239.5), size=(640, 480), model="pinhole")
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-2.0, 0.0, 0.0]))
        >>> ranges = DisparityRanges(StereoRectification(rig), disparity_sigma=0.5)
        >>> disparity = torch.full((480, 640), 10.0)
        >>> found = ranges(disparity)
        >>> round(float(found.range[240, 320]), 1), round(float(found.sigma[240, 320]), 1)  # 100² / (500 · 2) · 0.5
        (100.0, 5.0)
    """

    disparity_sigma: Tensor

    def __init__(self, rectification: StereoRectification, *, disparity_sigma: float = 0.3) -> None:
        super().__init__()
        if not 0 < disparity_sigma < math.inf:
            raise InputError(f"disparity_sigma {disparity_sigma}: positive pixels are needed")
        self.rectification = rectification
        self.register_buffer("disparity_sigma", scalar(disparity_sigma, rectification.rotation))
        # Ranges do not depend on where the rig stands, and light that bends moves them by nothing that can be measured.
        self.localize = Localizer(rectification.rig, weights="marks")

    @torch.no_grad()
    def forward(self, disparity: Tensor | ArrayLike) -> RangeImage:
        """Map disparities (..., H, W) in pixels of the left rectified image; NaN and the wrong sign have no range.

        Raises:
            InputError: not floating point, or another size.
        """
        width, height = self.rectification.camera.size
        disparity = as_disparity(disparity, self.disparity_sigma)
        if tuple(disparity.shape[-2:]) != (height, width):
            raise InputError(f"disparity: shape (..., {height}, {width}) is needed, got {tuple(disparity.shape)}")
        pixels = self.rectification.camera.grid(width, height).expand(*disparity.shape, 2).reshape(-1, 2)
        flat = disparity.reshape(-1)
        pieces = [self.at(*piece) for piece in zip(pixels.split(_PIECE), flat.split(_PIECE), strict=True)]
        return RangeImage(*(torch.cat(parts).reshape(disparity.shape) for parts in zip(*pieces, strict=True)))

    @torch.no_grad()
    def at(self, pixels: Tensor | ArrayLike, disparity: Tensor | ArrayLike) -> RangeImage:
        """The same for single pixels (N, 2) of the left rectified image and their disparities (N,)."""
        disparity = as_disparity(disparity, self.disparity_sigma)
        pixels = as_points("pixels", pixels, 2, disparity)
        good = self.rectification.depth(disparity).isfinite() & disparity.isfinite()
        safe = torch.where(good, disparity, 1.0)
        left, right, seen = self.rectification.source_pixels(pixels, safe)
        slopes = []
        for step in torch.eye(2, dtype=torch.float64, device=pixels.device) * _STEP:
            ends = [self.rectification.source_pixels(pixels + sign * step, safe)[:2] for sign in (1.0, -1.0)]
            slopes.append([(high - low) / (2.0 * _STEP) for high, low in zip(*ends, strict=True)])
        # A disparity is the difference of two marks, which share its variance.
        variance = 0.5 * self.disparity_sigma**2
        parts = [torch.stack([slope[side] for slope in slopes], -1) for side in (0, 1)]
        cov = torch.zeros(*disparity.shape, 4, 4, dtype=torch.float64, device=pixels.device)
        cov[..., :2, :2], cov[..., 2:, 2:] = (variance * part @ part.mT for part in parts)
        valid = good & seen
        eye = torch.eye(4, dtype=torch.float64, device=pixels.device)
        found = self.localize(left, right, torch.where(valid[:, None, None], cov, eye), valid)
        valid = valid & (found.inverse_range > 0) & found.range_low.isfinite()
        inverse = torch.where(valid, found.inverse_range, 1.0)
        found = RangeImage(
            range=torch.where(valid, 1.0 / inverse, torch.inf),
            sigma=torch.where(valid, found.inverse_range_sigma / inverse**2, torch.inf),
            low=torch.where(valid, found.range_low, torch.nan),
            high=torch.where(valid, found.range_high, torch.nan),
            valid=valid,
        )
        return RangeImage(*(value.detach() for value in found))
