"""Write images and videos."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from kcal.errors import InputError
from kcal.files import open_atomic, write_atomic
from kcal.opencv import cv2

# Images in color or gray as PNG files; `kcal.corners.images` reads images.


def encode_png(image: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    """A PNG file's bytes of an image: gray (H, W), RGB (H, W, 3) or RGBA (H, W, 4), 8 or 16 bit.

    Raises:
        InputError: another dtype or shape.

    Example:
        >>> encode_png(np.zeros((4, 6, 3), np.uint8))[1:4]
        b'PNG'
    """
    fits = image.ndim == 2 or (image.ndim == 3 and image.shape[2] in (3, 4))
    if image.dtype not in (np.uint8, np.uint16) or not fits or image.size == 0:
        raise InputError(
            f"an image (H, W), (H, W, 3) or (H, W, 4) of uint8 or uint16 is needed, got {image.shape} of {image.dtype}"
        )
    # OpenCV's order of channels is blue, green, red.
    swapped: NDArray[Any] = image if image.ndim == 2 else image[..., [2, 1, 0, *range(3, image.shape[2])]]
    done, data = cv2.imencode(".png", np.ascontiguousarray(swapped))
    if not done:
        raise InputError(f"an image of shape {image.shape} cannot be encoded as PNG")
    return bytes(data.tobytes())


def write_png(path: str | Path, image: NDArray[np.uint8] | NDArray[np.uint16], *, note: str = "") -> Path:
    """Write an image as PNG, atomically; shapes and types as in `encode_png`.

    Args:
        path: of the file.
        image: to write.
        note: a comment (tEXt) at the beginning of the file, in Latin-1.

    Raises:
        InputError: another dtype or shape.
        FileError: the file cannot be written.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_png(Path(folder, "gray.png"), np.full((4, 6), 128, np.uint8)).name
        'gray.png'
    """
    data = encode_png(image)
    if note:
        # Behind the signature and the block IHDR, which have 33 bytes.
        block = b"tEXtComment\0" + note.encode("latin-1")
        data = b"".join(
            [data[:33], struct.pack(">I", len(block) - 4), block, struct.pack(">I", crc32(block)), data[33:]]
        )
    return write_atomic(path, data)


# Write videos: H.264 in MP4, by PyAV (the extra `video`).


def write_video(path: str | Path, frames: Iterable[NDArray[np.uint8]], rate: int, *, quality: int = 20) -> Path:
    """Write gray frames as a video, atomically; frame n has the time n / rate.

    Args:
        path: of the MP4 file.
        frames: (H, W) each, with even sides.
        rate: frames a second.
        quality: x264's constant rate factor: 0 without losses, 23 as cameras do it.

    Raises:
        ImportError: PyAV is not installed.
        FileError: the file cannot be written.
    """
    import av

    with open_atomic(path) as file, av.open(file, "w", format="mp4") as container:
        stream = None
        for number, image in enumerate(frames):
            if stream is None:
                # A key frame every ten seconds.
                settings = {"crf": str(quality), "preset": "veryfast", "g": str(10 * rate)}
                stream = container.add_stream("libx264", rate=rate, options=settings)
                stream.width, stream.height, stream.pix_fmt = image.shape[1], image.shape[0], "yuvj420p"
                # The same bytes on every machine: x264 compresses otherwise with another number of threads.
                stream.codec_context.thread_count = 1
            frame = av.VideoFrame.from_ndarray(image, format="gray")
            frame.pts, frame.time_base = number, Fraction(1, rate)
            container.mux(stream.encode(frame))
        if stream is not None:
            container.mux(stream.encode())
    return Path(path)
