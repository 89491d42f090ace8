"""Commands on the measured pages exist as they are written there, and each page says what they need."""

import argparse
import ast
import functools
import re
import runpy
import shlex
import sys
import time
import tomllib
from pathlib import Path

import pytest

from scripts import measure
from scripts.shared import page as shared_page
from scripts.shared.page import Section

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs" / "measured").glob("*.md"))
COMMAND = re.compile(r"`((?:[A-Z_]+=\S+\s+)*python\s+-m\s+scripts\.[^`]+)`")


def commands(page: Path) -> list[str]:
    return [" ".join(found.split()) for found in COMMAND.findall(page.read_text(encoding="utf-8"))]


ALL = sorted({(page.stem, command) for page in PAGES for command in commands(page)})


class ParsedError(Exception):
    """The arguments are what the script takes; nothing has run."""


def parse(command: str, patch: pytest.MonkeyPatch) -> None:
    """Start the script of a command, and stop it when it has read its arguments."""
    words = [word for word in shlex.split(command) if not re.match(r"[A-Z_]+=", word)]
    patch.setattr(sys, "argv", words[2:])
    read = argparse.ArgumentParser.parse_args

    def stop(self: argparse.ArgumentParser, *given: object) -> None:
        read(self, *given)  # type: ignore[call-overload]
        raise ParsedError

    patch.setattr(argparse.ArgumentParser, "parse_args", stop)
    if words[2] == "scripts.measure":
        measure.main()
    else:
        runpy.run_module(words[2], run_name="__main__", alter_sys=True)


@pytest.mark.filterwarnings("ignore:'scripts:RuntimeWarning")
@pytest.mark.parametrize(("page", "command"), ALL)
def test_a_command_exists_with_its_options(page: str, command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ParsedError):
        parse(command, monkeypatch)


@pytest.mark.parametrize("wrong", ["stars real --wrote", "stars reel", "sky real"])
def test_a_wrong_option_is_seen(wrong: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SystemExit):
        parse(f"python -m scripts.measure {wrong}", monkeypatch)


@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_a_function_makes_each_table(page: Path) -> None:
    """Every section is closed, and has a function."""
    text = page.read_text(encoding="utf-8")
    names = re.findall(r"<!-- begin: (.+) -->", text)
    assert names == re.findall(r"<!-- end: (.+) -->", text)
    made = [each.name for each in measure.load(page.stem) if each.name != "picture"]
    assert sorted(made) == sorted(names)


# Sections that take few seconds in little, without other programs and without an installation; `make pages` runs all.
IN_LITTLE = (
    "lens accuracy", "lens no ray", "lens lookup tables", "lens inverse nets", "locate accuracy",
    "locate coverage", "locate localizer", "moving moving", "mutants mutants", "ordinary aspect",
    "other-programs devices", "paper table 2", "precision limits", "precision lens precision",
    "rig contradictions", "rig coverage", "rig turned", "rig faults", "solver first-order methods",
    "solver predicted and repeated", "stars random", "stations coverage", "stations peers", "stations smoke",
    "stations two", "tracks station tracks", "tracks station speed", "watch drift", "watch swing",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("section", IN_LITTLE)
def test_a_section_is_made_in_little(section: str, capsys: pytest.CaptureFixture[str]) -> None:
    """It raises where a table has columns that the page does not have."""
    measure.main([*section.split(" ", 1), "--quick"])
    lines = capsys.readouterr().out.splitlines()
    assert not lines[1].startswith("left out, ")
    assert lines[-1].endswith(" CPU s")
    assert len(lines) > 2


def test_a_table_says_what_made_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(shared_page, "DOCS", tmp_path)
    (tmp_path / "lens.md").write_text("# Page\n")
    each = Section("lens.md", "two words", lambda seeds=range(9), names=("a",): ["| x |"], {"seeds": range(1)})
    measure.make(each, {"seeds": range(2, 4)}, quick=True, write=True)
    assert "| x |" not in (tmp_path / "lens.md").read_text()
    measure.make(each, {"seeds": range(2, 4)}, quick=False, write=True)
    table, made = shared_page.read_section("lens.md", "two words").split("\n\n")
    assert table == "| x |"
    assert "python -m scripts.measure lens 'two words' --seeds 2-3 --names a, " in made
    told = ("commit ", " CPUs", "one thread", " CPU s", "Python 3", "torch 2", time.strftime("%Y-"))
    assert all(word in made for word in told)


def test_a_table_with_other_columns_is_seen(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(shared_page, "DOCS", tmp_path)
    page = "<!-- begin: it -->\n| error of 5 |  σ |\n| --- | --- |\n| 1 | 2 |\n<!-- end: it -->\n"
    (tmp_path / "lens.md").write_text(page)

    def made(*heads: str) -> Section:
        return Section("lens.md", "it", lambda: list(shared_page.table(heads, [["1"] * len(heads)])), {})

    measure.make(made("error of 7"), {}, quick=True, write=False)  # a program that is not here, and another number
    with pytest.raises(ValueError, match="columns that the page does not have"):
        measure.make(made("error of 7", "s"), {}, quick=True, write=False)
    with pytest.raises(SystemExit, match="not written, the page has columns that are not here"):
        measure.make(made("error of 5"), {}, quick=False, write=True)
    assert (tmp_path / "lens.md").read_text() == page
    measure.make(made("error of 5", "σ"), {}, quick=False, write=True)
    assert "CPU s" in (tmp_path / "lens.md").read_text()


@functools.cache
def extra_packages() -> frozenset[str]:
    """Names by which Python imports what `pip install kcal[bench]` installs."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    waiting, names = [*project["dependencies"], "kcal[bench]"], set()
    while waiting:
        line = waiting.pop()
        if line.startswith("kcal["):
            for extra in line[5:].rstrip("]").split(","):
                waiting += project["optional-dependencies"][extra]
        names.add(re.split(r"[^\w.-]", line)[0].lower())
    other = {"cv2": "opencv-contrib-python-headless", "PIL": "pillow", "skimage": "scikit-image"}
    other |= {"erfa": "pyerfa", "yaml": "pyyaml"}
    return frozenset({*names, *(name for name, package in other.items() if package in names)})


@functools.cache
def read(module: str) -> tuple[frozenset[str], frozenset[str]]:
    """Scripts that a script imports or starts, and what it asks for: packages and folders or programs by variable."""
    path = ROOT / f"{module.replace('.', '/')}.py"
    if not path.exists():  # a name in a module
        return frozenset(), frozenset()
    text = path.read_text(encoding="utf-8")
    asked = set(re.findall(r"KCAL_(?:DATA|MRCAL|PEERS|ROS|OPENCV|LENSBOY)", text))
    scripts = {f"{module.rpartition('.')[0]}.{name}" for name in re.findall(r'with_name\("(\w+)\.py"\)', text)}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            asked |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            asked.add(node.module.split(".")[0])
            scripts |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    own = {"kcal", "scripts", *sys.stdlib_module_names, *extra_packages()}
    return frozenset(name for name in scripts if name.startswith("scripts.")), frozenset(asked - own)


def needs(module: str) -> set[str]:
    """What a script and those that it uses ask for beyond a checkout and the extra `bench`."""
    seen, waiting, found = set(), [module], set()
    while waiting:
        each = waiting.pop()
        if each not in seen:
            seen.add(each)
            more, asked = read(each)
            waiting += more
            found |= asked
    return found


@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_a_page_says_what_its_commands_need(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    told = text[text.rindex("\n**To repeat**") :]
    assert "`pip install -e '.[bench]'`" in told
    own = {each.make.__module__ for each in measure.load(page.stem)}
    asked = {name for module in own for name in needs(module)}
    assert commands(page)
    assert {name for name in asked if f"`{name}`" not in told} == set()
