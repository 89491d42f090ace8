"""Clocks, and which frames of videos belong together."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from track_scenes import pairs_of, seen_by, tracked_site

from kcal import FileError, InputError
from kcal.pipeline import video_source
from kcal.pipeline.video_source import FramesTogether, VideoCounts, frames_together
from kcal.track import ClockPrior, Motion, Tracker, TrackOptions

# Clocks: offset, drift and slope from targets that move, covered by their sigmas; frames at different times.


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


# Which frames of videos belong together, from which offset on, and what is counted: without a video.


class Frame(NamedTuple):
    time: float


SIZES = {"left": (64, 48), "right": (32, 24), "third": (16, 12)}


def videos(monkeypatch: pytest.MonkeyPatch, *times: list[float]) -> list[tuple[Any, ...]]:
    """Files that have frames at these times; what they are asked for."""
    asked: list[tuple[Any, ...]] = []

    def frames(path: Path, size: tuple[int, int], since: float, undecoded: Any, _tell: Any) -> Iterator[Frame]:
        asked.append((path.name, size, round(since, 6)))
        undecoded()
        return (Frame(time) for time in times[int(path.name)] if time >= since)

    monkeypatch.setattr(video_source, "file_frames", frames)
    return asked


def groups(count: int, offset: int = 0, **more: Any) -> tuple[FramesTogether, list[Any]]:
    sizes = dict(list(SIZES.items())[:count])
    together = FramesTogether([str(k) for k in range(count)], sizes, **more)
    found = [(place, time, [frame and frame.time for frame in group]) for place, (time, group) in together(offset)]
    together.close()
    return together, found


def test_pairs_alone_or_all_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """The offset is a microsecond after the first camera's time; the right clock may be behind."""
    asked = videos(monkeypatch, [0.0, 1.0, 2.0], [0.1, 2.1, 3.0])
    both, found = groups(2, pairs=True, apart_s=0.2)
    assert found == [(1, 0.0, [0.0, 0.1]), (2_000_001, 2.0, [2.0, 2.1])]
    assert both.counts.frames == {"left": 3, "right": 2}
    assert both.counts.undecoded == 2
    assert asked == [("0", (64, 48), -0.2), ("1", (32, 24), -0.4)]
    _, found = groups(2, pairs=False, apart_s=0.2)
    assert found == [
        (1, 0.0, [0.0, 0.1]), (1_000_001, 1.0, [1.0, None]), (2_000_001, 2.0, [2.0, 2.1]),
        (3_000_001, 3.0, [None, 3.0]),
    ]  # fmt: skip
    # .05 s late: what says 1.05 is of 1.1; of times to go on from, frames just before are read again.
    asked.clear()
    _, found = groups(2, 1, pairs=True, apart_s=0.12, late=lambda _: 0.05)
    assert [place for place, _, _ in found] == []
    _, found = groups(2, 1, pairs=True, apart_s=0.16, late=lambda _: 0.05)
    assert found == [(2_000_001, 2.0, [2.0, 2.1])]
    assert asked[-2:] == [("0", (64, 48), -0.159999), ("1", (32, 24), -0.369999)]


def test_three_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    videos(monkeypatch, [1.0, 2.0], [1.1, 2.4], [1.05, 1.95])
    _, found = groups(3, pairs=False, apart_s=0.2, late=lambda c: -0.05 * c)
    assert [place for place, _, _ in found] == [950_001, 1_850_001, 2_350_001]
    assert [group for _, _, group in found] == [[1.0, 1.1, 1.05], [2.0, None, 1.95], [None, 2.4, None]]


def test_what_is_before_the_first_camera_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Times count from second 0 of the first file: what another one shows before is left out, and not silently."""
    videos(monkeypatch, [0.0, 1.0], [0.0, 2.0, 3.0], [0.0, 1.0])
    told: list[str] = []
    options: dict[str, Any] = {"apart_s": 0.2, "late": lambda c: -2.0 if c == 1 else 0.5, "tell": told.append}
    _, found = groups(3, pairs=False, **options)
    assert [time for _, time, _ in found] == [0.0, 0.5, 1.0, 1.5]
    (text,) = told
    assert text.startswith("right: what it shows in the 2 s before second 0 of left is left out")
    # Not where a run goes on, nor of pairs, whose frames without a partner are left out anyway.
    groups(3, 500_000, pairs=False, **options)
    videos(monkeypatch, [0.0, 1.0], [0.0, 2.0, 3.0])
    groups(2, pairs=True, **options)
    assert len(told) == 1


def test_nothing_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two files that never meet are refused; not where a run goes on, nor after it was ended."""
    videos(monkeypatch, [0.0, 1.0], [50.0, 51.0])
    for pairs in (True, False):
        with pytest.raises(FileError, match=r"0 and 1: no frames within 0\.5 s of each other; if the"):
            groups(2, pairs=pairs)
    assert groups(2, 1, pairs=True)[1] == []
    ended = FramesTogether(["0", "1"], {"left": (6, 4), "right": (6, 4)}, pairs=True)
    ended.close()
    assert list(ended(0)) == []


def test_what_is_refused() -> None:
    sizes = {"left": (6, 4), "right": (6, 4)}
    for names in (["a"], ["a", "b", "c"]):
        with pytest.raises(InputError, match=f"2 videos are needed, of left, right; got {len(names)}"):
            FramesTogether(names, sizes, pairs=True)
    for names in (["a.mp4", "rtsp://one/b"], ["rtsp://one/b", "a.mp4"]):
        with pytest.raises(InputError, match="files alone or live streams alone"):
            FramesTogether(names, sizes, pairs=True)
    assert FramesTogether(["rtsp://one/b", "rtsp://one/a"], sizes, pairs=True).live
    assert not FramesTogether(["a.mp4", "b.mp4"], sizes, pairs=True).live


def test_live_streams_without_partners_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Once, at the hundredth frame of a camera, unless some have met."""

    def frames(times: dict[str, list[float]]) -> Any:
        return lambda video, *_: (Frame(time) for time in times[video[-1]])

    sizes = {"left": (6, 4), "right": (6, 4)}
    for late, told in ((500.0, 1), (0.1, 0)):
        ticks = [float(k) for k in range(150)]
        monkeypatch.setattr(video_source, "live_frames", frames({"a": ticks, "b": [late + t for t in ticks]}))
        words: list[str] = []
        live = FramesTogether(["rtsp://one/a", "rtsp://one/b"], sizes, pairs=False, tell=words.append)
        monkeypatch.setattr(video_source, "_FRAMES", 1000)
        found = list(live(0))
        live.close()
        assert len([word for word in words if "100 frames of the left camera" in word]) == told
        assert len(found) + live.counts.dropped in (150, 300)


def test_counts_in_words() -> None:
    assert str(VideoCounts(frames={"left": 1200, "right": 7}, paired=5)) == "videos: 1,200 and 7 frames, 5 pairs"
    assert str(VideoCounts(frames={"a": 1, "b": 2, "c": 3}, paired=1, undecoded=2, dropped=4)) == (
        "videos: 1, 2 and 3 frames, 1 groups; 2 damaged or out of order, left out; 4 groups dropped for lack of time"
    )


def test_frames_wait_for_the_nearer_group() -> None:
    """At the limit they belong together, beyond it not; a frame nearer to the leader's next one waits."""

    def together(*times: list[float], apart: float = 0.5, late: float = 0.0) -> list[list[float | None]]:
        cameras = [(Frame(time) for time in own) for own in times]
        found = frames_together(cameras, lambda c: late if c else 0.0, apart)
        return [[frame.time if frame else None for frame in group] for _, group in found]

    assert together([0.0], [0.5]) == [[0.0, 0.5]]
    assert together([0.0], [0.5625]) == [[0.0, None], [None, 0.5625]]
    assert together([0.0, 1.0], [0.5]) == [[0.0, 0.5], [1.0, None]]
    assert together([0.0, 1.0], [0.5625], apart=0.75) == [[0.0, None], [1.0, 0.5625]]
    assert together([0.0], [0.75], late=-0.5) == [[0.0, 0.75]]
    assert together([], [1.0, 2.0]) == [[None, 1.0], [None, 2.0]]
    assert together([], []) == []
