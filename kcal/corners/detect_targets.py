"""Detect boards other than plain checkerboards: ChArUco boards, AprilGrids and circles."""

from __future__ import annotations

import torch

from kcal.corners.aprilgrid import find_aprilgrid
from kcal.corners.board import Board
from kcal.corners.charuco import enough, find_charuco, free_side
from kcal.corners.circles import find_circles, refine_circles, wrong_size
from kcal.corners.detection import Detection, too_few
from kcal.corners.images import Gray, to_8bit
from kcal.corners.refine import Refinement, refine_corners
from kcal.corners.saddle import CornerStatus
from kcal.errors import InputError

MIN_CIRCLES = 0.5  # share of the circles that must be fitted successfully


def detect_target(image: Gray, board: Board, refine: Refinement) -> Detection:
    """Find a board that is no plain checkerboard.

    Raises:
        InputError: a refinement that circles do not have.
    """
    if board.pattern == "aprilgrid":
        return _detect_tags(image, board, refine)
    if board.pattern == "checkerboard":
        return detect_charuco(image, board, refine)
    return _detect_circles(image, board, refine)


def detect_charuco(image: Gray, board: Board, refine: Refinement, legacy: bool | None = None) -> Detection:
    """Find the visible corners of a ChArUco board; `legacy` is the numbering where the image does not tell it."""
    pixels, reason, told = find_charuco(to_8bit(image), board, legacy)
    if pixels is None:
        return Detection(None, reason)
    seen = torch.isfinite(pixels).all(-1)
    refined = refine_corners(image, pixels, free_side(pixels, board), refine, (board.columns, board.rows))
    if not enough(refined.pixels, board):
        return Detection(None, too_few(refined, int(seen.sum())))
    return Detection(refined.pixels, covariance=refined.covariance, legacy=told)


def _detect_tags(image: Gray, board: Board, refine: Refinement) -> Detection:
    found = find_aprilgrid(to_8bit(image), board)
    if found.pixels is None:
        return Detection(None, found.reason)
    seen = torch.isfinite(found.pixels).all(-1)
    refined = refine_corners(image, found.pixels, torch.where(seen, found.side, 1.0), refine)
    if not enough(refined.pixels, board):
        none = (CornerStatus.NO_SADDLE, CornerStatus.MOVED, CornerStatus.NOT_CONVERGED, CornerStatus.OCCLUDED)
        lacking = sum(int((refined.status == status).sum()) for status in none) > 0.5 * int(seen.sum())
        more = "; the small squares between the tags are needed, as Kalibr draws them" if lacking else ""
        return Detection(None, too_few(refined, int(seen.sum())) + more)
    return Detection(refined.pixels, covariance=refined.covariance)


def _detect_circles(image: Gray, board: Board, refine: Refinement) -> Detection:
    if refine not in ("erf", "none"):
        raise InputError(
            f"refine {refine!r}: circles are fitted at their edges (erf), or left as OpenCV finds them (none)"
        )
    found = find_circles(to_8bit(image), board)
    if found.pixels is None or refine == "none":
        return Detection(found.pixels, found.reason)
    refined, radius = refine_circles(image, found.pixels, board, found.radius)
    if (reason := wrong_size(board, radius)) or int(
        (refined.status == CornerStatus.GOOD).sum()
    ) < MIN_CIRCLES * board.corners:
        return Detection(None, reason or too_few(refined, board.corners))
    return Detection(refined.pixels, covariance=refined.covariance)
