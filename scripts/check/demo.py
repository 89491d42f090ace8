"""How often the intervals of `kcal demo` contain the truth: the whole command, many seeds.

Every seed has its own poses, noise, survey and marks; lenses and board are those of the site. The intervals are those
that the command prints: 95 %. Seeds below 100 were looked at.
"""

from __future__ import annotations

import contextlib
import io
import math
import statistics
import tempfile
from pathlib import Path
from typing import Any
from unittest import mock

from kcal import Localizer, load_rig, locate_points
from kcal.cli import rooms
from kcal.cli.demo import simulated_site
from kcal.locate import Marks
from kcal.locate.positions import position_errors
from kcal.sim.scene import DemoScene
from scripts.shared.page import Line
from scripts.shared.sections import NOT_KEPT, Kept, section


def outcome(seed: int, views: int) -> dict[str, Any]:
    """What one run of the command says with so many views of each camera, beside the truth."""
    scene = DemoScene(seed=seed, near_views=views)
    site = mock.patch.object(rooms, "DemoScene", return_value=scene)
    with site, tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        simulated_site(Path(folder), seed)
        rig = load_rig(Path(folder, "rig.json"))
    marks, targets = scene.target_marks, scene.targets
    located = locate_points(
        Localizer(rig, pixel_sigma=scene.mark_sigma), Marks.of_pair(targets.names, marks.left, marks.right)
    )
    ranges = targets.enu.norm(dim=-1).tolist()
    found = []
    for name, true, miss in zip(targets.names, ranges, position_errors(located, targets.enu), strict=True):
        if miss is None:
            found.append({"name": name, "range": true, "located": False})
        else:
            across, along, inside = miss
            found.append({"name": name, "range": true, "located": True, "across": across, "along": along, "in": inside})
    return {"targets": found}


@section("chain.md", "demo", seeds=range(100, 101), views=4)
def demo(kept: Kept = NOT_KEPT, seeds: range = range(100, 140), views: int = 20) -> list[Line]:
    """Coverage and errors of each target over the seeds."""
    records = kept.records([(seed, views) for seed in seeds], outcome, lambda _: "done")
    rows = []
    names = [target["name"] for target in records[0]["targets"]]
    every: list[bool] = []
    for i, name in enumerate(names):
        seen = [record["targets"][i] for record in records]
        good = [target for target in seen if target["located"]]
        every += [target["in"] for target in good]
        middle = statistics.median(abs(target["along"]) for target in good)
        inside = sum(target["in"] for target in good)
        rows.append([name, f"{seen[0]['range']:.0f} m", f"{len(good)} of {len(seen)}", f"{middle:.2f} m",
                     f"{inside} of {len(good)}"])  # fmt: skip
    share = sum(every) / len(every)
    # Targets of one seed share its rig: seeds, not targets, are independent.
    own = [
        statistics.fmean(t["in"] for t in record["targets"] if t["located"])
        for record in records
        if any(t["located"] for t in record["targets"])
    ]
    half = 1.96 * statistics.stdev(own) / len(own) ** 0.5 if len(own) > 1 else math.nan
    return [
        ["target", "range of the first seed", "located", "median error of range", "in the interval"],
        *rows,
        f"{len(records)} seeds: the 95 % intervals contain the true range in {100 * share:.1f} ± {100 * half:.1f} % of "
        f"{len(every)} cases (± from the scatter of seeds).",
    ]
