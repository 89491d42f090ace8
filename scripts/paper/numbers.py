"""What the page and the pictures of `reproduce_paper.py` share: the paper's numbers, and medians over the draws."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence

Results = dict[str, list[dict]]
DISTANCES = ("100 m", "250 m", "500 m", "1 km", "2 km", "3.5 km", "5 km")
# The paper's Table 3, right and left camera.
TABLE_3 = {
    "14": (0.2021, 0.2132),
    "16": (0.2020, 0.2129),
    "18": (0.2021, 0.2129),
    "20": (0.2019, 0.2129),
    "20b": (0.2018, 0.2126),
    "22": (0.2017, 0.2126),
    "24": (0.2017, 0.2123),
}
# The paper's largest reprojection error of the seven points, pixels (its Fig. 9).
FIGURE_9 = {"14": 10.62, "20": 7.21, "hybrid": 6.93}
SHOWN = ("14", "20", "24", "hybrid", "OpenCV")
# Their lenses, everything else by kcal.
MIXED = "OpenCV, kcal's rig"
# Columns: the image's middle, and half the width of what counts as its center.
MIDDLE, HALF_CENTER = 959.5, 480.0
# Errors closer than this share are alike: the draws of the landmarks' noise tell no more.
ALIKE = 0.02


def middle(values: Sequence[float], digits: int = 3) -> str:
    """`median (smallest to largest)`; what is not finite is a failure, worse than any number."""
    good = [value for value in values if math.isfinite(value)]
    if not good:
        return "–"
    if len(values) == 1:
        return f"{good[0]:.{digits}f}"
    text = f"{number(median(values), digits)} ({min(good):.{digits}f} to {max(good):.{digits}f})"
    return text if len(good) == len(values) else f"{text}, {len(values) - len(good)} failed"


def number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "–"


def lowest(values: dict[str, float]) -> str:
    """The name of the smallest value; empty where nothing is finite."""
    good = {name: value for name, value in values.items() if math.isfinite(value)}
    return min(good, key=lambda name: good[name], default="")


def median(values: Iterable[float]) -> float:
    """What is not finite counts as infinite."""
    return statistics.median([value if math.isfinite(value) else math.inf for value in values])


def rms(values: Iterable[float]) -> float:
    """Infinite if a value is missing."""
    found = [value**2 if math.isfinite(value) else math.inf for value in values]
    return math.sqrt(statistics.fmean(found))


def below(a: float, b: float) -> bool:
    """Whether `a` is smaller, by more than `ALIKE`."""
    return a < (1.0 - ALIKE) * b


def calibration(run: dict, label: str, point: int = -1) -> float:
    """Range error of a point that lenses and rig make, meters: RMS over the draws of the landmarks' noise."""
    return rms(draw[point] for draw in run["located"][label]["range_error"])


def lens_share(run: dict, label: str, point: int = -1) -> float:
    """The same with landmarks that have no noise."""
    return abs(run["located"][label]["lens"][point])


def rig_share(run: dict, label: str, point: int = -1) -> float:
    """What the landmarks' noise adds to it: RMS of the difference."""
    found = run["located"][label]
    return rms(draw[point] - found["lens"][point] for draw in found["range_error"])


def everywhere(run: dict, label: str) -> float:
    """Range error by calibration 5 km away, all over the image, meters: RMS over places and draws."""
    return rms(run["located"][label]["far"])


def over_bound(run: dict, label: str, point: int = -1) -> float:
    """Total range error of a point over what the marks alone leave."""
    return run["located"][label]["total"][point] / run["bound"][point]


def relative(run: dict, label: str) -> float:
    """RMS over the seven points and the draws of range error by calibration, as a share of the range."""
    ranges = [math.hypot(*point) for point in run["targets"]]
    return rms(
        error / true for draw in run["located"][label]["range_error"] for error, true in zip(draw, ranges, strict=True)
    )


def position(run: dict, label: str) -> float:
    """RMS over the seven points and the draws of the position's error, meters."""
    return rms(error for draw in run["located"][label]["position_error"] for error in draw)


def reprojection(run: dict, label: str) -> list[float]:
    """Reprojection error of each of the seven points, pixels: RMS over the draws."""
    return [rms(errors) for errors in zip(*run["located"][label]["reprojection"], strict=True)]


def edge_means(run: dict, label: str) -> tuple[float, float]:
    """Mean reprojection error of the points in the middle half of the image, and of the others."""
    central = [abs(pixel[0] - MIDDLE) < HALF_CENTER for pixel in run["target_pixels"]]
    errors = reprojection(run, label)
    groups = [[e for e, inside in zip(errors, central, strict=True) if inside == wanted] for wanted in (True, False)]
    return statistics.fmean(groups[0]), statistics.fmean(groups[1])
