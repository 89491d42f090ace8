"""The house keeps its floors: imports point downward, and only two folders know foreign image libraries."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import kcal

PACKAGE = Path(kcal.__file__).parent
# A folder may import itself and any lower floor; floor 0 is kcal itself, its errors, files and checks.
FLOORS = {"cli": 6, "report": 5, "locate": 4, "calibrate": 3, "corners": 2, "io": 2, "lens": 1, "solve": 1, "": 0}
# The simulator stands beside the house: what it may import, and who may import it.
SIM_IMPORTS = {"sim", "lens", ""}
SIM_IMPORTERS = {"sim", "cli"}
IMAGE_LIBRARIES = {"cv2", "skimage"}
IMAGE_FOLDERS = {"corners", "io"}
MOST_LINES = 400


def folder_of(module: str) -> str:
    """`kcal.lens.camera` -> "lens"; `kcal.errors` and `kcal` -> ""."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and (parts[1] in FLOORS or parts[1] == "sim") else ""


def imported_modules(tree: ast.AST, package: str) -> set[str]:
    """Every module that is imported anywhere in the source, inside functions and for types too."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = package.split(".")
                base = ".".join([*parents[: len(parents) - node.level + 1], *([base] if base else [])])
            # `from kcal import lens` names a module as well.
            found |= {f"{base}.{alias.name}" for alias in node.names} if base == "kcal" else {base}
    return found


def may_import(importer: str, imported: str) -> bool:
    if importer == imported:
        return True
    if importer == "sim":
        return imported in SIM_IMPORTS
    if imported == "sim":
        return importer in SIM_IMPORTERS
    return FLOORS[imported] < FLOORS[importer]


def violations(module: str, source: str) -> list[str]:
    """What is wrong with a module's source, one line each."""
    tree = ast.parse(source)
    here = folder_of(module)
    wrong = []
    for name in sorted(imported_modules(tree, module.rpartition(".")[0])):
        root = name.split(".")[0]
        if root == "kcal" and not may_import(here, folder_of(name)):
            wrong.append(f"{module} imports {name}")
        if root in IMAGE_LIBRARIES and here not in IMAGE_FOLDERS:
            wrong.append(f"{module} imports {root}")
    if here != "cli":
        prints = [n for n in ast.walk(tree) if isinstance(n, ast.Call) and getattr(n.func, "id", None) == "print"]
        wrong += [f"{module}:{node.lineno} prints" for node in prints]
    if (lines := len(source.splitlines())) > MOST_LINES:
        wrong.append(f"{module} has {lines} lines")
    return wrong


# The root names everything lazily for its users; it has no floor.
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


@pytest.mark.parametrize("path", MODULES, ids=[str(path.relative_to(PACKAGE)) for path in MODULES])
def test_module_keeps_the_rules(path: Path) -> None:
    name = ".".join(["kcal", *path.relative_to(PACKAGE).with_suffix("").parts])
    assert violations(name, path.read_text(encoding="utf-8")) == []


def test_every_folder_has_a_floor() -> None:
    folders = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert folders == set(FLOORS) - {""} | {"sim"}


@pytest.mark.parametrize(
    ("module", "source", "complaint"),
    [
        ("kcal.lens.camera", "from kcal.solve.lm import LMOptions", "imports kcal.solve.lm"),
        ("kcal.lens.camera", "def f():\n    from kcal.corners.board import Board", "imports kcal.corners.board"),
        ("kcal.lens.camera", "import kcal.io.camera_file as c", "imports kcal.io.camera_file"),
        ("kcal.lens.camera", "from kcal import calibrate", "imports kcal.calibrate"),
        ("kcal.lens.camera", "from ..calibrate import mono", "imports kcal.calibrate"),
        ("kcal.solve.lm", "from kcal.lens.camera import Camera", "imports kcal.lens.camera"),
        ("kcal.corners.detect", "from kcal.io.camera_file import load_camera", "imports kcal.io.camera_file"),
        ("kcal.io.camera_file", "from kcal.corners.board import Board", "imports kcal.corners.board"),
        ("kcal.calibrate.mono", "from kcal.sim.scene import demo_rig", "imports kcal.sim.scene"),
        ("kcal.sim.render", "from kcal.corners.board import Board", "imports kcal.corners.board"),
        ("kcal.errors", "from kcal.lens.camera import Camera", "imports kcal.lens.camera"),
        ("kcal.locate.stereo", "import cv2", "imports cv2"),
        ("kcal.sim.render", "from skimage.io import imread", "imports skimage"),
        ("kcal.solve.lm", "def f():\n    print(1)", ":2 prints"),
        ("kcal.solve.lm", "x = 1\n" * 401, "has 401 lines"),
    ],
)  # fmt: skip
def test_planted_violations_are_seen(module: str, source: str, complaint: str) -> None:
    assert [complaint in line for line in violations(module, source)] == [True]


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("kcal.cli.demo", "from kcal.sim.scene import demo_rig\nprint(1)"),
        ("kcal.corners.detect", "import cv2\nfrom kcal.corners.board import Board\nfrom kcal.errors import InputError"),
        ("kcal.calibrate.mono", "from kcal.solve.lm import LMOptions\nfrom .init import homographies"),
        ("kcal.sim.render", "from kcal.lens.camera import Camera\nfrom kcal.checks import as_points"),
        ("kcal.io.camera_file", "import kcal\nimport skimage.io"),
        ("kcal.solve.lm", "x = 1\n" * 400),
    ],
)
def test_what_is_allowed(module: str, source: str) -> None:
    assert violations(module, source) == []
