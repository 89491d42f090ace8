"""Move a click to what is there: a corner, a cross, the middle of a blob or the end of a pole; or refuse."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch

from kcal.corners.images import Gray
from kcal.corners.point import refine_point
from kcal.errors import InputError
from kcal.mark.shapes import SEEN, SHAPES, Floats, ShapeFit, fit_shape, starts_at
from kcal.mark.texture import fit_before_texture

REACH = 3.5  # pixels that a click may be away from what it means
_HALF = 18  # pixels on each side of the click that take part at most
_WINDOWS = (4.0, 5.5, 7.5)  # pixels: sigma of the weight around the point, as long as the shape fits
_NOISIER = 1.1  # times the noise of the smaller window: then the larger one contains something else
_LEAST_HALF = 8
_SURE = 60.0  # a shape whose score is this much higher is not the one
_ROUGH = 10  # iterations to tell which shape it is
_LEAST_EXPLAINED = 0.7  # below, the surroundings are something else
_LARGEST_SIGMA = 0.5  # px: a place that is known worse than this is marked as well by hand
# px: what blur that is not Gaussian and backgrounds that are not even leave of the best fits.
_MODEL_SIGMA = 0.02


class Snapped(NamedTuple):
    """A point that was found near a click.

    Attributes:
        u: column.
        v: row.
        cov: variance of u, covariance, variance of v, px².
        how: the shape that was found; "edges" where only the directions of edges were used (`refine_point`).
    """

    u: float
    v: float
    cov: tuple[float, float, float]
    how: str


def snap(image: Gray, u: float, v: float) -> Snapped:
    """Find what a click means.

    Four shapes are fitted around it (`kcal.mark.shapes`) and the one that explains the pixels best is taken. Where
    none explains them, edges that meet decide alone (`kcal.corners.point.refine_point`).

    Args:
        image: (H, W) gray levels.
        u: column of the click.
        v: row.

    Raises:
        InputError: nothing there that determines a point, or nothing within 3.5 px.

    Example:
        >>> x = np.arange(60.0)
        >>> image = 60 + 100 / (1 + np.exp(-2 * np.add.outer(x - 30.3, 0 * x))) / (1 + np.exp(-2 * (x - 27.6)))
        >>> found = snap(image.astype(np.uint8), 29, 31)
        >>> found.how, round(found.u, 1), round(found.v, 1)
        ('corner', 27.6, 30.3)
    """
    column, row = round(u), round(v)
    height, width = image.shape
    half = min(column, row, width - 1 - column, height - 1 - row, _HALF)
    if half < _LEAST_HALF:
        raise InputError(f"within {_LEAST_HALF} px of the image's border: no room to look for a shape; mark it by hand")
    levels = image[row - half : row + half + 1, column - half : column + half + 1].astype(np.float64)
    if levels.max() - levels.min() < 3:
        raise InputError("flat: there is nothing to snap to; mark it by hand or choose another point")
    best = _best_shape(levels, np.array([u - column, v - row]))
    if best is not None:
        cov = best.covariance + _MODEL_SIGMA**2 * np.eye(2)
        return Snapped(column + float(best.point[0]), row + float(best.point[1]), _three(cov), best.shape)
    return _by_edges(image, u, v)


def _best_shape(levels: Floats, click: Floats) -> ShapeFit | None:
    half = len(levels) // 2
    x, y = np.meshgrid(np.arange(-half, half + 1.0), np.arange(-half, half + 1.0))
    where = np.stack([x.ravel(), y.ravel()], -1)
    gray = levels.ravel()

    def window(middle: Floats, sigma: float) -> Floats:
        distance = np.square(where - middle).sum(-1)
        return np.where(distance < (2.5 * sigma) ** 2, np.exp(-0.5 * distance / sigma**2), 0.0)

    around = click + REACH / 1.6 * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    rough = []
    for shape in SHAPES:
        fit = fit_shape(shape, where, gray, window(click, _WINDOWS[0]), starts_at(shape, around), _ROUGH)
        if fit is not None and np.linalg.norm(fit.point - click) <= REACH + 1:
            rough.append((shape, fit))
    rough.sort(key=lambda found: found[1].score)
    fits = []
    for shape, first in [found for found in rough[:2] if found[1].score < rough[0][1].score + _SURE]:
        # Again with windows around the point, so that the result does not depend on the click.
        fit, previous, seen = None, first, np.zeros(len(where), dtype=bool)
        for sigma in _WINDOWS:
            wider = fit_shape(shape, where, gray, window(previous.point, sigma), previous.parameters[None])
            # A larger window is better as long as the shape explains it as well.
            if wider is None or (fit is not None and wider.noise > _NOISIER * fit.noise):
                break
            # Around a whole pixel, so that a click elsewhere does not change which pixels at the rim take part.
            fit, previous, seen = wider, wider, window(np.rint(wider.point), sigma) > SEEN
        if fit is not None and _is_determined(fit, click):
            fits.append((first.score, shape, fit, seen))
    # The shape that explains the pixels best is the one, unless it determines no point.
    for _, shape, fit, seen in sorted(fits, key=lambda found: found[0]):
        final = fit_before_texture(shape, fit, where[seen], gray[seen])
        if _is_determined(final, click):
            return final
    return None


def _is_determined(fit: ShapeFit, click: Floats) -> bool:
    sigma = math.sqrt(max(float(np.linalg.eigvalsh(fit.covariance)[-1]), 0.0))
    near = float(np.linalg.norm(fit.point - click)) <= REACH
    return near and 0 < sigma <= _LARGEST_SIGMA and fit.explained >= _LEAST_EXPLAINED


def _by_edges(image: Gray, u: float, v: float) -> Snapped:
    # Only the surroundings are converted: the image may have 24 million pixels.
    top, left = max(round(v) - 24, 0), max(round(u) - 24, 0)
    crop = torch.from_numpy(image[top : top + 49, left : left + 49].astype(np.float64))
    found = refine_point(crop, torch.tensor([u - left, v - top], dtype=torch.float64))
    covariance = found.covariance.numpy() + _MODEL_SIGMA**2 * np.eye(2)
    if math.sqrt(float(np.linalg.eigvalsh(covariance)[-1])) > _LARGEST_SIGMA:
        raise InputError("nothing here determines a point: no corner, cross, blob or end; mark it by hand")
    return Snapped(left + float(found.pixel[0]), top + float(found.pixel[1]), _three(covariance), "edges")


def _three(covariance: Floats) -> tuple[float, float, float]:
    return float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])
