"""Boards with markers: AprilGrids, ChArUco boards, and boards whose markers cannot all be read."""

import cv2
import numpy as np
import pytest
import torch
from command_line import Command

from kcal import Board, Camera, InputError, Observations, calibrate_camera
from kcal.corners.detect import detect, detect_board, view_of
from kcal.corners.images import read_gray
from kcal.corners.marker_boards import _opencv_board, find_aprilgrid, find_charuco, free_side
from kcal.corners.markers import marker_cells, opencv_dictionary
from kcal.corners.print_board import pattern_shapes
from kcal.corners.search import NotFoundError
from scripts.bench.found import WRONG
from scripts.bench.hard_boards import Marked, covered, cut, moving, noisy, pictures, plain, small
from scripts.shared.printed_board import Paper, add, errors, expose, light_of, points_of, pose

CAMERA = Camera.build(focal=(430, 430), center=(243, 177), size=(480, 360), coefficients=[-0.1, 0.02])

BOARD = Board.parse("aprilgrid:4x3", "35mm")


@pytest.fixture(scope="module")
def paper():
    return Paper(BOARD, cell_mm=0.25)


TILTS = ([0.0, 0.0, 0.0], [0.6, 0.0, 0.2], [-0.3, 0.5, 3.0], [0.1, -0.8, -1.6])
SHIFTS = ((0.13, 0.0), (-0.1, 0.08), (0.0, -0.12))


@pytest.mark.parametrize(
    ("place", "fewest", "most", "largest"),
    [
        *(((tilt, 0.33), 46, 48, 0.06) for tilt in TILTS),
        # A part is enough.
        *((([0.2, -0.3, 0.1], 0.33, shift), 8, 40, 0.06) for shift in SHIFTS),
        # Tags of 20 px are read in the image twice as large.
        (([0.2, 0.3, 0.1], 0.75), 40, 48, 0.1),
    ],
)
def test_corners_of_tilted_partial_and_small_boards(paper, place, fewest, most, largest):
    image, truth = paper.shoot(CAMERA, *pose(BOARD, *place))
    found = detect_board(image, BOARD)
    rms, worst, count = errors(found.pixels, truth)
    assert fewest <= count <= most
    # 0.006 px is what noise of 1 % of the contrast leaves, 0.02 where edges run along the renderer's rays.
    assert rms < 0.03
    assert worst < largest
    assert found.covariance is not None


def test_two_grids_in_one_image(paper):
    """Each is found by its numbers, one beside the other, and never confused."""
    other = Board.parse("aprilgrid:3x3:id12", "35mm")
    scenes = [
        (paper, *pose(BOARD, [0.2, 0.3, 0.1], 0.6, (-0.12, 0))),
        (Paper(other, 0.25), *pose(other, [0.1, -0.3, 0.2], 0.6, (0.13, 0))),
    ]
    image = expose(light_of(scenes, CAMERA), *CAMERA.size)
    for board, scene in ((BOARD, scenes[0]), (other, scenes[1])):
        rms, most, count = errors(detect_board(image, board).pixels, points_of(board, CAMERA, *scene[1:]))
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
    found = detect_board(cv2.GaussianBlur(page, (0, 0), 0.8), board)
    origin = torch.tensor([40.0 + gap - 0.5, 40.0 + gap + pitch + side - 0.5], dtype=torch.float64)
    rms, most, count = errors(found.pixels, board.points[:, :2] * (1000 * side / 40) + origin)
    assert count == 24
    assert rms < 0.02
    assert most < 0.05


def test_nothing_there():
    blank = np.full((100, 100), 200, np.uint8)
    assert detect_board(blank, BOARD).reason == "fewer than 2 tags of the AprilGrid found"


def test_windows_end_before_the_cells_inside_a_tag(paper):
    image, _ = paper.shoot(CAMERA, *pose(BOARD, [0.0, 0.0, 0.0], 0.33))
    tag = 430 * 0.035 / 0.33
    side = find_aprilgrid(image, BOARD)[1].median()
    assert 0.5 * float(side) < 0.2 * 2**0.5 * tag  # two of ten cells, along the diagonal
    assert 0.5 * float(side) > 0.15 * 2**0.5 * tag


def test_wrong_target_says_what_was_seen(paper, tmp_path):
    image, _ = paper.shoot(CAMERA, *pose(BOARD, [0.2, 0.3, 0.1], 0.33))
    path = str(tmp_path / "a.png")
    cv2.imwrite(path, image)
    for text in ("9x6", "charuco:9x6", "circles:9x6", "charuco:9x6:apriltag_36h11"):
        with pytest.raises(InputError, match=r"markers 0 to 11 of dictionary apriltag_36h11 .*give --board aprilgrid:"):
            detect([path], Board.parse(text, "25mm"))


CHARUCO = Board.parse("charuco:9x6", "25mm")


@pytest.fixture(scope="module")
def charuco_paper():
    return Paper(CHARUCO, cell_mm=0.25)


def shoot(charuco_paper, camera, tilt, distance, shift=(0.0, 0.0), **options):
    return charuco_paper.shoot(camera, *pose(CHARUCO, tilt, distance, shift), supersample=2, **options)


FINE_CAMERA = Camera.build(focal=(1400, 1400), center=(600, 450), size=(1200, 900))

CHARUCO_CAMERA = Camera.build(focal=(560, 560), center=(241, 178), size=(480, 360), coefficients=[-0.1, 0.02])


class TestBoard:
    def test_syntax(self):
        assert (CHARUCO.columns, CHARUCO.rows, CHARUCO.dictionary) == (9, 6, "4x4_50")
        assert CHARUCO.marker == pytest.approx(0.0175, abs=1e-15)
        other = Board.parse("charuco:5x4:DICT_6X6_250:3cm", "40mm")
        assert (other.dictionary, other.marker, other.square) == ("6x6_250", 0.03, 0.04)
        assert str(other) == "5x4 inner corners, 40 mm squares, 30 mm markers 6x6_250"
        assert Board.parse("charuco:7x5", "1cm").unambiguous
        assert not Board.parse("7x5", "1cm").unambiguous

    @pytest.mark.parametrize(
        ("size", "message"),
        [
            ("charuco:9", "COLUMNSxROWS"),
            ("charuco:9x6:best", "choose one of"),
            ("charuco:9x6:4x4_50:30mm", "smaller than its square"),
            ("charuco:9x6:4x4_50:30", "with its unit"),
            ("charuco:20x20", "markers, dictionary 4x4_50 fewer"),
            ("charuco:9x6:4x4_50:9mm:x", "charuco:COLUMNSxROWS"),
        ],
    )
    def test_refusals(self, size, message):
        with pytest.raises(InputError, match=message) as caught:
            Board.parse(size, "25mm")
        assert "\n" not in str(caught.value)

    def test_half_a_description_is_refused(self):
        with pytest.raises(InputError, match="neither"):
            Board(columns=4, rows=3, square=0.1, marker=0.05)

    def test_markers_have_a_black_border(self):
        cells = marker_cells(CHARUCO)
        assert len(cells) == 35
        assert all(cell.shape == (6, 6) and cell[0].all() and cell[:, -1].all() for cell in cells)
        assert len({cell.tobytes() for cell in cells}) == 35
        with pytest.raises(InputError, match="not a ChArUco"):
            marker_cells(Board(columns=4, rows=3, square=0.1))


class TestDetection:
    def test_printed_board_is_found_in_order(self, charuco_paper):
        image, truth = shoot(charuco_paper, CHARUCO_CAMERA, [0.2, -0.15, 0.1], 0.4)
        found = detect_board(image, CHARUCO)
        error = found.pixels - truth
        assert bool(torch.isfinite(error).all())
        # 0.03: a window of 6 px.
        assert float(error.square().mean().sqrt()) < 0.03
        assert found.covariance is not None

    def test_upside_down(self, charuco_paper):
        image, truth = shoot(charuco_paper, CHARUCO_CAMERA, [0.1, 0.05, 3.1], 0.4)
        assert float((detect_board(image, CHARUCO).pixels - truth).abs().nan_to_num().max()) < 0.2

    def test_a_board_printed_white_on_black(self, charuco_paper):
        image, _ = shoot(charuco_paper, CHARUCO_CAMERA, [0.2, -0.15, 0.1], 0.4)
        pixels, inverted = (detect_board(each, CHARUCO).pixels for each in (image, 255 - image))
        assert float((inverted - pixels).abs().max()) < 0.05

    @pytest.mark.parametrize("tilt", [[1.25, 0.0, 0.0], [0.75, 1.0, 0.0]])
    def test_a_board_seen_at_seventy_degrees(self, tilt, charuco_paper):
        image, truth = shoot(charuco_paper, FINE_CAMERA, tilt, 0.3, blur=0.4)
        found = detect_board(image, CHARUCO).pixels
        seen = torch.isfinite(found).all(-1)
        assert int(seen.sum()) >= 20
        assert float((found - truth)[seen].square().mean().sqrt()) < 0.06

    def test_another_number_of_columns_is_no_board(self, charuco_paper):
        """Half of the markers lie as on a board of other columns: rows of markers are parallel on both."""
        image, _ = shoot(charuco_paper, CHARUCO_CAMERA, [0.2, -0.15, 0.1], 0.4)
        for size in ("charuco:6x9", "charuco:8x6", "charuco:10x6"):
            assert detect_board(image, Board.parse(size, "25mm")).reason.startswith("the markers do not lie as on this")

    @pytest.mark.parametrize(
        ("name", "size", "square", "corners"),
        [
            ("captures/single/inverted_charuco.png", "charuco:3x4:4x4_1000:40.5mm", "54mm", 12),
            ("field/charuco/v2.png", "charuco:16x10:5x5_100:4mm", "8mm", 120),
        ],
    )
    def test_boards_of_strangers(self, name, size, square, corners, kcal_data):
        board = Board.parse(size, square)
        pixels = detect_board(read_gray(kcal_data / name), board).pixels
        seen = torch.isfinite(pixels).all(-1).numpy()
        assert seen.sum() >= corners
        places, pixels = board.points[:, :2].numpy()[seen], pixels.numpy()[seen]
        plane = cv2.perspectiveTransform(places[None], cv2.findHomography(places, pixels)[0])[0]
        # A wide lens bends the first one by 2 px.
        assert np.abs(plane - pixels).max() < (0.12 if corners > 12 else 2.5)

    def test_a_part_at_the_border_is_enough(self, charuco_paper):
        image, truth = shoot(charuco_paper, CHARUCO_CAMERA, [0.1, -0.2, 0.0], 0.4, (0.12, 0.08))
        found = detect_board(image, CHARUCO)
        seen = torch.isfinite(found.pixels).all(-1)
        assert 8 <= int(seen.sum()) <= 40
        assert float((found.pixels - truth)[seen].square().mean().sqrt()) < 0.03
        view = view_of(found, "a")
        assert [pixel is None for pixel in view.pixels] == [spread is None for spread in view.covariance]

    def test_partial_views_calibrate(self, charuco_paper):
        tilts = [[0.4, 0.1, 0.0], [-0.4, 0.0, 0.1], [0.1, 0.45, 0.0], [0.0, -0.4, -0.1], [0.3, 0.3, 0.2]]
        shifts = [[0.1, 0.06], [-0.1, 0.05], [0.08, -0.06], [-0.09, -0.05], [0.0, 0.0]]
        views = []
        for i, (tilt, shift) in enumerate(zip(tilts, shifts, strict=True)):
            image, _ = shoot(charuco_paper, CHARUCO_CAMERA, tilt, 0.36, shift, seed=i)
            views.append(view_of(detect_board(image, CHARUCO), f"{i}"))
        assert any(None in view.pixels for view in views)
        result = calibrate_camera(Observations(board=CHARUCO, image_size=(480, 360), views=tuple(views)))
        assert result.rms < 0.06
        assert float(result.camera.focal[0]) == pytest.approx(560, abs=4)

    def test_nothing_and_too_little(self, charuco_paper):
        image, _ = shoot(charuco_paper, CHARUCO_CAMERA, [0.0, 0.0, 0.0], 0.4)
        assert "fewer than 6 corners" in detect_board(np.full_like(image, 200), CHARUCO).reason
        image[:, 90:] = 200
        assert detect_board(image, CHARUCO).pixels is None

    def test_window_ends_before_the_marker(self):
        side = free_side(CHARUCO.points[:, :2] * 1000, CHARUCO)
        # From the corner to the marker's own corner: 3.75 mm along each axis.
        assert float(side[0]) * 0.5 < 3.75 * np.sqrt(2)
        assert float(side[0]) * 0.5 > 0.7 * 3.75 * np.sqrt(2)


def test_commands(charuco_paper, tmp_path, command: Command):
    image, _ = shoot(charuco_paper, CHARUCO_CAMERA, [0.2, -0.15, 0.1], 0.4)
    cv2.imwrite(str(tmp_path / "a.png"), image)
    output = tmp_path / "a.obs.json"
    what = ["--board", "charuco:9x6", "--square", "25mm", "-o"]
    command("detect", tmp_path / "a.png", *what, output)
    assert Observations.load(output).board == CHARUCO
    command("board", *what, tmp_path / "b.pdf", "--paper A4")
    assert b"charuco:9x6:4x4_50:17.5mm" in (tmp_path / "b.pdf").read_bytes()


# ChArUco boards of OpenCV before 4.6 and since, of several dictionaries, and several in one image.


SIDE, MARGIN = 40, 40


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
    assert find_charuco(part, board)[1] is None
    cv2.imwrite(str(tmp_path / "a.png"), part)
    cv2.imwrite(str(tmp_path / "b.png"), image)
    for pixels in detect([tmp_path / "a.png", tmp_path / "b.png"], board).pixels():
        assert errors(pixels, truth)[1] < 0.05
    assert errors(detect([tmp_path / "a.png"], board).pixels()[0], truth)[1] == pytest.approx(SIDE, abs=0.1)


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
    both = np.concatenate([today[:middle], np.full((60, today.shape[1]), 255, np.uint8), before[middle:]])
    with pytest.raises(NotFoundError, match="two boards; hide one"):
        find_charuco(both, board)


def test_another_size():
    image, _ = drawn(Board.parse("charuco:8x5", "25mm"), False)
    with pytest.raises(NotFoundError, match="markers do not lie as on this board"):
        find_charuco(image, Board.parse("charuco:6x9", "25mm"))


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


# Boards with markers of which some cannot be read: their corners are found from those beside them.


SCENES = {name: Marked(Board.parse(name, "30mm")) for name in ("charuco:9x6", "aprilgrid:6x6")}


# Remarks: the share that was found when only corners beside markers without wrong bits were.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind", "least"),
    [
        ("charuco:9x6", plain, 1.0),  # 0.93
        ("charuco:9x6", moving, 0.95),  # 0.61
        ("charuco:9x6", small, 0.8),  # 0
        ("charuco:9x6", covered, 0.95),  # 0.85
        ("aprilgrid:6x6", noisy, 0.4),  # 0.10
        ("aprilgrid:6x6", moving, 0.95),  # 0.25
        ("aprilgrid:6x6", small, 0.95),  # 0
        ("aprilgrid:6x6", cut, 0.93),  # 0.89
    ],
)
def test_share_of_the_corners(name, kind, least):
    scene = SCENES[name]
    (image, truth), *_ = pictures(kind, 1, scene)
    pixels = detect_board(image, scene.board).pixels
    right = (pixels - truth).norm(dim=-1) < WRONG
    assert int(right.sum()) >= least * int(torch.isfinite(truth).all(-1).sum())
    assert int(torch.isfinite(pixels).all(-1).sum()) == int(right.sum())
