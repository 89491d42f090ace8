"""Sizes in headers written by hand: byte orders, kinds of numbers and origins that encoders here do not write."""

from __future__ import annotations

import struct

import pytest

from kcal.errors import FileError
from kcal.file_kind import _FORMATS, check_image_header, is_image


def tiff(order: str, big: bool, entries: list[tuple[int, int, int]], pad: int = 4) -> bytes:
    """A TIFF with one directory after `pad` bytes: entries of tag, kind and value."""
    letters = {3: "H", 4: "I", 16: "Q"}
    mark = b"II" if order == "<" else b"MM"
    size = 8 if big else 4
    if big:
        data = (
            mark + struct.pack(f"{order}HHHQ", 43, 8, 0, 16 + pad) + bytes(pad) + struct.pack(f"{order}Q", len(entries))
        )
    else:
        data = mark + struct.pack(f"{order}HI", 42, 8 + pad) + bytes(pad) + struct.pack(f"{order}H", len(entries))
    for tag, kind, value in entries:
        count = struct.pack(f"{order}Q" if big else f"{order}I", 1)
        data += struct.pack(f"{order}HH", tag, kind) + count
        data += (struct.pack(f"{order}{letters[kind]}", value) if kind in letters else b"").ljust(size, b"\0")
    return data


def jpeg2000(right: int, bottom: int, left: int, top: int) -> bytes:
    return b"\xff\x4f\xff\x51" + struct.pack(">HHIIII", 47, 0, right, bottom, left, top) + bytes(30)


SIZE = (53, 37)


@pytest.mark.parametrize(
    "data",
    [
        tiff("<", False, [(254, 4, 0), (256, 3, 53), (257, 4, 37), (258, 3, 8)]),
        tiff(">", False, [(256, 3, 53), (257, 3, 37), (259, 7, 0)]),
        tiff("<", True, [(257, 16, 37), (256, 16, 53)], pad=0),
        tiff(">", True, [(256, 4, 53), (257, 3, 37), (258, 3, 8)]),
        jpeg2000(58, 44, 5, 7),
        b"\0\0\0\x0cjP  \r\n" + bytes(20) + jpeg2000(53, 37, 0, 0),
        b"BM" + bytes(12) + struct.pack("<IHH", 12, 53, 37),
        b"BM" + bytes(12) + struct.pack("<Iii", 40, 53, -37),
        b"BM" + bytes(12) + struct.pack("<Iii", 40, -53, 37),
        b"\xff\xd8\xff\xc4\0\4ab\xff\xff\xc2\0\x11\x08" + struct.pack(">HH", 37, 53),
        b"\xff\xd8\xff\xcc\0\3a\xff\xc0\0\x11\x08" + struct.pack(">HH", 37, 53),
        b"\xff\xd8\xff\xc8\0\3a\xff\xcf\0\x11\x08" + struct.pack(">HH", 37, 53),
        b"P4 #\n53\n#9 9\n 37 ",
    ],
)
def test_sizes(data: bytes) -> None:
    read = next(read for start, read in _FORMATS.items() if data.startswith(start))
    assert read(data) == SIZE
    check_image_header(data, "x")
    assert is_image(data)


def test_what_has_no_size_is_truncated() -> None:
    for data in (
        tiff("<", False, [(256, 3, 53), (257, 3, 37)])[:-12],
        b"P5 53",
        b"\xff\xd8\xff\xda",
        jpeg2000(1, 1, 0, 0)[:20],
    ):
        with pytest.raises(FileError, match="x: the image is truncated or corrupt"):
            check_image_header(data, "x")


def test_words_are_no_images() -> None:
    for data in (
        b"BMW is a car, and much more than thirty letters",
        b"P5 is a title",
        b"BM" + bytes(40),
        b"GIF89a",
        b"",
    ):
        assert not is_image(data)
    assert not is_image(b"P5 0 5 255 ")
    assert not is_image(b"P5 1048576 5 255 ")
    assert is_image(b"P5 1048575 1 255 ")
    # A cut picture is a picture.
    assert is_image(b"\xff\xd8")


def test_a_png_of_more_pixels_than_its_bytes_can_have() -> None:
    def png(width: int, height: int, size: int) -> bytes:
        return (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + struct.pack(">II", width, height)).ljust(size, b"\0")

    check_image_header(png(8 * 1032, 100, 100), "x")
    with pytest.raises(FileError, match="truncated or corrupt"):
        check_image_header(png(8 * 1032 + 1, 100, 100), "x")
    with pytest.raises(FileError, match="at most 500 megapixels"):
        check_image_header(png(25_000, 20_001, 100), "x")
