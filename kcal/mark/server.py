"""The local server: routes that check what they are given and ask the `Desk`.

It answers only requests that name this machine as their host (a foreign page could otherwise reach it under a name of
its own: DNS rebinding) and, beyond the page's own files, only those with the token of this start.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Awaitable, Callable
from importlib import resources
from typing import Annotated, Any

import pydantic
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from kcal.corners.point import enlarge
from kcal.errors import KcalError
from kcal.mark.desk import Desk
from kcal.mark.items import ACTION, Mark, Side

_LARGEST_BODY = 1 << 20
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
_Coordinate = Annotated[float, pydantic.Field(allow_inf_nan=False, ge=-1e6, le=1e6)]
_Number = Annotated[int, pydantic.Field(ge=0, le=10_000_000)]


class _Query(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid")


class At(_Query):
    """A pixel of a frame."""

    side: Side
    frame: _Number
    u: _Coordinate
    v: _Coordinate


class From(At):
    """A mark that is to be matched, and what it was set by."""

    how: Annotated[str, pydantic.Field(max_length=20)] = "hand"


class Pair(_Query):
    """Two marks that are being dragged."""

    left: Mark
    right: Mark
    matched: Side | None = None


class Again(_Query):
    """A thing of the reference."""

    name: str
    side: Side
    frame: _Number
    reach: Annotated[int, pydantic.Field(ge=5, le=200)] = 40


class Do(_Query):
    """An action with its key."""

    key: Annotated[str, pydantic.Field(min_length=8, max_length=64)]
    action: dict[str, Any]


class Tile(_Query):
    """A tile; `low` and `high` stretch deep images."""

    side: Side
    frame: _Number
    level: Annotated[int, pydantic.Field(ge=0, le=20)]
    x: _Number
    y: _Number
    low: _Coordinate | None = None
    high: _Coordinate | None = None


def new_token() -> str:
    """A secret for one start of the server."""
    return secrets.token_urlsafe(24)


def marking_app(desk: Desk, token: str, hosts: tuple[str, ...]) -> Starlette:
    """The application.

    Args:
        desk: what it serves.
        token: that requests for data must carry in the header `X-Kcal-Token`.
        hosts: values of the header `Host` that are answered, for example `127.0.0.1:8347`.
    """

    def asked(
        model: type[pydantic.BaseModel], answer: Callable[[Any], Any]
    ) -> Callable[[Request], Awaitable[Response]]:
        async def endpoint(request: Request) -> Response:
            body = await request.body()
            query = model.model_validate(json.loads(body) if request.method == "POST" else dict(request.query_params))
            found = await run_in_threadpool(answer, query)
            return found if isinstance(found, Response) else JSONResponse(found)

        return endpoint

    def tile(query: Tile) -> Response:
        span = None if query.low is None or query.high is None else (query.low, query.high)
        part = desk.pictures.pyramid(query.side, query.frame).tile(query.level, query.x, query.y, span)
        return Response(part.tobytes(), media_type="application/octet-stream",
                        headers={"X-Width": str(part.shape[1]), "X-Height": str(part.shape[0])})  # fmt: skip

    def enlarged(query: At) -> Response:
        import torch

        image = desk.pictures.image(query.side, query.frame)
        height, width = image.shape
        u, v = min(max(round(query.u), 0), width - 1), min(max(round(query.v), 0), height - 1)
        top, left = max(v - 32, 0), max(u - 32, 0)
        crop = torch.from_numpy(image[top : v + 33, left : u + 33].astype("float64"))
        view = enlarge(crop, torch.tensor([float(u - left), float(v - top)]), half=24)
        low, high = desk.pictures.pyramid(query.side, query.frame).span if image.dtype.itemsize > 1 else (0.0, 255.0)
        patch = ((view.patch - low) * (255.0 / (high - low))).clamp(0, 255).round().to(torch.uint8).numpy()
        where = {"X-Left": str(left + view.left), "X-Top": str(top + view.top), "X-Factor": str(view.factor)}
        size = {"X-Width": str(patch.shape[1]), "X-Height": str(patch.shape[0])}
        return Response(patch.tobytes(), media_type="application/octet-stream", headers={**size, **where})

    data: dict[str, tuple[type[pydantic.BaseModel], Callable[[Any], Any], str]] = {
        "about": (_Query, lambda _: desk.about(), "GET"),
        "state": (_Query, lambda _: desk.state(), "GET"),
        "map": (_Query, lambda _: desk.map(), "GET"),
        "tile": (Tile, tile, "GET"),
        "enlarged": (At, enlarged, "GET"),
        "act": (Do, lambda query: desk.act(ACTION.validate_python(query.action), query.key), "POST"),
        "snap": (At, lambda query: desk.snapped(query.side, query.frame, query.u, query.v), "POST"),
        "curve": (At, lambda query: desk.curve(query.side, query.u, query.v), "POST"),
        "proposal": (From, lambda query: desk.proposal(query.side, query.frame, query.u, query.v, query.how), "POST"),
        "position": (Pair, lambda query: desk.position(query.left, query.right, query.matched), "POST"),
        "again": (Again, lambda query: desk.again(query.name, query.side, query.frame, query.reach), "POST"),
    }
    routes = [
        Route(f"/api/{name}", asked(model, answer), methods=[method]) for name, (model, answer, method) in data.items()
    ]
    pages = page_files()
    routes += [Route(path, _static_page(content, kind), methods=["GET"]) for path, (content, kind) in pages.items()]
    return Starlette(
        routes=routes,
        middleware=[Middleware(_Gate, token=token, hosts=hosts)],
        exception_handlers={
            KcalError: _refuse,
            pydantic.ValidationError: _refuse,
            json.JSONDecodeError: _refuse,
            UnicodeDecodeError: _refuse,
        },
    )


def page_files() -> dict[str, tuple[bytes, str]]:
    """The page's own files and the map library, by path: there are no others to be had."""
    found = {}
    for package, folder in (("kcal.mark", "page"), ("kcal.report", "leaflet")):
        for file in (resources.files(package) / folder).iterdir():
            kind = _TYPES.get("." + file.name.rpartition(".")[2])
            if kind is not None:
                found["/" if file.name == "index.html" else f"/{folder}/{file.name}"] = file.read_bytes(), kind
    return found


class _Gate(BaseHTTPMiddleware):
    """Refuse foreign hosts, requests for data without the token, and large bodies."""

    def __init__(self, app: ASGIApp, token: str, hosts: tuple[str, ...]) -> None:
        super().__init__(app)
        self._token, self._hosts = token.encode(), hosts

    async def dispatch(self, request: Request, call_next: Callable[[Request], Awaitable[Response]]) -> Response:
        origin = request.headers.get("origin")
        allowed = request.headers.get("host") in self._hosts
        if not allowed or (origin is not None and origin.removeprefix("http://") not in self._hosts):
            return _secured(JSONResponse({"error": "this host is not served"}, 403))
        given = request.headers.get("x-kcal-token", "").encode()
        if request.url.path.startswith("/api/") and not secrets.compare_digest(given, self._token):
            return _secured(JSONResponse({"error": "the token is wrong: open the address that kcal mark printed"}, 401))
        length = request.headers.get("content-length", "0")
        if not length.isdigit() or int(length) > _LARGEST_BODY or "transfer-encoding" in request.headers:
            return _secured(JSONResponse({"error": "the request is too large"}, 413))
        return _secured(await call_next(request))


def _secured(response: Response) -> Response:
    response.headers["Content-Security-Policy"] = _POLICY
    response.headers["X-Content-Type-Options"] = "nosniff"
    response.headers["Referrer-Policy"] = "no-referrer"
    response.headers["Cache-Control"] = "no-store"
    response.headers["Cross-Origin-Resource-Policy"] = "same-origin"
    return response


def _static_page(content: bytes, kind: str) -> Callable[[Request], Awaitable[Response]]:
    async def endpoint(_: Request) -> Response:
        return Response(content, media_type=kind)

    return endpoint


async def _refuse(_: Request, error: Exception) -> Response:
    if isinstance(error, pydantic.ValidationError):
        first = error.errors()[0]
        text = ": ".join(filter(None, [".".join(map(str, first["loc"])), first["msg"].removeprefix("Value error, ")]))
        return JSONResponse({"error": text}, 422)
    return JSONResponse({"error": " ".join(str(error).split())}, 400)
