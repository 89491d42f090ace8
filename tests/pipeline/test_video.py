"""Frames of videos: their times, which belong together, damaged and wrong files, and threads that hand them over."""

import shutil
import threading
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("av", reason="the extra `video` is not installed")
import av
from video_scenes import SIZE, drawn_image, small_rig, write_video

from kcal.errors import FileError
from kcal.pipeline.video_source import file_frames, frames_together
from kcal.threads import Handover

Frame = namedtuple("Frame", "time")
TIMES = [0.0, 0.04, 0.1, 0.101, 0.3, 0.34, 1.5, 1.54, 1.6, 2.9, 3.0, 3.04, 3.08, 3.2]


def images(count: int) -> list[np.ndarray]:
    random = np.random.default_rng(0)
    return [np.full(SIZE[::-1], 40 + 5 * number, np.uint8) + random.integers(0, 5, SIZE[::-1], np.uint8)
            for number in range(count)]  # fmt: skip


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_video(tmp_path_factory.mktemp("video") / "video.mp4", images(len(TIMES)), TIMES)


def paired(left: list[float], right: list[float], late: float = 0.0, apart: float = 0.5) -> list[tuple[float, float]]:
    frames = map(Frame, left), map(Frame, right)
    found = frames_together(frames, lambda c: late if c else 0.0, apart, whole=True)
    return [(one.time, other.time) for _, (one, other) in found]


def test_frames_have_their_own_times_and_gray_levels(video: Path) -> None:
    frames = list(file_frames(video, SIZE))
    assert [frame.time for frame in frames] == pytest.approx(TIMES, abs=1e-9)
    for frame, image in zip(frames, images(len(TIMES)), strict=True):
        assert frame.colors().shape == (SIZE[1], SIZE[0], 3)
        # Full range: 255 is white, also where the video keeps 235 for it.
        assert np.abs(frame.gray().numpy().astype(float) - image).mean() < 0.5
        assert (frame.colors()[..., 0] == frame.colors()[..., 2]).all()


def test_colors_are_red_green_blue_and_gray_levels_full(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "red.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"crf": "1"})
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
        image[..., 0] = 250
        image[:40] = 255
        container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    frame = next(file_frames(tmp_path / "red.mp4", SIZE))
    assert frame.colors()[120, 160].tolist() == pytest.approx([250, 0, 0], abs=8)
    assert frame.gray()[10, 10] >= 254


@pytest.mark.parametrize("since", [0.0, 0.05, 1.55, 3.1, 9.0])
def test_winding_gives_the_same_frames(video: Path, since: float) -> None:
    whole = {frame.place: frame.gray() for frame in file_frames(video, SIZE)}
    wanted = [place for place in whole if place > 1e6 * since]
    found = [frame for frame in file_frames(video, SIZE, since) if frame.place > 1e6 * since]
    assert [frame.place for frame in found] == wanted
    assert all((frame.gray() == whole[frame.place]).all() for frame in found)


def test_nearest_frames_each_once() -> None:
    """10 frames a second against 25, and the other way round; a gap; a late clock."""
    slow, fast = [k / 10 for k in range(10)], [0.013 + k / 25 for k in range(25)]
    found = paired(slow, fast)
    assert [one for one, _ in found] == slow
    assert all(abs(one - other) <= 0.0201 for one, other in found)
    turned = paired(fast, slow)
    assert [other for _, other in turned] == slow
    assert all(abs(one - other) <= 0.0201 for one, other in turned)
    gap = [time for time in fast if not 0.3 < time < 0.7]
    assert [one for one, _ in paired(slow, gap, apart=0.05)] == [0.0, 0.1, 0.2, 0.3, 0.7, 0.8, 0.9]
    assert paired(slow, [time + 5.0 for time in slow], late=-5.0) == [(time, time + 5.0) for time in slow]
    assert paired(slow, []) == paired([], fast) == []


def test_a_video_that_ends_first_ends_the_pairs() -> None:
    frames = iter(map(Frame, np.arange(0.0, 1e6)))
    assert len(list(frames_together([frames, map(Frame, (0.0, 1.0, 2.0))], lambda _: 0.0, 0.4, whole=True))) == 3
    assert next(frames).time < 10


def test_another_size_is_refused(video: Path) -> None:
    with pytest.raises(FileError, match="frames of 320x240 px, but the camera has 640x480"):
        next(file_frames(video, (640, 480)))


def test_files_that_are_no_videos(tmp_path: Path) -> None:
    garbage = tmp_path / "garbage.mp4"
    garbage.write_bytes(b"no video at all" * 1000)
    with pytest.raises(FileError, match="cannot be opened as a video"):
        next(file_frames(garbage, SIZE))
    with pytest.raises(FileError, match="no such file"):
        next(file_frames(tmp_path / "nowhere.mp4", SIZE))


@pytest.mark.parametrize("kind", ["ffconcat version 1.0\nfile {name}\n", "#EXTM3U\n#EXTINF:1\n{name}\n"])
def test_a_playlist_opens_nothing_else(video: Path, tmp_path: Path, kind: str) -> None:
    shutil.copyfile(video, tmp_path / "video.mp4")
    (tmp_path / "list.mp4").write_text(kind.format(name="video.mp4"), encoding="utf-8")
    with pytest.raises(FileError, match="cannot be opened as a video"):
        next(file_frames(tmp_path / "list.mp4", SIZE))


def test_a_video_without_times_is_refused(tmp_path: Path) -> None:
    """A raw stream, to which libav gives the times of 25 frames a second whatever the camera did."""
    path = tmp_path / "raw.h264"
    with av.open(str(path), "w", format="h264") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        for image in images(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray")))
        container.mux(stream.encode())
    with pytest.raises(FileError, match="raw stream has no times"):
        next(file_frames(path, SIZE))


def test_damaged_frames_are_left_out_and_counted(tmp_path: Path) -> None:
    scene = [drawn_image(small_rig(), 0, number / 10, np.random.default_rng(number)) for number in range(24)]
    path = write_video(tmp_path / "damaged.mp4", scene, [number / 10 for number in range(24)])
    content = bytearray(path.read_bytes())
    at = len(content) // 4
    content[at : at + 20_000] = np.random.default_rng(0).bytes(20_000)
    path.write_bytes(content)
    lost: list[None] = []
    found = list(file_frames(path, SIZE, undecoded=lambda: lost.append(None)))
    assert lost
    # What follows the next key frame is good again.
    assert 12 < len(found) < 24
    for frame in found:
        number = round(10 * frame.time)
        assert np.abs(frame.gray().numpy().astype(float) - scene[number]).mean() < 1.0, number


@pytest.mark.parametrize("name", ["cut.mkv", "cut.mp4"])
def test_a_file_that_was_cut_off_is_told(tmp_path: Path, name: str) -> None:
    times = [number / 10 for number in range(40)]
    whole = write_video(tmp_path / f"whole-{name}", images(40), times, index_first=name.endswith("mp4"))
    told: list[str] = []
    assert len(list(file_frames(whole, SIZE, tell=told.append))) == 40
    assert not told
    content = whole.read_bytes()
    path = tmp_path / name
    path.write_bytes(content[: int(0.6 * len(content))])
    found = list(file_frames(path, SIZE, tell=told.append))
    assert 8 < len(found) < 30
    missing = 4.0 - found[-1].time
    assert len(told) == 1
    assert abs(float(told[0].split("end ")[1].split()[0]) - missing) < 0.15


def test_a_handover_waits_or_drops_the_oldest() -> None:
    made: list[int] = []
    release = threading.Event()

    def numbers():
        for number in range(100):
            made.append(number)
            yield number
        release.set()

    got = iter(Handover(numbers(), 4, waits=True))
    assert [next(got) for _ in range(3)] == [0, 1, 2]
    assert len(made) <= 3 + 4 + 1
    assert list(got) == list(range(3, 100))
    release.clear()
    dropping = Handover(numbers(), 2, waits=False)
    release.wait()
    assert list(dropping) == [98, 99]
    assert dropping.dropped == 98


def test_a_handover_passes_errors_on_and_can_be_closed() -> None:
    def broken():
        yield 1
        raise FileError("torn")

    got = iter(Handover(broken(), 2, waits=True))
    assert next(got) == 1
    with pytest.raises(FileError, match="torn"):
        next(got)
    blocked = threading.Event()

    def endless():
        yield 1
        blocked.wait()
        yield 2

    waiting = Handover(endless(), 2, waits=True)
    got = iter(waiting)
    assert next(got) == 1
    threading.Timer(0.1, waiting.close).start()
    assert list(got) == []
    blocked.set()
