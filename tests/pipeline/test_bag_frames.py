"""Frames of bags in what follows videos: times, pixels, partners; `kcal watch` and `kcal mark` on bags."""

from pathlib import Path

import numpy as np
import pytest
from bags import KINDS, START, Written, raw, write_bag
from command_line import Command, rows_of

from kcal import FileError, KcalWarning, save_rig
from kcal.capture.session import shots
from kcal.mark.guide import open_pictures
from kcal.pipeline.video_source import FramesTogether, file_frames
from tests.helpers.scene_pairs import pair, small_rig

SIZE = (64, 48)
STEP = 100_000_000


def image(number: int) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 256, (48, 64, 3)).astype(np.uint8)


def shot(topic: str, stamp: int, shown: np.ndarray, encoding: str) -> Written:
    return topic, stamp, lambda store: raw(store, stamp, shown, encoding)


@pytest.fixture(params=KINDS)
def bag(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Left ones in color, right ones gray and 3 ms later; the second right one is missing."""
    found = [shot("/left/image", START + i * STEP, image(i), "rgb8") for i in range(3)]
    found += [shot("/right/image", START + 3_000_000 + i * STEP, image(i)[..., 0], "mono8") for i in (0, 2)]
    return write_bag(tmp_path / "run.bag", request.param, found)


def test_times_and_pixels(bag: Path) -> None:
    frames = list(file_frames(Path(f"{bag}:/left/image"), SIZE))
    assert [frame.time for frame in frames] == [1e-9 * (START + i * STEP) for i in range(3)]
    assert all(np.array_equal(frame.colors(), image(i)) for i, frame in enumerate(frames))
    gray = next(file_frames(Path(f"{bag}:/right/image"), SIZE, since=1e-9 * (START + STEP)))
    assert gray.time == 1e-9 * (START + 3_000_000 + 2 * STEP)
    assert np.array_equal(gray.gray().numpy(), image(2)[..., 0])
    assert np.array_equal(gray.colors(), np.stack([image(2)[..., 0]] * 3, -1))
    with pytest.raises(FileError, match="frames of 64x48 px, but the camera has 48x64"):
        next(file_frames(Path(f"{bag}:/left/image"), SIZE[::-1]))


def test_frames_of_two_topics_that_belong_together(bag: Path) -> None:
    together = FramesTogether(
        [f"{bag}:/left/image", f"{bag}:/right/image"], dict.fromkeys(("left", "right"), SIZE), pairs=True
    )
    found = [(time, [frame.time for frame in group if frame]) for _, (time, group) in together(0)]
    assert [time for time, _ in found] == [1e-9 * (START + i * STEP) for i in (0, 2)]
    assert [round(1e3 * (other - one), 3) for _, (one, other) in found] == [3.0, 3.0]
    together.close()


def test_what_is_damaged_is_counted(tmp_path: Path) -> None:
    found = [shot("/a", START, image(0), "rgb8"), shot("/a", START + 1, image(1), "nv12")]
    bag, bad = write_bag(tmp_path / "run", "mcap", found), []
    assert len(list(file_frames(bag, SIZE, undecoded=lambda: bad.append(1)))) == len(bad) == 1
    with pytest.warns(KcalWarning, match="1 images of 2 are left out: .*'nv12'"):
        taken = list(shots(str(bag), lambda: False, print))
    assert [one.name for one in taken] == ["1700000000.123456789.png"]


def test_marking(bag: Path) -> None:
    pictures = open_pictures(Path(f"{bag}:/left/image"), Path(f"{bag}:/right/image"))
    assert list(pictures.names) == [f"1700000000.{123_456_789 + i * STEP}" for i in (0, 2)]
    assert np.array_equal(pictures.image("right", 1), image(2)[..., 0])


@pytest.mark.slow
def test_watching(tmp_path: Path, command: Command) -> None:
    """Two looks at a rig at rest, of which the right images come a millisecond later."""
    save_rig(small_rig(), tmp_path / "rig.json")
    found = []
    for k in range(2):
        one, stamp = pair(k + 1), START + k * 60 * 10**9
        found.append(shot("/left/image", stamp, one.left, "mono8"))
        found.append(shot("/right/image", stamp + 10**6, one.right, "mono8"))
    bag = write_bag(tmp_path / "run", "sqlite3", found)
    sides = [f"{bag}:/{side}/image" for side in ("left", "right")]
    command("watch", tmp_path / "rig.json", *sides, "-o", tmp_path / "h.csv")
    rows = rows_of(tmp_path / "h.csv")
    assert [float(row["time"]) for row in rows] == [pytest.approx(1e-9 * START + 60.0 * k, abs=1e-3) for k in range(2)]
    assert float(rows[1]["relative_yaw_deg"]) == pytest.approx(0, abs=0.003)
