"""Camera and rig files: bytes, processor time to load, and whether saving what was loaded gives the same bytes.

    python -m scripts.bench.files

The cameras of the sample rig in assets/, hybrid with all that their calibrations know, and parametric ones calibrated
here from 30 simulated views.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.io.camera_file import load_camera, save_camera
from kcal.io.rig_file import load_rig, save_rig
from scripts.shared.page import table
from scripts.shared.timing import show
from scripts.shared.views import observed, simulate

SAMPLE = Path(__file__).parents[2] / "assets" / "sample-rig.json"


def measured(name: str, path: Path, load: Callable[[Path], Any], save: Callable[[Any, Path], Path]) -> list[str]:
    """One row of the table."""
    times = []
    for _ in range(7):
        start = time.process_time()
        content = load(path)
        times.append(time.process_time() - start)
    again = save(content, path.with_name("again.json"))
    same = "yes" if again.read_bytes() == path.read_bytes() else "no"
    return [name, f"{path.stat().st_size / 1e3:,.0f}", f"{1e3 * statistics.median(times):.0f}", same]


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    torch.set_num_threads(1)
    head, body = ["file", "kB", "load, ms of processor time", "saved again: same bytes"], []
    with tempfile.TemporaryDirectory() as folder:
        rig = load_rig(SAMPLE)
        body.append(measured("rig of two hybrid cameras", save_rig(rig, Path(folder) / "rig.json"), load_rig, save_rig))
        path = save_camera(rig.left, Path(folder) / "hybrid.json")
        body.append(measured("hybrid camera", path, load_camera, save_camera))
        for model in ("opencv5", "opencv14", "ext20"):
            found = calibrate_camera(observed(simulate(30)["pixels"].tolist()), CalibrationOptions(model=model))
            path = found.save(Path(folder) / f"{model}.json")
            body.append(measured(model, path, load_camera, save_camera))
    show(table(head, body))


if __name__ == "__main__":
    main()
