"""Where positions go besides files: Cursor-on-Target by UDP or TCP, and MQTT.

A sender never holds up the stream: what cannot be sent is counted. After a restart the last moments may be sent again;
events and messages carry the number of their moment, so that a receiver can tell.
"""

from __future__ import annotations

import contextlib
import datetime
import re
import socket
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Protocol
from urllib.parse import urlsplit

from kcal.errors import InputError, with_extra
from kcal.locate.export import cot_events, point_features
from kcal.locate.positions import Located
from kcal.locate.tables import PositionColumns

_EVENT = re.compile(r" <event.*?</event>\n", re.DOTALL)
# Seconds: a receiver that does not answer must not stop the stream, and is tried again after a while; a broker has some
# at the end for what it has not acknowledged.
_PATIENCE, _AGAIN, _FAREWELL = 1.0, 5.0, 5.0


class Sender(Protocol):
    """Somewhere that positions go; `failed` counts moments that did not get there."""

    failed: int

    def send(self, columns: PositionColumns, run: Located, moment: datetime.datetime) -> None:
        """Send the positions of a moment."""

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
        self._tcp, self._target = _network_address(address, ("udp", "tcp"))
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
        parts = urlsplit(address)
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
        # The messages of each moment, from the first that the broker has not acknowledged.
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


def _network_address(address: str, schemes: tuple[str, str]) -> tuple[bool, tuple[str, int]]:
    parts = urlsplit(address)
    port: int | None
    try:
        port = parts.port
    except ValueError:
        port = None
    if parts.scheme not in schemes or not parts.hostname or not port or parts.path:
        raise InputError(f"{_without_password(address)}: write {schemes[0]}://HOST:PORT or {schemes[1]}://HOST:PORT")
    return parts.scheme == schemes[1], (parts.hostname, port)


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
