"""Live streams on this machine: RTSP with the times of RTCP reports, MPEG-TS with those of arrival, interruptions."""

import contextlib
import io
import socket
import threading
import time

import numpy as np
import pytest

pytest.importorskip("av", reason="the extra `video` is not installed")
import av
from ports import deaf_port
from rtsp_server import RtspCamera
from video_scenes import SIZE, Image

from kcal.errors import FileError
from kcal.pipeline import video_source as module
from kcal.pipeline.video_source import TimedFrame, live_frames

PERIOD = 8.0


def bar(when: float) -> Image:
    """An image whose bright part tells the time, to 1/40 s."""
    image = np.full(SIZE[::-1], 60, np.uint8)
    image[:, : int(when % PERIOD / PERIOD * SIZE[0])] = 200
    return image


def shown_time(frame: TimedFrame) -> float:
    return float((frame.gray()[120] > 130).sum()) / SIZE[0] * PERIOD


def follow(address: str, count: int) -> tuple[list[TimedFrame], list[str]]:
    told: list[str] = []
    frames = live_frames(address, SIZE, threading.Event(), told.append)
    return [next(frames) for _ in range(count)], told


def arriving(address: str, count: int) -> tuple[list[TimedFrame], list[str]]:
    """As `follow`, of a stream whose times must be those at which its frames come."""
    began = time.time()
    frames, told = follow(address, count)
    assert all(began < frame.time < time.time() for frame in frames)
    return frames, told


@pytest.mark.parametrize("ahead", [0.0, 3600.25])
def test_rtsp_times_are_those_of_the_cameras_clock(ahead: float) -> None:
    with RtspCamera(bar, ahead=ahead) as camera:
        frames, told = follow(camera.address, 15)
    assert told == []
    off = [(frame.time - ahead - shown_time(frame) + PERIOD / 2) % PERIOD - PERIOD / 2 for frame in frames]
    # A bar of whole pixels is up to 25 ms behind.
    assert max(off) < 0.025 + 0.03
    assert min(off) > -0.03
    assert np.diff([frame.time for frame in frames]) == pytest.approx(0.05, abs=0.005)


def test_a_stream_that_breaks_off_is_connected_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_FIRST_WAIT", 0.05)
    with RtspCamera(bar, cut_after=16) as camera:
        frames, told = follow(camera.address, 24)
        assert camera.connections == 2
    assert told == ["127.0.0.1: the stream ended; connecting again in 0.05 s"]
    assert (np.diff([frame.time for frame in frames]) > 0).all()


def test_a_camera_without_reports_gets_times_of_arrival(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_NO_REPORT", 0.3)
    with RtspCamera(bar, reports=False) as camera:
        _, told = arriving(camera.address, 4)
    assert len(told) == 1
    assert "127.0.0.1: the stream tells no capture times" in told[0]
    assert "secret" not in told[0]


def test_a_camera_whose_clock_was_never_set_gets_times_of_arrival() -> None:
    with RtspCamera(bar, ahead=-time.time() + 1000.0) as camera:
        _, told = arriving(camera.address, 2)
    assert "those of arrival" in told[0]


def test_mpegts_over_tcp_has_times_of_arrival() -> None:
    content = io.BytesIO()
    with av.open(content, "w", format="mpegts") as container:
        stream = container.add_stream("libx264", rate=20, options={"preset": "ultrafast", "tune": "zerolatency"})
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        for number in range(40):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(bar(number / 20), format="gray")))
        container.mux(stream.encode())
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            with listener.accept()[0] as link, contextlib.suppress(OSError):
                for start in range(0, len(content.getvalue()), 1880):
                    link.sendall(content.getvalue()[start : start + 1880])
                    time.sleep(0.02)

        threading.Thread(target=serve, daemon=True).start()
        frames, told = arriving(f"tcp://127.0.0.1:{listener.getsockname()[1]}", 5)
    assert "those of arrival" in told[0]
    assert (np.diff([frame.time for frame in frames]) > 0).all()


def test_a_stream_that_does_not_answer_or_has_another_size() -> None:
    with (
        deaf_port() as port,
        pytest.raises(FileError, match=r"127\.0\.0\.1: cannot be opened as a video: Connection refused"),
    ):
        follow(f"rtsp://user:secret@127.0.0.1:{port}/main", 1)
    with (
        RtspCamera(bar) as camera,
        pytest.raises(FileError, match=r"127\.0\.0\.1: frames of 320x240 px, but the camera has 640x480"),
    ):
        next(live_frames(camera.address, (640, 480), threading.Event(), lambda _: None))
