"""Compare the network field with fixed and trained features, the default field and ext20, by views that were held out.

For each capture: RMS over held-out blocks of views (`kcal.calibrate.camera.at_setting`), and CPU seconds of one fit of
all views. Also the error at infinity on a simulated lens with a dent (`scripts/shared/dented_lens.py`).
"""

from __future__ import annotations

import time
from collections.abc import Iterator

from kcal import CalibrationOptions, KcalError, Observations, calibrate_camera
from kcal.calibrate import compare_models
from kcal.nets import FieldTraining
from scripts.shared.dented_lens import capture, network, off
from scripts.shared.page import merged, table
from scripts.shared.real_captures import data_folder
from scripts.shared.sections import section

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


def cells(seen: Observations, parts: int, fits: tuple[str, ...]) -> list[str]:
    """For each lens the held-out RMS, and CPU seconds in brackets."""
    out = []
    for name in fits:
        try:
            held, seconds = measure(seen, name, parts)
            out.append(f"{held:.4f} ({seconds:.1f})")
        except KcalError as error:
            # A lens that does not fit is a result, too.
            print(f"{name}: {error}", flush=True)
            out.append("does not fit")
    return out


@section("network-field.md", "captures", names=("sq1280",), fits=("ext20",), parts=2)
def captures(names: tuple[str, ...] = CAPTURES, parts: int = 3, fits: tuple[str, ...] = tuple(FITS)) -> Iterator[str]:
    found = ((name, Observations.load(data_folder() / "captures" / f"{name}.obs.json")) for name in names)
    rows = ([name, len(seen.views), *cells(seen, parts, fits)] for name, seen in found)
    return merged("network-field.md", "captures", ["capture", "views", *fits], rows)


@section("network-field.md", "dent", fits=("ext20",))
def dent(fits: tuple[str, ...] = tuple(FITS)) -> Iterator[str]:
    """For each lens the error at infinity over the middle of the image of a lens with a dent, pixels."""
    out = []
    for model, training in map(FITS.__getitem__, fits):
        options = CalibrationOptions(model=model)
        if model == "hybrid":
            options = CalibrationOptions(board="exact", motion=False)
        elif model == "network":
            options = CalibrationOptions(field=network(), training=training, board="exact", motion=False)
        begin = time.process_time()
        camera = calibrate_camera(capture(), options).camera
        out.append(f"{off(camera):.3f} ({time.process_time() - begin:.1f})")
    return table(["lens", *fits], [["with a dent of 3 px", *out]])
