"""The socket of the local server: on this machine's own address only."""

from __future__ import annotations

import socket

from kcal.errors import InputError


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
    except OSError as error:
        listener.close()
        if fallback:
            return listening_socket(0, fallback=False)
        raise InputError(f"port {port} cannot be used: {error.strerror or error}; give another --port") from error
    return listener
