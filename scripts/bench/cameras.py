"""Many cameras in one call against one call each: time, memory, agreement (docs/measured/solver.md).

    python -m scripts.bench.cameras                                  64 cameras of 30 views, 5 and 14 coefficients
    python -m scripts.bench.cameras --cameras 16 --views 15 --coefficients 5 --repeats 1 --dry

Each run is a process of its own, so that its peak memory is its own; both ways alternate.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from typing import Any

from scripts.shared.memory import peak_megabytes
from scripts.shared.page import write_section
from scripts.shared.timing import row, show
from scripts.shared.views import COLUMNS, MODELS, NOISE, ROWS, SIZE, WEAK, observed, simulate

FIRST_SEED = 40_000
# RMS, relative: as far as the solver's tolerance goes.
SAME_RMS = 1e-9


def work(way: str, cameras: int, views: int, coefficients: int) -> None:
    """Calibrate all cameras and print the time of the calibrations alone, peak memory and the answers."""
    import torch

    from kcal.calibrate.camera.calibrate import (
        CalibrationOptions,
        CameraCalibrationResult,
        calibrate_camera,
        calibrate_cameras,
    )

    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))
    sets = []
    for number in range(cameras):
        sets.append(observed(simulate(views, seed=FIRST_SEED + number)["pixels"].tolist()))
    options = CalibrationOptions(model=MODELS[coefficients], weak_prior=WEAK)
    before = peak_megabytes()
    start = time.perf_counter()
    if way == "one call":
        found = calibrate_cameras(sets, options)
    else:
        found = [calibrate_camera(seen, options) for seen in sets]
    seconds = time.perf_counter() - start
    after = peak_megabytes()
    good = [one for one in found if isinstance(one, CameraCalibrationResult)]
    print(json.dumps({
        "seconds": seconds,
        "before": before,
        "after": after,
        "rms": [one.rms for one in good],
        "fx": [float(one.camera.focal[0]) for one in good],
        "sigma": [one.sigma["fx"] for one in good],
    }))  # fmt: skip


def run(way: str, arguments: argparse.Namespace, coefficients: int) -> dict[str, Any]:
    command = [
        sys.executable,
        "-m",
        "scripts.bench.cameras",
        "--work",
        way,
        str(arguments.cameras),
        str(arguments.views),
        str(coefficients),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return found


def main() -> None:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    if sys.argv[1:2] == ["--work"]:
        work(sys.argv[2], *map(int, sys.argv[3:6]))
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cameras", type=int, default=64)
    parser.add_argument("--views", type=int, default=30)
    parser.add_argument("--coefficients", type=int, nargs="*", default=[5, 14], choices=list(MODELS))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--dry", action="store_true", help="print only")
    arguments = parser.parse_args()
    lines = show([
        "## Many cameras at once",
        "",
        f"Made by `scripts/bench/cameras.py`: {arguments.cameras} cameras, {arguments.views} simulated views each of a "
        f"{COLUMNS}x{ROWS} board, {SIZE[0]}x{SIZE[1]} px, noise {NOISE} px an axis, {os.environ['OMP_NUM_THREADS']} "
        f"thread(s), median of {arguments.repeats} alternating runs. *One call*: `calibrate_cameras`; *calls*: "
        "`calibrate_camera` for each. *Ratio*: time of the calls over that of the one call (range). *Same*: cameras "
        f"whose RMS agrees to {SAME_RMS:g}; *worst*: the largest difference of RMS, relative, and of fx in standard "
        f"deviations. Models beyond 5 coefficients with `weak_prior={WEAK}`. *MB*: how much peak memory grows by "
        "calibrating.",
        "",
        "| coefficients | one call s | calls s | ratio | same | worst RMS | worst fx / σ | one call MB | calls MB |",
        "|---|---|---|---|---|---|---|---|---|",
    ])  # fmt: skip
    for coefficients in arguments.coefficients:
        runs: dict[str, list[dict[str, Any]]] = {"one call": [], "calls": []}
        for _ in range(arguments.repeats):
            for way, found in runs.items():
                found.append(run(way, arguments, coefficients))
        one, many = runs["one call"], runs["calls"]
        ratios = [b["seconds"] / a["seconds"] for a, b in zip(one, many, strict=True)]
        a, b = one[-1], many[-1]
        rms = [abs(x / y - 1.0) for x, y in zip(a["rms"], b["rms"], strict=True)]
        shift = [abs(x - y) / s for x, y, s in zip(a["fx"], b["fx"], b["sigma"], strict=True) if s]
        grown = [max(entry["after"] - entry["before"] for entry in runs[way]) for way in runs]
        seconds = [statistics.median(entry["seconds"] for entry in runs[way]) for way in runs]
        lines += show([
            row(
                coefficients, f"{seconds[0]:.2f}", f"{seconds[1]:.2f}",
                f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})",
                f"{sum(r <= SAME_RMS for r in rms)} of {len(rms)}", f"{max(rms):.1e}", f"{max(shift):.1e}",
                f"{grown[0]:.0f}", f"{grown[1]:.0f}",
            )
        ])  # fmt: skip
    if not arguments.dry:
        write_section("solver.md", "many cameras", "\n".join(lines))


if __name__ == "__main__":
    main()
