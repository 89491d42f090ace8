"""Who may ask a local page, what is refused and with which status, and the files of the page itself."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pydantic
import pytest

pytest.importorskip("starlette", reason="the extra `mark` is not installed")
pytest.importorskip("httpx", reason="starlette's test client needs httpx")
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.testclient import TestClient

from kcal.errors import FileError, InputError
from kcal.web.serving import json_body, local_app, new_token, page_files

TOKEN = "secret-of-this-start"
HOST = "127.0.0.1:8347"
LARGEST = 1 << 20


class Point(pydantic.BaseModel):
    u: int
    v: int

    @pydantic.model_validator(mode="after")
    def _ordered(self) -> Point:
        if self.u > self.v:
            raise ValueError("u is larger")
        return self


async def echo(request: Request) -> Response:
    return JSONResponse(await json_body(request))


async def point(request: Request) -> Response:
    Point.model_validate(await json_body(request))
    return JSONResponse({})


async def fail(request: Request) -> Response:
    match request.path_params["how"]:
        case "disk":
            raise FileError("the disk\n  is full") from OSError("no space")
        case "file":
            raise FileError("no such file") from ValueError("elsewhere")
        case _:
            raise InputError("not a number") from OSError("elsewhere")


@pytest.fixture
def client() -> Iterator[TestClient]:
    routes = [
        Route("/api/echo", echo, methods=["POST"]),
        Route("/api/point", point, methods=["POST"]),
        Route("/api/fail/{how}", fail),
    ]
    app = local_app(
        routes, {"/": (b"<p>", "text/html"), "/a.js": (b"1", "text/javascript")}, TOKEN, (HOST, "localhost:1")
    )
    with TestClient(app, base_url=f"http://{HOST}", headers={"X-Kcal-Token": TOKEN}) as found:
        yield found


def test_only_this_machines_names_are_served(client: TestClient) -> None:
    for host in ("evil.example", "127.0.0.1", "127.0.0.1:80", "localhost.evil.example:8347", ""):
        for path in ("/", "/api/echo"):
            answer = client.post(path, headers={"Host": host}, json=1)
            assert answer.status_code == 403
            assert answer.json() == {"error": "this host is not served"}
    assert client.get("/", headers={"Host": "localhost:1"}).status_code == 200
    assert client.get("/", headers={"Origin": "http://evil.example"}).status_code == 403
    assert client.get("/", headers={"Origin": f"http://{HOST}"}).status_code == 200


def test_data_need_the_token_and_pages_do_not(client: TestClient) -> None:
    for token in ("", "wrong", TOKEN + "x", "é"):
        answer = client.post("/api/echo", headers={"X-Kcal-Token": token.encode()}, json=1)
        assert answer.status_code == 401
        assert "the token is wrong" in answer.json()["error"]
        assert client.get("/", headers={"X-Kcal-Token": token.encode()}).status_code == 200
    assert client.post("/api/echo", json=1).json() == 1
    assert len(new_token()) == 32
    assert new_token() != new_token()


def test_every_answer_forbids_what_others_could_do_with_it(client: TestClient) -> None:
    answers = client.get("/"), client.get("/none"), client.get("/", headers={"Host": "x"}), client.get("/api/fail/disk")
    for answer in answers:
        assert answer.headers["content-security-policy"].startswith("default-src 'none'; script-src 'self'")
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["referrer-policy"] == "no-referrer"
        assert answer.headers["cache-control"] == "no-store"
        assert answer.headers["cross-origin-resource-policy"] == "same-origin"


def test_pages_have_their_type_and_are_only_read(client: TestClient) -> None:
    assert client.get("/a.js").content == b"1"
    assert client.get("/a.js").headers["content-type"].startswith("text/javascript")
    assert client.post("/a.js").status_code == 405
    assert client.get("/b.js").status_code == 404


def test_size_of_a_request(client: TestClient) -> None:
    assert client.post("/api/echo", content=b'"' + b"x" * (LARGEST - 2) + b'"').status_code == 200
    assert client.post("/api/echo", content=b'"' + b"x" * (LARGEST - 1) + b'"').status_code == 413
    for length in ("-1", "1" * 13, "x"):
        assert client.post("/api/echo", content=b"1", headers={"Content-Length": length}).status_code == 413
    assert client.post("/api/echo", content=iter([b"1"])).status_code == 413  # in chunks


@pytest.mark.parametrize(
    ("body", "message"),
    [(b"{", "the request cannot be read: Expecting"), (b"\xff", "the request cannot be read"),
     (b"9" * 5000, "the request cannot be read"), (b"[" * 100_000, "nested too deeply")],
)  # fmt: skip
def test_what_is_no_json(client: TestClient, body: bytes, message: str) -> None:
    answer = client.post("/api/echo", content=body)
    assert answer.status_code == 400
    assert message in answer.json()["error"]


def test_depth_of_a_request(client: TestClient) -> None:
    def nested(levels: int, begin: str, end: str) -> bytes:
        return (begin * levels + "1" + end * levels).encode()

    for begin, end in (("[", "]"), ('{"a": ', "}")):
        assert client.post("/api/echo", content=nested(31, begin, end)).status_code == 200
        answer = client.post("/api/echo", content=nested(32, begin, end))
        assert answer.status_code == 400
        assert answer.json()["error"] == "the request is nested too deeply"


def test_status_and_text_of_errors(client: TestClient) -> None:
    answers: list[tuple[str, Any, int, str]] = [
        ("point", {"u": 1}, 422, "v: Field required"),
        ("point", {"u": 1.5, "v": "x"}, 422, "u: Input should be a valid integer, got a number with a fractional part"),
        ("point", {"u": 2, "v": 1}, 422, "u is larger"),
    ]
    for path, body, status, text in answers:
        answer = client.post(f"/api/{path}", content=json.dumps(body))
        assert (answer.status_code, answer.json()["error"]) == (status, text)
    for how, status, text in (
        ("disk", 503, "the disk is full"),
        ("file", 400, "no such file"),
        ("x", 400, "not a number"),
    ):
        answer = client.get(f"/api/fail/{how}")
        assert (answer.status_code, answer.json()["error"]) == (status, text)


def test_files_of_a_page() -> None:
    found = page_files(("kcal.mark", "page"), ("kcal.web", "map"))
    assert found["/"][1] == "text/html"
    assert {path.split("/")[1] for path in found} == {"", "page", "map"}
    assert {kind for _, kind in found.values()} <= {"text/html", "text/javascript", "text/css", "image/svg+xml"}
    for path, (content, kind) in found.items():
        suffix = {"text/html": "", "text/javascript": ".js", "text/css": ".css", "image/svg+xml": ".svg"}[kind]
        assert path.endswith(suffix)
        assert content
