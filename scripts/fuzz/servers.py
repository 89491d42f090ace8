"""The local servers as harnesses: requests with damaged bodies, queries, headers and paths, and raw bytes.

A case is a list of requests as JSON. Marking and capture are asked directly, the live map through its socket.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging.handlers
import math
import random
import shutil
import socket
import tempfile
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlencode, urlsplit

import numpy as np
from hypothesis import strategies
from starlette.applications import Starlette

from kcal.capture.session import CaptureOptions, CaptureSession, capture_app
from kcal.io.images import write_png
from kcal.locate.localizer import Localizer
from kcal.locate.marks import read_marks
from kcal.locate.points import PointLocator
from kcal.mark.guide import Pictures, open_pictures
from kcal.mark.marking_service import Desk
from kcal.mark.server import marking_app
from kcal.mark.session import Session
from kcal.pipeline.senders import LiveMap
from scripts.fuzz.damage import ODD_NUMBERS, ODD_TEXTS, damage_bytes, damaged
from scripts.fuzz.hunt import Prepared
from scripts.fuzz.readers import ACTIONS, BOARD, placed_rig

# Seconds for an answer; less than what the clock allows a case, so that the message says who was silent.
_PATIENCE = 60.0
_TOKEN, _HOST = "secret-of-this-start", "127.0.0.1:8347"
_MARK = {"u": 20.5, "v": 20.0, "cov": [0.01, 0.0, 0.01], "frame": ""}
_GETS: list[tuple[str, dict[str, Any]]] = [
    ("/api/about", {}),
    ("/api/state", {}),
    ("/api/map", {}),
    ("/api/tile", {"side": "left", "frame": 0, "level": 0, "x": 0, "y": 0, "low": 0, "high": 200}),
    ("/api/enlarged", {"side": "right", "frame": 0, "u": 10.5, "v": 20}),
    ("/", {}),
    ("/page/../../../../etc/passwd", {}),
]
_POSTS: list[tuple[str, dict[str, Any]]] = [
    *(("/api/act", action) for action in ACTIONS),
    ("/api/act", {"key": "key-number-8", "action": {"do": "load", "items": {"a": ["target", _MARK, None]},
                                                    "kinds": ["target"]}}),
    ("/api/act", {"key": "key-number-9", "action": {"do": "places", "places": {"a": {"at": [1, 2, 3], "sigma": 1}}}}),
    ("/api/snap", {"side": "left", "frame": 0, "u": 30.0, "v": 30.0}),
    ("/api/curve", {"side": "left", "frame": 0, "u": 30.0, "v": 30.0}),
    ("/api/proposal", {"side": "left", "frame": 0, "u": 30.0, "v": 30.0, "how": "corner"}),
    ("/api/position", {"left": _MARK, "right": {**_MARK, "u": 15.5}, "matched": None}),
    ("/api/again", {"name": "mast", "side": "left", "frame": 0, "reach": 40}),
    ("/api/stop", {}),
    ("/api/state", {}),
]  # fmt: skip
_HEADERS = ["host", "origin", "x-kcal-token", "content-length", "transfer-encoding", "content-type", "cookie", "range"]


class Answer(NamedTuple):
    """What a server said."""

    status: int
    headers: dict[str, str]
    body: bytes


def _request(rng: random.Random) -> dict[str, Any]:
    post = rng.random() < 0.6
    path, content = rng.choice(_POSTS if post else _GETS)
    headers = {"host": _HOST, "x-kcal-token": _TOKEN}
    query, body = "", ""
    if post:
        data = json.dumps(content).encode()
        body = (damaged(data, ".json", rng) if rng.random() < 0.7 else data).decode("latin-1")
    else:
        fields = dict(content)
        if fields and rng.random() < 0.7:
            fields[rng.choice(list(fields))] = rng.choice([*ODD_NUMBERS, *ODD_TEXTS]).encode("utf-8", "replace")
        query = urlencode(fields)
    if rng.random() < 0.1:
        odd = ["", "evil.example", "http://evil.example", "1" * 30, "-1", "é", *ODD_TEXTS]
        headers[rng.choice(_HEADERS)] = rng.choice(odd)
    if rng.random() < 0.05:
        headers.pop(rng.choice(list(headers)))
    if rng.random() < 0.05:
        path = damage_bytes(path.encode() * 10, rng)[0].decode("latin-1")
    method = rng.choice(["GET", "POST", "PUT", "HEAD", "OPTIONS"]) if rng.random() < 0.05 else "POST" if post else "GET"
    return {"method": method, "path": path, "query": query, "headers": headers, "body": body}


@strategies.composite
def _requests(draw: Any) -> bytes:
    rng = draw(strategies.randoms(use_true_random=False))
    return json.dumps([_request(rng) for _ in range(rng.randint(1, 6))]).encode()


def ask(app: Starlette, loop: asyncio.AbstractEventLoop, request: Mapping[str, Any]) -> Answer:
    """One request to an application, as a server that read it from a socket would pass it on."""
    headers = {"content-length": str(len(request["body"])), **request["headers"]}
    raw = [(name.encode(), value.encode("utf-8", "replace")) for name, value in headers.items()]
    scope = {
        "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": request["method"],
        "path": request["path"], "raw_path": request["path"].encode("utf-8", "replace"), "root_path": "",
        "scheme": "http", "query_string": request["query"].encode(), "headers": raw, "client": ("127.0.0.1", 1),
        "server": ("127.0.0.1", 8347),
    }  # fmt: skip
    sent: list[dict[str, Any]] = []
    waiting = [{"type": "http.request", "body": request["body"].encode("latin-1"), "more_body": False}]

    async def receive() -> dict[str, Any]:
        return waiting.pop(0) if waiting else {"type": "http.disconnect"}

    async def send(message: Any) -> None:
        sent.append(message)

    loop.run_until_complete(app(scope, receive, send))
    found = {name.decode().lower(): value.decode("latin-1") for name, value in sent[0]["headers"]}
    return Answer(sent[0]["status"], found, b"".join(part.get("body", b"") for part in sent[1:]))


def _check_answer(answer: Answer, request: Mapping[str, Any]) -> None:
    assert answer.status < 500, f"status {answer.status}: {answer.body[:200]!r}"
    headers = request["headers"]
    if headers.get("host") != _HOST or headers.get("origin", f"http://{_HOST}") not in (f"http://{_HOST}", _HOST):
        assert answer.status == 403, f"a foreign host got {answer.status}"
    elif request["path"].startswith("/api/") and headers.get("x-kcal-token") != _TOKEN:
        assert answer.status == 401, f"without the token came {answer.status}"
    assert "default-src 'none'" in answer.headers.get("content-security-policy", ""), "no policy"
    assert b"root:" not in answer.body, "a file from outside"
    if answer.headers.get("content-type", "").startswith("application/json") and answer.body:
        require_json(answer.body)


def require_json(body: bytes) -> Any:
    """The content of a JSON text, in which each number is finite."""

    def refuse(text: str) -> Any:
        raise AssertionError(f"{text} in JSON")

    def number(text: str) -> float:
        assert math.isfinite(float(text)), f"{text} in JSON"
        return float(text)

    return json.loads(body, parse_constant=refuse, parse_float=number)


def _check_all(app: Starlette, loop: asyncio.AbstractEventLoop, case: bytes) -> None:
    """Answers to requests, after which the state is still told."""
    for request in [*json.loads(case), _good("/api/state")]:
        _check_answer(answer := ask(app, loop, request), request)
    assert answer.status == 200, "no state any more"


def _good(path: str) -> dict[str, Any]:
    headers = {"host": _HOST, "x-kcal-token": _TOKEN}
    return {"method": "GET", "path": path, "query": "", "headers": headers, "body": ""}


def _pictures(folder: Path) -> Pictures:
    axis = np.arange(60)
    corner = np.where((axis[:, None] >= 30) & (axis >= 27), 160, 60).astype(np.uint8)
    for side in ("left", "right"):
        write_png(folder / f"{side}.png", np.pad(corner, 20, mode="edge"))
    return open_pictures(folder / "left.png", folder / "right.png")


def marking(folder: Path) -> Prepared:
    """Requests to the marking page; a session that is opened again has the same things."""
    pictures, loop = _pictures(folder), asyncio.new_event_loop()

    def check(case: bytes) -> None:
        with tempfile.TemporaryDirectory(dir=folder) as name:
            place = Path(name, "session")
            place.mkdir()
            with contextlib.closing(Desk(pictures, Session(place / "marks.csv"))) as desk:
                app = marking_app(desk, _TOKEN, (_HOST,))
                _check_all(app, loop, case)
                shutil.copytree(place, Path(name, "again"), ignore=shutil.ignore_patterns("*.lock"))
                before = desk.session.state
            files = sorted(path.name for path in place.iterdir())
            assert all(file.startswith(("marks", "points", "landmarks")) for file in files), f"files: {files}"
            with contextlib.closing(Session(Path(name, "again", "marks.csv"))) as again:
                assert again.state == before, f"opened again: {again.state} | {before}"
            for path in (desk.session.files.marks, desk.session.files.points):
                if path.exists() and path.read_text(encoding="utf-8").count("\n") > 1:
                    read_marks(path, single=True)

    return Prepared(_requests(), check)


def capture(folder: Path) -> Prepared:
    """Requests to the capture page."""
    loop = asyncio.new_event_loop()
    session = CaptureSession(folder / "left.obs.json", BOARD, CaptureOptions())
    app = capture_app(session, threading.Event(), _TOKEN, (_HOST,))

    def check(case: bytes) -> None:
        _check_all(app, loop, case)

    return Prepared(_requests(), check)


def live_map(folder: Path) -> Prepared:
    """Raw bytes to the socket of a live map."""
    live = LiveMap(PointLocator(Localizer(placed_rig())).located(), 0)
    parts = urlsplit(live.address)
    errors = logging.handlers.BufferingHandler(1 << 20)
    errors.setLevel(logging.ERROR)
    logging.getLogger("uvicorn.error").addHandler(errors)
    # With the words HOST and TOKEN, so that a case can be repeated.
    whole = [
        f"GET {path} HTTP/1.1\r\nHost: HOST\r\nConnection: close\r\n{extra}\r\n".encode()
        for path, extra in (
            ("/", ""), ("/events?token=TOKEN", "Accept: text/event-stream\r\n"), ("/events?token=no", ""),
            ("/map/map.css", "Range: bytes=0-10\r\n"), ("/leaflet/../../../../etc/passwd", ""),
            ("/", "X-Kcal-Token: TOKEN\r\nContent-Length: 5\r\n\r\nabcde"),
        )
    ]  # fmt: skip

    @strategies.composite
    def cases(draw: Any) -> bytes:
        rng = draw(strategies.randoms(use_true_random=False))
        return damaged(rng.choice(whole), ".http", rng)

    def said(data: bytes, ends: bool) -> bytes:
        data = data.replace(b"HOST", parts.netloc.encode()).replace(b"TOKEN", parts.fragment.encode())
        found = b""
        with (
            contextlib.suppress(ConnectionError),  # a request that is too large is cut off
            socket.create_connection((parts.hostname or "", parts.port or 0), timeout=_PATIENCE) as connection,
        ):
            connection.sendall(data)
            if ends:  # a request that is not whole is waited for; one of events is told until then
                with contextlib.suppress(OSError):  # cut off already
                    connection.shutdown(socket.SHUT_WR)
            while len(found) < 1 << 20 and (part := connection.recv(1 << 16)):
                found += part
        return found

    def check(case: bytes) -> None:
        errors.flush()
        found = said(case, ends=True)
        assert not found or (found.startswith(b"HTTP/1.1 ") and found[9:10] in b"1234"), f"answered {found[:100]!r}"
        assert b"root:" not in found, "a file from outside"
        assert not errors.buffer, f"in the log: {errors.format(errors.buffer[0])[:300]}"
        assert said(whole[0], ends=False).startswith(b"HTTP/1.1 200"), "the page is not served any more"

    return Prepared(cases(), check)


SERVERS: dict[str, Callable[[Path], Prepared]] = {"marking": marking, "capture": capture, "live map": live_map}
