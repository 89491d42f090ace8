"""Tracks: the localizer's own numbers at birth, consistent afterwards, never below the systematic part, names kept."""

import copy
import dataclasses
import math
from typing import Any

import pandas
import polars
import pytest
import torch
from locate_rigs import real_rig, tensor
from track_scenes import ORIGIN, pairs_of, seen_by, tracked_site, yawed_rig

from kcal import InputError, Localizer
from kcal.gaussian import half_of_covariance
from kcal.locate.tables import NUMBERS, TEXTS
from kcal.pipeline.estimates import track_states
from kcal.pipeline.imm_filter import Motion, Timing, born
from kcal.pipeline.measurements import anchored, known_views, sightings
from kcal.pipeline.stream import track_columns
from kcal.pipeline.tracks import Tracker, TrackOptions, Tracks
from kcal.rig import RigCovariance

STEADY = TrackOptions(motions=(Motion(acceleration=1e-4),), speed_mps=10.0, confirm_hits=2)


def test_one_sighting_is_what_the_localizer_says() -> None:
    """A real lens, correlated errors of calibration and mounting, refraction: all as `Localizer` has them."""
    rig = real_rig()
    mix = torch.randn(12, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    scale = tensor(*[2e-5] * 3, *[5e-3] * 3, *[0.02] * 3, *[3e-5] * 3)
    whole = (scale[:, None] * mix) @ (scale[:, None] * mix).T / 12.0
    there = rig.placed(origin=ORIGIN, heading_deg=35.0, pitch_deg=-1.0, roll_deg=0.5)
    linked = torch.nn.functional.pad(half_of_covariance(whole), (sum(rig.sizes), 1))
    there.relative_root = torch.cat([there.relative_root, linked])
    localize = Localizer(there)
    points = tensor([10.0, -3.0, 120.0], [-150.0, 20.0, 900.0], [300.0, 60.0, 2500.0], [0.0, 40.0, 90_000.0])
    left, right = rig(points)[0].unbind(-2)
    pairs = pairs_of(left, right + tensor([0.0, 0.4]), 7.0)
    expected = localize(pairs.left, pairs.right, pairs.covariance)
    stations = localize.weighing_all()
    seen = sightings(
        known_views(stations.posed, stations.common), pairs.pixels, pairs.seen, pairs.covariance, pairs.time
    )
    turned = torch.linalg.qr(torch.eye(3).double() + 0.2 * mix[:3, :3])[0]
    frame = ((turned * torch.sign(turned.diagonal())).T @ localize.enu_from_rig.T).expand(4, 3, 3)
    timing = Timing(torch.zeros(2, 4).double(), torch.zeros(0, 3, 4).double(), torch.zeros(0, 4).double())
    local = anchored(seen, frame.movedim(0, -1), seen.place)
    found = track_states(
        stations, frame, seen.anchor, born(local, timing, torch.full((2, 1), 10.0).double()).summary(), None
    )
    assert found.status.tolist() == expected.status.tolist() == [0, 0, 0, 6]
    # Rows are linear around the place where the lines of sight meet; the localizer goes on to the optimum.
    error = (found.inverse_range - expected.inverse_range) / expected.inverse_range_sigma
    assert float(error.abs().max()) < 2e-4
    for name in ("inverse_range_sigma", "range_low"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=2e-4, atol=0, msg=name)
    for name in ("enu", "geodetic"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=1e-6, atol=1e-7, msg=name)
    # A track's bearing is where the target is, and not where light makes it seem to be.
    ahead = torch.nn.functional.normalize(expected.enu[:3], dim=-1)
    torch.testing.assert_close(found.bearing[:3], ahead, rtol=0, atol=1e-7)
    # The point sinks as its range grows, which one of the two neglects.
    unit = expected.covariance[:3].diagonal(dim1=-2, dim2=-1).sqrt()
    off = (found.covariance - expected.covariance)[:3] / unit[:, :, None] / unit[:, None, :]
    assert float(off.abs().max()) < 2e-3
    # What no point explains: 0.4 px between two marks of 0.3 px each.
    slope, value = seen.late.sum(0).movedim(-1, 0), seen.value.T[..., None]
    miss = (value - slope @ torch.linalg.lstsq(slope, value).solution).square().sum((1, 2)).sqrt()
    torch.testing.assert_close(miss, torch.full((4,), 0.4 / 0.3 / math.sqrt(2)).double(), rtol=0.02, atol=0)


def followed(
    tracker: Tracker, rigs: list, start: torch.Tensor, velocity: torch.Tensor, frames: int, seed: int, late: float = 0.0
) -> tuple[Tracks, torch.Tensor]:
    """Tracks at the end, one for each target in order, and the true places; each target has a true rig of its own."""
    generator = torch.Generator().manual_seed(seed)
    for frame in range(frames):
        time = frame / 10.0
        places, later = start + time * velocity, start + (time + late) * velocity
        marks = [seen_by(rig, places[i : i + 1], 0.3, generator, later[i : i + 1]) for i, rig in enumerate(rigs)]
        left, right = (torch.cat(side) for side in zip(*marks, strict=True))
        tracks = tracker(pairs_of(left, right, time))
    return tracks, places


def scattered(count: int, seed: int, speed: float = 10.0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    across = torch.linspace(-0.45, 0.45, count).double()[torch.randperm(count, generator=generator)]
    z = torch.linspace(math.log(300.0), math.log(5000.0), count).double().exp()
    up = 0.4 * (torch.rand(count, generator=generator).double() - 0.5)
    velocity = speed * torch.randn(count, 3, generator=generator).double()
    return torch.stack([across * z, up * z, z], -1), velocity


def test_errors_are_as_large_as_stated() -> None:
    """Each target has its own true rig, so that errors of the calibration are independent too: 6 degrees of freedom."""
    localize, count = tracked_site(0.003), 60
    yaws = math.radians(0.003) * torch.randn(count, generator=torch.Generator().manual_seed(3)).double()
    start, velocity = scattered(count, 1)
    tracker = Tracker(localize, STEADY)
    tracks, places = followed(tracker, [yawed_rig(localize.rig, float(y)) for y in yaws], start, velocity, 12, 5)
    assert tracks.number == tuple(range(1, count + 1))
    frame = tracker.frame.movedim(-1, 0) @ localize.enu_from_rig
    ray, pace = (frame @ places[..., None])[..., 0], (frame @ velocity[..., None])[..., 0]
    true = torch.cat([ray[:, :2] / ray[:, 2:], 1.0 / ray[:, 2:], pace / ray[:, 2:]], -1)
    belief = tracker.beliefs.summary()
    spread = belief.effect @ tracker.shared.root
    covariance = belief.noise + spread @ spread.mT
    unit = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    error = ((true - belief.mean) / unit)[..., None]
    white = torch.linalg.solve(covariance / unit[:, :, None] / unit[:, None, :], error)
    nees = float((error * white).sum((-2, -1)).mean())
    # The mean of 60 values of chi-squared with 6 degrees of freedom: 95 % between.
    assert 5.15 < nees < 6.9, nees
    state = tracks.state
    truth = 1.0 / torch.linalg.vector_norm(places, dim=-1)
    ratio = (state.inverse_range - truth) / state.inverse_range_sigma
    assert 0.8 < float(ratio.square().mean().sqrt()) < 1.2
    ok = state.status == 0
    assert int(ok.sum()) > 50
    moving = (state.velocity - velocity @ localize.enu_from_rig.T)[ok, :, None]
    speed = (moving * torch.linalg.solve(state.velocity_covariance[ok], moving)).sum((-2, -1)).mean()
    assert 2.3 < float(speed) < 3.7


def test_frames_reduce_noise_but_never_the_systematic_part() -> None:
    localize = tracked_site(0.01)
    start, still = torch.tensor([[0.0, 0.0, 2000.0]]).double(), torch.zeros(1, 3).double()
    options = TrackOptions(motions=(Motion(acceleration=0.0),), speed_mps=1e-6, confirm_hits=1)
    sigmas, systematic = [], []
    for frames in (1, 49):
        tracks, _ = followed(Tracker(localize, options), [localize.rig], start, still, frames, 0)
        square = float(tracks.state.enu[0, 1]) ** 2
        sigmas.append(float(tracks.state.covariance[0, 1, 1].sqrt()) / square)
        systematic.append(float(tracks.state.systematic[0, 1, 1].sqrt()) / square)
    # 0.01° of yaw over 10 m; the marks' 0.42 px of 1600 are 1.5 times as much.
    assert systematic == pytest.approx([math.radians(0.01) / 10.0] * 2, rel=1e-3)
    noise = [math.sqrt(a**2 - b**2) for a, b in zip(sigmas, systematic, strict=True)]
    assert noise[1] / noise[0] == pytest.approx(1 / 7, rel=1e-3)


def test_what_lasts_of_errors_in_marks_never_averages_away() -> None:
    """Targets whose right marks are off by their own constant shift of 0.1 px along each axis, and noise."""
    localize, count, lasting = tracked_site(), 60, 0.1
    start, velocity = scattered(count, 2, speed=3.0)
    options = dataclasses.replace(STEADY, lasting_px=lasting)
    plain, honest = Tracker(localize, dataclasses.replace(STEADY, lasting_px=0.0)), Tracker(localize, options)
    generator = torch.Generator().manual_seed(8)
    shift = lasting * torch.randn(count, 2, generator=generator).double()
    for frame in range(40):
        places = start + frame / 10.0 * velocity
        left, right = seen_by(localize.rig, places, 0.3, generator)
        both = [tracker(pairs_of(left, right + shift, frame / 10.0)).state for tracker in (plain, honest)]
    truth = 1.0 / torch.linalg.vector_norm(places, dim=-1)
    without, with_it = (float((((each.inverse_range - truth) / each.inverse_range_sigma) ** 2).mean()) for each in both)
    # Chi-squared of 60 targets over 60: 0.69 to 1.39 in 95 % of the cases.
    assert without > 1.5
    assert 0.69 < with_it < 1.39
    ahead = both[1].covariance[:, 1, 1] - both[0].covariance[:, 1, 1]
    torch.testing.assert_close(both[1].systematic[:, 1, 1], ahead, rtol=0.02, atol=0.0)


def test_the_effect_of_a_calibration_error_is_that_of_making_it() -> None:
    """A focal length that is wrong by 1 px, which matters little ahead and much aside, and a target that sweeps by."""
    rig = tracked_site().rig
    covariance = torch.zeros(5, 5, dtype=torch.float64)
    covariance[0, 0] = 1.0
    rig.covariance = RigCovariance.of(rig, right=covariance)
    localize = Localizer(rig.placed(origin=ORIGIN, heading_deg=0.0))
    found = []
    for error in (0.0, 0.05):
        tracker = Tracker(localize, TrackOptions(motions=(Motion(acceleration=3.0),), confirm_hits=1))
        for frame in range(25):
            left, right = rig(torch.tensor([[-40.0 + 3.0 * frame, 0.0, 120.0]]).double())[0].unbind(-2)
            # The true focal length is larger, and the marks are farther from the middle: it is believed too small.
            right = right + error / 1600.0 * (right - rig.right.center) * torch.tensor([1.0, 0.0])
            tracker(pairs_of(left, right, frame / 10.0))
        found.append(tracker.beliefs.summary())
    change = (found[1].mean - found[0].mean)[0] / 0.05
    sign = torch.sign(localize.calibration_factor.sum())
    unit = found[0].noise[0].diagonal().sqrt()
    torch.testing.assert_close(change / unit, sign * found[0].effect[0, :, 0] / unit, rtol=0.03, atol=0.01)
    assert float((change / unit).abs().max()) > 0.3


def test_a_wide_sweep_turns_the_frame_and_stays_exact() -> None:
    localize = tracked_site()
    start, velocity = torch.tensor([[-56.0, 0.0, 100.0]]).double(), torch.tensor([[28.0, 0.0, 0.0]]).double()
    tracker = Tracker(localize, TrackOptions(motions=(Motion(acceleration=0.1),)))
    tracks, places = followed(tracker, [localize.rig], start, velocity, 40, 1)
    assert tracks.number == (1,)
    assert not torch.allclose(
        tracker.frame[..., 0] @ localize.enu_from_rig @ torch.nn.functional.normalize(start[0], dim=0),
        tensor(0.0, 0.0, 1.0),
    )
    error = (tracks.state.enu - places @ localize.enu_from_rig.T)[..., None]
    assert float((error.mT @ torch.linalg.solve(tracks.state.covariance, error)).squeeze()) < 16.3


def test_models_find_out_how_a_target_moves() -> None:
    localize = tracked_site()
    generator = torch.Generator().manual_seed(0)
    tracker = Tracker(localize)
    rate, speed = 0.2, 12.0
    for frame in range(60):
        time = frame / 10.0
        east, ahead = speed / rate * math.sin(rate * time), speed / rate * (1 - math.cos(rate * time))
        turning = [east - 30.0, 0.0, ahead + 150.0]
        places = torch.tensor([turning, [20.0, 0.0, 150.0], [-60.0 + 10 * time, -10.0, 200.0]]).double()
        tracks = tracker(pairs_of(*seen_by(localize.rig, places, 0.3, generator), time))
    assert tracks.models.argmax(-1).tolist() == [2, 0, 1]
    assert torch.allclose(tracks.models.sum(-1), torch.ones(3).double())


def test_a_target_behind_another_keeps_its_number() -> None:
    """One crosses behind a nearer one; meanwhile every pairing on the common line is offered, ambiguous."""
    localize = tracked_site()
    generator = torch.Generator().manual_seed(2)
    tracker = Tracker(localize)
    for frame in range(60):
        time = frame / 10.0
        places = torch.tensor([[-20.0 + 10.0 * time, 0.0, 400.0], [45.0 - 20.0 * time, 0.0, 600.0]]).double()
        left, right = seen_by(localize.rig, places, 0.2, generator)
        both = torch.cat([torch.stack([left[0], right[1]])[None], torch.stack([left[1], right[0]])[None]])
        near = frame > 10
        if near:
            left, right = torch.cat([left, both[:, 0]]), torch.cat([right, both[:, 1]])
        tracks = tracker(pairs_of(left, right, time, 0.2, [near] * len(left)))
    assert sorted(tracks.number) == [1, 2]
    order = [tracks.number.index(n) for n in (1, 2)]
    assert tracks.state.enu[order, 1].tolist() == pytest.approx([400.0, 600.0], rel=0.03)


@pytest.mark.parametrize(("again", "number"), [(10.0, 1), (-10.0, 2)])
def test_recognized_by_its_motion_after_an_occlusion(again: float, number: int) -> None:
    localize = tracked_site()
    generator = torch.Generator().manual_seed(4)
    tracker = Tracker(localize, TrackOptions(motions=(Motion(acceleration=0.2),)))
    told = []
    for frame in range(70):
        time = frame / 10.0
        if 20 <= frame < 55:
            tracks = tracker(pairs_of(torch.zeros(0, 2).double(), torch.zeros(0, 2).double(), time), time)
        else:
            velocity = 10.0 if frame < 20 else again
            places = torch.tensor([[20.0 + velocity * (time - 5.5), 0.0, 400.0]]).double()
            tracks = tracker(pairs_of(*seen_by(localize.rig, places, 0.2, generator), time))
        told.append(tracks.number)
    assert told[19] == (1,)
    assert told[25] == (1,), "carried on for a while"
    assert float(tracks.unseen_s[0]) == 0.0
    assert told[40] == (), "lost"
    assert told[-1] == (number,)


def test_what_is_told_may_be_differentiated_further() -> None:
    localize, (start, velocity) = tracked_site(0.003), scattered(3, 1)
    tracker = Tracker(localize, STEADY)
    tracks, _ = followed(tracker, [localize.rig] * 3, start, velocity, 4, 5)
    weight = torch.ones(3, 3, dtype=torch.float64, requires_grad=True)
    (weight * tracks.state.enu).sum().backward()
    assert weight.grad is not None
    assert torch.equal(weight.grad, tracks.state.enu)
    assert torch.equal(copy.deepcopy(tracker).tracks().state.enu, tracks.state.enu)


@pytest.mark.parametrize(("course_deg", "speed"), [(90.0, 150.0), (180.0, 150.0), (45.0, 100.0), (180.0, 8.0)])
def test_aircraft_and_walkers_have_the_errors_that_are_stated(course_deg: float, speed: float) -> None:
    """By default: what crosses at 150 m/s has a track at once, and what comes so is not held to be slow."""
    pace = speed * tensor([math.sin(math.radians(course_deg)), 0.0, math.cos(math.radians(course_deg))])[0]
    inside, moving, told = [], [], 0
    for seed in range(3):
        site, generator = tracked_site(), torch.Generator().manual_seed(seed)
        tracker = Tracker(site)
        for time in range(40):
            place = tensor([0.0, -50.0, 2000.0]) + pace * (time - 20) / 10
            tracks = tracker(pairs_of(*seen_by(site.rig, place, 0.3, generator), time / 10), time / 10)
            if not tracks.number:
                continue
            told += 1
            state, far = tracks.state, float(torch.linalg.vector_norm(place))
            inside.append(float(state.range_low[0]) < far < float(state.range_high[0]))
            off = state.velocity[0] - pace[[0, 2, 1]] * tensor([1.0, 1.0, -1.0])[0]
            moving.append(float(off @ torch.linalg.solve(state.velocity_covariance[0], off)) < 16.27)
    assert told >= 3 * 37
    assert sum(inside) >= 0.9 * len(inside)
    assert sum(moving) >= 0.97 * len(moving)


def test_what_is_seen_once_is_not_told() -> None:
    localize = tracked_site()
    tracker = Tracker(localize)
    left, right = localize.rig(torch.tensor([[0.0, 0.0, 300.0]]).double())[0].unbind(-2)
    assert tracker(pairs_of(left, right, 0.0)).number == ()
    assert tracker(pairs_of(left[:0], right[:0], 0.0), 5.0).number == ()
    assert tracker.records == []


def test_time_must_be_given_and_must_not_go_back() -> None:
    tracker = Tracker(tracked_site())
    nothing = pairs_of(torch.zeros(0, 2).double(), torch.zeros(0, 2).double(), 0.0)
    with pytest.raises(InputError, match="give the time"):
        tracker(nothing)
    tracker(nothing, 3.0)
    with pytest.raises(InputError, match="not before the last one"):
        tracker(nothing, 2.0)
    with pytest.raises(InputError, match="record=True"):
        tracker.smoothed()


@pytest.mark.parametrize("wrong", [{"gate": 0.0}, {"motions": ()}, {"forget_after_s": 1.0}])
def test_impossible_options(wrong: dict[str, object]) -> None:
    with pytest.raises(InputError):
        TrackOptions(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("fast", [(0.0, 1.0), (1.0, math.nan), (1.0,), 7.0])
def test_impossible_speeds_of_a_motion(fast: Any) -> None:
    with pytest.raises(InputError, match="fast must be two positive numbers, across and along"):
        Motion(acceleration=1.0, fast=fast)


def test_tracks_are_tables() -> None:
    localize = tracked_site()
    tracker = Tracker(localize, STEADY, record=True)
    for time in range(4):
        points = tensor([10.0 + time, -3.0, 120.0], [-15.0, 20.0, 900.0], [0.0, 40.0, 90_000.0])
        left, right = localize.rig(points)[0].unbind(-2)
        tracks = tracker(pairs_of(left, right, float(time)))
    ours, theirs = polars.DataFrame(tracks.to_arrow()), pandas.DataFrame.from_arrow(tracks.to_arrow())
    assert ours["name"].to_list() == list(theirs["name"]) == [f"track {number}" for number in tracks.number]
    assert ours["hits"].to_list() == tracks.hits.tolist()
    assert set(ours["time_s"]) == {3.0}
    assert ours["status"].to_list() == ["ok", "ok", "bearing_only"]
    state = tracks.state
    for name, value in {
        "north_m": state.enu[:, 1], "cov_eu_m2": state.covariance[:, 0, 2], "lon": state.geodetic[:, 1],
        "velocity_up_mps": state.velocity[:, 2],
    }.items():  # fmt: skip
        assert ours[name].to_list() == [*value[:2].tolist(), None]
    assert (ours["range_low_m"] < ours["range_m"]).to_list() == [True, True, None]
    columns = track_columns(tracks, 1)
    assert set(ours.columns) <= {*TEXTS, *NUMBERS, *columns.extras}
    assert torch.tensor(ours["range_m"][:2]) == pytest.approx(columns.column("range_m")[:2], rel=1e-6)
    smoothed = tracker.smoothed()[0]
    table = pandas.DataFrame.from_arrow(smoothed.to_arrow())
    assert list(table["time_s"]) == smoothed.time.tolist()
    assert list(table["east_m"]) == smoothed.state.enu[:, 0].tolist()
