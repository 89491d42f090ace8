"""The map of a stream in the browser: served to this machine only, and it loads nothing from elsewhere.

A page gets the newest tracks as server-sent events. A page that is slow misses moments; nothing waits for it.
"""

from __future__ import annotations

import asyncio
import math
import secrets
import threading
from collections.abc import AsyncIterator

import orjson
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route

from kcal.locate.columns import PositionColumns
from kcal.locate.positions import Located
from kcal.web.gate import local_app, page_files
from kcal.web.serving import LocalServer

# Seconds between looks for news, and between signs of life while there is none.
_POLL, _ALIVE = 0.1, 10.0


class LiveMap:
    """The server; `address` is what to open.

    Args:
        run: where the cameras stand.
        port: 0 for any that is free.

    Raises:
        InputError: the port cannot be used.
    """

    def __init__(self, run: Located, port: int) -> None:
        self._site = orjson.dumps(
            {"cameras": [{"name": f"{camera.name} camera", "place": camera.geodetic[:2]} for camera in run.cameras]}
        )
        self._news = (0, b"")
        self._ended = threading.Event()
        self._server = LocalServer(self._app, port, fallback=False)
        self.address = self._server.address
        # Signals are those of the stream.
        self._thread = threading.Thread(target=self._server.run, daemon=True)
        self._thread.start()

    def show(self, columns: PositionColumns, sequence: int) -> None:
        """Show the tracks of a moment."""
        radius, range_m = columns.column("cep95_m").tolist(), columns.column("range_m").tolist()
        tracks = [
            {
                "name": name,
                "place": [lat, lon],
                "radius": around if math.isfinite(around) else 0.0,
                "text": f"{columns.extras['category'][i]}, {distance:,.0f} m",
            }
            for i, (name, (lat, lon), around, distance) in enumerate(
                zip(columns.names, columns.numbers[:, :2].tolist(), radius, range_m, strict=True)
            )
            if math.isfinite(lat)
        ]
        self._news = (self._news[0] + 1, orjson.dumps({"sequence": sequence, "tracks": tracks}))

    def close(self) -> None:
        """End the server."""
        self._ended.set()
        self._server.stop()
        self._thread.join(5.0)

    def _app(self, token: str, hosts: tuple[str, ...]) -> Starlette:
        async def events(request: Request) -> Response:
            # The browser's own reader of events sends no headers.
            if not secrets.compare_digest(request.query_params.get("token", "").encode(), token.encode()):
                return PlainTextResponse("open the address that kcal live printed", 403)
            return StreamingResponse(self._told(request), media_type="text/event-stream")

        pages = page_files(("kcal.pipeline", "page"), ("kcal.report", "leaflet"))
        return local_app([Route("/events", events)], pages, token, hosts)

    async def _told(self, request: Request) -> AsyncIterator[bytes]:
        yield b"event: site\ndata: " + self._site + b"\n\n"
        seen, quiet = 0, 0.0
        while not self._ended.is_set() and not await request.is_disconnected():
            number, text = self._news
            if number != seen:
                seen, quiet = number, 0.0
                yield b"event: tracks\ndata: " + text + b"\n\n"
            elif quiet >= _ALIVE:
                quiet = 0.0
                yield b": alive\n\n"
            await asyncio.sleep(_POLL)
            quiet += _POLL
