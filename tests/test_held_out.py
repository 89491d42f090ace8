"""The judge of held-out views: what it forgives a camera, and what not."""

import math

import pytest
import torch

from kcal import Board, Camera
from kcal.calibrate.hybrid.board_modes import board_modes
from kcal.lens import rotation_from_vector
from scripts.shared.held_out import NOISE, TWIST_PRIOR, held_out

CAMERA = Camera.build(focal=(700, 700), center=(322, 236), size=(640, 480), coefficients=[-0.2, 0.05])
POINTS = Board(columns=8, rows=6, square=0.05).points
TILTS = torch.tensor([[0.5, 0.1, 0], [-0.5, 0, 0.3], [0.1, 0.5, 0], [0, -0.5, 1.0], [0.02, 0.03, 3.0]]).double()
PLACES = torch.tensor([[0, 0, 0.9], [0.2, 0.1, 1.0], [-0.2, 0.1, 0.8], [0.1, -0.1, 1.2], [0, 0.05, 0.7]]).double()


def places(points: torch.Tensor) -> torch.Tensor:
    """Corners (V, N, 3) in the camera's frame."""
    return (points - POINTS.mean(0)) @ rotation_from_vector(TILTS).transpose(-1, -2) + PLACES[:, None]


def views(points: torch.Tensor = POINTS) -> torch.Tensor:
    return CAMERA.project(places(points))[0].detach()


def rms(total: float, count: int) -> float:
    return math.sqrt(total / count)


def test_the_true_camera_errs_by_nothing_whatever_the_tilt() -> None:
    found = held_out(CAMERA, POINTS, views())
    assert max(found.still, found.moved) < 1e-9
    assert (found.corners, found.lost) == (5 * 48, 0)


def test_a_bent_board_is_not_the_cameras_fault() -> None:
    modes = board_modes(POINTS)
    bent = POINTS + torch.tensordot(2e-3 * modes.unit, modes.shapes, 1).T
    found = held_out(CAMERA, POINTS, views(bent))
    assert rms(found.still, found.corners) < 0.03  # px: what the prior of 1e-3 leaves of 0.5 px
    flat = (views(bent) - views()).square().sum(-1).mean().sqrt()
    assert flat > 0.5


def test_motion_during_the_readout_is_refitted_only_if_asked_to() -> None:
    """Pixels solve v = f(pose at the row v): the judge's own formulas are not used."""
    turn, shift = TWIST_PRIOR * torch.randn(2, 2, 5, 1, 3, generator=torch.Generator().manual_seed(3)).double()
    about, pixels = places(POINTS) - PLACES[:, None], views()
    distance = PLACES.norm(dim=-1)[:, None, None]
    for _ in range(20):
        time = pixels[..., 1:] / 480 - 0.5
        angle = turn[0] * time + turn[1] * time**2
        moved = (rotation_from_vector(angle) @ about[..., None])[..., 0] + PLACES[:, None]
        pixels = CAMERA.project(moved + distance * (shift[0] * time + shift[1] * time**2))[0].detach()
    found = held_out(CAMERA, POINTS, pixels)
    assert rms(found.still, found.corners) > 0.05
    assert rms(found.moved, found.corners) < 0.01


def test_a_wrong_lens_stays_wrong() -> None:
    pixels = views() + 0.05 * torch.randn(5, 48, 2, generator=torch.Generator().manual_seed(1)).double()
    wrong = Camera.build(focal=(700, 700), center=(322, 236), size=(640, 480), coefficients=[-0.3, 0.05])
    for key in ("still", "moved"):
        assert getattr(held_out(wrong, POINTS, pixels), key) > 3 * getattr(held_out(CAMERA, POINTS, pixels), key)


def test_weights_count_and_unseen_corners_do_not() -> None:
    pixels, weight = views(), torch.ones(5, 48).double()
    pixels[0, 3], weight[1, 4] = torch.nan, 0.0
    pixels[1, 4] += 30.0
    found = held_out(CAMERA, POINTS, pixels, weight)
    assert found.corners == 5 * 48 - 2
    assert found.still < 1e-9
    noisy = views() + torch.randn(5, 48, 2, generator=torch.Generator().manual_seed(2)).double() * NOISE
    half = held_out(CAMERA, POINTS, noisy, 0.5 * weight.fill_(1.0))
    assert half.still == pytest.approx(0.25 * held_out(CAMERA, POINTS, noisy).still, rel=0.1)


def test_views_with_fewer_than_eight_corners_are_left_out() -> None:
    pixels = views()
    pixels[2, 7:] = torch.nan
    assert held_out(CAMERA, POINTS, pixels).corners == 4 * 48


def test_corners_without_an_image_are_told() -> None:
    """The lens folds within its image: the outermost corners that the true lens shows have no image."""
    folding = Camera.build(focal=(700, 700), center=(322, 236), size=(640, 480), coefficients=[-0.6, 0.0])
    found = held_out(folding, POINTS, CAMERA.project(places(POINTS) - torch.tensor([0.15, 0.1, 0.2]))[0].detach())
    assert 0 < found.lost < found.corners
