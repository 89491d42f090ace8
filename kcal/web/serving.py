"""Serve a local page until it is stopped."""

from __future__ import annotations

from collections.abc import Callable

import uvicorn
from starlette.applications import Starlette

from kcal.web.gate import new_token
from kcal.web.listening import listening_socket


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
        self._server = uvicorn.Server(uvicorn.Config(app, log_level="warning", access_log=False))

    def run(self) -> None:
        """Answer until `stop` is called, or until Ctrl+C."""
        self._server.run(sockets=[self._listener])

    def stop(self) -> None:
        """End `run`, from another thread."""
        self._server.should_exit = True
