"""Pictures that commands write: PNG, SVG or PDF by their suffix, and nothing else."""

import math
from pathlib import Path

import pytest
import torch
import typer.main
from command_line import Command
from typer.core import TyperGroup

from kcal.calibrate.camera.at_setting import ComparisonResult
from kcal.cli.main import app
from kcal.report.calibration import models_figure
from kcal.report.figures import new_figure, save_picture

# What a command needs before it looks at its options.
_FILES = {"towers.csv": "name,lat,lon,height\nmill,1.5,2,9\n"}
_REQUIRED = {"sites": "towers.csv --area 1,2,3,4 --ground 0"}
_PICTURES = {"picture", "skyline_picture", "gallery", "coverage"}


def picture_options() -> list[tuple[str, str]]:
    """Command and flag of every picture that a command writes."""
    found, open_groups = [], [("", typer.main.get_command(app))]
    while open_groups:
        name, command = open_groups.pop()
        if isinstance(command, TyperGroup):
            open_groups += [(f"{name} {word}".strip(), one) for word, one in command.commands.items()]
        else:
            found += [(name, param.opts[0]) for param in command.params if param.name in _PICTURES]
    return sorted(found)


def test_commands_that_draw() -> None:
    names = {name.removesuffix(" solve") for name, _ in picture_options()}
    assert names == {
        "board measure", "budget", "calibrate", "check", "compare", "detect", "diff", "export", "locate", "rig",
        "sites", "stars", "station", "watch",
    }  # fmt: skip


@pytest.mark.parametrize(("name", "flag"), [pair for pair in picture_options() if pair[0] != "calibrate"])
@pytest.mark.parametrize("file", ["a.jpg", "a", "no/a.pdf"])
def test_a_name_that_no_picture_can_have_is_refused_first(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, flag: str, file: str
) -> None:
    """Before anything is computed, whatever else is missing."""
    monkeypatch.chdir(tmp_path)
    for path, text in _FILES.items():
        Path(path).write_text(text)
    said = command(f"{name} {_REQUIRED.get(name, '')} {flag} {file}", code=1).err
    assert ("the folder no does not exist" if "/" in file else f"{file}: the name of a picture must end with") in said


@pytest.mark.parametrize(("suffix", "start"), [("png", b"\x89PNG\r\n"), ("svg", b"<?xml"), ("PDF", b"%PDF-")])
def test_the_suffix_says_the_format(tmp_path: Path, suffix: str, start: bytes) -> None:
    def drawn() -> bytes:
        figure = new_figure(2.0, 1.0)
        figure.text(0.1, 0.5, "σ 山 $a$")
        return save_picture(tmp_path / f"a.{suffix}", figure).read_bytes()

    once = drawn()
    assert once.startswith(start)
    assert drawn() == once


class TestCompare:
    COSTS = torch.tensor([[4.0, 1.0, 4.0], [4.0, 2.0, 5.0], [math.inf] * 3], dtype=torch.float64)
    RESULT = ComparisonResult(
        models=("b", "a", "none"), costs=COSTS, corners=torch.tensor([100, 50, 50]), failures={"none": "no start"}
    )

    def test_the_best_is_first(self) -> None:
        axes = models_figure(self.RESULT, "left").axes[0]
        assert [text.get_text() for text in axes.get_yticklabels()] == ["b", "a"]
        assert [float(at) for at in axes.lines[1].get_xdata()] == pytest.approx(list(self.RESULT.rms.values())[:2])
        bars = axes.collections[0].get_segments()  # type: ignore[attr-defined]
        error = self.RESULT.difference("a", "b")[1]
        assert [float(bar[1, 0] - bar[0, 0]) for bar in bars] == pytest.approx([0.0, 2 * error])
