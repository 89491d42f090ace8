"""A camera on this machine: an RTSP server of one H.264 video, whose packets and sender reports libav makes."""

import contextlib
import math
import socket
import struct
import threading
import time
from collections.abc import Callable
from fractions import Fraction
from typing import Self

import av
import numpy as np
import numpy.typing as npt
from waiting import PATIENCE

_SDP = (
    "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=camera\r\nt=0 0\r\nm=video 0 RTP/AVP 96\r\na=rtpmap:96 H264/90000\r\n"
    "a=fmtp:96 packetization-mode=1\r\na=control:streamid=0\r\n"
)


class RtspCamera:
    """Serves what `draw` gives for the seconds since 1970 of this machine, to one client after another.

    Frames are at multiples of one over the rate.

    Args:
        draw: gray levels (H, W) at a time.
        rate: frames a second.
        ahead: seconds by which the camera's own clock is ahead, in its reports.
        reports: whether it sends any.
        cut_after: frames after which the first connection is cut.
    """

    def __init__(
        self,
        draw: Callable[[float], npt.NDArray[np.uint8]],
        rate: float = 20.0,
        *,
        ahead: float = 0.0,
        reports: bool = True,
        cut_after: int | None = None,
    ) -> None:
        self._draw, self._rate, self._ahead, self._reports, self._cut = draw, rate, ahead, reports, cut_after
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"rtsp://user:secret@127.0.0.1:{self._listener.getsockname()[1]}/main"
        self.connections = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._listener.close()
        self._thread.join()

    def _serve(self) -> None:
        while not self._ended.is_set():
            self._listener.settimeout(0.2)
            with contextlib.suppress(OSError), self._listener.accept()[0] as link:
                self.connections += 1
                self._talk(link)

    def _talk(self, link: socket.socket) -> None:
        link.settimeout(PATIENCE)
        asked = b""
        while True:
            while b"\r\n\r\n" not in asked:
                asked += link.recv(4096)
            head, _, asked = asked.partition(b"\r\n\r\n")
            lines = head.decode().split("\r\n")
            number = next(line.split(":")[1].strip() for line in lines if line.lower().startswith("cseq"))
            method = lines[0].split()[0]
            answer = f"RTSP/1.0 200 OK\r\nCSeq: {number}\r\nSession: 1\r\n"
            if method == "OPTIONS":
                answer += "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n"
            if method == "SETUP":
                answer += "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\n"
            body = _SDP if method == "DESCRIBE" else ""
            if body:
                answer += f"Content-Type: application/sdp\r\nContent-Length: {len(body)}\r\n"
            link.sendall((answer + "\r\n" + body).encode())
            if method == "PLAY":
                self._play(link)
                # What was not read would make the end of the stream an error.
                link.shutdown(socket.SHUT_WR)
                while not self._ended.is_set() and link.recv(4096):
                    pass
                return

    def _play(self, link: socket.socket) -> None:
        with contextlib.ExitStack() as stack:
            ports = [stack.enter_context(socket.socket(type=socket.SOCK_DGRAM)) for _ in range(2)]
            while True:
                ports[0].bind(("127.0.0.1", 0))
                with contextlib.suppress(OSError):
                    ports[1].bind(("127.0.0.1", ports[0].getsockname()[1] + 1))
                    break
                ports[0].close()
                ports[0] = stack.enter_context(socket.socket(type=socket.SOCK_DGRAM))
            for port in ports:
                port.setblocking(False)
            start = math.ceil(time.time() * self._rate) / self._rate
            target = f"rtp://127.0.0.1:{ports[0].getsockname()[1]}?pkt_size=1200"
            # Reports are of that moment, whenever this thread comes to send them.
            real = {"start_time_realtime": str(1000 * round(1000 * start))}
            camera = stack.enter_context(av.open(target, "w", format="rtp", options=real))
            options = {"crf": "10", "preset": "ultrafast", "tune": "zerolatency", "g": "10"}
            stream = camera.add_stream(
                "libx264", rate=25, options=options | {"x264-params": "repeat-headers=1:annexb=1"}
            )
            first = self._draw(start)
            stream.width, stream.height, stream.pix_fmt = first.shape[1], first.shape[0], "yuvj420p"
            stream.time_base = stream.codec_context.time_base = Fraction(1, 90000)
            camera.start_encoding()
            number = 0
            while not self._ended.is_set() and number != self._cut:
                due = start + number / self._rate
                time.sleep(max(0.0, due - time.time()))
                frame = av.VideoFrame.from_ndarray(self._draw(due), format="gray")
                frame.pts, frame.time_base = round(90000 * (due - start)), Fraction(1, 90000)
                for packet in stream.encode(frame):
                    camera.mux(packet)
                number += 1
                for channel, port in reversed(list(enumerate(ports))):
                    self._relay(link, channel, port)
            self._cut = None

    def _relay(self, link: socket.socket, channel: int, port: socket.socket) -> None:
        while True:
            try:
                packet = port.recv(65536)
            except BlockingIOError:
                return
            if channel == 1:
                if not self._reports:
                    continue
                seconds, part = struct.unpack(">II", packet[8:16])
                moved = seconds + part / 2**32 + self._ahead
                packet = packet[:8] + struct.pack(">II", int(moved), int(moved % 1 * 2**32)) + packet[16:]
            link.sendall(struct.pack(">cBH", b"$", channel, len(packet)) + packet)
