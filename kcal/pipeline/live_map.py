"""The map of a stream in the browser: served to this machine only, and it loads nothing from elsewhere.

A page gets the newest tracks as server-sent events. A page that is slow misses moments; nothing waits for it, except
that the end is told to each page before the server stops.
"""

from __future__ import annotations

import asyncio
import itertools
import secrets
import threading
import time
from collections.abc import AsyncIterator

import numpy as np
import orjson
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route

from kcal.locate.positions import CORNER_DECIMALS, Located, camera_place, field_of_view, near, ring_blocks
from kcal.locate.tables import PositionColumns
from kcal.texts import length_text
from kcal.web.serving import LocalServer, local_app, page_files

# Seconds between looks for news, between signs of life while there is none, and for which the end waits for pages.
_POLL, _ALIVE, _FAREWELL = 0.1, 10.0, 3.0
# Meters to which fields of view are drawn: farther than any target, so that they fill the map at every zoom.
_FIELD_REACH_M = 100_000.0


class LiveMap:
    """The server; `address` is what to open, `readers` the number of pages that are open.

    Args:
        run: where the cameras stand.
        port: 0 for any that is free.

    Raises:
        InputError: the port cannot be used.
    """

    def __init__(self, run: Located, port: int) -> None:
        cameras = [
            {
                "name": camera.name if run.feet is not None else f"{camera.name} camera",
                "place": camera_place(camera, run.origin),
                "field": field_of_view(camera, run.origin, _FIELD_REACH_M),
            }
            for camera in run.cameras
        ]
        self.run, self.readers = run, 0
        self._site = orjson.dumps({"cameras": cameras})
        # Number of the news, its columns and its moment; the last that was written for pages.
        self._news: tuple[int, PositionColumns | None, int] = (0, None, 0)
        self._written = (0, b"")
        self._ending = b""
        self._server = LocalServer(self._app, port, fallback=False)
        self.address = self._server.address
        # Signals are those of the stream.
        self._thread = threading.Thread(target=self._server.run, daemon=True)
        self._thread.start()

    def show(self, columns: PositionColumns, sequence: int) -> None:
        """Show the tracks of a moment. It is written out only if a page asks for it."""
        self._news = (self._news[0] + 1, columns, sequence)

    def close(self, words: str = "finished") -> None:
        """Tell each page how it ended, and end the server."""
        self._ending = orjson.dumps({"words": words})
        until = time.monotonic() + _FAREWELL
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
            seen, quiet = 0, 0.0
            while not await request.is_disconnected():
                # Looked at before the news: what came before the end is shown before it.
                ending, (number, columns, sequence) = self._ending, self._news
                if number != seen and columns is not None:
                    seen, quiet = number, 0.0
                    yield b"event: tracks\ndata: " + self._text(number, columns, sequence) + b"\n\n"
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

    def _text(self, number: int, columns: PositionColumns, sequence: int) -> bytes:
        """News as JSON, written once for all pages."""
        if self._written[0] != number:
            self._written = number, _tracks_text(columns, sequence, self.run)
        return self._written[1]


def _tracks_text(columns: PositionColumns, sequence: int, run: Located) -> bytes:
    """The tracks with a position: name, place, 95 % region, and what is said of each."""
    origin = run.origin
    located = np.flatnonzero(columns.located)
    rings = itertools.chain.from_iterable(ring_blocks(columns, origin, plain=run.feet is not None))
    distances = columns.column("range_m")
    # Of an interval of 95 %; one without end tells no digits.
    sigmas = (columns.column("range_high_m") - columns.column("range_low_m")) / 3.92
    tracks = []
    for i, ring in zip(located.tolist(), rings, strict=True):
        lat, lon = columns.numbers[i, :2].tolist()
        # As `near` does for one: the whole ring lies on the origin's side of the antimeridian.
        turn = near(lon, origin.lon) - lon
        tracks.append(
            {
                "name": columns.names[i],
                "place": [lat, lon + turn],
                "region": np.round(ring + np.array([0.0, turn]), CORNER_DECIMALS).tolist(),
                "text": f"{columns.extras['category'][i]}, {length_text(distances[i], sigmas[i])}",
            }
        )
    return orjson.dumps({"sequence": sequence, "tracks": tracks})
