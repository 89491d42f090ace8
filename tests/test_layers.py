"""The house keeps its rooms and floors: imports point downward, without circles; few rooms know foreign libraries."""

import ast
import graphlib
from pathlib import Path

import pytest

import kcal

PACKAGE = Path(kcal.__file__).parent
# A room may import itself and any room on a lower floor; "" is kcal itself: its errors, files and checks.
_ROOMS = (
    "web lens solve",
    "nets corners io",
    "calibrate/problem",
    "calibrate/hybrid",
    "calibrate/camera calibrate/rig",
    "calibrate/batch",
    "locate",
    "pipeline stars scene skyline",
    "watch report mark capture",
    "cli",
)
FLOORS = {"": 0} | {room: floor for floor, rooms in enumerate(_ROOMS, 1) for room in rooms.split()}
# The simulator stands beside the house: what it may import, and who may import it.
SIM_IMPORTS = {"sim", "lens", ""}
SIM_IMPORTERS = {"sim", "cli"}
IMAGE_LIBRARIES = ("kcal.opencv", "skimage")
IMAGE_ROOMS = {"corners", "io"}
# Images of whole numbers are sampled by OpenCV, in half of torch's time.
IMAGE_MODULES = {"kcal.lens.images"}
# Where OpenCV is loaded, and says which package to remove where it cannot be.
OPENCV = "kcal.opencv"
MOST_LINES = 700
# Doors name what users import, whichever room defines it, and have no floor: they import nothing but `kcal.doors`, and
# of the rooms only the command line goes through them.
DOORS = {stub.with_suffix(".py") for stub in PACKAGE.rglob("__init__.pyi")}
# These two have no floor, too: one has the version besides, the other runs the command line.
WITHOUT_FLOOR = DOORS | {PACKAGE / "__main__.py"}
# Folders that are a door alone.
EMPTY_ROOMS = {"rig", "track"}


def room_of(module: str) -> str:
    """`kcal.lens.camera` -> "lens"; `kcal.calibrate.rig.solve` -> "calibrate/rig"; `kcal.errors` and `kcal` -> ""."""
    parts = module.split(".")[1:]
    if parts[:1] == ["calibrate"]:
        return "/".join(parts[:2])
    return parts[0] if parts and (parts[0] in FLOORS or parts[0] == "sim") else ""


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
            # `from kcal import lens` and `from kcal.calibrate import rig` name modules as well.
            whole = base in ("kcal", "kcal.calibrate")
            found |= {f"{base}.{alias.name}" for alias in node.names} if whole else {base}
    return found


def may_import(importer: str, imported: str) -> bool:
    if importer == imported:
        return True
    if importer == "sim":
        return imported in SIM_IMPORTS
    if imported == "sim":
        return importer in SIM_IMPORTERS
    return imported in FLOORS and FLOORS[imported] < FLOORS[importer]


def public_module(path: Path) -> str:
    return ".".join(["kcal", *path.parent.relative_to(PACKAGE).parts])


# `import kcal` itself loads nothing; it is how a module reads the version.
DOOR_NAMES = {public_module(path) for path in DOORS} - {"kcal"} | {f"kcal.{name}" for name in kcal.__all__}


def violations(module: str, source: str) -> list[str]:
    """What is wrong with a module's source, one line each."""
    tree = ast.parse(source)
    here = room_of(module)
    wrong = []
    for name in sorted(imported_modules(tree, module.rpartition(".")[0])):
        root = name.split(".")[0]
        if root == "kcal" and not may_import(here, room_of(name)):
            wrong.append(f"{module} imports {name}")
        elif name in DOOR_NAMES and here != "cli":
            wrong.append(f"{module} goes through the door {name}")
        knows = here in IMAGE_ROOMS or module in IMAGE_MODULES
        if (not knows and name.startswith(IMAGE_LIBRARIES)) or (module != OPENCV and root == "cv2"):
            wrong.append(f"{module} imports {name}")
    of_kcal = [
        n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute) and getattr(n.value, "id", None) == "kcal"
    ]
    if here != "cli":
        wrong += [f"{module} goes through the door kcal.{name}" for name in of_kcal if name in kcal.__all__]
        prints = [n for n in ast.walk(tree) if isinstance(n, ast.Call) and getattr(n.func, "id", None) == "print"]
        wrong += [f"{module}:{node.lineno} prints" for node in prints]
    # `torch.compiler.disable` loads the compiler, 1.6 s, wherever the module is imported.
    decorators = [each for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) for each in n.decorator_list]
    wrong += [f"{module}:{node.lineno} loads the compiler" for node in decorators if "compiler" in ast.unparse(node)]
    if (lines := len(source.splitlines())) > MOST_LINES:
        wrong.append(f"{module} has {lines} lines")
    return wrong


MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path not in WITHOUT_FLOOR)


def name_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(["kcal", *(parts[:-1] if parts[-1] == "__init__" else parts)])


@pytest.mark.parametrize("room", sorted({path.parent for path in MODULES}), ids=lambda room: room.name)
def test_modules_keep_the_rules(room: Path) -> None:
    for path in sorted(set(MODULES) & set(room.glob("*.py"))):
        name = ".".join(["kcal", *path.relative_to(PACKAGE).with_suffix("").parts])
        assert violations(name, path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("path", sorted(DOORS), ids=public_module)
def test_a_door_imports_nothing(path: Path) -> None:
    allowed = {"kcal.doors"} | ({"__future__"} if path.parent == PACKAGE else set())
    assert imported_modules(ast.parse(path.read_text(encoding="utf-8")), public_module(path)) == allowed
    stub = ast.parse(path.with_suffix(".pyi").read_text(encoding="utf-8"))
    homes = {line.module for line in stub.body if isinstance(line, ast.ImportFrom)}
    assert homes.isdisjoint(DOOR_NAMES)


def test_every_folder_is_a_room() -> None:
    folders = {path.parent.relative_to(PACKAGE).as_posix() for path in PACKAGE.glob("**/__init__.py")}
    assert folders == (set(FLOORS) - {""}) | {"sim", "calibrate", "."} | EMPTY_ROOMS


def circle(graph: dict[str, set[str]]) -> list[str]:
    """The modules of one import circle, or nothing."""
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        found: list[str] = error.args[1]
        return found
    return []


def test_no_module_imports_itself_through_others() -> None:
    """Imports inside functions count too: they hide a circle, they do not remove it."""
    names = {name_of(path) for path in MODULES}
    graph = {
        name_of(path): imported_modules(ast.parse(path.read_text(encoding="utf-8")), name_of(path).rpartition(".")[0])
        & names
        for path in MODULES
    }
    assert circle(graph) == []


# The same thing at two places: one minimization, and one of a batch.
SHARED_NAMES = {"minimize"}


def defined_twice(sources: dict[str, str]) -> dict[str, list[str]]:
    """Functions and classes at the top of a module whose name another module defines too."""
    homes: dict[str, list[str]] = {}
    for module, source in sources.items():
        for node in ast.parse(source).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name not in SHARED_NAMES:
                homes.setdefault(node.name, []).append(module)
    return {name: modules for name, modules in homes.items() if len(modules) > 1}


def test_a_name_means_one_thing() -> None:
    assert defined_twice({name_of(path): path.read_text(encoding="utf-8") for path in MODULES}) == {}


def test_a_planted_second_meaning_is_seen() -> None:
    assert defined_twice({"a": "def f(): ...", "b": "class f: ...", "c": "g = 1"}) == {"f": ["a", "b"]}


def test_a_planted_circle_is_seen() -> None:
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) != []


@pytest.mark.parametrize(
    ("module", "source", "complaint"),
    [
        ("kcal.lens.camera", "from kcal.solve.lm import LMOptions", "imports kcal.solve.lm"),
        ("kcal.lens.camera", "def f():\n    from kcal.corners.board import Board", "imports kcal.corners.board"),
        ("kcal.lens.camera", "import kcal.io.camera_file as c", "imports kcal.io.camera_file"),
        ("kcal.lens.camera", "from kcal import calibrate", "imports kcal.calibrate"),
        ("kcal.lens.camera", "from ..calibrate import rig", "imports kcal.calibrate.rig"),
        ("kcal.lens.camera_like", "from kcal.nets.inverse import InverseNet", "imports kcal.nets.inverse"),
        ("kcal.solve.lm", "from kcal.lens.camera import Camera", "imports kcal.lens.camera"),
        ("kcal.corners.detect", "from kcal.io.camera_file import load_camera", "imports kcal.io.camera_file"),
        ("kcal.io.camera_file", "from kcal.corners.board import Board", "imports kcal.corners.board"),
        ("kcal.calibrate.problem.views", "from kcal.calibrate.hybrid import fit", "imports kcal.calibrate.hybrid"),
        ("kcal.calibrate.rig.solve", "from kcal.calibrate.camera.solve import solve", "imports kcal.calibrate.camera"),
        ("kcal.calibrate.camera.solve", "from ..rig import pairs", "imports kcal.calibrate.rig"),
        ("kcal.calibrate.camera.solve", "from kcal.sim.scene import demo_rig", "imports kcal.sim.scene"),
        ("kcal.sim.scene", "from kcal.corners.board import Board", "imports kcal.corners.board"),
        ("kcal.errors", "from kcal.lens.camera import Camera", "imports kcal.lens.camera"),
        ("kcal.locate.stereo", "from kcal.lens import Undistort", "through the door kcal.lens"),
        ("kcal.locate.stereo", "from kcal import Camera", "through the door kcal.Camera"),
        ("kcal.locate.stereo", "from kcal.rig import Mounting", "through the door kcal.rig"),
        ("kcal.locate.stereo", "import kcal\nkcal.Camera(1)", "through the door kcal.Camera"),
        ("kcal.locate.stereo", "from kcal.opencv import cv2", "imports kcal.opencv"),
        ("kcal.corners.detect", "import cv2", "imports cv2"),
        ("kcal.sim.scene", "from skimage.io import imread", "imports skimage"),
        ("kcal.solve.lm", "def f():\n    print(1)", ":2 prints"),
        ("kcal.solve.lm", "@torch.compiler.disable\ndef f(): ...", ":1 loads the compiler"),
        ("kcal.solve.lm", "x = 1\n" * 701, "has 701 lines"),
    ],
)  # fmt: skip
def test_planted_violations_are_seen(module: str, source: str, complaint: str) -> None:
    assert [complaint in line for line in violations(module, source)] == [True]


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("kcal.cli.demo", "import kcal\nfrom kcal.sim.scene import demo_rig\nprint(kcal.Camera(1))"),
        ("kcal.corners.detect", "from kcal.opencv import cv2\nfrom kcal.corners.board import Board"),
        ("kcal.calibrate.camera.solve", "from kcal.calibrate.problem.views import refine_poses\nfrom . import options"),
        ("kcal.sim.scene", "from kcal.lens.camera import Camera\nfrom kcal.checks import as_points"),
        ("kcal.io.camera_file", "import kcal\nimport skimage.io\nprovenance = kcal.__version__"),
        ("kcal.solve.lm", "x = 1\n" * 700),
    ],
)
def test_what_is_allowed(module: str, source: str) -> None:
    assert violations(module, source) == []
