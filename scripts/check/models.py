"""Every lens model on real captures: RMS of all views, and of views that were held out.

    KCAL_DATA=DATA python -m scripts.check.models --out FILE            # captures and models that FILE has are kept
    KCAL_DATA=DATA python -m scripts.check.models --out FILE BEFORE     # beside the records of another version

Held out: each camera is fitted to every other view and judged on the others, both ways, by its projection alone, with
poses and board refitted (`scripts.shared.held_out`). CPU seconds are those of the fit to all views. A model that is
refused, or has no image of a corner that was seen, says so.
"""

from __future__ import annotations

import argparse
import itertools
import math
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import torch

from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.errors import KcalError
from scripts.shared.held_out import held_out
from scripts.shared.page import table
from scripts.shared.real_captures import data_folder, load, names
from scripts.shared.records import Record, finish, read
from scripts.shared.timing import show

# Names of models; "free" leaves the weak prior out.
MODELS = (
    "hybrid", "opencv4", "opencv5", "opencv8", "opencv12", "opencv14", "ext20", "ext22", "fisheye4", "opencv8 free",
    "opencv14 free",
)  # fmt: skip


def options_of(model: str) -> CalibrationOptions:
    """The options that a name of `MODELS` stands for."""
    name, _, free = model.partition(" ")
    return CalibrationOptions(model=name, weak_prior=None) if free else CalibrationOptions(model=name)


def fitted(capture: str, model: str, cache: Path) -> Record:
    """One model on one capture."""
    whole, options = load(capture, data_folder(), cache), options_of(model)
    record: Record = {}
    start = time.process_time()
    try:
        result = calibrate_camera(whole.seen, options)
        record |= {"rms": result.rms, "cost": result.weighted_rms or result.rms, "status": result.status.name}
    except KcalError as error:
        record["refused"] = str(error)
    record["cpu_s"] = time.process_time() - start
    halves = whole.half(0), whole.half(1)
    total, count, lost = 0.0, 0, 0
    try:
        for own, other in (halves, halves[::-1]):
            camera = calibrate_camera(own.seen, options).camera
            found = held_out(camera, other.seen.board.points, other.seen.pixels(), other.weight)
            total, count, lost = total + found.still, count + found.corners, lost + found.lost
    except KcalError as error:
        return record | {"half_refused": str(error)}
    return record | {"held_out": math.sqrt(total / max(1, count - lost)), "lost": lost}


def lines(records: Sequence[Record], before: Sequence[Record]) -> list[str]:
    """One row for each capture and model; with the other version's records, before and after."""
    earlier = {tuple(record["key"]): record for record in before}
    rows = []
    for record in records:
        both = [earlier[tuple(record["key"])], record] if tuple(record["key"]) in earlier else [record]
        cells = [" → ".join(cell(one, key) for one in both) for key in ("rms", "held_out", "cpu_s")]
        rows.append([*record["key"], *cells])
    return table(["capture", "model", "RMS, px", "held out, px", "CPU, s"], rows)


def cell(record: Record, key: str) -> str:
    """A figure of a record."""
    if key not in record:
        return "refused"
    if key == "cpu_s":
        return f"{record[key]:.2f}"
    return f"{record[key]:.4f}" + (f" ({record['lost']} lost)" if key == "held_out" and record["lost"] else "")


def line(record: Record) -> str:
    """One line to print."""
    return ", ".join(cell(record, key) for key in ("rms", "held_out", "cpu_s"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", nargs="?", type=Path, help="JSON lines of another version")
    parser.add_argument("--out", type=Path, required=True, help="JSON lines of finished fits")
    parser.add_argument("--captures", nargs="+", help="names, or observations files; all if left out")
    parser.add_argument("--models", nargs="+", default=MODELS)
    cache = Path(tempfile.gettempdir(), "kcal-ordinary-corners")
    parser.add_argument("--cache", type=Path, default=cache, help="folder of corners found in images")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)  # sums in one order, so that a run can be repeated
    keys = list(itertools.product(arguments.captures or names(data_folder()), arguments.models))
    records = finish(arguments.out, keys, lambda capture, model: fitted(capture, model, arguments.cache), line)
    show(lines(records, read([arguments.before] if arguments.before else [])))


if __name__ == "__main__":
    main()
