"""Examples of the pages: Python blocks run and pass a strict type check, commands are accepted by the command line."""

import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from calibrate_scenes import motions, observe, pixels_of
from typer.main import get_command

from kcal import Camera, Observations, load_rig, save_camera
from kcal.cli.main import app
from kcal.cli.options import SETTINGS, defaults_of

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(language: str) -> list[Any]:
    """Fenced blocks of all pages, each with the page and the line where it begins."""
    found = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for match in re.finditer(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
            line = text[: match.start()].count("\n") + 2
            found.append(pytest.param(match[1], id=f"{page.relative_to(ROOT)}:{line}"))
    return found


PYTHON = blocks("python")
# What `mypy --strict` asks of the file that it checks, as settings of these files alone.
STRICT = """
[[tool.mypy.overrides]]
module = ["examples.*"]
disallow_any_generics = true
disallow_incomplete_defs = true
disallow_subclassing_any = true
disallow_untyped_calls = true
disallow_untyped_decorators = true
implicit_reexport = false
strict_equality = true
extra_checks = true
warn_return_any = true
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that the pages' examples read, from the sample rig and from simulated corners."""
    folder = tmp_path_factory.mktemp("examples")
    shutil.copyfile(ROOT / "assets" / "sample-rig.json", folder / "rig.json")
    shutil.copyfile(ROOT / "assets" / "sample-points.csv", folder / "points.csv")
    rig = load_rig(folder / "rig.json")
    for side, camera in (("left", rig.left), ("right", rig.right)):
        save_camera(camera, folder / f"{side}.camera.json", name=side)
        _observations(side).save(folder / f"{side}.obs.json")
    return folder


def _observations(side: str) -> Observations:
    camera = Camera.build(focal=(800, 800), center=(322, 238), size=(640, 480), coefficients=[-0.1, 0.02])
    return observe(pixels_of(camera, motions(camera, 5, 4), noise=0.05, seed=len(side)), names="01234")


@pytest.mark.slow
@pytest.mark.parametrize("source", PYTHON)
def test_python_runs(source: str, files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(files)
    exec(compile(source, "page", "exec"), {})


@pytest.mark.slow
def test_python_passes_a_strict_type_check(tmp_path: Path) -> None:
    package = tmp_path / "examples"
    package.mkdir()
    (package / "__init__.py").write_text("", encoding="utf-8")
    for number, block in enumerate(PYTHON):
        (package / f"example_{number}.py").write_text(f"# {block.id}\n{block.values[0]}", encoding="utf-8")
    # kcal keeps its own settings, so that what mypy has stored of it and of its dependencies is used again.
    settings = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    (tmp_path / "pyproject.toml").write_text(settings + STRICT, encoding="utf-8")
    command = [sys.executable, "-m", "mypy", "--config-file", str(tmp_path / "pyproject.toml"), str(package)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def resolve(words: list[str]) -> tuple[Any, list[str]]:
    """The command that a line calls, and its arguments; the first command of a group runs where none is named."""
    command, rest = get_command(app), list(words)
    while hasattr(command, "commands"):
        named = bool(rest) and rest[0] in command.commands
        assert named or command.name != "kcal", f"no command {rest[:1]}"
        command = command.commands[rest.pop(0)] if named else next(iter(command.commands.values()))
    return command, rest


def commands() -> Iterator[Any]:
    """Lines of the pages' shell blocks that call kcal, with what a `kcal init` before them on the page wrote."""
    page, settings = "", {}
    for block in blocks("sh"):
        if (here := str(block.id).partition(":")[0]) != page:
            page, settings = here, {}
        for line in block.values[0].replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words[:1] == ["kcal"]:
                if words[1] == "init":
                    context = resolve(words[1:])[0].make_context("init", words[2:])
                    settings = {key: context.params[key] for key in SETTINGS if context.params[key] is not None}
                yield pytest.param(words[1:], settings, id=f"{block.id}:{' '.join(words[1:3])}")


@pytest.mark.parametrize(("words", "settings"), list(commands()))
def test_a_command_is_accepted(words: list[str], settings: dict[str, Any]) -> None:
    command, arguments = resolve(words)
    defaults = defaults_of(settings, get_command(app)).get(words[0], {})
    # Parses all options and values, and runs nothing.
    command.make_context(command.name, arguments, default_map=defaults.get(command.name, defaults))


@pytest.mark.parametrize("page", PAGES, ids=[str(page.relative_to(ROOT)) for page in PAGES])
def test_commands_in_the_text_exist(page: Path) -> None:
    # What 1.0 had stands first in the rows of the table of changes.
    text = re.sub(r"^\| `.*?` \|", "|", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    for span in re.findall(r"`kcal ([a-z][^`]*)`", text.replace("\n", " ")):
        command, arguments = resolve(span.split())
        known = {name for option in command.params for name in option.opts} | {"--help"}
        assert [word for word in arguments if word.startswith("-") and word.split("=")[0] not in known] == [], span


def test_planted_mistakes_are_seen() -> None:
    with pytest.raises(AssertionError):
        resolve(["none"])
    command, arguments = resolve(["rig", "a.json", "b.json", "--none", "-o", "rig.json"])
    assert command.name == "solve"
    with pytest.raises(Exception, match="--none"):
        command.make_context(command.name, arguments)
