"""Which board images show: its kind, columns, rows and markers; images that do not agree; a board named wrongly."""

import functools
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import Command
from numpy.typing import NDArray
from PIL import Image

from kcal import Board, Camera, InputError, Observations, calibrate_camera, detect
from kcal.corners import detect_board, recognize_board
from kcal.corners.images import decode_gray, decode_image, exif_orientation, expand_images, image_header
from kcal.corners.recognize import (
    Recognized,
    SeenMarkers,
    circle_board,
    marker_board,
    most_markers,
    seen_board,
    spread_order,
)
from kcal.io.images import write_png
from scripts.shared.printed_board import Paper, pose

CAMERA = Camera.build(focal=(700, 700), center=(379.5, 279.5), size=(760, 560))
TILTS = ((0.1, 0.1, 0.1), (0.7, 0.1, 1.4), (-0.2, 0.6, -0.4))


@functools.cache
def shot(board: Board, distance: float, tilt: tuple[float, ...]) -> NDArray[np.uint8]:
    return Paper(board, cell_mm=0.5).shoot(CAMERA, *pose(board, tilt, distance), supersample=1)[0]


def shots(board: Board, distance: float, *tilts: tuple[float, ...]) -> list[NDArray[np.uint8]]:
    return [shot(board, distance, tilt).copy() for tilt in tilts or TILTS]


@pytest.mark.parametrize(("text", "square", "distance"), [
    ("9x6", "25mm", 0.4), ("7x7", "25mm", 0.4), ("charuco:9x6:5x5_100:19mm", "25mm", 0.4),
    ("charuco:7x4:4x4_50:id20", "25mm", 0.4), ("aprilgrid:6x5:0.3", "30mm", 0.5),
    ("aprilgrid:5x4:0.2:id20", "30mm", 0.5), ("circles:8x6", "22mm", 0.35), ("asymmetric:4x11", "20mm", 0.45),
])  # fmt: skip
def test_boards_are_recognized(text: str, square: str, distance: float) -> None:
    board = Board.parse(text, square)
    found = recognize_board(shots(board, distance), square)
    assert (found.pattern, found.columns, found.rows, found.first) == (
        board.pattern, board.columns, board.rows, board.first,
    )  # fmt: skip
    # The smallest dictionary that has its markers.
    assert (found.dictionary or "").split("_")[0] == (board.dictionary or "").split("_")[0]
    for own, true in ((found.marker, board.marker), (found.gap, board.gap)):
        assert own == (None if true is None else pytest.approx(true, rel=0.04))


def test_rows_that_one_image_cuts_another_shows() -> None:
    """A part of a board with markers votes as well; it does not make the board smaller."""
    upper = shots(Board.parse("charuco:9x6:5x5_100", "25mm"), 0.4, TILTS[0])[0]
    lower, middle = upper.copy(), upper.shape[0] // 2
    upper[middle + 40 :] = 200
    lower[: middle - 40] = 200
    for image in (upper, lower):
        seen = seen_board(image)
        assert seen is not None
        assert seen.rows[1] - seen.rows[0] < 6
    found = recognize_board([upper, lower], "25mm")
    assert (found.columns, found.rows, found.first) == (9, 6, 0)


def test_nothing_and_no_agreement() -> None:
    one, two = (shots(Board.parse(text, "25mm"), 0.4, *TILTS[:2]) for text in ("9x6", "8x5"))
    with pytest.raises(InputError, match=r"cannot be told from 4 images .*: 9x6 in 2, 8x5 in 2; give --board"):
        recognize_board([*one, *two], "25mm")
    with pytest.raises(InputError, match="1 images that were looked at: they show none; give --board"):
        recognize_board(np.full((200, 240), 230, np.uint8), "25mm")


def test_the_square_is_asked_for_with_what_was_found() -> None:
    noted: list[Recognized] = []
    with pytest.raises(InputError, match=r"the board is 9x6, seen in 1 of 1 images .* for example --square 25mm"):
        recognize_board(shots(Board.parse("9x6", "25mm"), 0.4, TILTS[0]), note=noted.append)
    assert [(found.votes, found.looked) for found in noted] == [(1, 1)]


def test_it_ends_as_soon_as_images_agree() -> None:
    images = shots(Board.parse("9x6", "25mm"), 0.4, TILTS[0]) * 20
    noted: list[Recognized] = []
    recognize_board(images, "25mm", note=noted.append)
    assert noted[0].looked == 3
    assert sorted(spread_order(13)) == list(range(13))


def test_markers_and_spots_that_are_no_board() -> None:
    random = np.random.default_rng(0)
    (image,) = shots(Board.parse("charuco:9x6:5x5_100", "25mm"), 0.4, TILTS[0])
    seen = most_markers(image)
    assert marker_board(image, seen) is not None
    shuffled = dict(zip(seen.corners, random.permutation(list(seen.corners.values())), strict=True))
    assert marker_board(image, seen._replace(corners=shuffled)) is None
    # ArUco's grid boards: most of their markers lie as some ChArUco board has them, but sheared or too large.
    for across, count in ((3, 15), (4, 16)):
        places = 100.0 * np.stack([np.arange(count) % across, np.arange(count) // across], 1)
        corners = places[:, None] + [(0, 0), (80, 0), (80, 80), (0, 80)]
        assert marker_board(image, SeenMarkers("6x6_50", 1, dict(enumerate(corners)))) is None
    assert circle_board([tuple(place) for place in random.uniform(0, 500, (40, 2)).tolist()]) is None
    grid = [(30.0 * i, 30.0 * j) for i in range(6) for j in range(5)]
    assert circle_board(grid) is not None
    assert circle_board(grid[1:]) is None


@pytest.mark.parametrize(("images", "text"), [
    ("opencv_stereo/left*.jpg", "9x6"), ("captures/pi640", "7x7"), ("captures/gloworm960", "8x6"),
    ("captures/carnd", "9x6"), ("captures/single/fisheye_8x6.jpg", "8x6"),
    ("captures/single/inverted_charuco.png", "charuco:3x4:4x4_50"), ("field/charuco/v2.png", "charuco:16x10:5x5_100"),
])  # fmt: skip
def test_boards_of_strangers(images: str, text: str, kcal_data: Path) -> None:
    noted: list[Recognized] = []
    recognize_board(str(kcal_data / images), "25mm", note=noted.append)
    assert noted[0].seen is not None
    assert noted[0].seen.text == text


@pytest.mark.slow
def test_a_false_hit_does_not_make_another_board(kcal_data: Path, tmp_path: Path, command: Command) -> None:
    """OpenCV 5.0 finds 8x8 corners in one image of a board of 7x7; 5.1 does not."""
    if not cv2.__version__.startswith("5.0"):
        pytest.skip("this OpenCV has no such false hit")
    files = [kcal_data / "captures" / "pi640" / f"img{number}.jpg" for number in (9, 1, 5, 7)]
    wrong = Board.parse("8x8", "25mm")
    assert detect_board(shots(Board.parse("9x6", "25mm"), 0.4, TILTS[0])[0], wrong).pixels is None
    with pytest.raises(InputError, match=r"the board is in 1 of 4 images only; .* give --board 7x7"):
        detect(files, wrong)
    result = command("detect", *files, "--square 25mm -o", tmp_path / "x.obs.json")
    assert "board 7x7, seen in " in result.err
    assert "board found in 4 of 4 images" in result.out


def test_a_board_that_is_often_covered_is_no_other_one() -> None:
    """Few images with the whole board, and more that show a part of it: the board stays."""
    image = shots(Board.parse("9x6", "25mm"), 0.4, TILTS[0])[0]
    covered = [image.copy() for _ in range(4)]
    for number, one in enumerate(covered):
        one[:, : 300 + 50 * number] = 128
    seen = detect([image, *covered], Board.parse("9x6", "25mm"))
    assert seen.names[0] == "image 0"
    # Fewer than half, so that others were looked at.
    assert 2 * len(seen.views) < 5


def test_images_of_two_cameras_end_with_a_command_for_each(
    kcal_data: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The commands can be pasted: they are run here."""
    monkeypatch.chdir(tmp_path)
    files = [*(f"left0{number}.jpg" for number in (1, 2)), *(f"calibration{number}.jpg" for number in (1, 7))]
    for name, folder in zip(files, 2 * ["opencv_stereo"] + 2 * ["captures/carnd"], strict=True):
        (tmp_path / name).symlink_to(kcal_data / folder / name)
    said = command("detect . --board 9x6 --square 25mm -o x.obs.json", code=1).err
    lines = said.split("To split them: ")[1].strip().split(" && ")
    assert [line.split(" -o ")[1] for line in lines] == ["x-1280x720.obs.json", "x-640x480.obs.json"]
    for line in lines:
        command(line.removeprefix("kcal "))
    found = [Observations.load(line.split(" -o ")[1]) for line in lines]
    assert [len(seen.views) + len(seen.failures) for seen in found] == [2, 2]
    assert all(seen.views for seen in found)


def test_many_images_that_failed_are_one_line_and_a_file(
    tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_png(tmp_path / "a.png", shots(Board.parse("9x6", "25mm"), 0.4, TILTS[0])[0])
    for number in range(13):
        (tmp_path / f"b{number}.png").write_bytes(b"")
    said = command("detect . --board 9x6 --square 25mm -o x.obs.json").out
    line = "13 images failed, 13 of them: the file is empty; copy it again; all of them: x.left-out.txt"
    assert line in said.splitlines()
    assert len((tmp_path / "x.left-out.txt").read_text().splitlines()) == 13
    (tmp_path / "b0.png").unlink()
    few = command("detect . --board 9x6 --square 25mm -o y.obs.json").out
    assert "  failed b1.png: the file is empty; copy it again" in few.splitlines()
    assert not (tmp_path / "y.left-out.txt").exists()


@pytest.mark.parametrize("there", [False, True])
def test_raw_and_heic_images_of_a_folder_are_named_with_what_to_do(
    tmp_path: Path, there: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("rawpy", "pillow_heif"):
        if there:
            pytest.importorskip(module)
        else:
            monkeypatch.setitem(sys.modules, module, None)
    write_png(tmp_path / "a.png", shots(Board.parse("9x6", "25mm"), 0.4, TILTS[0])[0])
    for name in ("a.CR2", "b.CR2", "c.heic"):
        (tmp_path / name).write_bytes(
            bytes(3) + b"\x18ftypheic" + bytes(100) if "heic" in name else b"II*\0" + bytes(99)
        )
    # The raw image of which a picture is there is not a failure of its own.
    assert [path.name for path in expand_images([tmp_path])] == ["a.png", "b.CR2", "c.heic"]
    raw, heic = detect(tmp_path, Board.parse("9x6", "25mm"), note=lambda _: None).failures
    assert (raw.name, heic.name) == ("b.CR2", "c.heic")
    words = ("a raw image that LibRaw cannot read", "the image is truncated or corrupt") if there else (
        "a raw image, which needs one more package: pip install 'kcal[images]'",
        "a HEIC image, which needs one more package: pip install 'kcal[images]'",
    )  # fmt: skip
    assert raw.reason.startswith(words[0])
    assert heic.reason.startswith(words[1])


@pytest.mark.parametrize(("turns", "orientation"), [(0, 1), (1, 8), (2, 3), (3, 6)])
def test_heic_is_as_the_sensor_wrote_it(turns: int, orientation: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Decoders turn it as the file asks; kcal turns it back."""
    stored = np.arange(40 * 30, dtype=np.uint8).reshape(30, 40)
    data = bytes(3) + b"\x18ftypheic" + bytes(8) + b"\0\0\0\x09irot" + bytes([turns])
    shown = Image.fromarray(np.ascontiguousarray(np.rot90(stored, turns)))
    monkeypatch.setattr("kcal.corners.images._opened_heif", lambda data, source: shown)
    assert np.array_equal(decode_gray(data, "a.heic"), stored)
    assert np.array_equal(decode_image(data, "a.heic")[..., 0], stored)
    assert image_header(data, "a.heic") == (40, 30)
    assert exif_orientation(data) == orientation


def test_a_unit_that_cannot_be_is_asked_about(kcal_data: Path) -> None:
    """A board of 2 m, where a sheet of paper is meant."""
    seen = Observations.load(kcal_data / "captures" / "st1_l.obs.json")
    seen = seen.subset(list(seen.names[::3]))
    large = seen.model_copy(update={"board": seen.board.model_copy(update={"square": 10.0 * seen.board.square})})
    assert large.board.likelier_square == pytest.approx(seen.board.square)
    told = [[found for found in calibrate_camera(one).findings if found.name == "unit"] for one in (seen, large)]
    assert told[0] == []
    (found,) = told[1]
    assert "with squares of 242.3 mm the board is 1.94 x 1.21 m, photographed with a focal length of " in found.text
    assert "with squares of 24.23 mm it would be 0.194 x 0.121 m, from 0.3" in found.text
