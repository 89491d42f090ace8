"""Make assets/view.png: a practice site, calibrated and located, in the 3-D viewer rerun.

    python -m scripts.make_view_picture [FOLDER]

Everything is made by commands of kcal, marks by the site's truth with 0.1 px of noise. The viewer draws in software, on
a display that is not there: `apt-get install xvfb mesa-vulkan-drivers`. With a folder, what is in it already is kept.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
SIGMA = 0.1
# Of the window, points; and its bars above and below the scene, which are cut off, at 2 pixels a point.
WIDTH, HEIGHT = 750, 560
# Pixels a point of the picture.
SCALE = 1.5
ABOVE, BELOW = 124, 60


def kcal(folder: Path, words: str) -> None:
    """Run one command of kcal in a folder; stop if it fails."""
    subprocess.run([sys.executable, "-m", "kcal", *words.split()], check=True, cwd=folder)


def solve(folder: Path) -> None:
    """Calibrate both cameras and solve the rig, with what of it is not there yet."""
    if not (folder / ".truth").exists():
        kcal(folder.parent, f"demo --practice {folder.name}")
    truth = json.loads((folder / ".truth" / "truth.json").read_text())
    random, head = np.random.default_rng(0), "name,left_u,left_v,right_u,right_v"
    tables: dict[str, list[str]] = {"marks.csv": [head], "points.csv": [head]}
    for name, pixels in truth["marks"].items():
        seen = np.array(pixels).reshape(4) + SIGMA * random.standard_normal(4)
        table = tables["points.csv" if name in truth["targets"] else "marks.csv"]
        table.append(f"{name},{','.join(map(repr, seen.tolist()))}")
    for name, lines in tables.items():
        (folder / name).write_text("\n".join(lines) + "\n")
    for side in ("left", "right"):
        if not (folder / f"{side}.camera.json").exists():
            kcal(folder, f"detect boards/{side} --board 9x6 --square 60mm -o {side}.obs.json")
            kcal(folder, f"calibrate {side}.obs.json -o {side}.camera.json")
    if not (folder / "rig.json").exists():
        files = "left.camera.json right.camera.json --landmarks survey.csv --marks marks.csv"
        kcal(folder, f"rig {files} --pixel-sigma {SIGMA} -o rig.json")


def screenshot(recording: Path, picture: Path) -> None:
    """Open a recording in the viewer and save what it shows, without the bars of its window."""
    shot = recording.with_suffix(".png")
    # The mouse is in the middle of the display: the window is beside it.
    display = ["xvfb-run", "-a", "-s", f"-screen 0 {5 * WIDTH}x{5 * HEIGHT}x24"]
    where = f"--port auto --bind 127.0.0.1 --window-size {WIDTH}x{HEIGHT} --screenshot-to".split()
    viewer = [sys.executable, "-m", "rerun_cli", str(recording), *where, str(shot)]
    home = str(recording.parent)
    subprocess.run(display + viewer, check=True, timeout=300, env=os.environ | {"CI": "1", "HOME": home})
    with Image.open(shot) as image:
        scene = image.convert("RGB").crop((0, ABOVE, image.width, image.height - BELOW))
    scene = scene.resize((round(SCALE * WIDTH), round(SCALE * scene.height / 2)), Image.Resampling.LANCZOS)
    # Median cut would lose the few pixels of the lines.
    scene.quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(picture, optimize=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, help="of the site; a temporary one if not given")
    given = parser.parse_args().folder
    with tempfile.TemporaryDirectory() as temporary:
        folder = (given or Path(temporary, "site")).resolve()
        solve(folder)
        kcal(folder, "view rig.json points.csv site/left.png site/right.png -o view.rrd")
        screenshot(folder / "view.rrd", ROOT / "assets" / "view.png")


if __name__ == "__main__":
    main()
