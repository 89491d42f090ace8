"""Pin the numbers of real captures and of a simulated site, and compare those of another version with them.

    python -m scripts.check.golden --write golden.json                 before a change
    python -m scripts.check.golden --against golden.json               after it
    python -m scripts.check.golden --against golden.json --only sq1280 demo

Commands run as a user types them, so that a pin outlives changes of names in Python and of files: cameras with their
standard deviations, rigs, positions with their intervals, stars. A line says the largest change of a number: relative,
and in its own standard deviations where it has one. It exits with 1 where a change is above both limits, 1e-9 and 0.1
sigma, or where a number came or went. Real data are in the folder `KCAL_DATA`.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from kcal import load_rig

REPO = Path(__file__).resolve().parents[2]
FILES = REPO / "tests" / "promises" / "files" / "1.0"
PLACE = ("--site", "19.07,72.87,14", "--heading", "35")
Numbers = dict[str, list[float]]
"""Name -> the value, and its standard deviation where it has one."""


def run(*arguments: str | Path) -> str:
    """What a command of kcal prints; one that failed shows what it said."""
    done = subprocess.run([sys.executable, "-m", "kcal", *map(str, arguments)], capture_output=True, text=True)
    if done.returncode not in (0, 3):
        raise SystemExit(f"kcal {' '.join(map(str, arguments))}\n{done.stdout}{done.stderr}")
    return done.stdout


def calibrated(observations: Path, folder: Path) -> Path:
    camera = folder / observations.name.replace(".obs.json", ".camera.json")
    if not camera.exists():
        run("calibrate", observations, "-o", camera)
    return camera


def camera_numbers(file: Path) -> Numbers:
    content = json.loads(file.read_bytes())
    sigma = content["standard_deviations"] or {}
    found = {
        name: [value] + ([sigma[name]] if sigma.get(name) else [])
        for name, value in {**content["intrinsics"], **content["coefficients"]}.items()
    }
    return (
        found
        | {f"sigma {name}": [value] for name, value in sigma.items() if value}
        | {"rms": [content["calibration"]["rms"]]}
    )


def table_numbers(file: Path) -> Numbers:
    """Each number of a table by its row and column."""
    with file.open() as text:
        rows = list(csv.DictReader(text))
    # Where marks are exact their reprojection is rounding.
    return {
        f"{row['name']} {key}": [value]
        for row in rows
        for key, cell in row.items()
        if (value := number(cell)) and not key.startswith("reprojection")
    }


def number(cell: Any) -> float:
    """The number of a cell; 0 where it has none, which is left out."""
    try:
        value = float(cell)
    except (TypeError, ValueError):
        return 0.0
    return value if math.isfinite(value) else 0.0


def rig_numbers(rig: Path, folder: Path, *place: str) -> Numbers:
    """Relative pose, and positions of points from 10 to 1,000 baselines away with all their errors."""
    known = load_rig(rig)
    turn, shift = known.right_from_left_rotation, known.right_from_left_translation
    found = {f"rotation {i}": [value] for i, value in enumerate(turn.flatten().tolist())}
    found |= {f"translation {i}": [value] for i, value in enumerate(shift.tolist())}
    width, height = known.left.size
    rows = ["name,left_u,left_v,right_u,right_v"]
    for share in (0.35, 0.5, 0.65):
        ray = known.left.unproject(known.left.params.new_tensor([[share * width, (1 - share) * height]]))[0]
        for times in (10, 30, 100, 300, 1000):
            point = ray * times * known.baseline
            seen = known.left.project(point), known.right.project(known.right_from_left(point))
            if all(bool(valid) for _, valid in seen):
                marks = [value for pixels, _ in seen for value in pixels[0].tolist()]
                rows.append(",".join([f"{share} at {times}", *map(str, marks)]))
    points, table = folder / f"{rig.stem}.points.csv", folder / f"{rig.stem}.positions.csv"
    points.write_text("\n".join(rows) + "\n")
    run("locate", rig, points, *place, "-o", table)
    return found | table_numbers(table)


def star_numbers(images: list[Path]) -> Numbers:
    found: Numbers = {}
    for i, image in enumerate(json.loads(run("stars", *images, "--json"))["images"]):
        sigma = max(image["sigma_deg"])
        found |= {f"{i} {key}": [image[key], sigma] for key in ("right_ascension_deg", "declination_deg")}
        found |= {f"{i} sigma": [sigma], f"{i} stars": [image["identified"]]}
    return found


def stations(folder: Path) -> Numbers:
    """Three cameras or more, from a stored file; marks spread over their images."""
    rig = FILES / "camera-rig.json"
    content = json.loads(rig.read_bytes())
    rows = ["name,camera,u,v"]
    for row in range(6):
        for index, (name, camera) in enumerate(zip(content["names"], content["cameras"], strict=True)):
            width, height = camera["image_size"]
            u, v = width * (0.4 + 0.04 * ((row + index) % 5)), height * (0.45 + 0.02 * (row % 3))
            rows.append(f"thing {row},{name},{u},{v}")
    (folder / "stations.csv").write_text("\n".join(rows) + "\n")
    run("locate", rig, folder / "stations.csv", "-o", folder / "stations.positions.csv")
    return table_numbers(folder / "stations.positions.csv")


def measure(data: Path, folder: Path, words: list[str]) -> Iterator[tuple[str, Numbers]]:
    """Each part whose name contains one of the words, all if there are none."""

    def wanted(name: str) -> bool:
        return not words or any(word in name for word in words)

    if wanted("sample"):
        run("locate", REPO / "assets/sample-rig.json", REPO / "assets/sample-points.csv", "-o", folder / "sample.csv")
        yield "sample", table_numbers(folder / "sample.csv")
    if wanted("stored rig"):
        yield "stored rig", rig_numbers(FILES / "rig.json", folder, *PLACE)
    if wanted("stations"):
        yield "stations", stations(folder)
    for observations in sorted((data / "captures").glob("*.obs.json")):
        name = f"camera {observations.name.removesuffix('.obs.json')}"
        # This one is refused: there is no camera to compare.
        if wanted(name) and name != "camera lanhp_l":
            yield name, camera_numbers(calibrated(observations, folder))
    for pair in ("st1", "gavin"):
        if wanted(f"rig {pair}"):
            sides = [data / "captures" / f"{pair}_{side}.obs.json" for side in "lr"]
            rig = folder / f"{pair}.rig.json"
            run("rig", *(calibrated(side, folder) for side in sides), "--pairs", *sides, "-o", rig)
            yield f"rig {pair}", rig_numbers(rig, folder, *PLACE)
    if wanted("stars"):
        images = sorted((data / "stars").glob("*.png"))
        yield "stars", star_numbers(images[:3])
    if wanted("demo"):
        run("demo", "-o", folder / "demo")
        yield "demo", rig_numbers(folder / "demo" / "rig.json", folder)


def change(now: Numbers, before: Numbers) -> tuple[float, float, str]:
    """The largest change: relative, in sigmas (infinite where a number has none), and of what."""
    worst = (0.0, 0.0, "")
    for name, (old, *sigma) in before.items():
        if name not in now:
            continue
        step = abs(now[name][0] - old)
        scale = abs(old) + (sigma[0] if sigma else 0.0)
        worst = max(worst, (step / scale if scale else step, step / sigma[0] if sigma else math.inf, name))
    return worst


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", type=Path, help="the file of pinned numbers")
    parser.add_argument("--against", type=Path, help="a file of pinned numbers")
    parser.add_argument("--only", nargs="*", default=[], help="parts whose names contain one of these words")
    options = parser.parse_args(argv)
    pinned = json.loads(options.against.read_text()) if options.against else {}
    found, moved = {}, False
    with tempfile.TemporaryDirectory() as folder:
        for name, numbers in measure(Path(os.environ.get("KCAL_DATA", "missing")), Path(folder), options.only):
            found[name] = numbers
            if name not in pinned:
                print(f"{name:22} {len(numbers):5} numbers", flush=True)
                continue
            relative, sigmas, what = change(numbers, pinned[name])
            other = sorted(numbers.keys() ^ pinned[name].keys())
            bad = bool(other) or (relative > 1e-9 and sigmas > 0.1)
            moved |= bad
            shown = f"{relative:8.1e} relative" + (f", {sigmas:.1e} sigma" if math.isfinite(sigmas) else "")
            came = f"; came or went: {len(other)}, such as {other[0]}" if other else ""
            print(f"{name:22} {len(numbers):5} numbers: {shown} ({what}){came}{'  <--' if bad else ''}", flush=True)
    if options.write:
        options.write.write_text(json.dumps(found, indent=1) + "\n")
    sys.exit(1 if moved else 0)


if __name__ == "__main__":
    main()
