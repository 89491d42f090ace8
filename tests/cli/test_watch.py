"""`kcal watch` on folders, and its history in `kcal locate` and `kcal live`."""

import json
import math
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from socketserver import StreamRequestHandler, TCPServer

import orjson
import polars
import pytest
import torch
from command_line import Command, ran, rows_of
from PIL import Image
from waiting import PATIENCE

import kcal.watch.watcher as watcher_module
from kcal import InputError, load_rig, save_rig
from kcal.lens.rig import Mounting, Origin
from kcal.locate.budget import planned_rig
from kcal.watch.history import history_head, history_line
from kcal.watch.watcher import Webhook
from tests.helpers.scene_pairs import pair, small_rig
from tests.helpers.watched_looks import START, row_of, yaw_turn

ZERO = torch.zeros(3).double(), torch.ones(3).double()


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig whose right camera turns by 0.02° after the second of five moments."""
    folder = tmp_path_factory.mktemp("site")
    save_rig(small_rig(), folder / "rig.json")
    for k in range(5):
        one = pair(k + 1, turns=yaw_turn(0.02 if k >= 2 else 0.0))
        for side in ("left", "right"):
            (folder / side).mkdir(exist_ok=True)
            Image.fromarray(getattr(one, side)).save(folder / side / f"2026-05-01T12{k:02d}00.png")
    return folder


@pytest.mark.slow
def test_a_drift_is_found_told_and_drawn(site: Path, command: Command) -> None:
    history, picture = site / "h.csv", site / "p.png"
    words = [str(site / name) for name in ("rig.json", "left", "right")]
    found = command("watch", *words, "-o", history, "--picture", picture, "--parquet", site / "h.parquet", code=3)
    assert "beyond the limit of 0.005°" in " ".join(found.err.split())
    assert picture.stat().st_size > 10_000
    rows = rows_of(history)
    assert [float(row["time"]) for row in rows] == [START + 60.0 * k for k in range(5)]
    assert polars.read_parquet(site / "h.parquet")["time"].to_list() == [float(row["time"]) for row in rows]
    assert float(rows[4]["relative_yaw_deg"]) == pytest.approx(0.02, abs=0.003)
    assert int(rows[0]["matches"]) > 100
    # Doubted at first: the interval contains both.
    assert float(rows[2]["relative_yaw_sigma_deg"]) > 0.015
    # Nothing new: nothing is looked at, no new alarm.
    again = command("watch", *words, "-o", history, "--relock", site / "new.json")
    assert "not re-locked: a day of history and more than 20 measurements are needed" in " ".join(again.out.split())
    assert not (site / "new.json").exists()


@pytest.mark.slow
def test_a_history_becomes_parquet_once_a_day(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made, rows, seen = tmp_path / "h.parquet", [], pair(1)
    monkeypatch.setattr(watcher_module, "_LEARN_S", 100.0)
    watcher = watcher_module.Watcher(small_rig(), tmp_path / "h.csv", every_s=1.0, parquet=made)
    for k in range(3):
        watcher.look(60.0 * k, seen.left, seen.right)
        rows.append(polars.read_parquet(made)["time"].to_list())
    watcher.close()
    assert rows == [[0.0], [0.0], [0.0, 60.0, 120.0]]


@pytest.fixture
def watched(tmp_path: Path) -> Path:
    """A rig with a history: an hour of looks after a turn of 0.01°, then ten hours of nothing."""
    rig = planned_rig()
    rig.mounting = Mounting(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0)
    save_rig(rig, tmp_path / "rig.json")
    rows = [row_of(START + 60.0 * k, yaw_turn(0.01)) for k in range(60)]
    rows += [row_of(START + 3600.0 + 600.0 * k, None) for k in range(60)]
    fingerprint = load_rig(tmp_path / "rig.json").fingerprint
    (tmp_path / "h.csv").write_text(history_head() + "".join(history_line(row, fingerprint, ZERO) for row in rows))
    return tmp_path


def marks(folder: Path, times: list[str]) -> Path:
    """A target at 2 km, as the turned rig sees it, at some times."""
    left, right = planned_rig()(torch.tensor([[0.0, 0.0, 2000.0]], dtype=torch.float64))[0].unbind(-2)
    right = right + torch.tensor([[1600.0 * math.tan(math.radians(0.01)), 0.0]])
    lines = ["name,left_u,left_v,right_u,right_v,time"]
    for k, time in enumerate(times):
        lines.append(",".join([f"p{k}", *map(str, left[0].tolist() + right[0].tolist()), time]))
    path = folder / "points.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_rig_without_a_place_has_no_errors_of_its_place(watched: Path, command: Command) -> None:
    rig = load_rig(watched / "rig.json")
    rig.mounting = None
    save_rig(rig, watched / "lab.json")
    words = ["locate", watched / "lab.json", marks(watched, [f"{START + 1800.5}"]), "--pixel-sigma", "0.02"]
    found = command(*words, "--history", watched / "h.csv", "-o", watched / "lab.csv")
    said = " ".join((found.out + found.err).split())
    assert "of the errors in calibration" in said
    assert "calibration and mounting" not in said


def test_rows_are_located_by_the_rig_of_their_time(watched: Path, command: Command) -> None:
    points = marks(watched, [f"{START + 1800.5}", "2026-05-01T12:30:00Z", f"{START + 36_000}"])
    words = ["locate", str(watched / "rig.json"), str(points), "--pixel-sigma", "0.02", "-o", str(watched / "out.csv")]
    found = command(*words, "--history", watched / "h.csv")
    assert "errors in calibration and mounting are not included" not in " ".join((found.out + found.err).split())
    rows = rows_of(watched / "out.csv")
    assert [float(row["range_m"]) for row in rows[:2]] == pytest.approx([2000.0] * 2, rel=0.01)
    wide = [float(row["range_high_m"]) - float(row["range_low_m"]) for row in rows]
    assert wide[2] > 1.4 * wide[0]
    assert float(rows[2]["range_low_m"]) < 2000.0 < float(rows[2]["range_high_m"])
    command(*words)
    assert abs(float(rows_of(watched / "out.csv")[0]["range_m"]) - 2000.0) > 60.0


def test_what_locate_needs_for_it(watched: Path, command: Command) -> None:
    points = marks(watched, ["yesterday"])
    words = ["locate", str(watched / "rig.json"), str(points), "--history", str(watched / "h.csv")]
    for text, message in (("yesterday", "p0: time 'yesterday'"), (f"{START - 60}", "tells nothing of that time")):
        marks(watched, [text])
        found = ran(*words)
        assert found.exit_code == 1
        assert message in " ".join(str(found.exception).split())
    command(*words, "--aged 9h:0.0004", code=2)
    points.write_text("name,left_u,left_v,right_u,right_v\na,959.5,539.5,951.5,539.5\n")
    assert "needs a column time" in str(ran(*words).exception)


def test_live_tracks_have_the_sigma_of_the_moment(watched: Path, command: Command) -> None:
    rig = planned_rig()
    sigmas = {}
    for name, start in (("day", START + 1800.0), ("dark", START + 36_000.0)):
        lines = []
        for k in range(12):
            left, right = rig(torch.tensor([[5.0 * k / 10.0, 0.0, 1500.0]], dtype=torch.float64))[0].unbind(-2)
            right = right + torch.tensor([[1600.0 * math.tan(math.radians(0.01)), 0.0]])
            lines.append(orjson.dumps({"time": start + k / 10.0, "left": left.tolist(), "right": right.tolist(),
                                       "sigma": 0.02}))  # fmt: skip
        source = watched / f"{name}.jsonl"
        source.write_bytes(b"\n".join(lines) + b"\n")
        output = watched / f"{name}.csv"
        words = ["live", str(watched / "rig.json"), "--detections", str(source), "-o", str(output)]
        command(*words, "--history", watched / "h.csv")
        last = rows_of(output)[-1]
        assert float(last["range_low_m"]) < 1500.0 < float(last["range_high_m"])
        sigmas[name] = float(last["range_high_m"]) - float(last["range_low_m"])
    assert sigmas["dark"] > 1.3 * sigmas["day"]


def test_a_webhook_gets_the_alarm_and_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kcal.watch.watcher._PATIENCE", PATIENCE)
    got: list[dict[str, object]] = []

    class Hook(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            if len(refused):
                refused.pop()
                self.send_response(500)
            else:
                got.append(json.loads(body))
                self.send_response(204)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    refused = [1]
    server = HTTPServer(("127.0.0.1", 0), Hook)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    hook = Webhook(f"http://127.0.0.1:{server.server_port}/x")
    hook.send({"time": 1.0})
    assert (hook.failed, got) == (1, [])
    hook.again()
    hook.again()
    server.shutdown()
    assert (hook.failed, got) == (1, [{"time": 1.0}])


@pytest.mark.parametrize("address", ["udp://host", "http://[::1", "http://host:99999"])
def test_impossible_webhooks(address: str) -> None:
    with pytest.raises(InputError, match="write http"):
        Webhook(address)


def test_a_webhook_that_speaks_no_http_ends_nothing() -> None:
    class Babble(StreamRequestHandler):
        def handle(self) -> None:
            self.rfile.readline()
            self.wfile.write(b"no protocol at all\r\n")

    with TCPServer(("127.0.0.1", 0), Babble) as server:
        threading.Thread(target=server.handle_request, daemon=True).start()
        hook = Webhook(f"http://127.0.0.1:{server.server_address[1]}/x")
        hook.send({"time": 1.0})
    assert hook.failed == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["-o", "h.csv", "left"], "two folders"),
        (["-o", "h.json", "left", "right"], "ends with .csv"),
        (["-o", "h.csv", "--alarm", "mail:me"], "http"),
        (["-o", "h.csv", "--parquet", "h.txt"], "ends with .parquet"),
    ],
)
def test_wrong_words(tmp_path: Path, words: list[str], message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    save_rig(small_rig(), tmp_path / "rig.json")
    found = ran("watch", "rig.json", *words)
    assert found.exit_code in (1, 2)
    assert message in " ".join((found.output + str(found.exception)).split())


@pytest.mark.slow
def test_videos_are_watched_too_and_continue(tmp_path: Path, command: Command) -> None:
    pytest.importorskip("av")
    from tests.helpers.video_scenes import write_video

    save_rig(small_rig(), tmp_path / "rig.json")
    times = [0.0, 1.0, 2.0, 3.0]
    pairs = [pair(k + 1) for k in range(4)]
    for side in ("left", "right"):
        write_video(tmp_path / f"{side}.mp4", [getattr(one, side) for one in pairs], times)
    words = ["watch", *(str(tmp_path / name) for name in ("rig.json", "left.mp4", "right.mp4"))]
    words += ["-o", str(tmp_path / "h.csv"), "--every", "2"]
    for _ in range(2):
        command(*words)
        assert [float(row["time"]) for row in rows_of(tmp_path / "h.csv")] == [0.0, 2.0]
