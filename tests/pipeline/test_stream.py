"""Streams: the same bytes whether killed or not, malformed lines counted, nothing read or written twice."""

from __future__ import annotations

import csv
import datetime
import io
import json
import os
import random
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import orjson
import pytest
import torch
from ports import deaf_port
from track_scenes import seen_by, tracked_site
from waiting import PATIENCE

import kcal.pipeline.stream
from kcal.errors import FileError, InputError
from kcal.locate.positions import located_by
from kcal.locate.tabulate import Locator
from kcal.pipeline.association import AssociationOptions
from kcal.pipeline.grouping import Moment, read_moment
from kcal.pipeline.measurements import ClockPrior
from kcal.pipeline.senders import CotSender, sender_to
from kcal.pipeline.stream import Ledger, SourceItem, Stream, lines_of
from kcal.pipeline.tracks import Tracker
from scripts.shared.children import children

SITE = tracked_site(0.002)


def write_lines(path: Path, frames: int, count: int = 3) -> Path:
    generator = torch.Generator().manual_seed(0)
    start = torch.tensor([[-60.0, 5.0, 300.0], [20.0, -10.0, 500.0], [100.0, 0.0, 900.0]]).double()[:count]
    velocity = torch.tensor([[8.0, 0.0, 1.0], [-5.0, 1.0, 0.0], [0.0, 0.0, 3.0]]).double()[:count]
    lines = []
    for frame in range(frames):
        left, right = seen_by(SITE.rig, start + frame / 10.0 * velocity, 0.2, generator)
        if frame % 7 == 3:
            lines.append(b'{"time": "noon", "left": [], "right": []}')
        lines.append(
            orjson.dumps({"time": 1.7e9 + frame / 10, "left": left.tolist(), "right": right.tolist(), "sigma": 0.2})
        )
    path.write_bytes(b"\n".join(lines) + b"\n")
    return path


def read(line: bytes) -> Moment:
    return read_moment(line, SITE.rig, AssociationOptions(), 0.3)


def new_stream(folder: Path, **options: object) -> Stream:
    run = located_by(Locator(SITE.rig, origin=SITE.origin, heading_deg=0.0))
    tracker = Tracker(SITE, clock=ClockPrior(offset_sigma_s=0.02))
    outputs = [folder / "tracks.geojsonl", folder / "tracks.csv", folder / "tracks.cot"]
    return Stream(tracker, run, outputs, folder / "journal", **options)  # type: ignore[arg-type]


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("tracks.*"))}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, bytes]]:
    """Lines, and what one run without interruption makes of them."""
    folder = tmp_path_factory.mktemp("whole")
    lines = write_lines(folder / "lines.jsonl", 40)
    counts = new_stream(folder).follow(lines_of(lines, read), waits=True, resumes=True)
    assert (counts.moments, counts.malformed, counts.repeated, counts.dropped) == (40, 6, 0, 0)
    assert "time" in counts.last_error
    return lines, contents(folder)


def test_what_is_written(whole: tuple[Path, dict[str, bytes]]) -> None:
    rows = list(csv.DictReader(io.StringIO(whole[1]["tracks.csv"].decode())))
    assert len(rows) == 3 * 37  # told from the fourth sighting on
    assert [(row["sequence"], row["name"]) for row in rows[:4]] == [
        ("4", "track 1"), ("4", "track 2"), ("4", "track 3"), ("5", "track 1"),
    ]  # fmt: skip
    last = rows[-3]
    assert abs(float(last["velocity_east_mps"]) - 8.0) < 4 * float(last["velocity_east_sigma_mps"])
    assert float(last["range_low_m"]) < float(last["range_m"]) < float(last["range_high_m"])
    features = [orjson.loads(line) for line in whole[1]["tracks.geojsonl"].splitlines()]
    assert [feature["properties"]["kind"] for feature in features[:3]] == ["camera", "camera", "point"]
    assert len(features) == 2 + len(rows)
    assert features[-1]["properties"]["time_s"] == 1.7e9 + 3.9
    assert whole[1]["tracks.cot"].count(b"<event ") == len(rows)
    assert b'time="2023-11-14T22:13:23.900Z"' in whole[1]["tracks.cot"]


def test_a_second_run_adds_nothing_and_new_lines_are_continued(
    whole: tuple[Path, dict[str, bytes]], tmp_path: Path
) -> None:
    """In two halves, the second of which begins in the middle of a line that was still being written."""
    text = whole[0].read_bytes()
    lines = tmp_path / "lines.jsonl"
    for cut in (len(text) // 2, len(text), len(text)):
        lines.write_bytes(text[:cut])
        counts = new_stream(tmp_path).follow(lines_of(lines, read), waits=True, resumes=True)
    assert counts.moments == counts.repeated == counts.malformed == 0
    assert contents(tmp_path) == whole[1]


def kill_after(lines: int) -> None:
    """Kill this process after so many lines of the stream and of its journal."""
    left = lines

    def count(frame: FrameType, event: str, argument: object) -> Any:
        nonlocal left
        if Path(frame.f_code.co_filename).name != "stream.py":
            return None
        left -= event == "line"
        if not left:
            os.kill(os.getpid(), signal.SIGKILL)
        return count

    sys.settrace(count)


def follow_until(lines: int, source: Path, folder: Path) -> None:
    """Follow a stream with few moments in a checkpoint, and be killed after so many lines of code; 0 for never."""
    kcal.pipeline.stream._CHECKPOINT = 9
    if lines:
        kill_after(lines)
    new_stream(folder).follow(lines_of(source, read), waits=True, resumes=True)


@pytest.mark.skipif(sys.platform == "win32", reason="kills a process")
def test_killed_at_any_time_the_outputs_are_the_same(whole: tuple[Path, dict[str, bytes]], tmp_path: Path) -> None:
    """At any line of what writes: six times early, so that there is always more to do, and then not any more."""
    chance = random.Random(1)
    for lines in [*(chance.randrange(50, 2000) for _ in range(6)), 0]:
        child = children().Process(target=follow_until, args=(lines, whole[0], tmp_path))
        child.start()
        child.join()
        assert child.exitcode == (-signal.SIGKILL if lines else 0)
    assert contents(tmp_path) == whole[1]


def test_half_a_moment_is_cut_off(whole: tuple[Path, dict[str, bytes]], tmp_path: Path) -> None:
    """What a crash left in one output, before it was in the journal, and half a line in the journal itself."""
    stream = new_stream(tmp_path)
    stream.shown = lambda columns, tracks: stream.stop() if tracks.time > 1.7e9 + 2.05 else None
    stream.follow(lines_of(whole[0], read), waits=True, resumes=True)
    with open(tmp_path / "tracks.csv", "ab") as file:
        file.write(b"track 1,ok,,19.07" + 100_000 * b"0")
    with open(tmp_path / "journal", "ab") as file:
        file.write(b"[22,1700000002.1,45")
    assert new_stream(tmp_path).follow(lines_of(whole[0], read), waits=True, resumes=True).moments == 40 - 22
    assert contents(tmp_path) == whole[1]


def test_a_source_that_does_not_resume_skips_what_was_written(
    whole: tuple[Path, dict[str, bytes]], tmp_path: Path
) -> None:
    """A pipe whose writer begins somewhat earlier again."""
    lines = whole[0].read_bytes().splitlines(keepends=True)

    def pipe(first: int, last: int):
        return lambda _: (SourceItem(read(line), 0) for line in lines[first:last] if b"noon" not in line)

    new_stream(tmp_path).follow(pipe(0, 20), waits=True, resumes=False)
    counts = new_stream(tmp_path).follow(pipe(14, 46), waits=True, resumes=False)
    assert counts.repeated == 5
    assert contents(tmp_path) == whole[1]


def test_a_camera_that_does_not_wait_drops_the_oldest(whole: tuple[Path, dict[str, bytes]], tmp_path: Path) -> None:
    moments = [read(line) for line in whole[0].read_bytes().splitlines() if b"noon" not in line]
    release = threading.Event()

    def camera(_: int) -> Iterator[SourceItem]:
        # More than can wait, before the first is dealt with.
        for number in range(200):
            yield SourceItem(moments[0]._replace(time=1.7e9 + number), 0)
        release.set()

    stream = new_stream(tmp_path)
    stream.tracker = _Slow(stream.tracker, release)  # type: ignore[assignment]
    counts = stream.follow(camera, waits=False, resumes=False)
    assert counts.dropped > 100
    assert counts.moments + counts.dropped == 200


class _Slow:
    """A tracker whose first moment takes until all others have come."""

    def __init__(self, tracker: Tracker, release: threading.Event) -> None:
        self.__dict__.update(tracker=tracker, release=release)

    def __call__(self, *args: object) -> object:
        self.release.wait()
        return self.tracker(*args)

    def __getattr__(self, name: str) -> object:
        return getattr(self.tracker, name)


def test_a_journal_of_something_else(whole: tuple[Path, dict[str, bytes]], tmp_path: Path) -> None:
    new_stream(tmp_path).follow(lines_of(whole[0], read), waits=True, resumes=True)
    run = located_by(Locator(SITE.rig, origin=SITE.origin, heading_deg=0.0))
    outputs = [tmp_path / "tracks.geojsonl", tmp_path / "tracks.csv", tmp_path / "tracks.cot"]
    with pytest.raises(FileError, match="other outputs"):
        Stream(Tracker(SITE), run, outputs[:1], tmp_path / "journal")
    with pytest.raises(FileError, match="another rig or other options"):
        Stream(Tracker(SITE), run, outputs, tmp_path / "journal")
    outputs[1].write_bytes(b"lost")
    with pytest.raises(FileError, match="4 bytes, but the journal"):
        new_stream(tmp_path)
    (tmp_path / "journal").write_bytes(b"{}\n")
    with pytest.raises(FileError, match="damaged"):
        new_stream(tmp_path)


@pytest.mark.parametrize(
    "place",
    [[1, 1.5, 10, [-3]], [1, 1.5, 10, [3.5]], [1, 1.5, 10, [None]], [1, "1", 10, [3]], [True, 1.5, 10, [3]],
     [1, 1.5, -1, [3]], [1, 1.5, 10, [3, 3]], [1, 1.5, 10]],
)  # fmt: skip
def test_a_journal_of_damaged_places(place: list[object], tmp_path: Path) -> None:
    output, journal = tmp_path / "out.csv", tmp_path / "journal"
    ledger = Ledger(journal, [output])
    ledger.checkpoint({})
    ledger.append([b"abc"], 1.5, 10)
    ledger.close()
    whole = journal.read_bytes()
    journal.write_bytes(whole.replace(b"[1,1.5,10,[3]]", json.dumps(place).encode()))
    with pytest.raises(FileError, match=r"journal: the journal is damaged"):
        Ledger(journal, [output])
    assert output.read_bytes() == b"abc"
    journal.write_bytes(whole)
    Ledger(journal, [output]).close()


def test_a_shorter_input(whole: tuple[Path, dict[str, bytes]], tmp_path: Path) -> None:
    new_stream(tmp_path).follow(lines_of(whole[0], read), waits=True, resumes=True)
    other = tmp_path / "other.jsonl"
    other.write_bytes(b"{}\n")
    with pytest.raises(FileError, match="shorter than the journal says"):
        new_stream(tmp_path).follow(lines_of(other, read), waits=True, resumes=True)


def test_a_source_that_fails_ends_the_stream(whole: tuple[Path, dict[str, bytes]], tmp_path: Path) -> None:
    moment = read(whole[0].read_bytes().splitlines()[0])

    def broken(_: int) -> Iterator[SourceItem]:
        yield SourceItem(moment, 1)
        raise RuntimeError("the detector has a bug")

    with pytest.raises(RuntimeError, match="has a bug"):
        new_stream(tmp_path).follow(broken, waits=True, resumes=False)
    assert orjson.loads((tmp_path / "journal").read_bytes())["place"][0] == 1


def test_events_need_calendar_times(tmp_path: Path) -> None:
    lines = tmp_path / "lines.jsonl"
    lines.write_bytes(b'{"time": 3.0, "left": [], "right": []}\n')
    with pytest.raises(InputError, match="not in Unix seconds"):
        new_stream(tmp_path).follow(lines_of(lines, read), waits=True, resumes=True)
    start = datetime.datetime(2026, 5, 1, tzinfo=datetime.UTC)
    assert new_stream(tmp_path, start=start).follow(lines_of(lines, read), waits=True, resumes=True).moments == 1


def test_a_line_that_never_ends_is_malformed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kcal.pipeline.stream._LONGEST", 100)
    path = tmp_path / "lines.jsonl"
    path.write_bytes(b"x" * 1000 + b'\n{"time": 3.0, "left": [], "right": []}\n')
    items = list(lines_of(path, read)(0))
    assert [type(item.moment) for item in items] == [InputError, Moment]
    assert items[1].offset == path.stat().st_size


@pytest.mark.parametrize("kind", ["udp", "tcp"])
def test_events_over_the_network(whole: tuple[Path, dict[str, bytes]], tmp_path: Path, kind: str) -> None:
    with socket.socket(type=socket.SOCK_STREAM if kind == "tcp" else socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(PATIENCE)
        if kind == "tcp":
            receiver.listen()
        port = receiver.getsockname()[1]
        stream = new_stream(tmp_path, senders=[CotSender(f"{kind}://127.0.0.1:{port}")])
        stream.shown = lambda columns, tracks: stream.stop() if tracks.number else None
        assert stream.follow(lines_of(whole[0], read), waits=True, resumes=True).unsent == 0
        if kind == "tcp":
            link = receiver.accept()[0]
            got = b"".join(iter(lambda: link.recv(4096), b""))
            link.close()
        else:
            got = b"".join(receiver.recv(4096) for _ in range(3))
    assert got.count(b"<event ") == got.count(b"</event>") == 3
    assert b'stale="2023-11-14T22:13:30.300Z"' in got


def test_a_receiver_that_is_not_there_is_counted(whole: tuple[Path, dict[str, bytes]], tmp_path: Path) -> None:
    with deaf_port() as port:
        stream = new_stream(tmp_path, senders=[CotSender(f"tcp://127.0.0.1:{port}")])
        counts = stream.follow(lines_of(whole[0], read), waits=True, resumes=True)
    assert counts.unsent == 37
    assert contents(tmp_path) == whole[1]


@pytest.mark.parametrize(
    "wrong", ["http://host:1", "udp://host", "tcp://host:x", "udp://user:secret@:1", "mqtt://host"]
)
def test_impossible_addresses(wrong: str) -> None:
    with pytest.raises(InputError, match="write ") as caught:
        sender_to(wrong)
    assert "secret" not in str(caught.value)


def test_outputs_that_cannot_grow(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="output of a stream"):
        Stream(Tracker(SITE), located_by(Locator(SITE.rig, origin=SITE.origin, heading_deg=0.0)), [tmp_path / "a.kml"],
               tmp_path / "journal")  # fmt: skip
