"""Raw images are developed so that no pixel moves. A DNG is written here, with a mosaic of colored pixels."""

import struct
from pathlib import Path

import numpy as np
import pytest

from kcal import Board, FileError, detect
from kcal.corners.images import decode_gray, decode_image, image_header, read_gray
from kcal.file_kind import file_kind
from kcal.io.images import write_png
from tests.corners.test_recognize import TILTS, shots

pytest.importorskip("rawpy", reason="the extra images is not installed")
GAINS, BLACK, WHITE = (0.5, 1.0, 0.7), 256, 16383
# How struct writes a value of each of TIFF's kinds.
FORMS = {1: "B", 2: "s", 3: "H", 4: "I", 5: "I", 10: "i"}


def dng(mosaic: np.ndarray, orientation: int = 1) -> bytes:
    """An uncompressed DNG 1.4 of a mosaic RGGB; tags as in Adobe's specification, in ascending order."""
    height, width = mosaic.shape
    neutral = [number for gain in GAINS for number in (int(100 * gain), 100)]
    matrix = [number for value in np.eye(3).ravel() for number in (int(1e4 * value), 10000)]
    data = mosaic.astype("<u2").tobytes()
    tags = [
        (254, 4, [0]), (256, 4, [width]), (257, 4, [height]), (258, 3, [16]), (259, 3, [1]), (262, 3, [32803]),
        (271, 2, b"kcal\0"), (272, 2, b"test\0"), (273, 4, [0]), (274, 3, [orientation]), (277, 3, [1]),
        (278, 4, [height]), (279, 4, [len(data)]), (284, 3, [1]), (33421, 3, [2, 2]), (33422, 1, [0, 1, 1, 2]),
        (50706, 1, [1, 4, 0, 0]), (50707, 1, [1, 1, 0, 0]), (50708, 2, b"kcal test\0"), (50714, 3, [BLACK]),
        (50717, 4, [WHITE]), (50721, 10, matrix), (50728, 5, neutral), (50778, 3, [21]),
    ]  # fmt: skip
    first = 8 + 2 + 12 * len(tags) + 4
    values = [value if isinstance(value, bytes) else struct.pack(f"<{len(value)}{FORMS[kind]}", *value)
              for _, kind, value in tags]  # fmt: skip
    place = first + sum(len(value) + len(value) % 2 for value in values if len(value) > 4)
    entries, beside = b"", b""
    for (tag, kind, value), packed in zip(tags, values, strict=True):
        count = len(value) // (2 if kind in (5, 10) else 1)
        inside = struct.pack("<I", place) if tag == 273 else packed.ljust(4, b"\0")
        if len(packed) > 4:
            inside = struct.pack("<I", first + len(beside))
            beside += packed + b"\0" * (len(packed) % 2)
        entries += struct.pack("<HHI", tag, kind, count) + inside
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4) + beside + data


def mosaic(picture: np.ndarray) -> np.ndarray:
    """What a sensor whose colors are not equally sensitive sees of a gray picture."""
    light = picture.astype(float) / 255
    for row, column, gain in ((0, 0, GAINS[0]), (1, 1, GAINS[2])):
        light[row::2, column::2] *= gain
    return np.rint(BLACK + light * (WHITE - BLACK))


def test_corners_are_those_of_the_same_picture_as_png(tmp_path: Path) -> None:
    board = Board.parse("9x6", "25mm")
    picture = shots(board, 0.4, TILTS[0])[0]
    write_png(tmp_path / "a.png", picture)
    (tmp_path / "b.dng").write_bytes(dng(mosaic(picture)))
    seen = detect([tmp_path / "a.png", tmp_path / "b.dng"], board, note=lambda _: None)
    one, other = (np.array(view.pixels, float) for view in seen.views)
    off = np.linalg.norm(one - other, axis=1)
    assert off.max() < 0.03
    assert np.abs((one - other).mean(0)).max() < 0.003
    # A quarter of a pixel, which a mosaic read as it is would be off, is more than both.
    assert len(off) == 54


def test_levels_are_linear_and_white_is_gray(tmp_path: Path) -> None:
    ramp = np.tile(np.linspace(10, 250, 64), (48, 1))
    colors = decode_image(dng(mosaic(ramp)), "a.dng")
    assert (colors.dtype, colors.shape) == (np.uint16, (48, 64, 3))
    assert np.abs(colors[4:-4, 4:-4].astype(float) / 65535 - ramp[4:-4, 4:-4, None] / 255).max() < 2e-3
    (tmp_path / "a.dng").write_bytes(dng(mosaic(ramp)))
    gray = read_gray(tmp_path / "a.dng")
    assert (gray.dtype, gray.shape) == (np.uint16, (48, 64))
    assert file_kind(tmp_path / "a.dng") == "image"


@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_it_is_as_the_sensor_wrote_it(orientation: int) -> None:
    picture = np.add.outer(2.0 * np.arange(48), 1.5 * np.arange(64)) + 20
    data = dng(mosaic(picture), orientation)
    assert image_header(data, "a.DNG") == (64, 48)
    assert np.array_equal(decode_gray(data, "a.DNG"), decode_gray(dng(mosaic(picture)), "a.dng"))


def test_damaged_ones_are_refused() -> None:
    data = dng(mosaic(np.full((48, 64), 99.0)))
    for broken in (data[:200], data[:-2000], b""):
        with pytest.raises(FileError, match=r"a\.nef: a raw image that LibRaw cannot read"):
            decode_gray(broken, "a.nef")


def test_colors_are_interpolated_linearly() -> None:
    """Methods that follow edges are not linear, and shift edges by what lies beside them."""
    draw = np.random.default_rng(3)
    one, other = (draw.integers(0, 256, (48, 64)).astype(float) for _ in range(2))
    mixed = decode_image(dng(mosaic(0.5 * (one + other))), "a.dng").astype(float)
    both = [decode_image(dng(mosaic(picture)), "a.dng").astype(float) for picture in (one, other)]
    assert np.abs(mixed - 0.5 * (both[0] + both[1])).max() < 20  # of 65535: levels are rounded to 14 bits
