"""Captures by hand: the rolling shutter's implicit equation, blur, and noise along it."""

from __future__ import annotations

import math

import pytest
import torch

from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.sim.captures import BoardPose, project_board, sample_board_poses
from scripts.shared.captures import PAPER_BOARD
from scripts.shared.moving_captures import HandMotion, Hands, draw_motion, moving_capture, noise_root, rolling_corners

PINHOLE = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), model="pinhole")
POINTS = torch.tensor([[0.0, 0.0, 2.0], [0.3, 0.4, 2.0], [-0.3, -0.5, 2.0]]).double()
READOUT, EXPOSURE = 0.02, 0.01
POSES = sample_board_poses(PINHOLE, PAPER_BOARD, 6, torch.Generator().manual_seed(4), fill=(0.25, 0.8))


def steady(*rates: float) -> HandMotion:
    """Constant rates of turn and shift."""
    zero = torch.zeros(1, 6, dtype=torch.float64)
    return HandMotion(torch.tensor(rates, dtype=torch.float64), zero, zero + 1.0, zero)


def test_a_shift_along_the_rows_shears_the_image() -> None:
    still = PINHOLE.project(POINTS)[0]
    pixels, blur = rolling_corners(
        PINHOLE, POINTS, steady(0, 0, 0, 0.5, 0, 0), torch.zeros(3).double(), READOUT, EXPOSURE
    )
    speed = 800 * 0.5 / 2.0  # px/s
    times = ((still[:, 1] + 0.5) / 480 - 0.5) * READOUT
    assert torch.allclose(pixels[:, 0], still[:, 0] + speed * times)
    assert torch.allclose(pixels[:, 1], still[:, 1])
    assert torch.allclose(blur, torch.tensor([speed * EXPOSURE, 0.0]).double().expand(3, 2))


def test_a_shift_down_the_rows_stretches_the_image() -> None:
    """v = v0 + speed · time(v) has a closed form; one iteration of it does not."""
    still = PINHOLE.project(POINTS)[0]
    pixels, _ = rolling_corners(PINHOLE, POINTS, steady(0, 0, 0, 0, 4.0, 0), torch.zeros(3).double(), READOUT, EXPOSURE)
    rows = 800 * 4.0 / 2.0 * READOUT / 480  # share of the image by which the board moves during the readout
    assert torch.allclose(pixels[:, 1] - 239.5, (still[:, 1] - 239.5) / (1 - rows))


def test_things_turn_about_their_middle() -> None:
    spin = steady(0, 0, 2.0, 0, 0, 0)
    pixels, _ = rolling_corners(PINHOLE, POINTS[1:2], spin, POINTS[1], READOUT, EXPOSURE)
    assert torch.allclose(pixels, PINHOLE.project(POINTS[1:2])[0])
    other, _ = rolling_corners(PINHOLE, POINTS[1:2], spin, torch.zeros(3).double(), READOUT, EXPOSURE)
    assert float((other - pixels).norm()) > 1.0


def test_what_is_detected_is_the_mean_over_the_exposure() -> None:
    zero, one = torch.zeros(1, 6).double(), torch.zeros(1, 6).double()
    one[0, 3] = 1.0
    swing = HandMotion(zero[0], one, zero + 5.0, zero + math.pi / 2)
    pixels, _ = rolling_corners(PINHOLE, POINTS[:1], swing, zero[0, :3], READOUT, 0.04)
    circular = 2 * math.pi * 5
    shift = (
        math.sin(circular * 0.02) / (circular * 0.02) - 1
    ) / circular  # the mean of (cos(circular t) - 1) / circular
    assert float(pixels[0, 0]) == pytest.approx(319.5 + 800 * shift / 2.0, abs=1e-4)
    late = swing.at(torch.tensor([0.0, 0.05]).double())  # a quarter of a period
    assert late[0].abs().max() == 0
    assert float(late[1, 3]) == pytest.approx(-1 / circular)


def test_points_behind_are_not_seen() -> None:
    behind = torch.cat([POINTS, torch.tensor([[0.0, 0.0, -1.0]]).double()])
    pixels, _ = rolling_corners(PINHOLE, behind, steady(0, 0, 0, 0, 4.0, 0), torch.zeros(3).double(), READOUT, EXPOSURE)
    assert pixels.isfinite().all(-1).tolist() == [True, True, True, False]


def test_rates_are_as_large_as_asked_for() -> None:
    generator = torch.Generator().manual_seed(5)
    moments = torch.tensor([-0.01, 0.01]).double()
    rates = torch.stack(
        [draw_motion(0.4, 0.1, (2.0, 10.0), generator).at(moments).diff(dim=0)[0] / 0.02 for _ in range(2000)]
    )
    found = rates.square().mean(0).sqrt()
    assert found[:3].tolist() == pytest.approx([0.4] * 3, rel=0.06)  # a mean over 20 ms of up to 10 Hz loses 2 %
    assert found[3:].tolist() == pytest.approx([0.1] * 3, rel=0.06)


def test_noise_grows_along_the_blur_alone() -> None:
    length = 0.7 * math.sqrt(12.0) * math.sqrt(15.0)  # widens the edge fourfold
    root = noise_root(torch.tensor([0.6, 0.8]).double() * length, 0.1)
    value, vector = torch.linalg.eigh(root)
    assert value.tolist() == pytest.approx([0.1, 0.2])
    assert vector[:, 1].abs().tolist() == pytest.approx([0.6, 0.8])


def test_noise_is_drawn_from_its_covariance() -> None:
    # The largest blur is as long as the motion wants.
    moving = moving_capture(
        PINHOLE, 7 * POSES, sigma=0.1, seed=2, hands=Hands(turning=(0.5, 0.5), exposure=(0.02, 0.02))
    )
    off = moving.pixels - moving.true_pixels
    distance = (off * torch.linalg.solve(moving.covariance, off[..., None])[..., 0]).sum(-1)
    assert float(distance.mean()) == pytest.approx(2.0, rel=0.08)
    assert float(moving.covariance.diagonal(dim1=-2, dim2=-1).max()) > 1.5 * 0.1**2


def test_on_a_stand_corners_are_where_the_lens_shows_them() -> None:
    still = moving_capture(PINHOLE, POSES, sigma=0.1, seed=2)
    assert torch.allclose(still.true_pixels[1], project_board(PINHOLE, POSES[1], PAPER_BOARD)[0])
    assert torch.allclose(still.covariance[1, 3], 0.01 * torch.eye(2).double())
    assert float((still.pixels - still.true_pixels).square().mean().sqrt()) == pytest.approx(0.1, rel=0.1)


@pytest.mark.parametrize("holds", ["board", "camera"])
def test_blurred_pictures_are_taken_again(holds: str) -> None:
    fast = Hands(holds=holds, turning=(1.0, 1.0), exposure=(0.02, 0.02), most_blur=3.0)  # type: ignore[arg-type]
    moving = moving_capture(PINHOLE, POSES, sigma=0.1, seed=4, hands=fast)
    assert 0.5 < float(moving.blur.norm(dim=-1).max()) <= 3.0
    assert moving.exposure == pytest.approx(0.02)
    assert 0.01 <= moving.readout <= 0.03


def test_bad_values_are_refused() -> None:
    with pytest.raises(InputError, match="readout"):
        Hands(readout=(0.03, 0.01))
    with pytest.raises(InputError, match="holds"):
        Hands(holds="tripod")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="most_blur"):
        Hands(most_blur=0.0)
    with pytest.raises(InputError, match="sigma"):
        moving_capture(PINHOLE, POSES, sigma=-0.1, seed=1)
    with pytest.raises(InputError, match="0 poses"):
        moving_capture(PINHOLE, list[BoardPose](), sigma=0.1, seed=1)
