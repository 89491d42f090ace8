"""`kcal live` on two videos: positions within their intervals, restarts, and one line for whatever is wrong."""

from __future__ import annotations

import csv
import shutil
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from command_line import at_moment, invoked, ran, rows_of, terminate

pytest.importorskip("av", reason="the extra `video` is not installed")
from rtsp_server import RtspCamera
from video_scenes import VELOCITY, bright_spots, film, places, small_rig, write_video
from waiting import wait_for

from kcal import FileError, InputError, Origin, Rig, save_rig
from kcal.threads import Handover

FRAMES, LATE = 14, 0.03


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two videos: 15 frames a second, and some 25 at uneven times; the right camera is 30 ms later than it says.

    They are compressed as cameras do it.
    """
    folder, rig = tmp_path_factory.mktemp("scene"), small_rig()
    save_rig(rig, folder / "rig.json")
    times = [number / 15 for number in range(FRAMES)]
    write_video(folder / "left.mp4", film(rig, 0, times), times, crf=23)
    times = [round(0.013 + number / 25 + 0.008 * np.sin(number), 3) for number in range(25)]
    write_video(folder / "right.mp4", film(rig, 1, times, LATE), times, crf=23)
    return folder


@pytest.fixture
def folder(scene: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(scene, tmp_path, dirs_exist_ok=True))


def live(folder: Path, *options: str, detector: str = "video_scenes:bright_spots") -> str:
    videos = [str(folder / "left.mp4"), str(folder / "right.mp4")]
    command = ["live", str(folder / "rig.json"), *videos, "--detector", detector, "-o", str(folder / "tracks.csv")]
    return invoked(*command, *options)


@pytest.mark.slow
def test_positions_and_clock_are_right_within_their_sigmas(folder: Path) -> None:
    told = live(folder, "--clock-sigma", "0.1")
    assert f"{FRAMES} moments, {2 * (FRAMES - 3)} positions" in told
    assert f"videos: {FRAMES} and " in told
    offset, sigma = (float(told.split(word)[1].split()[0]) for word in ("images are ", "± "))
    assert abs(offset - 1e3 * LATE) < 3.5 * sigma
    # 12 to 19 ms where the noise of the images is drawn anew: compression leaves more or fewer matches.
    assert sigma < 25.0
    rows = rows_of(folder / "tracks.csv")
    assert len(rows) == 2 * (FRAMES - 3)
    for row in rows[-8:]:
        found = np.array([float(row[f"{axis}_m"]) for axis in ("east", "up", "north")]) * [1, -1, 1]
        true = places(float(row["time_s"])).numpy()
        target = int(np.abs(true - found).sum(1).argmin())
        sigma = np.sqrt([float(row[f"cov_{axis}_m2"]) for axis in ("ee", "uu", "nn")])
        # The images inside the boxes were matched: boxes alone leave some 4 m.
        assert sigma[2] < 2.0
        assert (np.abs(found - true[target]) < 3.5 * sigma).all(), (found, true[target], sigma)
        pace = float(row["velocity_east_mps"]) - float(VELOCITY[target, 0])
        assert abs(pace) < 3.5 * float(row["velocity_east_sigma_mps"])


@pytest.mark.slow
def test_sigterm_ends_it_and_the_next_run_continues(folder: Path) -> None:
    live(folder, "--clock-offset", str(LATE))
    whole = (folder / "tracks.csv").read_bytes()
    for path in folder.glob("tracks.csv*"):
        path.unlink()
    left_by_a_crash: dict[Path, bytes] = {}

    def terminated() -> None:
        left_by_a_crash.update((path, path.read_bytes()) for path in folder.glob("tracks.csv*"))
        terminate()

    with at_moment(7, terminated):
        assert "7 moments, 8 positions" in live(folder, "--clock-offset", str(LATE))
    told = live(folder, "--clock-offset", str(LATE))
    assert "continuing after 7 moments" in told
    # The first left frame is earlier than all right ones.
    assert f"{FRAMES - 8} moments" in told
    assert (folder / "tracks.csv").read_bytes() == whole
    # After a crash there is no newer checkpoint: seven moments are detected again, and not written again.
    for path, content in left_by_a_crash.items():
        path.write_bytes(content)
    assert f"{FRAMES - 8} moments" in live(folder, "--clock-offset", str(LATE))
    assert (folder / "tracks.csv").read_bytes() == whole


@pytest.mark.slow
def test_three_videos_of_three_cameras(tmp_path: Path) -> None:
    """The third camera stops in the middle and names stay; what SIGTERM interrupts is continued to the same table."""
    pair = small_rig()
    camera, north = pair.left, torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    center = torch.tensor([[0.0, 0, 0], [2.0, 0, 0], [-2.0, 0, 0]])
    origin = Origin(lat=19.07, lon=72.87, height=14.0)
    rig = Rig([camera] * 3, ["left", "right", "third"], north.repeat(3, 1, 1), center=center, origin=origin)
    rig.root = rig.with_errors(position_m=0.001, attitude_deg=0.001)
    save_rig(rig, tmp_path / "rig.json")
    west = Rig.pair(camera, camera, torch.eye(3), torch.tensor([2.0, 0.0, 0.0]))
    times = [number / 15 for number in range(FRAMES)]
    for name, scene, side, count in (("left", pair, 0, FRAMES), ("right", pair, 1, FRAMES), ("third", west, 1, 8)):
        write_video(tmp_path / f"{name}.mp4", film(scene, side, times[:count]), times[:count], crf=23)
    videos = [str(tmp_path / f"{name}.mp4") for name in rig.names]
    command = ["live", str(tmp_path / "rig.json"), *videos, "--detector", "video_scenes:bright_spots"]

    def run() -> str:
        return invoked(*command, "-o", tmp_path / "tracks.csv")

    run()
    whole = (tmp_path / "tracks.csv").read_bytes()
    rows = list(csv.DictReader(whole.decode().splitlines()))
    assert {row["name"] for row in rows} == {"track 1", "track 2"}
    assert {row["cameras"] for row in rows if row["sequence"] == "6"} == {"left right third"}
    for row in rows[-2:]:
        found = np.array([float(row[f"{axis}_m"]) for axis in ("east", "up", "north")]) * [1, -1, 1]
        true = places(float(row["time_s"])).numpy()
        sigma = np.sqrt([float(row[f"cov_{axis}_m2"]) for axis in ("ee", "uu", "nn")])
        assert (np.abs(found - true[np.abs(true - found).sum(1).argmin()]) < 3.5 * sigma).all()
    for path in tmp_path.glob("tracks.csv*"):
        path.unlink()
    with at_moment(5):
        run()
    assert "continuing after 5 moments" in run()
    assert (tmp_path / "tracks.csv").read_bytes() == whole


def nothing(image: np.ndarray) -> list[Box]:
    return []


def test_empty_images_and_exchanged_videos(folder: Path) -> None:
    assert f"{FRAMES} moments, 0 positions" in live(folder, detector="tests.cli.test_live_videos:nothing")
    for path in folder.glob("tracks.csv*"):
        path.unlink()
    (folder / "left.mp4").rename(folder / "other.mp4")
    (folder / "right.mp4").rename(folder / "left.mp4")
    (folder / "other.mp4").rename(folder / "right.mp4")
    assert "with boxes in both, none of one object: are videos and cameras in one order?" in live(folder)


def test_recordings_that_do_not_overlap(folder: Path) -> None:
    times = [7.0 + number / 15 for number in range(5)]
    write_video(folder / "right.mp4", film(small_rig(), 1, times, -7.0), times)
    with pytest.raises(FileError, match=r"no frames within 0.5 s of each other.*--clock-offset"):
        live(folder)
    # Seven seconds too late by its own clock.
    (folder / "tracks.csv.journal").unlink()
    assert "5 moments, 4 positions" in live(folder, "--clock-offset", "-7")


class Box:
    """What a detector of batches returns for one image."""

    def __init__(self, boxes: np.ndarray) -> None:
        self.xyxy, self.conf, self.cls, self.orig_shape, self.names = boxes, None, None, (240, 320), {}
        self.boxes = self


def of_batches(image: np.ndarray) -> list[Box]:
    assert image.shape == (240, 320, 3)
    assert image.dtype == np.uint8
    return [Box(bright_spots(image))]


def returns_text(image: np.ndarray) -> object:
    return object()


def raises(image: np.ndarray) -> None:
    raise ValueError("no weights\nwere loaded")


not_callable = 3


def test_a_detector_of_batches(folder: Path) -> None:
    told = live(folder, "--clock-offset", str(LATE), detector=f"{__name__}:of_batches")
    assert f"{FRAMES - 1} moments, {2 * (FRAMES - 4)} positions" in told


@pytest.mark.parametrize(
    ("detector", "message"),
    [
        ("nomodule:find", "detector nomodule:find: no module 'nomodule'"),
        ("video_scenes:find", "the module video_scenes has no 'find'"),
        ("video_scenes", "write package.module:callable"),
        (f"{__name__}:not_callable", "of type int, cannot be called"),
        (f"{__name__}:returns_text", "returned for the left image at 0.000 s: detections: object is not known"),
        (f"{__name__}:raises", "failed on the left image at 0.000 s: ValueError: no weights were loaded"),
    ],
)
def test_a_detector_that_does_not_work(folder: Path, detector: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        live(folder, detector=detector)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("words", ["left --detector a:b", "left right", "", "left right --detector a:b --detections -"])
def test_incomplete_commands(folder: Path, words: str) -> None:
    given = [str(folder / f"{word}.mp4") if word in ("left", "right") else word for word in words.split()]
    assert ran("live", folder / "rig.json", *given, "-o", folder / "t.csv").exit_code == 2


class Pairs(Handover[Any]):
    """Groups of frames on their way to the detector; the last one made is known to `slow_spots`."""

    last: ClassVar[Pairs]

    def __init__(self, items: Iterable[Any], most: int, *, waits: bool) -> None:
        if most == 1:
            Pairs.last = self
        super().__init__(items, most, waits=waits)


def slow_spots(image: np.ndarray) -> np.ndarray:
    """So slow that a pair is dropped meanwhile."""
    wait_for(lambda: Pairs.last.dropped > 0)
    return bright_spots(image)


@pytest.mark.slow
def test_two_rtsp_streams_whose_newest_frames_are_taken(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = small_rig()
    table = [film(rig, side, [1.0] * 7) for side in (0, 1)]
    monkeypatch.setattr("kcal.pipeline.video_source.Handover", Pairs)
    began = time.time()
    cameras = [RtspCamera(lambda when, side=side: table[side][round(10 * when) % 7], 10.0) for side in (0, 1)]
    with cameras[0], cameras[1], at_moment(5):
        videos = [camera.address for camera in cameras]
        command = ["live", str(folder / "rig.json"), *videos, "--detector", f"{__name__}:slow_spots"]
        done = ran(*command, "-o", folder / "tracks.csv", catch_exceptions=False)
    assert done.exit_code == 0
    assert "5 moments, " in done.output
    assert "pairs dropped for lack of time" in done.output
    assert "secret" not in done.output
    rows = rows_of(folder / "tracks.csv")
    assert rows
    for row in rows:
        assert np.abs(places(1.0)[:, 2].numpy() - float(row["north_m"])).min() < 5.0
        assert began <= float(row["time_s"]) < time.time()
