"""Cameras behind flat windows, in air and under water: whether the port is found, and whether error bars hold.

Truth: a central lens (scripts/shared/port.py) without a window, behind one in air, and behind one in water, all rays
by Snell's law; windows of 5 to 20 mm, 2 to 8 cm before the lens, tilted by up to 5°. 40 views of a board of 11 x 8
corners, 35 mm apart, some 0.5 to 3.5 m away; corners with 0.1 px of noise. Error bars: how often the true direction of
a pixel, at infinity in the same medium and after the best rotation, lies in the 95 % ellipse, on a grid of the image.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from unittest.mock import patch

import torch

from kcal import Board, CalibrationOptions, Observations
from kcal.sim.captures import LensLike, sample_board_poses
from scripts.bench.traced_lenses import measured
from scripts.shared.page import table
from scripts.shared.port import AIR, WATER, PortedCamera, drawn
from scripts.shared.sections import NOT_KEPT, Kept, Record, section
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


def measure(name: str, seed: int, views: int) -> Record:
    """One capture, with the port's terms where kcal wants them, and without."""
    camera = drawn(MEDIA[name], seed)
    seen = seen_by(camera, seed, views)
    after = measured(camera, seen, CalibrationOptions())  # type: ignore[arg-type]
    before = after
    if after.get("port"):
        with patch("kcal.calibrate.hybrid.fit.pupil_recedes", lambda _: False):
            before = measured(camera, seen, CalibrationOptions())  # type: ignore[arg-type]
    return {"before": before, "after": after}


def rows(records: list[Record]) -> list[list[str]]:
    """One row for each medium."""
    out = []
    for name in MEDIA:
        own = [r for r in records if r["key"][0] == name]
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


@section("one-camera.md", "ports", seeds=range(100, 101), media=("window in water",), views=10)
def ports(
    kept: Kept = NOT_KEPT, seeds: range = range(100, 200), media: tuple[str, ...] = tuple(MEDIA), views: int = VIEWS
) -> Iterator[str]:
    head = ["", "port found", "inside where boards reached, %", "beyond, %", "RMS at infinity, px"]
    return table(head, rows(kept.records([(name, seed, views) for seed in seeds for name in media], measure)))
