"""Compare the network field with fixed and trained features, the default field and ext20, by views that were held out.

    KCAL_DATA=DATA python -m scripts.bench.network_field [--captures gavin_l st1_l] [--write]

For each capture: RMS over held-out blocks of views (`kcal.calibrate.camera.at_setting`), and CPU seconds of one fit of
all views. Also the error at infinity on a simulated lens with a dent (`scripts/shared/dented_lens.py`). `--write` puts
both tables into docs/measured/network-field.md.
"""

from __future__ import annotations

import argparse
import functools
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from kcal import CalibrationOptions, KcalError, Observations, calibrate_camera
from kcal.calibrate import compare_models
from kcal.nets import FieldTraining
from scripts.shared.dented_lens import capture, network, off
from scripts.shared.page import table, write_row

CAPTURES = ("gavin_l", "gavin_r", "st1_l", "lanhp_l", "luisa39", "carnd18", "fish_l", "kaidan", "ch1280", "sq1280")
# Name -> lens model and training.
FITS: dict[str, tuple[str, FieldTraining | None]] = {
    "ext20": ("ext20", None),
    "default": ("hybrid", None),
    "network, last layer only": ("network", None),
    "network, Gauss-Newton": ("network", FieldTraining()),
    "network, Adam": ("network", FieldTraining(optimizer="adam")),
}


def measure(seen: Observations, name: str, parts: int) -> tuple[float, float]:
    """Held-out RMS in pixels, and CPU seconds of one fit."""
    model, training = FITS[name]
    options = CalibrationOptions(model="opencv5", board_warp=True, training=training)
    held = compare_models(seen, [model], options=options, parts=parts).rms[model]
    begin = time.process_time()
    calibrate_camera(seen, CalibrationOptions(model=model, training=training))
    return held, time.process_time() - begin


def cells(seen: Observations, parts: int, tell: Callable[[str], object]) -> list[str]:
    """For each lens the held-out RMS, and CPU seconds in brackets."""
    out = []
    for name in FITS:
        try:
            held, seconds = measure(seen, name, parts)
            out.append(f"{held:.4f} ({seconds:.1f})")
        except KcalError as error:
            # A lens that does not fit is a result, too.
            tell(f"{name}: {error}")
            out.append("does not fit")
        tell(f"{name}: {out[-1]}")
    return out


def dent() -> list[str]:
    """For each lens the error at infinity over the middle of the image of a lens with a dent, pixels."""
    out = []
    for model, training in FITS.values():
        options = CalibrationOptions(model=model)
        if model == "hybrid":
            options = CalibrationOptions(board="exact", motion=False)
        elif model == "network":
            options = CalibrationOptions(field=network(), training=training, board="exact", motion=False)
        begin = time.process_time()
        camera = calibrate_camera(capture(), options).camera
        out.append(f"{off(camera):.3f} ({time.process_time() - begin:.1f})")
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--captures", nargs="*", default=list(CAPTURES))
    parser.add_argument("--parts", type=int, default=3)
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    keep(given.write, "dent", ["lens", *FITS], ["with a dent of 3 px", *dent()])
    for name in given.captures:
        seen = Observations.load(Path(os.environ["KCAL_DATA"], "captures", f"{name}.obs.json"))
        found = cells(seen, given.parts, functools.partial(print, name, flush=True))
        keep(given.write, "captures", ["capture", "views", *FITS], [name, len(seen.views), *found])


def keep(write: bool, section: str, heads: Sequence[object], row: Sequence[object]) -> None:
    """Print a row, and put it into its table of the page."""
    print("\n".join(table(heads, [row])), flush=True)
    if write:
        write_row("network-field.md", section, heads, row)


if __name__ == "__main__":
    main()
