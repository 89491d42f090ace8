"""Where positions go besides files: Cursor-on-Target, MQTT, and a live map."""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import itertools
import math
import re
import secrets
import socket
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable
from typing import Any, Protocol

import numpy as np
import orjson
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route

from kcal.errors import InputError, with_extra
from kcal.lens.rig import Origin
from kcal.locate.export import cot_events, point_features
from kcal.locate.positions import CORNER_DECIMALS, Located, camera_place, field_of_view, near, ring_blocks
from kcal.locate.tables import PositionColumns
from kcal.texts import length_text, number_text
from kcal.values import split_address
from kcal.web.coast import coast_near
from kcal.web.serving import LocalServer, local_app, page_files

# Where positions go besides files: Cursor-on-Target by UDP or TCP, and MQTT.
#
# A sender never holds up the stream: what cannot be sent is counted. After a restart the last time steps may be sent
# again; events and messages carry the number of their time step, so that a receiver can tell.

_EVENT = re.compile(r" <event.*?</event>\n", re.DOTALL)
# Seconds: a receiver that does not answer must not stop the stream, and is tried again after a while; a broker has some
# at the end for what it has not acknowledged.
_PATIENCE, _AGAIN, _FAREWELL = 1.0, 5.0, 5.0


class Sender(Protocol):
    """Somewhere that positions go; `failed` counts time steps that did not get there."""

    failed: int

    def send(self, columns: PositionColumns, run: Located, moment: datetime.datetime) -> None:
        """Send the positions of a time step."""

    def close(self) -> None:
        """Send nothing more."""


class CotSender:
    """Cursor-on-Target events, one datagram each by UDP, or one after another by TCP.

    Args:
        address: `udp://HOST:PORT`, multicast too, or `tcp://HOST:PORT`.
        stale_s: seconds for which an event counts.

    Raises:
        InputError: another kind of address.
    """

    def __init__(self, address: str, stale_s: float = 10.0) -> None:
        parts = split_address(address)
        if parts.scheme not in ("udp", "tcp") or not parts.hostname or not parts.port or parts.path:
            raise InputError(f"{_without_password(address)}: write udp://HOST:PORT or tcp://HOST:PORT")
        self._tcp, self._target = parts.scheme == "tcp", (parts.hostname, parts.port)
        self._stale_s, self._socket, self._next_try = stale_s, None, 0.0
        self.failed = 0

    _socket: socket.socket | None

    def send(self, columns: PositionColumns, run: Located, moment: datetime.datetime) -> None:
        """Send an event for each position."""
        events = _EVENT.findall(cot_events(columns, run, time=moment, stale_s=self._stale_s))
        if not events:
            return
        try:
            link = self._connected()
            for event in events:
                link.sendall(event.strip().encode() + (b"\n" if self._tcp else b""))
        except OSError:
            self.failed += 1
            self.close()
            self._next_try = time.monotonic() + _AGAIN

    def _connected(self) -> socket.socket:
        if self._socket is None:
            if time.monotonic() < self._next_try:
                raise OSError("not yet again")
            if self._tcp:
                self._socket = socket.create_connection(self._target, _PATIENCE)
            else:
                family, kind, _, _, place = socket.getaddrinfo(*self._target, type=socket.SOCK_DGRAM)[0]
                self._socket = socket.socket(family, kind)
                self._socket.settimeout(_PATIENCE)
                self._socket.connect(place)
        return self._socket

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.close()
            self._socket = None


class MqttSender:
    """GeoJSON features to a broker, one message for each track, under TOPIC/NAME.

    Args:
        address: `mqtt://[USER:PASSWORD@]HOST[:PORT]/TOPIC`.

    Raises:
        InputError: another kind of address, the extra `mqtt` is missing, or the broker does not answer.
    """

    def __init__(self, address: str) -> None:
        with with_extra("mqtt", "MQTT needs"):
            from paho.mqtt import client, enums
        parts = split_address(address)
        self._topic = parts.path.strip("/")
        if parts.scheme != "mqtt" or not parts.hostname or not self._topic or set(self._topic) & set("#+"):
            raise InputError(f"{_without_password(address)}: write mqtt://HOST/TOPIC")
        self._client = client.Client(enums.CallbackAPIVersion.VERSION2)
        if parts.username:
            self._client.username_pw_set(parts.username, parts.password)
        # What a broker does not take is not kept without end.
        self._client.max_queued_messages_set(1000)
        try:
            self._client.connect(parts.hostname, parts.port or 1883)
        except OSError as error:
            raise InputError(f"{_without_password(address)}: the broker does not answer ({error})") from error
        self._client.loop_start()
        # The messages of each time step, from the first that the broker has not acknowledged.
        self._sent: deque[list[Any]] = deque()
        self.failed = 0

    _client: Any

    def send(self, columns: PositionColumns, run: Located, moment: datetime.datetime) -> None:
        """Publish a feature for each position, at least once."""
        messages = [
            self._client.publish(f"{self._topic}/{name.replace(' ', '-')}", feature, qos=1)
            for name, feature in zip(columns.names, point_features(columns), strict=True)
        ]
        if any(message.rc != 0 for message in messages):
            self.failed += 1
        else:
            self._sent.append(messages)
        self._forget_arrived()

    def close(self) -> None:
        """Wait until the broker has what was sent, for some seconds, and disconnect; count what it does not have."""
        until = time.monotonic() + _FAREWELL
        while self._sent and time.monotonic() < until:
            time.sleep(0.01)
            self._forget_arrived()
        self.failed += len(self._sent)
        self._sent.clear()
        self._client.disconnect()
        self._client.loop_stop()

    def _forget_arrived(self) -> None:
        while self._sent and all(message.is_published() for message in self._sent[0]):
            self._sent.popleft()


def _without_password(address: str) -> str:
    return re.sub(r"//[^/@]*@", "//", address)


SENDERS: dict[str, Callable[[str], Sender]] = {"udp": CotSender, "tcp": CotSender, "mqtt": MqttSender}


def sender_to(address: str) -> Sender:
    """The sender for an address.

    Raises:
        InputError: an address that is none of udp://, tcp:// and mqtt://, or as the senders.

    Example:
        >>> sender_to("udp://127.0.0.1:18999").failed
        0
    """
    make = SENDERS.get(address.partition("://")[0])
    if make is None:
        raise InputError(f"{_without_password(address)}: write udp://HOST:PORT, tcp://HOST:PORT or mqtt://HOST/TOPIC")
    return make(address)


# The map of a stream in the browser: served to this machine only, and it loads nothing from elsewhere.
#
# A page gets the newest tracks as server-sent events. A slow page misses time steps; nothing waits for it, except
# that the end is told to each page before the server stops.

# Seconds between looks for news, between signs of life while there is none, and for which the end waits for pages.
_POLL, _ALIVE, _MAP_FAREWELL = 0.1, 10.0, 3.0
# Meters to which fields of view are drawn: farther than any target, so that they fill the map at every zoom.
_FIELD_REACH_M = 100_000.0


# Points of a trail, seconds between two of them, and for which it stays once its track has ended.
_TRAIL, _TRAIL_STEP_S, _TRAIL_KEPT_S = 300, 0.5, 60.0
# The year 2001 in Unix seconds: smaller times are not of the calendar.
CALENDAR = 1e9


class LiveMap:
    """The server; `address` is what to open, `readers` the number of pages that are open.

    Args:
        run: where the cameras stand.
        port: 0 for any that is free.
        start: calendar time of second 0, if times are not Unix seconds.

    Raises:
        InputError: the port cannot be used.
    """

    def __init__(self, run: Located, port: int, start: datetime.datetime | None = None) -> None:
        word = " camera" if run.centers is None else ""
        cameras = [
            {"name": f"{camera.name}{word}", "place": camera_place(camera, run.place),
             "field": field_of_view(camera, run.place, _FIELD_REACH_M)}
            for camera in run.cameras
        ]  # fmt: skip
        self.run, self.readers, self._start = run, 0, start
        self._site = orjson.dumps({"cameras": cameras, "coast": coast_near(run.place.lat, run.place.lon)})
        # Number of the news, its columns, its time step and time; the last that was written for pages.
        self._news: tuple[int, PositionColumns | None, int, float] = (0, None, 0, 0.0)
        # Where each track has been, and when last.
        self._trails: dict[str, tuple[deque[list[float]], float]] = {}
        self._trails_end = -math.inf
        self._lock = threading.Lock()
        self._written = (0, b"")
        self._ending = b""
        self._server = LocalServer(self._app, port, fallback=False)
        self.address = self._server.address
        # Signals are those of the stream.
        self._thread = threading.Thread(target=self._server.run, daemon=True)
        self._thread.start()

    def show(self, columns: PositionColumns, sequence: int, time_s: float) -> None:
        """Show the tracks of a time step, at a time in seconds. They are written out only if a page asks for them."""
        if not 0.0 <= time_s - self._trails_end < _TRAIL_STEP_S:
            self._trails_end = time_s
            with self._lock:
                self._follow(columns, time_s)
        self._news = (self._news[0] + 1, columns, sequence, time_s)

    def _follow(self, columns: PositionColumns, time_s: float) -> None:
        """Where each track has been, for pages that are opened later."""
        for i in np.flatnonzero(columns.located).tolist():
            places, _ = self._trails.get(columns.names[i], (deque(maxlen=_TRAIL), 0.0))
            places.append(_place_of(columns, i, self.run.place))
            self._trails[columns.names[i]] = places, time_s
        self._trails = {name: one for name, one in self._trails.items() if 0.0 <= time_s - one[1] <= _TRAIL_KEPT_S}

    def close(self, words: str = "finished") -> None:
        """Tell each page how it ended, and end the server."""
        self._ending = orjson.dumps({"words": words})
        until = time.monotonic() + _MAP_FAREWELL
        while self.readers and time.monotonic() < until:
            time.sleep(_POLL / 2)
        self._server.stop()
        self._thread.join(5.0)

    def _app(self, token: str, hosts: tuple[str, ...]) -> Starlette:
        async def events(request: Request) -> Response:
            # The browser's own reader of events sends no headers.
            if not secrets.compare_digest(request.query_params.get("token", "").encode(), token.encode()):
                return PlainTextResponse("open the address that kcal live printed", 403)
            return StreamingResponse(self._told(request), media_type="text/event-stream")

        pages = page_files(("kcal.pipeline", "page"), ("kcal.report", "leaflet"), ("kcal.web", "map"))
        return local_app([Route("/events", events)], pages, token, hosts)

    async def _told(self, request: Request) -> AsyncIterator[bytes]:
        self.readers += 1
        try:
            yield b"event: site\ndata: " + self._site + b"\n\n"
            with self._lock:
                trails = {name: list(places) for name, (places, _) in self._trails.items()}
            yield b"event: trails\ndata: " + orjson.dumps(trails) + b"\n\n"
            seen, quiet = 0, 0.0
            while not await request.is_disconnected():
                # Looked at before the news: what came before the end is shown before it.
                ending, (number, columns, sequence, time_s) = self._ending, self._news
                if number != seen and columns is not None:
                    seen, quiet = number, 0.0
                    yield b"event: tracks\ndata: " + self._text(number, columns, sequence, time_s) + b"\n\n"
                elif quiet >= _ALIVE:
                    quiet = 0.0
                    yield b": alive\n\n"
                if ending:
                    yield b"event: end\ndata: " + ending + b"\n\n"
                    return
                await asyncio.sleep(_POLL)
                quiet += _POLL
        finally:
            self.readers -= 1

    def _text(self, number: int, columns: PositionColumns, sequence: int, time_s: float) -> bytes:
        """News as JSON, written once for all pages."""
        if self._written[0] != number:
            news = {"sequence": sequence, "time": time_s, "clock": clock_text(time_s, self._start)}
            self._written = number, orjson.dumps({**news, "tracks": _tracks(columns, self.run)})
        return self._written[1]


def clock_text(time_s: float, start: datetime.datetime | None = None) -> str:
    """A time of the stream, as of the calendar where it is known.

    Example:
        >>> clock_text(1767225600.25), clock_text(12.34)
        ('2026-01-01 00:00:00 UTC', '12.3 s')
    """
    known = calendar_time(time_s, start)
    return f"{time_s:.1f} s" if known is None else f"{known.astimezone(datetime.UTC):%Y-%m-%d %H:%M:%S} UTC"


def calendar_time(time_s: float, start: datetime.datetime | None) -> datetime.datetime | None:
    """A time of the stream on the calendar, if it counts from `start` or in Unix seconds."""
    if start is not None:
        return start + datetime.timedelta(seconds=time_s)
    return datetime.datetime.fromtimestamp(time_s, datetime.UTC) if time_s > CALENDAR else None


def _tracks(columns: PositionColumns, run: Located) -> list[dict[str, Any]]:
    """The tracks with a position: name, place, 95 % region, and what is said of each."""
    origin = run.place
    located = np.flatnonzero(columns.located)
    rings = itertools.chain.from_iterable(ring_blocks(columns, run))
    distances = columns.column("range_m")
    # Of an interval of 95 %; one without end tells no digits.
    sigmas = (columns.column("range_high_m") - columns.column("range_low_m")) / 3.92
    tracks = []
    for i, ring in zip(located.tolist(), rings, strict=True):
        place = _place_of(columns, i, origin)
        # The whole ring lies on the origin's side of the antimeridian.
        turn = place[1] - columns.numbers[i, 1]
        words = [_called(columns, i), length_text(distances[i], sigmas[i]), *_speed(columns, i)]
        region = np.round(ring + np.array([0.0, turn]), CORNER_DECIMALS).tolist()
        tracks.append({"name": columns.names[i], "place": place, "region": region, "text": ", ".join(words)})
    return tracks


def _place_of(columns: PositionColumns, row: int, origin: Origin) -> list[float]:
    lat, lon = columns.numbers[row, :2].tolist()
    return [lat, near(lon, origin.lon)]


def _called(columns: PositionColumns, row: int) -> str:
    """`car 12` of the category car and the name `track 12`; the name where the category tells nothing."""
    name, category = columns.names[row], columns.extras["category"][row]
    return name if category in ("", "object") or category.isdigit() else f"{category} {name.rpartition(' ')[2]}"


def _speed(columns: PositionColumns, row: int) -> list[str]:
    """The level speed and where it leads, where that is known to be more than nothing."""
    parts = ("east", "north", "east_sigma", "north_sigma")
    east, north, east_sigma, north_sigma = (float(columns.extras[f"velocity_{part}_mps"][row]) for part in parts)
    speed = math.hypot(east, north)
    sigma = math.hypot(east * east_sigma, north * north_sigma) / max(speed, 1e-9)
    if not speed > 2.0 * sigma:
        return []
    return [f"{number_text(speed, sigma)} m/s toward {math.degrees(math.atan2(east, north)) % 360:03.0f}°"]
