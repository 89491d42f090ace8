"""The paper's experiment on simulated rigs: its tables and figures, each beside the paper's own numbers.

Three kinds of cameras stand for the paper's: wide glass lenses that are poorly centered, plastic aspheres, and machine
vision lenses; all are ray-traced (`kcal.sim.truth`), so that no lens model of kcal or OpenCV is the truth. Every seed
is another pair of lenses, another set of board views, survey and marks. Images are rendered, spoiled and searched;
corners and results of each seed stay in FOLDER, and a run that was interrupted goes on from there: a changed kcal needs
another folder. Processes for other `--kinds` may work in the same one.
"""

from __future__ import annotations

import functools
import itertools
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path

from scripts.paper.figures import write_figures
from scripts.paper.page import SECTIONS, Results, table_2
from scripts.paper.site import KINDS
from scripts.paper.solve import ALL, run_seed
from scripts.shared.page import Line, Lines
from scripts.shared.sections import section

# Of runs in little, which share one draw.
_LITTLE = tempfile.TemporaryDirectory(prefix="kcal-paper-")


@functools.cache
def results_of(work: Path, seeds: int, views: int, kinds: tuple[str, ...], models: tuple[str, ...]) -> Results:
    """Seed by seed, so that a run that is stopped has something of every kind."""
    results: Results = {}
    for seed, name in itertools.product(range(seeds), kinds):
        results.setdefault(name, []).append(run_seed(work / f"{name}-{seed}-{views}", name, seed, views, models))
    return results


def _registered(name: str, made: Callable[[Results], Iterable[Line]]) -> None:
    @section("paper.md", name, kinds=("vision",), seeds=1, views=5, models=("14",), work=Path(_LITTLE.name))
    def part(
        work: Path = Path("build/paper"), seeds: int = 5, views: int = 30, kinds: tuple[str, ...] = tuple(KINDS),
        models: tuple[str, ...] = tuple(ALL), write: bool = False,
    ) -> Lines:  # fmt: skip
        """Views of each camera; corners and results stay in the folder."""
        if not set(kinds) <= {*KINDS}:
            raise SystemExit(f"kinds of cameras: {', '.join(KINDS)}")
        results = results_of(work, seeds, views, kinds, models)
        yield from made(results)
        if write and name == "split":
            write_figures(results)


for _name, _made in SECTIONS.items():
    _registered(_name, _made)
section("paper.md", "table 2")(table_2)
