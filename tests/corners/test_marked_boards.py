"""Boards with markers of which some cannot be read: their corners are found from those beside them."""

import pytest
import torch

from kcal.corners.board import Board
from kcal.corners.detect import detect_board
from scripts.bench.hard_boards import covered, cut, moving, noisy, pictures, plain, small
from scripts.bench.hard_scenes import Marked
from scripts.bench.marked_boards import WRONG

SCENES = {name: Marked(Board.parse(name, "30mm")) for name in ("charuco:9x6", "aprilgrid:6x6")}


# Remarks: the share that was found when only corners beside markers without wrong bits were.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind", "least"),
    [
        ("charuco:9x6", plain, 1.0),  # 0.93
        ("charuco:9x6", moving, 0.95),  # 0.61
        ("charuco:9x6", small, 0.8),  # 0
        ("charuco:9x6", covered, 0.95),  # 0.85
        ("aprilgrid:6x6", noisy, 0.4),  # 0.10
        ("aprilgrid:6x6", moving, 0.95),  # 0.25
        ("aprilgrid:6x6", small, 0.95),  # 0
        ("aprilgrid:6x6", cut, 0.93),  # 0.89
    ],
)
def test_share_of_the_corners(name, kind, least):
    scene = SCENES[name]
    (image, truth), *_ = pictures(kind, 1, scene)
    pixels = detect_board(image, scene.board).pixels
    right = (pixels - truth).norm(dim=-1) < WRONG
    assert int(right.sum()) >= least * int(torch.isfinite(truth).all(-1).sum())
    assert int(torch.isfinite(pixels).all(-1).sum()) == int(right.sum())
