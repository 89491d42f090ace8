"""Install kcal into empty environments, from wheel and sdist, with the oldest and newest dependencies, and use it.

Each cell is an environment of its own in a temporary folder: an interpreter, what it is installed from, and its
dependencies. *Oldest* are the lowest versions that pyproject.toml allows, *newest* what pip chooses. In it, outside the
repository and without extras: `kcal calibrate` of two cameras from generated corners, `kcal rig` of both, `kcal locate`
of a point to within its interval; then the core tests (`--tests`), against the installed package. Interpreters that are
not found are named, not skipped silently.

What an installation takes: sizes and start-up with and without extras; kcal beside other packages of OpenCV.

Sizes are those of the packages in this environment that kcal or an extra needs and a smaller installation has not.
Without extras, their modules are hidden from the same environment. OpenCV's packages are installed into temporary
folders that come first on the path.
"""

from __future__ import annotations

import importlib.metadata
import itertools
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from kcal.files import make_folder
from scripts import make_sbom
from scripts.shared.children import timed_process
from scripts.shared.page import DOCS, Line, Lines, section, show, table

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


def call(*words: object, path: str = "", **options: Any) -> str:
    """Run a program, with `path` as PYTHONPATH; its output, or SystemExit with the end of what it said."""
    environment = os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
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


def filled(rows: list[list[str]], missing: list[str]) -> Lines:
    """The page's table; cells that were left out are shown as not run."""
    cells = [(version, *cell) for version in PYTHONS for cell in CELLS if version not in missing]
    there = {(row[0], row[1], row[2]): row for row in rows}
    rows = [there.get(head, [*head, "", "", "", "not run"]) for head in cells]
    return table(["Python", "from", "dependencies", "torch", "numpy", "scipy", "result"], rows)


@section("other-programs.md", "versions", only="none")
def versions(
    only: str = "", pythons: tuple[str, ...] = PYTHONS, tests: tuple[str, ...] = CORE, processes: int = 1,
    newest_torch: str = "",
) -> Lines:  # fmt: skip
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
    return filled(rows, missing)


# Extras of users; the others are for kcal's own tests and pages.
_NOT_OF_USERS = {"bench", "docs", "dev"}
_STARTS = {
    "`import kcal`": ["-c", "import kcal"],
    "`kcal --help`": ["-m", "kcal", "--help"],
    "`kcal locate`": ["-m", "kcal", "locate", "assets/sample-rig.json", "assets/sample-points.csv"],
}
_HIDDEN = """
import sys
class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {names}:
            raise ImportError(name, name=name)
sys.meta_path.insert(0, Hidden())
"""
_CORNERS = """
import cv2, json, sys
from kcal.corners.board import Board
from kcal.corners.detect import detect_board
from kcal.corners.images import read_gray
board = Board.parse("9x6", "25mm")
print(json.dumps([cv2.__version__, [detect_board(read_gray(path), board).pixels.tolist() for path in sys.argv[1:]]]))
"""


def needed(requirements: Iterable[str]) -> set[str]:
    """Names of the packages that these need, with all that those need in turn."""
    try:
        return set(make_sbom.needed(map(Requirement, requirements)))
    except importlib.metadata.PackageNotFoundError as missing:
        raise SystemExit(f"{missing.name} is not installed here; pip install -e '.[dev]'") from None


def megabytes(packages: Iterable[str]) -> float:
    """Of all files of these packages, each counted once."""
    files = {file.locate() for name in packages for file in importlib.metadata.files(name) or ()}
    return sum(Path(file).stat().st_size for file in files if Path(file).exists()) / 1e6


def seconds(words: list[str], path: str, runs: int) -> float:
    """CPU seconds of a command, the median of its runs."""
    options: dict[str, Any] = {"env": os.environ | {"PYTHONPATH": path}, "check": True, "cwd": ROOT}
    return statistics.median(timed_process(sys.executable, *words, **options)[1] for _ in range(runs))


@section("other-programs.md", "extras", runs=1)
def extras(runs: int = 9) -> list[Line]:
    """Size of each extra, and CPU seconds to start with all of them and with none."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    base = needed(project["dependencies"])
    rows: list[list[object]] = [
        ["kcal", len(base), f"{megabytes(base | {'torch'}):.0f}", f"{megabytes({'torch'}):.0f} of it torch"]
    ]
    modules: set[str] = set()
    tops = importlib.metadata.packages_distributions()
    for name, requirements in sorted(project["optional-dependencies"].items()):
        if name not in _NOT_OF_USERS:
            more = needed(requirements) - base
            modules |= {top for top, owners in tops.items() if {canonicalize_name(one) for one in owners} & more}
            rows.append([f"`{name}`", len(more), f"{megabytes(more):.0f}", ", ".join(requirements)])
    lines = table(["installed", "packages", "MB", "which"], rows)
    starts: list[list[object]] = []
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "sitecustomize.py").write_text(_HIDDEN.replace("{names}", repr(modules)))
        for said, words in _STARTS.items():
            times = [seconds(words, path, runs) for path in (str(ROOT), f"{folder}{os.pathsep}{ROOT}")]
            starts.append([said, *(f"{one:.2f}" for one in times)])
    return [*lines, ["start", "with all extras, CPU s", "without"], *starts]


@section("other-programs.md", "opencv packages", packages=("opencv-python-headless==5.0.0.93",), images=1)
def opencv_packages(
    packages: tuple[str, ...] = (
        "opencv-python==5.0.0.93",
        "opencv-python-headless==5.0.0.93",
        "opencv-contrib-python==5.1.0.95",
        "opencv-python==4.12.0.88",
    ),
    images: int = 13,
) -> Lines:
    """Corners of OpenCV's sample images with other packages of OpenCV, against those with kcal's own."""
    if "KCAL_DATA" not in os.environ:
        raise SystemExit("KCAL_DATA names no folder of captures")
    files = [str(one) for one in sorted(Path(os.environ["KCAL_DATA"], "opencv_stereo").glob("left*.jpg"))[:images]]

    def corners(path: str) -> tuple[str, list[list[list[float]]]]:
        return json.loads(call(sys.executable, "-c", _CORNERS, *files, path=path))

    yield ["package", "version", "corners", "largest difference, px"]
    _, own = corners(str(ROOT))
    for package in packages:
        with tempfile.TemporaryDirectory() as folder:
            call(sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", folder, package)
            used, found = corners(f"{folder}{os.pathsep}{ROOT}")
            assert package.partition("==")[2].startswith(used), used
        far = max(abs(a - b) for one, other in zip(own, found, strict=True) for p, q in zip(one, other, strict=True)
                  for a, b in zip(p, q, strict=True))  # fmt: skip
        yield [*package.split("=="), sum(map(len, found)), f"{far:.1g}"]
