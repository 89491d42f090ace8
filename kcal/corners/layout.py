"""Whether markers lie in an image as they lie on a board."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

_TRIES = 60  # pairs; nearly all of a board's markers agree, or hardly any


def agreeing(placed: npt.NDArray[np.floating], seen: npt.NDArray[np.floating], tolerance: float) -> int:
    """How many markers lie within `tolerance` of where one homography puts them.

    The homography is that of the two markers, near each other or not, with which most of the others agree; a wide lens
    bends the board, so that not all of it follows one.

    Args:
        placed: (M, 4, 2) corners on the board.
        seen: (M, 4, 2) in the image.
        tolerance: mean distance of a marker's corners, in the board's units.

    Example:
        >>> square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        >>> placed = np.stack([square, square + [2, 0], square + [0, 2], square + [2, 2]])
        >>> agreeing(placed, 10 * placed + 5, 0.1)
        4
        >>> agreeing(placed[[0, 1, 3, 2]], 10 * placed + 5, 0.1)
        2
    """
    return int(inliers(placed, seen, tolerance).sum())


def inliers(
    placed: npt.NDArray[np.floating], seen: npt.NDArray[np.floating], tolerance: float
) -> npt.NDArray[np.bool_]:
    """Which markers `agreeing` counts, (M,)."""
    count = len(placed)
    best = np.zeros(count, bool)
    if count < 2:
        return ~best
    pairs = [(i, j) for i in range(count) for j in range(i + 1, count)]
    step = max(1, len(pairs) // _TRIES)
    for i, j in pairs[::step]:
        found = board_homography(placed[[i, j]].reshape(-1, 2), seen[[i, j]].reshape(-1, 2))
        if found is None:
            continue
        good = _misses(found, placed, seen) < tolerance
        if good.sum() > best.sum():
            best = good
    return best


def board_homography(
    placed: npt.NDArray[np.floating], seen: npt.NDArray[np.floating]
) -> npt.NDArray[np.float64] | None:
    """(3, 3) board from image by least squares of points (N, 2); None where they determine none."""
    found, _ = cv2.findHomography(seen.astype(np.float64), placed.astype(np.float64))
    if found is None or not np.isfinite(found).all():
        return None
    return np.asarray(found, np.float64)


def _misses(
    board_from_image: npt.NDArray[np.float64], placed: npt.NDArray[np.floating], seen: npt.NDArray[np.floating]
) -> npt.NDArray[np.float64]:
    there = cv2.perspectiveTransform(seen.reshape(1, -1, 2).astype(np.float64), board_from_image).reshape(seen.shape)
    return np.asarray(np.linalg.norm(there - placed, axis=-1).mean(-1), np.float64)
