import os
import sys

import cv2
import numpy as np
import pytest

from kcal.corners.images import decode_gray, expand_images, read_gray, to_8bit, unique_names
from kcal.errors import FileError, InputError


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


def test_exif_orientation_is_ignored(picture):
    # APP1 segment: TIFF header and one tag, 0x0112 (orientation) = 6 (turn by 90 degrees).
    tiff = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
    body = b"Exif\0\0" + tiff
    plain = encoded(picture, ".jpg")
    turned = plain[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + plain[2:]
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_GRAYSCALE).shape == (160, 120)  # the tag works
    assert (decode_gray(turned, "x") == decode_gray(plain, "x")).all()


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
