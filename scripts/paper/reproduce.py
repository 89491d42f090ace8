"""The paper's experiment on simulated rigs: its tables and figures, each beside the paper's own numbers.

Three kinds of cameras stand for the paper's: wide glass lenses that are poorly centered, plastic aspheres, and machine
vision lenses; all are ray-traced (`kcal.sim.truth`), so that no lens model of kcal or OpenCV is the truth. Every seed
is another pair of lenses, another set of board views, survey and marks. Images are rendered, spoiled and searched;
corners and results of each seed stay in FOLDER, and a run that was interrupted goes on from there: a changed kcal needs
another folder. Processes for other `--kinds` may work in the same one.

One draw of the paper's experiment: both cameras calibrated with every model, rigs solved, seven points located.
"""

from __future__ import annotations

import functools
import itertools
import json
import math
import tempfile
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from kcal import CalibrationOptions, Camera, KcalError, Observations, calibrate_camera
from kcal.calibrate import compare_models
from kcal.sim.truth import TruthLens
from scripts.paper.locate import KINDS, bound, by_kcal, by_opencv, judge, nowhere, observe, paper_scene
from scripts.paper.page import SECTIONS, Results, table_2, write_figures
from scripts.shared.captures import error_at_infinity
from scripts.shared.page import Line, Lines, section
from scripts.shared.peer_lenses import as_camera, calibrated

# What the paper calls 14, 16, 18, 20, 20 (its second one), 22 and 24 parameters.
MODELS = {"14": "opencv14", "16": "ext16", "18": "ext18", "20": "ext20", "20b": "ext20b", "22": "ext22", "24": "ext24"}
ALL = {**MODELS, "hybrid": "hybrid"}
NAN = math.nan
# What ends one model and not the whole run.
REFUSED = (KcalError, RuntimeError)
Pair = dict[str, tuple[Camera, float]]  # of both sides: a camera and its RMS


def run_seed(folder: Path, name: str, seed: int, views: int, models: Collection[str] = ALL) -> dict[str, Any]:
    """Everything of one seed of one kind of camera; what is in the folder is not made again, nor other models."""
    folder.mkdir(parents=True, exist_ok=True)
    return _Run(folder, name, seed, views).everything(models)


class _Run:
    """One draw; results go to the folder's `result.json` after every model."""

    def __init__(self, folder: Path, name: str, seed: int, views: int) -> None:
        self.folder, self.seed, self.name = folder, seed, name
        self.scene = paper_scene(KINDS[name], seed)
        rig: Any = self.scene.rig
        self.true: dict[str, TruthLens] = {"left": rig.left, "right": rig.right}
        self.path = folder / "result.json"
        self.result: dict[str, Any] = {
            "name": name, "seed": seed, "cameras": {}, "held_out": {}, "located": {},
        }  # fmt: skip
        if self.path.exists():
            self.result |= json.loads(self.path.read_text())
        for side in self.true:
            if not all((folder / f"{side}.{who}.json").exists() for who in ("kcal", "opencv")):
                observe(folder, name, self.scene, side, views)
        self.seen = {side: Observations.load(folder / f"{side}.kcal.json") for side in self.true}
        self.plain = {side: Observations.load(folder / f"{side}.opencv.json") for side in self.true}

    def everything(self, models: Collection[str]) -> dict[str, Any]:
        self.result["bound"] = bound(self.scene)
        self.result["targets"] = self.scene.targets.enu.tolist()
        self.result["target_pixels"] = self.scene.target_marks.true_left.tolist()
        for label, model in ALL.items():
            if label not in self.result["located"]:
                self._model(label, model) if label in models else self._locate(label, None)
        if not self.result["held_out"]:
            self._held_out({label: model for label, model in ALL.items() if label in models})
        if not {"OpenCV", "OpenCV, kcal's rig"} <= set(self.result["located"]):
            self._opencv()
        return self.result

    def _model(self, label: str, model: str) -> None:
        pair = None
        with suppress(*REFUSED):
            found = {s: calibrate_camera(seen, CalibrationOptions(model=model)) for s, seen in self.seen.items()}
            pair = {side: (each.camera, each.rms) for side, each in found.items()}
        self._locate(label, pair)

    def _held_out(self, models: dict[str, str]) -> None:
        """RMS of views that were held out, of both cameras together."""
        # Poses are drawn and have no neighbors: every view may be held out for itself.
        found = [
            compare_models(seen, tuple(models.values()), groups="views", options=CalibrationOptions())
            for seen in self.seen.values()
        ]
        self.result["held_out"] = dict.fromkeys(ALL, NAN)
        for label, model in models.items():
            squared = sum(each.rms[model] ** 2 for each in found) / len(found)
            self.result["held_out"][label] = math.sqrt(squared) if math.isfinite(squared) else NAN
        self._keep()

    def _opencv(self) -> None:
        pair, raw = Pair(), dict[str, Any]()
        for side, seen in self.plain.items():
            rms, matrix, lens = calibrated(seen, 14)
            pair[side], raw[side] = (as_camera(matrix, lens, seen.image_size, "opencv14"), rms), (matrix, lens)
        # Their lenses with kcal's rig and rays tell what of the difference is not lenses.
        self._locate("OpenCV, kcal's rig", pair)
        self.result["cameras"]["OpenCV"] = self.result["cameras"]["OpenCV, kcal's rig"]
        self.result["located"]["OpenCV"] = judge(self.scene, partial(by_opencv, raw))
        self._keep()

    def _locate(self, label: str, pair: Pair | None) -> None:
        if pair is None:
            none = dict.fromkeys(("rms", "infinity"), NAN)
            self.result["cameras"][label] = dict.fromkeys(self.true, none)
            self.result["located"][label] = nowhere(self.scene)
        else:
            self.result["cameras"][label] = {
                side: {"rms": pair[side][1], "infinity": error_at_infinity(pair[side][0], lens).rms}
                for side, lens in self.true.items()
            }
            cameras = pair["left"][0], pair["right"][0]
            self.result["located"][label] = judge(self.scene, partial(by_kcal, cameras))
        self._keep()

    def _keep(self) -> None:
        part = self.path.with_suffix(".part")
        part.write_text(json.dumps(self.result))
        part.replace(self.path)


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
