"""Smoothing: consistent, better than the filter, and honest about what is shared."""

from __future__ import annotations

import math

import torch
from track_scenes import pairs_of, seen_by, tracked_site, yawed_rig

from kcal.pipeline.imm_filter import Motion
from kcal.pipeline.measurements import ClockPrior
from kcal.pipeline.tracks import Tracker, TrackOptions


def test_smoothed_states_are_consistent_and_sharper() -> None:
    localize, count, frames = tracked_site(0.003), 40, 16
    generator = torch.Generator().manual_seed(0)
    z = torch.linspace(300.0, 2500.0, count).double()
    across, up = torch.linspace(-0.4, 0.4, count).double(), 0.15 * torch.randn(count, generator=generator).double()
    start = torch.stack([across * z, up * z, z], -1)
    velocity = 8.0 * torch.randn(count, 3, generator=generator).double()
    yaws = math.radians(0.003) * torch.randn(count, generator=generator).double()
    rigs = [yawed_rig(localize.rig, float(yaw)) for yaw in yaws]
    options = TrackOptions(motions=(Motion(acceleration=0.01),), speed_mps=8.0)
    tracker = Tracker(localize, options, record=True)
    places = []
    for frame in range(frames):
        places.append(start + frame / 10.0 * velocity)
        marks = [seen_by(rig, places[-1][i : i + 1], 0.3, generator) for i, rig in enumerate(rigs)]
        left, right = (torch.cat(side) for side in zip(*marks, strict=True))
        tracks = tracker(pairs_of(left, right, frame / 10.0))
    found = tracker.smoothed()
    assert [track.number for track in found] == list(tracks.number) == list(range(1, count + 1))
    middle = torch.stack([track.state.inverse_range[8] for track in found])
    sigma = torch.stack([track.state.inverse_range_sigma[8] for track in found])
    ratio = (middle - 1.0 / torch.linalg.vector_norm(places[8], dim=-1)) / sigma
    assert 0.75 < float(ratio.square().mean().sqrt()) < 1.25
    velocities = torch.stack([track.state.velocity[8] for track in found])
    true = velocity @ localize.enu_from_rig.T
    covariance = torch.stack([track.state.velocity_covariance[8] for track in found])
    error = (velocities - true)[..., None]
    # 40 values of chi-squared with three degrees of freedom.
    assert 2.2 < float((error.mT @ torch.linalg.solve(covariance, error)).mean()) < 3.9
    # The last moment is the filter's, and the first is much better known than when it was seen.
    last = torch.stack([track.state.enu[-1] for track in found])
    torch.testing.assert_close(last, tracks.state.enu)
    first = torch.stack([track.state.covariance[0, 1, 1] - track.state.systematic[0, 1, 1] for track in found])
    one = localize(*(torch.cat(side) for side in zip(*marks, strict=True)))
    assert bool((first < 0.5 * one.covariance[:, 1, 1]).all())


def test_a_clock_that_is_known_at_the_end_corrects_the_beginning() -> None:
    localize, late = tracked_site(), 0.05
    generator = torch.Generator().manual_seed(1)
    start = torch.tensor([[-30.0, 10.0, 300.0], [0.0, -20.0, 200.0], [10.0, 0.0, 250.0]]).double()
    velocity = torch.tensor([[9.0, 0.0, 0.0], [0.0, 6.0, 2.0], [-8.0, -5.0, 1.0]]).double()
    tracker = Tracker(
        localize, TrackOptions(motions=(Motion(acceleration=0.02),)), clock=ClockPrior(offset_sigma_s=0.1), record=True
    )
    for frame in range(40):
        time = frame / 10.0
        left, right = seen_by(localize.rig, start + time * velocity, 0.2, generator, start + (time + late) * velocity)
        tracker(pairs_of(left, right, time, 0.2))
    offset, sigma = tracker.clock_estimate().offset(4.0)
    assert abs(offset - late) < 3 * sigma < 0.006
    for track, place, pace in zip(tracker.smoothed(), start, velocity, strict=True):
        true = 1.0 / torch.linalg.vector_norm(place + track.time[:, None] * pace, dim=-1)
        error = (true - track.state.inverse_range) / track.state.inverse_range_sigma
        assert float(error.abs().max()) < 3.0
