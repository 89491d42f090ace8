"""The pages name only what exists: links, pictures, scripts, files and functions."""

from __future__ import annotations

import ast
import importlib.util
import re
from pathlib import Path

import pytest

from scripts.shared.page import CONCLUSIONS

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]


def missing_links(page: Path, text: str) -> list[str]:
    """Relative links and pictures of a page without a file."""
    targets = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'(?:src|href)="([^"]+)"', text)
    relative = [target.split("#")[0] for target in targets if not re.match(r"[a-z]+:", target)]
    return [target for target in relative if target and not (page.parent / target).exists()]


def missing_scripts(text: str) -> list[str]:
    """Paths below scripts/ and modules `scripts...` without a file."""
    paths = set(re.findall(r"\bscripts/[\w/]+(?:\.py)?", text))
    modules = set(re.findall(r"python -m (scripts[\w.]*\w)", text))
    absent = [path for path in paths if not any((ROOT / f"{path}{suffix}").exists() for suffix in ("", ".py"))]
    return sorted(absent + [module for module in modules if importlib.util.find_spec(module) is None])


def missing_code(text: str) -> list[str]:
    """`kcal/...py`, `tests/...py` and `path.py::Class.method` that do not exist."""
    absent = []
    for path, name in re.findall(r"`((?:kcal|tests)/[\w/]+\.py)(?:::([\w.]+))?`", text):
        if not (ROOT / path).exists():
            absent.append(path)
            continue
        scope = ast.parse((ROOT / path).read_text(encoding="utf-8")).body
        for part in name.split(".") if name else ():
            found = [node for node in scope if part in names_of(node)]
            scope = getattr(found[0], "body", []) if found else []
            absent += [] if found else [f"{path}::{name}"]
    return absent


def names_of(node: ast.stmt) -> set[str]:
    """What a statement defines."""
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return {getattr(node, "name", "")} | {target.id for target in targets if isinstance(target, ast.Name)}


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_a_page_names_what_exists(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert missing_links(page, text) == []
    assert missing_scripts(text) == []
    assert missing_code(text) == []


def test_planted_mistakes_are_seen() -> None:
    page = ROOT / "docs" / "index.md"
    assert missing_links(page, "[a](none.md) ![b](none.png) [c](#d) [e](https://f.org/none)") == ["none.md", "none.png"]
    assert missing_scripts("`scripts/none.py`, python -m scripts.bench.none") == [
        "scripts.bench.none",
        "scripts/none.py",
    ]
    text = "`kcal/none.py` `kcal/lens/camera.py::Camera.none` `kcal/lens/camera.py::Camera.project`"
    assert missing_code(text) == ["kcal/none.py", "kcal/lens/camera.py::Camera.none"]


def test_every_page_is_in_the_index() -> None:
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    pages = {page.relative_to(ROOT / "docs").as_posix() for page in (ROOT / "docs").rglob("*.md")}
    assert {page for page in pages if f"({page})" not in index} == {"index.md"}


@pytest.mark.parametrize("page", sorted(path.name for path in (ROOT / "docs" / "measured").glob("*.md")))
def test_a_measured_page_begins_with_its_conclusion(page: str) -> None:
    opening = (ROOT / "docs" / "measured" / page).read_text(encoding="utf-8").split("\n\n")[1]
    assert opening.startswith("**Conclusion.**")
    # What a script writes anew must be what the page says.
    assert page not in CONCLUSIONS or opening == CONCLUSIONS[page]
