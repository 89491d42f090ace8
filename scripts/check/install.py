"""What an installation takes: sizes and start-up with and without extras; kcal beside other packages of OpenCV.

Sizes are those of the packages in this environment that kcal or an extra needs and a smaller installation has not.
Without extras, their modules are hidden from the same environment. OpenCV's packages are installed into temporary
folders that come first on the path.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import statistics
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from scripts import make_sbom
from scripts.shared.page import DOCS, Line, Lines, table
from scripts.shared.sections import section
from scripts.shared.timing import children_seconds

ROOT = DOCS.parents[1]
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
    spent = []
    for _ in range(runs):
        before = children_seconds()
        subprocess.run(
            [sys.executable, *words], env=os.environ | {"PYTHONPATH": path}, capture_output=True, check=True, cwd=ROOT
        )
        spent.append(children_seconds() - before)
    return statistics.median(spent)


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
        done = subprocess.run(
            [sys.executable, "-c", _CORNERS, *files],
            env=os.environ | {"PYTHONPATH": path},
            capture_output=True,
            text=True,
        )
        if done.returncode:
            raise SystemExit(done.stderr[-1000:])
        return json.loads(done.stdout)

    yield ["package", "version", "corners", "largest difference, px"]
    _, own = corners(str(ROOT))
    for package in packages:
        with tempfile.TemporaryDirectory() as folder:
            subprocess.run(
                [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", folder, package],
                check=True,
            )
            used, found = corners(f"{folder}{os.pathsep}{ROOT}")
            assert package.partition("==")[2].startswith(used), used
        far = max(abs(a - b) for one, other in zip(own, found, strict=True) for p, q in zip(one, other, strict=True)
                  for a, b in zip(p, q, strict=True))  # fmt: skip
        yield [*package.split("=="), sum(map(len, found)), f"{far:.1g}"]
