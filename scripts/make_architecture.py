"""Draw the rooms of kcal and the imports between them into docs/architecture.png.

    python -m scripts.make_architecture

Rooms and imports are read from the source. A room stands above every room that it imports. An arrow that other arrows
imply (a room also imports what its imports import) is left out, and so is the room at the bottom, `kcal` itself (its
errors, files and checks), which every room may import.
"""

from __future__ import annotations

import ast
import itertools
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "kcal"
PICTURE = ROOT / "docs" / "architecture.png"
BOTTOM = "kcal"
WIDTH, HEIGHT = 0.92, 0.5  # of a box; columns and floors are 1 apart
# The column of each room and what is written under its name. Floors and arrows come from the imports.
LOOKS = {
    "cli": (3.3, "commands"),
    "report": (1.6, "pictures and maps"),
    "mark": (2.6, "marking page"),
    "pipeline": (5.7, "tracks, streams"),
    "capture": (5.1, "guided photography"),
    "web": (5.7, "local pages"),
    "calibrate/batch": (4.0, "many cameras"),
    "calibrate/hybrid": (2.95, "hybrid lens"),
    "locate": (1.0, "pixels to positions"),
    "calibrate/camera": (2.8, "one camera"),
    "calibrate/rig": (1.0, "several cameras"),
    "nets": (4.55, "learned inverse"),
    "stars": (3.65, "stars of the night"),
    "scene": (2.4, "matches of the scene"),
    "skyline": (4.65, "skyline and terrain"),
    "watch": (4.6, "a rig over time"),
    "sim": (0.0, "simulated truth"),
    "io": (1.0, "files"),
    "corners": (2.15, "boards, detection"),
    "calibrate/problem": (3.4, "what is minimized"),
    "lens": (2.15, "cameras and rigs"),
    "solve": (4.2, "least squares"),
}


def room_of(module: str) -> str:
    """`kcal.lens.camera` -> "lens"; `kcal.calibrate.rig.solve` -> "calibrate/rig"; `kcal.errors` -> "kcal"."""
    parts = module.split(".")[1:]
    if parts[:1] == ["calibrate"]:
        return "/".join(parts[:2])
    return parts[0] if parts and (PACKAGE / parts[0]).is_dir() else BOTTOM


def read_imports() -> dict[str, set[str]]:
    """Which rooms each room imports, in functions and for types too."""
    rooms: dict[str, set[str]] = {BOTTOM: set()}
    for path in PACKAGE.rglob("*.py"):
        module = ".".join(["kcal", *path.relative_to(PACKAGE).with_suffix("").parts])
        room = room_of(module)
        # Doors name what other rooms define, and belong to no room.
        stub = path.with_suffix(".pyi")
        if path.name == "__main__.py" or (path.name == "__init__.py" and stub.exists()):
            continue
        imported = rooms.setdefault(room, set())
        # What commands take of the rooms stands in a stub.
        for node in ast.walk(ast.parse((stub if stub.exists() else path).read_text(encoding="utf-8"))):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            imported |= {room_of(name) for name in names if name.split(".")[0] == "kcal"} - {room}
    return rooms


def floors(rooms: dict[str, set[str]]) -> dict[str, int]:
    """The floor of each room: 0 without imports, else one above the highest room that it imports.

    Raises:
        ValueError: rooms that import each other.
    """
    level: dict[str, int] = {}
    while len(level) < len(rooms):
        ready = {room for room in rooms if room not in level and rooms[room] <= set(level)}
        if not ready:
            raise ValueError(f"rooms import each other: {sorted(set(rooms) - set(level))}")
        level |= {room: max((level[below] + 1 for below in rooms[room]), default=0) for room in ready}
    return level


def arrows(rooms: dict[str, set[str]]) -> set[tuple[str, str]]:
    """The imports that no other imports imply, without those of `kcal` itself."""
    level = floors(rooms)
    reach: dict[str, set[str]] = {}
    for room in sorted(rooms, key=level.__getitem__):
        reach[room] = rooms[room].union(*(reach[below] for below in rooms[room]))
    return {
        (room, below)
        for room, imported in rooms.items()
        for below in imported - {BOTTOM}
        if not any(below in reach[other] for other in imported)
    }


def draw(path: Path) -> None:
    """Draw boxes on their floors and arrows between them."""
    rooms = read_imports()
    level = floors(rooms)
    place = {room: (LOOKS.get(room, (5.4, ""))[0], float(level[room])) for room in rooms if room != BOTTOM}
    boxes = sorted((y, x, room) for room, (x, y) in place.items())
    for (y, x, room), (other_y, other_x, other) in itertools.pairwise(boxes):
        if y == other_y and other_x - x < WIDTH:
            raise ValueError(f"{room} and {other} overlap: give them other columns in LOOKS")
    left, right = min(x for x, _ in place.values()), max(x for x, _ in place.values())
    figure, axes = plt.subplots(figsize=(11, 8.5), layout="constrained")
    for room, (x, y) in place.items():
        color = "#dbe9f6" if room.startswith("calibrate/") else "#f4efe1"
        _box(axes, x, y, WIDTH, room, LOOKS.get(room, (0, ""))[1], color)
    _box(axes, (left + right) / 2, 0, right - left + WIDTH, BOTTOM, "errors, files, checks: every room", "#eeeeee")
    for room, below in sorted(arrows(rooms)):
        (x, y), (to_x, to_y) = place[room], place[below]
        # Imports that skip floors at the left edge go around the boxes between.
        around = to_x == left and y - to_y > 2
        start = (x - WIDTH / 2, y) if around else (x, y - HEIGHT / 2)
        style = "angle,angleA=180,angleB=90,rad=12" if around else "arc3"
        arrow = FancyArrowPatch(
            start,
            (to_x, to_y + HEIGHT / 2),
            arrowstyle="-|>",
            connectionstyle=style,
            mutation_scale=13,
            shrinkA=0,
            shrinkB=1,
            color="#555555",
            zorder=0.5,
        )
        axes.add_patch(arrow)
    axes.set_xlim(left - 0.6, right + 0.6)
    axes.set_ylim(-0.45, max(level.values()) + 0.45)
    axes.axis("off")
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)


def _box(axes: Axes, x: float, y: float, width: float, name: str, role: str, color: str) -> None:
    corner = (x - width / 2, y - HEIGHT / 2)
    box = FancyBboxPatch(corner, width, HEIGHT, boxstyle="round,pad=0,rounding_size=0.06", fc=color, ec="#333333")
    axes.add_patch(box)
    axes.text(x, y + 0.07, name, ha="center", va="center", fontsize=11, fontweight="bold", zorder=3)
    axes.text(x, y - 0.11, role, ha="center", va="center", fontsize=9, zorder=3)


if __name__ == "__main__":
    draw(PICTURE)
