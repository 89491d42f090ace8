"""How often the intervals of `kcal demo` contain the truth: the whole command, many seeds.

    python -m scripts.check.demo --out seeds.jsonl --seeds 40        # seeds that the file holds are kept
    python -m scripts.check.demo --out seeds.jsonl --write           # the page, from what is there

Every seed has its own poses, noise, survey and marks; lenses and board are those of the site. The intervals are those
that the command prints: 95 %.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from kcal import Localizer, load_rig, locate_points
from kcal.cli.demo_run import simulated_site
from kcal.locate import Marks
from kcal.locate.positions import position_errors
from kcal.sim.scene import DemoScene
from scripts.shared.page import table, tell


def outcome(seed: int) -> dict[str, Any]:
    """What one run of the command says, beside the truth."""
    scene, start = DemoScene(seed=seed), time.process_time()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
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
    return {"seed": seed, "targets": found, "seconds": time.process_time() - start}


def tables(records: list[dict[str, Any]]) -> list[str]:
    """Coverage and errors of each target over the seeds."""
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
    half = 1.96 * statistics.stdev(own) / len(own) ** 0.5
    return [
        *table(["target", "range of the first seed", "located", "median error of range", "in the interval"], rows),
        "",
        f"{len(records)} seeds: the 95 % intervals contain the true range in {100 * share:.1f} ± {100 * half:.1f} % of "
        f"{len(every)} cases (± from the scatter of seeds).",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="JSON lines")
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--first", type=int, default=100, help="seeds below were looked at")
    parser.add_argument("--write", action="store_true", help="only write the page")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    records = [json.loads(line) for line in arguments.out.read_text().splitlines()] if arguments.out.exists() else []
    done = {record["seed"] for record in records}
    for seed in range(arguments.first, arguments.first + arguments.seeds) if not arguments.write else ():
        if seed not in done:
            records.append(outcome(seed))
            with arguments.out.open("a") as file:
                file.write(json.dumps(records[-1]) + "\n")
    lines = tables(records)
    tell("chain.md", "demo", lines, write=arguments.write)


if __name__ == "__main__":
    main()
