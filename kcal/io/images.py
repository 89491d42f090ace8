"""Writing images. Reading them, with all that can go wrong, is `kcal.corners.images`."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from kcal.errors import FileError, InputError
from kcal.files import write_atomic


def write_png(path: str | Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> Path:
    """Write a grey image (H, W), 8 or 16 bit, as PNG, atomically.

    Raises:
        InputError: another dtype or shape.
        FileError: the file cannot be written.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_png(Path(folder, "grey.png"), np.full((4, 6), 128, np.uint8)).name
        'grey.png'
    """
    if image.dtype not in (np.uint8, np.uint16) or image.ndim != 2 or image.size == 0:
        raise InputError(f"an image (H, W) of uint8 or uint16 is needed, got {image.shape} of {image.dtype}")
    done, data = cv2.imencode(".png", image)
    if not done:
        raise FileError(f"{path}: the image cannot be encoded")
    return write_atomic(path, data.tobytes())
