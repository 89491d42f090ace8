"""Tracks over stations far apart: who saw what, names that stay at a hand-over, bearings of one, clocks of each."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from kcal import InputError, Localizer, Rig
from kcal.pipeline.association import AssociationOptions, associate
from kcal.pipeline.pairing import ObjectViews
from kcal.rig import Mounting, planned_rig
from kcal.track import ClockPrior, Detections, Motion, Tracker, TrackOptions, group_objects
from scripts.shared.station_scenes import ORIGIN, drawn_errors, marks, ring

SIZE = (1920, 1080)
STEADY = TrackOptions(motions=(Motion(acceleration=0.02),), lose_after_s=5.0, forget_after_s=20.0, lasting_px=0.0)


def boxes(pixels: Tensor, time: float = 0.0) -> Detections:
    return Detections(
        boxes=torch.cat([pixels - 6.0, pixels + 6.0], -1), score=torch.ones(len(pixels)).double(),
        category=("object",) * len(pixels), track=(None,) * len(pixels), size=SIZE, time=time,
    )  # fmt: skip


def views_of(pixels: Tensor, seen: Tensor, time: Tensor | float, sigma: float = 1.0) -> ObjectViews:
    count, cameras = seen.shape
    return ObjectViews(
        pixels=pixels, seen=seen, time=torch.as_tensor(time, dtype=torch.float64).expand(count, cameras).clone(),
        covariance=sigma**2 * torch.eye(2 * cameras).double().expand(count, -1, -1), score=torch.ones(count),
        category=("object",) * count, ambiguous=torch.zeros(count, dtype=torch.bool),
    )  # fmt: skip


def stations(count: int = 3, radius: float = 8000.0) -> Rig:
    rig = ring(count, radius)
    rig.root = rig.with_errors(position_m=0.3, attitude_deg=0.004, refraction=0.05)
    return rig


def scene(count: int, seed: int) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(seed)
    places = torch.rand(count, 3, generator=g).double() * torch.tensor([4000.0, 4000.0, 500.0])
    return places - torch.tensor([2000.0, 2000.0, -100.0]), 15.0 * torch.randn(count, 3, generator=g).double()


def test_two_cameras_of_one_mast_are_paired_as_ever() -> None:
    rig = planned_rig()
    rig.mounting = Mounting(origin=ORIGIN, heading_deg=0.0, refraction=0.0)
    g = torch.Generator().manual_seed(1)
    z = torch.linspace(200.0, 900.0, 30).double()
    places = torch.stack([(torch.rand(30, generator=g).double() - 0.5) * 0.8 * z, 0.1 * z * torch.sin(z), z], -1)
    left, right = rig(places)[0].unbind(-2)
    left, right = (p + 0.5 * torch.randn(30, 2, generator=g).double() for p in (left, right))
    seen = boxes(left), boxes(right[torch.randperm(30, generator=g)])
    # The nearest range is a default of masts.
    options = AssociationOptions(box_sigma=1.0, nearest=100.0)
    expected = associate(rig, *seen, options)
    found = group_objects(Localizer(rig, weights="all"), seen, options)
    both = found.seen.all(1)
    pairs = {
        tuple(p.flatten().tolist()): bool(a) for p, a in zip(found.pixels[both], found.ambiguous[both], strict=True)
    }
    wanted = torch.cat([seen[0].anchors()[expected.left], seen[1].anchors()[expected.right]], -1).tolist()
    assert pairs == {tuple(p): bool(a) for p, a in zip(wanted, expected.ambiguous, strict=True)}
    assert len(pairs) > 25


def test_errors_of_tracks_are_as_large_as_stated() -> None:
    """Each target has its own true rig, so that shared errors are independent too; 3 degrees of freedom."""
    rig, count = stations(4), 60
    start, velocity = scene(count, 5)
    g = torch.Generator().manual_seed(6)
    errors = drawn_errors(rig.root, count, g)
    tracker = Tracker(Localizer(rig), STEADY)
    for second in range(8):
        places = start + second * velocity
        pixels = marks(rig, places, errors) + torch.randn(count, 4, 2, generator=g).double()
        tracks = tracker(views_of(pixels, torch.rand(count, 4, generator=g) < 0.8, float(second)), float(second))
    ok = tracks.state.status == 0
    assert int(ok.sum()) > 50
    near = torch.cdist(tracks.state.enu[ok], places).argmin(-1)
    error = (tracks.state.enu[ok] - places[near])[..., None]
    nees = float((error.mT @ torch.linalg.solve(tracks.state.covariance[ok], error)).mean())
    # The mean of 50 values of chi-squared with three degrees of freedom: 99 % between.
    assert 2.2 < nees < 4.0, nees
    moved = (tracks.state.velocity[ok] - velocity[near])[..., None]
    speed = float((moved.mT @ torch.linalg.solve(tracks.state.velocity_covariance[ok], moved)).mean())
    assert 2.1 < speed < 4.1, speed


def test_a_name_lives_through_bearings_and_a_hand_over() -> None:
    """Cameras 1 and 2 see it, then 2 alone, then 2 and 3, then 3 alone: one track; errors grow while one sees it."""
    rig = stations()
    # Focal lengths are not exact either.
    lens = torch.zeros(3, rig.quantities, dtype=torch.float64)
    lens[torch.arange(3), rig.sizes[0] * torch.arange(3)] = 0.1
    rig.root = torch.cat([rig.root, lens])
    g = torch.Generator().manual_seed(7)
    start, velocity = torch.tensor([[-400.0, 300.0, 200.0]]).double(), torch.tensor([[12.0, -5.0, 0.0]]).double()
    tracker = Tracker(Localizer(rig), STEADY)
    shown, sigmas, seen_by = set(), [], []
    for second in range(40):
        who = [[0, 1], [1], [1, 2], [2]][second // 10]
        places = start + second * velocity
        pixels = marks(rig, places) + torch.randn(1, 3, 2, generator=g).double()
        seen = torch.zeros(1, 3, dtype=torch.bool)
        seen[0, who] = True
        tracks = tracker(views_of(pixels, seen, float(second)), float(second))
        shown |= set(tracks.number)
        if second > 5:
            error = (tracks.state.enu[0] - places[0])[:, None]
            assert float(error.T @ torch.linalg.solve(tracks.state.covariance[0], error)) < 25.0
            sigmas.append(float(tracks.state.covariance[0].diagonal().sum().sqrt()))
            seen_by.append(tracks.seen[0].nonzero()[:, 0].tolist())
    assert shown == {1}
    assert tracks.state.anchor.tolist() == [0]
    assert seen_by[0] == [0, 1]
    assert seen_by[-1] == [2]
    assert sigmas[13] > 1.5 * sigmas[3]
    assert sigmas[23] < 0.7 * sigmas[13]


def test_one_camera_begins_no_track() -> None:
    rig = stations()
    tracker = Tracker(Localizer(rig), STEADY)
    pixels, seen = marks(rig, torch.tensor([[0.0, 0.0, 200.0]]).double()), torch.tensor([[False, True, False]])
    for second in range(6):
        assert tracker(views_of(pixels, seen, float(second)), float(second)).number == ()
    assert tracker.records == []


def test_a_row_that_is_not_finite_loses_no_other() -> None:
    rig, (places, _) = stations(), scene(4, 8)
    pixels, seen = marks(rig, places), torch.ones(4, 3, dtype=torch.bool)
    broken = pixels.clone()
    broken[1] = math.nan
    broken[2, 0] = math.nan
    found = []
    for given, there in ((broken, seen), (pixels, seen & torch.isfinite(broken).all(-1))):
        tracker = Tracker(Localizer(rig), STEADY)
        for second in range(6):
            tracks = tracker(views_of(given, there, float(second)), float(second))
        found.append(tracks)
    assert found[0].number == found[1].number == (1, 2, 3)
    for name, value, other in zip(found[0].state._fields, found[0].state, found[1].state, strict=True):
        assert torch.equal(value, other), name
    assert bool(torch.isfinite(found[0].state.enu).all())


def test_the_clock_of_each_camera_is_found() -> None:
    rig = ring(3, 1500.0)
    rig.root = rig.with_errors(attitude_deg=0.001)
    g = torch.Generator().manual_seed(9)
    start = torch.tensor([[-300.0, 0.0, 150.0], [200.0, 200.0, 150.0], [0.0, -300.0, 250.0], [100.0, 0.0, 200.0]])
    velocity = torch.tensor([[25.0, 5.0, 0.0], [-10.0, -20.0, 0.0], [5.0, 25.0, -3.0], [-22.0, 8.0, 2.0]]).double()
    late = torch.tensor([0.0, 0.3, -0.2]).double()
    clock = [ClockPrior(offset_sigma_s=0.5, drift_sigma=1e-4), ClockPrior(offset_s=-0.1, offset_sigma_s=0.5)]
    tracker = Tracker(Localizer(rig), STEADY, clock=clock)
    for frame in range(30):
        time = frame / 3.0
        pixels = torch.stack([marks(rig, start + (time + float(d)) * velocity)[:, c] for c, d in enumerate(late)], 1)
        tracker(
            views_of(pixels + 0.5 * torch.randn(4, 3, 2, generator=g).double(), torch.ones(4, 3) > 0, time, 0.5), time
        )
    for camera in (1, 2):
        offset, sigma = tracker.clock_estimate(camera).offset(5.0)
        assert abs(offset - float(late[camera])) < 3 * sigma < 0.15
    with pytest.raises(InputError, match="camera 3"):
        tracker.clock_estimate(3)


def test_refusals() -> None:
    localize = Localizer(stations())
    with pytest.raises(InputError, match="tower 2 need a time"):
        group_objects(localize, [None, dataclasses.replace(boxes(torch.zeros(1, 2)), time=None), None])
    with pytest.raises(InputError, match="of 3 cameras"):
        group_objects(localize, [None, None])
    with pytest.raises(InputError, match="each of 2 cameras"):
        Tracker(localize, clock=[ClockPrior()])
    with pytest.raises(InputError, match="objects of 2 cameras"):
        Tracker(localize)(views_of(torch.zeros(1, 2, 2), torch.ones(1, 2) > 0, 0.0))
    with pytest.raises(InputError, match="covariance: shape"):
        dataclasses.replace(views_of(torch.zeros(1, 2, 2), torch.ones(1, 2) > 0, 0.0), covariance=torch.eye(4))
