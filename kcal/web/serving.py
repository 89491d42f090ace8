"""What every local page shares: its socket, who may ask, what errors look like, its files, and its server."""

from __future__ import annotations

import json
import re
import secrets
import socket
from collections.abc import Awaitable, Callable, Mapping
from importlib import resources
from typing import Any

import pydantic
import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from kcal.errors import FileError, InputError, KcalError
from kcal.native_file import fault_text

# The socket of the local server: on this machine's own address only.


def listening_socket(port: int, *, fallback: bool) -> socket.socket:
    """A listening socket bound to 127.0.0.1.

    Args:
        port: to bind; 0 for any that is free.
        fallback: take any free port if this one is in use.

    Raises:
        InputError: the port is in use, or may not be used.
    """
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(("127.0.0.1", port))
        # Whoever opens the address as soon as it is printed waits for the server, and is not refused.
        listener.listen()
    except (OSError, OverflowError) as error:
        listener.close()
        if fallback:
            return listening_socket(0, fallback=False)
        raise InputError(
            f"port {port} cannot be used: {getattr(error, 'strerror', None) or error}; give another --port"
        ) from error
    return listener


# What every local page shares: who may ask, what errors look like, and the files of the page itself.
#
# It answers only requests that name this machine as their host (a foreign page could otherwise reach it under a name of
# its own: DNS rebinding) and, beyond the page's own files, only those with the token of this start.

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
        exception_handlers={KcalError: _refuse, pydantic.ValidationError: _refuse},
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


# Serve a local page until it is stopped.


class LocalServer:
    """A server of this machine's own address, with a token of this start.

    Args:
        make_app: makes the application from the token and the hosts that are answered.
        port: to listen on; 0 for any that is free.
        fallback: take any free port if this one is in use.

    Raises:
        InputError: the port is in use, or may not be used.
    """

    def __init__(self, make_app: Callable[[str, tuple[str, ...]], Starlette], port: int, *, fallback: bool) -> None:
        self._listener = listening_socket(port, fallback=fallback)
        bound, token = self._listener.getsockname()[1], new_token()
        app = make_app(token, tuple(f"{name}:{bound}" for name in ("127.0.0.1", "localhost")))
        self.address = f"http://127.0.0.1:{bound}/#{token}"
        self._server = uvicorn.Server(uvicorn.Config(app, log_level="warning", access_log=False, lifespan="off"))

    def run(self) -> None:
        """Answer until `stop` is called, or until Ctrl+C."""
        self._server.run(sockets=[self._listener])

    def stop(self) -> None:
        """End `run`, from another thread."""
        self._server.should_exit = True
