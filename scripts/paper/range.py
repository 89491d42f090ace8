"""Parts of docs/measured/paper.md about range: error by distance, choice of the model, center and edge."""

from __future__ import annotations

import math

from scripts.paper.numbers import (
    DISTANCES,
    FIGURE_9,
    SHOWN,
    TABLE_3,
    Results,
    calibration,
    edge_means,
    lowest,
    median,
    middle,
    number,
    relative,
    reprojection,
    rms,
)
from scripts.paper.split import FAR_M
from scripts.shared.page import Lines, table


def distance(results: Results) -> list[str]:
    def worst(run: dict, label: str) -> float:
        return max(reprojection(run, label))

    rows = [["paper", *(FIGURE_9.get(label, "–") for label in SHOWN)]]
    rows += [
        [name, *(number(median(worst(run, m) for run in runs), 2) for m in SHOWN)] for name, runs in results.items()
    ]
    lines = ["Largest reprojection error of the seven points, pixels:", "", *table(["", *SHOWN], rows), ""]
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


def choice(results: Results) -> list[str]:
    rows: list[list[str]] = []
    gains: list[float] = []
    for name, runs in results.items():
        models = [*TABLE_3, "hybrid"]
        chosen: dict[str, list[str]] = {
            "views": [lowest({m: run["held_out"][m] for m in models}) for run in runs],
            "checks": [lowest({m: rms(run["located"][m]["check_reprojection"]) for m in models}) for run in runs],
            "leak": [lowest({m: relative(run, m) for m in models}) for run in runs],
            "hybrid": ["hybrid"] * len(runs),
            "20": ["20"] * len(runs),
            "14": ["14"] * len(runs),
        }
        scores = {
            how: [100 * relative(run, label) if label else math.nan for run, label in zip(runs, which, strict=True)]
            for how, which in chosen.items()
        }
        gains += [a - b for a, b in zip(scores["views"], scores["leak"], strict=True) if math.isfinite(a - b)]
        rows.append([name, *(middle(values, 2) for values in scores.values())])
    heads = ["", "held-out views", "check points", "the seven points (leak)", "hybrid", "always 20", "always 14"]
    return [
        *table(heads, rows),
        "",
        "The third column chooses by the seven points on which it is scored, so its score is the lowest possible. "
        f"It is {middle(gains, 2)} percentage points below the first column: this is the bias of the paper's choice.",
    ]


def edges(results: Results) -> Lines:
    yield ["camera", "", *SHOWN]
    for name, runs in results.items():
        for which, title in ((0, "center"), (1, "edge")):
            cells = [median(edge_means(run, label)[which] for run in runs) for label in SHOWN]
            yield [name, title, *(number(cell, 2) for cell in cells)]
