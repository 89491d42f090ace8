"""Commands from plain functions: options, their help, files and values, and options of several words.

What commands take of the rooms: each name stands in the stub, which has no others, and is found where it says.
"""

import ast
import dataclasses
import json
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from kcal.cli import kinds, rooms
from kcal.cli.options import Command, Kind, Only, Rare, Several, declared
from kcal.doors import named_modules
from kcal.errors import FileError, InputError
from kcal.locate.marks import is_long
from kcal.values import (
    WithSigma,
    distance,
    instant,
    length,
    named,
    number_list,
    place_on_earth,
    ranges_and_errors,
    size,
    with_sigma,
)

app = typer.Typer()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Shared:
    """Options of two commands.

    Args:
        limit: Largest turn.
        hidden: Not for the command line.
        stars: Night images.
    """

    limit: kinds.Degrees = 0.5
    hidden: int = 7
    stars: Several[str] | None = None


def show(
    first: str,
    second: kinds.RigFile | None = None,
    *,
    shared: kinds.Annotated[Shared, Only(("limit", "stars"))],
    heading: kinds.MeasuredDegrees = WithSigma(1.0, 0.5),
    site: Rare[kinds.Annotated[kinds.Place, Kind(of="keep")] | None] = None,
    keep: bool = False,
    pixel_sigma: kinds.PixelSigma | None = None,
) -> None:
    """Show what was given [all of it].

    Args:
        first: Any word,
            of two lines.
        second: A rig file.
        heading: With its σ [not grid north].
        site: Where it stands.
        keep: Keep it.
    """
    values = (first, second, shared.limit, shared.hidden, shared.stars, heading, site, keep)
    print(json.dumps(list(map(str, values))))


app.command("show", cls=Command)(declared(show))
app.command("other")(declared(lambda: None))


def run(*words: str, code: int = 0) -> list[str]:
    result = CliRunner().invoke(app, ["show", *words], catch_exceptions=code == 2)
    assert result.exit_code == code, result.output
    return list(json.loads(result.stdout)) if code == 0 else [result.output]


def test_values_and_defaults() -> None:
    assert run("a") == ["a", "None", "0.5", "7", "None", "1±0.5", "None", "False"]
    words = ("a", "--limit", "2", "--heading", "35+-0.01", "--site", "1,2,3±4", "--keep")
    *_, limit, _, _, heading, site, keep = run(*words)
    assert (limit, heading, keep) == ("2.0", "35±0.01", "True")
    assert site == "KnownPlace(origin=Origin(lat=1.0, lon=2.0, height=3.0), sigma=4.0)"


@pytest.mark.parametrize(
    ("words", "first", "stars"),
    [
        ("a --stars x y z", "a", "['x', 'y', 'z']"),
        ("--stars x y a", "a", "['x', 'y']"),
        ("--stars x -- a", "a", "['x']"),
        ("--stars x --stars y a --keep", "a", "['x', 'y']"),
        ("--stars=x a", "a", "['x']"),
        ("--limit -2 a --stars x --heading -3", "a", "['x']"),
    ],
)
def test_an_option_of_several_words_ends_at_the_next_option(words: str, first: str, stars: str) -> None:
    found = run(*words.split())
    assert (found[0], found[4]) == (first, stars)


def test_wrong_words_are_wrong_usage_and_wrong_values_are_not() -> None:
    assert "write VALUE±SIGMA" in run("a", "--heading", "east", code=2)[0]
    # It passes every comparison with a limit, and would make all of a result NaN.
    with pytest.raises(InputError, match="--limit: a number is needed, not nan"):
        run("a", "--limit", "nan")
    with pytest.raises(InputError, match="--site '1,2': write three numbers"):
        run("a", "--site", "1,2")
    with pytest.raises(FileError, match=r"none\.json: cannot read"):
        run("a", "none.json")


def test_an_option_that_does_nothing_is_said() -> None:
    for words, said in ((["--keep"], ""), ([], "warning: --site does nothing without --keep\n")):
        assert CliRunner().invoke(app, ["show", "a", "--site", "1,2,3", *words]).stderr == said


def test_a_file_is_checked_before_values_are_read(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text("{}")
    with pytest.raises(FileError, match="a kcal rig file is needed here"):
        run("a", str(tmp_path / "x.json"), "--site", "1,2")


def test_help_is_from_docstrings() -> None:
    result = CliRunner().invoke(app, ["show", "--help"], env={"COLUMNS": "150", "NO_COLOR": "1"})
    for text in ("Any word, of two lines.", "DEG±SIGMA", "With its σ [not grid north].", "Largest turn.", "1±0.5"):
        assert text in result.stdout
    assert "Noise of marks along each axis" in result.stdout
    for text in ("--site", "--hidden", "--no-keep", "Args:"):
        assert text not in result.stdout
    assert "Where it stands." in CliRunner().invoke(app, ["show", "--help-all"]).stdout


@pytest.mark.parametrize(
    ("read", "text"),
    [
        (with_sigma, "12±-1"), (with_sigma, "1±2±3"), (with_sigma, ""), (number_list, "1,x"),
        (number_list, ""), (length, "25"), (length, "0mm"), (length, "1e400mm"), (distance, "-5"), (distance, "5miles"),
        (size, "0x5"), (size, "12"), (place_on_earth, "1,2,3±x"), (place_on_earth, "1,2"), (instant, "noon"),
        (instant, "2026-01-01T00:00:00"), (ranges_and_errors, "5km"), (ranges_and_errors, "5km:0%"),
        (ranges_and_errors, "1..2km:1%"),
    ],
)  # fmt: skip
def test_a_text_that_cannot_be_read_says_what_to_write(read: object, text: str) -> None:
    assert callable(read)
    with pytest.raises(InputError, match=r"^--x .*(write|end it with)"):
        read(text, "--x")


def test_a_name_and_its_value() -> None:
    assert named(" fx = 1600 ", "--fix", "NAME=VALUE") == ("fx", "1600")
    with pytest.raises(InputError, match="--fix 'fx': write NAME=VALUE"):
        named("fx", "--fix", "NAME=VALUE")


def test_the_stub_has_what_commands_use_and_nothing_else() -> None:
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in Path(rooms.__file__).parent.glob("*.py")]
    parts = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Attribute)]
    used = {part.attr for part in parts if isinstance(part.value, ast.Name) and part.value.id == "rooms"}
    assert used == set(named_modules(rooms.__file__))


def test_a_name_is_what_its_module_defines() -> None:
    assert rooms.is_long is is_long
    with pytest.raises(AttributeError, match="no attribute 'is_short'"):
        _ = rooms.is_short  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("name", "library", "extra"),
    [("Videos", "av", "video"), ("sender_to", "starlette", "mark"), ("LocalServer", "uvicorn", "mark")],
)
def test_a_library_that_is_missing_is_named_with_its_extra(
    name: str, library: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for loaded in [one for one in sys.modules if one.partition(".")[0] == library]:
        monkeypatch.setitem(sys.modules, loaded, None)
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(sys.modules, named_modules(rooms.__file__)[name], raising=False)
    with pytest.raises(InputError, match=rf"this needs {library}\S*; install it with: pip install 'kcal\[{extra}\]'"):
        getattr(rooms, name)
