"""`kcal demo --score`: how well somebody did on a practice site, in meters, and what comes next."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kcal.cli.console import out, print_table, warn
from kcal.cli.demo_practice import read_truth_file
from kcal.cli.practice_files import STEPS, Exercise

if TYPE_CHECKING:
    from kcal.lens.rig import StereoRig

# Names under which results are looked for, the first that is there.
POSITIONS = ("positions.geojson", "positions.csv")
TRACKS = ("tracks.csv", "tracks.geojsonl")


def practice_score(folder: Path) -> None:
    """Compare what is in a folder with its truth, step by step.

    Raises:
        FileError: no site is there, or a result that cannot be read.
    """
    truth = read_truth_file(folder)
    _score_cameras(folder, truth)
    rig = _score_rig(folder, truth)
    if rig is not None:
        _score_positions(folder, truth)
        _score_tracks(folder, truth)
    step = next_step(folder)
    if step is None:
        out.print("All steps are done.")
        return
    out.print(f"next: {step.name}, in {folder}:", markup=False)
    for command in step.commands:
        out.print(f"  {command}", markup=False)


def next_step(folder: Path) -> Exercise | None:
    """The first step whose files are not all there; what only leads to a step that is done counts as done."""
    others = {"positions.geojson": POSITIONS, "tracks.csv": TRACKS}
    done = [
        all(any((folder / name).exists() for name in others.get(made, (made,))) for made in step.makes)
        for step in STEPS
    ]
    for step, own, later in zip(STEPS, done, [*done[1:], False], strict=True):
        if not own and not (step.leads_on and later):
            return step
    return None


def _head(text: str) -> None:
    out.print(f"\n[bold]{text}[/]")


def _score_cameras(folder: Path, truth: dict[str, Any]) -> None:
    from kcal.io.camera_file import load_camera
    from kcal.report.practice_score import score_lens

    rows = [["camera", "RMS px", "middle px", "largest px", "sideways at 5 km", "range at 5 km"]]
    for side in ("left", "right"):
        path = folder / f"{side}.camera.json"
        if path.exists():
            found = score_lens(load_camera(path), truth["cameras"][side], truth["baseline_m"])
            pixels = [f"{value:.3f}" for value in (found.rms, found.middle, found.largest)]
            rows.append([side, *pixels, f"{found.sideways_m:.2f} m", f"{found.range_m:.0f} m"])
    _head("Cameras: error over the image after the best turn")
    _print_or_missing(rows)


def _score_rig(folder: Path, truth: dict[str, Any]) -> StereoRig | None:
    from kcal.io.rig_file import load_rig
    from kcal.report.practice_score import score_rig

    _head("Rig: error of ranges over the image, with marks that have no noise")
    path = folder / "rig.json"
    if not path.exists():
        out.print("not done yet")
        return None
    rig = load_rig(path)
    rows = [["at", "mean m", "RMS m", "one sigma as stated m"]]
    for found in score_rig(rig, truth):
        stated = "none" if found.stated is None else _short_meters(found.stated)
        rows.append([f"{found.range_m / 1000:g} km", _signed(found.mean), _short_meters(found.rms), stated])
    print_table(rows)
    true, own = truth["baseline_m"], float(rig.baseline)
    out.print(f"baseline {own:.4f} m, {1e3 * (own - true):+.1f} mm off")
    return rig


def _score_positions(folder: Path, truth: dict[str, Any]) -> None:
    from kcal.report.practice_score import score_positions

    _head("Positions: against the truth")
    path = _first(folder, POSITIONS)
    if path is None:
        out.print("not done yet")
        return
    scores = score_positions(path, truth)
    rows = [["target", "range m", "off on the map m", "off in range m", "95 % interval contains it"]]
    for found in scores:
        cells = [f"{found.range_m:.0f}", _short_meters(found.level), _signed(found.range_off)]
        rows.append([found.name, *cells, "yes" if found.contains else "no"])
    _print_or_missing(rows)
    if scores:
        inside = sum(found.contains for found in scores)
        out.print(f"{inside} of {len(scores)} intervals contain the true range; 95 % are to be expected")
    missing = [name for name in truth["targets"] if name.casefold() not in {each.name.casefold() for each in scores}]
    if missing:
        out.print(f"not among the positions: {', '.join(missing)} (names as in targets.csv)", markup=False)


def _score_tracks(folder: Path, truth: dict[str, Any]) -> None:
    from kcal.report.practice_score import score_tracks

    _head("Tracks: against the ships")
    path = _first(folder, TRACKS)
    if path is None:
        out.print("not done yet")
        return
    scores, strays = score_tracks(path, truth)
    rows = [["ship", "range m", "followed", "tracks", "off on the map m", "off in range m", "intervals with the truth"]]
    for found in scores:
        share = "" if math.isnan(found.contained) else f"{100 * found.contained:.0f} %"
        counts = [f"{found.range_m:.0f}", f"{100 * found.followed:.0f} %", f"{found.tracks}"]
        rows.append([found.name, *counts, _short_meters(found.level), _short_meters(found.range_off), share])
    print_table(rows)
    if strays:
        warn(f"{strays} tracks are near no ship")


def _first(folder: Path, names: tuple[str, ...]) -> Path | None:
    return next((folder / name for name in names if (folder / name).exists()), None)


def _print_or_missing(rows: list[list[str]]) -> None:
    if len(rows) > 1:
        print_table(rows)
    else:
        out.print("not done yet")


def _short_meters(value: float) -> str:
    if math.isnan(value):
        return ""
    return f"{value:.0f}" if abs(value) >= 10 else f"{value:.2g}" if abs(value) >= 0.01 else f"{value:.3f}"


def _signed(value: float) -> str:
    return f"{'-' if value < 0 else '+'}{_short_meters(abs(value))}"
