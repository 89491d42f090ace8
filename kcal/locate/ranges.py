"""The 95 % interval of a range, from one over the range and its standard deviation.

A range is skewed: at 5 km with 3.2 px of disparity, half a pixel too many puts a point 0.7 km nearer and half a pixel
too few 0.9 km farther, and the far end is infinite once the disparity may be zero. A standard deviation of the range
hides both. One over the range has nearly Gaussian errors, so its interval is carried over.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

# Two-sided 95 % of a normal distribution.
QUANTILE = 1.959963984540054
# A parallax below this many standard deviations gives a bearing, but no range worth the name.
BEARING_SIGMAS = 3.0


class RangeInterval(NamedTuple):
    """Ends of the 95 % interval in meters from the left camera, (..., N) each.

    Attributes:
        low: nearest range; infinite if the rays diverge by more than the noise explains.
        high: farthest range; infinite if the point may be at infinity.
    """

    low: Tensor
    high: Tensor


def range_interval(inverse_range: Tensor, sigma: Tensor, known: Tensor | None = None) -> RangeInterval:
    """The 95 % interval of the range, from the interval inverse_range ± 1.96 sigma.

    Args:
        inverse_range: (..., N) one over meters, negative where the rays diverge.
        sigma: (..., N) its standard deviation.
        known: (..., N) bool; where it is False the interval is 0 to infinity.

    Example:
        >>> f, baseline, disparity = 1600.0, 10.0, torch.tensor([3.2], dtype=torch.float64)
        >>> sigma = torch.tensor([0.5 / (f * baseline)], dtype=torch.float64)
        >>> interval = range_interval(disparity / (f * baseline), sigma)
        >>> round(interval.low.item(), 1), round(interval.high.item(), 1)
        (3827.8, 7207.1)
    """
    ends = []
    for inverse, unknown in ((inverse_range + QUANTILE * sigma, 0.0), (inverse_range - QUANTILE * sigma, math.inf)):
        ahead = inverse > 0
        reach = torch.where(ahead, 1.0 / torch.where(ahead, inverse, 1.0), math.inf)
        ends.append(reach if known is None else torch.where(known, reach, unknown))
    return RangeInterval(*ends)
