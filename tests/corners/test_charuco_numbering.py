"""ChArUco boards of OpenCV before 4.6 and since, of several dictionaries, and several in one image."""

import cv2
import numpy as np
import pytest
import torch

from kcal.corners.board import Board
from kcal.corners.detect import detect, detect_board
from kcal.corners.marker_boards import _opencv_board, find_charuco
from kcal.errors import InputError
from kcal.lens.camera import Camera
from scripts.shared.printed_board import Paper, errors, expose, light_of, points_of, pose

SIDE, MARGIN = 40, 40
CAMERA = Camera.build(focal=(430, 430), center=(243, 177), size=(480, 360), coefficients=[-0.1, 0.02])


def drawn(board, legacy):
    """OpenCV's own picture of a board, and its corners."""
    size = ((board.columns + 1) * SIDE, (board.rows + 1) * SIDE)
    image = _opencv_board(board, legacy).generateImage(size)
    image = cv2.copyMakeBorder(image, *(MARGIN,) * 4, cv2.BORDER_CONSTANT, value=255)
    truth = board.points[:, :2] * (SIDE / board.square) + SIDE + MARGIN - 0.5
    return cv2.GaussianBlur(image, (0, 0), 1.0), truth


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("size", ["charuco:8x5", "charuco:9x5", "charuco:4x3", "charuco:8x5:5x5_100:id30"])
def test_the_image_tells_the_numbering(size, legacy):
    board = Board.parse(size, "25mm")
    image, truth = drawn(board, legacy)
    found = detect_board(image, board)
    assert found.legacy is legacy
    assert errors(found.pixels, truth)[1:] == pytest.approx((0.0, board.corners), abs=1e-3)


def test_where_both_numberings_are_the_same():
    board = Board.parse("charuco:9x6", "25mm")
    for legacy in (False, True):
        image, truth = drawn(board, legacy)
        found = detect_board(image, board)
        assert found.legacy is None
        assert errors(found.pixels, truth)[1] < 1e-3


@pytest.mark.parametrize("legacy", [False, True])
def test_half_a_board(legacy):
    board = Board.parse("charuco:9x5", "25mm")
    image, truth = drawn(board, legacy)
    below = image.shape[0] * 2 // 5
    found = detect_board(np.ascontiguousarray(image[below:]), board)
    assert found.legacy is legacy
    _rms, most, count = errors(found.pixels + torch.tensor([0.0, below]), truth)
    assert 15 <= count < 45
    assert most < 0.05


def test_images_that_do_not_tell_follow_the_others(tmp_path):
    """In the middle of some boards both numberings differ by a shift only: a square, if guessed wrong."""
    board = Board.parse("charuco:8x5", "25mm")
    image, truth = drawn(board, True)
    part = image.copy()
    part[:, image.shape[1] * 6 // 10 :] = 255
    assert find_charuco(part, board).legacy is None
    cv2.imwrite(str(tmp_path / "a.png"), part)
    cv2.imwrite(str(tmp_path / "b.png"), image)
    seen = detect([tmp_path / "a.png", tmp_path / "b.png"], board)
    for pixels in seen.pixels():
        assert errors(pixels, truth)[1] < 0.05
    alone = detect([tmp_path / "a.png"], board)
    assert errors(alone.pixels()[0], truth)[1] == pytest.approx(SIDE, abs=0.1)


def test_images_of_two_numberings_are_refused(tmp_path):
    board = Board.parse("charuco:8x5", "25mm")
    for name, legacy in (("old", True), ("new", False)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), drawn(board, legacy)[0])
    with pytest.raises(
        InputError, match=r"two ChArUco boards: old\.png shows the numbering of OpenCV before 4\.6, new\.png"
    ):
        detect([tmp_path / "old.png", tmp_path / "new.png"], board)


def test_markers_of_both_numberings_in_one_image():
    """Halves of two boards that show other markers each."""
    board = Board.parse("charuco:9x9", "25mm")
    today, before = (drawn(board, legacy)[0] for legacy in (False, True))
    middle = len(today) // 2
    found = find_charuco(
        np.concatenate([today[:middle], np.full((60, today.shape[1]), 255, np.uint8), before[middle:]]), board
    )
    assert found.pixels is None
    assert "two boards; hide one" in found.reason


def test_another_size():
    image, _ = drawn(Board.parse("charuco:8x5", "25mm"), False)
    found = find_charuco(image, Board.parse("charuco:6x9", "25mm"))
    assert found.pixels is None
    assert "markers do not lie as on this board" in found.reason


@pytest.mark.parametrize(
    "name",
    [
        "aruco_original",
        "aruco_mip_36h12",
        "apriltag_16h5",
        "apriltag_25h9",
        "apriltag_36h10",
        "apriltag_36h11",
        "7x7_1000",
    ],
)
def test_dictionaries(name):
    board = Board.parse(f"charuco:6x5:{name}", "25mm")
    image, truth = Paper(board, 0.25).shoot(CAMERA, *pose(board, [0.2, 0.3, 0.1], 0.26), supersample=3)
    rms, most, count = errors(detect_board(image, board).pixels, truth)
    assert count >= 28
    assert rms < 0.03
    assert most < 0.08


def test_two_boards_in_one_image():
    boards = Board.parse("charuco:4x4", "30mm"), Board.parse("charuco:4x4:id20", "30mm")
    places = [
        pose(board, [0.2, tilt, 0.1], 0.5, (x, 0))
        for board, tilt, x in zip(boards, (0.3, -0.3), (-0.11, 0.11), strict=True)
    ]
    papers = [Paper(board, 0.25) for board in boards]
    image = expose(
        light_of([(paper, *place) for paper, place in zip(papers, places, strict=True)], CAMERA), *CAMERA.size
    )
    for board, place in zip(boards, places, strict=True):
        rms, most, count = errors(detect_board(image, board).pixels, points_of(board, CAMERA, *place))
        assert count == 16
        assert rms < 0.03
        assert most < 0.06
    reason = detect_board(image, Board.parse("charuco:4x4:5x5_50", "30mm")).reason
    assert "fewer than 6 corners" in reason
    reason = detect_board(image, Board.parse("charuco:3x3:id36", "30mm")).reason
    assert "markers 0 to 31 of 4x4_50 are another board's" in reason
    twice = expose(light_of([(papers[0], *place) for place in places], CAMERA), *CAMERA.size)
    assert "is seen twice" in detect_board(twice, boards[0]).reason
