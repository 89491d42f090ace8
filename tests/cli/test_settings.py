"""`kcal.toml`, the noise of marks by one name, options by their old names, and short help."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from typer.main import get_command
from typer.testing import CliRunner, Result

from kcal import load_rig
from kcal.cli.main import app
from kcal.cli.settings import SETTINGS, defaults_of, read_settings, toml_text
from kcal.errors import FileError

ASSETS = Path(__file__).parents[2] / "assets"
EXAMPLE = {"board": "9x6", "square": "25mm", "camera": "camera:0", "origin": "1,2,3", "heading": 4.0,
           "pixel_sigma": 0.2, "require": "5km:10%", "baseline": 12.5}  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    shutil.copyfile(ASSETS / "sample-rig.json", "rig.json")
    shutil.copyfile(ASSETS / "sample-points.csv", "points.csv")
    return tmp_path


def kcal(*words: str) -> Result:
    return CliRunner().invoke(app, list(words))


def test_what_is_written_is_read(folder: Path) -> None:
    assert set(EXAMPLE) == set(SETTINGS)
    words = [word for key, value in EXAMPLE.items() for word in (f"--{key.replace('_', '-')}", str(value))]
    assert kcal("init", *words).exit_code == 0
    assert read_settings(folder) == EXAMPLE
    with pytest.raises(FileError, match="kcal init --force"):
        raise kcal("init").exception or AssertionError
    assert kcal("init", "--force").exit_code == 0
    assert read_settings(folder) == {}


def test_odd_texts_survive(folder: Path) -> None:
    odd = {"camera": 'C:\\"a"\n\t\x07é'}
    Path("kcal.toml").write_text(toml_text(odd), encoding="utf-8")
    assert read_settings(folder) == odd


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("bord = '9x6'", "unknown key 'bord'; did you mean board"),
        ("board = 9", 'board must be a text in quotation marks, for example board = "9x6"'),
        ("pixel_sigma = '0.1'", "pixel_sigma must be a number"),
        ("pixel_sigma = nan", "pixel_sigma must be a number"),
        ("baseline = true", "baseline must be a number"),
        ("board = ", "not TOML"),
        ("a = " + 5000 * "[", "not TOML"),
    ],
)
def test_what_is_not_understood_is_refused(text: str, message: str, folder: Path) -> None:
    Path("kcal.toml").write_text(text)
    with pytest.raises(FileError, match=r"kcal\.toml: ") as refused:
        raise kcal("budget").exception or AssertionError
    assert message in str(refused.value)


def test_every_setting_is_a_parameter_of_its_commands() -> None:
    group = get_command(app)
    for setting in SETTINGS.values():
        for words, parameter in setting.takers:
            command = group
            for word in words.split():
                command = command.commands[word]
            assert parameter in [each.name for each in command.params], (words, parameter)


def test_commands_take_what_is_not_typed_and_say_so(folder: Path) -> None:
    Path("kcal.toml").write_text(toml_text({"board": "9x6", "square": "25mm", "pixel_sigma": 0.25}))
    printed = kcal("board", "-o", "board.svg")
    assert "board.svg: 9x6 inner corners, 25 mm squares" in printed.stdout
    assert "from kcal.toml: board 9x6, square 25mm" in printed.stderr
    printed = kcal("board", "-o", "board.svg", "--board", "7x4")
    assert "board.svg: 7x4 inner corners, 25 mm squares" in printed.stdout
    assert "from kcal.toml: square 25mm\n" in printed.stderr
    assert "0.354 px" in kcal("budget").stdout
    assert defaults_of({"pixel_sigma": 0.25})["rig"]["check"] == {"pixel_sigma": 0.25}


def test_the_position_of_a_rig_goes_before_that_of_the_folder(folder: Path) -> None:
    plain = kcal("locate", "rig.json", "points.csv").stdout
    Path("kcal.toml").write_text(toml_text({"origin": "1,2,3", "heading": 4.0}))
    printed = kcal("locate", "rig.json", "points.csv")
    assert printed.stdout == plain
    assert "that in its file, not that in kcal.toml" in printed.stderr
    assert kcal("locate", "rig.json", "points.csv", "--origin", "1,2,3", "--heading", "4").stdout != plain


def test_the_noise_of_marks_is_that_of_the_rig(folder: Path) -> None:
    assert load_rig("rig.json").calibration.pixel_sigma == 0.1
    stated = kcal("locate", "rig.json", "points.csv")
    assert "noise of marks: 0.1 px, from the rig's file" in stated.stderr
    assert stated.stdout == kcal("locate", "rig.json", "points.csv", "--pixel-sigma", "0.1").stdout
    assert stated.stdout != kcal("locate", "rig.json", "points.csv", "--pixel-sigma", "0.3").stdout
    assert "noise of marks: 0.3 px, assumed; --pixel-sigma states it" in kcal("budget").stderr
    assert "noise of marks 0.1 px along each axis" in kcal("show", "rig.json").stdout


@pytest.mark.parametrize("words", [["calibrate"], ["rig", "solve"], ["locate"], ["live"]])
def test_help_is_short_and_help_all_is_whole(words: list[str]) -> None:
    command = get_command(app)
    for word in words:
        command = command.commands[word]
    names = {param.opts[0]: param.hidden for param in command.params if param.opts[0].startswith("-")}
    short, whole = kcal(*words, "--help").stdout, kcal(*words, "--help-all").stdout
    assert sum(not hidden for hidden in names.values()) <= 12
    assert "--help-all shows" in short
    for name, hidden in names.items():
        row = rf"│ +(\* +)?(--\w+ +)?{name[:18]}"
        assert bool(re.search(row, short)) != hidden, name
        assert re.search(row, whole), name
    assert kcal(*words, "--help").stdout == short


def test_help_all_of_a_short_command_is_its_help() -> None:
    assert kcal("show", "--help-all").stdout == kcal("show", "--help").stdout
