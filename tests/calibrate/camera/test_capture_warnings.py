"""What is said of views that moved while their rows were read."""

from __future__ import annotations

import torch

from kcal.calibrate.camera.warnings import motion_warnings
from kcal.calibrate.hybrid.fit import HybridFit, fit_hybrid
from kcal.lens.camera import Camera
from kcal.lens.zernike import ZernikeModes
from kcal.sim.board import BoardSize, board_points
from kcal.sim.captures import sample_board_poses
from scripts.shared.moving_captures import Hands, moving_capture

BOARD = BoardSize(9, 6, 0.05)
CAMERA = Camera.build(focal=(1100, 1100), center=(639.5, 479.5), size=(1280, 960), coefficients=[-0.1])
HANDS = Hands(turning=(1.0, 1.0), speed=(0.3, 0.3), readout=(0.03, 0.03), exposure=(0.005, 0.005))
MODES = ZernikeModes(radial=7, decentered=4, astigmatic=3, other=2)


def fitted(views: int, hands: Hands | None) -> HybridFit:
    poses = sample_board_poses(CAMERA, BOARD, views, torch.Generator().manual_seed(4), fill=(0.3, 0.5))
    seen = moving_capture(CAMERA, poses, sigma=0.05, seed=5, hands=hands, board=BOARD).pixels
    inside = CAMERA.inside(seen.nan_to_num(nan=-9.0))
    pixels = torch.where(inside[..., None], seen, torch.nan)
    return fit_hybrid(board_points(BOARD), pixels, CAMERA.size, modes=MODES, square=True)


def test_motion_is_told_in_pixels() -> None:
    many = motion_warnings(fitted(12, HANDS))
    assert len(many) == 1
    assert "moved while rows were read" in many[0]
    assert motion_warnings(fitted(12, None)) == []


def test_few_views_that_moved() -> None:
    """Their error bars are wide, and may still be too small, which no other warning says."""
    few = motion_warnings(fitted(5, HANDS))
    assert [text.startswith("5 views that moved are few") for text in few] == [True, False]
