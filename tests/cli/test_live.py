"""`kcal live`: tracks into files, stopped by SIGTERM and continued, and told what is wrong.

`kcal live --detections -` ends by a signal while its input stays open.
"""

import contextlib
import itertools
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from command_line import at_moment, invoked, ran, rows_of
from track_scenes import ORIGIN, seen_by, tracked_site
from waiting import PATIENCE, wait_for

from kcal import FileError, InputError, Origin, save_rig
from kcal.lens.rig import Mounting
from kcal.pipeline.stream import Stream
from kcal.pipeline.tracks import TrackOptions
from kcal.rig import planned_rig
from scripts.shared.station_scenes import marks, ring


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A rig file that says where it stands, and lines of two cars for two seconds; the right clock is 50 ms late."""
    rig = tracked_site().rig
    rig.mounting = Mounting(origin=ORIGIN, heading_deg=0.0)
    save_rig(rig, tmp_path / "rig.json")
    generator = torch.Generator().manual_seed(0)
    start = torch.tensor([[-30.0, 5.0, 150.0], [20.0, -10.0, 200.0]]).double()
    velocity = torch.tensor([[8.0, 4.0, 0.0], [-5.0, 3.0, 2.0]]).double()
    with open(tmp_path / "lines.jsonl", "w", encoding="utf-8") as file:
        for frame in range(20):
            places = start + frame / 10.0 * velocity
            left, right = seen_by(rig, places, 0.2, generator, places + 0.05 * velocity)
            line = {"time": 1.7e9 + frame / 10, "left": left.tolist(), "right": right.tolist(), "sigma": 0.2}
            file.write(json.dumps(line) + "\n")
        file.write("oops\n")
    return tmp_path


def live(folder: Path, *options: str) -> str:
    command = ["live", str(folder / "rig.json"), "--detections", str(folder / "lines.jsonl")]
    return invoked(*command, "-o", folder / "tracks.csv", *options)


def test_the_whole_job(folder: Path) -> None:
    told = live(folder, "--clock-sigma", "0.1")
    assert "20 moments, 34 positions; 1 malformed line" in told
    assert "last malformed line: not a line of JSON" in told
    offset = float(told.split("images are ")[1].split(" ")[0])
    sigma = float(told.split("± ")[1].split(" ")[0])
    assert abs(offset - 50.0) < 3 * sigma < 20.0
    rows = rows_of(folder / "tracks.csv")
    assert len(rows) == 34
    assert {row["name"] for row in rows} == {"track 1", "track 2"}
    assert float(rows[-2]["north_m"]) == pytest.approx(150.0, rel=0.02)


def test_sigterm_ends_it_and_the_next_run_continues(folder: Path) -> None:
    live(folder, "--clock-sigma", "0.1")
    whole = (folder / "tracks.csv").read_bytes()
    for path in folder.glob("tracks.csv*"):
        path.unlink()
    before = signal.getsignal(signal.SIGTERM)
    with at_moment(7):
        assert "7 moments, 8 positions" in live(folder, "--clock-sigma", "0.1")
    assert signal.getsignal(signal.SIGTERM) is before
    assert "continuing after 7 moments" in live(folder, "--clock-sigma", "0.1")
    assert (folder / "tracks.csv").read_bytes() == whole


def test_the_bar_tells_how_much_of_the_file_is_done(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[float] = []

    @contextlib.contextmanager
    def steps(what: str, total: int | None) -> Iterator[Callable[..., None]]:
        assert total == (folder / "lines.jsonl").stat().st_size
        yield lambda text, by: done.append(by)

    monkeypatch.setattr("kcal.cli.live.steps", steps)
    monkeypatch.setattr("kcal.cli.live.clocks.monotonic", itertools.count().__next__)
    live(folder)
    size = len((folder / "lines.jsonl").read_text())
    # All but the last lines, which are told with the end.
    assert 0.8 * size < sum(done) <= size
    assert len(done) > 15


@pytest.mark.parametrize("how", ["finished", "stopped", "ended by an error: see the terminal"])
def test_the_map_is_told_how_it_ended(folder: Path, how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("uvicorn")
    from kcal.pipeline.senders import LiveMap

    close, write, told, shown = LiveMap.close, Stream._write, [], []

    def ended(page: LiveMap, words: str) -> None:
        told.append(words)
        close(page, words)

    def disturbed(self: Stream, *what: object) -> None:
        write(self, *what)  # type: ignore[arg-type]
        if self.counts.moments == 7 and how == "stopped":
            os.kill(os.getpid(), signal.SIGTERM)
        if self.counts.moments == 7 and how.startswith("ended"):
            raise FileError("the disk is full")

    monkeypatch.setattr(LiveMap, "close", ended)
    monkeypatch.setattr(LiveMap, "show", lambda page, columns, sequence, time_s: shown.append(sequence))
    monkeypatch.setattr(Stream, "_write", disturbed)
    if how.startswith("ended"):
        with pytest.raises(FileError, match="disk is full"):
            live(folder, "--port", "0")
    else:
        live(folder, "--port", "0")
    assert told == [how]
    assert shown == list(range(1, 21 if how == "finished" else 8))


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        (["-o", "positions.kml"], InputError, "output of a stream"),
        (["--to", "http://host"], InputError, "udp://HOST:PORT"),
        (["--start", "noon"], InputError, "2026-05-01T12:00:00Z"),
        (["--start", "2026-05-01T12:00:00"], InputError, "has no zone: end it with Z"),
        (["--clock-offset", "nan"], InputError, "clock"),
        (["--box-sigma", "0"], InputError, "box_sigma"),
        (["--detections", "nowhere.jsonl"], FileError, "cannot read"),
    ],
)
def test_what_is_wrong(
    folder: Path, options: list[str], error: type[Exception], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    with pytest.raises(error, match=message):
        live(folder, *options)


def test_wrong_times_are_told(folder: Path) -> None:
    """One moment a day ahead and one in milliseconds leave all others as they are; a clock that is set is said."""
    stamped = [json.loads(line) for line in (folder / "lines.jsonl").read_text().splitlines()[:20]]
    texts = [json.dumps(line) for line in stamped]
    texts[10:10] = [json.dumps(stamped[10] | {"time": stamped[10]["time"] + 86400.0})]
    texts[5:5] = [json.dumps(stamped[5] | {"time": 1e13})]
    texts += [json.dumps(line | {"time": line["time"] + 3600.0}) for line in stamped]
    (folder / "lines.jsonl").write_text("\n".join(texts) + "\n")
    told = " ".join(live(folder, "--clock-sigma", "0.1").split())
    assert "40 moments, 68 positions; 1 moment left out, whose times the ones before and after contradict" in told
    assert "times jumped (1 x) and stayed: followed, with new tracks; the last jump was 3,598.1 s ahead" in told
    assert "last malformed line: time 1e+13: seconds are needed" in told


def test_clocks_that_count_from_other_days_are_told(folder: Path) -> None:
    """In place of "the parallax is below three sigma", and of intervals to infinity."""
    texts = (folder / "lines.jsonl").read_text().splitlines()[:20]
    lines = [json.loads(text) for text in texts]
    for line in lines[:10]:
        line["time"] = [line["time"], line["time"] + 3600.0]
    (folder / "lines.jsonl").write_text("\n".join(map(json.dumps, lines)) + "\n")
    told = " ".join(live(folder).split())
    assert "last malformed line: the cameras' times are 3600 s apart: do clocks count in one zone" in told
    assert "10 moments, " in told


def test_nothing_that_can_be_read_is_an_error(folder: Path) -> None:
    lines = [json.loads(line) for line in (folder / "lines.jsonl").read_text().splitlines()[:20]]
    texts = [json.dumps(line | {"time": 1e3 * line["time"]}) for line in lines]
    (folder / "lines.jsonl").write_text("\n".join(texts) + "\n")
    for _ in range(2):
        with pytest.raises(InputError, match=r"none of 20 lines could be read; the last one: time 1\.7e\+12: seconds"):
            live(folder)


def test_a_rig_that_does_not_say_where_it_stands(folder: Path) -> None:
    rig = tracked_site().rig
    rig.mounting = None
    save_rig(rig, folder / "rig.json")
    with pytest.raises(InputError, match="give origin and heading_deg"):
        live(folder)
    assert "20 moments" in live(folder, "--site", "19.07,72.87,14", "--heading", "35")


def test_what_compression_leaves_lasts_in_tracks() -> None:
    """Pairs that come matched keep the default; of what compression adds to matches, a third lasts."""
    assert TrackOptions.for_video(0.0) == TrackOptions()
    assert TrackOptions.for_video(0.06).lasting_px == pytest.approx((0.01**2 + 0.02**2) ** 0.5, rel=1e-12)


def test_stations_into_files(tmp_path: Path) -> None:
    """Three towers, one of which is blind for a while: one line names the cameras that have an image."""
    rig = ring(3, 6000.0)
    rig.root = rig.with_errors(position_m=0.3, attitude_deg=0.004)
    save_rig(rig, tmp_path / "towers.json")
    generator = torch.Generator().manual_seed(0)
    start = torch.tensor([[-400.0, 300.0, 200.0], [700.0, -500.0, 150.0]]).double()
    velocity = torch.tensor([[12.0, -5.0, 0.0], [0.0, 9.0, 0.0]]).double()
    with open(tmp_path / "lines.jsonl", "w", encoding="utf-8") as file:
        for second in range(16):
            pixels = marks(rig, start + second * velocity) + torch.randn(2, 3, 2, generator=generator).double()
            boxes = torch.cat([pixels - 5.5, pixels + 6.5], -1)  # of a detector that counts from the edge
            each = {name: {"time": 1.7e9 + second, "boxes": boxes[:, c].tolist()} for c, name in enumerate(rig.names)}
            if 6 <= second < 12:
                del each["tower 1"]
            file.write(json.dumps({"cameras": each}) + "\n")
        file.write('{"cameras": {"tower 9": {"time": 1700000099, "boxes": []}}}\n')
    command = ["live", str(tmp_path / "towers.json"), "--detections", str(tmp_path / "lines.jsonl")]
    outputs = ["-o", str(tmp_path / "tracks.csv"), "-o", str(tmp_path / "tracks.geojsonl"), "--clock-sigma", "0.1"]
    done = invoked(*command, *outputs)
    assert "with names of tower 1, tower 2, tower 3" in done
    assert "tower 3's images are" in done
    rows = rows_of(tmp_path / "tracks.csv")
    assert {row["name"] for row in rows} == {"track 1", "track 2"}
    assert {row["cameras"] for row in rows if row["sequence"] == "9"} == {"tower 2 tower 3"}
    assert {row["told_from"] for row in rows} == {"tower 1"}
    last = sorted((float(row["east_m"]), float(row["north_m"])) for row in rows if row["sequence"] == "16")
    for found, wanted in zip(last, sorted((start + 15.0 * velocity)[:, :2].tolist()), strict=True):
        assert found == pytest.approx(wanted, abs=15.0)
    # Azimuths count from the tower: the first one stands east of the target, at its own vertical.
    assert 180.0 < float(rows[-1]["azimuth_deg"]) < 360.0
    assert ran(*command, *outputs, "--heading", "3", "--site", "1,2,3").exit_code == 2


def test_placed_cameras_may_be_named_left_and_right(tmp_path: Path) -> None:
    """Each has its own pose with errors, which is not a pair in the left one's frame."""
    rig = ring(2, 6000.0)
    rig.names, rig.root = ("left", "right"), rig.with_errors(position_m=0.3, attitude_deg=0.004)
    save_rig(rig, tmp_path / "towers.json")
    pixels = marks(rig, torch.tensor([[300.0, 200.0, 150.0]]).double())
    boxes = torch.cat([pixels - 5.5, pixels + 6.5], -1)
    lines = [
        json.dumps(
            {"cameras": {n: {"time": 1.7e9 + s, "boxes": boxes[:, c].tolist()} for c, n in enumerate(rig.names)}}
        )
        for s in range(8)
    ]
    (tmp_path / "lines.jsonl").write_text("\n".join(lines), encoding="utf-8")
    command = ["live", str(tmp_path / "towers.json"), "--detections", str(tmp_path / "lines.jsonl")]
    invoked(*command, "-o", tmp_path / "tracks.csv")
    rows = rows_of(tmp_path / "tracks.csv")
    assert rows
    assert float(rows[-1]["east_m"]) == pytest.approx(300.0, abs=15.0)


@pytest.mark.slow
@pytest.mark.parametrize("sent", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_while_it_waits_for_a_line(sent: signal.Signals, tmp_path: Path) -> None:
    rig = planned_rig()
    rig.mounting = Mounting(origin=Origin(lat=10.0, lon=20.0, height=3.0), heading_deg=30.0)
    save_rig(rig, tmp_path / "rig.json")
    command = [sys.executable, "-m", "kcal", "live", "rig.json", "--detections", "-", "-o", "tracks.csv"]
    pipe = subprocess.PIPE
    live = subprocess.Popen(command, cwd=tmp_path, stdin=pipe, stdout=pipe, stderr=pipe)
    try:
        live.stdin.write(b'{"time": 1.0, "left": [[960, 540]], "right": [[944, 540]]}\n')
        live.stdin.flush()
        written = tmp_path / "tracks.csv"
        wait_for(lambda: written.exists() and written.stat().st_size > 0)
        live.send_signal(sent)
        # Its input stays open until it has ended.
        live.wait(PATIENCE)
        said = live.stderr.read().decode()
    finally:
        live.kill()
        live.communicate()
    assert "Fatal" not in said
    assert "Traceback" not in said
    assert live.returncode == 0
