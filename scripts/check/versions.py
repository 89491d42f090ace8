"""Install kcal into empty environments, from wheel and sdist, with the oldest and newest dependencies, and use it.

Each cell is an environment of its own in a temporary folder: an interpreter, what it is installed from, and its
dependencies. *Oldest* are the lowest versions that pyproject.toml allows, *newest* what pip chooses. In it, outside the
repository and without extras: `kcal calibrate` of two cameras from generated corners, `kcal rig` of both, `kcal locate`
of a point to within its interval; then the core tests (`--tests`), against the installed package. Interpreters that are
not found are named, not skipped silently.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from kcal.files import make_folder
from scripts.shared.page import DOCS, table
from scripts.shared.sections import section
from scripts.shared.timing import show

ROOT = DOCS.parents[1]
PYTHONS = ("3.11", "3.12", "3.13")
CELLS = (("wheel", "oldest"), ("sdist", "newest"))
# What needs no extra; tests whose extra is not installed skip.
CORE = ("tests/solve", "tests/lens", "tests/io", "tests/calibrate/problem", "tests/locate")
SMOKE = """
import csv, importlib.metadata, json, subprocess, sys
from pathlib import Path
import torch
import kcal
assert "site-packages" in kcal.__file__, kcal.__file__
from kcal import Board, Camera, Observations, View
from kcal.sim.captures import BoardSize, board_points
from kcal.sim.captures import sample_board_poses

true = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080), coefficients=[-0.2, 0.05])
size, generator = BoardSize(9, 6, 0.06), torch.Generator().manual_seed(1)
poses = sample_board_poses(true, size, 12, generator, fill=(0.3, 0.7))
apart = torch.tensor([-0.1, 0.0, 0.0], dtype=torch.float64)
points = torch.stack([board_points(size) @ pose.rotation.T + pose.translation for pose in poses])
seen = true.project(points)[0]
seen = seen + 0.05 * torch.randn(seen.shape, dtype=torch.float64, generator=generator)
for name, pixels in (("left", seen), ("right", true.project(points + apart)[0])):
    views = tuple(
        View(name=str(i), pixels=tuple((u, v) if 0 < u < 1919 and 0 < v < 1079 else None for u, v in view))
        for i, view in enumerate(pixels.tolist())
    )
    Observations(board=Board(columns=9, rows=6, square=0.06), image_size=(1920, 1080), views=views).save(
        f"{name}.obs.json"
    )
target = torch.tensor([[1.0, -0.3, 12.0]], dtype=torch.float64)
marks = [float(x) for at in (target, target + apart) for x in true.project(at)[0][0]]
Path("marks.csv").write_text("name,left_u,left_v,right_u,right_v\\nbuoy," + ",".join(map(str, marks)))

def run(command):
    done = subprocess.run([Path(sys.executable).with_name("kcal"), *command.split()], capture_output=True, text=True)
    assert done.returncode == 0, f"kcal {command}: {done.stdout}{done.stderr}"

run("--help")
run("calibrate left.obs.json -o left.camera.json")
run("calibrate right.obs.json -o right.camera.json")
run("rig left.camera.json right.camera.json --pairs left.obs.json right.obs.json -o rig.json")
run("locate rig.json marks.csv -o out.csv --site 19.07,72.87,14 --heading 35")
row = next(csv.DictReader(open("out.csv")))
distance = float(target.norm())
assert float(row["range_low_m"]) < distance < float(row["range_high_m"]), row
assert abs(float(row["range_m"]) - distance) < 0.02 * distance, row
assert not torch.cuda.is_initialized()
versions = {name: importlib.metadata.version(name) for name in ("torch", "numpy", "scipy", "kornia")}
print(json.dumps({"versions": versions, "python": sys.version.split()[0]}))
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


def core_tests(folder: Path, bin_folder: Path, tests: list[str], processes: int) -> str:
    """Run tests of a copy of this repository that has no package beside them; what pytest counted.

    Raises:
        SystemExit: a test failed.
    """
    copy = folder / "tests-alone"
    if not copy.exists():
        for name in ("tests", "scripts", "assets", "docs"):
            shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", copy)
    # What tests themselves import; it must not move what is tested.
    tools = "pytest", "pytest-xdist", "hypothesis", "onnx", "onnxscript", "onnxruntime", "safetensors"
    fixed = folder / "fixed.txt"
    fixed.write_text(call(bin_folder / "pip", "freeze", "--exclude", "kcal"))
    call(bin_folder / "pip", "install", "--quiet", "--no-compile", "--constraint", fixed, *tools)
    options = "-m", "not slow", "-p", "no:cacheprovider", "-n", processes
    said = call(bin_folder / "python", "-m", "pytest", *options, *tests, cwd=copy)
    return said.strip().splitlines()[-1].split(" in ")[0]


def cell(folder: Path, python: str, package: Path, pins: list[str], tests: list[str], processes: int) -> dict[str, Any]:
    """Install a package into an empty environment and use it; the environment is removed.

    Args:
        folder: for the environment.
        python: interpreter.
        package: wheel or sdist.
        pins: requirements besides it.
        tests: paths of tests to run after that.
        processes: that run them.
    """
    place = folder / "environment"
    start = time.perf_counter()
    found: dict[str, Any] = {}
    try:
        call(python, "-m", "venv", place)
        pip = place / "bin" / "pip"
        # Kept from one cell to the next: torch brings gigabytes that all interpreters share.
        wheels = "--find-links", folder / "wheels"
        call(pip, "download", "--quiet", *wheels, "--dest", wheels[1], package, *pins)
        call(pip, "install", "--quiet", "--no-compile", *wheels, package, *pins)
        installed = time.perf_counter() - start
        found = json.loads(call(place / "bin" / "python", "-c", SMOKE, cwd=folder).splitlines()[-1])
        outcome = "passed"
        if tests:
            outcome += f"; core tests: {core_tests(folder, place / 'bin', tests, processes)}"
        return {"outcome": outcome, "install_s": installed, **found}
    except SystemExit as error:
        show([str(error)])
        return {"outcome": "FAILED: " + str(error).splitlines()[-1], **found}
    finally:
        shutil.rmtree(place, ignore_errors=True)


def filled(rows: list[list[str]], missing: list[str]) -> Iterator[str]:
    """The page's table; cells that were left out are shown as not run."""
    cells = [(version, *cell) for version in PYTHONS for cell in CELLS if version not in missing]
    there = {(row[0], row[1], row[2]): row for row in rows}
    rows = [there.get(head, [*head, "", "", "", "not run"]) for head in cells]
    return table(["Python", "from", "dependencies", "torch", "numpy", "scipy", "result"], rows)


@section("other-programs.md", "versions", only="none")
def versions(
    only: str = "", pythons: tuple[str, ...] = PYTHONS, tests: tuple[str, ...] = CORE, processes: int = 1,
    newest_torch: str = "",
) -> list[str]:  # fmt: skip
    """`only`: oldest or newest dependencies. `newest_torch`: a requirement in place of what pip chooses."""
    lower = [lowest(line) for line in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]]
    rows: list[list[str]] = []
    missing = [version for version in pythons if interpreter(version) is None]
    with tempfile.TemporaryDirectory(prefix="kcal-versions-") as name:
        folder = Path(name)
        packages = built(folder) if only != "none" else {}
        make_folder(folder / "wheels")
        for version, (kind, age) in itertools.product(pythons, CELLS):
            if (python := interpreter(version)) is not None and only in ("", age):
                newest = [newest_torch] if newest_torch else []
                pins = lower if age == "oldest" else newest
                found = cell(folder, python, packages[kind], pins, list(tests), processes)
                seen = (found.get("versions", {}).get(one, "") for one in ("torch", "numpy", "scipy"))
                rows.append([version, kind, age, *seen, found["outcome"]])
                show([" | ".join(rows[-1])])
    return [*filled(rows, missing)]
