"""Measure and draw assets/opencv.png: the same corners of a printed board through OpenCV and through kcal.

    python -m scripts.make_comparison                # measures, keeps the figures in a file, draws
    python -m scripts.make_comparison --draws 2      # quicker

The site is that of `kcal demo`, drawn anew each time: two ray-traced lenses whose entrance pupils move, 10 m apart,
twelve landmarks surveyed to 2 cm. Each draw has its own lenses, board (printed, bent by 0.7 mm), poses, and noise.
Corners of 20 views by each camera have 0.05 px of noise. OpenCV: `cv2.calibrateCamera` with 5, 8 and 14 coefficients;
the picture shows the number that is best at 5 km. Then `cv2.solvePnP` on the landmarks for each camera, and
`cv2.triangulatePoints`. Targets at 1 and 5 km, in nine directions, are marked exactly: their errors are those of the
calibrations. (0.1 px of noise in the marks would add 9 m at 1 km and 221 m at 5 km to each.)
"""

from __future__ import annotations

import argparse
import functools
import json
import math
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from torch import Tensor

from kcal import Board, Observations, calibrate_camera
from kcal.report.figures import ACCENT, FAINT, GRAY, INK, WARN, new_figure, save_picture
from kcal.sim.captures import PrintedBoard, drawn_rig
from kcal.sim.raytrace import SURVEILLANCE
from kcal.sim.scene import FOCAL_MM, DemoScene, NamedPoints
from scripts.check.chain import localizer
from scripts.make_assets import ASSETS
from scripts.paper.locate import SIDES
from scripts.paper.locate import by_opencv as opencv_rig
from scripts.shared.captures import as_observations, capture_corners
from scripts.shared.long_range import landmarks_of
from scripts.shared.page import show
from scripts.shared.peer_lenses import calibrated

RANGES, BEARINGS = (1000.0, 5000.0), (-32.0, -24.0, -16.0, -8.0, 0.0, 8.0, 16.0, 24.0, 32.0)
NOISE, VIEWS = 0.05, 20
FIRST = 400  # seed of the first draw; none below was looked at
COEFFICIENTS = {f"OpenCV, {count} coefficients": count for count in (5, 8, 14)}
NAMES = ("kcal", *COEFFICIENTS)
FAR_SHOWN, ACROSS = 6900.0, 3900.0  # meters


def scene_of(draw: int) -> DemoScene:
    """The site of the demonstration with other lenses and another board."""
    places = tuple((f"{far:g} {at:g}", far, at, 0.0) for far in RANGES for at in BEARINGS[:: 2 if far < 5000 else 1])
    return DemoScene(
        seed=draw,
        rig=drawn_rig(SURVEILLANCE, 1.0, draw, focal_mm=FOCAL_MM, wander=1.0),
        near_board=PrintedBoard(9, 6, 0.06, seed=draw),
        targets_at=places,
    )


def corners(scene: DemoScene, draw: int, side: int) -> Observations:
    """What one camera saw of the board."""
    board = scene.near_board
    lens = (scene.rig.left, scene.rig.right)[side]
    seen = capture_corners(lens, VIEWS, sigma=NOISE, seed=2 * draw + side, board=board, fill=(0.4, 0.9))
    return as_observations(seen.pixels, lens.size, Board(columns=board.columns, rows=board.rows, square=board.square))


def measured(draw: int) -> dict[str, Any]:
    """Positions of all targets by every chain, to the right and ahead of the left camera; None where there is none."""
    scene = scene_of(draw)
    seen = corners(scene, draw, 0), corners(scene, draw, 1)
    survey = scene.surveyed(scene.landmarks)
    found: dict[str, Any] = {"draw": draw, "truth": turned(scene, scene.targets.enu).tolist()}
    for name in NAMES:
        enu = by_kcal(scene, seen, survey) if name == "kcal" else by_opencv(scene, seen, survey, COEFFICIENTS[name])
        there = enu.isfinite().all(-1).tolist()
        found[name] = [p if ok else None for p, ok in zip(turned(scene, enu).tolist(), there, strict=True)]
    print(draw, {name: [round(median(errors([found], name, far))) for far in RANGES] for name in NAMES}, flush=True)
    return found


def by_kcal(scene: DemoScene, seen: tuple[Observations, Observations], survey: NamedPoints) -> Tensor:
    """Positions (N, 3) of the targets by kcal's calibration, rig and localizer."""
    marks = scene.landmark_marks
    pixels = torch.stack([marks.left, marks.right], 1)
    landmarks = landmarks_of(survey.enu, pixels, scene.survey_sigma, scene.mark_sigma)
    with torch.no_grad():
        cameras = calibrate_camera(seen[0]).camera, calibrate_camera(seen[1]).camera
        found = localizer(cameras, landmarks, "prior")(scene.target_marks.true_left, scene.target_marks.true_right)
    return torch.where((found.inverse_range > 0)[:, None], found.bearing / found.inverse_range[:, None], torch.nan)


def by_opencv(scene: DemoScene, seen: tuple[Observations, Observations], survey: NamedPoints, count: int) -> Tensor:
    """Positions (N, 3) of the targets by `calibrateCamera`, `solvePnP` and `triangulatePoints`."""
    cameras = {side: calibrated(views, count)[1:] for side, views in zip(SIDES, seen, strict=True)}
    marks = scene.landmark_marks
    place, _ = opencv_rig(cameras, survey.enu, marks.left, marks.right)
    return place(scene.target_marks.true_left, scene.target_marks.true_right)


def turned(scene: DemoScene, enu: Tensor) -> Tensor:
    """Places (N, 2) to the right and ahead of the left camera's heading."""
    angle = math.radians(scene.heading_deg)
    east, north = enu[:, 0], enu[:, 1]
    return torch.stack(
        [east * math.cos(angle) - north * math.sin(angle), east * math.sin(angle) + north * math.cos(angle)], -1
    )


def errors(records: list[dict[str, Any]], name: str, far: float) -> list[float]:
    """Errors of the range of all targets at a distance, meters; infinite where there is no position."""
    found = []
    for record in records:
        for true, place in zip(record["truth"], record[name], strict=True):
            if abs(math.hypot(*true) - far) < 1.0:
                found.append(math.inf if place is None else abs(math.hypot(*place) - math.hypot(*true)))
    return found


def draw(records: list[dict[str, Any]], other: str) -> None:
    """Both results side by side, from above."""
    figure = new_figure(8.0, 5.0, dpi=200)
    panels = figure.subplots(1, 2, sharey=True)
    for axes, name, color in zip(panels, (other, "kcal"), (WARN, ACCENT), strict=True):
        _draw_panel(axes, records, name, color)
    text = f"+ true   ● located, {len(records)} draws of lenses, board and noise   ±: median error of the range"
    figure.text(0.5, 0.02, text, fontsize=11, color=GRAY, ha="center", va="bottom")
    figure.subplots_adjust(left=0.01, right=0.99, top=0.81, bottom=0.09, wspace=0.03)
    save_picture(ASSETS / "opencv.png", figure)


def _draw_panel(axes: Axes, records: list[dict[str, Any]], name: str, color: str) -> None:
    edge = math.radians(36.0)
    angles = np.linspace(-edge, edge, 100)
    for far in RANGES:
        axes.plot(far * np.sin(angles), far * np.cos(angles), color=FAINT, linewidth=1.0, linestyle=(0, (4, 3)))
        place = far * math.sin(edge) + 80, far * math.cos(edge) - 40
        axes.text(*place, f"{far / 1000:g} km", fontsize=12, color=GRAY, ha="left", va="top")
    for side in (-edge, edge):
        axes.plot([0, FAR_SHOWN * math.sin(side)], [0, FAR_SHOWN * math.cos(side)], color=FAINT, linewidth=0.8)
    beyond = count = 0
    for record in records:
        for true, place in zip(record["truth"], record[name], strict=True):
            count += 1
            if place is None or not (abs(place[0]) < ACROSS and 0 < place[1] < FAR_SHOWN):
                beyond += 1
                continue
            axes.plot(*zip(true, place, strict=True), color=color, alpha=0.3, linewidth=0.8, zorder=2)
            axes.plot(*place, "o", color=color, markersize=3.6, alpha=0.6, markeredgewidth=0, zorder=3)
    axes.plot(*zip(*records[0]["truth"], strict=True), "+", color=INK, markersize=7, markeredgewidth=1.3, zorder=4)
    axes.plot(0, 0, "^", color=INK, markersize=9, zorder=4)
    if beyond:
        axes.text(0, FAR_SHOWN, f"{beyond} of {count} lie beyond", fontsize=11, color=color, ha="center", va="top")
    typical = [median(errors(records, name, far)) for far in RANGES]
    axes.set_title(name, fontsize=18, fontweight="bold", color=INK, pad=34)
    text = "    ".join(f"{far / 1000:g} km: ±{_meters(value)}" for far, value in zip(RANGES, typical, strict=True))
    axes.text(0.5, 1.03, text, transform=axes.transAxes, fontsize=14, color=color, ha="center", va="bottom")
    axes.set(xlim=(-ACROSS, ACROSS), ylim=(-150, FAR_SHOWN), aspect="equal")
    axes.axis("off")


def _meters(value: float) -> str:
    return f"{value / 1000:.1f} km" if value >= 950 else f"{float(f'{value:.2g}'):g} m"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=10, help="of lenses, boards, poses and noise")
    parser.add_argument("--out", type=Path, default=Path("comparison.jsonl"), help="draws in it are kept")
    arguments = parser.parse_args()
    records = [json.loads(line) for line in arguments.out.read_text().splitlines()] if arguments.out.exists() else []
    for number in range(FIRST + len(records), FIRST + arguments.draws):
        records.append(measured(number))
        with arguments.out.open("a") as file:
            file.write(json.dumps(records[-1]) + "\n")
    typical = functools.partial(errors, records)
    for name in NAMES:
        show([f"{name}: " + ", ".join(f"{median(typical(name, far)):.0f} m at {far:g} m" for far in RANGES)])
    draw(records, min(COEFFICIENTS, key=lambda name: median(typical(name, RANGES[-1]))))


if __name__ == "__main__":
    main()
