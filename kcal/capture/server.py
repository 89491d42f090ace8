"""The capture page's routes."""

from __future__ import annotations

import threading

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from kcal.capture.session import CaptureSession
from kcal.web.serving import local_app, page_files


def capture_app(session: CaptureSession, stop: threading.Event, token: str, hosts: tuple[str, ...]) -> Starlette:
    """The application.

    Args:
        session: that is shown.
        stop: set when the page asks to end.
        token: that requests for data must carry.
        hosts: that are answered.
    """

    async def state(_: Request) -> Response:
        return JSONResponse({**await run_in_threadpool(session.state), "stopped": stop.is_set()})

    async def picture(_: Request) -> Response:
        found = await run_in_threadpool(session.picture)
        return Response(status_code=204) if found is None else Response(found, media_type="image/png")

    async def end(_: Request) -> Response:
        stop.set()
        return JSONResponse({})

    routes = [
        Route("/api/state", state, methods=["GET"]),
        Route("/api/picture", picture, methods=["GET"]),
        Route("/api/stop", end, methods=["POST"]),
    ]
    return local_app(routes, page_files(("kcal.capture", "page")), token, hosts)
