"""The live map behind a real web server with TLS, configured as `docs/howto/proxy.md` says."""

import base64
import contextlib
import os
import re
import shutil
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from ports import free_port
from track_scenes import run_of, tracked_site
from waiting import PATIENCE, wait_for

pytest.importorskip("uvicorn")
import httpx

from kcal.pipeline.senders import LiveMap

NGINX, OPENSSL = (shutil.which(name, path="/usr/sbin:/usr/bin:/usr/local/bin") for name in ("nginx", "openssl"))
PAGE = Path(__file__).parents[2] / "docs" / "howto" / "proxy.md"
pytestmark = pytest.mark.skipif(not (NGINX and OPENSSL), reason="nginx and openssl are not installed")


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[str, str]]:
    """The address of the web server, and the token of the map behind it."""
    live = LiveMap(run_of(tracked_site()), 0)
    port = re.search(r":(\d+)/#", live.address).group(1)
    command = [OPENSSL, "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=map.example.org", "-days", "2"]
    subprocess.run([*command, "-keyout", "map.key", "-out", "map.crt"], cwd=tmp_path, check=True, capture_output=True)
    secret = subprocess.run([OPENSSL, "passwd", "-apr1", "tide"], check=True, capture_output=True, text=True).stdout
    (tmp_path / "map.users").write_text(f"harbor:{secret}")
    outside = free_port()
    text = re.search(r"```nginx\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL).group(1)
    for there, here in (
        ("listen 443 ssl", f"listen 127.0.0.1:{outside} ssl"),
        ("/etc/ssl/", f"{tmp_path}/"),
        ("/etc/nginx/", f"{tmp_path}/"),
        ("127.0.0.1:8350", f"127.0.0.1:{port}"),
        # However slowly this test asks, it is too often.
        ("rate=20r/s", "rate=1r/m"),
    ):
        assert there in text
        text = text.replace(there, here)
    stores = "".join(
        f"{name}_temp_path {tmp_path}/{name};" for name in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    # Started by root it would work as somebody who may not read this folder.
    user = "user root; " if os.geteuid() == 0 else ""
    (tmp_path / "nginx.conf").write_text(
        f"{user}daemon off; pid {tmp_path}/pid; error_log {tmp_path}/errors; events {{}} "
        f"http {{ access_log {tmp_path}/accesses; {stores} {text} }}"
    )
    server = subprocess.Popen([NGINX, "-p", str(tmp_path), "-c", str(tmp_path / "nginx.conf")])

    def answers() -> bool:
        assert server.poll() is None
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", outside), PATIENCE):
            return True
        return False

    wait_for(answers)
    yield f"https://127.0.0.1:{outside}", live.address.partition("#")[2]
    server.terminate()
    server.wait(PATIENCE)
    live.close()


def test_the_map_behind_nginx(served: tuple[str, str], tmp_path: Path) -> None:
    address, token = served
    pass_word = {"Authorization": "Basic " + base64.b64encode(b"harbor:tide").decode()}
    # As a browser asks: with its own host and origin.
    asked = {**pass_word, "Host": "map.example.org", "Origin": "https://map.example.org"}
    with httpx.Client(verify=False, base_url=address, timeout=PATIENCE) as client:
        assert client.get("/").status_code == 401
        page = client.get("/", headers=asked)
        assert page.status_code == 200
        assert "frame-ancestors 'none'" in page.headers["content-security-policy"]
        assert client.get("/events", headers=asked).status_code == 403
        with client.stream("GET", "/events", params={"token": token}, headers=asked) as events:
            assert events.status_code == 200
            assert next(events.iter_lines()) == "event: site"
        assert client.post("/", headers=asked, content=b"x" * 2_000_000).status_code == 413
        found = [client.get("/", headers=asked).status_code for _ in range(150)]
        assert 200 in found
        assert 503 in found  # more than are allowed
    assert token not in (tmp_path / "accesses").read_text()
