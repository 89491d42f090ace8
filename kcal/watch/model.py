"""How the cameras of a rig turn over time, and how that is learned from what was measured (maximum likelihood).

Each camera turns by three angles, left before right: pitch, yaw, roll, in radians about its own axes, counted from the
moment of the reference. Each angle is a random walk that returns to its mean (an Ornstein-Uhlenbeck process: masts bend
with the sun and go back), plus a turn for each kelvin where temperatures are known, plus a part that has another value
at every look (wind). Beyond the noise of a look, patches change with light and shade: that error lasts for hours.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

# Seconds that light and shade last.
LASTING_S = 7200.0
# Radians per kelvin of an angle: 1 K across a steel beam of 10 m bends it by 0.6 mrad; brackets do a hundredth of that.
HEAT_SIGMA = 1e-5
# What is assumed of swing (radians), return (seconds) and wind (radians), and by which factors it may differ.
_USUAL = (math.radians(0.003), 6 * 3600.0, math.radians(0.0005))
_FACTOR = math.log(5.0)
_LEAST, _MOST = (1e-7, 300.0, 1e-8), (0.05, 3e7, 0.01)
# Rows that are enough to learn from, and the most that are read.
FEWEST, MOST_ROWS = 60, 1500
# Standard deviations beyond which a look is left out of the likelihood.
_OUTLIER = 5.0


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class TurnModel:
    """What is known of the motion of the six angles before anything is measured.

    Args:
        swing: (..., 6) radians, standard deviation of the part that changes slowly.
        return_s: (..., 6) seconds in which it goes back by 1 - 1/e; a random walk where that is long.
        gust: (..., 6) radians, standard deviation of what has another value at every look.
    """

    swing: Tensor
    return_s: Tensor
    gust: Tensor

    @classmethod
    def usual(cls) -> TurnModel:
        """What is assumed before enough was measured."""
        swing, back, gust = torch.tensor(_USUAL, dtype=torch.float64)[:, None].expand(3, 6)
        return cls(swing=swing, return_s=back, gust=gust)


class AngleSeries(NamedTuple):
    """One angle at T looks, for K angles: what `learned` reads.

    Attributes:
        time: (T,) seconds.
        angle: (T, K) radians, NaN where it was not measured.
        variance: (T, K) of its noise that is new at each look.
        lasting: (T, K) variance of what lasts.
        kelvin: (T, K) of warming since the reference; zeros where nobody measured it.
    """

    time: NDArray[np.float64]
    angle: NDArray[np.float64]
    variance: NDArray[np.float64]
    lasting: NDArray[np.float64]
    kelvin: NDArray[np.float64]


def learned(series: AngleSeries) -> TurnModel:
    """The most likely model of K angles; what is usual counts where the looks tell little.

    Looks are thinned to some thousand, evenly; a compass search goes over the logarithms of the three numbers.
    """
    known = np.isfinite(series.angle).any(1)
    rows = np.flatnonzero(known)
    if len(rows) < FEWEST:
        return TurnModel.usual()
    rows = rows[-MOST_ROWS:] if len(rows) <= 2 * MOST_ROWS else rows[:: len(rows) // MOST_ROWS]
    part = AngleSeries(*(values[rows] for values in series))
    usual, count = np.log(_USUAL), part.angle.shape[1]
    low, high = np.log(_LEAST), np.log(_MOST)
    best = np.repeat(usual[:, None], count, 1)
    step = np.full(count, 1.5)
    moves = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    for _ in range(24):
        tried = np.clip(best[None] + moves[:, :, None] * step, low[:, None], high[:, None])
        prior = -0.5 * (((tried - usual[:, None]) / _FACTOR) ** 2).sum(1)
        value = _log_likelihood(part, np.exp(tried)) + prior
        first = value.argmax(0)
        best = tried[first, :, np.arange(count)].T
        step = np.where(first == 0, 0.5 * step, step)
        if step.max() < 0.1:
            break
    swing, back, gust = torch.from_numpy(np.exp(best))
    # The sun moves masts smoothly, which looks say is slow; how far they go is what was seen: 95 % of it, as of a sine.
    far = np.nanquantile(np.abs(part.angle), 0.95, axis=0) / math.sqrt(2.0)
    swing = torch.maximum(swing, torch.from_numpy(far))
    return TurnModel(swing=swing, return_s=back, gust=gust)


def _log_likelihood(series: AngleSeries, tried: NDArray[np.float64]) -> NDArray[np.float64]:
    """(C, K) of C candidates (C, 3, K), by a Kalman filter of slow part, lasting error and turn per kelvin."""
    swing, back, gust = tried.swapaxes(0, 1)
    shape = swing.shape
    mean, spread = np.zeros((3, *shape)), np.zeros((3, 3, *shape))
    spread[0, 0], spread[1, 1], spread[2, 2] = swing**2, series.lasting[0], HEAT_SIGMA**2
    total = np.zeros(shape)
    for k in range(len(series.time)):
        if k:
            passed = series.time[k] - series.time[k - 1]
            keep = np.ones((3, *shape))
            keep[0], keep[1] = np.exp(-passed / back), math.exp(-passed / LASTING_S)
            mean = keep * mean
            spread = keep[:, None] * spread * keep
            spread[0, 0] += (1.0 - keep[0] ** 2) * swing**2
            spread[1, 1] += (1.0 - keep[1] ** 2) * series.lasting[k]
        toward = spread[0] + spread[1] + series.kelvin[k] * spread[2]
        variance = toward[0] + toward[1] + series.kelvin[k] * toward[2] + gust**2 + series.variance[k]
        off = series.angle[k] - mean[0] - mean[1] - series.kelvin[k] * mean[2]
        square = off**2 / variance
        used = square < _OUTLIER**2
        log = -0.5 * (np.minimum(square, _OUTLIER**2) + np.log(variance))
        total += np.where(np.isfinite(off), log, 0.0)
        gain = np.where(used, toward / variance, 0.0)
        mean = mean + gain * np.where(used, off, 0.0)
        spread = spread - gain[:, None] * toward
    return total
