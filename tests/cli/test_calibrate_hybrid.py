"""`kcal calibrate --model hybrid`: evidence on the screen, the winner in the file, a picture of the field."""

from __future__ import annotations

import functools
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

import kcal.calibrate.lensfit.hybrid
from kcal.cli.main import app
from kcal.corners.board import Board
from kcal.corners.observations import Observations, View
from kcal.io.camera_file import CameraFile
from kcal.lens.camera import Camera
from kcal.lens.hybrid import HybridCamera
from kcal.lens.pose import rotation_from_vector
from kcal.lens.residual import FieldGrid, FieldResidual

SIZE = (640, 480)
BOARD = Board(columns=8, rows=6, square=0.04)


def observations(field: float) -> Observations:
    """Twenty views through a lens with a correction of that many pixels."""
    camera = Camera.build(focal=(500, 502), center=(322, 238), size=SIZE, coefficients=[-0.2, 0.05])
    grid = FieldGrid.covering((-0.65, -0.5), (0.65, 0.5), widths=[0.25])
    generator = torch.Generator().manual_seed(5)
    weights = field / 500 * torch.randn(2, grid.count, dtype=torch.float64, generator=generator)
    camera = HybridCamera.of(camera, FieldResidual(grid, weights))
    views: list[View] = []
    while len(views) < 20:
        draw = torch.rand(6, dtype=torch.float64, generator=generator) - 0.5
        depth = 0.6 + 0.3 * draw[3]
        turn = rotation_from_vector(1.2 * draw[:3])
        center = torch.stack([0.9 * depth * draw[4], 0.6 * depth * draw[5], depth])
        pixels, valid = camera.project((BOARD.points - BOARD.points.mean(0)) @ turn.T + center)
        if bool((valid & camera.inside(pixels)).all()):
            pixels = pixels + 0.05 * torch.randn(pixels.shape, dtype=torch.float64, generator=generator)
            views.append(View(name=f"{len(views):02d}.png", pixels=tuple((u, v) for u, v in pixels.tolist())))
    return Observations(board=BOARD, image_size=SIZE, views=tuple(views))


@pytest.fixture
def quick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder, and fewer models and units than the command's own."""
    models = ("opencv5", "opencv8")
    few = functools.partial(
        kcal.calibrate.lensfit.hybrid.HybridOptions, models=models, rivals=models, widths=(1.2, 0.6, 0.3)
    )
    monkeypatch.setattr(kcal.calibrate.lensfit.hybrid, "HybridOptions", few)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    return tmp_path


def test_a_hybrid_is_written_with_its_pictures(quick: Path) -> None:
    observations(1.0).save(quick / "left.obs.json")
    arguments = ["left.obs.json", "-o", "left.camera.json", "--model", "hybrid", "--groups", "views"]
    outcome = CliRunner().invoke(app, ["calibrate", *arguments, "--picture", "left.png"])
    assert outcome.exit_code == 0, outcome.output
    assert "better than" in outcome.output
    assert outcome.output.index("hybrid  ") < outcome.output.index("opencv5  ")  # the table is sorted
    file = CameraFile.load(quick / "left.camera.json")
    assert isinstance(file.camera(), HybridCamera)
    assert file.standard_deviations is not None
    assert file.standard_deviations["fx"] is not None
    assert file.standard_deviations["fx"] > 0
    assert (quick / "left.png").stat().st_size > 10_000
    assert (quick / "left.field.png").stat().st_size > 10_000


def test_a_parametric_camera_is_written_where_it_is_no_worse(quick: Path) -> None:
    observations(0.0).save(quick / "left.obs.json")
    outcome = CliRunner().invoke(app, ["calibrate", "left.obs.json", "-o", "left.camera.json", "--model", "hybrid"])
    assert outcome.exit_code == 0, outcome.output
    assert "no better than" in outcome.output
    assert type(CameraFile.load(quick / "left.camera.json").camera()) is Camera


@pytest.mark.parametrize("extra", [["--fix", "k3"], ["--loss", "huber"], ["--reject"], ["--groups", "fish"]])
def test_options_that_do_not_go_with_it(quick: Path, extra: list[str]) -> None:
    observations(0.0).save(quick / "left.obs.json")
    arguments = ["calibrate", "left.obs.json", "-o", "left.camera.json", "--model", "hybrid", *extra]
    outcome = CliRunner().invoke(app, arguments)
    assert outcome.exit_code != 0
    assert not (quick / "left.camera.json").exists()
    assert extra[0] in str(outcome.exception)
