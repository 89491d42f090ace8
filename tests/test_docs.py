"""The pages name only what exists: links, pictures, scripts, files and functions."""

import ast
import importlib
import importlib.util
import re
from pathlib import Path

import pytest
import torch

from kcal.cli.options import NAME as SETTINGS_FILE
from scripts.docs_site import commands_page, conclusions_page, navigation, ordered, with_descriptions
from scripts.make_reference import DOORS, groups, page, page_of, public

ROOT = Path(__file__).parents[1]
PAGES = [
    *(ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "SECURITY")),
    *sorted((ROOT / "docs").rglob("*.md")),
]
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


def missing_names(text: str) -> list[str]:
    """`kcal.lens.baking` and its like that do not exist, or are old names."""
    names = set(re.findall(r"(?<![\w./-])kcal(?:\.\w+)+", text)) - {SETTINGS_FILE}
    return [name for name in sorted(names) if not exists(name)]


def exists(name: str) -> bool:
    """Whether a dotted name is a module or something in one."""
    first, *parts = name.split(".")
    found: object = importlib.import_module(first)
    for number, part in enumerate(parts):
        try:
            found = getattr(found, part)
        except AttributeError:
            try:
                found = importlib.import_module(".".join([first, *parts[: number + 1]]))
            except ImportError:
                return False
    return True


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
    assert missing_names(text) == []


def test_planted_mistakes_are_seen() -> None:
    page = ROOT / "docs" / "index.md"
    assert missing_links(page, "[a](none.md) ![b](none.png) [c](#d) [e](https://f.org/none)") == ["none.md", "none.png"]
    scripts = missing_scripts("`scripts/none.py`, python -m scripts.bench.none")
    assert scripts == ["scripts.bench.none", "scripts/none.py"]
    text = "`kcal/none.py` `kcal/lens/camera.py::Camera.none` `kcal/lens/camera.py::Camera.project`"
    assert missing_code(text) == ["kcal/none.py", "kcal/lens/camera.py::Camera.none"]
    there = "`kcal.lens.bake(camera)`, kcal.Camera.project, kcal.lens.zernike, kcal/none.py, a.kcal.none"
    absent = ["kcal.bake", "kcal.lens.none", "kcal.none.Camera"]
    assert missing_names(f"{there}: {' '.join(absent)}") == absent


def names_in(nav: object) -> list[str]:
    """Pages of a navigation as MkDocs has it: texts, in lists and in dictionaries."""
    if isinstance(nav, str):
        return [nav]
    return [name for part in (nav.values() if isinstance(nav, dict) else nav) for name in names_in(part)]


def test_every_page_is_in_the_navigation() -> None:
    pages = {page.relative_to(ROOT / "docs").as_posix() for page in (ROOT / "docs").rglob("*.md")}
    names = names_in(navigation())
    assert len(names) == len(set(names))
    made = {name for name in names if name not in pages}
    assert pages < set(names)
    # The others are made of the code when the site is built.
    notebooks = {f"notebooks/{path.stem}.md" for path in (ROOT / "docs").rglob("*.ipynb")}
    assert {name for name in made if not name.startswith("reference/")} == {"measured/index.md"} | notebooks


def test_pages_without_a_place_follow_those_that_have_one() -> None:
    found = ordered(["new", "drift", "board", "marking"], ("board", "mark*", "drift"))
    assert found == ["board", "marking", "drift", "new"]


@pytest.mark.parametrize("door", DOORS)
def test_every_public_name_is_in_the_reference(door: str) -> None:
    module, text = importlib.import_module(door), page_of(door).read_text(encoding="utf-8")
    assert text == page(door), "python -m scripts.make_reference writes it anew"
    listed = re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)
    assert sorted([*listed, *re.findall(r"\[`kcal\.(\w+)`\]\(\1\.md\)", text)]) == module.__all__
    # On the site each name leads to its docstring.
    site = with_descriptions(door, text)
    homes = dict(name for names in groups(door).values() for name in names)
    assert sorted(name for names in public(door).values() for name, _ in names) == sorted(listed)
    for name, home in homes.items():
        assert f"| [`{name}`][{home}.{name}] {'|' if name in listed else 'of'}" in site
        assert f"::: {home}.{name}\n" in site
        value = getattr(importlib.import_module(home), name)
        kinds = ((torch.nn.Module, "module"), (Warning, "warning"), (Exception, "error"), (object, "type"))
        kind = next(kind for base, kind in kinds if issubclass(value, base)) if isinstance(value, type) else "function"
        where = "" if name in listed else f" of `{home}`"
        assert f"| `{name}`{where} | {kind} | " in text


def test_the_pages_of_the_reference_are_on_the_index() -> None:
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    assert [door for door in DOORS if f"(reference/{page_of(door).name})" not in index] == []


def test_the_commands_page_has_every_option() -> None:
    page = commands_page()
    assert "## kcal rig check" in page
    assert (
        "`--pixel-sigma` `PX` | Noise of marks along each axis; that in the rig's file, or 0.3, if not given. |" in page
    )
    assert "`--output`, `-o` `PATH` | Rig file to write. | required |" in page


HOWTOS = sorted((ROOT / "docs" / "howto").glob("*.md"))


@pytest.mark.parametrize("page", HOWTOS, ids=[page.stem for page in HOWTOS])
def test_a_howto_fits_one_screen(page: Path) -> None:
    assert len(page.read_text(encoding="utf-8").split()) <= 250


def test_the_way_to_a_first_position_is_short() -> None:
    pages = ROOT / "README.md", ROOT / "docs" / "tutorial" / "guide.md"
    assert sum(len(page.read_text(encoding="utf-8").split()) for page in pages) < 1500


MEASURED = sorted((ROOT / "docs" / "measured").glob("*.md"))


@pytest.mark.parametrize("page", MEASURED, ids=[page.stem for page in MEASURED])
def test_a_measured_page_concludes_and_then_shows(page: Path) -> None:
    """Where kcal is behind, the conclusion, a table or a picture with a caption, and what makes it."""
    text = re.sub(r"<!--.*?-->\n", "", page.read_text(encoding="utf-8"))
    beginning = re.split(r"\n## ", text)[0]
    _, losses, conclusion, *shown = beginning.split("\n\n")
    assert losses.startswith("**Losses.** ")
    assert conclusion.startswith("**Conclusion.** ")
    assert f"{losses}\n\n{conclusion}\n" in conclusions_page()
    assert any(block.startswith(("| ", "![")) for block in shown[:2])
    assert re.search(r"`(python -m scripts\.|scripts/)", "".join(shown))


def test_how_often_intervals_are_right_is_one_figure_of_the_whole_chain() -> None:
    """The table of `scripts.check.chain` gives it; the other pages link to it and state no other one."""
    text = (ROOT / "docs" / "measured" / "chain.md").read_text(encoding="utf-8")
    cells = [line.split(" | ")[7] for line in text.splitlines() if " | default-prior | " in line]
    ends = [cell.split(" to ") for cell in cells]
    figure = f"{min(low for low, _ in ends)} to {max(high for _, high in ends)} %"
    assert f"{figure} of the intervals contain the true range" in text
    stated = {
        page: re.findall(r"\[(\d[\d.]* to \d[\d.]* %)\]\([./a-z]*chain\.md", page.read_text("utf-8")) for page in PAGES
    }
    assert {found for each in stated.values() for found in each} == {figure}
    assert {"README.md", "guide.md", "survey.md", "paper.md"} <= {page.name for page, found in stated.items() if found}
    other = [page for page in PAGES if page.parent.name != "measured" and page.name != "CHANGELOG.md"]
    assert [
        page for page in other if re.search(r"9\d[\d.]* to 9\d[\d.]* % of (the|cases)", page.read_text("utf-8"))
    ] == []


def test_a_figure_with_a_link_to_a_measured_page_is_in_its_tables() -> None:
    number, missing = re.compile(r"\d+(?:\.\d+)?"), []
    for each in PAGES:
        text = each.read_text(encoding="utf-8")
        for said, name in re.findall(r"\[([^][]*\d[^][]*)\]\([./\w-]*measured/([\w-]+\.md)[^)]*\)", text):
            made = (ROOT / "docs" / "measured" / name).read_text(encoding="utf-8")
            tables = re.sub(r"<!-- python.*?-->", "", "".join(re.findall(r"<!-- begin.*?<!-- end", made, re.DOTALL)))
            for figure in number.findall(said):
                digits = len(figure.partition(".")[2])
                if all(f"{float(one):.{digits}f}" != figure for one in number.findall(tables)):
                    missing.append(f"{each.name}: {said!r}, {name}")
    assert missing == []


def test_programs_were_tested_with_the_versions_of_constraints() -> None:
    pins = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line)
    page = (ROOT / "docs/reference/programs.md").read_text()
    rows = [line.split("|")[-2] for line in page.splitlines() if "|" in line]
    told = dict(re.findall(r"([a-z][\w-]+) (\d+\.\d[\d.]*)", " ".join(rows)))
    assert len(told) > 10
    assert told == {name: pins[name] for name in told}
