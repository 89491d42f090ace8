"""Write the pages of docs/reference that list the public names, one page for `kcal` and one for each namespace.

    python -m scripts.make_reference

Names, their groups and the modules that define them come from the stubs (`kcal/__init__.pyi`, `kcal/lens/__init__.pyi`
and so on), what each is from the first line of its docstring. Nothing of kcal is imported.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "reference"
# In the order in which a program uses them.
DOORS = (
    "kcal", "kcal.lens", "kcal.corners", "kcal.calibrate", "kcal.rig", "kcal.locate", "kcal.track", "kcal.report",
    "kcal.solve", "kcal.stars", "kcal.nets",
)  # fmt: skip


def groups(door: str) -> dict[str, list[tuple[str, str]]]:
    """Title of each group of names -> (name, the module that defines it); a comment of the stub begins a group."""
    stub = ROOT / door.replace(".", "/") / "__init__.pyi"
    found: dict[str, list[tuple[str, str]]] = {}
    for block in stub.read_text(encoding="utf-8").split("\n\n")[1:]:
        names = [line for line in ast.parse(block).body if isinstance(line, ast.ImportFrom) and line.module != "kcal"]
        if names:
            title = block.splitlines()[0].removeprefix("# ")
            found[title] = [(alias.name, str(line.module)) for line in names for alias in line.names]
    return found


def page_of(door: str) -> Path:
    """The page of `kcal` or of a namespace."""
    return FOLDER / f"{door.rpartition('.')[2]}.md"


def first_line(module: str, name: str | None = None) -> str:
    """The first line of the docstring of a module, or of what it defines.

    Raises:
        ValueError: the module does not define it, or it has no docstring.
    """
    path = ROOT / module.replace(".", "/")
    source = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    tree = ast.parse(source.read_text(encoding="utf-8"))
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
        lines += ["", f"## {title}", "", "| Name | What it is |", "|---|---|"]
        lines += [f"| `{name}` | {first_line(module, name).replace('|', chr(92) + '|')} |" for name, module in names]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write all pages."""
    for door in DOORS:
        page_of(door).write_text(page(door), encoding="utf-8")


if __name__ == "__main__":
    main()
