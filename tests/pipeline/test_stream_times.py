"""Times that are wrong, clocks that are set, and two streams that write one file."""

from __future__ import annotations

import csv
import io
import math
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import orjson
import pytest
import torch
from track_scenes import seen_by, tracked_site

from kcal.errors import FileError, InputError
from kcal.locate.positions import located_by
from kcal.locate.tabulate import Locator
from kcal.pipeline.association import AssociationOptions
from kcal.pipeline.grouping import Moment, read_moment
from kcal.pipeline.stream import MomentOrder, SourceItem, Stream, StreamCounts, lines_of
from kcal.pipeline.tracks import Tracker

SITE = tracked_site(0.002)
DAY = 86_400.0


def line_at(seen_s: float, stamp: float) -> bytes:
    place = torch.tensor([[-60.0, 5.0, 300.0], [20.0, -10.0, 500.0]]).double()
    left, right = seen_by(SITE.rig, place + seen_s * torch.tensor([8.0, 0.0, 1.0]), 0.0, torch.Generator())
    return orjson.dumps({"time": stamp, "left": left.tolist(), "right": right.tolist(), "sigma": 0.2}) + b"\n"


def read(line: bytes) -> Moment:
    return read_moment(line, SITE.rig, AssociationOptions(), 0.3)


def new_stream(folder: Path) -> Stream:
    run = located_by(Locator(SITE.rig, origin=SITE.origin, heading_deg=0.0))
    return Stream(Tracker(SITE), run, [folder / "tracks.csv"], folder / "journal")


def follow(folder: Path, stamps: list[float], name: str = "lines.jsonl") -> StreamCounts:
    lines = folder / name
    lines.write_bytes(b"".join(line_at(0.1 * k, stamp) for k, stamp in enumerate(stamps)))
    return new_stream(folder).follow(lines_of(lines, read), waits=True, resumes=True)


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
        stream = new_stream(tmp_path)
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
    counts = new_stream(tmp_path).follow(
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
                Stream(
                    Tracker(SITE), located_by(Locator(SITE.rig, origin=SITE.origin, heading_deg=0.0)),
                    [tmp_path / "tracks.csv"], tmp_path / journal,
                )  # fmt: skip
        with pytest.raises(FileError, match=r"journal: kcal live, process"):
            Stream(
                Tracker(SITE), located_by(Locator(SITE.rig, origin=SITE.origin, heading_deg=0.0)),
                [tmp_path / "other.csv"], tmp_path / "journal",
            )  # fmt: skip
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
    odd = [
        "1e308",
        "1e-308",
        "-1",
        str(2**64),
        "9" * 400,
        "null",
        "true",
        '"x"',
        "[]",
        "{}",
        "[[1]]",
        "NaN",
        "[" * 3000,
    ]
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
