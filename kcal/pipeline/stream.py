"""The stream, in bounded memory and with its journal: lines or frames in, tracks out, time step by time step."""

from __future__ import annotations

import base64
import dataclasses
import datetime
import hashlib
import math
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Generic, NamedTuple, TypeVar

import numpy as np
import orjson
import torch
from torch import Tensor

from kcal.errors import FileError, InputError
from kcal.files import FileLock, read_bytes, write_atomic
from kcal.lens.rig import Rig
from kcal.locate.export import APPENDED, appended
from kcal.locate.points import camera_list, own_axes
from kcal.locate.positions import Located
from kcal.locate.stereo import Localization, PositionStatus
from kcal.locate.tables import PositionColumns
from kcal.locate.tabulate import number_table
from kcal.pipeline.estimates import TrackStates
from kcal.pipeline.grouping import Moment
from kcal.pipeline.imm_filter import Beliefs
from kcal.pipeline.senders import Sender, calendar_time
from kcal.pipeline.tracks import Tracker, TrackRecord, Tracks
from kcal.threads import Handover

# The journal of a stream: which time steps are in the outputs, so that a restart neither loses nor doubles any.
#
# The first line is a checkpoint with the state of the tracker. Each further line is a time step whose positions are in
# the outputs. A time step is written to the outputs first, then to the journal. What a crash left of one that is
# not in the journal is cut off the outputs at the next start, and the time step is done again.


class StreamPlace(NamedTuple):
    """How far a stream has come.

    Attributes:
        sequence: how many time steps are in the outputs.
        time: seconds of the last one; None before the first.
        offset: bytes of the input that were read.
        sizes: bytes of each output.
    """

    sequence: int
    time: float | None
    offset: int
    sizes: tuple[int, ...]


class Ledger:
    """Outputs that are appended to, and their journal.

    Args:
        path: of the journal; made if it is missing.
        outputs: files; they are made, or cut to what the journal says.
        work: the command that writes them.

    Raises:
        FileError: a file that another process writes or that cannot be opened, a damaged journal, one of other outputs,
            or an output that has lost what the journal says it has.
    """

    def __init__(self, path: Path, outputs: Sequence[Path], work: str = "live") -> None:
        self._head = {"kcal": f"{work} journal", "version": 1}
        self.path, self.outputs = path, tuple(outputs)
        self.state: dict[str, Any] | None = None
        self.checkpoint_at = self.place = StreamPlace(0, None, 0, (0,) * len(self.outputs))
        self._files: list[BinaryIO] = []
        self._log: BinaryIO | None = None
        self._lock = FileLock((*self.outputs, path), f"kcal {work}")
        try:
            if path.exists():
                self._read()
            for file, size in zip(self.outputs, self.place.sizes, strict=True):
                self._files.append(self._opened(file, size))
        except BaseException:
            self.close()
            raise

    def append(self, parts: Sequence[bytes], time: float, offset: int) -> None:
        """Write a time step's bytes to the outputs, and then to the journal."""
        if self._log is None:
            raise FileError(f"{self.path}: no checkpoint was written yet")
        for file, part in zip(self._files, parts, strict=True):
            file.write(part)
            file.flush()
        sizes = tuple(size + len(part) for size, part in zip(self.place.sizes, parts, strict=True))
        self.place = StreamPlace(self.place.sequence + 1, time, offset, sizes)
        self._log.write(orjson.dumps(list(self.place)) + b"\n")
        self._log.flush()

    def checkpoint(self, state: dict[str, Any]) -> None:
        """Begin the journal again with the state after the last time step."""
        for file in self._files:
            os.fsync(file.fileno())
        names = [str(path.resolve()) for path in self.outputs]
        head = {**self._head, "outputs": names, "place": list(self.place), "state": state}
        if self._log is not None:
            self._log.close()
        write_atomic(self.path, orjson.dumps(head) + b"\n")
        self._log = open(self.path, "ab")  # noqa: SIM115
        self.state, self.checkpoint_at = state, self.place

    def close(self) -> None:
        """Close all files, and let other processes write them."""
        for file in (*self._files, *([self._log] if self._log else [])):
            file.close()
        self._lock.release()

    def _read(self) -> None:
        lines = read_bytes(self.path).split(b"\n")[:-1]  # what is cut off was not complete
        try:
            head = orjson.loads(lines[0])
            if {name: head[name] for name in self._head} != self._head:
                kind = str(self._head["kcal"]).split()[0]
                raise FileError(f"{self.path}: not a journal of this version of `kcal {kind}`")
            if head["outputs"] != [str(path.resolve()) for path in self.outputs]:
                raise FileError(f"{self.path}: a journal of other outputs, {head['outputs']}; delete it to begin anew")
            stored = [head["place"], *map(orjson.loads, lines[1:])]
            places = [_stored_place(values, len(self.outputs)) for values in stored]
            self.state = head["state"]
            if not isinstance(self.state, dict):
                raise TypeError("no state")
        except (ValueError, KeyError, TypeError, IndexError) as error:
            raise FileError(f"{self.path}: the journal is damaged ({error}); delete it to begin anew") from error
        self.checkpoint_at, self.place = places[0], places[-1]

    def _opened(self, path: Path, size: int) -> BinaryIO:
        try:
            file = open(path, "r+b" if size else "wb")  # noqa: SIM115
            there = file.seek(0, os.SEEK_END)
            if there < size:
                raise FileError(f"{path}: {there} bytes, but the journal {self.path} says {size}; delete both")
            file.truncate(size)
            file.seek(size)
        except OSError as error:
            raise FileError(f"{path}: cannot write: {error.strerror or error}") from error
        return file


def _stored_place(values: Any, outputs: int) -> StreamPlace:
    """A place as it was stored.

    Raises:
        TypeError: not that of so many outputs.
    """
    sequence, time, offset, sizes = values
    counts = [sequence, offset, *sizes]
    if len(sizes) != outputs or any(type(count) is not int or not 0 <= count < 2**63 for count in counts):
        raise TypeError("a place does not fit its outputs")
    if time is not None and (type(time) not in (int, float) or not math.isfinite(time)):
        raise TypeError("a place has no time")
    return StreamPlace(sequence, time, offset, tuple(sizes))


# The stream: lines or frames in, tracks out, time step by time step, in bounded memory, and stopped at any time.

# Times of a stream in their order: one that its neighbors contradict is left out, a clock that was set is followed.

# Seconds: a step ahead beyond it, and beyond ten times the last step, waits until later times bear it out.
_AHEAD_S, _STEPS = 1.0, 10.0
# Seconds: times that go back by less are of earlier time steps, repeated or out of order; less ahead is a gap.
_BACK_S = 15.0
# Time steps in their order that make a jump true.
_RUN = 3
# Seconds, the year 5138: a larger number is no time in seconds.
MOST_SECONDS = 1e11
T = TypeVar("T")


class Released(NamedTuple, Generic[T]):
    """What is to be done after one more time step.

    Attributes:
        moments: to be taken in now, in the order in which they came.
        jump_s: by how many seconds the clock was set before the first of them; 0 if it was not, or by a short gap.
        contradicted: how many that waited are left out.
        repeated: whether this time step is left out, because its time is not after the last one.
    """

    moments: list[T]
    jump_s: float = 0.0
    contradicted: int = 0
    repeated: bool = False


class MomentOrder(Generic[T]):
    """Decide time step by time step which are taken in.

    A time that jumps, ahead or back, waits. If the next ones go on from where the clock was, it is left out. If they go
    on from it, the clock was set (or nothing was seen for a while), and they are taken in.

    Args:
        time: seconds of the last time step; -inf before the first.
        step: seconds between the last two.
        until: times up to this one are repeated, until one is later: a source that begins somewhat earlier again.

    Example:
        >>> order = MomentOrder[str]()
        >>> [order.put(name, time).moments for name, time in (("a", 1.0), ("b", 1.1), ("wrong", 9e4), ("c", 1.2))]
        [['a'], ['b'], [], ['c']]
        >>> [order.put(name, time).moments for name, time in (("d", 9e4), ("e", 90000.1), ("f", 90000.2))]
        [[], [], ['d', 'e', 'f']]
    """

    def __init__(self, time: float = -math.inf, step: float = 0.0, until: float = -math.inf) -> None:
        self.time, self.step, self.until = max(time, until), step, until
        self._waiting: list[tuple[T, float]] = []

    @property
    def waiting(self) -> int:
        """Time steps whose times nothing has borne out yet."""
        return len(self._waiting)

    def put(self, moment: T, time: float) -> Released[T]:
        """Take one more time step."""
        ahead = time - self.time
        if 0.0 < ahead <= max(_AHEAD_S, _STEPS * self.step) or self.time == -math.inf:
            return self._release([(moment, time)], contradicted=len(self._waiting))
        if -_BACK_S <= ahead <= 0.0 or time <= self.until:
            return Released([], repeated=True)
        contradicted = 0
        if self._waiting and time <= self._waiting[-1][1]:
            contradicted, self._waiting = len(self._waiting), []
        self._waiting.append((moment, time))
        if len(self._waiting) < _RUN:
            return Released([], contradicted=contradicted)
        jump = self._waiting[0][1] - self.time
        return self._release(self._waiting, 0.0 if 0.0 < jump <= _BACK_S else jump)

    def end(self) -> Released[T]:
        """The source has ended: a short gap before what waits needs no proof; what jumped waits for the next run."""
        if self._waiting and 0.0 < self._waiting[0][1] - self.time <= _BACK_S:
            return self._release(self._waiting)
        return Released([])

    def _release(self, run: list[tuple[T, float]], jump: float = 0.0, contradicted: int = 0) -> Released[T]:
        before = run[-2][1] if len(run) > 1 else self.time
        self.time, self._waiting, self.until = run[-1][1], [], -math.inf
        self.step = self.time - before if math.isfinite(before) else 0.0
        return Released([moment for moment, _ in run], jump, contradicted)


# A tracker's whole state as JSON, to the last bit, and back: an interrupted stream goes on as if it was not.

# Of the tensors: a journal of another one is of no use.
_LAYOUT = "tracks last, of any cameras"
_SHARED = ("information", "score", "values", "root")


def settings_of(tracker: Tracker) -> str:
    """Hex digits that change with the rig, its errors and all options."""
    localize, shared = tracker.solved, tracker.shared
    parts = [_LAYOUT, localize.rig.fingerprint, repr(tracker.options), repr(shared.scale.tolist())]
    known = (localize.errors, localize.bending_errors)
    parts += ["none" if value is None else _packed(value)["data"] for value in known]
    parts += [] if tracker.moments is None else ["watched"]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def snapshot(tracker: Tracker) -> dict[str, Any]:
    """Everything that the next call depends on; a recorded history is left out."""
    return {
        "settings": settings_of(tracker),
        "time": tracker.time if math.isfinite(tracker.time) else None,
        "next": [tracker.next_number, tracker.next_key],
        "start": tracker.shared.start,
        "records": [dataclasses.asdict(record) for record in tracker.records],
        "beliefs": [_packed(value) for value in tracker.beliefs],
        "frame": _packed(tracker.frame),
        "home": tracker.home.tolist(),
        "shared": {name: _packed(getattr(tracker.shared, name)) for name in _SHARED},
    }


def restore(tracker: Tracker, state: dict[str, Any]) -> None:
    """Bring a new tracker to the state of a snapshot.

    Raises:
        FileError: it is of another rig or other options, or damaged.
    """
    if state.get("settings") != settings_of(tracker):
        raise FileError("the journal is of another rig or other options; delete it to begin anew, or restore them")
    try:
        tracker.time = -math.inf if state["time"] is None else float(state["time"])
        tracker.next_number, tracker.next_key = state["next"]
        tracker.shared.start = state["start"]
        tracker.records = [TrackRecord(**record) for record in state["records"]]
        tracker.beliefs = Beliefs(*(_unpacked(value) for value in state["beliefs"]))
        tracker.frame = _unpacked(state["frame"])
        tracker.home = torch.tensor(state["home"], dtype=torch.long)
        for name in _SHARED:
            setattr(tracker.shared, name, _unpacked(state["shared"][name]))
    except (KeyError, TypeError, ValueError) as error:
        raise FileError(f"the journal is damaged ({error}); delete it to begin anew") from error


def _packed(value: Tensor) -> dict[str, Any]:
    array = np.ascontiguousarray(value.detach().cpu().numpy().astype("<f8"))
    return {"shape": list(array.shape), "data": base64.b64encode(array.tobytes()).decode()}


def _unpacked(value: dict[str, Any]) -> Tensor:
    array = np.frombuffer(base64.b64decode(value["data"]), dtype="<f8").reshape(value["shape"])
    return torch.from_numpy(array.astype(np.float64))


# Tracks as the columns that files and maps of positions are made of.

_REASONS = {
    int(PositionStatus.OK): "",
    int(PositionStatus.BEARING_ONLY): "the parallax is below three sigma: only the bearing is known",
    int(PositionStatus.PARALLEL): "the lines of sight do not meet: only the bearing is known",
}


def track_columns(tracks: Tracks, sequence: int, stations: Rig | None = None) -> PositionColumns:
    """One row for each track; velocities, hits and times are further columns.

    Args:
        tracks: of one time step.
        sequence: number of the time step, which together with the name is never used twice.
        stations: cameras far apart: bearings are then those at the anchor's own vertical, and two more columns tell
            from which camera a track is told, and which see it now.
    """
    state = TrackStates(*(value.cpu() for value in tracks.state))
    ok = state.status == int(PositionStatus.OK)
    count = len(tracks.number)
    if stations is not None:
        state = state._replace(bearing=(own_axes(stations).cpu()[state.anchor] @ state.bearing[..., None])[..., 0])
    shared = {name: value for name, value in state._asdict().items() if name in Localization._fields}
    views = dict.fromkeys(("reprojection", "used", "bad", "misfit"), torch.zeros(count, 2))
    numbers = number_table(Localization(**views | shared))
    sigma = state.velocity_covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
    extras = {
        "sequence": [str(sequence)] * count,
        "time_s": [repr(tracks.time)] * count,
        "category": list(tracks.category),
        "hits": [str(hits) for hits in tracks.hits.tolist()],
        "unseen_s": [f"{seconds:.3f}" for seconds in tracks.unseen_s.tolist()],
    }
    for part, values in (("", state.velocity), ("_sigma", sigma)):
        for axis, along in zip(("east", "north", "up"), values.T, strict=True):
            extras[f"velocity_{axis}{part}_mps"] = _texts(along, ok)
    if stations is not None:
        extras["told_from"] = [stations.names[camera] for camera in state.anchor.tolist()]
        extras["cameras"] = [camera_list(stations, row) for row in tracks.seen.tolist()]
    names, status = [f"track {number}" for number in tracks.number], state.status.numpy()
    reasons = [_REASONS[int(code)] for code in status]
    return PositionColumns(names, status, reasons, numbers, extras, state.anchor.numpy())


def _texts(values: torch.Tensor, ok: torch.Tensor) -> list[str]:
    return [repr(value) if there else "" for value, there in zip(values.tolist(), ok.tolist(), strict=True)]


# The stream: lines or frames in, tracks out, time step by time step, in bounded memory, and stopped at any time.
#
# One thread reads and puts time steps into a short queue. When it is full, reading waits (a file or pipe), or the
# oldest time step is dropped and counted (a camera, which does not wait).

# Time steps that wait, and time steps between checkpoints: about ten seconds of video.
_WAITING, _CHECKPOINT = 32, 250
# Seconds: no two images of one moment are farther apart.
_APART = 10.0
# Bytes; a longer line is malformed, so that memory stays bounded.
_LONGEST = 1 << 22


class SourceItem(NamedTuple):
    """What a source gives: a time step, or why there is none; `offset` bytes of the source have been read by then."""

    moment: Moment | InputError
    offset: int


@dataclasses.dataclass
class StreamCounts:
    """What happened so far: all that went in is in one of these.

    Attributes:
        moments: written to the outputs in this run.
        repeated: skipped, because their time is not after that of the last one.
        contradicted: left out, because the time steps before and after agree that their time is wrong.
        waiting: at the end, time steps whose time jumped and that no later one confirms; the next run reads them again.
        jumps: how often the clock was set, or nothing came for a while, and what came was followed.
        last_jump_s: by how many seconds the clock was set last.
        malformed: lines that could not be read.
        dropped: time steps of a camera for which there was no time.
        positions: written.
        unsent: time steps that a receiver did not get.
        last_error: of the last malformed line.
    """

    moments: int = 0
    repeated: int = 0
    contradicted: int = 0
    waiting: int = 0
    jumps: int = 0
    last_jump_s: float = 0.0
    malformed: int = 0
    dropped: int = 0
    positions: int = 0
    unsent: int = 0
    last_error: str = ""


class Stream:
    """Follow what a source shows and write it down; continue where the journal ends.

    Args:
        tracker: new; its state comes from the journal if there is one.
        run: how positions are located, for the heads of files.
        outputs: files .geojsonl, .csv or .cot, which grow.
        journal: the file that remembers what was written.
        senders: where positions go besides.
        start: calendar time of second zero, for sources that count from elsewhere than 1970.
        shown: called with the columns and tracks of each time step, for a map.

    Raises:
        InputError: an output of another kind.
        FileError: as `Ledger`, or a journal of another rig.
    """

    def __init__(
        self,
        tracker: Tracker,
        run: Located,
        outputs: Sequence[Path],
        journal: Path,
        *,
        senders: Sequence[Sender] = (),
        start: datetime.datetime | None = None,
        shown: Callable[[PositionColumns, Tracks], None] | None = None,
    ) -> None:
        wrong = [path for path in outputs if path.suffix.lower() not in APPENDED]
        if wrong:
            raise InputError(f"{wrong[0]}: the output of a stream ends with {', '.join(APPENDED)}")
        self.tracker, self.run, self.senders = tracker, run, tuple(senders)
        self.start, self.shown = start, shown
        self.counts = StreamCounts()
        self._stop = threading.Event()
        self.ledger = Ledger(journal, outputs)
        self._behind, self._order = False, MomentOrder[SourceItem]()
        if self.ledger.state is not None:
            try:
                restore(tracker, self.ledger.state)
            except FileError as error:
                self.ledger.close()
                raise FileError(f"{journal}: {error}") from error
            except BaseException:
                self.ledger.close()
                raise

    def stop(self) -> None:
        """End after the present time step; may be called from another thread or a signal's handler."""
        self._stop.set()

    def follow(self, source: Callable[[int], Iterator[SourceItem]], *, waits: bool, resumes: bool) -> StreamCounts:
        """Follow a source until it ends or `stop` is called.

        A time that jumps is followed once two later time steps go on from it; tracks then
        begin anew.

        Args:
            source: gives items from an offset on; if it can be closed, it is closed at the end.
            waits: whether the source waits when there is no time for more; else the oldest time steps are dropped.
            resumes: whether it can begin at an offset; else it gives what comes now.
        """
        place, checkpoint = self.ledger.place, self.ledger.checkpoint_at
        begin = checkpoint.offset if resumes else 0
        # Time steps after the checkpoint that are in the outputs already bring only the tracker to where it was.
        self._behind = resumes and self.ledger.state is not None and checkpoint.sequence < place.sequence
        self._order = self._new_order(waits=waits, resumes=resumes)
        if not self._behind:
            self._checkpoint()
        items = Handover(source(begin), _WAITING, waits=waits, stop=self._stop)
        try:
            for item in items:
                self.counts.dropped = items.dropped
                # Of lines that are read again after a restart, each was counted in the run before.
                new = item.offset > place.offset or not resumes
                wrong = item.moment if isinstance(item.moment, InputError) else self._wrong_time(item.moment)
                if wrong is not None:
                    if new:
                        self.counts.malformed += 1
                        self.counts.last_error = str(wrong)
                    continue
                assert isinstance(item.moment, Moment)
                self._take_in(self._order.put(item, item.moment.time), new)
            if not self._stop.is_set():
                self._take_in(self._order.end(), True)
            self.counts.waiting = self._order.waiting
        finally:
            self._stop.set()
            if not self._behind:
                self._checkpoint()
            self.ledger.close()
            for sender in self.senders:
                sender.close()
            self.counts.unsent = sum(sender.failed for sender in self.senders)
            # The interpreter must not end while the reader computes; one that waits for input may be left alone.
            if (close := getattr(source, "close", None)) is not None:
                close()
            items.close(0.5 if close is None else 10.0)
        return self.counts

    def _new_order(self, *, waits: bool, resumes: bool) -> MomentOrder[SourceItem]:
        latest, state = self.ledger.place.time, self.ledger.state
        step = float(state.get("step_s", 0.0)) if state is not None else 0.0
        if resumes or latest is None:
            return MomentOrder(self.tracker.time, step)
        if self.tracker.time > latest:
            self.tracker.set_clock(latest)
        # A pipe's writer may begin somewhat earlier again; a camera cannot.
        return MomentOrder(latest, step, until=latest if waits else -math.inf)

    def _checkpoint(self) -> None:
        self.ledger.checkpoint(snapshot(self.tracker) | {"step_s": self._order.step})

    def _take_in(self, released: Released[SourceItem], new: bool) -> None:
        """Take in the time steps that are in order now; `new`: they are counted."""
        if new:
            self.counts.repeated += released.repeated
            self.counts.contradicted += released.contradicted
        for number, item in enumerate(released.moments):
            assert isinstance(item.moment, Moment)
            if released.jump_s and number == 0:
                self.tracker.set_clock(item.moment.time)
                if item.offset > self.ledger.place.offset or not self._behind:
                    self.counts.jumps += 1
                    self.counts.last_jump_s = released.jump_s
            if self._behind:
                place = self.ledger.place
                written, self._behind = item.offset <= place.offset, item.offset < place.offset
                if written:
                    self.tracker(item.moment.pairs, item.moment.time)
                if not self._behind:
                    self._checkpoint()
                if written:
                    continue
            sequence = self.ledger.place.sequence + 1
            self._write(item.moment, item.offset, sequence)
            if sequence % _CHECKPOINT == 0:
                self._checkpoint()

    def _wrong_time(self, moment: Moment) -> InputError | None:
        """Why a time cannot be one in seconds, or None."""
        largest = max([abs(moment.time), *moment.pairs.time.abs().flatten().tolist()])
        if largest >= MOST_SECONDS:
            return InputError(f"time {largest:.6g}: seconds are needed; this may be in milliseconds or smaller units")
        times, seen = moment.pairs.time, moment.pairs.seen
        latest, first = times.masked_fill(~seen, -math.inf).amax(1), times.masked_fill(~seen, math.inf).amin(1)
        if len(times) and (apart := float((latest - first).amax())) > _APART:
            return InputError(f"the cameras' times are {apart:.6g} s apart: do clocks count in one zone, from one day?")
        if self.start is not None:
            try:
                self.start + datetime.timedelta(seconds=moment.time)
            except OverflowError:
                return InputError(f"time {moment.time:.6g}: no date so many seconds after the start")
        return None

    def _write(self, moment: Moment, offset: int, sequence: int) -> None:
        when = self._calendar(moment.time)
        tracks = self.tracker(moment.pairs, moment.time)
        # Files of two cameras of one mast tell all from the left one.
        stations = None if self.run.centers is None else self.tracker.localize.rig
        columns = track_columns(tracks, sequence, stations)
        files = zip(self.ledger.outputs, self.ledger.place.sizes, strict=True)
        parts = [appended(path.suffix.lower(), self.run, columns, when, first=size == 0) for path, size in files]
        self.ledger.append(parts, moment.time, offset)
        for sender in self.senders:
            sender.send(columns, self.run, when)
        self.counts.moments += 1
        self.counts.positions += len(columns.names)
        self.counts.unsent = sum(sender.failed for sender in self.senders)
        # Last: what is told counts this time step, too.
        if self.shown is not None:
            self.shown(columns, tracks)

    def _calendar(self, time: float) -> datetime.datetime:
        if (known := calendar_time(time, self.start)) is not None:
            return known
        if self.senders or any(path.suffix.lower() == ".cot" for path in self.ledger.outputs):
            raise InputError(f"time {time:g} s is not in Unix seconds, which events need; give the start of the count")
        return datetime.datetime.fromtimestamp(0, datetime.UTC)


def lines_of(path: Path | None, read: Callable[[bytes], Moment]) -> Callable[[int], Iterator[SourceItem]]:
    """The lines of a file, or of the standard input if None, as a source; blank ones are skipped.

    A last line without its end that cannot be read is still being written, and is left for the next run.

    Args:
        path: of the file.
        read: turns a line into a time step, or raises `InputError`.
    """

    def items(offset: int) -> Iterator[SourceItem]:
        try:
            # A reader of its own: a thread that waits in `sys.stdin` when Python ends makes that a fatal error.
            file = open(os.dup(sys.stdin.fileno()) if path is None else path, "rb")  # noqa: SIM115
        except OSError as error:
            raise FileError(f"{path}: cannot read: {error.strerror or error}") from error
        with file:
            if path is not None:
                if os.fstat(file.fileno()).st_size < offset:
                    raise FileError(f"{path}: shorter than the journal says; another file? Delete the journal")
                file.seek(offset)
            while line := file.readline(_LONGEST):
                offset += len(line)
                whole = line.endswith(b"\n")
                if not whole and len(line) == _LONGEST:
                    while (rest := file.readline(_LONGEST)) and not rest.endswith(b"\n"):
                        offset += len(rest)
                    offset += len(rest)
                    yield SourceItem(InputError(f"a line of more than {_LONGEST} bytes"), offset)
                    continue
                if not line.strip():
                    continue
                try:
                    found: Moment | InputError = read(line)
                except InputError as error:
                    if not whole:
                        return
                    found = error
                yield SourceItem(found, offset)

    return items
