"""MQTT: messages arrive at a broker; one that is not there is named, without its password."""

import datetime
import socket
import threading

import numpy as np
import orjson
import pytest
from ports import deaf_port
from track_scenes import run_of, tracked_site

pytest.importorskip("paho.mqtt.client")
from kcal import InputError
from kcal.locate.tables import NUMBERS, PositionColumns
from kcal.pipeline.senders import Sender, sender_to


class Broker(threading.Thread):
    """The least that a broker does for a publisher: accept, and acknowledge."""

    def __init__(self, *, acknowledges: bool = True) -> None:
        super().__init__(daemon=True)
        self.acknowledges = acknowledges
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        self.messages: list[tuple[str, bytes]] = []
        self.start()

    def run(self) -> None:
        link, _ = self.listener.accept()
        with link, link.makefile("rb") as file:
            while head := file.read(1):
                size, shift = 0, 0
                while True:
                    byte = file.read(1)[0]
                    size |= (byte & 127) << shift
                    shift += 7
                    if byte < 128:
                        break
                body = file.read(size)
                if head[0] >> 4 == 1:
                    link.sendall(b"\x20\x02\x00\x00")
                elif head[0] >> 4 == 3:
                    end = 2 + int.from_bytes(body[:2], "big")
                    self.messages.append((body[2:end].decode(), body[end + 2 :]))
                    if self.acknowledges:
                        link.sendall(b"\x40\x02" + body[end : end + 2])


def sent_to(broker: Broker) -> Sender:
    """A sender that sent two tracks and was closed at once."""
    sender = sender_to(f"mqtt://127.0.0.1:{broker.port}/site/tracks")
    numbers = np.full((2, len(NUMBERS)), np.nan)
    numbers[:, :3] = 19.0, 72.0, 5.0
    columns = PositionColumns(
        ["track 1", "track 2"], np.zeros(2, np.int8), ["", ""], numbers, {"sequence": ["9", "9"]}, np.zeros(2, int)
    )
    sender.send(columns, run_of(tracked_site()), datetime.datetime.now(datetime.UTC))
    sender.close()
    broker.join()
    return sender


def test_each_track_has_a_topic() -> None:
    """Also those that were sent right before the end."""
    broker = Broker()
    assert sent_to(broker).failed == 0
    assert [topic for topic, _ in broker.messages] == ["site/tracks/track-1", "site/tracks/track-2"]
    feature = orjson.loads(broker.messages[1][1])
    assert feature["geometry"]["coordinates"] == [72.0, 19.0, 5.0]
    assert feature["properties"]["sequence"] == 9


def test_what_a_broker_does_not_acknowledge_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kcal.pipeline.senders._FAREWELL", 0.1)
    assert sent_to(Broker(acknowledges=False)).failed == 1


def test_a_broker_that_is_not_there() -> None:
    with deaf_port() as port, pytest.raises(InputError, match="does not answer") as caught:
        sender_to(f"mqtt://user:secret@127.0.0.1:{port}/tracks")
    assert "secret" not in str(caught.value)
