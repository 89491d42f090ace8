"""What every local page shares: who may ask, what errors look like, and the files of the page itself.

It answers only requests that name this machine as their host (a foreign page could otherwise reach it under a name of
its own: DNS rebinding) and, beyond the page's own files, only those with the token of this start.
"""

from __future__ import annotations

import json
import re
import secrets
from collections.abc import Awaitable, Callable, Mapping
from importlib import resources
from typing import Any

import pydantic
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from kcal.errors import FileError, InputError, KcalError
from kcal.native_file import fault_text

_LARGEST_BODY = 1 << 20
_DEEPEST = 32
_DIGITS = re.compile("[0-9]{1,12}")
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}


def new_token() -> str:
    """A secret for one start of the server."""
    return secrets.token_urlsafe(24)


def local_app(
    routes: list[Route], pages: Mapping[str, tuple[bytes, str]], token: str, hosts: tuple[str, ...]
) -> Starlette:
    """An application for this machine's browser.

    Args:
        routes: of data, under /api/.
        pages: see `page_files`.
        token: that requests for data must carry in the header `X-Kcal-Token`.
        hosts: values of the header `Host` that are answered, for example `127.0.0.1:8347`.
    """
    own = [Route(path, _static_page(content, kind), methods=["GET"]) for path, (content, kind) in pages.items()]
    return Starlette(
        routes=[*routes, *own],
        middleware=[Middleware(_Gate, token=token, hosts=hosts)],
        exception_handlers={
            KcalError: _refuse,
            pydantic.ValidationError: _refuse,
        },
    )


async def json_body(request: Request) -> Any:
    """The content of a request's body.

    Raises:
        InputError: no JSON, or JSON that cannot be read: nested too deeply, or a number of thousands of digits.
    """
    body = await request.body()
    try:
        content = json.loads(body)
        _check_depth(content)
    except RecursionError as error:
        raise InputError("the request is nested too deeply") from error
    except ValueError as error:
        raise InputError(f"the request cannot be read: {error}") from error
    return content


def _check_depth(content: Any, depth: int = _DEEPEST) -> None:
    """Raise `RecursionError` beyond `_DEEPEST` levels: whoever walks through the content must not fail."""
    if not depth:
        raise RecursionError
    for part in content.values() if isinstance(content, dict) else content if isinstance(content, list) else ():
        _check_depth(part, depth - 1)


def page_files(*folders: tuple[str, str]) -> dict[str, tuple[bytes, str]]:
    """Files of a page by path, with their types: there are no others to be had.

    Args:
        folders: package and folder of each; an `index.html` is the page itself.
    """
    found = {}
    for package, folder in folders:
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
            return _secured(JSONResponse({"error": "the token is wrong: open the address that kcal printed"}, 401))
        length = request.headers.get("content-length", "0")
        if not _DIGITS.fullmatch(length) or int(length) > _LARGEST_BODY or "transfer-encoding" in request.headers:
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
        return JSONResponse({"error": fault_text(error)}, 422)
    # What this machine could not write may be possible later, and is then worth asking for again.
    failed = isinstance(error, FileError) and isinstance(error.__cause__, OSError)
    return JSONResponse({"error": " ".join(str(error).split())}, 503 if failed else 400)
