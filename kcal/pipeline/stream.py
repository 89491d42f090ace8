"""The stream: lines or frames in, tracks out, moment by moment, in bounded memory, and stopped at any time.

One thread reads and puts moments into a short queue; when it is full, reading waits (a file or pipe), or the oldest
moment is dropped and counted (a camera, which does not wait).
"""

from __future__ import annotations

import dataclasses
import datetime
import math
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from kcal.errors import FileError, InputError
from kcal.locate.export import APPENDED, appended
from kcal.locate.positions import Located
from kcal.locate.tables import PositionColumns
from kcal.pipeline.handover import Handover
from kcal.pipeline.lines import Moment
from kcal.pipeline.moment_order import MOST_SECONDS, MomentOrder, Released
from kcal.pipeline.senders import Sender
from kcal.pipeline.snapshots import restore, snapshot
from kcal.pipeline.stream_journal import Ledger
from kcal.pipeline.track_columns import track_columns
from kcal.pipeline.track_options import Tracks
from kcal.pipeline.tracks import Tracker

# Moments that wait, and moments between checkpoints: about ten seconds of video.
_WAITING, _CHECKPOINT = 32, 250
# Bytes; a longer line is malformed, so that memory stays bounded.
_LONGEST = 1 << 22
# The year 2001 in Unix seconds: smaller times are not of the calendar.
CALENDAR = 1e9


class SourceItem(NamedTuple):
    """What a source gives: a moment, or why there is none; `offset` bytes of the source have been read by then."""

    moment: Moment | InputError
    offset: int


@dataclasses.dataclass
class StreamCounts:
    """What happened so far: all that went in is in one of these.

    Attributes:
        moments: written to the outputs in this run.
        repeated: skipped, because their time is not after that of the last one.
        contradicted: left out, because the moments before and after agree that their time is wrong.
        waiting: at the end, moments whose time jumped and that no later one bears out; the next run reads them again.
        jumps: how often the clock was set, or nothing came for a while, and what came was followed.
        last_jump_s: by how many seconds the clock was set last.
        malformed: lines that could not be read.
        dropped: moments of a camera for which there was no time.
        positions: written.
        unsent: moments that a receiver did not get.
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
        shown: called with the columns and tracks of each moment, for a map.

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
            except BaseException:
                self.ledger.close()
                raise

    def stop(self) -> None:
        """End after the present moment; may be called from another thread or a signal's handler."""
        self._stop.set()

    def follow(self, source: Callable[[int], Iterator[SourceItem]], *, waits: bool, resumes: bool) -> StreamCounts:
        """Follow a source until it ends or `stop` is called.

        A time that jumps is followed once two later moments go on from it (`kcal.pipeline.moment_order`); tracks then
        begin anew.

        Args:
            source: gives items from an offset on; if it can be closed, it is closed at the end.
            waits: whether the source waits when there is no time for more; else the oldest moments are dropped.
            resumes: whether it can begin at an offset; else it gives what comes now.
        """
        place, checkpoint = self.ledger.place, self.ledger.checkpoint_at
        begin = checkpoint.offset if resumes else 0
        # Moments after the checkpoint that are in the outputs already bring only the tracker to where it was.
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
            close = getattr(source, "close", None)
            if close is not None:
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
        """Take in the moments that are in order now; `new`: they are counted."""
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
        stations = None if self.run.feet is None else self.tracker.localize.rig
        columns = track_columns(tracks, sequence, stations)
        parts = [
            appended(path.suffix.lower(), self.run, columns, when, first=size == 0)
            for path, size in zip(self.ledger.outputs, self.ledger.place.sizes, strict=True)
        ]
        self.ledger.append(parts, moment.time, offset)
        for sender in self.senders:
            sender.send(columns, self.run, when)
        self.counts.moments += 1
        self.counts.positions += len(columns.names)
        self.counts.unsent = sum(sender.failed for sender in self.senders)
        # Last: what is told counts this moment, too.
        if self.shown is not None:
            self.shown(columns, tracks)

    def _calendar(self, time: float) -> datetime.datetime:
        if self.start is not None:
            return self.start + datetime.timedelta(seconds=time)
        if time > CALENDAR:
            return datetime.datetime.fromtimestamp(time, datetime.UTC)
        if self.senders or any(path.suffix.lower() == ".cot" for path in self.ledger.outputs):
            raise InputError(f"time {time:g} s is not in Unix seconds, which events need; give the start of the count")
        return datetime.datetime.fromtimestamp(0, datetime.UTC)


def lines_of(path: Path | None, read: Callable[[bytes], Moment]) -> Callable[[int], Iterator[SourceItem]]:
    """The lines of a file, or of the standard input if None, as a source; blank ones are skipped.

    A last line without its end is still being written, and is left for the next run.

    Args:
        path: of the file.
        read: turns a line into a moment, or raises `InputError`.
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
                if not line.endswith(b"\n"):
                    if len(line) < _LONGEST:
                        return
                    while (rest := file.readline(_LONGEST)) and not rest.endswith(b"\n"):
                        offset += len(rest)
                    offset += len(rest)
                    yield SourceItem(InputError(f"a line of more than {_LONGEST} bytes"), offset)
                    continue
                if not line.strip():
                    continue
                try:
                    yield SourceItem(read(line), offset)
                except InputError as error:
                    yield SourceItem(error, offset)

    return items
