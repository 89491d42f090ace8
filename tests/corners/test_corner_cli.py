import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from board_render import homography, render
from typer.testing import CliRunner

from kcal.cli.main import app
from kcal.corners.board import Board
from kcal.corners.observations import Observations
from kcal.errors import FileError, InputError

SMALL = Board(columns=6, rows=5, square=0.02)
OPTIONS = ["--board", "6x5", "--square", "20mm", "-o"]


def kcal(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture
def shots(tmp_path):
    folder = tmp_path / "shots"
    folder.mkdir()
    for k in range(2):
        H = homography(SMALL, (240, 200), 22, (0.1 * k, 0.05), 0.1)
        cv2.imwrite(f"{folder}/shot{k}.png", render(SMALL, (240, 200), H, seed=k, supersample=2)[0])
    return folder


def test_all_real_images_are_found(tmp_path):
    data = os.environ.get("KCAL_DATA")
    if not data:
        pytest.skip("KCAL_DATA is not set: no real images")
    for side in ("left", "right"):
        output = tmp_path / f"{side}.obs.json"
        images = Path(data, "opencv_stereo", f"{side}*.jpg")
        result = kcal("detect", images, "--board", "9x6", "--square", "25mm", "-o", output)
        assert result.exit_code == 0
        assert "board found in 13 of 13 images of 640x480 px" in result.output
        seen = Observations.load(output)
        assert len(seen.views) == 13
        assert seen.failures == ()
        assert seen.board == Board(columns=9, rows=6, square=0.025)
        assert seen.names[0] == f"{side}01.jpg"


def test_failures_are_listed_on_screen_and_in_the_file(shots, tmp_path):
    (shots / "bad.jpg").write_bytes(cv2.imencode(".jpg", cv2.imread(f"{shots}/shot0.png", 0))[1].tobytes()[:1500])
    output = tmp_path / "x.obs.json"
    result = kcal("detect", shots, *OPTIONS, output)
    assert result.exit_code == 0
    assert "board found in 2 of 3 images" in result.output
    assert "failed bad.jpg: the image is truncated or corrupt" in result.output
    assert [failure.name for failure in Observations.load(output).failures] == ["bad.jpg"]


def test_sixteen_bit_images(shots, tmp_path):
    for path in shots.iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path), 0).astype(np.uint16) * 257)
    output = tmp_path / "x.obs.json"
    assert kcal("detect", shots, *OPTIONS, output).exit_code == 0
    assert len(Observations.load(output).views) == 2


@pytest.mark.parametrize("method", ["saddle", "opencv", "skimage", "none"])
def test_refine_is_recorded(shots, tmp_path, method):
    output = tmp_path / "x.obs.json"
    assert kcal("detect", shots / "shot0.png", *OPTIONS, output, "--refine", method).exit_code == 0
    assert Observations.load(output).refinement == method


def refused(error, match, *arguments):
    result = kcal(*arguments)
    assert result.exit_code == 1
    assert isinstance(result.exception, error)
    message = str(result.exception)
    assert "\n" not in message
    assert match in message


def test_what_cannot_be_done_leaves_no_file(shots, tmp_path):
    output = tmp_path / "x.obs.json"
    empty = tmp_path / "empty"
    empty.mkdir()
    refused(FileError, "no image in this folder", "detect", empty, *OPTIONS, output)
    refused(FileError, "no file matches", "detect", shots / "*.jpg", *OPTIONS, output)
    refused(FileError, "no such file", "detect", shots / "shot9.png", *OPTIONS, output)
    larger = ["--board", "9x8", "--square", "20mm", "-o", output]
    refused(InputError, "no board in any of 2 images", "detect", shots, *larger)
    refused(InputError, "with its unit", "detect", shots, "--board", "6x5", "--square", "20", "-o", output)
    refused(InputError, "COLUMNSxROWS", "detect", shots, "--board", "6", "--square", "20mm", "-o", output)
    for name in ("wide", "wider"):
        cv2.imwrite(f"{shots}/{name}.png", np.random.default_rng(0).integers(0, 255, (100, 300), dtype=np.uint8))
    counts = "2 of 240x200 px (shot0.png, shot1.png); 2 of 300x100 px (wide.png, wider.png)"
    refused(InputError, counts, "detect", shots, *OPTIONS, output)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "shots"]


def test_output_is_checked_before_the_work(shots, tmp_path, monkeypatch):
    monkeypatch.setattr("kcal.corners.detect.detect", lambda *_, **__: pytest.fail("work was begun"))
    refused(FileError, "does not exist", "detect", shots, *OPTIONS, tmp_path / "none" / "x.obs.json")
    refused(FileError, "is a folder", "detect", shots, *OPTIONS, tmp_path)


def test_old_file_survives_a_failure(shots, tmp_path):
    output = tmp_path / "x.obs.json"
    output.write_text("old")
    refused(InputError, "no board", "detect", shots, "--board", "9x8", "--square", "20mm", "-o", output)
    assert output.read_text() == "old"


def test_board_command(tmp_path):
    for suffix, begin in ((".svg", b"<?xml"), (".pdf", b"%PDF-1.4")):
        output = tmp_path / f"board{suffix}"
        result = kcal("board", "--board", "9x6", "--square", "25mm", "--page", "A4", "-o", output)
        assert result.exit_code == 0
        assert "9x6 inner corners, 25 mm squares, page 297x210 mm" in result.output
        assert output.read_bytes().startswith(begin)


def test_board_command_refuses(tmp_path):
    common = ["board", "--board", "9x6", "--square"]
    refused(InputError, "A2 would do", *common, "40mm", "--page", "A4", "-o", tmp_path / "b.pdf")
    refused(InputError, ".svg or .pdf", *common, "25mm", "-o", tmp_path / "b.png")
    refused(FileError, "does not exist", *common, "25mm", "-o", tmp_path / "none" / "b.pdf")
    assert list(tmp_path.iterdir()) == []


def test_shipped_boards_are_what_the_command_draws(tmp_path):
    shipped = Path(__file__).parents[2] / "assets" / "boards"
    for size, square, page in (("9x6", "25mm", "A4"), ("7x6", "50mm", "A2")):
        for suffix in (".svg", ".pdf"):
            output = tmp_path / f"board_{size}_{square}_{page}{suffix}"
            assert kcal("board", "--board", size, "--square", square, "--page", page, "-o", output).exit_code == 0
            assert output.read_bytes() == (shipped / output.name).read_bytes()
