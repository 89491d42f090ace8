"""Heads of image files."""

import io
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from kcal.corners.images import decode_image, read_gray
from kcal.errors import FileError
from kcal.file_kind import _FORMATS, check_image_header, is_image

# The size of an image is known, and refused, before anything is decoded.


LEVELS = np.random.default_rng(0).integers(0, 255, (37, 53), np.uint8)


def size_of(data: bytes) -> tuple[int, int]:
    return next(read for start, read in _FORMATS.items() if data.startswith(start))(data)


def png_header(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    pixels = zlib.compress(b"\0" * 1000)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".bmp", ".pgm", ".ppm", ".jp2"])
@pytest.mark.parametrize("image", [LEVELS, np.stack([LEVELS] * 3, -1)], ids=["gray", "color"])
def test_sizes_are_those_of_the_decoder(suffix: str, image: np.ndarray) -> None:
    if suffix in (".pgm", ".ppm"):
        image = LEVELS if suffix == ".pgm" else np.stack([LEVELS] * 3, -1)
    data = cv2.imencode(suffix, image)[1].tobytes()
    assert size_of(data) == (53, 37)
    check_image_header(data, "x")
    for cut in (0, 2, 6):
        with pytest.raises(FileError, match=r"not an image|truncated or corrupt|the file is empty"):
            check_image_header(data[:cut], "x")


@pytest.mark.parametrize(
    "options", [{"format": "TIFF", "big_tiff": True}, {"format": "TIFF", "compression": "tiff_lzw"}, {"format": "JPEG"}]
)
def test_sizes_of_files_of_other_programs(options: dict[str, object]) -> None:
    data = io.BytesIO()
    Image.fromarray(LEVELS).save(data, **options)  # type: ignore[arg-type]
    assert size_of(data.getvalue()) == (53, 37)


def test_a_jpeg_with_a_thumbnail_and_comments() -> None:
    data = cv2.imencode(".jpg", LEVELS)[1].tobytes()
    small = cv2.imencode(".jpg", LEVELS[:16, :16])[1].tobytes()
    block = b"\xff\xe1" + struct.pack(">H", len(small) + 2) + small
    assert size_of(data[:2] + block + b"\xff\xff\xfe\0\4ab" + data[2:]) == (53, 37)
    commented = b"P5 # a comment\n# 9 9\n53 37\n255\n" + LEVELS.tobytes()
    assert size_of(commented) == (53, 37)
    assert np.array_equal(decode_image(commented, "x"), LEVELS)


def test_webp_is_read(tmp_path: Path) -> None:
    path = tmp_path / "x.webp"
    cv2.imwrite(str(path), LEVELS, [cv2.IMWRITE_WEBP_QUALITY, 101])
    assert read_gray(path).shape == LEVELS.shape


def test_too_many_pixels_are_refused_before_memory_is_taken(tmp_path: Path) -> None:
    """In a process of its own, because the peak of memory is counted per process."""
    (tmp_path / "huge.png").write_bytes(png_header(30_000, 30_000))
    code = (
        "import resource, sys\nfrom kcal.corners.images import read_gray\nfrom kcal.errors import FileError\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "try: read_gray(sys.argv[1])\nexcept FileError as error: print(error)\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "huge.png")], capture_output=True, text=True, check=True
    )
    said, grown = done.stdout.splitlines()
    assert said.endswith("huge.png: 30000x30000 pixels; an image may have at most 500 megapixels")
    assert int(grown) < 50_000 * (1024 if sys.platform == "darwin" else 1)


@pytest.mark.parametrize(
    "data",
    [
        png_header(2**31 - 1, 2**31 - 1),
        cv2.imencode(".jpg", LEVELS)[1].tobytes().replace(b"\0\x25\0\x35", b"\xff\xff\xff\xff"),
        b"BM" + bytes(12) + struct.pack("<Iii", 40, 100_000, -100_000) + bytes(40),
        b"P5 60000 60000 255 ",
        struct.pack("<2sHIHHHIIHHII", b"II", 42, 8, 2, 256, 4, 1, 90_000, 257, 4, 1, 90_000),
    ],
    ids=["png", "jpeg", "bmp", "pgm", "tiff"],
)
def test_every_format_is_limited(data: bytes) -> None:
    for read in (check_image_header, decode_image):
        with pytest.raises(FileError, match=r"^x: \d+x\d+ pixels; an image may have at most 500 megapixels$"):
            read(data, "x")


@pytest.mark.parametrize("data", [b"v/1\x01 EXR", b"#?RADIANCE\n", b"GIF89a", b"\x59\xa6\x6a\x95", b"P7\nWIDTH 9"])
def test_decoders_that_cameras_do_not_need_are_not_reached(data: bytes) -> None:
    with pytest.raises(FileError, match="not an image that can be read"):
        check_image_header(data + bytes(100), "x")


# Sizes in headers written by hand: byte orders, kinds of numbers and origins that encoders here do not write.


def tiff(order: str, big: bool, entries: list[tuple[int, int, int]], pad: int = 4) -> bytes:
    """A TIFF with one directory after `pad` bytes: entries of tag, kind and value."""
    letters = {3: "H", 4: "I", 16: "Q"}
    mark = b"II" if order == "<" else b"MM"
    size, wide, short = (8, "Q", "Q") if big else (4, "I", "H")
    begin = struct.pack(f"{order}HHHQ", 43, 8, 0, 16 + pad) if big else struct.pack(f"{order}HI", 42, 8 + pad)
    data = mark + begin + bytes(pad) + struct.pack(f"{order}{short}", len(entries))
    for tag, kind, value in entries:
        data += struct.pack(f"{order}HH{wide}", tag, kind, 1)
        data += (struct.pack(f"{order}{letters[kind]}", value) if kind in letters else b"").ljust(size, b"\0")
    return data


def jpeg2000(right: int, bottom: int, left: int, top: int) -> bytes:
    return b"\xff\x4f\xff\x51" + struct.pack(">HHIIII", 47, 0, right, bottom, left, top) + bytes(30)


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
    assert size_of(data) == (53, 37)
    check_image_header(data, "x")
    assert is_image(data)


def test_what_has_no_size_is_truncated() -> None:
    short = tiff("<", False, [(256, 3, 53), (257, 3, 37)])[:-12]
    for data in (short, b"P5 53", b"\xff\xd8\xff\xda", jpeg2000(1, 1, 0, 0)[:20]):
        with pytest.raises(FileError, match="x: the image is truncated or corrupt"):
            check_image_header(data, "x")


def test_words_are_no_images() -> None:
    words = b"BMW is a car, and much more than thirty letters", b"P5 is a title", b"BM" + bytes(40), b"GIF89a", b""
    assert not any(map(is_image, (*words, b"P5 0 5 255 ", b"P5 1048576 5 255 ")))
    # A cut picture is a picture.
    assert all(map(is_image, (b"P5 1048575 1 255 ", b"\xff\xd8")))


def test_a_png_of_more_pixels_than_its_bytes_can_have() -> None:
    """One damaged byte of its size: 320 megapixels of 79 bytes were decoded for 12 s."""

    def png(width: int, height: int, size: int) -> bytes:
        return (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + struct.pack(">II", width, height)).ljust(size, b"\0")

    check_image_header(png(8 * 1032, 100, 100), "x")
    with pytest.raises(FileError, match="truncated or corrupt"):
        check_image_header(png(8 * 1032 + 1, 100, 100), "x")
    with pytest.raises(FileError, match="at most 500 megapixels"):
        check_image_header(png(25_000, 20_001, 100), "x")
