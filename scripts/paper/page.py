"""The tables of docs/measured/paper.md from the results of `reproduce.py`; every figure in them is computed here.

The pictures of docs/measured/paper.md: error by source, coverage, models, distance, center and edge, map.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from kcal.locate.budget import BudgetErrors, planned_rig, range_errors
from kcal.report.figures import new_figure, save_picture
from kcal.texts import range_text
from scripts.paper.locate import KINDS, MARK_SIGMA
from scripts.shared.page import DOCS, Line, Lines, table

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


FAR_M = 5003.0  # range of the farthest target
LIMIT = 0.01 * FAR_M
LANDMARKS = 12


def split(results: Results) -> list[str]:
    """What the error at 5 km is made of."""
    rows, limits = [], []
    for name, runs in results.items():
        for label in (*SHOWN, MIXED):
            lens, rig, both, far, over = (
                [value(run, label) for run in runs]
                for value in (lens_share, rig_share, calibration, everywhere, over_bound)
            )
            cells = [number(median(lens), 0), number(median(rig), 0), middle(both, 0)]
            cells += [number(median(run["bound"][-1] for run in runs), 0), number(median(over), 2), middle(far, 0)]
            rows.append([name, label, *cells])
        limits += ["", _limits(name, runs)]
    heads = ["camera", "model", "lenses", "rig", "calibration", "marks", "total / marks", "all over the image"]
    return [*table(heads, rows), *limits]


def _limits(name: str, runs: list[dict]) -> str:
    """What an error of 1 % would need: which landmarks, or which lens."""
    lens, rig, both = (median(value(run, "hybrid") for run in runs) for value in (lens_share, rig_share, calibration))
    if not math.isfinite(both):
        return f"*{name}*: half of the draws or more have no rig."
    larger = "its lenses" if lens > rig else "the landmarks' noise"
    text = (
        f"*{name}*: the larger part of the hybrid's {both:.0f} m is {larger} ({lens:.0f} m of lenses, {rig:.0f} m of "
        "rig). "
    )
    if lens >= LIMIT:
        text += f"More landmarks cannot bring it to {LIMIT:.0f} m: that takes better corners or more views."
    else:
        # Independent landmarks as good as these, spread likewise.
        needed = math.ceil(LANDMARKS * rig**2 / (LIMIT**2 - lens**2))
        word = "are enough" if needed <= LANDMARKS else "would be needed"
        text += f"For {LIMIT:.0f} m (1 %), {needed} landmarks like these {word}, as noise averages."
    return text


def table_1(results: Results) -> list[Line]:
    paper = [("Surveillance camera", 0.22, 0.20), ("Surveillance camera", 0.24, 0.21)]
    paper += [("Machine vision lens", 0.07, 0.07), ("Webcam", 0.10, 0.08)]
    sources = [("glass", "left"), ("glass", "right"), ("vision", "left"), ("plastic", "left")]
    rows, smaller, total, ratios, whole = [], 0, 0, [], []
    for (title, theirs, ours), (name, side) in zip(paper, sources, strict=True):
        if name not in results:
            continue
        pairs = [(run["cameras"]["OpenCV"][side]["rms"], run["cameras"]["14"][side]["rms"]) for run in results[name]]
        smaller += sum(own < other for other, own in pairs)
        total += len(pairs)
        whole.append(median(run["cameras"]["hybrid"][side]["rms"] for run in results[name]))
        other, own = middle([a for a, _ in pairs]), middle([b for _, b in pairs])
        ratios.append(ours / median(b for _, b in pairs))
        rows.append([f"{title}: {KINDS[name].title}, {side}", theirs, ours, other, own])
    return [
        ["camera", "paper, OpenCV", "paper, own", "OpenCV here", "kcal here"],
        *rows,
        f"In {smaller} of {total} calibrations kcal's residual is the smaller one. The paper's own residuals are "
        f"{min(ratios):.1f} to {max(ratios):.1f} times those of kcal here. Most of a residual is the board: the same "
        f"corners leave {min(whole):.3f} to {max(whole):.3f} px (medians of the rows) once kcal's default camera has "
        "measured it. A residual measures board and corners first and the lens last.",
    ]


def table_2() -> list[Line]:
    paper = {2.0: (125.0, 3125.0), 1.0: (62.5, 1562.5), 0.5: (31.25, 781.25), 0.1: (6.25, 156.25)}
    rows = []
    for disparity, (near, far) in paper.items():
        found = range_errors(planned_rig(), [1000.0, 5000.0], BudgetErrors(disparity_px=disparity))["disparity"]
        cells: list[object] = []
        for which, value in enumerate((near, far)):
            nearer, farther, slope = (float(part[which]) for part in found)
            cells += [f"{value:g}", f"{slope:.2f}", f"{nearer:.0f} to +{farther:.0f}"]
        rows.append([f"{disparity:g}", *cells])
    near, far, _ = (
        float(part[0]) for part in range_errors(planned_rig(), [5000.0], BudgetErrors(disparity_px=2.0))["disparity"]
    )
    return [
        ["Δd, px", "paper, 1 km", "slope", "exact", "paper, 5 km", "slope", "exact"],
        *rows,
        "The paper's formula, ΔZ = Z² Δd / (f B) with f B = 16 000 px m, is the slope at the true point, and kcal's "
        f"slope is the same. Exactly, the error is not symmetric: 2 px at 5 km put a point {-near / 1000:.1f} km too "
        f"near or {far / 1000:.1f} km too far.",
    ]


def table_3(results: Results) -> list[Line]:
    heads = [f"{name}, {side}" for name in results for side in ("right", "left")]
    rows, gains = [], []
    for label, paper in TABLE_3.items():
        cells = [
            number(median(run["cameras"][label][side]["rms"] for run in runs), 4)
            for runs in results.values()
            for side in ("right", "left")
        ]
        rows.append([label, *paper, *cells])
    for name, runs in results.items():
        gain = [
            100 * (1 - run["cameras"]["20"][side]["rms"] / run["cameras"]["14"][side]["rms"])
            for run in runs
            for side in ("left", "right")
        ]
        gains.append(f"{middle(gain, 1)} % ({name})")
    return [
        ["coefficients", "paper, right", "left", *heads],
        *rows,
        f"From 14 to 20 coefficients the paper's residual falls by 0.1 %; here by {', '.join(gains)}. A flat table "
        "says that something else than the lens is left: here it is the print of the board, which no coefficient "
        "describes. The paper's 0.2 px may be of the same kind.",
    ]


def distance(results: Results) -> list[Line]:
    def worst(run: dict, label: str) -> float:
        return max(reprojection(run, label))

    rows = [["paper", *(FIGURE_9.get(label, "–") for label in SHOWN)]]
    rows += [
        [name, *(number(median(worst(run, m) for run in runs), 2) for m in SHOWN)] for name, runs in results.items()
    ]
    lines: list[Line] = ["Largest reprojection error of the seven points, pixels:", ["", *SHOWN], *rows, ""]
    rows = []
    for name, runs in results.items():
        for label in SHOWN:
            columns = [median(calibration(run, label, i) for run in runs) for i in range(len(DISTANCES))]
            share = number(100 * columns[-1] / FAR_M, 2)
            rows.append([name, label, *(number(column, 1) for column in columns), share])
        marks = [median(column) for column in zip(*(run["bound"] for run in runs), strict=True)]
        rows.append([name, "marks alone", *(number(v, 1) for v in marks), number(100 * marks[-1] / FAR_M, 2)])
    lines += ["Range error by calibration, meters; the last column is percent at 5 km:", ""]
    return [*lines, *table(["camera", "model", *DISTANCES, "%"], rows)]


def choice(results: Results) -> list[Line]:
    rows: list[list[str]] = []
    gains: list[float] = []
    for name, runs in results.items():
        models = [*TABLE_3, "hybrid"]
        chosen: dict[str, list[str]] = {
            "views": [lowest({m: run["held_out"][m] for m in models}) for run in runs],
            "checks": [lowest({m: rms(run["located"][m]["check_reprojection"]) for m in models}) for run in runs],
            "leak": [lowest({m: relative(run, m) for m in models}) for run in runs],
            **{label: [label] * len(runs) for label in ("hybrid", "20", "14")},
        }
        scores = {
            how: [100 * relative(run, label) if label else math.nan for run, label in zip(runs, which, strict=True)]
            for how, which in chosen.items()
        }
        gains += [a - b for a, b in zip(scores["views"], scores["leak"], strict=True) if math.isfinite(a - b)]
        rows.append([name, *(middle(values, 2) for values in scores.values())])
    heads = ["", "held-out views", "check points", "the seven points (leak)", "hybrid", "always 20", "always 14"]
    return [
        heads,
        *rows,
        "The third column chooses by the seven points on which it is scored, so its score is the lowest possible. "
        f"It is {middle(gains, 2)} percentage points below the first column: this is the bias of the paper's choice.",
    ]


def edges(results: Results) -> Lines:
    yield ["camera", "", *SHOWN]
    for name, runs in results.items():
        for which, title in ((0, "center"), (1, "edge")):
            cells = [median(edge_means(run, label)[which] for run in runs) for label in SHOWN]
            yield [name, title, *(number(cell, 2) for cell in cells)]


def _figure_3(results: Results) -> Lines:
    models = [*TABLE_3, "hybrid"]
    yield ["camera", "", *models]
    for name, runs in results.items():
        positions = {m: [position(run, m) for run in runs] for m in models}
        held_out = {m: [run["held_out"][m] for run in runs] for m in models}
        infinity = {
            m: [run["cameras"][m][side]["infinity"] for run in runs for side in ("left", "right")] for m in models
        }
        yield from [
            [name, "position, RMS of seven, m", *(number(median(positions[m]), 0) for m in models)],
            [name, "error at infinity, RMS, px", *(number(median(infinity[m]), 3) for m in models)],
            [name, "held-out views, px", *(number(median(held_out[m]), 4) for m in models)],
        ]


def _marks(results: Results) -> Lines:
    shown = [("14", "integer"), ("14", "marked"), ("20", "marked"), ("hybrid", "marked")]
    yield ["", "14, whole pixels", *(f"{label}, marks to {MARK_SIGMA:g} px" for label, _ in shown[1:])]
    for name, runs in results.items():
        yield [name, *(number(100 * _far_share(runs, label, kind), 1) for label, kind in shown)]


def _far_share(runs: list[dict], label: str, kind: str) -> float:
    errors = []
    for run in runs:
        for true, found in zip(run["targets"][3:], run["located"][label][kind][3:], strict=True):
            errors.append(abs(math.hypot(*found) / math.hypot(*true) - 1.0))
    return median(errors)


SECTIONS: dict[str, Callable[[Results], Iterable[Line]]] = {
    "split": split,
    "table 1": table_1,
    "table 3": table_3,
    "models": _figure_3,
    "marks": _marks,
    "distance": distance,
    "choice": choice,
    "edges": edges,
}


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
