from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from kcal.errors import InputError
from kcal.io.images import write_png
from kcal.mark.guide import TILE, Pyramid, open_pictures, top_level


def noise(height: int, width: int, dtype: type = np.uint8) -> np.ndarray:
    return np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (height, width), dtype=dtype)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_tiles_are_the_image_and_its_means(dtype: type) -> None:
    image = noise(1300, 1100, dtype)
    pyramid = Pyramid(image)
    assert top_level(image.shape) == 2
    span = None if dtype is np.uint8 else (0.0, 65535.0)
    tile = pyramid.tile(0, 2, 1, span).astype(float)
    part = image[TILE : 2 * TILE, 2 * TILE :].astype(float) / (1 if span is None else 257)
    assert tile.shape == (512, 76)
    assert np.abs(tile - part).max() <= 0.5
    means = image[:1300, :1100].reshape(325, 4, 275, 4).mean((1, 3)) / (1 if span is None else 257)
    assert np.abs(pyramid.tile(2, 0, 0, span) - means).max() <= 1.01
    for bad in ((3, 0, 0), (0, 3, 0), (0, 0, -1)):
        with pytest.raises(InputError, match="no tile"):
            pyramid.tile(*bad)


def test_folders_are_paired_by_name(tmp_path: Path) -> None:
    for side, numbers in (("left", (1, 2, 3)), ("right", (2, 3, 4))):
        (tmp_path / side).mkdir()
        for number in numbers:
            write_png(
                tmp_path / side / f"{side}{number:02d}.png",
                np.full((20, 30), number, np.uint8) + np.eye(20, 30, dtype=np.uint8),
            )
    pictures = open_pictures(tmp_path / "left", tmp_path / "right")
    assert pictures.names == ("left02", "left03")
    assert pictures.image("right", 1)[5, 0] == 3
    with pytest.raises(InputError, match="no frame 2"):
        pictures.image("left", 2)


def test_videos_are_paired_by_frame(tmp_path: Path) -> None:
    for side, count in (("left", 5), ("right", 4)):
        video = cv2.VideoWriter(str(tmp_path / f"{side}.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
        for number in range(count):
            video.write(np.full((48, 64, 3), 40 * number + 20, np.uint8))
        video.release()
    pictures = open_pictures(tmp_path / "left.avi", tmp_path / "right.avi")
    assert len(pictures.names) == 4
    for number in (2, 0, 3, 1):
        assert abs(float(pictures.image("left", number).mean()) - (40 * number + 20)) < 3
    write_png(tmp_path / "one.png", noise(20, 30))
    with pytest.raises(InputError, match="two images, two folders or two videos"):
        open_pictures(tmp_path / "left.avi", tmp_path / "one.png")
