"""Streams: the same bytes whether killed or not, and times that are wrong."""

import csv
import datetime
import io
import json
import math
import os
import random
import signal
import socket
import subprocess
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
from track_scenes import run_of, seen_by, tracked_site
from waiting import PATIENCE

import kcal.pipeline.stream
from kcal import FileError, InputError
from kcal.pipeline.grouping import Moment, read_moment
from kcal.pipeline.senders import CotSender, sender_to
from kcal.pipeline.stream import Ledger, MomentOrder, SourceItem, Stream, StreamCounts, lines_of
from kcal.track import AssociationOptions, ClockPrior, Tracker
from scripts.shared.children import children

# Streams: the same bytes whether killed or not, malformed lines counted, nothing read or written twice.


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
    tracker = Tracker(SITE, clock=ClockPrior(offset_sigma_s=0.02))
    outputs = [folder / "tracks.geojsonl", folder / "tracks.csv", folder / "tracks.cot"]
    return Stream(tracker, run_of(SITE), outputs, folder / "journal", **options)  # type: ignore[arg-type]


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
    moments = 0
    # The last line is whole without its end, which may still come.
    for cut in (len(text) // 2, len(text) - 1, len(text)):
        lines.write_bytes(text[:cut])
        counts = new_stream(tmp_path).follow(lines_of(lines, read), waits=True, resumes=True)
        moments += counts.moments
    assert (moments, counts.moments, counts.repeated, counts.malformed) == (40, 0, 0, 0)
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
    assert new_stream(tmp_path).follow(pipe(14, 46), waits=True, resumes=False).repeated == 5
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
    other = tmp_path / "other.jsonl"
    other.write_bytes(b"{}\n")
    with pytest.raises(FileError, match="shorter than the journal says"):
        new_stream(tmp_path).follow(lines_of(other, read), waits=True, resumes=True)
    run, outputs = run_of(SITE), [tmp_path / "tracks.geojsonl", tmp_path / "tracks.csv", tmp_path / "tracks.cot"]
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
    "wrong",
    [
        "http://host:1",
        "udp://host",
        "tcp://host:x",
        "udp://user:secret@:1",
        "udp://[::1:5",
        "mqtt://host",
        "mqtt://host:99999/x",
    ],
)
def test_impossible_addresses(wrong: str) -> None:
    with pytest.raises(InputError, match="write ") as caught:
        sender_to(wrong)
    assert "secret" not in str(caught.value)


def test_outputs_that_cannot_grow(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="output of a stream"):
        Stream(Tracker(SITE), run_of(SITE), [tmp_path / "a.kml"], tmp_path / "journal")


# Times that are wrong, clocks that are set, and two streams that write one file.


DAY = 86_400.0


def line_at(seen_s: float, stamp: float) -> bytes:
    place = torch.tensor([[-60.0, 5.0, 300.0], [20.0, -10.0, 500.0]]).double()
    left, right = seen_by(SITE.rig, place + seen_s * torch.tensor([8.0, 0.0, 1.0]), 0.0, torch.Generator())
    return orjson.dumps({"time": stamp, "left": left.tolist(), "right": right.tolist(), "sigma": 0.2}) + b"\n"


def new_timed_stream(folder: Path) -> Stream:
    return Stream(Tracker(SITE), run_of(SITE), [folder / "tracks.csv"], folder / "journal")


def follow(folder: Path, stamps: list[float], name: str = "lines.jsonl") -> StreamCounts:
    lines = folder / name
    lines.write_bytes(b"".join(line_at(0.1 * k, stamp) for k, stamp in enumerate(stamps)))
    return new_timed_stream(folder).follow(lines_of(lines, read), waits=True, resumes=True)


def times(folder: Path) -> list[float]:
    rows = csv.DictReader(io.StringIO((folder / "tracks.csv").read_text()))
    return sorted({float(row["time_s"]) for row in rows})


STEADY = [1.7e9 + 0.1 * k for k in range(20)]


@pytest.mark.parametrize("wrong", [STEADY[9] + DAY, STEADY[9] - DAY, 1e9])
def test_a_time_that_its_neighbors_contradict_is_left_out(tmp_path: Path, wrong: float) -> None:
    counts = follow(tmp_path, [*STEADY[:10], wrong, *STEADY[10:]])
    assert (counts.moments, counts.contradicted, counts.jumps, counts.repeated) == (20, 1, 0, 0)
    assert times(tmp_path) == STEADY[3:]


@pytest.mark.parametrize("jump", [DAY, -DAY, 3600.0, -20.0])
def test_a_clock_that_was_set_is_followed(tmp_path: Path, jump: float) -> None:
    stamps = [*STEADY[:10], *(stamp + jump for stamp in STEADY[10:])]
    counts = follow(tmp_path, stamps)
    assert (counts.moments, counts.contradicted, counts.jumps) == (20, 0, 1)
    assert counts.last_jump_s == pytest.approx(jump + 0.1, abs=1e-6)
    # Tracks are told of again from the fourth sighting on, under new numbers.
    assert times(tmp_path) == sorted([*stamps[3:10], *stamps[13:]])
    names = [row["name"] for row in csv.DictReader(io.StringIO((tmp_path / "tracks.csv").read_text()))]
    assert set(names) == {"track 1", "track 2", "track 3", "track 4"}


@pytest.mark.parametrize("unit", [1e3, 1e6, 1e9])
def test_times_in_smaller_units_are_malformed_lines(tmp_path: Path, unit: float) -> None:
    """All of them, or one among others, at each start anew."""
    counts = follow(tmp_path, [stamp * unit for stamp in STEADY[:5]])
    assert (counts.moments, counts.malformed) == (0, 5)
    assert "seconds are needed" in counts.last_error
    counts = follow(tmp_path, [*STEADY[:5], 1e13, *STEADY[5:]], "others.jsonl")
    assert (counts.moments, counts.malformed) == (20, 1)


def test_the_last_moment_waits_for_the_next_run(tmp_path: Path) -> None:
    """Stamped a day ahead, as the last line so far: nothing tells whether the clock was set."""
    assert follow(tmp_path, [*STEADY[:10], STEADY[9] + DAY]).waiting == 1
    counts = follow(tmp_path, [*STEADY[:10], STEADY[9] + DAY, *STEADY[10:]])
    assert (counts.moments, counts.contradicted, counts.waiting) == (10, 1, 0)
    assert times(tmp_path) == STEADY[3:]


def test_interrupted_anywhere_the_same_moments_are_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One run, and one for each moment, with wrong times, a gap and a clock that is set."""
    monkeypatch.setattr("kcal.pipeline.stream._CHECKPOINT", 7)
    stamps = [*STEADY[:6], 5e9, *STEADY[6:9], *(s + 40.0 for s in STEADY[9:12]), *(s - DAY for s in STEADY[12:])]
    (tmp_path / "whole").mkdir()
    whole = follow(tmp_path / "whole", stamps)
    assert (whole.moments, whole.contradicted, whole.jumps) == (len(stamps) - 1, 1, 2)
    lines = tmp_path / "whole" / "lines.jsonl"
    kept = b""
    for _ in range(len(stamps)):
        stream = new_timed_stream(tmp_path)
        # As a kill does: what the checkpoint at the end of the last run said is forgotten.
        stream.shown = lambda columns, tracks, stream=stream: stream.stop()
        before = (tmp_path / "journal").read_bytes() if kept else b""
        stream.follow(lines_of(lines, read), waits=True, resumes=True)
        kept = (tmp_path / "tracks.csv").read_bytes()
        if before and len(before.splitlines()) < 7:
            place = orjson.loads((tmp_path / "journal").read_bytes().splitlines()[0])["place"]
            (tmp_path / "journal").write_bytes(before + orjson.dumps(place) + b"\n")
    assert kept == (tmp_path / "whole" / "tracks.csv").read_bytes()


def test_a_source_that_cannot_resume_follows_a_clock_that_was_set_meanwhile(tmp_path: Path) -> None:
    follow(tmp_path, STEADY)
    back = [read(line_at(0.1 * k, stamp - DAY)) for k, stamp in enumerate(STEADY)]
    counts = new_timed_stream(tmp_path).follow(
        lambda _: (SourceItem(moment, 0) for moment in back), waits=False, resumes=False
    )
    assert (counts.moments, counts.jumps) == (20, 1)


def test_sparse_and_slow_times_are_taken_as_they_come() -> None:
    """Whatever the gaps: times that only rise are all taken, and a steady slow step waits for nothing."""
    order = MomentOrder[int]()
    stamps = [0.0, 60.0, 120.0, 180.0, 240.0, 300.0]
    taken = [order.put(k, stamp).moments for k, stamp in enumerate(stamps)]
    assert taken == [[0], [], [], [1, 2, 3], [4], [5]]
    order = MomentOrder[int]()
    stamps = [0.0, 0.1, 7.0, 7.1, 900.0, 905.0, 2000.0, 2000.1, 2000.2]
    released = [order.put(k, stamp) for k, stamp in enumerate(stamps)] + [order.end()]
    assert [k for part in released for k in part.moments] == list(range(9))
    assert sum(part.contradicted for part in released) == order.waiting == 0
    order = MomentOrder[int](time=10.0)
    order.put(0, 12.0)
    assert order.end().moments == [0]
    assert MomentOrder[int]().put(0, 5.0).moments == [0]
    assert MomentOrder[int](time=10.0, until=10.0).put(0, -math.inf).repeated


SECOND = """
import sys
from pathlib import Path
from kcal.pipeline.stream import Ledger
ledger = Ledger(Path(sys.argv[2]), [Path(sys.argv[1])])
ledger.checkpoint({})
ledger.append([b"row\\n"], 1.0, 5)
print("ready", flush=True)
sys.stdin.read()
"""


@pytest.mark.slow
def test_one_process_at_a_time_writes_an_output(tmp_path: Path) -> None:
    """The second one is refused and told who has it; after a kill, the next one goes on."""
    (tmp_path / "link.csv").symlink_to(tmp_path / "tracks.csv")
    child = subprocess.Popen(
        [sys.executable, "-c", SECOND, str(tmp_path / "link.csv"), str(tmp_path / "journal")],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    try:
        assert child.stdout is not None
        assert child.stdout.readline() == b"ready\n"
        for journal in ("journal", "other"):
            with pytest.raises(FileError, match=rf"tracks\.csv: kcal live, process {child.pid}, since 20.* writes it"):
                Stream(Tracker(SITE), run_of(SITE), [tmp_path / "tracks.csv"], tmp_path / journal)
        with pytest.raises(FileError, match=r"journal: kcal live, process"):
            Stream(Tracker(SITE), run_of(SITE), [tmp_path / "other.csv"], tmp_path / "journal")
        assert (tmp_path / "tracks.csv").read_bytes() == b"row\n"
    finally:
        child.send_signal(signal.SIGKILL)
        child.wait()
    (tmp_path / "journal").unlink()
    assert follow(tmp_path, STEADY).moments == 20
    assert not list(tmp_path.glob(".*.lock"))


def test_a_line_with_anything_is_a_moment_or_an_input_error() -> None:
    """Any value of two good lines replaced by something else: what is read goes through the tracker, too."""
    good = [
        {"time": 3.5, "left": [[960, 540]], "right": [[944, 540]], "sigma": 0.3, "scores": [0.5], "categories": ["a"]},
        {side: {"time": 3.5, "boxes": [[900, 500, 920, 520]], "scores": [0.5], "categories": ["a"]}
         for side in ("left", "right")},
    ]  # fmt: skip
    odd = f'1e308 1e-308 -1 {2**64} {"9" * 400} null true "x" [] {{}} [[1]] NaN {"[" * 3000}'.split()
    tracker, counts = Tracker(SITE), {True: 0, False: 0}
    for line in good:
        for path in _paths(line):
            for text in odd:
                changed = orjson.loads(orjson.dumps(line))
                holder = changed
                for key in path[:-1]:
                    holder = holder[key]
                holder[path[-1]] = "@"
                try:
                    moment = read(orjson.dumps(changed).replace(b'"@"', text.encode()))
                except InputError:
                    counts[False] += 1
                    continue
                counts[True] += 1
                if abs(moment.time) < 1e11:
                    tracker.set_clock(moment.time)
                    tracker(moment.pairs, moment.time)
    assert min(counts.values()) > 20


def _paths(value: Any) -> list[list[Any]]:
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path for key, inside in pairs for path in ([key], *([key, *more] for more in _paths(inside)))]
