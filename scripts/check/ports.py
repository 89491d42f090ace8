"""Cameras behind flat windows, in air and under water: whether the port is found, and whether error bars hold.

    python -m scripts.check.ports --out ports.jsonl                       # captures that the file holds are kept
    python -m scripts.check.ports --out *.jsonl --write                   # the table in docs/measured/one-camera.md

Truth: a central lens (scripts/shared/port.py) without a window, behind one in air, and behind one in water, all rays
by Snell's law; windows of 5 to 20 mm, 2 to 8 cm before the lens, tilted by up to 5°. 40 views of a board of 11 x 8
corners, 35 mm apart, some 0.5 to 3.5 m away; corners with 0.1 px of noise. Error bars: how often the true direction of
a pixel, at infinity in the same medium and after the best rotation, lies in the 95 % ellipse, on a grid of the image.
"""

from __future__ import annotations

import argparse
import json
import statistics
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch

from kcal import Board, CalibrationOptions, Observations
from kcal.sim.captures import LensLike, sample_board_poses
from scripts.bench.traced_lenses import measured
from scripts.shared.page import table, tell
from scripts.shared.port import AIR, WATER, PortedCamera, drawn
from scripts.shared.traced import as_observations

MEDIA = {"no window": None, "window in air": AIR, "window in water": WATER}
BOARD = Board(columns=11, rows=8, square=0.035)
VIEWS, NOISE, FILL = 40, 0.1, (0.2, 0.92)


def seen_by(camera: LensLike | PortedCamera, seed: int, views: int = VIEWS, sigma: float = NOISE) -> Observations:
    """Views of the board in poses that cover the image."""
    generator = torch.Generator().manual_seed(seed)
    poses = sample_board_poses(camera, BOARD, views, generator, fill=FILL)  # type: ignore[arg-type]
    rotation, translation = (torch.stack([getattr(p, part) for p in poses]) for part in ("rotation", "translation"))
    pixels, _ = camera.project(BOARD.points @ rotation.mT + translation[:, None])
    noise = sigma * torch.randn(pixels.shape, dtype=torch.float64, generator=generator)
    return as_observations(pixels + noise, camera.size, BOARD)


def measure(name: str, seed: int) -> dict[str, Any]:
    """One capture, with the port's terms where kcal wants them, and without."""
    camera = drawn(MEDIA[name], seed)
    seen = seen_by(camera, seed)
    after = measured(camera, seen, CalibrationOptions())  # type: ignore[arg-type]
    before = after
    if after.get("port"):
        with patch("kcal.calibrate.hybrid.fit.pupil_recedes", lambda _: False):
            before = measured(camera, seen, CalibrationOptions())  # type: ignore[arg-type]
    return {"medium": name, "seed": seed, "before": before, "after": after}


def rows(records: list[dict[str, Any]]) -> list[list[str]]:
    """One row for each medium."""
    out = []
    for name in MEDIA:
        own = [r for r in records if r["medium"] == name]
        if not own:
            continue
        row = [name, f"{sum(bool(r['after'].get('port')) for r in own)} of {len(own)}"]
        for key, unit in (("inside", "%"), ("beyond", "%"), ("rms", "px")):
            means = []
            for which in ("before", "after"):
                values = [r[which][key] for r in own if key in r[which] and r[which][key] == r[which][key]]
                mean = statistics.fmean(values)
                means.append(f"{100 * mean:.1f}" if unit == "%" else f"{mean:.2f}")
            row.append(" → ".join(means) if means[0] != means[1] else means[0])
        out.append(row)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", nargs="+", type=Path, required=True, help="JSON lines; the first is written to")
    parser.add_argument("--media", nargs="+", choices=MEDIA, default=list(MEDIA))
    parser.add_argument("--seeds", nargs="*", type=int, default=list(range(100, 200)))
    parser.add_argument("--write", action="store_true", help="only write the table into the page")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    records = [json.loads(line) for path in arguments.out if path.exists() for line in path.read_text().splitlines()]
    known = {(r["medium"], r["seed"]) for r in records}
    for seed in () if arguments.write else arguments.seeds:
        for name in arguments.media:
            if (name, seed) not in known:
                records.append(measure(name, seed))
                with arguments.out[0].open("a") as file:
                    file.write(json.dumps(records[-1]) + "\n")
    head = ["", "port found", "inside where boards reached, %", "beyond, %", "RMS at infinity, px"]
    tell("one-camera.md", "ports", table(head, rows(records)), write=arguments.write)


if __name__ == "__main__":
    main()
