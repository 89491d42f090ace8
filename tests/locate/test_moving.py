"""Tracks of known positions: reading, interpolation with its sigma, identities and clocks."""

import math
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kcal import FileError, InputError, MeasuredPosition
from kcal.locate.moving import MovingOptions, MovingTrack, Sighting, match_moving, read_sightings, read_tracks
from scripts.check.moving import CAMERA, CENTERS, LATE, NAMES, one_draw, path_of

HEAD = "name,time,lat,lon,height,sigma,sigma_up,constant_sigma,latency_sigma\n"


def track(interval: float, noise: float, seed: int = 0) -> MovingTrack:
    random = torch.Generator().manual_seed(seed)
    times = torch.arange(0.0, 60.0, interval, dtype=torch.float64)
    points = path_of("drone", random)(times)
    points = points + noise * torch.randn(points.shape, generator=random, dtype=torch.float64)
    return MovingTrack(name="drone", times=times, points=points, sigma=torch.full_like(points, max(noise, 1e-3)))


@pytest.mark.parametrize("interval", [0.5, 2.0, 4.0])
@pytest.mark.parametrize("noise", [0.02, 1.0])
def test_interpolation_states_at_least_its_error(interval: float, noise: float) -> None:
    own = track(interval, noise)
    times = torch.arange(1.0, 55.0, 0.37, dtype=torch.float64)
    found = own.at(times)
    truth = path_of("drone", torch.Generator().manual_seed(0))(times)
    z = (found.points - truth) / found.sigma
    # Cautious by design: every other fix is left out to learn it.
    assert 0.1 < float(z.square().mean().sqrt()) < 1.15


def test_velocity_does_not_follow_the_noise() -> None:
    own = track(1.0, 1.0)
    times = torch.arange(5.0, 50.0, 0.5, dtype=torch.float64)
    path = path_of("drone", torch.Generator().manual_seed(0))
    truth = (path(times + 1e-3) - path(times - 1e-3)) / 2e-3
    raw = own.points.diff(dim=0) - path(own.times).diff(dim=0)
    error = (own.at(times).velocity - truth).square().mean().sqrt()
    assert error < 0.5 * raw.square().mean().sqrt()


def test_nothing_is_known_in_gaps_and_outside() -> None:
    times = torch.tensor([0.0, 1, 2, 3, 4, 20, 21], dtype=torch.float64)
    own = MovingTrack(
        name="ship", times=times, points=times[:, None] * torch.ones(3).double(), sigma=torch.ones(7, 3).double()
    )
    found = own.at(torch.tensor([-0.1, 0.0, 2.5, 10.0, 20.5, 21.1], dtype=torch.float64))
    assert torch.isfinite(found.points).all(-1).tolist() == [False, True, True, False, True, False]


@given(st.permutations(range(6)))
@settings(max_examples=10, deadline=None)
def test_lines_may_come_in_any_order(order: list[int]) -> None:
    import tempfile

    lines = [f"a,{t},54.{t},7.5,{10 + t},2,3,8,0.3\n" for t in range(6)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "t.csv")
        path.write_text(HEAD + "".join(lines[i] for i in order))
        (found,), origin = read_tracks(path)
    assert found.times.tolist() == [0, 1, 2, 3, 4, 5]
    assert origin.lat == pytest.approx(54 + order[0] / 10)
    assert found.sigma[0].tolist() == [2, 2, 3]
    assert found.constant == (8, 8, 8)
    assert found.latency == 0.3


def test_dates_are_seconds_since_1970(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text(
        "name,time,east,north,up,sigma\n" + "".join(f"a,2026-11-24T20:47:2{i}+01:00,{i},0,0,1\n" for i in range(5))
    )
    assert read_tracks(path)[0][0].times.tolist() == [1795549640.0 + i for i in range(5)]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a,0,54,7,10,2,3,8,0\n" * 5, "rise"),
        ("a,0,54,7,10,2,3,8,0\n", "4 or more"),
        ("a,x,54,7,10,2,3,8,0\n", "zone"),
        ("a,2026-11-24T20:47:26,54,7,10,2,3,8,0\n", "zone"),
        ("a,0,95,7,10,2,3,8,0\n", "latitude"),
        ("a,0,54,7,10,,3,8,0\n", "sigma is empty"),
        ("a,0,54,7,10,-1,3,8,0\n", "positive"),
        ("a,0,54,7,10,2,3,-8,0\n", "constant_sigma"),
    ],
)
def test_bad_tracks_are_refused(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "t.csv"
    path.write_text(HEAD + text)
    with pytest.raises(FileError, match=says):
        read_tracks(path)


def test_bad_sightings_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    path.write_text("name,camera,time,u,v\nship,left,0,1,2\nship,middle,0,1,2\n")
    with pytest.raises(FileError, match="middle"):
        read_sightings(path, NAMES)
    path.write_text("name,camera,time,u,v\nship,left,0,1,2\nship,left,0,1,2\n")
    with pytest.raises(FileError, match="before"):
        read_sightings(path, NAMES)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ships", "aircraft"])
def test_wrong_names_are_found(kind: str) -> None:
    found = one_draw(kind, 1)
    assert found.false == 0
    assert found.matched > 0.9
    assert abs(found.yaw) < 4 * found.sigma
    assert abs(found.late) < 4 * found.late_sigma


def test_a_minute_of_a_drone() -> None:
    found = one_draw("drone", 2)
    assert found.sigma < 0.002
    assert abs(found.yaw) < 4 * found.sigma
    assert found.late_sigma < 0.002
    assert abs(found.late) < 4 * found.late_sigma


def test_a_thing_that_is_no_track_is_left_out() -> None:
    own = track(0.1, 0.02)
    path = path_of("drone", torch.Generator().manual_seed(0))
    look = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    seen = torch.arange(2.0, 50.0, 0.5, dtype=torch.float64)
    unknown = torch.full((len(seen),), math.nan, dtype=torch.float64)
    sightings = []
    for c in range(2):
        pixels = CAMERA.project((path(seen + LATE) - CENTERS[c]) @ look.T)[0]
        sightings.append(Sighting(label="drone", camera=c, times=seen, pixels=pixels, sigma=unknown))
    bird = torch.stack([400 + 15 * seen, 300 + 3 * seen], 1)
    sightings.append(Sighting(label="bird", camera=0, times=seen, pixels=bird, sigma=unknown))
    places = tuple(
        MeasuredPosition(camera=c, point=CENTERS[c], sigma=torch.full((3,), 0.02).double()) for c in range(2)
    )
    found = match_moving([own], sightings, (CAMERA, CAMERA), NAMES, places, MovingOptions(pixel_sigma=0.1))
    assert {(one.label, one.track) for one in found.identities} == {("drone", "drone"), ("bird", None)}
    assert abs(found.clock - LATE) < 0.1
    assert torch.isfinite(found.landmarks.pixels).all()
    # Each fix is used once.
    assert len(set(found.landmarks.names)) == len(found.landmarks.names) <= len(own.times)


def test_times_without_anything_in_common_are_refused() -> None:
    own = track(0.1, 0.02)
    late = torch.arange(1000.0, 1010.0, 1.0, dtype=torch.float64)
    unknown = torch.full((len(late),), math.nan, dtype=torch.float64)
    pixels = torch.full((len(late), 2), 500.0, dtype=torch.float64)
    sighting = Sighting(label="drone", camera=0, times=late, pixels=pixels, sigma=unknown)
    with pytest.raises(InputError, match="clocks"):
        match_moving([own], [sighting], (CAMERA, CAMERA), NAMES)
