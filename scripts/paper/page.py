"""The tables of docs/measured/paper.md from the results of `reproduce.py`; every figure in them is computed here."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator

from scripts.paper.numbers import TABLE_3, Results, median, number, position
from scripts.paper.range import choice, distance, edges
from scripts.paper.site import MARK_SIGMA
from scripts.paper.split import split
from scripts.paper.tables import table_1, table_3
from scripts.shared.page import Lines, table


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


def _marks(results: Results) -> Iterator[str]:
    shown = [("14", "integer"), ("14", "marked"), ("20", "marked"), ("hybrid", "marked")]
    rows = []
    for name, runs in results.items():
        rows.append([name, *(number(100 * _far_share(runs, label, kind), 1) for label, kind in shown)])
    heads = ["14, whole pixels", *(f"{label}, marks to {MARK_SIGMA:g} px" for label, _ in shown[1:])]
    return table(["", *heads], rows)


def _far_share(runs: list[dict], label: str, kind: str) -> float:
    errors = []
    for run in runs:
        for true, found in zip(run["targets"][3:], run["located"][label][kind][3:], strict=True):
            errors.append(abs(math.hypot(*found) / math.hypot(*true) - 1.0))
    return median(errors)


SECTIONS: dict[str, Callable[[Results], Iterable[str]]] = {
    "split": split,
    "table 1": table_1,
    "table 3": table_3,
    "models": _figure_3,
    "marks": _marks,
    "distance": distance,
    "choice": choice,
    "edges": edges,
}
