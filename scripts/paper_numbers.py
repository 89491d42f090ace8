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
SHOWN = ("14", "20", "24", "hybrid", "field", "OpenCV")


def middle(values: Sequence[float], digits: int = 3) -> str:
    """`median (smallest to largest)` of what is finite."""
    good = [value for value in values if math.isfinite(value)]
    if not good:
        return "–"
    if len(values) == 1:
        return f"{good[0]:.{digits}f}"
    text = f"{statistics.median(good):.{digits}f} ({min(good):.{digits}f} to {max(good):.{digits}f})"
    return text if len(good) == len(values) else f"{text}, {len(values) - len(good)} failed"


def labels(runs: list[dict], wanted: Sequence[str]) -> list[str]:
    """Those of the wanted models that every run has."""
    return [label for label in wanted if all(label in run["located"] for run in runs)]


def lowest(values: dict[str, float]) -> str:
    """The name of the smallest value; NaN is none."""
    return min(values, key=lambda name: values[name] if math.isfinite(values[name]) else math.inf)


def median(values: Iterable[float]) -> float:
    """Of what is finite."""
    good = [value for value in values if math.isfinite(value)]
    return statistics.median(good) if good else math.nan


def rms(values: Sequence[float]) -> float:
    return math.sqrt(statistics.fmean(value**2 for value in values))


def relative(run: dict, label: str) -> float:
    """RMS of the seven range errors that the calibration alone makes, as shares of the ranges."""
    ranges = [math.hypot(*point) for point in run["targets"]]
    errors = run["located"][label]["range_error"]
    return rms([error / true for error, true in zip(errors, ranges, strict=True)])


def edge_means(run: dict, label: str) -> tuple[float, float]:
    """Mean reprojection error of the points in the middle half of the image, and of the others."""
    central = [abs(pixel[0] - 959.5) < 480 for pixel in run["target_pixels"]]
    errors = run["located"][label]["reprojection"]
    groups = [[e for e, inside in zip(errors, central, strict=True) if inside == wanted] for wanted in (True, False)]
    return statistics.fmean(groups[0]), statistics.fmean(groups[1])
