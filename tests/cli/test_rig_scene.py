"""`kcal rig --scene`: a rig from images and a tape; without a length it is refused."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from kcal.cli.main import app
from kcal.io.camera_file import save_camera
from kcal.io.images import write_png
from kcal.io.rig_file import load_rig
from tests.helpers.scene_pairs import pair, small_rig


@pytest.fixture
def given(tmp_path: Path) -> list[str]:
    rig, images = small_rig(), pair(1)
    names = []
    for side in ("left", "right"):
        save_camera(getattr(rig, side), tmp_path / f"{side}.camera.json")
        write_png(tmp_path / f"{side}.png", getattr(images, side))
        names.append(str(tmp_path / side))
    cameras = [f"{name}.camera.json" for name in names]
    return ["rig", *cameras, "--scene", *(f"{name}.png" for name in names), "-o", str(tmp_path / "rig.json")]


def test_a_rig_from_images_and_a_tape(given: list[str], tmp_path: Path) -> None:
    length = float(small_rig().baseline)
    result = CliRunner().invoke(app, [*given, "--baseline", f"{length:.4f}+-0.002"])
    assert result.exit_code == 0, result.output
    assert "off the line" in result.output
    assert "one pair: what moves cannot be told" in result.output
    assert float(load_rig(tmp_path / "rig.json").baseline) == pytest.approx(length, abs=0.002)


def test_without_a_length_it_is_refused(given: list[str], tmp_path: Path) -> None:
    result = CliRunner().invoke(app, given)
    assert result.exit_code == 1
    assert "leaves the scale open" in str(result.exception)
    assert not (tmp_path / "rig.json").exists()
