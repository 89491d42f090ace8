"""The map of a stream in the browser: served to this machine only, and it loads nothing from elsewhere.

A page gets the newest tracks as server-sent events. A page that is slow misses moments; nothing waits for it.
"""

from __future__ import annotations

import asyncio
import math
import secrets
import threading
from collections.abc import AsyncIterator
from typing import Any

import orjson
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route

from kcal.locate.columns import PositionColumns
from kcal.locate.positions import Located
from kcal.web.gate import new_token, page_files
from kcal.web.listening import listening_socket

_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
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
        self._token, self._socket = new_token(), listening_socket(port, fallback=False)
        bound = self._socket.getsockname()[1]
        self._hosts = {f"127.0.0.1:{bound}", f"localhost:{bound}"}
        self.address = f"http://127.0.0.1:{bound}/#{self._token}"
        routes = [Route("/events", self._events)]
        pages = page_files(("kcal.pipeline", "page"), ("kcal.report", "leaflet"))
        routes += [Route(path, self._file(content, kind)) for path, (content, kind) in pages.items()]
        config = uvicorn.Config(Starlette(routes=routes), log_level="warning", access_log=False, lifespan="off")
        self._server = uvicorn.Server(config)
        # Signals are those of the stream.
        self._thread = threading.Thread(target=self._server.run, kwargs={"sockets": [self._socket]}, daemon=True)
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
        self._server.should_exit = self._server.force_exit = True
        self._thread.join(5.0)
        self._socket.close()

    def _file(self, content: bytes, kind: str) -> Any:
        async def answer(request: Request) -> Response:
            if request.headers.get("host") not in self._hosts:
                return PlainTextResponse("this host is not served", 403, headers=_HEADERS)
            return Response(content, media_type=kind, headers=_HEADERS)

        return answer

    async def _events(self, request: Request) -> Response:
        given = request.query_params.get("token", "")
        known = secrets.compare_digest(given.encode(), self._token.encode())
        if request.headers.get("host") not in self._hosts or not known:
            return PlainTextResponse("open the address that kcal live printed", 403, headers=_HEADERS)
        return StreamingResponse(self._told(request), media_type="text/event-stream", headers=_HEADERS)

    async def _told(self, request: Request) -> AsyncIterator[bytes]:
        yield b"event: site\ndata: " + self._site + b"\n\n"
        seen, quiet = 0, 0.0
        while not self._server.should_exit and not await request.is_disconnected():
            number, text = self._news
            if number != seen:
                seen, quiet = number, 0.0
                yield b"event: tracks\ndata: " + text + b"\n\n"
            elif quiet >= _ALIVE:
                quiet = 0.0
                yield b": alive\n\n"
            await asyncio.sleep(_POLL)
            quiet += _POLL
