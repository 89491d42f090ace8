"""Find grids of circles and the images of their centers.

OpenCV's `findCirclesGrid` finds the grid. kcal fits the edge of each circle as a blurred ellipse
(`kcal.corners.ellipse`) and corrects the ellipse's center, which is not the image of the circle's center
(`kcal.corners.circle_bias`). All circles must be in the image.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kcal.corners.board import Board
from kcal.corners.circle_bias import center_shift, homography, local_maps
from kcal.corners.ellipse import Ellipses, fit_ellipses
from kcal.corners.images import Gray
from kcal.corners.saddle import CornerStatus, Refined, with_status

SEARCH_SIDES = (1200, 2400)  # pixels: longer sides of the searched image, small first
_MOST_REACH = 1.8  # radii from the center to where pixels tell of the edge and of the light outside
_FOREIGN = 1.5  # pixels short of the next circle's edge, where its blur begins
_MOST_BLUR = 0.5  # of the radius
_MOST_MISFIT = 0.2  # RMS residual over the contrast: above, something covers the circle
_MOST_MOVE = 0.5  # radii from OpenCV's center
_SIZE_RATIO = 1.25  # of the circles' diameter as seen to that of the board's text
_LEAST_KNOWN = 6  # circles: fewer good ones do not tell how the others are shifted, and no board is found
_LATTICE = 0.3  # of a distance: how near a blob beside the grid must be to where its next circle would be


class FoundCircles(NamedTuple):
    """A grid of circles in an image.

    Args:
        pixels: (corners, 2) OpenCV's centers in the board's order; None if none were found.
        radius: meters, about.
        reason: why none were found.
    """

    pixels: Tensor | None
    radius: float = 0.0
    reason: str = ""


def find_circles(image: npt.NDArray[np.uint8], board: Board) -> FoundCircles:
    """The centers of a grid of dark circles on light, or of light ones on dark.

    Example:
        >>> find_circles(np.full((100, 100), 200, np.uint8), Board.parse("circles:7x6", "20mm")).reason
        'no grid of 7x6 circles found'
    """
    reason, most = f"no grid of {board.columns}x{board.rows} {_kind(board)} found", 0
    for small, scale in _sizes(image):
        for picture in (small, 255 - small):
            blobs = round_blobs(picture)
            most = max(most, len(blobs))
            if len(blobs) < board.corners:
                continue
            centers = _find_grid(picture, board)
            if centers is None:
                continue
            ordered = circle_order(centers, board)
            if ordered is None:
                reason = "the grid of circles found is not the board"
                continue
            places = torch.tensor([blob.pt for blob in blobs], dtype=torch.float64)
            if _goes_on(places, ordered, board):
                reason = f"circles go on beyond {board.columns}x{board.rows}: the board has more than that"
                continue
            own = torch.cdist(ordered, places).argmin(1)
            sizes = torch.tensor([blob.size for blob in blobs], dtype=torch.float64)[own]
            first = local_maps(board.points[:, :2], ordered).first
            radius = float((0.5 * sizes / torch.linalg.det(first).abs().sqrt()).median())
            return FoundCircles((ordered + 0.5) * scale - 0.5, radius)
    if reason.startswith("no grid") and most:
        reason += f" ({most} round blobs seen, {board.corners} are needed, all in the image)"
    return FoundCircles(None, reason=reason)


def refine_circles(image: Gray, pixels: Tensor, board: Board, radius: float) -> tuple[Refined, float]:
    """The images of the circles' centers, and the circles' radius as it is seen, meters.

    Args:
        image: (H, W) uint8 or uint16.
        pixels: (corners, 2) starts in the board's order, all finite.
        board: the board; its diameter, if it has one, is used for the correction of the centers, else that seen.
        radius: of the circles, meters, about.
    """
    points = board.points[:, :2]
    first = local_maps(points, pixels).first
    center, shape = pixels, _symmetric(torch.linalg.inv(first)) / radius
    for _ in range(2):  # the second time with the pixels that belong to what was found
        size = torch.linalg.det(shape).rsqrt()
        reach = (board.spacing / radius - 1.0 - _FOREIGN / size).clamp(1.15, _MOST_REACH)
        found = fit_ellipses(image, center, shape, reach)
        usable = found.converged & ((found.center - pixels).norm(dim=-1) < _MOST_MOVE * size)
        if not bool(usable.any()):
            break
        center = torch.where(usable[:, None], found.center, center)
        shape = torch.where(usable[:, None, None], found.shape, shape)
        radius = float((torch.linalg.det(shape) * torch.linalg.det(first)).rsqrt()[usable].median())
    refined = _with_statuses(image, pixels, found)
    good = refined.status == CornerStatus.GOOD
    if int(good.sum()) < _LEAST_KNOWN:
        return refined, radius
    maps = local_maps(points, found.center, good)
    shift = center_shift(maps, 0.5 * board.diameter if board.diameter is not None else radius)
    return refined._replace(pixels=refined.pixels - shift), radius


def wrong_size(board: Board, radius: float) -> str:
    """Why circles that look this large cannot be the board's; empty if they can."""
    if board.diameter is None:
        return ""
    ratio = 2.0 * radius / board.diameter
    if 1.0 / _SIZE_RATIO < ratio < _SIZE_RATIO:
        return ""
    return (
        f"the circles are {2e3 * radius:.3g} mm wide where their distance is {1e3 * board.square:g} mm, "
        f"the board's are {1e3 * board.diameter:g} mm: check distance and diameter"
    )


def circle_order(pixels: Tensor, board: Board) -> Tensor | None:
    """Centers (corners, 2) in the board's order; None if they fit it in none.

    The order is never mirrored. Where a board looks the same in two orders, the one nearest to upright in the image.
    """
    grid = pixels.reshape(board.rows, board.columns, 2)
    turns = [grid, grid.flip(0), grid.flip(1), grid.flip(0, 1)]
    if board.columns == board.rows and board.pattern == "circles":
        turns += [turn.transpose(0, 1) for turn in turns]
    points = board.points[:, :2]
    fits: list[tuple[float, float, Tensor]] = []
    for turn in turns:
        candidate = turn.reshape(-1, 2)
        h = homography(points, candidate)
        there = torch.nn.functional.pad(points, (0, 1), value=1.0) @ h.T
        if not bool((there[:, 2] > 0).all()):
            continue
        miss = float((there[:, :2] / there[:, 2:] - candidate).norm(dim=-1).square().mean().sqrt())
        first = local_maps(points, candidate).first
        if not bool((torch.linalg.det(first) > 0).all()):
            continue  # mirrored, or folded
        across, down = torch.nn.functional.normalize(first.mean(0), dim=0).unbind(-1)
        side = float(torch.linalg.det(first).sqrt().median()) * board.spacing
        upright = float(across[0] + down[1]) + 1e-6 * float(across[1] - down[0])
        if miss < 0.5 * side:
            fits.append((miss / side, upright, candidate))
    if not fits:
        return None
    best = min(fits)[0]
    return max((fit for fit in fits if fit[0] < 2.0 * best + 0.02), key=lambda fit: fit[1])[2]


def _kind(board: Board) -> str:
    return "asymmetric circles" if board.pattern == "asymmetric" else "circles"


def _sizes(image: npt.NDArray[np.uint8]) -> Iterator[tuple[npt.NDArray[np.uint8], Tensor]]:
    height, width = image.shape
    tried: set[tuple[int, int]] = set()
    for longest in SEARCH_SIDES:
        factor = max(1.0, max(width, height) / longest)
        size = round(width / factor), round(height / factor)
        if size in tried:
            return
        tried.add(size)
        small = image if factor == 1.0 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        yield np.asarray(small, np.uint8), torch.tensor([width / size[0], height / size[1]], dtype=torch.float64)


def round_blobs(image: npt.NDArray[np.uint8], circularity: float = 0.0) -> list[cv2.KeyPoint]:
    """Dark round spots of an image."""
    return list(_detector(image.size, circularity).detect(image))


def _detector(pixels: int, circularity: float = 0.0) -> cv2.SimpleBlobDetector:
    """Blobs of any size and tilt: OpenCV's own settings lose circles that are small, large, near or seen from aside."""
    options = cv2.SimpleBlobDetector.Params()
    options.minThreshold, options.maxThreshold, options.thresholdStep = 20, 235, 10
    options.minDistBetweenBlobs = 4
    options.filterByArea, options.minArea, options.maxArea = True, 12, 0.05 * pixels
    options.filterByCircularity, options.minCircularity = circularity > 0, max(circularity, 0.01)
    options.filterByInertia, options.minInertiaRatio = True, 0.05
    options.filterByConvexity, options.minConvexity = True, 0.85
    return cv2.SimpleBlobDetector.create(options)


def _find_grid(image: npt.NDArray[np.uint8], board: Board) -> Tensor | None:
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if board.pattern == "asymmetric" else cv2.CALIB_CB_SYMMETRIC_GRID
    for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING):
        # In a new thread OpenCV's random numbers begin anew, so that the same image always gives the same grid.
        with ThreadPoolExecutor(1) as fresh:
            found, centers = fresh.submit(
                cv2.findCirclesGrid, image, (board.columns, board.rows), None, flags, _detector(image.size)
            ).result()
        if found:
            return torch.from_numpy(np.asarray(centers, np.float64).reshape(-1, 2))
    return None


def _goes_on(blobs: Tensor, pixels: Tensor, board: Board) -> bool:
    """Whether more than half of the places one row or column beyond the grid have a blob."""
    points = board.points[:, :2] / board.square
    h = homography(pixels, points)
    there = torch.nn.functional.pad(blobs, (0, 1), value=1.0) @ h.T
    seen = there[:, :2] / there[:, 2:]
    step = 2.0 if board.pattern == "asymmetric" else 1.0
    grid = points.reshape(board.rows, board.columns, 2)
    beside = [grid[:, 0] - torch.tensor([step, 0.0]), grid[:, -1] + torch.tensor([step, 0.0])]
    # The next row but one of asymmetric circles is a shift of a row, the next one of the row before.
    up, down = (grid[1], grid[-2]) if board.pattern == "asymmetric" else (grid[0], grid[-1])
    rows = 2.0 if board.pattern == "asymmetric" else 1.0
    beside += [up - torch.tensor([0.0, rows]), down + torch.tensor([0.0, rows])]
    return any(float((torch.cdist(side.double(), seen).amin(1) < _LATTICE).double().mean()) > 0.5 for side in beside)


def _symmetric(matrix: Tensor) -> Tensor:
    """The symmetric positive B with |B v| = |matrix v|, for (M, 2, 2)."""
    values, vectors = torch.linalg.eigh(matrix.mT @ matrix)
    return vectors @ torch.diag_embed(values.clamp_min(1e-18).sqrt()) @ vectors.mT


def _with_statuses(image: Gray, start: Tensor, found: Ellipses) -> Refined:
    height, width = image.shape
    size = torch.linalg.det(found.shape).clamp_min(1e-12).rsqrt()
    half = torch.linalg.vector_norm(torch.linalg.inv(found.shape), dim=-1) + found.blur[:, None]
    limit = torch.tensor([width - 1.0, height - 1.0], dtype=torch.float64)
    inside = ((found.center >= half) & (found.center <= limit - half)).all(-1)
    alike = found.contrast.sign() == found.contrast.median().sign()
    result, status = with_status(
        found.center,
        (
            (CornerStatus.OUTSIDE, inside),
            (CornerStatus.NO_SADDLE, alike & torch.isfinite(found.center).all(-1)),
            (CornerStatus.OCCLUDED, found.misfit <= _MOST_MISFIT),
            (CornerStatus.BLURRED, found.blur <= _MOST_BLUR * size),
            (CornerStatus.MOVED, (found.center - start).norm(dim=-1) <= _MOST_MOVE * size),
            (CornerStatus.NOT_CONVERGED, found.converged),
        ),
    )
    good = status == CornerStatus.GOOD
    covariance = torch.where(good[:, None, None], found.covariance, float("nan"))
    return Refined(result, status, covariance, torch.where(good, found.blur, float("nan")))
