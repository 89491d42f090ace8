"""Write videos: H.264 in MP4, by PyAV (the extra `video`)."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kcal.files import open_atomic


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
