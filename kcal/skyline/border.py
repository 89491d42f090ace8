"""The border of sky and ground in an image, column by column, between pixels and with standard deviations.

A dynamic program finds the topmost sharp edge that goes through the whole image; soft edges, as those of most clouds,
weigh little. In each column a blurred step is then fitted to a few pixels around it. Columns in which that is vague are
left out, and so are those beside a jump of the border: a pole or a tree in front.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d, median_filter, uniform_filter1d
from scipy.special import erf

from kcal.errors import InputError

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Rows of the two boxes whose means are compared, and columns over which they are smoothed.
_BOX, _ACROSS = 3, 5
# An edge counts half if its step is so many standard deviations, and so many gray levels in a range of 255.
_SURE, _LEAST_STEP = 6.0, 2.0
# Columns over which the noise is taken as even.
_EVEN = 31
# Of the dynamic program: what a row of change costs, most rows between neighbors, what a longer jump costs, and what it
# costs to leave an edge of full strength in the sky.
_SLOPE, _ROWS, _JUMP, _CROSSED = 0.02, 6, 2.0, 1.5
# Rows on each side of the edge to which a step is fitted, and steps of that fit.
_REACH, _STEPS = 6, 12
# px: blur (σ) with which a fit begins, and of an edge that is no longer one.
_BLUR, _VAGUE = 1.0, 4.0
# px: a border is used if its σ is below this, and if it was found no farther from where the program put it.
_MOST_SIGMA, _MOST_MOVE = 0.5, 2.5
# px between the borders of neighboring columns that are a jump, and columns beside one that are left out.
_BREAK, _BESIDE = 4.0, 3
# Columns of the running median with which a jump is compared.
_MEDIAN = 9
# px by which texture as strong as the step moves a border: of rendered hills in haze (scripts/check/skyline.py).
_TEXTURE = 4.5
# A border is an edge of the sky if above it texture is below this share of its own step.
_ROUGH = 0.5


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Border:
    """Where the sky ends in each column of an image.

    Args:
        row: (W,) px, integer in the middle of a pixel; NaN where it is not clear.
        sigma: (W,) px, along the column, of noise and of texture beside the border.
        step: (W,) gray levels from the ground to the sky.
        size: width and height of the image.
    """

    row: Floats
    sigma: Floats
    step: Floats
    size: tuple[int, int]

    @property
    def clear(self) -> Bools:
        """(W,) whether the border is clear."""
        return np.isfinite(self.row)


def sky_border(image: NDArray[np.generic]) -> Border:
    """Find the border of sky and ground.

    Args:
        image: (H, W) gray levels, 8 or 16 bits or floats.

    Raises:
        InputError: not an image of gray levels, or one of a single brightness.

    Example:
        >>> rows = np.arange(60)[:, None] - 31.3 - 0.05 * np.arange(80)
        >>> found = sky_border(120.0 - 60.0 * np.tanh(rows) + np.random.default_rng(1).normal(0, 1, (60, 80)))
        >>> bool(found.clear.all()), float(np.abs(found.row - 31.3 - 0.05 * np.arange(80)).max()) < 0.2
        (True, True)
    """
    gray = np.asarray(image)
    if gray.ndim != 2 or min(gray.shape) < 8 * _BOX:
        raise InputError(f"an image (H, W) of gray levels is needed, got the shape {gray.shape}")
    light = gray.astype(np.float64)
    if not np.isfinite(light).all():
        raise InputError("the image has gray levels that are not finite")
    full = float(np.ptp(light))
    if full <= 0.0:
        raise InputError("the image has one gray level everywhere: there is no sky and no ground in it")
    noise = _noise(light)
    step = _row_steps(light)
    path = _on_steepest(step, _best_path(_strength(step, noise, _LEAST_STEP / 255.0 * full)))
    return _refined_border(light, path, noise)


def _noise(light: Floats) -> Floats:
    """(W,) standard deviation of the noise of the smoother half of each column's pixels, as its neighbors smooth it."""
    off = np.sort(np.abs(light[1:-1] - 0.5 * (light[:-2] + light[2:])), axis=0)
    # The mean of the smaller half, which is sky mostly: of normal values it is 0.325 σ.
    own = off[: len(off) // 2].mean(0) / (0.325 * math.sqrt(1.5))
    # Rounding to gray levels leaves 0.29 of one, even where there is no noise.
    return np.maximum(uniform_filter1d(own, _EVEN, mode="nearest"), max(0.5 * float(np.median(own)), 0.29))


def _row_steps(light: Floats) -> Floats:
    """(H, W) gray levels by which the rows above a row differ from those from there on."""
    smooth = uniform_filter1d(light, _ACROSS, axis=1, mode="nearest")
    found: Floats = convolve1d(smooth, np.repeat([1.0, -1.0], _BOX) / _BOX, axis=0, mode="nearest")
    return found


def _strength(step: Floats, noise: Floats, least: float) -> Floats:
    """(H, W) between 0 and 1: how surely there is an edge above a row."""
    spread = noise * math.sqrt(2.0 / (_BOX * _ACROSS))
    scale = np.maximum(_SURE * spread, least)
    found: Floats = np.square(step) / (np.square(step) + np.square(scale))
    found[: 2 * _BOX] = 0.0
    found[-2 * _BOX :] = 0.0
    return found


def _on_steepest(step: Floats, path: NDArray[np.int64]) -> NDArray[np.int64]:
    """A path that runs above strong edges, which all count alike, put onto the steepest row there."""
    rows = np.clip(path[:, None] + np.arange(-1, 2 * _BOX + 1), 0, len(step) - 1)
    value = np.abs(step[rows, np.arange(len(path))[:, None]])
    return rows[np.arange(len(path)), value.argmax(1)]


def _best_path(strength: Floats) -> NDArray[np.int64]:
    """(W,) the row of the border in each column, by dynamic programming from left to right."""
    rows, columns = strength.shape
    # Edges count as crossed from half of their full strength on: many rows of noise are none. An edge spreads over the
    # rows of a box, and an own edge is crossed in part.
    sure = np.maximum(2.0 * strength - 1.0, 0.0)
    above = np.cumsum(sure, 0) - sure
    own = np.zeros_like(strength)
    own[2 * _BOX :] = above[2 * _BOX :] - above[: -2 * _BOX]
    cost = _CROSSED / _BOX * (above - own) - strength
    shifts = np.arange(-_ROWS, _ROWS + 1)
    total, back = cost[:, 0], np.zeros((columns, rows), np.int64)
    everywhere = np.arange(rows)
    for column in range(1, columns):
        padded = np.pad(total, _ROWS, constant_values=np.inf)
        around = np.lib.stride_tricks.sliding_window_view(padded, 2 * _ROWS + 1) + _SLOPE * np.abs(shifts)
        pick = around.argmin(1)
        least, origin = around[everywhere, pick], everywhere + shifts[pick]
        far = int(total.argmin())
        jump = total[far] + _JUMP < least
        total = np.where(jump, total[far] + _JUMP, least) + cost[:, column]
        back[column] = np.where(jump, far, origin)
    path = np.empty(columns, np.int64)
    path[-1] = int(total.argmin())
    for column in range(columns - 1, 0, -1):
        path[column - 1] = back[column, path[column]]
    return path


def _refined_border(light: Floats, path: NDArray[np.int64], noise: Floats) -> Border:
    """A blurred step in each column around the path."""
    rows, columns = light.shape
    inside = (path >= 2 * _BOX + 1) & (path < rows - 2 * _BOX - 1)
    offset = np.arange(-_REACH, _REACH)
    # An edge between the rows path - 1 and path stands at path - 0.5.
    index = np.clip(path[:, None] + offset, 0, rows - 1)
    value = light[index, np.arange(columns)[:, None]]
    blur: Floats = np.full(columns, _BLUR)
    found = None
    for own_blur in (True, False):
        found = _fit_steps((offset + 0.5).astype(np.float64), value, blur, own_blur=own_blur)
        good = inside & (np.abs(found[0]) < _MOST_MOVE) & (np.abs(found[1]) > _SURE * noise)
        if own_blur:
            # A lens has one blur, and a slanting edge a wider one.
            slope = np.gradient(median_filter(path.astype(np.float64), _MEDIAN, mode="nearest"))
            slant = np.sqrt(1.0 + np.square(slope))
            usual = float(np.median(found[2][good] / slant[good])) if good.any() else _BLUR
            vague = found[2] > min(3.0 * usual, _VAGUE) * slant
            blur = np.clip(usual, 0.3, _VAGUE) * slant
    assert found is not None
    place, step, _, variance, left = found
    # Texture beside the border is no white noise: what it does to the fit is like a step of its own close by.
    texture = np.sqrt(np.maximum(np.square(left) - np.square(noise), 0.0))
    sigma = np.sqrt(variance * np.square(noise) + np.square(_TEXTURE * texture / np.maximum(np.abs(step), 1e-9)))
    # Above the border is sky: what differs there from one brightness is small beside the step.
    rough = np.std(light[np.clip(path[:, None] - np.arange(4, 4 + 2 * _REACH), 0, rows - 1),
                         np.arange(columns)[:, None]], axis=1)  # fmt: skip
    good &= ~vague & (sigma < _MOST_SIGMA) & (rough < _ROUGH * np.abs(step) + 2.0 * noise)
    row = path - 0.5 + place
    level = median_filter(row, _MEDIAN, mode="nearest")
    trend = np.abs(np.gradient(level))
    broken = (np.abs(row - level) > _BREAK + _MEDIAN * trend) | (
        np.abs(np.diff(row, prepend=row[0])) > _BREAK + 2 * trend
    )
    good &= uniform_filter1d(broken.astype(np.float64), 2 * _BESIDE + 1, mode="nearest") < 0.5 / (2 * _BESIDE + 1)
    return Border(
        row=np.where(good, row, np.nan), sigma=np.where(good, sigma, np.nan), step=step, size=(columns, rows)
    )  # fmt: skip


def _fit_steps(
    at: Floats, value: Floats, blur: Floats, *, own_blur: bool
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Fit m - c erf((x - x0) / (√2 s)) to values (W, K) at places (K,): x0, step 2 c, s, variance of x0, residual.

    The variance is for residuals of one gray level; the residual is the root of their mean square.
    """
    count = 4 if own_blur else 3
    half = len(at) // 2
    middle = 0.5 * (value[:, :half].mean(1) + value[:, half:].mean(1))
    height = 0.5 * (value[:, :half].mean(1) - value[:, half:].mean(1))
    place, width = np.zeros(len(value)), blur.copy()
    for _ in range(_STEPS):
        z = (at - place[:, None]) / width[:, None]
        shape = erf(z / math.sqrt(2.0))
        bell = math.sqrt(2.0 / math.pi) * np.exp(-0.5 * np.square(z))
        by = [np.ones_like(z), -shape, height[:, None] * bell / width[:, None]]
        if own_blur:
            by.append(height[:, None] * bell * z / width[:, None])
        rows = np.stack(by, -1)
        off = value - middle[:, None] + height[:, None] * shape
        normal = rows.transpose(0, 2, 1) @ rows
        scale = np.sqrt(np.maximum(np.einsum("wii->wi", normal), 1e-9))
        normal = normal / (scale[:, :, None] * scale[:, None]) + 1e-6 * np.eye(count)
        step = np.linalg.solve(normal, (rows.transpose(0, 2, 1) @ off[..., None]) / scale[..., None])[..., 0] / scale
        middle, height = middle + step[:, 0], height + step[:, 1]
        place = np.clip(place + np.clip(step[:, 2], -1.0, 1.0), -_REACH, _REACH)
        if own_blur:
            width = np.clip(width + np.clip(step[:, 3], -0.5, 0.5), 0.3, 2.0 * _VAGUE)
    inverse = np.linalg.inv(normal)[:, 2, 2] / np.square(scale[:, 2])
    left = np.sqrt(np.square(off).sum(1) / max(len(at) - count, 1))
    return place, 2.0 * height, width, inverse, left
