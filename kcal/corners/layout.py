"""Whether markers lie in an image as they lie on a board."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

_NEIGHBORS = 4  # markers that tell where one should be: few, because lenses bend the board
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


def in_place(
    placed: npt.NDArray[np.floating], seen: npt.NDArray[np.floating], tolerance: float
) -> npt.NDArray[np.bool_]:
    """Which markers lie where those near them put them, (M,).

    It begins with those of one homography (`inliers`) and goes on from neighbor to neighbor, as far as a lens bends the
    board.
    """
    good = inliers(placed, seen, tolerance)
    tried = good.copy()
    while good.sum() >= 2 and not tried.all():
        away = np.linalg.norm(seen.mean(1)[:, None] - seen[good].mean(1)[None], axis=-1)
        away[tried] = np.inf
        other = int(np.argmin(away.min(1)))
        near = np.flatnonzero(good)[np.argsort(away[other])[:_NEIGHBORS]]
        found = board_homography(placed[near].reshape(-1, 2), seen[near].reshape(-1, 2))
        good[other] = found is not None and _misses(found, placed[[other]], seen[[other]])[0] < tolerance
        tried[other] = True
    return good


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
