"""Write the pages of docs/reference that list the public names, one page for `kcal` and one for each namespace.

    python -m scripts.make_reference

Names, their groups and the modules that define them come from the stubs (`kcal/__init__.pyi`, `kcal/lens/__init__.pyi`
and so on), its kind from its base classes, what it does from the first line of its docstring. Nothing of kcal is
imported.
"""

from __future__ import annotations

import ast
import functools
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "reference"
# In the order in which a program uses them.
DOORS = (
    "kcal", "kcal.lens", "kcal.corners", "kcal.calibrate", "kcal.rig", "kcal.locate", "kcal.track", "kcal.report",
    "kcal.solve", "kcal.stars", "kcal.nets",
)  # fmt: skip


RETURNED = "Results and parts of them"
# Types of attributes and of private steps in which only those look who work on kcal.
INSIDE = {
    "Border", "BoardPrior", "BoardState", "CameraFile", "FieldModes", "FitOptions", "Fixes",
    "GroundSurface", "HistoryRow", "HybridFit", "LearnedStart", "LensPrior", "PosedCameras", "Spline",
    "Surroundings", "TurnModel", "WeightPrior",
}  # fmt: skip
_BASES = {"nn.Module": "module", "Exception": "error", "UserWarning": "warning"}


def groups(door: str) -> dict[str, list[tuple[str, str]]]:
    """Title of each group of names -> (name, the module that defines it); a comment of the stub begins a group.

    The last group is what the others return, and parts of it: users read these and do not make them, so they are not
    in the namespace but in the modules that define them.
    """
    found = public(door)
    if returned := returned_by().get(door):
        found[RETURNED] = returned
    return found


def public(door: str) -> dict[str, list[tuple[str, str]]]:
    """The groups of the names that a door has."""
    stub = ROOT / door.replace(".", "/") / "__init__.pyi"
    found: dict[str, list[tuple[str, str]]] = {}
    for block in stub.read_text(encoding="utf-8").split("\n\n")[1:]:
        names = [line for line in ast.parse(block).body if isinstance(line, ast.ImportFrom) and line.module != "kcal"]
        if names:
            title = block.splitlines()[0].removeprefix("# ")
            found[title] = [(alias.name, str(line.module)) for line in names for alias in line.names]
    return found


@functools.cache
def returned_by() -> dict[str, list[tuple[str, str]]]:
    """Namespace -> types that its names, or fields of these types, give away and that are not public."""
    named = {door: [home for homes in public(door).values() for home in homes] for door in DOORS}
    seen = {home for homes in named.values() for home in homes}
    found: dict[str, list[tuple[str, str]]] = {}
    for door, homes in named.items():
        for _ in range(2):
            homes = sorted({home for name, module in homes for home in _returns(module, name)} - seen)
            seen.update(homes)
            found.setdefault(door, []).extend(homes)
    return found


def _returns(module: str, name: str) -> set[tuple[str, str]]:
    """Classes of kcal (name, module) that a function, or a class in its methods and fields, gives away."""
    imported = _imported(module)
    found = _defined(module, name)
    members = found.body if isinstance(found, ast.ClassDef) else [found]
    given = [
        part
        for node in members
        if isinstance(node, ast.AnnAssign | ast.FunctionDef)
        if (kind := node.annotation if isinstance(node, ast.AnnAssign) else node.returns)
        if not _own(node).startswith("_") or _own(node) == "__call__"
        for part in ast.walk(kind)
    ]
    homes = {imported[part.id] for part in given if isinstance(part, ast.Name) and part.id in imported}
    return {
        (kind, home)
        for kind, home in homes
        # How a problem is solved is no result.
        if home.startswith("kcal.") and kind not in INSIDE and not kind.startswith("_")
        if not home.startswith(("kcal.calibrate.problem.", "kcal.calibrate.rig.source"))
        if any(isinstance(node, ast.ClassDef) and node.name == kind for node in _tree(home).body)
    }


def kind_of(module: str, name: str) -> str:
    """What a name is: a function, a `torch.nn.Module`, an error, a warning or another type."""
    found = _defined(module, name)
    if not isinstance(found, ast.ClassDef):
        return "function"
    for base in (ast.unparse(base).partition("[")[0] for base in found.bases):
        own, home = _imported(module).get(base, (base, ""))
        kind = kind_of(home, own) if home.startswith("kcal") else _BASES.get(base, "type")
        if kind != "type":
            return kind
    return "type"


def _imported(module: str) -> dict[str, tuple[str, str]]:
    """What a module's names of imports and classes mean: (name, the module that defines it)."""
    tree = _tree(module)
    names = {
        alias.asname or alias.name: (alias.name, str(node.module))
        for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names
    }  # fmt: skip
    return names | {node.name: (node.name, module) for node in tree.body if isinstance(node, ast.ClassDef)}


def _defined(module: str, name: str) -> ast.stmt:
    (found,) = (node for node in _tree(module).body if getattr(node, "name", None) == name)
    return found


def _own(node: ast.AnnAssign | ast.FunctionDef) -> str:
    return ast.unparse(node.target) if isinstance(node, ast.AnnAssign) else node.name


@functools.cache
def _tree(module: str) -> ast.Module:
    path = ROOT / module.replace(".", "/")
    source = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return ast.parse(source.read_text(encoding="utf-8"))


def page_of(door: str) -> Path:
    """The page of `kcal` or of a namespace."""
    return FOLDER / f"{door.rpartition('.')[2]}.md"


def first_line(module: str, name: str | None = None) -> str:
    """The first line of the docstring of a module, or of what it defines.

    Raises:
        ValueError: the module does not define it, or it has no docstring.
    """
    tree = _tree(module)
    for node in [tree] if name is None else tree.body:
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and getattr(node, "name", None) == name:
            text = ast.get_docstring(node)
            if text:
                return text.splitlines()[0]
    raise ValueError(f"{module} has no docstring of {name}")


def page(door: str) -> str:
    """The text of a page."""
    what = re.sub("^kcal: ", "", first_line(door))
    lines = [f"# {door}", "", what[0].upper() + what[1:], ""]
    if door == "kcal":
        others = (f"[`{other}`]({page_of(other).name})" for other in DOORS[1:])
        lines += ["The names that most programs need. The others are in namespaces: " + ", ".join(others) + ".", ""]
    named = groups(door)
    example = next(iter(named.values()))[0][0]
    lines += [
        f"`help({door}.{example})` explains arguments, units and errors, and so does the site that `make docs` builds."
    ]
    for title, names in named.items():
        lines += ["", f"## {title}", ""]
        if title == RETURNED:
            lines += ["What the names above return and contain. To annotate with one, import it from its module.", ""]
        lines += ["| Name | Kind | What it is or does |", "|---|---|---|"]
        for name, module in names:
            where = f" of `{module}`" if title == RETURNED else ""
            kind = kind_of(module, name)
            lines += [f"| `{name}`{where} | {kind} | {first_line(module, name).replace('|', chr(92) + '|')} |"]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write all pages."""
    for door in DOORS:
        page_of(door).write_text(page(door), encoding="utf-8")


if __name__ == "__main__":
    main()
