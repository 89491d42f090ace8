import cv2
import numpy as np
import pytest
import torch

from kcal.corners.board import Board
from kcal.corners.detect import detect, detect_board
from kcal.corners.marker_boards import find_aprilgrid
from kcal.corners.markers import opencv_dictionary
from kcal.corners.print_board import pattern_shapes
from kcal.errors import InputError
from kcal.lens.camera import Camera
from scripts.shared.printed_board import Paper, add, errors, expose, light_of, points_of, pose

CAMERA = Camera.build(focal=(430, 430), center=(243, 177), size=(480, 360), coefficients=[-0.1, 0.02])
BOARD = Board.parse("aprilgrid:4x3", "35mm")
TILTS = ([0.0, 0.0, 0.0], [0.6, 0.0, 0.2], [-0.3, 0.5, 3.0], [0.1, -0.8, -1.6])


@pytest.fixture(scope="module")
def paper():
    return Paper(BOARD, cell_mm=0.25)


@pytest.mark.parametrize("tilt", TILTS)
def test_corners_of_tilted_boards(paper, tilt):
    image, truth = paper.shoot(CAMERA, *pose(BOARD, tilt, 0.33))
    found = detect_board(image, BOARD)
    rms, most, count = errors(found.pixels, truth)
    assert count >= 46
    # 0.006 px is what noise of 1 % of the contrast leaves, 0.02 where edges run along the renderer's rays.
    assert rms < 0.03
    assert most < 0.06
    assert found.covariance is not None


@pytest.mark.parametrize("shift", [(0.13, 0.0), (-0.1, 0.08), (0.0, -0.12)])
def test_a_part_is_enough(paper, shift):
    image, truth = paper.shoot(CAMERA, *pose(BOARD, [0.2, -0.3, 0.1], 0.33, shift))
    found = detect_board(image, BOARD)
    rms, most, count = errors(found.pixels, truth)
    assert 8 <= count <= 40
    assert rms < 0.03
    assert most < 0.06


def test_small_tags(paper):
    """Tags of 20 px are read in the image twice as large."""
    image, truth = paper.shoot(CAMERA, *pose(BOARD, [0.2, 0.3, 0.1], 0.75))
    rms, most, count = errors(detect_board(image, BOARD).pixels, truth)
    assert count >= 40
    assert rms < 0.03
    assert most < 0.1


def test_two_grids_in_one_image(paper):
    """Each is found by its numbers, one beside the other, and never confused."""
    other = Board.parse("aprilgrid:3x3:id12", "35mm")
    scenes = [
        (paper, *pose(BOARD, [0.2, 0.3, 0.1], 0.6, (-0.12, 0))),
        (Paper(other, 0.25), *pose(other, [0.1, -0.3, 0.2], 0.6, (0.13, 0))),
    ]
    image = expose(light_of(scenes, CAMERA), *CAMERA.size)
    for board, scene in ((BOARD, scenes[0]), (other, scenes[1])):
        truth = points_of(board, CAMERA, *scene[1:])
        rms, most, count = errors(detect_board(image, board).pixels, truth)
        assert count >= board.corners - 8
        assert rms < 0.03
        assert most < 0.1
    third = detect_board(image, Board.parse("aprilgrid:4x3:id100", "35mm"))
    assert third.pixels is None
    assert "are seen, the board has 100 to 111: another board, or give its first number" in third.reason


def test_a_tag_that_is_seen_twice(paper):
    scenes = [(paper, *pose(BOARD, [0.0, 0.0, 0.0], 0.6, (x, 0.0))) for x in (-0.12, 0.13)]
    found = detect_board(expose(light_of(scenes, CAMERA), *CAMERA.size), BOARD)
    assert found.pixels is None
    assert "is seen twice" in found.reason


@pytest.mark.parametrize("wrong", ["aprilgrid:3x4", "aprilgrid:6x4", "aprilgrid:5x5"])
def test_another_number_of_tags(paper, wrong):
    image, _ = paper.shoot(CAMERA, *pose(BOARD, [0.2, 0.3, 0.1], 0.33))
    found = detect_board(image, Board.parse(wrong, "35mm"))
    assert found.pixels is None
    assert "tags found do not lie as on this board" in found.reason


def test_without_squares_between_the_tags(paper):
    """Such a board has no crossings to refine: it is refused with that reason."""
    bare = Paper(BOARD, cell_mm=0.25)
    gap, black = 1000 * BOARD.gap, 1.0 - bare.light
    left, top = bare.origin - np.array(pattern_shapes(BOARD).origin)
    small = np.zeros_like(black)
    for square in pattern_shapes(BOARD).rectangles:
        if abs(square.height - gap) < 1e-6 and abs(square.width - gap) < 1e-6:
            add(small, (left + square.x) / 0.25, (top + square.y) / 0.25, gap / 0.25, gap / 0.25)
    bare.light = 1.0 - np.clip(black - small, 0, 1)
    image, _ = bare.shoot(CAMERA, *pose(BOARD, [0.2, 0.3, 0.1], 0.33))
    found = detect_board(image, BOARD)
    assert found.pixels is None
    assert "small squares between the tags are needed" in found.reason


def test_tags_with_a_border_of_one_cell():
    """Other makers than Kalibr draw tags of 8 cells, upright as in OpenCV's dictionary: both are read."""
    board, cell = Board.parse("aprilgrid:3x2:0.3", "40mm"), 5
    side, gap = 8 * cell, 12
    pitch = side + gap
    page = np.full((2 * pitch + gap + 80, 3 * pitch + gap + 80), 255, np.uint8)
    for row in range(3):
        for column in range(4):
            y, x = 40 + row * pitch, 40 + column * pitch
            page[y : y + gap, x : x + gap] = 0
    for number in range(6):
        row, column = divmod(number, 3)
        y, x = 40 + gap + (1 - row) * pitch, 40 + gap + column * pitch
        page[y : y + side, x : x + side] = opencv_dictionary("apriltag_36h11").generateImageMarker(number, side)
    image = cv2.GaussianBlur(page, (0, 0), 0.8)
    found = detect_board(image, board)
    origin = torch.tensor([40.0 + gap - 0.5, 40.0 + gap + pitch + side - 0.5], dtype=torch.float64)
    truth = board.points[:, :2] * (1000 * side / 40) + origin
    rms, most, count = errors(found.pixels, truth)
    assert count == 24
    assert rms < 0.02
    assert most < 0.05


def test_nothing_there():
    blank = np.full((100, 100), 200, np.uint8)
    assert detect_board(blank, BOARD).reason == "fewer than 2 tags of the AprilGrid found"


def test_windows_end_before_the_cells_inside_a_tag(paper):
    image, _ = paper.shoot(CAMERA, *pose(BOARD, [0.0, 0.0, 0.0], 0.33))
    tag = 430 * 0.035 / 0.33
    side = find_aprilgrid(image, BOARD).side
    assert 0.5 * float(side.nanmedian()) < 0.2 * 2**0.5 * tag  # two of ten cells, along the diagonal
    assert 0.5 * float(side.nanmedian()) > 0.15 * 2**0.5 * tag


def test_wrong_target_says_what_was_seen(paper, tmp_path):
    image, _ = paper.shoot(CAMERA, *pose(BOARD, [0.2, 0.3, 0.1], 0.33))
    path = str(tmp_path / "a.png")
    cv2.imwrite(path, image)
    for text in ("9x6", "charuco:9x6", "circles:9x6", "charuco:9x6:apriltag_36h11"):
        with pytest.raises(InputError, match=r"markers 0 to 11 of dictionary apriltag_36h11 .*give --board aprilgrid:"):
            detect([path], Board.parse(text, "25mm"))
