"""A session without its slow parts: what it proposes, what it shows, when it calibrates and when it ends."""

import math
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from capture_frames import BOARD

from kcal.calibrate.camera.advice import NextView
from kcal.capture import session as module
from kcal.capture.session import FIRST_VIEWS, CaptureOptions, CaptureSession, follow
from kcal.corners.detect import Detection
from kcal.errors import InputError
from kcal.lens.pose import rotation_from_vector

SIZE = (320, 240)
IMAGE = np.arange(240 * 320, dtype=np.uint32).reshape(240, 320).astype(np.uint8)


def place(number: int) -> torch.Tensor:
    """Corners of a board whose left upper one is 12 px further right and 8 px lower for each number."""
    grid = torch.cartesian_prod(torch.arange(BOARD.rows), torch.arange(BOARD.columns)).flip(-1).double()
    return 20.0 * grid + torch.tensor([20.0, 30.0]) + number * torch.tensor([12.0, 8.0])


@pytest.fixture
def session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> CaptureSession:
    """Every frame shows a board at the place whose number is its first pixel; calibrations cost nothing."""

    def detect(image: Any, board: Any, refine: Any) -> Detection:
        return (
            Detection(pixels=place(int(image[0, 0]))) if image[0, 0] < 90 else Detection(pixels=None, reason="no board")
        )

    def calibrate(seen: Any) -> SimpleNamespace:
        rotation = rotation_from_vector(torch.tensor([[0.5, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]).double())
        rotation[2] = torch.nan
        return SimpleNamespace(
            camera=len(seen.views), hybrid=SimpleNamespace(sigma=1.0), cam_from_board_rotation=rotation, warnings=("w",)
        )

    def proposal(*_: Any) -> NextView:
        return NextView(torch.eye(3), torch.zeros(3), place(1), "somewhere", math.inf)

    monkeypatch.setattr(module, "detect_board", detect)
    monkeypatch.setattr(module, "calibrate_camera", calibrate)
    monkeypatch.setattr(module, "far_sigma", lambda camera: 1.0 / camera)
    monkeypatch.setattr(module, "next_view", proposal)
    return CaptureSession(tmp_path / "left.obs.json", BOARD, CaptureOptions(until=0.19, most=7))


def frame(number: int) -> np.ndarray:
    image = IMAGE.copy()
    image[0, 0] = number
    return image


def test_before_the_first_frame(session: CaptureSession) -> None:
    assert session.picture() is None
    assert not session.think()
    state = session.state()
    assert (state["views"], state["size"], state["next"], state["corners"], state["outlines"]) == (
        0,
        [0, 0],
        None,
        [],
        [],
    )
    assert (state["most"], state["until"], state["message"], state["finished"]) == (7, 0.19, "show the board", "")
    assert math.isnan(session.sigma)


def test_a_frame_without_a_board_gives_the_size_and_a_first_proposal(session: CaptureSession) -> None:
    assert not session.offer(frame(99), "x", moving=True)
    assert session.think()
    assert not session.think()
    state = session.state()
    assert state["size"] == [320, 240]
    assert state["message"] == "no board"
    assert state["next"]["sigma"] is None
    # In the middle of the image, which a camera of 58 degrees across sees.
    outline = np.array(state["next"]["outline"])
    assert np.allclose(outline.mean(0), [160, 120], atol=25)
    assert np.ptp(outline[:, 0]) > 100
    assert ((outline > 0) & (outline < SIZE)).all()
    suggestion = session.suggestion
    upper = suggestion.pixels[: BOARD.columns] if "left" in suggestion.words else suggestion.pixels
    seen = suggestion.rotation @ BOARD.points.T + suggestion.translation[:, None]
    focal = (upper - upper.mean(0)).norm() / (seen[:2] / seen[2])[:, : len(upper)].sub(
        (seen[:2] / seen[2])[:, : len(upper)].mean(1, keepdim=True)
    ).norm()
    assert float(focal) == pytest.approx(0.9 * 320, rel=1e-6)
    assert state["next"]["first"] == [state["next"]["outline"][0]]


def test_four_first_views_are_tilts_in_different_directions(session: CaptureSession) -> None:
    words = []
    for number in range(FIRST_VIEWS):
        assert session.offer(frame(number), f"a {number}.png", moving=False)
        if number < FIRST_VIEWS - 1:
            assert session.think()
            assert not session.think()
            words.append(session.state()["next"]["words"])
    assert len(set(words)) == 3
    assert all("near, in the middle" in text and "away" in text for text in words)


def test_calibrations_and_the_end(session: CaptureSession) -> None:
    for number in range(FIRST_VIEWS):
        session.offer(frame(number), str(number), moving=False)
    assert session.think()
    assert not session.think()
    state = session.state()
    assert state["history"] == [[4, 0.25]]
    assert session.sigma == 0.25
    assert state["warnings"] == ["w"]
    assert state["next"]["words"] == "somewhere"
    assert state["next"]["sigma"] is None
    # Where normals lean, and rolls; of views that were not left out.
    np.testing.assert_allclose(state["holds"], [[0, -math.sin(0.5), 0], [0, 0, math.degrees(1.0)]], atol=1e-9)
    assert state["finished"] == ""
    for number in (4, 5):
        session.offer(frame(number), str(number), moving=False)
        session.think()
    assert session.finished == "points at infinity are known to ± 0.167 px: enough"
    session.history.clear()
    session.offer(frame(6), "6", moving=False)
    assert session.finished == "7 views were kept: the most that were asked for"


def test_what_is_shown_of_the_boards(session: CaptureSession) -> None:
    session.offer(frame(2), "a", moving=False)
    state = session.state()
    corners = place(2)
    outer = [corners[i].tolist() for i in (0, BOARD.columns - 1, BOARD.corners - 1, BOARD.corners - BOARD.columns)]
    assert state["outlines"] == [outer]
    assert state["corners"] == corners.tolist()
    session.offer(frame(99), "b", moving=False)
    assert session.state()["corners"] == []
    assert session.state()["size"] == [320, 240]


def test_a_board_must_rest_and_be_somewhere_new(session: CaptureSession) -> None:
    assert not session.offer(frame(0), "a", moving=True)
    assert session.message == "hold still"
    assert session.offer(frame(0), "a", moving=True)
    assert not session.offer(frame(1), "b", moving=True)
    assert session.message == "hold still"
    assert session.offer(frame(1), "b/c.png", moving=True)
    assert session.message == "kept b/c.png"
    assert session.frames == session.output.parent / "left.frames"
    assert {path.name for path in session.frames.iterdir()} == {"a.png", "b_c.png"}
    assert not session.offer(frame(0), "d", moving=False)
    assert session.message.startswith("kept one like this already")
    with pytest.raises(InputError, match="d: 240x320 px, earlier views have another size"):
        session.offer(np.ascontiguousarray(frame(0).T), "d", moving=False)


def test_the_picture_is_no_wider_than_a_screen(session: CaptureSession) -> None:
    for width, step in ((1280, 1), (1281, 2), (3000, 3)):
        image = np.arange(10 * width, dtype=np.uint32).astype(np.uint8).reshape(10, width)
        image[0, 0] = 99
        session.offer(image, "x", moving=False)
        found = session.picture()
        assert found is not None
        assert np.array_equal(cv2.imdecode(np.frombuffer(found, np.uint8), cv2.IMREAD_UNCHANGED), image[::step, ::step])


def test_following_ends(session: CaptureSession) -> None:
    for number in range(6):
        session.offer(frame(number), str(number), moving=False)
    follow(session, until=lambda: True)
    assert session.history == []
    follow(session, until=lambda: False)
    assert session.history == [(6, 1 / 6)]


def test_limits_of_the_options() -> None:
    CaptureOptions(most=FIRST_VIEWS)
    for until in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(InputError, match="until must be positive"):
            CaptureOptions(until=until)
    with pytest.raises(InputError, match="at least 4 views, got 3"):
        CaptureOptions(most=FIRST_VIEWS - 1)


def test_routes(session: CaptureSession) -> None:
    pytest.importorskip("starlette", reason="the extra `mark` is not installed")
    pytest.importorskip("httpx", reason="starlette's test client needs httpx")
    from starlette.testclient import TestClient

    from kcal.capture.session import capture_app

    stop = threading.Event()
    app = capture_app(session, stop, "token", ("here",))
    with TestClient(app, base_url="http://here", headers={"X-Kcal-Token": "token"}) as client:
        assert client.get("/").status_code == 200
        assert client.get("/api/picture").status_code == 204
        session.offer(frame(0), "a", moving=False)
        picture = client.get("/api/picture")
        assert picture.status_code == 200
        assert picture.headers["content-type"] == "image/png"
        state = client.get("/api/state").json()
        assert (state["views"], state["stopped"]) == (1, False)
        assert client.get("/api/stop").status_code == 405
        assert not stop.is_set()
        assert client.post("/api/stop").json() == {}
        assert stop.is_set()
        assert client.get("/api/state").json()["stopped"]
