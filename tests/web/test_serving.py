"""The socket of a local server: this machine's own address alone, and another port only where it may be."""

import http.client
import socket
import threading

import pytest
from ports import free_port
from waiting import PATIENCE

pytest.importorskip("starlette", reason="the extra `mark` is not installed")
pytest.importorskip("uvicorn", reason="the extra `mark` is not installed")

from kcal.errors import InputError
from kcal.web.serving import LocalServer, listening_socket, local_app


def test_a_port_in_use_is_refused_or_replaced() -> None:
    with listening_socket(0, fallback=False) as first:
        name, port = first.getsockname()
        assert name == "127.0.0.1"
        # Who connects before the server answers waits.
        with socket.create_connection((name, port), timeout=PATIENCE):
            pass
        with pytest.raises(InputError, match=f"port {port} cannot be used: .*; give another --port"):
            listening_socket(port, fallback=False)
        with pytest.raises(InputError, match=r"port 70000 cannot be used: .*0-65535.*; give another --port"):
            listening_socket(70000, fallback=False)
        with listening_socket(port, fallback=True) as other:
            assert other.getsockname()[0] == "127.0.0.1"
            assert other.getsockname()[1] not in (0, port)


def test_a_port_can_be_used_again_at_once() -> None:
    port = free_port()
    with (
        listening_socket(port, fallback=False) as first,
        socket.create_connection(("127.0.0.1", port), timeout=PATIENCE) as there,
    ):
        first.accept()[0].close()
        there.recv(1)
    with listening_socket(port, fallback=False) as again:
        assert again.getsockname()[1] == port


def test_a_server_answers_at_its_address_until_it_is_stopped() -> None:
    made: list[tuple[str, tuple[str, ...]]] = []

    def make_app(token: str, hosts: tuple[str, ...]):
        made.append((token, hosts))
        return local_app([], {"/": (b"hello", "text/html")}, token, hosts)

    server = LocalServer(make_app, 0, fallback=False)
    ((token, hosts),) = made
    host, _, given = server.address.removeprefix("http://").partition("/#")
    assert given == token
    assert set(hosts) == {host, host.replace("127.0.0.1", "localhost")}
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    connection = http.client.HTTPConnection(host, timeout=PATIENCE)
    connection.request("GET", "/")
    assert connection.getresponse().read() == b"hello"
    connection.close()
    server.stop()
    thread.join()
