"""Install kcal into empty environments, from wheel and sdist, with the oldest and newest dependencies, and use it.

    python -m scripts.check.versions                          # all that can be had; writes the page other-programs.md
    python -m scripts.check.versions --only oldest --no-page  # quicker, for CI

Each cell is an environment of its own in a temporary folder: an interpreter, what it is installed from, and its
dependencies. *Oldest* are the lowest versions that pyproject.toml allows, *newest* what pip chooses. In it, outside the
repository: `import kcal`, a camera calibrated from generated corners, a point located to within its
interval, and `kcal --help`. Interpreters that are not found are named, not skipped silently.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path
from typing import Any

from kcal.files import make_folder
from scripts.shared.page import DOCS, table, write_section
from scripts.shared.timing import show

ROOT = DOCS.parents[1]
PYTHONS = ("3.11", "3.12", "3.13")
CELLS = (("wheel", "oldest"), ("sdist", "newest"))
SMOKE = """
import importlib.metadata, json, math, os, sys, time
import torch, numpy
start = time.perf_counter()
import kcal
assert "site-packages" in kcal.__file__, kcal.__file__
from kcal import Board, Camera, Observations, Origin, StereoLocalizer, StereoRig, View, calibrate_camera
from kcal.sim.captures import capture_corners
from kcal.sim.board import BoardSize

true = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080), coefficients=[-0.2, 0.05])
seen = capture_corners(true, 12, sigma=0.05, seed=1, board=BoardSize(9, 6, 0.06), fill=(0.4, 0.9))
views = tuple(
    View(name=str(i), pixels=tuple((float(u), float(v)) for u, v in view)) for i, view in enumerate(seen.pixels)
)
observations = Observations(board=Board(columns=9, rows=6, square=0.06), image_size=(1920, 1080), views=views)
result = calibrate_camera(observations)
assert 0.05 < result.rms < 0.09, result.rms
rig = StereoRig(result.camera, result.camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
target = torch.tensor([[120.0, -30.0, 1000.0]], dtype=torch.float64)
left, right, _ = rig(target)
found = StereoLocalizer(rig, origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=35.0, pixel_sigma=0.1)(
    left, right
)
distance = float(target.norm())
assert float(found.range_low) < distance < float(found.range_high)
assert not torch.cuda.is_initialized()
versions = {name: importlib.metadata.version(name) for name in ("torch", "numpy", "scipy", "kornia")}
print(json.dumps({"rms": result.rms, "versions": versions, "python": sys.version.split()[0]}))
"""


def lowest(requirement: str) -> str:
    """The lowest release that a requirement allows: `torch>=2.7,<3` becomes `torch==2.7.*`."""
    match = re.match(r"([\w-]+)>=([\d.]+)", requirement)
    if match is None:
        raise SystemExit(f"{requirement}: a lower bound is needed")
    name, version = match.groups()
    version = version if "." in version else f"{version}.0"
    return f"{name}=={version}.*" if version.count(".") < 2 else f"{name}=={version}"


def interpreter(version: str) -> str | None:
    """Its path, or None where there is none."""
    if sys.version.startswith(f"{version}."):
        return str(Path(sys.base_prefix, "bin", "python3"))
    found = sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))
    # Its own files first: what a version manager puts on the PATH runs only where that version was chosen.
    return str(found[-1]) if found else shutil.which(f"python{version}")


def call(*words: object, **options: Any) -> str:
    """Run a program; its output, or SystemExit with the end of what it said."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run([str(word) for word in words], text=True, capture_output=True, env=environment, **options)
    if done.returncode:
        raise SystemExit((done.stderr or done.stdout).strip()[-1500:])
    return done.stdout


def built(folder: Path) -> dict[str, Path]:
    """The wheel and the sdist of this repository."""
    tools = folder / "build-tools"
    call(sys.executable, "-m", "venv", tools)
    call(tools / "bin" / "pip", "install", "--quiet", "build")
    call(tools / "bin" / "python", "-m", "build", "--outdir", folder, ROOT)
    shutil.rmtree(tools)
    return {"wheel": next(folder.glob("*.whl")), "sdist": next(folder.glob("*.tar.gz"))}


def cell(folder: Path, python: str, package: Path, pins: list[str]) -> dict[str, Any]:
    """Install a package into an empty environment and use it; the environment is removed.

    Args:
        folder: for the environment.
        python: interpreter.
        package: wheel or sdist.
        pins: requirements besides it.
    """
    place = folder / "environment"
    start = time.perf_counter()
    try:
        call(python, "-m", "venv", place)
        pip = place / "bin" / "pip"
        # Kept from one cell to the next: torch brings gigabytes that all interpreters share.
        wheels = "--find-links", folder / "wheels"
        call(pip, "download", "--quiet", *wheels, "--dest", wheels[1], package, *pins)
        call(pip, "install", "--quiet", "--no-compile", *wheels, package, *pins)
        installed = time.perf_counter() - start
        found = json.loads(call(place / "bin" / "python", "-c", SMOKE, cwd=folder).splitlines()[-1])
        call(place / "bin" / "kcal", "--help", cwd=folder)
        return {"outcome": "passed", "install_s": installed, **found}
    except SystemExit as error:
        return {"outcome": "FAILED: " + str(error).splitlines()[-1]}
    finally:
        shutil.rmtree(place, ignore_errors=True)


def filled(rows: list[list[str]], missing: list[str]) -> list[str]:
    """The page's table; cells that were left out are shown as not run."""
    cells = [(version, *cell) for version in PYTHONS for cell in CELLS if version not in missing]
    there = {(row[0], row[1], row[2]): row for row in rows}
    rows = [there.get(head, [*head, "", "", "", "not run"]) for head in cells]
    return table(["Python", "from", "dependencies", "torch", "numpy", "scipy", "result"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=("oldest", "newest"), help="only these dependencies")
    parser.add_argument("--pythons", nargs="+", default=list(PYTHONS), metavar="X.Y")
    parser.add_argument("--newest-torch", default="", metavar="REQUIREMENT", help="in place of what pip chooses")
    parser.add_argument("--out", type=Path, help="JSON lines of rows; those in it are kept and shown")
    parser.add_argument("--no-page", action="store_true")
    arguments = parser.parse_args()
    lower = [lowest(line) for line in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]]
    kept = arguments.out.read_text().splitlines() if arguments.out and arguments.out.exists() else []
    rows: list[list[str]] = [json.loads(line) for line in kept]
    missing: list[str] = []
    with tempfile.TemporaryDirectory(prefix="kcal-versions-") as name:
        folder = Path(name)
        packages = built(folder)
        make_folder(folder / "wheels")
        for version in arguments.pythons:
            python = interpreter(version)
            if python is None:
                missing.append(version)
                continue
            for kind, age in CELLS:
                done = [version, kind, age] in [row[:3] for row in rows]
                if arguments.only in (None, age) and not done:
                    newest = [arguments.newest_torch] if arguments.newest_torch else []
                    found = cell(folder, python, packages[kind], lower if age == "oldest" else newest)
                    seen = found.get("versions", {})
                    names = ("torch", "numpy", "scipy")
                    rows.append([version, kind, age, *(seen.get(name, "") for name in names), found["outcome"]])
                    show([" | ".join(rows[-1])])
                    if arguments.out:
                        with arguments.out.open("a") as file:
                            file.write(json.dumps(rows[-1]) + "\n")
        if not arguments.no_page:
            write_section("other-programs.md", "versions", "\n".join(filled(rows, missing)))
    if not rows or any(row[-1] != "passed" for row in rows):
        sys.exit(1)


if __name__ == "__main__":
    main()
