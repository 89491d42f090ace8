"""Images of boards: how they are read, resized and turned, and what is told of those without the board."""

import os
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import ExifTags, Image

from kcal import Board, FileError, InputError
from kcal.corners import detect as module
from kcal.corners.circles import find_circles
from kcal.corners.detect import detect, refuse_other_board, seen_by_most, too_few
from kcal.corners.images import decode_gray, expand_images, image_time, read_gray, to_8bit, unique_names
from kcal.corners.markers import opencv_dictionary
from kcal.corners.observations import View, common_size, rescaled, resized_alike
from kcal.corners.recognize import has_own_markers, seen_circles, seen_instead, seen_markers, seen_size
from kcal.corners.refine import refine_corners
from kcal.corners.saddle import CornerStatus, Refined
from kcal.corners.search import NotFoundError
from kcal.corners.video import VideoFrames


@pytest.fixture
def picture():
    y, x = np.mgrid[:120, :160]
    rng = np.random.default_rng(0)
    gray = np.where((x // 20 + y // 20) % 2 == 0, 60, 200) + rng.normal(0, 8, x.shape)
    return np.clip(gray, 0, 255).astype(np.uint8)


def encoded(picture, suffix, *options):
    return cv2.imencode(suffix, picture, list(options))[1].tobytes()


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".bmp", ".pgm"])
def test_lossless_formats_are_exact(picture, suffix):
    assert (decode_gray(encoded(picture, suffix), "x") == picture).all()


def test_sixteen_bits_stay_sixteen(picture, tmp_path):
    deep = picture.astype(np.uint16) * 200 + 7
    for suffix in (".png", ".tiff"):
        (tmp_path / f"deep{suffix}").write_bytes(encoded(deep, suffix))
        image = read_gray(tmp_path / f"deep{suffix}")
        assert image.dtype == np.uint16
        assert (image == deep).all()


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.999])
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tiff", ".bmp", ".webp"])
def test_truncated_files_are_refused(picture, suffix, share, capfd):
    data = encoded(picture, suffix)
    with pytest.raises(FileError, match=r"cut\.img: .*(truncated|not an image)"):
        decode_gray(data[: int(len(data) * share)], "cut.img")
    assert capfd.readouterr().err == ""  # no decoder talks to the user


@pytest.mark.skipif(sys.platform == "win32", reason="libjpeg's messages cannot be caught there")
def test_jpeg_that_the_decoder_would_fill_with_gray_is_refused(picture, capfd):
    data = encoded(picture, ".jpg", cv2.IMWRITE_JPEG_QUALITY, 95)
    patched = data[: len(data) // 2] + b"\xff\xd9"
    assert cv2.imdecode(np.frombuffer(patched, np.uint8), cv2.IMREAD_GRAYSCALE) is not None  # OpenCV says nothing
    capfd.readouterr()
    with pytest.raises(FileError, match="Corrupt JPEG data"):
        decode_gray(patched, "patched.jpg")
    assert capfd.readouterr().err == ""


def test_spare_bytes_before_the_end_of_a_jpeg_are_harmless(picture):
    data = encoded(picture, ".jpg")
    assert (decode_gray(data[:-2] + bytes(17) + data[-2:], "x") == decode_gray(data, "x")).all()


def test_decoding_without_an_error_stream(picture):
    saved = os.dup(2)
    os.close(2)
    try:
        image = decode_gray(encoded(picture, ".png"), "x")
    finally:
        os.dup2(saved, 2)
        os.close(saved)
    assert (image == picture).all()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (b"these are words, no image", "not an image"),
        (encoded(np.arange(64, dtype=np.uint8).reshape(8, 8), ".png"), "8x8 pixels are too few"),
        (encoded(np.full((50, 50), 128, np.uint8), ".png"), "same gray level"),
        (encoded(np.random.default_rng(0).random((50, 50), np.float32), ".tiff"), "float32"),
    ],
)
def test_useless_files_say_why(tmp_path, content, message):
    path = tmp_path / "x.png"
    path.write_bytes(content)
    with pytest.raises(FileError, match=message) as caught:
        read_gray(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(FileError, match="No such file"):
        read_gray(tmp_path / "none.png")
    with pytest.raises(FileError, match=r"directory|Permission"):
        read_gray(tmp_path)


def test_to_8bit_ignores_hot_pixels_and_keeps_order():
    deep = np.linspace(300, 4000, 10000).astype(np.uint16).reshape(100, 100)
    clean = to_8bit(deep).astype(int)
    assert clean.min() == 0
    assert clean.max() == 255
    assert (np.diff(clean.reshape(-1)) >= 0).all()
    deep[50, 50] = 65535
    # One hot pixel moves the 99.9 % level by one pixel's share of the range.
    assert np.abs(np.delete(to_8bit(deep).astype(int) - clean, 50, 0)).max() <= 1


def test_to_8bit_of_almost_flat_image():
    deep = np.full((100, 100), 1000, np.uint16)
    deep[0, 0] = 1200
    assert to_8bit(deep)[0, 0] == 255
    assert to_8bit(deep)[1, 1] == 0


def test_to_8bit_uses_the_whole_scale_for_two_neighboring_levels():
    assert to_8bit(np.array([[7, 8], [8, 7]], np.uint16)).tolist() == [[0, 255], [255, 0]]


def test_expand_folders_wildcards_and_files(tmp_path):
    for name in ("b10.png", "b9.PNG", "b1.jpg", "notes.txt", ".hidden.png"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "deeper").mkdir()
    (tmp_path / "deeper" / "c.png").write_bytes(b"x")
    assert [path.name for path in expand_images([tmp_path])] == ["b1.jpg", "b9.PNG", "b10.png"]
    assert [path.name for path in expand_images([f"{tmp_path}/b*"])] == ["b1.jpg", "b9.PNG", "b10.png"]
    assert [path.name for path in expand_images([f"{tmp_path}/**/*.png"])] == ["b10.png", "c.png"]
    twice = expand_images([tmp_path / "b10.png", tmp_path, tmp_path / "deeper" / ".." / "b9.PNG"])
    assert [path.name for path in twice] == ["b10.png", "b1.jpg", "b9.PNG"]


def test_a_file_with_brackets_is_no_wildcard(tmp_path):
    (tmp_path / "a[1].png").write_bytes(b"x")
    assert expand_images([tmp_path / "a[1].png"]) == [tmp_path / "a[1].png"]


def test_expand_errors(tmp_path):
    with pytest.raises(FileError, match="no image in this folder"):
        expand_images([tmp_path])
    with pytest.raises(FileError, match="no file matches"):
        expand_images([tmp_path / "*.png"])
    with pytest.raises(FileError, match="no such file"):
        expand_images([tmp_path / "x.png"])
    with pytest.raises(InputError, match="no images given"):
        expand_images([])


def test_unique_names(tmp_path):
    paths = [tmp_path / "l" / "1.png", tmp_path / "r" / "1.png", tmp_path / "r" / "2.png"]
    assert unique_names(paths) == ["l/1.png", "r/1.png", "2.png"]
    assert unique_names([]) == []


# Images of one camera that were resized alike: their corners, covariances and what is said of them.


BOARD = Board(columns=6, rows=5, square=0.02)


def checkerboard(side: int, left: int, top: int, size: tuple[int, int]) -> np.ndarray:
    """An image with squares of `side` px whose first one begins at (left, top); edges lie between pixels."""
    y, x = np.mgrid[: size[1], : size[0]]
    column, row = (x - left) // side, (y - top) // side
    on = (x >= left) & (y >= top) & (column <= BOARD.columns) & (row <= BOARD.rows)
    return np.where(on & ((column + row) % 2 == 0), 40, 220).astype(np.uint8)


@pytest.fixture
def folder(tmp_path):
    """Two whole images and one a third as large, in each direction."""
    for name, left in (("a", 90), ("b", 120)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), checkerboard(60, left, 90, (720, 540)))
    whole = checkerboard(60, 150, 120, (720, 540))
    cv2.imwrite(str(tmp_path / "c.png"), cv2.resize(whole, (240, 180), interpolation=cv2.INTER_AREA))
    return tmp_path


def test_corners_of_a_smaller_image_are_those_of_the_whole_one(folder) -> None:
    notes: list[str] = []
    seen = detect([folder / f"{name}.png" for name in "abc"], BOARD, note=notes.append)
    assert seen.image_size == (720, 540)
    # Edges of squares, between pixels: corner (1, 1) of the squares from (150, 120).
    first = torch.tensor([150.0 + 60.0 - 0.5, 120.0 + 60.0 - 0.5], dtype=torch.float64)
    torch.testing.assert_close(seen.pixels()[2, 0], first, rtol=0, atol=0.05)
    torch.testing.assert_close(seen.pixels()[2] - seen.pixels()[0], torch.tensor([60.0, 30.0]).double().expand(30, 2),
                               rtol=0, atol=0.06)  # fmt: skip
    assert notes == [
        "images of several sizes: corners were scaled to 720x540 px of most images: c.png from 240x180 px by 3"
    ]
    small, large = detect([folder / "c.png"], BOARD).covariances(), seen.covariances()
    torch.testing.assert_close(large[2], 9.0 * small[0], rtol=1e-9, atol=0)


def test_it_is_never_silent(folder) -> None:
    with pytest.warns(UserWarning, match="scaled to 720x540"):
        detect([folder / f"{name}.png" for name in "abc"], BOARD)


def test_most_images_decide_and_then_the_largest() -> None:
    sizes = [(640, 360), (1920, 1080), None, (640, 360)]
    found = common_size("abcd", sizes)
    assert found.size == (640, 360)
    assert found.scales == {1: (1 / 3, 1 / 3)}
    assert found.notes[0].endswith("b from 1920x1080 px by 0.3333")
    assert common_size("ab", sizes[:2]).size == (1920, 1080)
    assert common_size("ad", [(640, 360), (640, 360)]) == ((640, 360), {}, {}, ())


@pytest.mark.parametrize(
    ("one", "other", "alike"),
    [
        ((1500, 1000), (640, 427), True),
        ((1500, 1000), (640, 426), True),
        ((1500, 1000), (640, 425), False),
        ((6016, 4016), (3008, 2008), True),
        ((640, 480), (640, 360), False),
        ((640, 480), (480, 640), False),
        ((640, 480), (639, 479), False),
        ((640, 480), (640, 479), False),
    ],
)
def test_which_sizes_are_alike(one, other, alike) -> None:
    assert resized_alike(one, other) is alike
    assert resized_alike(other, one) is alike


def test_sides_that_were_rounded_have_scales_of_their_own() -> None:
    found = common_size("aab", [(1500, 1000), (1500, 1000), (640, 427)])
    assert found.scales == {2: (1500 / 640, 1000 / 427)}
    view = rescaled(
        View(name="b", pixels=((-0.5, -0.5), (639.5, 426.5)), covariance=((1, 0.5, 2),) * 2), found.scales[2]
    )
    assert view.pixels == ((-0.5, -0.5), (1499.5, 999.5))
    assert view.covariance[0] is not None
    x, y = found.scales[2]
    assert view.covariance[0] == pytest.approx((x * x, 0.5 * x * y, 2.0 * y * y))


@pytest.mark.parametrize(
    ("sizes", "left_out"),
    [
        ([(640, 480), (640, 480), (640, 360)], "640x360 px, not the 640x480 px of most images: cropped or of another"),
        ([(640, 480), (640, 480), (480, 640)], "480x640 px, not the 640x480 px of most images: turned by 90 degrees"),
        ([(640, 480), (320, 240), (240, 320)], "240x320 px, not the 640x480 px of most images: turned by 90 degrees"),
        ([(1281, 721), (1280, 720), (1280, 724)], "1280x724 px, not the 1281x721 px"),
    ],
)
def test_what_is_left_out(sizes, left_out) -> None:
    found = common_size("abc", sizes)
    assert found.size == sizes[0]
    assert list(found.left_out) == [2]
    assert found.left_out[2].startswith(left_out)
    assert found.notes[-1].startswith("1 of 3 images were left out, because their size is not")


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        (
            [(640, 480), (640, 360)],
            r"1 of 640x480 px \(a\); 1 of 640x360 px \(b\); detect those of each size",
        ),
        ([(640, 480), (480, 640), None], "turn back those that were turned by 90 degrees, or detect"),
        ([(640, 480), (640, 480), (640, 360), (500, 360)], "none has more than half: 2 of 640x480"),
    ],
)
def test_no_size_of_most_is_refused_with_counts(sizes, message) -> None:
    with pytest.raises(InputError, match=message):
        common_size("abcd"[: len(sizes)], sizes)
    assert common_size("ab", [None, None]).size == (0, 0)


def test_sizes_are_read_before_anything_is_searched(folder, monkeypatch) -> None:
    """A pixel or two more is the same camera; an image of another size costs no search, and the rest is there."""
    whole = checkerboard(60, 150, 90, (721, 541))
    cv2.imwrite(str(folder / "d.png"), whole)
    cv2.imwrite(str(folder / "foreign.jpg"), whole[:400])
    searched, find, notes = [], module.detect_board, []
    monkeypatch.setattr(module, "detect_board", lambda image, *rest: searched.append(image.shape) or find(image, *rest))
    seen = detect([folder / name for name in ("foreign.jpg", "a.png", "b.png", "d.png")], BOARD, note=notes.append)
    assert searched == [(540, 720), (540, 720), (541, 721)]
    assert (seen.names, seen.image_size) == (("a.png", "b.png", "d.png"), (720, 540))
    assert [failure.name for failure in seen.failures] == ["foreign.jpg"]
    assert [text.split(";")[0] for text in notes] == [
        "images of 721x541 px were taken as they are among the 720x540 px of most images",
        "1 of 4 images were left out, because their size is not the 720x540 px of most images: foreign.jpg",
    ]
    first = torch.tensor([150.0 + 60.0 - 0.5, 90.0 + 60.0 - 0.5], dtype=torch.float64)
    torch.testing.assert_close(seen.pixels()[2, 0], first, rtol=0, atol=0.05)
    with pytest.raises(InputError, match="1 of 721x400 px"):
        detect([folder / name for name in ("foreign.jpg", "a.png")], BOARD)
    assert len(searched) == 3


# What is told of images without the board: which other one they show, why few corners are good, and their times.


BLANK = np.full((200, 240), 230, np.uint8)


def instead(image: np.ndarray, board: Board, size: tuple[int, int] | None) -> str:
    """What is told where the largest grid of the image has a size."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("kcal.corners.recognize.seen_size", lambda _: size)
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
        assert instead(BLANK, Board(columns=6, rows=9, square=0.025), found) == told

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
        assert "3 to 60 of dictionary 5x5_100" in seen_markers(markers("5x5_250", 3, 60, 7, 9), self.BOARD)

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
        assert other.startswith("some 12 circles were found, the board has 16")
        few = r"no grid of 7x6 circles found \(12 round blobs seen, 42 are needed, all in the image\)"
        with pytest.raises(NotFoundError, match=few):
            find_circles(twelve, Board.parse("circles:7x6", "25mm"))

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
        # Nanoseconds; thousandths of a telephone; a zone; three digits that may be a number are not read.
        ("2026-01-01T00-00-01.123456789.png", 1767225601.123456789), ("PXL_20260101_000001123.jpg", 1767225601.123),
        ("20260101T020000.5+0200.png", 1767225600.5), ("20251231T223000-01:30.png", 1767225600.0),
        ("20260101_000000_123.png", 1767225600.0),
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
