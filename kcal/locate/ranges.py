"""How far a point may be: the range interval that the noise of the marks leaves open.

The interval covers the marks' noise only. An error of the calibration (0.01 degrees of relative yaw is 436 m at 5 km
with a baseline of 10 m and 1600 px of focal length) comes on top and is not in it.

A range is skewed: with parallax α the range is close to baseline / α, so that equal steps of α to either side reach
much farther outward than inward, and the outer end is infinite once α may be zero. A standard deviation of the range
hides both, hence an interval of α is carried over.
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
        bearing_only: true where the parallax is below three of its standard deviations.
    """

    low: Tensor
    high: Tensor
    bearing_only: Tensor


def range_from_parallax(baseline: Tensor | float, bearing: Tensor, parallax: Tensor) -> Tensor:
    """Range from the left camera by the law of sines; infinite where the rays do not meet in front.

    Args:
        baseline: distance of the cameras in meters.
        bearing: (..., N) angle at the left camera between its ray and the direction to the right camera, radians.
        parallax: (..., N) angle by which the right ray turns towards the left one, radians: the angle at the point.

    Returns:
        (..., N) meters, baseline * sin(bearing + parallax) / sin(parallax); the angle at the right camera is
        what the other two leave of π. Gradients are finite everywhere.

    Example:
        >>> angle = torch.tensor([0.002, 0.0], dtype=torch.float64)
        >>> range_from_parallax(10.0, torch.full_like(angle, math.pi / 2), angle).round(decimals=2).tolist()
        [4999.99, inf]
    """
    meets = (parallax > 0) & (bearing + parallax < math.pi)
    angle = torch.where(meets, parallax, 1.0)
    distance = baseline * torch.sin(bearing + angle) / torch.sin(angle)
    # With parallax π - bearing the right ray runs down the baseline and the point has come to the left camera.
    return torch.where(meets, distance, torch.where(parallax > 0, 0.0, math.inf))


def range_interval(
    baseline: Tensor | float, bearing: Tensor, parallax: Tensor, parallax_sigma: Tensor
) -> RangeInterval:
    """The 95 % interval of the range, from the interval parallax ± 1.96 sigma. It covers the marks' noise only.

    Args:
        baseline: distance of the cameras in meters.
        bearing: (..., N) angle at the left camera between its ray and the direction to the right camera, radians;
            its own noise is neglected, as it moves the range by no more than the point moves sideways.
        parallax: (..., N) radians, negative where the rays diverge.
        parallax_sigma: (..., N) standard deviation of the parallax, radians: for a narrow rig that looks straight
            ahead sqrt(2) * pixel_sigma / focal.

    Example:
        >>> f, disparity = 1600.0, torch.tensor([3.2], dtype=torch.float64)
        >>> sigma = torch.tensor([0.5 / f], dtype=torch.float64)
        >>> interval = range_interval(10.0, torch.tensor([math.pi / 2]).double(), disparity / f, sigma)
        >>> round(interval.low.item(), 1), round(interval.high.item(), 1), interval.bearing_only.item()
        (3827.8, 7207.1, False)
    """
    reach = QUANTILE * parallax_sigma
    return RangeInterval(
        low=range_from_parallax(baseline, bearing, parallax + reach),
        high=range_from_parallax(baseline, bearing, parallax - reach),
        bearing_only=parallax < BEARING_SIGMAS * parallax_sigma,
    )
