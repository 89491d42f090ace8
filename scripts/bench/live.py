"""`kcal live` for an hour: killed again and again, nothing lost, nothing doubled, memory flat; what a track costs."""

from __future__ import annotations

import contextlib
import csv
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import orjson
import psutil
import torch

from kcal import Localizer, Origin, Rig, save_rig
from kcal.pipeline.pairing import ObjectViews
from kcal.rig import Mounting, RigCovariance, planned_rig
from kcal.track import Tracker
from scripts.shared.page import Lines, section


def site_rig() -> Rig:
    rig = planned_rig()
    sigma = torch.tensor([0, 3e-5, 0, 0, 0, 0], dtype=torch.float64)
    rig.covariance = RigCovariance.of(rig, pose=torch.diag(sigma**2))
    rig.mounting = Mounting(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0)
    return rig


def marks(rig: Rig, targets: int, second: float, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Targets that circle before the rig, each at its own range."""
    number = torch.arange(targets, dtype=torch.float64)
    z = 300.0 + 80.0 * number
    angle = second * 3.0 / 20.0 + number
    across = (number / max(targets - 1, 1) - 0.5) * 0.7 * z
    places = torch.stack([across + 20.0 * angle.cos(), 0.02 * z * number.cos(), z + 20.0 * angle.sin()], -1)
    left, right = rig(places)[0].unbind(-2)
    noise = 0.2 * torch.randn(2, targets, 2, generator=generator, dtype=torch.float64)
    return left + noise[0], right + noise[1]


def cost_of_tracks(moments: int = 60, compiled: bool = False) -> float:
    """Processor milliseconds of one moment of the tracker of 50 targets."""
    targets, rig, generator = 50, site_rig(), torch.Generator().manual_seed(0)
    tracker = Tracker(Localizer(rig), compiled=compiled)
    spent = 0.0
    for moment in range(moments):
        left, right = marks(rig, targets, moment / 30.0, generator)
        pairs = ObjectViews.of_pairs(
            left, right, covariance=0.04 * torch.eye(4, dtype=torch.float64).expand(targets, 4, 4),
            time=torch.full((targets, 2), moment / 30.0, dtype=torch.float64), score=torch.ones(targets),
            category=("car",) * targets,
        )  # fmt: skip
        before = time.process_time()
        tracker(pairs)
        # The first moments have no tracks yet.
        spent += time.process_time() - before if moment >= 10 else 0.0
    return 1e3 * spent / (moments - 10)


def share_of_core(costs: list[float]) -> str:
    """Of moments at 30 Hz, from milliseconds of some runs."""
    middle = float(np.median(costs))
    return (
        f"{middle:.1f} ms of a core ({min(costs):.1f} to {max(costs):.1f} in {len(costs)} runs), "
        f"{3.0 * middle:.1f} % at 30 Hz"
    )


@section("tracks.md", "live", hours=0.003, kills=1, runs=1, eager=True)
def live(
    hours: float = 1.0, rate: float = 2.0, targets: int = 5, kills: int = 10, runs: int = 5, eager: bool = False
) -> Lines:
    costs = []
    for compiled in (False, not eager):
        cost_of_tracks(moments=12, compiled=compiled)
        costs.append([cost_of_tracks(compiled=compiled) for _ in range(runs)])
        print(f"50 tracks{', compiled' if compiled else ''}: {np.median(costs[-1]):.2f} ms a moment", flush=True)
    moments = round(hours * 3600 * rate)
    with tempfile.TemporaryDirectory() as folder:
        rig, generator = site_rig(), torch.Generator().manual_seed(0)
        file, lines, output = (str(Path(folder, name)) for name in ("rig.json", "lines.jsonl", "tracks.csv"))
        save_rig(rig, file)
        malformed = 0
        with open(lines, "wb") as writer:
            for moment in range(moments):
                left, right = marks(rig, targets, moment / rate, generator)
                line = {"time": 1.7e9 + moment / rate, "left": left.tolist(), "right": right.tolist()}
                writer.write(orjson.dumps(line | {"sigma": 0.2}) + b"\n")
                if moment % 1000 == 500:
                    malformed += 1
                    writer.write(b'{"time": \n')
        command = [sys.executable, "-m", "kcal", "live", file, "--detections", lines, "-o", output]
        chance, killed, memory = random.Random(0), 0, []
        size = 0
        while True:
            process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
            # Killed after it has written a random share of what one of `kills` equal parts would be.
            until = size + (0.5 + chance.random()) * 460.0 * targets * moments / (kills + 1)
            while process.poll() is None:
                time.sleep(0.05)
                there = Path(output).stat().st_size if Path(output).exists() else 0
                with contextlib.suppress(psutil.Error):  # it has just ended
                    memory.append(psutil.Process(process.pid).memory_info().rss / 1e6)
                if killed < kills and there > until:
                    process.kill()
                    killed += 1
                    break
            process.wait()
            size = Path(output).stat().st_size
            if process.returncode == 0:
                break
            print(f"killed {killed} times, {size / 1e6:.1f} MB written", flush=True)
        with open(output, encoding="utf-8") as reader:
            seen = Counter((row["sequence"], row["name"]) for row in csv.DictReader(reader))
        sequences = {int(sequence) for sequence, _ in seen}
        lost = moments - 3 - len(sequences & set(range(4, moments + 1)))
        doubled = sum(count - 1 for count in seen.values())
    quarter = max(1, len(memory) // 4)
    early, late = max(memory[: 2 * quarter]), max(memory[-quarter:])

    yield f"{hours:g} h of {rate:g} moments a second with {targets} targets, replayed as fast as it goes."
    rows: list[list[object]] = [
        ["", "found"],
        ["moments, positions", f"{moments:,}, {sum(seen.values()):,}"],
        ["malformed lines among them", malformed],
        ["kills (SIGKILL)", killed],
        ["moments lost", lost],
        ["positions doubled", doubled],
        ["most memory, first half and last quarter", f"{early:.0f} and {late:.0f} MB"],
        ["50 tracks, one moment", share_of_core(costs[0])],
        ["the same, compiled", share_of_core(costs[1])],
    ]
    yield from rows
