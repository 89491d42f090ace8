"""What `kcal calibrate` says to people: focal lengths on the axis, and errors that end with the command to run."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest
import torch
from calibrate_scenes import camera, motions, observe, pixels_of
from typer.testing import CliRunner

from kcal.calibrate.camera.calibrate import calibrate_camera
from kcal.cli.console import more_views
from kcal.cli.main import app
from kcal.corners.board import Board
from kcal.errors import DegenerateError
from kcal.io.camera_file import load_camera
from kcal.lens.uncertainty import paraxial_focal

RUNNER = CliRunner()


def write(path: Path, count: int, seed: int = 1) -> Path:
    truth = camera("opencv4")
    observe(pixels_of(truth, motions(truth, count, seed), noise=0.1, seed=seed)).save(path)
    return path


def test_too_few_views_end_with_the_command_that_adds_some(tmp_path: Path) -> None:
    path = write(tmp_path / "my left.obs.json", 2)
    result = RUNNER.invoke(app, ["calibrate", str(path), "-o", str(tmp_path / "left.camera.json")])
    assert isinstance(result.exception, DegenerateError)
    text = str(result.exception)
    assert text.startswith("2 view(s) of the board: at least 3")
    command = shlex.split(text.split("To add views: ")[1])
    assert command[:2] == ["kcal", "capture"]
    options = dict(zip(command[3::2], command[4::2], strict=True))
    assert options == {"--board": "7x6", "--square": "50mm", "-o": str(path)}
    assert not (tmp_path / "left.camera.json").exists()


def test_the_command_names_the_same_board() -> None:
    sizes = ["9x6", "charuco:9x6:5x5_100:15mm", "charuco:9x6:5x5_100:15mm:id3", "circles:7x6", "circles:7x6:10mm"]
    for size in (*sizes, "asymmetric:4x11", "aprilgrid:6x6:0.3", "aprilgrid:6x5:2mm:id7"):
        board = Board.parse(size, "24.23mm")
        words = shlex.split(more_views(board, Path("a.obs.json")))
        assert Board.parse(words[words.index("--board") + 1], words[words.index("--square") + 1]) == board


def test_one_of_several_cameras(tmp_path: Path) -> None:
    paths = [write(tmp_path / "a.obs.json", 8), write(tmp_path / "b.obs.json", 2)]
    result = RUNNER.invoke(app, ["calibrate", *map(str, paths), "-o", str(tmp_path / "out")])
    assert "1 of 2 cameras failed: b" in str(result.exception)
    assert f"To add views: kcal capture camera:0 --board 7x6 --square 50mm -o {paths[1]}" in result.output.replace(
        "\n", ""
    )
    assert (tmp_path / "out" / "a.camera.json").exists()


def test_focal_lengths_are_those_on_the_axis(tmp_path: Path) -> None:
    """Printed by calibrate, show and diff alike, and told to programs; fx of the file is another number."""
    path, file = write(tmp_path / "a.obs.json", 8), tmp_path / "a.camera.json"
    told = json.loads(RUNNER.invoke(app, ["calibrate", str(path), "-o", str(file), "--json"]).stdout)
    saved = load_camera(file)
    found = paraxial_focal(saved)
    assert any(f"focal length {found}; principal point" in line for line in told["text"])
    assert abs(found.mean[0] - float(saved.focal[0])) > 0.1
    assert f"focal length {found}, on its axis; fx and fy below" in RUNNER.invoke(app, ["show", str(file)]).output
    assert RUNNER.invoke(app, ["diff", str(file), str(file)]).output.count(f"focal length {found}") == 2
    numbers = told["cameras"]["a"]
    assert numbers["focal_px"] == pytest.approx(found.value.tolist())
    assert numbers["focal_sigma_px"] == pytest.approx(found.sigma.tolist(), rel=1e-6)


def test_parametric_lenses_show_their_parameter(tmp_path: Path) -> None:
    path, file = write(tmp_path / "a.obs.json", 8), tmp_path / "a.camera.json"
    RUNNER.invoke(app, ["calibrate", str(path), "-o", str(file), "--model", "opencv4"])
    fx, fy = load_camera(file).focal.tolist()
    text = RUNNER.invoke(app, ["show", str(file)]).output
    match = re.search(r"focal length ([\d.]+) ± [\d.]+ px along rows, ([\d.]+) ± [\d.]+ px along columns\n", text)
    assert match is not None
    # Rounded to two digits of sigma.
    assert [float(value) for value in match.groups()] == pytest.approx([fx, fy], abs=1e-2)


def test_the_library_names_no_command() -> None:
    with pytest.raises(DegenerateError) as caught:
        calibrate_camera(observe(torch.zeros(2, 42, 2).double() + torch.rand(2, 42, 2).double() * 100))
    assert "kcal capture" not in str(caught.value)
