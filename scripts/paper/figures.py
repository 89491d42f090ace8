"""The pictures of docs/measured/paper.md: error by source, coverage, models, distance, center and edge, map."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from kcal.report.figures import new_figure, save_picture
from kcal.texts import range_text
from scripts.paper.page import (
    DISTANCES,
    LIMIT,
    SHOWN,
    TABLE_3,
    Results,
    calibration,
    lens_share,
    median,
    position,
    reprojection,
    rig_share,
)
from scripts.shared.page import DOCS

COLORS = {
    "14": "#dd7a1f", "16": "#b7791f", "18": "#8a5a00", "20": "#2b6cb0", "24": "#6b46c1", "hybrid": "#2f855a",
    "OpenCV": "#6b7280",
}  # fmt: skip
TRUE, FOUND, FAINT, INK, GRID = "#c02a6b", "#2b6cb0", "#9aa3af", "#111827", "#e5e7eb"


def write_figures(results: Results) -> None:
    _split(results)
    _models(results)
    _distance(results)
    _map(results)


def _split(results: Results) -> None:
    """Medians of the parts of the error at 5 km, side by side: they add up in squares."""
    figure = new_figure(4.6 * len(results), 4.2)
    first = None
    for column, (name, runs) in enumerate(results.items()):
        axes = first = figure.add_subplot(1, len(results), column + 1, sharey=first)
        place = np.arange(len(SHOWN))
        for shift, value, title, color in (
            (-0.25, lens_share, "lenses", COLORS["20"]),
            (0.0, rig_share, "rig (landmarks' noise)", COLORS["14"]),
        ):
            axes.bar(place + shift, _shown(median(value(run, m) for run in runs) for m in SHOWN), 0.24, color=color,
                     label=title)  # fmt: skip
        total = _shown(median(run["located"][m]["total"][-1] for run in runs) for m in SHOWN)
        axes.bar(place + 0.25, total, 0.24, color=FAINT, label="total, with the target's marks")
        axes.axhline(median(run["bound"][-1] for run in runs), color=INK, linestyle="--", linewidth=1,
                     label="marks alone")  # fmt: skip
        axes.axhline(LIMIT, color=TRUE, linestyle=":", linewidth=1.2, label="1 %")
        axes.set_yscale("log")
        axes.set_xticks(place, SHOWN)
        axes.tick_params(labelsize=8)
        axes.set_title(f"{name}: range error at 5 km, m", fontsize=10, loc="left")
        axes.grid(axis="y", color=GRID, linewidth=0.6)
        axes.set_axisbelow(True)
    # All share it: its limits must count every bar.
    _logarithmic(axes)
    _legend_below(figure, axes)
    save_picture(DOCS / "paper-split.png", figure)


def _shown(values: Iterable[float]) -> list[float]:
    """What failed has no bar."""
    return [value if math.isfinite(value) else math.nan for value in values]


def _logarithmic(axes: Axes) -> None:
    """A logarithmic axis with plain numbers, of a decade at least: small differences are to look small."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    wider = max(1.0, 10.0 * low / high) ** 0.5
    axes.set_ylim(low / wider, high * wider)
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _legend_below(figure: Figure, axes: Axes) -> None:
    handles, titles = axes.get_legend_handles_labels()
    height = 0.35 / figure.get_size_inches()[1]
    figure.tight_layout(rect=(0, height, 1, 1))
    figure.legend(handles, titles, loc="lower center", ncols=len(titles), fontsize=9, frameon=False)


def _models(results: Results) -> None:
    figure = new_figure(11.0, 3.6 * len(results))
    models = [*TABLE_3, "hybrid"]
    panels = (
        ("RMS position error of seven points by calibration, m", position),
        ("RMS of held-out views, pixels", lambda run, label: run["held_out"][label]),
    )
    place = np.arange(len(models))
    for line, (name, runs) in enumerate(results.items()):
        for column, (title, value) in enumerate(panels):
            axes = figure.add_subplot(len(results), 2, 2 * line + column + 1)
            values = np.array([[value(run, m) for m in models] for run in runs])
            middles = np.array([median(column) for column in values.T])
            values[~np.isfinite(values)] = np.nan
            middles[~np.isfinite(middles)] = np.nan
            axes.plot(place, values.T, color=FAINT, linewidth=0.8, marker=".", markersize=4)
            axes.plot(place, middles, color=FOUND, linewidth=2, marker="o")
            axes.set_xticks(place, models)
            if np.isfinite(middles).any():
                _logarithmic(axes)
            axes.grid(axis="y", color=GRID, linewidth=0.6)
            axes.set_title(f"{name}: {title}", fontsize=10, loc="left")
    axes.set_xlabel("coefficients; gray: each draw, blue: median", fontsize=9)
    figure.tight_layout()
    save_picture(DOCS / "paper-models.png", figure)


def _distance(results: Results) -> None:
    figure = new_figure(12.0, 4.2 * len(results))
    place = np.arange(len(DISTANCES))
    for line, (name, runs) in enumerate(results.items()):
        left, right = (figure.add_subplot(len(results), 2, 2 * line + column + 1) for column in (0, 1))
        true = np.array([math.hypot(*point) for point in runs[0]["targets"]])
        for shift, label in zip(np.linspace(-0.12, 0.12, len(SHOWN)), SHOWN, strict=True):
            pixels = np.array([reprojection(run, label) for run in runs])
            meters = np.array([[calibration(run, label, i) for i in range(len(true))] for run in runs]) / true * 100
            for axes, values in ((left, pixels), (right, meters)):
                middles = np.array(_shown(median(column) for column in values.T))
                values[~np.isfinite(values)] = np.nan
                bars = np.clip([middles - np.nanmin(values, 0), np.nanmax(values, 0) - middles], 0, None)
                axes.errorbar(
                    place + shift, middles, bars, color=COLORS[label], marker="o", markersize=4, capsize=2,
                    linewidth=1.2, elinewidth=0.8, label=label,
                )  # fmt: skip
        noise = np.median([run["bound"] for run in runs], 0) / true * 100
        right.plot(place, noise, color=INK, linestyle="--", linewidth=1, label="marks' noise alone, σ")
        for axes, title in ((left, "reprojection error, pixels"), (right, "range error by calibration, %")):
            _logarithmic(axes)
            axes.set_xticks(place, DISTANCES)
            axes.set_title(f"{name}: {title}", fontsize=10, loc="left")
            axes.grid(axis="y", color=GRID, linewidth=0.6)
    _legend_below(figure, right)
    save_picture(DOCS / "paper-distance.png", figure)


def _map(results: Results) -> None:
    """Plan view of the first draw of plastic lenses, which differ most: as the paper's Fig. 6 and 11."""
    panels = [("14", "integer"), ("14", "marked"), ("20", "marked"), ("hybrid", "marked")]
    name = "plastic" if "plastic" in results else next(iter(results))
    run = results[name][0]
    figure = new_figure(6.8, 5.1)
    for place, (label, kind) in enumerate(panels, 1):
        axes = figure.add_subplot(2, 2, place)
        title = {"integer": "whole pixels", "marked": "sub-pixel marks"}[kind]
        _plan(axes, run["targets"], run["located"][label][kind])
        axes.set_title(f"{name}: {label}, {title}", fontsize=10)
    figure.tight_layout()
    save_picture(DOCS / "paper-map.png", figure)


def _plan(axes: Axes, true: list, found: list) -> None:
    def radius(meters: float) -> float:
        return math.log1p(meters / 50.0)

    def place(point: list[float]) -> tuple[float, float]:
        distance = max(math.hypot(point[0], point[1]), 1e-9)
        return point[0] / distance * radius(distance), point[1] / distance * radius(distance)

    for arc in (100, 250, 500, 1000, 2500, 5000, 10000):
        turn = np.linspace(math.radians(-25), math.radians(60), 60)
        axes.plot(radius(arc) * np.sin(turn), radius(arc) * np.cos(turn), color=FAINT, linewidth=0.6)
        label = range_text(arc)
        axes.text(radius(arc) * math.sin(turn[-1]), radius(arc) * math.cos(turn[-1]), label, fontsize=6, color=FAINT)
    for number, (a, b) in enumerate(zip(true, found, strict=True), 1):
        start = place(a)
        axes.scatter(*start, color=TRUE, s=22, zorder=3)
        axes.annotate(str(number), start, textcoords="offset points", xytext=(4, 3), fontsize=7, color=TRUE)
        if all(map(math.isfinite, b)):
            end = place(b)
            axes.plot(*zip(start, end, strict=True), color=FOUND, linewidth=1)
            axes.scatter(*end, color=FOUND, s=14, zorder=4)
    axes.set_aspect("equal")
    axes.set_axis_off()
