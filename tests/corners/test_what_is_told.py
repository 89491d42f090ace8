"""What is told of images without the board: which other one they show, why few corners are good, and their times."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import ExifTags, Image

from kcal.corners.board import Board
from kcal.corners.circles import find_circles
from kcal.corners.detect import (
    detect,
    has_own_markers,
    refuse_other_board,
    seen_by_most,
    seen_circles,
    seen_instead,
    seen_markers,
    seen_size,
    too_few,
)
from kcal.corners.images import image_time
from kcal.corners.markers import opencv_dictionary
from kcal.corners.refine import refine_corners
from kcal.corners.saddle import CornerStatus, Refined
from kcal.corners.video import VideoFrames
from kcal.errors import FileError, InputError

BLANK = np.full((200, 240), 230, np.uint8)


def instead(image: np.ndarray, board: Board, size: tuple[int, int] | None) -> str:
    """What is told where the largest grid of the image has a size."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("kcal.corners.detect.seen_size", lambda _: size)
        return seen_instead(image, board)


def markers(dictionary: str, *numbers: int, border: int = 1) -> NDArray[np.uint8]:
    """A page with so many markers in rows of four."""
    page = np.full((60 + 90 * (1 + (len(numbers) - 1) // 4), 400), 255, np.uint8)
    for k, number in enumerate(numbers):
        x, y = 30 + 90 * (k % 4), 30 + 90 * (k // 4)
        page[y : y + 64, x : x + 64] = opencv_dictionary(dictionary).generateImageMarker(number, 64, borderBits=border)
    return page


def spots(columns: int, rows: int) -> NDArray[np.uint8]:
    page = np.full((60 * rows + 40, 60 * columns + 40), 230, np.uint8)
    for k in range(columns * rows):
        cv2.circle(page, (50 + 60 * (k % columns), 50 + 60 * (k // columns)), 15, 20, -1)
    return page


class TestOtherBoards:
    BOARD = Board(columns=9, rows=6, square=0.025)

    @pytest.mark.parametrize(("found", "told"), [
        (None, ""), ((9, 6), ""), ((8, 5), "a board of 8x5 was found: count inner corners, not squares"),
        ((8, 6), "a board of 8x6 was found: give --board 8x6"),
    ])  # fmt: skip
    def test_another_checkerboard(self, found: tuple[int, int] | None, told: str) -> None:
        assert instead(BLANK, self.BOARD, found) == told
        tall = Board(columns=6, rows=9, square=0.025)
        assert instead(BLANK, tall, found) == told

    def test_a_checkerboard_in_place_of_markers(self) -> None:
        """Of the same size too: its markers are missing."""
        marked = Board.parse("charuco:9x6", "25mm")
        assert instead(BLANK, marked, (9, 6)) == "a board of 9x6 was found: give --board 9x6"
        circles = Board.parse("circles:9x6", "25mm")
        assert instead(BLANK, circles, (8, 5)) == "a board of 8x5 was found: give --board 8x5"

    def test_markers(self) -> None:
        told = "markers 3 to 9 of dictionary 4x4_50 were found: give --board charuco:COLUMNSxROWS:4x4_50"
        page = markers("4x4_50", 3, 5, 7, 9)
        assert seen_markers(page, self.BOARD) == told
        assert seen_markers(markers("4x4_50", 3, 5, 7), self.BOARD) == ""
        # They may be those of the board itself.
        own = Board.parse("charuco:9x6", "25mm")
        assert seen_markers(page, own) == ""
        assert has_own_markers(page, own)
        assert instead(page, own, (8, 6)) == ""
        others = Board.parse("charuco:9x6:4x4_250:id20", "25mm")
        assert seen_markers(page, others) == told
        assert not has_own_markers(page, others)
        assert has_own_markers(page, Board.parse("charuco:9x6:4x4_250:id9", "25mm"))
        assert not has_own_markers(page, Board.parse("charuco:9x6:4x4_250:id10", "25mm"))
        assert not has_own_markers(page, self.BOARD)
        assert seen_markers(markers("4x4_250", 3, 60), self.BOARD) == ""

    def test_the_larger_of_dictionaries(self) -> None:
        page = markers("5x5_250", 3, 60, 7, 9)
        assert "3 to 60 of dictionary 5x5_100" in seen_markers(page, self.BOARD)

    def test_tags(self) -> None:
        page = markers("apriltag_36h11", 0, 1, 2, 5, border=2)
        assert seen_markers(page, self.BOARD).endswith("give --board aprilgrid:COLUMNSxROWS")
        assert seen_markers(page, Board.parse("aprilgrid:6x6", "25mm")) == ""
        single = markers("apriltag_36h11", 0, 1, 2, 5)
        assert seen_markers(single, self.BOARD).endswith("give --board charuco:COLUMNSxROWS:apriltag_36h11")
        assert has_own_markers(single, Board.parse("aprilgrid:6x6", "25mm"))

    def test_circles(self) -> None:
        twelve, eleven = spots(4, 3), spots(11, 1)
        assert seen_circles(eleven, self.BOARD) is None
        told = "some 12 circles were found: give --board circles:COLUMNSxROWS or asymmetric:COLUMNSxROWS"
        assert seen_circles(twelve, self.BOARD) == told
        assert instead(twelve, self.BOARD, None) == told
        assert seen_circles(twelve, Board.parse("circles:4x3", "25mm")) == ""
        other = seen_circles(twelve, Board.parse("asymmetric:4x4", "25mm"))
        assert other is not None
        assert other.startswith("some 12 circles were found, the board has 16")
        few = find_circles(twelve, Board.parse("circles:7x6", "25mm")).reason
        assert few == "no grid of 7x6 circles found (12 round blobs seen, 42 are needed, all in the image)"

    def test_the_size_of_a_grid(self) -> None:
        i, j = np.mgrid[:9, :6]
        squares = np.kron(np.where((i + j) % 2 == 0, 40, 220), np.ones((30, 30))).astype(np.uint8)
        assert seen_size(np.pad(squares, 40, constant_values=220)) == (8, 5)
        assert seen_size(BLANK) is None


def test_why_too_few_are_good() -> None:
    """Counts of each reason, and a cure for the one that is most frequent."""
    status = torch.tensor([CornerStatus.GOOD] * 2 + [CornerStatus.OCCLUDED] * 2 + [CornerStatus.BLURRED] * 3)
    told = too_few(Refined(torch.zeros(7, 2), status), 7)
    assert told == (
        "only 2 of 7 corners could be refined (2 covered or glaring, 3 too blurred); focus, hold still or move closer"
    )
    assert too_few(Refined(torch.zeros(1, 2), status[:1]), 9) == "only 1 of 9 corners could be refined ()"


def test_corners_as_they_are() -> None:
    """Without refinement nothing moves; what is missing or outside is told."""
    start = torch.tensor([[3.0, 4.0], [torch.nan, 4.0], [-0.5, 4.0], [239.0, 199.0], [239.5, 3.0]]).double()
    found = refine_corners(BLANK, start, torch.full((5,), 10.0).double(), "none")
    missing, outside = int(CornerStatus.MISSING), int(CornerStatus.OUTSIDE)
    assert found.status.tolist() == [0, missing, outside, 0, outside]
    torch.testing.assert_close(found.pixels[[0, 3]], start[[0, 3]])
    assert bool(found.pixels[[1, 2, 4]].isnan().all())


class TestTimes:
    @pytest.mark.parametrize(("name", "seconds"), [
        ("left_20260101T000000Z.png", 1767225600.0), ("2026-01-01_00-01-02.25.jpg", 1767225662.25),
        ("a 20260102 030405.png", 1767225600.0 + 86400.0 + 3 * 3600 + 4 * 60 + 5),
        ("right_1767225600.5.png", 1767225600.5), ("1767225601.png", 1767225601.0),
        # No such month: then Unix seconds.
        ("20261301T000000_1767225602.png", 1767225602.0),
    ])  # fmt: skip
    def test_in_names(self, name: str, seconds: float) -> None:
        assert image_time(Path(name)) == pytest.approx(seconds, abs=1e-6)

    def test_in_the_camera_s_own_words(self, tmp_path: Path) -> None:
        tags = Image.Exif()
        tags.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.DateTimeOriginal] = "2026:01:01 02:00:00"
        for zone, hours in ((None, 2.0), ("+02:00", 0.0), ("-01:30", 3.5)):
            if zone:
                tags.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.OffsetTimeOriginal] = zone
            path = tmp_path / "a.jpg"
            Image.fromarray(BLANK).save(path, exif=tags)
            assert image_time(path) == 1767225600.0 + 3600.0 * hours

    def test_none(self, tmp_path: Path) -> None:
        Image.fromarray(BLANK).save(tmp_path / "a.png")
        (tmp_path / "b.png").write_bytes(b"nothing")
        for name in ("a.png", "b.png"):
            with pytest.raises(FileError, match="no time of capture"):
                image_time(tmp_path / name)


def test_single_frames_of_a_video(tmp_path: Path) -> None:
    """By their numbers, in any order; beyond the last one there is none."""
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 12.0, (64, 48))  # type: ignore[attr-defined]
    for k in range(6):
        writer.write(np.full((48, 64, 3), 20 + 30 * k, np.uint8))
    writer.release()
    frames = VideoFrames(path)
    assert (frames.count, frames.rate) == (6, 12.0)
    for number in (0, 1, 4, 2, 3, 5, 0):
        assert frames[number].shape == (48, 64)
        assert float(frames[number].mean()) == pytest.approx(20.0 + 30.0 * number, abs=2.0)
    with pytest.raises(FileError, match="frame 9 cannot be decoded"):
        frames[9]
    (tmp_path / "none.avi").write_bytes(b"nothing")
    for name, message in (("none.avi", "not a video"), ("missing.avi", "no such file")):
        with pytest.raises(FileError, match=message):
            VideoFrames(tmp_path / name)


def test_most_images_tell_which_board_they_show() -> None:
    """Not one image each: a grid that is seen in one of them is no other board."""
    board = Board(columns=8, rows=6, square=0.025)
    whole = "a board of 9x6 inner corners was found, not 8x6: give --board 9x6"
    gray = np.full((60, 80), 128, np.uint8)
    failed = [(gray, whole), (gray, whole.replace("9x6", "11x7"))]
    failed += 4 * [(gray, "a grid of 9x6 inner corners was found, larger than 8x6"), (gray, "too blurred")]
    assert seen_by_most(failed, board) == ("a board of 9x6 was found: give --board 9x6", 5)
    with pytest.raises(InputError) as caught:
        refuse_other_board(0, failed, 26, board)
    said = "(5 of them: a board of 9x6 was found: give --board 9x6)"
    assert str(caught.value) == f"no board in the first 10 of 26 images {said}"
    with pytest.raises(InputError, match="is in 1 of 11 images only; in 5 of them a board of 9x6"):
        refuse_other_board(1, failed, 11, board)
    refuse_other_board(2, failed, 12, board)


def test_a_wrong_size_ends_the_search_early(kcal_data: Path) -> None:
    """It took 291 s, gave two false views and said "give --board 11x7 … give --board 3x3"."""
    searched: list[str] = []
    images = sorted((kcal_data / "opencv_stereo").glob("left*.jpg"))
    with pytest.raises(InputError, match=r"no board in the first 3 of 13 images .*: give --board 9x6\)$"):
        detect(images, Board(columns=8, rows=6, square=0.025), progress=searched.append)
    assert len(searched) == 2
