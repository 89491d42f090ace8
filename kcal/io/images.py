"""Images in color or gray: PNG files written, any image file's bytes to pixels.

Whether a file is whole (JPEG decoders only mutter about damage) is found out by `kcal.corners.images.decode_gray`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kcal.errors import FileError, InputError
from kcal.files import write_atomic
from kcal.image_header import check_image_header


def decode_image(data: bytes, source: str | Path) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Decode an image file's bytes as stored: gray (H, W), RGB (H, W, 3) or RGBA (H, W, 4), uint8 or uint16.

    The EXIF orientation is ignored: row 0 is the row the sensor read first, because the lens does not turn with it.

    Raises:
        FileError: not an image, more than 500 megapixels, or pixels other than 8 or 16 bits unsigned; `source` names
            it.

    Example:
        >>> colors = np.zeros((4, 6, 3), np.uint16) + np.array([1, 2, 65535], np.uint16)
        >>> decode_image(encode_png(colors), "memory")[0, 0].tolist()
        [1, 2, 65535]
    """
    check_image_header(data, source)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise FileError(f"{source}: the image is truncated or corrupt; copy it again or leave it out")
    if image.dtype not in (np.uint8, np.uint16):
        raise FileError(f"{source}: pixels are {image.dtype}; store the image with 8 or 16 bits unsigned")
    return _swap_red_and_blue(image)


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
    done, data = cv2.imencode(".png", _swap_red_and_blue(image))
    if not done:
        raise InputError(f"an image of shape {image.shape} cannot be encoded as PNG")
    return bytes(data.tobytes())


def write_png(path: str | Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> Path:
    """Write an image as PNG, atomically; shapes and types as in `encode_png`.

    Raises:
        InputError: another dtype or shape.
        FileError: the file cannot be written.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_png(Path(folder, "gray.png"), np.full((4, 6), 128, np.uint8)).name
        'gray.png'
    """
    return write_atomic(path, encode_png(image))


def _swap_red_and_blue(image: NDArray[Any]) -> NDArray[Any]:
    """OpenCV's order of channels to RGB(A), or back."""
    return image if image.ndim == 2 else np.ascontiguousarray(image[..., [2, 1, 0, *range(3, image.shape[2])]])
