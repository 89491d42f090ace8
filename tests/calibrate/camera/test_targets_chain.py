"""From rendered photographs of each kind of board to a camera: it is the true one within its error bars."""

import cv2
import pytest
import torch
from typer.testing import CliRunner

from kcal.calibrate.camera.advice import possible_views
from kcal.cli.main import app
from kcal.corners.board import Board
from kcal.corners.marker_boards import _opencv_board
from kcal.corners.observations import Observations
from kcal.io.camera_file import load_camera
from kcal.lens.camera import Camera
from kcal.lens.difference import camera_difference
from kcal.lens.uncertainty import paraxial_focal
from scripts.shared.printed_board import Paper, pose

CAMERA = Camera.build(focal=(430, 430), center=(243, 177), size=(480, 360), coefficients=[-0.1, 0.02])
TILTS = (
    [0.5, 0.0, 0.0], [-0.5, 0.0, 0.1], [0.0, 0.5, 1.5], [0.0, -0.5, -0.1],
    [0.35, 0.35, 0.8], [-0.35, 0.35, 0.0], [0.1, 0.1, 1.6], [0.35, -0.35, 3.0],
)  # fmt: skip
KALIBR = "target_type: 'aprilgrid'\ntagCols: 4\ntagRows: 3\ntagSize: 0.035\ntagSpacing: 0.3\n"


def photographs(folder, paper, distance, shift):
    for i, tilt in enumerate(TILTS):
        place = (shift * (1, -1)[i % 2], shift * (1, -1)[i // 2 % 2])
        image, _ = paper.shoot(
            CAMERA, *pose(paper.board, tilt, distance * (1.15 if i % 3 else 1.0), place), seed=i, supersample=3
        )
        cv2.imwrite(f"{folder}/{i}.png", image)


def run(*arguments):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "square", "distance", "shift"),
    [
        ("april.yaml", None, 0.33, 0.02),
        ("asymmetric:4x11", "20mm", 0.42, 0.008),
        ("circles:8x6:11mm", "22mm", 0.31, 0.008),
    ],
)
def test_calibration(tmp_path, text, square, distance, shift):
    if square is None:
        (tmp_path / text).write_text(KALIBR)
        text = str(tmp_path / text)
    what = ["--board", text, *(["--square", square] if square else [])]
    board = Board.parse(text, square)
    photographs(tmp_path, Paper(board, 0.25), distance, shift)
    seen, file = tmp_path / "a.obs.json", tmp_path / "a.camera.json"
    told = run("detect", tmp_path / "*.png", *what, "-o", seen, "--gallery", tmp_path / "gallery.png")
    width, height = (1000 * side for side in board.extent)
    assert "board found in 8 of 8 images" in told
    assert f"{width:g} x {height:g} mm" in " ".join(told.split())
    assert ("looks the same turned by 180°" in told) == (board.pattern == "circles")
    observations = Observations.load(seen)
    assert observations.board == board
    told = run("calibrate", seen, "-o", file)
    assert f"{width:g} x {height:g} mm" in " ".join(told.split())
    camera = load_camera(file)
    assert camera.calibration.record.board == board.record
    assert str(board.record) in " ".join(run("show", file).split())
    difference = camera_difference(camera, CAMERA)
    # Error bars that hold: chance makes larger differences in more than 1 of 100 cases.
    assert difference.probability > 0.01
    focal = paraxial_focal(camera)
    assert float((focal.value - 430).abs().max()) < 3 * float(focal.sigma.max())
    assert float(focal.sigma.max()) < 0.005 * 430
    # What follows from a board is there for each kind.
    assert len(possible_views(camera, board).words) > 50


def test_old_charuco_boards_calibrate(tmp_path):
    """The old numbering, as OpenCV drew it; views that show a part only."""
    board = Board.parse("charuco:8x5", "25mm")
    paper = Paper(board, 0.25)
    cells = round(25 / 0.25)
    size = ((board.columns + 1) * cells, (board.rows + 1) * cells)
    drawn = torch.from_numpy(_opencv_board(board, True).generateImage(size)) / 255.0
    left, top = (round(float(side) / 0.25) - cells for side in paper.origin)
    paper.light[top : top + size[1], left : left + size[0]] = drawn.numpy()
    photographs(tmp_path, paper, 0.26, 0.04)
    seen, file = tmp_path / "a.obs.json", tmp_path / "a.camera.json"
    run("detect", tmp_path / "*.png", "--board", "charuco:8x5", "--square", "25mm", "-o", seen)
    assert any(None in view.pixels for view in Observations.load(seen).views)
    run("calibrate", seen, "-o", file)
    assert camera_difference(load_camera(file), CAMERA).probability > 0.01


def test_two_boards_are_detected_one_after_the_other(tmp_path):
    from scripts.shared.printed_board import expose, light_of

    boards = Board.parse("aprilgrid:3x3", "30mm"), Board.parse("aprilgrid:3x3:id9", "30mm")
    papers = [Paper(board, 0.25) for board in boards]
    for i, tilt in enumerate(TILTS[:3]):
        scenes = [(papers[k], *pose(boards[k], tilt, 0.5, (x, 0.0))) for k, x in enumerate((-0.1, 0.1))]
        cv2.imwrite(str(tmp_path / f"{i}.png"), expose(light_of(scenes, CAMERA, 3), *CAMERA.size, supersample=3))
    for number, text in enumerate(("aprilgrid:3x3", "aprilgrid:3x3:id9")):
        output = tmp_path / f"{number}.obs.json"
        run("detect", tmp_path / "*.png", "--board", text, "--square", "30mm", "-o", output)
        assert len(Observations.load(output).views) == 3
    left, right = (Observations.load(tmp_path / f"{number}.obs.json").pixels()[0, :, 0] for number in (0, 1))
    assert float(left.nanmean()) < 240 < float(right.nanmean())
