"""Which frames are kept, what is on the disk, and how a session goes on and ends."""

import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from capture_frames import BOARD, images
from command_line import Command, ran

from kcal import Board, FileError, InputError, Observations
from kcal.capture.session import FIRST_VIEWS, CaptureOptions, CaptureSession, Shot, follow, shots
from kcal.corners.video import Frame
from kcal.io.images import write_png


def test_useful_frames_are_kept_and_on_the_disk(tmp_path: Path) -> None:
    session = CaptureSession(tmp_path / "left.obs.json", BOARD)
    assert session.offer(images()[0], "a.png", moving=False)
    assert not session.offer(images()[0], "b.png", moving=False)
    assert "one like this" in session.message
    assert not session.offer(np.full((240, 320), 90, np.uint8), "c.png", moving=False)
    assert "no board" in session.message
    # Of a moving board: only what was at the same place in the frame before.
    assert not session.offer(images()[1], "d", moving=True)
    assert session.message == "hold still"
    assert session.offer(images()[1], "e", moving=True)
    kept = Observations.load(tmp_path / "left.obs.json")
    assert kept.names == ("a.png", "e")
    for view, image in zip(kept.views, images()[:2], strict=True):
        assert view.image is not None
        assert np.array_equal(cv2.imread(view.image, cv2.IMREAD_UNCHANGED), image)
    with pytest.raises(InputError, match="another size"):
        session.offer(images()[0][:200], "f", moving=False)
    again = CaptureSession(tmp_path / "left.obs.json", BOARD)
    assert again.views == 2
    assert not again.offer(images()[0], "g", moving=False)
    with pytest.raises(InputError, match="another board"):
        CaptureSession(tmp_path / "left.obs.json", Board(columns=7, rows=5, square=0.02))


def test_noise_is_no_movement_and_a_little_movement_no_new_view(tmp_path: Path) -> None:
    session = CaptureSession(tmp_path / "left.obs.json", BOARD)
    noisy = images()[0] ^ (np.arange(images()[0].shape[1]) % 2).astype(np.uint8)
    assert not session.offer(images()[0], "a", moving=True)
    assert session.offer(noisy, "b", moving=True)
    assert session.corners is not None
    assert not session.offer(np.roll(images()[0], 3, 1), "c", moving=False)
    assert "one like this" in session.message


@pytest.mark.slow
def test_from_the_first_view_to_the_goal(tmp_path: Path) -> None:
    session = CaptureSession(tmp_path / "left.obs.json", BOARD, CaptureOptions(until=50.0))
    assert not session.think()
    assert session.state()["next"] is None
    words = set()
    for number in range(FIRST_VIEWS):
        session.offer(images()[number], str(number), moving=False)
        assert session.think()
        state = session.state()
        assert state["views"] == number + 1
        assert len(state["next"]["outline"]) == 4
        words.add(state["next"]["words"])
        assert not session.think()
    assert len(words) == FIRST_VIEWS
    state = session.state()
    assert len(state["history"]) == 1
    assert len(state["holds"]) == len(state["outlines"]) == FIRST_VIEWS
    assert 0 < state["next"]["sigma"] < session.sigma < 50.0
    assert "enough" in state["finished"]
    follow(session, until=lambda: False)
    # The advice goes on while a calibration runs, or fails: nothing is calibrated here.
    assert session.offer(images()[FIRST_VIEWS], "late", moving=False)
    late = session.state()["next"]
    assert late["outline"] != state["next"]["outline"]
    assert late["sigma"] < state["next"]["sigma"]
    assert len(session.state()["history"]) == 1
    few = CaptureSession(tmp_path / "left.obs.json", BOARD, CaptureOptions(until=1e-9, most=4))
    assert "the most that were asked for" in few.finished


def test_options() -> None:
    with pytest.raises(InputError, match="until"):
        CaptureOptions(until=0.0)
    with pytest.raises(InputError, match="most"):
        CaptureOptions(most=3)


def test_images_that_come_into_a_folder(tmp_path: Path) -> None:
    """Each once, when it has come to rest; one that is no image is told."""
    write_png(tmp_path / "1.png", images()[0])
    (tmp_path / "notes.txt").write_text("x")
    (tmp_path / "2.png").write_bytes(b"nothing")
    told: list[str] = []
    found: list[Shot] = []
    for shot in shots(str(tmp_path), lambda: len(found) == 2, told.append):
        found.append(shot)
        write_png(tmp_path / "3.png", images()[1])
    assert [shot.name for shot in found] == ["1.png", "3.png"]
    assert np.array_equal(found[1].image, images()[1])
    assert not found[0].moving
    assert len(told) == 1
    assert "2.png" in told[0]
    with pytest.raises(FileError, match="no such file"):
        next(shots(str(tmp_path / "none"), lambda: False, told.append))


def test_of_a_stream_the_newest_frame_is_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    taken, ended = threading.Event(), threading.Event()

    def frames(source: str, duration: float) -> Iterator[Frame]:
        for number in range(7 * 5):
            if number == 7:
                taken.wait()
            yield Frame(number, images()[0])
        ended.set()
        raise FileError("the stream ended")

    monkeypatch.setattr("kcal.capture.session.read_frames", frames)
    found = shots("camera:0", lambda: False, print)
    first = next(found)
    taken.set()
    ended.wait()
    assert first.moving
    # Of the four groups of frames that came in between, the last.
    last = next(found)
    assert (first.name, last.name) == ("camera:0#000000", "camera:0#000028")
    with pytest.raises(FileError, match="the stream ended"):
        next(found)


@pytest.mark.slow
def test_command_line(tmp_path: Path, command: Command) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    for i, image in enumerate(images()):
        write_png(folder / f"{i}.png", image)
    what = ["--board", "6x5", "--square", "20mm", "--no-page"]
    done = command("capture", folder, *what, "-o", tmp_path / "x.obs.json", "--most 5")
    assert "next: kcal calibrate" in done.out
    assert len(Observations.load(tmp_path / "x.obs.json").views) == 5
    assert len(list((tmp_path / "x.frames").iterdir())) == 5
    assert isinstance(ran("capture", tmp_path / "no", *what, "-o", tmp_path / "y.obs.json").exception, FileError)
