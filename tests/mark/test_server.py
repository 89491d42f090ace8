import errno
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("starlette", reason="the extra `mark` is not installed")
pytest.importorskip("httpx", reason="starlette's test client needs httpx")
from starlette.testclient import TestClient

from kcal.errors import FileError
from kcal.io.images import write_png
from kcal.mark.guide import open_pictures
from kcal.mark.marking_service import Desk
from kcal.mark.server import marking_app, marking_files
from kcal.mark.session import Journal, Session

TOKEN = "secret-of-this-start"
HOST = "127.0.0.1:8347"
MARK = {"u": 30.5, "v": 20.25, "cov": [0.01, 0.0, 0.01], "how": "corner", "frame": "left"}


@pytest.fixture
def client(tmp_path: Path) -> Iterator[TestClient]:
    axis = np.arange(60)
    corner = np.where((axis[:, None] >= 30) & (axis >= 27), 160, 60).astype(np.uint8)
    for side in ("left", "right"):
        write_png(tmp_path / f"{side}.png", np.pad(corner, 20, mode="edge"))
    desk = Desk(open_pictures(tmp_path / "left.png", tmp_path / "right.png"), Session(tmp_path / "marks.csv"))
    app = marking_app(desk, TOKEN, (HOST,))
    with TestClient(app, base_url=f"http://{HOST}", headers={"X-Kcal-Token": TOKEN}) as found:
        yield found
    desk.close()


def do(client: TestClient, action: dict[str, Any], key: str = "some-key-1") -> Any:
    return client.post("/api/act", json={"key": key, "action": action})


def test_the_page_loads_nothing_from_elsewhere(client: TestClient) -> None:
    answer = client.get("/")
    policy = answer.headers["content-security-policy"]
    assert answer.status_code == 200
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    for path, (content, kind) in marking_files().items():
        assert client.get(path).content == content
        if path.startswith("/page/") or path == "/":
            found = content.decode().replace("http://www.w3.org/2000/svg", "")
            assert "http" not in found, path
            assert " style=" not in found or kind != "text/html"
    assert client.get("/page/../server.py").status_code == 404
    assert client.get("/page/%2e%2e/server.py").status_code == 404


@pytest.mark.parametrize(
    "path", ["/api/state", "/api/about", "/api/tile?side=left&frame=0&level=0&x=0&y=0", "/api/none"]
)
def test_data_need_the_token(client: TestClient, path: str) -> None:
    for token in ("", "wrong", TOKEN + "x", "é"):
        assert client.get(path, headers={"X-Kcal-Token": token.encode()}).status_code == 401


@pytest.mark.parametrize(
    ("body", "status", "message"),
    [
        (json.dumps({"key": "k", "action": {"do": "undo"}}).encode(), 422, "key: String should have at least 8"),
        (json.dumps({"key": "12345678", "action": {"do": "undo"}}).encode(), 400, "nothing to undo"),
        (json.dumps({"key": "12345678", "action": {"do": "rm"}}).encode(), 422, "does not match any of the expected"),
        (json.dumps({"key": "12345678", "action": {"do": "put", "name": "x", "side": "left", "mark": MARK}}).encode(),
         400, "nothing is named 'x'"),
        (json.dumps({"key": "12345678", "action": {"do": "add", "name": "a\nb", "kind": "target"}}).encode(), 400,
         "one line"),
        (b'{"key": "12345678", "action": {"do": "put", "name": "x", "side": "left", "mark": {"u": NaN, "v": 1, "cov": '
         b"[1, 0, 1]}}}", 422, "finite number"),
        (json.dumps({"key": "12345678", "action": {"do": "put", "name": "x", "side": "left",
                                                   "mark": {**MARK, "cov": [1, 2, 1]}}}).encode(), 422,
         "the covariance is not positive definite"),
        (b" " * (1 << 21), 413, "too large"),
        (b'{"key": "12345678", "action": ' + b"[" * 900 + b"]" * 900 + b"}", 400, "nested too deeply"),
    ],
)  # fmt: skip
def test_bad_requests(client: TestClient, body: bytes, status: int, message: str) -> None:
    answer = client.post("/api/act", content=body)
    assert answer.status_code == status
    assert message in answer.json()["error"]
    assert client.get("/api/state").json()["version"] == 0


def test_a_click_outside_the_picture_is_no_mark(client: TestClient) -> None:
    do(client, {"do": "add", "name": "a", "kind": "target"})
    for number, (u, v) in enumerate(((-0.6, 5), (5, -3), (99.6, 5), (5, 1e5))):
        action = {"do": "put", "name": "a", "side": "left", "mark": {**MARK, "u": u, "v": v}}
        answer = do(client, action, f"outside-{number}")
        assert answer.status_code == 400
        assert "outside the left picture, which has 100x100 pixels" in answer.json()["error"]
    assert client.get("/api/state").json()["items"][0]["left"] is None
    for number, (u, v) in enumerate(((-0.5, 5), (99.5, 99.5))):
        action = {"do": "put", "name": "a", "side": "left", "mark": {**MARK, "u": u, "v": v}}
        assert do(client, action, f"border-{number}").status_code == 200


def test_a_full_disk_is_told_and_what_was_answered_stays(
    client: TestClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Room for 37 more bytes at a time: answers are whole or refusals, never failures of the server."""
    do(client, {"do": "add", "name": "a", "kind": "target"})
    random, left, wrote = np.random.default_rng(0), [0], os.write

    def write(file: int, data: bytes) -> int:
        count = min(left[0], len(data))
        left[0] -= count
        if not count:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return wrote(file, data[:count])

    answers = []
    with monkeypatch.context() as patched:
        patched.setattr("kcal.mark.session.os.write", write)
        for number in range(60):
            left[0] = int(random.integers(0, 400))
            action = {"do": "put", "name": "a", "side": "left", "mark": {**MARK, "u": float(number)}}
            answer = do(client, action, f"put-number-{number}")
            answers.append(answer.status_code)
            if answer.status_code == 503:
                assert "the disk is full; this was not done" in answer.json()["error"]
            else:
                last = float(number)
    assert {200, 503} == set(answers)
    assert client.get("/api/state").json()["items"][0]["left"]["u"] == last
    assert client.get("/api/state").json()["version"] == 1 + answers.count(200)
    again = Journal(Path(shutil.copy(tmp_path / "marks.log", tmp_path / "copy.log")))
    assert (again.count, again.notes) == (1 + answers.count(200), [])
    assert again.state.items["a"].left.u == last


def test_tables_that_cannot_be_written_are_told(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, text: str) -> None:
        raise FileError(f"{path}: cannot write") from OSError(errno.ENOSPC, "no space")

    with monkeypatch.context() as patched:
        patched.setattr("kcal.mark.session.write_atomic", full)
        do(client, {"do": "add", "name": "a", "kind": "feature"})
        answer = do(client, {"do": "put", "name": "a", "side": "left", "mark": MARK}, "some-key-2")
    assert answer.status_code == 200
    assert "the disk is full. Nothing is lost" in answer.json()["trouble"]
    answer = do(client, {"do": "put", "name": "a", "side": "right", "mark": MARK}, "some-key-3")
    assert answer.json()["trouble"] == ""


def test_tiles_are_the_gray_levels(client: TestClient, tmp_path: Path) -> None:
    answer = client.get("/api/tile", params={"side": "right", "frame": 0, "level": 0, "x": 0, "y": 0})
    size = int(answer.headers["x-height"]), int(answer.headers["x-width"])
    tile = np.frombuffer(answer.content, np.uint8).reshape(size)
    assert size == (100, 100)
    assert [tile[60, 60], tile[10, 10]] == [160, 60]
    assert client.get("/api/tile", params={"side": "right", "frame": 0, "level": 0, "x": 5, "y": 0}).status_code == 400
    assert client.get("/api/tile", params={"side": "up", "frame": 0, "level": 0, "x": 0, "y": 0}).status_code == 422
    answer = client.get("/api/enlarged", params={"side": "left", "frame": 0, "u": 47, "v": 50})
    assert answer.headers["x-factor"] == "10"
    assert int(answer.headers["x-width"]) * int(answer.headers["x-height"]) == len(answer.content) == 490 * 490
    assert (answer.headers["x-left"], answer.headers["x-top"]) == ("23", "26")


def test_tiles_of_color_images_are_in_color(tmp_path: Path) -> None:
    colors = np.random.default_rng(0).integers(0, 255, (100, 90, 3), dtype=np.uint8)
    for side in ("left", "right"):
        write_png(tmp_path / f"{side}.png", colors)
    desk = Desk(open_pictures(tmp_path / "left.png", tmp_path / "right.png"), Session(tmp_path / "marks.csv"))
    app = marking_app(desk, TOKEN, (HOST,))
    with TestClient(app, base_url=f"http://{HOST}", headers={"X-Kcal-Token": TOKEN}) as client:
        answer = client.get("/api/tile", params={"side": "left", "frame": 0, "level": 0, "x": 0, "y": 0})
        assert answer.headers["x-channels"] == "3"
        np.testing.assert_array_equal(np.frombuffer(answer.content, np.uint8).reshape(100, 90, 3), colors)
        answer = client.get("/api/enlarged", params={"side": "left", "frame": 0, "u": 47, "v": 50})
        patch = np.frombuffer(answer.content, np.uint8).reshape(490, 490, 3)
        at = [10 * (value - int(answer.headers[f"x-{name}"])) + 5 for name, value in (("top", 50), ("left", 47))]
        assert np.abs(patch[at[0], at[1]].astype(int) - colors[50, 47]).max() < 30
    desk.close()


def test_marking_without_cameras(client: TestClient, tmp_path: Path) -> None:
    found = client.post("/api/snap", json={"side": "left", "frame": 0, "u": 48, "v": 48}).json()
    assert found["how"] == "corner"
    assert (found["u"], found["v"]) == (pytest.approx(46.5, abs=0.1), pytest.approx(49.5, abs=0.1))
    assert "flat" in client.post("/api/snap", json={"side": "left", "frame": 0, "u": 20, "v": 20}).json()["refusal"]
    refusal = client.post("/api/curve", json={"side": "left", "frame": 0, "u": 1, "v": 1}).json()["refusal"]
    assert "no cameras were given" in refusal
    do(client, {"do": "add", "name": "tree", "kind": "target"})
    state = do(client, {"do": "put", "name": "tree", "side": "left", "mark": MARK}, "some-key-2").json()
    assert state["items"][0]["left"]["sigma"] == pytest.approx(0.1)
    assert state["undo"]
