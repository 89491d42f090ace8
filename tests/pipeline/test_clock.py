"""Clocks: offset, drift and slope from targets that move, covered by their sigmas; frames at different times."""

from __future__ import annotations

import math

import pytest
import torch
from track_scenes import pairs_of, seen_by, tracked_site

from kcal.errors import InputError
from kcal.pipeline.imm_filter import Motion
from kcal.pipeline.measurements import ClockPrior
from kcal.pipeline.tracks import Tracker, TrackOptions

OPTIONS = TrackOptions(motions=(Motion(acceleration=0.02),), speed_mps=8.0)


def crowd(seed: int, count: int = 12) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    z = torch.linspace(150.0, 600.0, count).double()
    across = torch.linspace(-0.3, 0.3, count).double()[torch.randperm(count, generator=generator)]
    up = torch.linspace(-0.15, 0.15, count).double()
    velocity = torch.tensor([6.0, 2.0, 4.0]).double() * torch.randn(count, 3, generator=generator).double()
    return torch.stack([across * z, up * z, z], -1), velocity


def test_offset_from_cameras_of_unlike_rates() -> None:
    """The left camera has 10 and the right one 25 frames a second: the nearest frames are up to 20 ms apart."""
    localize = tracked_site(0.002)
    tracker = Tracker(localize, OPTIONS, clock=ClockPrior(offset_sigma_s=0.1))
    generator = torch.Generator().manual_seed(0)
    start, velocity = crowd(1)
    for frame in range(40):
        time = frame / 10.0
        stamp = round(25 * (time + 0.013)) / 25 - 0.013
        places, later = start + time * velocity, start + (stamp + 0.040) * velocity
        tracks = tracker(
            pairs_of(*seen_by(localize.rig, places, 0.2, generator, later), torch.tensor([time, stamp]), 0.2)
        )
    offset, sigma = tracker.clock_estimate().offset(2.0)
    assert sigma < 0.0025
    assert abs(offset - 0.040) < 3 * sigma
    truth = 1.0 / torch.linalg.vector_norm(places, dim=-1)
    ratio = (tracks.state.inverse_range - truth) / tracks.state.inverse_range_sigma
    assert float(ratio.abs().max()) < 4.0


def test_drift_and_rolling_shutter() -> None:
    localize = tracked_site()
    prior = ClockPrior(offset_s=0.01, offset_sigma_s=0.05, drift_sigma=0.01, slope_sigma_s=0.05)
    tracker = Tracker(localize, OPTIONS, clock=prior)
    generator = torch.Generator().manual_seed(0)
    start, velocity = crowd(3)
    true = torch.tensor([0.03, 0.004, 0.02]).double()
    for frame in range(40):
        time = 7.0 + frame / 10.0
        places = start + (time - 7.0) * velocity
        row = localize.rig.right.project(localize.rig.right_from_left(places))[0][:, 1] / 1080 - 0.5
        late = torch.stack([torch.ones_like(row), torch.full_like(row, time - 7.0), row], -1) @ true
        tracker(pairs_of(*seen_by(localize.rig, places, 0.2, generator, places + late[:, None] * velocity), time, 0.2))
    found = tracker.clock_estimate()
    assert found.start == 7.0
    error = found.values - true
    assert float(error @ torch.linalg.solve(found.covariance, error)) < 14.2  # 99.7 % of three degrees of freedom
    assert bool((found.covariance.diagonal().sqrt() < torch.tensor([0.003, 0.0015, 0.012]).double()).all())


def test_an_unknown_clock_widens_the_range_of_what_moves() -> None:
    """20 ms at 10 m/s across a baseline of 10 m are 2 % of range; a target that stands still loses nothing."""
    localize = tracked_site()
    places = torch.tensor([[0.0, 0.0, 400.0], [50.0, 0.0, 400.0]]).double()
    velocity = torch.tensor([[10.0, 0.0, 0.0], [0.0, 0.0, 0.0]]).double()
    sigmas = []
    for sigma in (0.0, 0.02):
        tracker = Tracker(localize, OPTIONS, clock=ClockPrior(offset_sigma_s=sigma))
        generator = torch.Generator().manual_seed(0)
        for frame in range(30):
            moved = places + frame / 10.0 * velocity
            tracks = tracker(pairs_of(*seen_by(localize.rig, moved, 0.2, generator), frame / 10.0, 0.2))
        sigmas.append(tracks.state.inverse_range_sigma / tracks.state.inverse_range)
    more = (sigmas[1].square() - sigmas[0].square()).clamp_min(0).sqrt()
    # Both move level, straight and side by side: hardly anything betrays the offset.
    assert float(more[0]) == pytest.approx(0.02, rel=0.03)
    assert tracker.clock_estimate().offset(1.0)[1] == pytest.approx(0.02, rel=0.03)
    assert float(more[1]) < 0.003


def test_a_clock_that_is_known_is_not_estimated() -> None:
    tracker = Tracker(tracked_site(), OPTIONS, clock=ClockPrior(offset_s=0.02))
    assert tracker.clock_estimate().offset(3.0) == (0.02, 0.0)


@pytest.mark.parametrize("wrong", [{"offset_s": math.nan}, {"drift_sigma": -1.0}])
def test_impossible_clocks(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match="clock"):
        ClockPrior(**wrong)
