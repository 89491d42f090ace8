"""Images and videos as they are stored: colors in their order, 8 and 16 bits, refusals."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from kcal.corners.images import decode_image
from kcal.errors import FileError, InputError
from kcal.io.images import encode_png, write_png, write_video

DRAW = np.random.default_rng(1)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(4, 6), (4, 6, 3), (4, 6, 4)])
def test_a_png_comes_back_to_the_bit(shape: tuple[int, ...], kind: type, tmp_path: Path) -> None:
    image = DRAW.integers(0, np.iinfo(kind).max, shape, dtype=kind, endpoint=True)
    back = decode_image(write_png(tmp_path / "a.png", image).read_bytes(), "a.png")
    assert back.dtype == kind
    assert np.array_equal(back, image)


def test_red_is_first_and_transparency_last() -> None:
    """As another program reads it: OpenCV's order is blue, green, red."""
    image = np.zeros((2, 2, 4), np.uint8) + np.array([10, 20, 30, 40], np.uint8)
    stored = cv2.imdecode(np.frombuffer(encode_png(image), np.uint8), cv2.IMREAD_UNCHANGED)
    assert stored[0, 0].tolist() == [30, 20, 10, 40]


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((4, 6), np.float32), np.zeros((4, 6, 2), np.uint8), np.zeros((0, 6), np.uint8), np.zeros(6, np.uint8),
        np.zeros((4, 6, 5), np.uint8), np.zeros((2, 4, 6, 3), np.uint8),
    ],
)  # fmt: skip
def test_what_no_png_can_hold_is_refused(image: np.ndarray) -> None:
    with pytest.raises(InputError, match="an image"):
        encode_png(image)


def test_damaged_images_are_refused() -> None:
    data = encode_png(DRAW.integers(0, 255, (40, 60), dtype=np.uint8))
    with pytest.raises(FileError, match="here"):
        decode_image(data[:40], "here")
    done, floats = cv2.imencode(".tiff", np.ones((4, 6), np.float32))
    assert done
    with pytest.raises(FileError, match="8 or 16 bits"):
        decode_image(floats.tobytes(), "here")


def test_a_video_has_its_frames_at_their_times(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    frames = [np.full((32, 48), 40 * number, np.uint8) for number in range(5)]
    path = write_video(tmp_path / "a.mp4", iter(frames), 4, quality=0)
    with av.open(str(path)) as container:
        read = [(float(frame.time), frame.to_ndarray(format="gray")) for frame in container.decode(video=0)]
    assert [time for time, _ in read] == [0.0, 0.25, 0.5, 0.75, 1.0]
    for (_, image), frame in zip(read, frames, strict=True):
        assert image.shape == (32, 48)
        assert np.abs(image.astype(int) - frame).max() <= 1
    assert write_video(tmp_path / "b.mp4", iter(frames), 4, quality=0).read_bytes() == path.read_bytes()
