"""`kcal board`: printing is the default, measuring a command of its own."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from calibrate_scenes import observe
from click.testing import Result
from printed_boards import printed_points, printed_views
from typer.testing import CliRunner

from kcal.calibrate.hybrid.measured_board import load_measured_board
from kcal.cli.main import app
from kcal.corners.board import Board
from kcal.errors import FileError
from kcal.lens.camera import Camera

BOARD = Board(columns=8, rows=6, square=0.03)
SIZE = (1280, 960)


def kcal(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def capture(folder: Path, name: str, points: torch.Tensor, seed: int) -> Path:
    camera = Camera.build(focal=(800, 800), center=(645, 476), size=SIZE, coefficients=[-0.12, 0.03], model="opencv5")
    pixels = printed_views(camera, BOARD, points, 8, seed, noise=0.1)
    return observe(pixels, board=BOARD, size=SIZE).save(folder / f"{name}.obs.json")


def test_one_board(tmp_path: Path) -> None:
    points = printed_points(BOARD, 3)
    output, picture = tmp_path / "plate.board.json", tmp_path / "plate.png"
    files = [capture(tmp_path, name, points, seed) for name, seed in (("left", 1), ("right", 2))]
    result = kcal("board", "measure", *files, "-o", output, "--picture", picture)
    assert result.exit_code == 0
    board = load_measured_board(output)
    assert (board.name, board.observations) == ("plate", ("left", "right"))
    assert f"bending {1e3 * board.bending.value:.3f} ± {1e3 * board.bending.sigma:.3f} mm" in result.output
    assert "2 of 2 observations: left, right" in result.output
    assert "evidence that they saw one board" in result.output
    assert picture.read_bytes()[:4] == b"\x89PNG"


def test_two_boards(tmp_path: Path) -> None:
    files = [capture(tmp_path, name, printed_points(BOARD, seed), seed) for name, seed in (("left", 3), ("right", 4))]
    result = kcal("board", "measure", *files, "-o", tmp_path / "plate.board.json")
    assert result.exit_code == 0
    assert "these observations show 2 boards" in result.output
    assert load_measured_board(tmp_path / "plate.board.json").observations == ("left",)


def test_refusals(tmp_path: Path) -> None:
    for arguments, message in (
        (["none.obs.json", "-o", tmp_path / "x.board.json"], "cannot read"),
        ([tmp_path / "a.obs.json", "-o", tmp_path / "none" / "x.board.json"], "does not exist"),
    ):
        result = kcal("board", "measure", *arguments)
        assert isinstance(result.exception, FileError)
        assert message in str(result.exception)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", [["board"], ["board", "print"]])
def test_printing_is_the_default(tmp_path: Path, command: list[str]) -> None:
    output = tmp_path / "board.svg"
    assert kcal(*command, "--board", "9x6", "--square", "25mm", "-o", output).exit_code == 0
    assert output.read_bytes().startswith(b"<?xml")
