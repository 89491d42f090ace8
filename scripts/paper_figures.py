"""The pictures of docs/paper.md: coverage, models, distance, centre and edge, map."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from page import DOCS
from paper_numbers import DISTANCES, SHOWN, TABLE_3, Results, edge_means, labels, median, rms
from paper_site import KINDS

from kcal.corners.observations import Observations
from kcal.report.figures import new_figure, save_png

COLOURS = {
    "14": "#dd7a1f", "16": "#b7791f", "18": "#8a5a00", "20": "#2b6cb0", "24": "#6b46c1", "hybrid": "#2f855a",
    "field": "#9f1239", "OpenCV": "#6b7280",
}  # fmt: skip
TRUE, FOUND, FAINT, INK = "#c02a6b", "#2b6cb0", "#9aa3af", "#111827"


def write_figures(results: Results, work: Path, views: int) -> None:
    rigs = {name: runs for name, runs in results.items() if name in KINDS}
    _coverage(work, next(iter(rigs)), views)
    _models(rigs)
    _distance(rigs)
    _edges(rigs)
    _map(rigs)


def _coverage(work: Path, name: str, views: int) -> None:
    seen = Observations.load(work / f"{name}-0-{views}" / "left.kcal.json")
    figure = new_figure(8.0, 4.9)
    axes = figure.subplots()
    width, height = seen.image_size
    for number, view in enumerate(seen.pixels().numpy()):
        axes.scatter(view[:, 0], view[:, 1], s=5, linewidths=0, color=_turbo(number / len(seen.views)))
    axes.add_patch(Rectangle((-0.5, -0.5), width, height, fill=False, edgecolor=INK))
    axes.set_xlim(-30, width + 30)
    axes.set_ylim(height + 30, -30)
    axes.set_aspect("equal")
    axes.set_title(
        f"Corners of {len(seen.views)} views, one colour a view (the paper's Fig. 1)", fontsize=11, loc="left"
    )
    axes.set_xlabel("u, pixels")
    axes.set_ylabel("v, pixels")
    figure.tight_layout()
    save_png(DOCS / "paper-coverage.png", figure)


def _turbo(share: float) -> tuple[float, float, float, float]:
    from matplotlib import colormaps

    return colormaps["turbo"](share)


def _models(rigs: Results) -> None:
    figure = new_figure(11.0, 4.2 * len(rigs))
    for line, (name, runs) in enumerate(rigs.items()):
        models = labels(runs, [*TABLE_3, "hybrid", "field"])
        place = np.arange(len(models))
        for column, (title, value) in enumerate(
            (
                (
                    "RMS position error of seven points by calibration, m",
                    lambda r, m: rms(r["located"][m]["position_error"]),
                ),
                ("RMS of held-out views, pixels", lambda r, m: r["held_out"][m]),
            )
        ):
            axes = figure.add_subplot(len(rigs), 2, 2 * line + column + 1)
            values = np.array([[value(run, m) for m in models] for run in runs])
            axes.plot(place, values.T, color=FAINT, linewidth=0.8)
            axes.plot(place, np.nanmedian(values, 0), color=FOUND, linewidth=2, marker="o")
            axes.set_xticks(place, models)
            axes.set_yscale("log")
            axes.set_title(f"{name}: {title}", fontsize=10, loc="left")
            axes.set_xlabel("coefficients; grey: each draw, blue: median", fontsize=9)
    figure.tight_layout()
    save_png(DOCS / "paper-models.png", figure)


def _distance(rigs: Results) -> None:
    figure = new_figure(12.0, 4.6 * len(rigs))
    for line, (name, runs) in enumerate(rigs.items()):
        left, right = (figure.add_subplot(len(rigs), 2, 2 * line + column + 1) for column in (0, 1))
        place = np.arange(len(DISTANCES))
        true = np.array([math.hypot(*point) for point in runs[0]["targets"]])
        models = labels(runs, SHOWN)
        for shift, label in zip(np.linspace(-0.18, 0.18, len(models)), models, strict=True):
            pixels = np.array([run["located"][label]["reprojection"] for run in runs])
            metres = np.abs([run["located"][label]["range_error"] for run in runs]) / true * 100
            for axes, values in ((left, pixels), (right, metres)):
                middle = np.nanmedian(values, 0)
                bars = [middle - np.nanmin(values, 0), np.nanmax(values, 0) - middle]
                axes.errorbar(
                    place + shift, middle, bars, color=COLOURS[label], marker="o", markersize=4, capsize=2,
                    linewidth=1.2, elinewidth=0.8, label=label,
                )  # fmt: skip
        noise = np.median([run["bound"] for run in runs], 0) / true * 100
        right.plot(place, noise, color=INK, linestyle="--", linewidth=1, label="marks' noise alone, σ")
        for axes, title in ((left, "reprojection error, pixels"), (right, "range error by calibration, %")):
            axes.set_yscale("log")
            axes.set_xticks(place, DISTANCES)
            axes.set_title(f"{name}: {title}; median, smallest, largest of {len(runs)}", fontsize=10, loc="left")
            axes.grid(axis="y", color="#e5e7eb", linewidth=0.6)
        right.legend(fontsize=8)
    figure.tight_layout()
    save_png(DOCS / "paper-distance.png", figure)


def _edges(rigs: Results) -> None:
    figure = new_figure(5.5 * len(rigs), 4.0)
    for column, (name, runs) in enumerate(rigs.items()):
        axes = figure.add_subplot(1, len(rigs), column + 1)
        models = labels(runs, SHOWN)
        place = np.arange(len(models))
        for shift, which, title, colour in ((-0.2, 0, "centre", FAINT), (0.2, 1, "edge", FOUND)):
            values = [median(edge_means(run, m)[which] for run in runs) for m in models]
            axes.bar(place + shift, values, 0.38, color=colour, label=title)
        axes.set_xticks(place, models)
        axes.set_ylabel("mean reprojection error, pixels")
        axes.set_title(f"{name}: median over draws (the paper's Fig. 10)", fontsize=10, loc="left")
        axes.legend(fontsize=9)
    figure.tight_layout()
    save_png(DOCS / "paper-edges.png", figure)


def _map(rigs: Results) -> None:
    """Plan view of the first draw, with a logarithmic range: as the paper's Fig. 6 and 11."""
    figure = new_figure(13.5, 2.7 * len(rigs))
    for line, (name, runs) in enumerate(rigs.items()):
        last = "field" if "field" in runs[0]["located"] else "24"
        panels = [("14", "integer"), ("14", "marked"), ("20", "marked"), (last, "marked")]
        for column, (label, kind) in enumerate(panels):
            axes = figure.add_subplot(len(rigs), 4, 4 * line + column + 1)
            title = {"integer": "whole pixels", "marked": "sub-pixel marks"}[kind]
            _plan(axes, runs[0]["targets"], runs[0]["located"][label][kind])
            axes.set_title(f"{name}: {label}, {title}", fontsize=10)
    figure.tight_layout()
    save_png(DOCS / "paper-map.png", figure)


def _plan(axes: Axes, true: list, found: list) -> None:
    def radius(metres: float) -> float:
        return math.log1p(metres / 50.0)

    def place(point: list[float]) -> tuple[float, float]:
        distance = max(math.hypot(point[0], point[1]), 1e-9)
        return point[0] / distance * radius(distance), point[1] / distance * radius(distance)

    for arc in (100, 250, 500, 1000, 2500, 5000, 10000):
        turn = np.linspace(math.radians(-25), math.radians(60), 60)
        axes.plot(radius(arc) * np.sin(turn), radius(arc) * np.cos(turn), color=FAINT, linewidth=0.6)
        label = f"{arc / 1000:g} km" if arc >= 1000 else f"{arc} m"
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
