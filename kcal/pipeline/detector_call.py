"""Call a user's detector, `package.module:callable`, on frames, and say in one line what is wrong with it."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcal.errors import InputError
from kcal.pipeline.detections import Detections

# An image (H, W, 3) uint8 in, whatever `Detections.read` takes out.
Detector = Callable[[NDArray[np.uint8]], Any]


def load_detector(name: str) -> Detector:
    """Import the callable that `package.module:callable` names.

    Raises:
        InputError: no such module, one that fails, or nothing in it that can be called.

    Example:
        >>> load_detector("math:nothing")
        Traceback (most recent call last):
        kcal.errors.InputError: detector math:nothing: the module math has no 'nothing'
    """
    module_name, colon, path = name.partition(":")
    if not (module_name and colon and path):
        raise InputError(f"detector {name!r}: write package.module:callable")
    try:
        found: Any = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        raise InputError(f"detector {name}: no module {error.name!r} in this Python or this folder") from error
    except Exception as error:  # whatever a module of the user raises
        raise InputError(f"detector {name}: importing {module_name} fails: {_one_line(error)}") from error
    for part in path.split("."):
        if not hasattr(found, part):
            raise InputError(f"detector {name}: the module {module_name} has no {part!r}")
        found = getattr(found, part)
    if not callable(found):
        raise InputError(f"detector {name}: what it names, of type {type(found).__name__}, cannot be called")
    detector: Detector = found
    return detector


def detect_in(detector: Detector, image: NDArray[np.uint8], time: float, where: str) -> Detections:
    """The detections in one image.

    Args:
        detector: gets the image and returns what `Detections.read` takes, or a list with one such result.
        image: (H, W, 3) red, green and blue.
        time: seconds.
        where: names the image in messages.

    Raises:
        InputError: the detector fails, or returns something else.

    Example:
        >>> found = detect_in(lambda image: [[1.0, 2.0, 5.0, 6.0]], np.zeros((8, 8, 3), np.uint8), 0.5, "left image")
        >>> found.time, found.boxes.tolist()
        (0.5, [[0.5, 1.5, 4.5, 5.5]])
    """
    height, width = image.shape[:2]
    try:
        found = detector(image)
    except Exception as error:  # whatever a detector of the user raises
        raise InputError(f"the detector failed on the {where} at {time:.3f} s: {_one_line(error)}") from error
    # Detectors of batches return a list, here of one image's result.
    if isinstance(found, (list, tuple)) and len(found) == 1 and (isinstance(found[0], Mapping) or _is_result(found[0])):
        found = found[0]
    try:
        return Detections.read(found, size=(width, height), time=time)
    except InputError as error:
        raise InputError(f"what the detector returned for the {where} at {time:.3f} s: {error}") from error


def _is_result(value: Any) -> bool:
    return hasattr(value, "boxes") or hasattr(value, "xyxy")


def _one_line(error: Exception) -> str:
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
