"""Commands that are interrupted, and pages of captures."""

import json
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import pytest
import torch
from board_render import render
from calibrate_scenes import BOARD, corner_pixels, observe
from command_line import ran
from interrupted import interrupt
from typer.testing import Result

from kcal import CalibrationOptions, Observations, calibrate_camera, load_camera, load_rig, save_camera

# Ctrl-C: a command ends with one line and exit code 130, whatever it is doing, and leaves nothing torn behind.


SAMPLE = Path(__file__).parents[2] / "assets" / "sample-rig.json"

POINTS = SAMPLE.with_name("sample-points.csv")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    save_camera(load_rig(SAMPLE).left, tmp_path / "left.camera.json")
    return tmp_path


@pytest.mark.parametrize("moment", ["import:kcal.cli.main", "import:torch", "lost:kcal.cli.main", "lost:torch"])
def test_while_it_loads(moment: str, folder: Path) -> None:
    assert interrupt(folder, moment, "export left.camera.json -o left.yaml") == "interrupted; nothing was written"


def test_while_a_table_is_located(folder: Path) -> None:
    said = interrupt(folder, "step:1", f"locate {SAMPLE} {POINTS} -o a.csv")
    assert said == "interrupted after 7 rows; written: nothing; other files are as they were"


def test_a_file_that_came_into_place_is_named(folder: Path) -> None:
    line = f"locate {SAMPLE} {POINTS} -o a.csv -o b.geojson"
    said = interrupt(folder, "written:1", line)
    assert (folder / "b.geojson").exists() == ("b.geojson" in said)
    assert (folder / "a.csv").exists() == ("a.csv" in said)
    assert (folder / "a.csv").exists() != (folder / "b.geojson").exists()
    said = interrupt(folder, "written:1", "diff left.camera.json left.camera.json --picture d.png")
    assert said == "interrupted; written and kept: d.png"


def test_an_old_file_stays_until_the_new_one_is_whole(folder: Path) -> None:
    (folder / "left.yaml").write_text("old")
    assert interrupt(folder, "write:1", "export left.camera.json -o left.yaml") == "interrupted; nothing was written"
    assert (folder / "left.yaml").read_text() == "old"


@pytest.mark.slow
def test_while_an_image_is_searched(folder: Path) -> None:
    """OpenCV's search goes on in a thread, from which Python's end would abort the process."""
    corners = np.array([[200, 150], [440, 160], [430, 330], [190, 320]], np.float32)
    flat = np.array([[0, 0], [6, 0], [6, 5], [0, 5]], np.float32)
    image, _ = render(BOARD, (640, 480), cv2.getPerspectiveTransform(flat, corners), supersample=3)
    cv2.imwrite(str(folder / "a.png"), image)
    line = "detect a.png --board 7x6 --square 50mm -o new.obs.json"
    assert interrupt(folder, "search:1", line) == "interrupted; nothing was written"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "moments"),
    [
        ("calibrate left.obs.json -o new.camera.json", ["step:2", "write:1"]),
        ("board measure left.obs.json -o plate.board.json --picture plate.png", ["step:1", "write:2"]),
        ("detect images --board 7x6 --square 50mm -o new.obs.json --refine saddle", ["step:1", "write:1"]),
        ("rectify near.camera.json images -o straight", ["write:2"]),
        ("rig left.camera.json right.camera.json --landmarks survey.csv --marks marks.csv -o rig.json", ["step:4"]),
        ("demo -o site", ["step:1", "write:2"]),
        ("batch cameras --board 7x6 --square 50mm -o results --workers 2", ["step:1"]),
    ],
)
def test_long_work(line: str, moments: list[str], site: Path) -> None:
    for moment in moments:
        written = {path: path.read_bytes() for path in site.rglob("*") if path.is_file()}
        said = interrupt(site, moment, line)
        assert said.startswith("interrupted; ")
        new = [path for path in site.rglob("*") if path.is_file() and path not in written]
        # One file for each that was to be written before that moment; of the work of others `batch` has a folder.
        assert len(new) <= int(moment[-1])
        assert all(path.read_bytes() == content for path, content in written.items())
        assert all(path.name in said for path in new if ".work" not in path.parts)
        for path in new:
            path.unlink()


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Observations and images of a camera, and a rig of others with marked landmarks."""
    folder = tmp_path_factory.mktemp("site")
    seen = observe(corner_pixels(10, 1, noise=0.05))
    seen.save(folder / "left.obs.json")
    calibrate_camera(seen, CalibrationOptions(model="opencv5")).save(folder / "near.camera.json", name="near")
    for place in ("images", "cameras/a", "cameras/b"):
        (folder / place).mkdir(parents=True)
        for i, view in enumerate(seen.pixels()[:3]):
            corners = view[[0, 6, 41, 35]].numpy().astype(np.float32)
            flat = np.array([[0, 0], [6, 0], [6, 5], [0, 5]], np.float32)
            image, _ = render(BOARD, (640, 480), cv2.getPerspectiveTransform(flat, corners), seed=i, supersample=3)
            cv2.imwrite(str(folder / place / f"{i}.png"), image)
    rig = load_rig(SAMPLE)
    save_camera(rig.left, folder / "left.camera.json")
    save_camera(rig.right, folder / "right.camera.json")
    places = torch.tensor([[x, 4.0 * (i % 3 - 1), 150.0 + 40 * i] for i, x in enumerate(range(-42, 48, 12))]).double()
    right = places @ rig.right_from_left_rotation.T + rig.right_from_left_translation
    marks = torch.cat([rig.left.project(places)[0], rig.right.project(right)[0]], 1)
    names = "abcdefgh"
    survey = [f"{n},{x},{z},{-y},0.02" for n, (x, y, z) in zip(names, places.tolist(), strict=True)]
    (folder / "survey.csv").write_text("\n".join(["name,east,north,up,sigma", *survey]))
    rows = [",".join([n, *map(str, row)]) for n, row in zip(names, marks.tolist(), strict=True)]
    (folder / "marks.csv").write_text("\n".join(["name,left_u,left_v,right_u,right_v", *rows]))
    return folder


# The page of `kcal capture`: its address is told on one line and opened, and a capture without a board is an error.


ADDRESS = "http://127.0.0.1:8348/#" + 60 * "t"


class Server:
    """In place of the one that answers browsers: it runs until it is told to stop."""

    made: ClassVar[list[tuple[int, bool]]] = []

    def __init__(self, make_app: Callable[..., object], port: int, *, fallback: bool) -> None:
        self.address, self._stopped = ADDRESS, threading.Event()
        self.made.append((port, fallback))

    def run(self) -> None:
        self._stopped.wait()

    def stop(self) -> None:
        self._stopped.set()


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Addresses that were opened, of captures whose source shows nothing."""
    found: list[str] = []

    def nothing(*_: object) -> Iterator[None]:
        return iter(())

    monkeypatch.setattr("kcal.capture.session.shots", nothing)
    monkeypatch.setattr("kcal.web.serving.LocalServer", Server)
    monkeypatch.setattr("webbrowser.open", found.append)
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    monkeypatch.setattr(Server, "made", [])
    return found


def capture(folder: Path, *options: str) -> Result:
    words = ["capture", "camera:0", "--board", "9x6", "--square", "25mm", "-o", str(folder / "left.obs.json"), *options]
    return ran(*words, env={"COLUMNS": "40"})


def test_the_address_is_on_one_line_and_opened(tmp_path: Path, opened: list[str]) -> None:
    """A wrapped one cannot be clicked; the usual port may be taken, and a port that was asked for may not."""
    done = capture(tmp_path)
    assert f"capture page: {ADDRESS}\n" in done.output
    assert opened == [ADDRESS]
    assert done.exit_code != 0
    assert "no frame showed the board" in str(done.exception)
    capture(tmp_path, "--no-browser", "--port", "9000")
    assert opened == [ADDRESS]
    assert Server.made == [(8348, True), (9000, False)]


def test_no_page(tmp_path: Path, opened: list[str]) -> None:
    assert "capture page" not in capture(tmp_path, "--no-page").output
    assert opened == []
    assert Server.made == []


def test_an_interruption_before_all_has_started(
    tmp_path: Path, opened: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What has started ends: a thread that was left behind would keep the command alive."""
    start, begun, ended, given_up = threading.Thread.start, [], threading.Event(), threading.Event()

    def endless(source: str, stopped: Callable[[], bool], tell: object) -> Iterator[None]:
        while not (stopped() or given_up.wait(0.01)):
            pass
        ended.set()
        return iter(())

    def interrupted(thread: threading.Thread) -> None:
        begun.append(thread)
        if len(begun) == 2:
            raise KeyboardInterrupt
        start(thread)

    monkeypatch.setattr("kcal.capture.session.shots", endless)
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", interrupted)
        done = capture(tmp_path, "--no-page")
    try:
        assert done.exit_code == 130
        assert ended.is_set()
    finally:
        given_up.set()


# As a user goes with somebody's capture: calibrate both cameras, ask whether they may be used, solve the rig, ask.


def kcal(*words: object) -> tuple[int, str]:
    found = ran(*words)
    return found.exit_code, found.output


@pytest.mark.slow
def test_a_stereo_capture_from_observations_to_the_verdict_on_its_rig(kcal_data: Path, tmp_path: Path) -> None:
    """Ten of the pairs of a webcam rig, of which nobody knows the truth: what must agree, agrees."""
    seen, cameras = [], []
    for side in ("left", "right"):
        file, camera = tmp_path / f"{side}.obs.json", tmp_path / f"{side}.camera.json"
        whole = Observations.load(kcal_data / "captures" / f"st1_{side[0]}.obs.json")
        whole.model_copy(update={"views": whole.views[:10]}).save(file)
        code, text = kcal("calibrate", file, "-o", camera)
        assert code == 0, text
        seen.append(file)
        cameras.append(camera)
        assert load_camera(camera).calibration.record.rms < 0.5
    code, text = kcal("report", cameras[0], "--observations", seen[0], "-o", tmp_path / "left.html", "--json")
    assert code == (0 if json.loads(text[text.index("{") :])["verdict"]["usable"] else 3)
    assert (tmp_path / "left.html").stat().st_size > 100_000
    code, text = kcal("rig", *cameras, "--pairs", *seen, "-o", tmp_path / "rig.json")
    assert code == 0, text
    rig = load_rig(tmp_path / "rig.json")
    assert rig.calibration.pairs >= 7
    assert rig.covariance is not None
    assert 0.02 < float(rig.baseline) < 0.5
    code, text = kcal("report", tmp_path / "rig.json", *(word for file in seen for word in ("--observations", file)))
    assert code in (0, 3)
    assert ("YES" if code == 0 else "NO") in text
    # Each finding in words, none by its internal name.
    assert not any(name in text for name in ("\n  halves:", "\n  patterns:", "\n  other-views:", "\n  exact-lenses:"))
