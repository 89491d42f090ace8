"""Compare the network field with fixed and trained features, the default field and ext20, by views that were held out.

    KCAL_DATA=DATA python -m scripts.bench.network_field [--captures gavin_l st1_l] [--write]

For each capture: RMS over held-out blocks of views (`kcal.calibrate.camera.compare`), and CPU seconds of one fit of all
views. `--write` puts the table into docs/measured/network-field.md.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path

from kcal.calibrate.camera.calibrate import calibrate_camera
from kcal.calibrate.camera.compare import compare_models
from kcal.calibrate.camera.result import CalibrationOptions
from kcal.calibrate.hybrid.network_fit import FieldTraining
from kcal.corners.observations import Observations
from kcal.errors import KcalError

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


def table(captures: list[str], parts: int, tell: Callable[[str], object]) -> str:
    """One row for each capture: held-out RMS, and CPU seconds in brackets."""
    lines = [f"| capture | views | {' | '.join(FITS)} |", f"|---|---|{'---|' * len(FITS)}"]
    for capture in captures:
        seen = Observations.load(Path(os.environ["KCAL_DATA"], "captures", f"{capture}.obs.json"))
        cells = []
        for name in FITS:
            try:
                held, seconds = measure(seen, name, parts)
                cells.append(f"{held:.4f} ({seconds:.1f})")
            except KcalError as error:
                # A lens that does not fit is a result, too.
                tell(f"{capture}, {name}: {error}")
                cells.append("does not fit")
            tell(f"{capture}, {name}: {cells[-1]}")
        lines.append(f"| {capture} | {len(seen.views)} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--captures", nargs="*", default=list(CAPTURES))
    parser.add_argument("--parts", type=int, default=4)
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    text = table(given.captures, given.parts, lambda line: print(line, flush=True))
    print(text)
    if given.write:
        page = Path(__file__).parents[2] / "docs" / "measured" / "network-field.md"
        head = page.read_text(encoding="utf-8").split("\n| capture")[0]
        page.write_text(f"{head}\n{text}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
