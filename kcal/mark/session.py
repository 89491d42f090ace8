"""The files of a session: marks, points and landmarks as CSV, and the undo log."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, NamedTuple

import torch
from torch import Tensor

import kcal.mark.items as marking
from kcal.errors import FileError, InputError
from kcal.files import check_writable, try_lock, write_atomic
from kcal.lens.rig import Origin
from kcal.locate.marks import Marks, marks_text, read_marks
from kcal.locate.survey import EARTH, LOCAL, PLACE_COLUMNS, places_csv, read_survey
from kcal.locate.tables import TableRow, header_of, read_rows
from kcal.mark.shapes import three_of

# The undo log: every action is one line of a file, written through to the disk before it is answered.
#
# Whatever was answered is there after a crash: the state is what the lines say, from the first to the last. A line that
# was cut off by a crash, or by a full disk, was not answered, and is removed. A line that was damaged later loses
# itself alone.

_HEAD = {"kcal": "marking log", "version": 1}


class Journal:
    """States of all actions so far, with undo and redo, and the file that they come from.

    Args:
        path: of the log; made if it is missing.

    Attributes:
        count: how many actions there were.
        notes: what was found damaged in the file.

    Raises:
        FileError: a log that cannot be read or written, or one that another server has open.
    """

    def __init__(self, path: Path) -> None:
        self._states = [marking.MarkingState()]
        self._undone: list[marking.MarkingState] = []
        self._earlier: list[marking.MarkingState] = []
        self._seen: set[str] = set()
        self.count = 0
        self.notes: list[str] = []
        self.path = path
        # Bytes that are whole lines: what follows them was not answered.
        self._end = 0
        self._open()

    @property
    def state(self) -> marking.MarkingState:
        """The present one."""
        return self._states[-1]

    def earlier(self) -> Iterator[marking.MarkingState]:
        """States after earlier actions, latest first."""
        return reversed(self._earlier)

    @property
    def undoable(self) -> tuple[bool, bool]:
        """Whether there is anything to undo, and whether anything was undone last."""
        return len(self._states) > 1, bool(self._undone)

    def do(self, action: marking.Change | marking.Step, key: str) -> bool:
        """Apply an action and write it down; False if an action with this key was done before.

        Args:
            action: what to do.
            key: of the action. A page that got no answer sends it again, and it is then not done twice.

        Raises:
            InputError: the action is impossible; nothing was written then.
            FileError: the log cannot be written; the state is as before.
        """
        if key in self._seen:
            return False
        states, undone = self._after(action)
        line = json.dumps({"key": key, "action": action.model_dump(mode="json", exclude_none=True)}) + "\n"
        try:
            self._append(line.encode())
        except OSError as error:
            raise FileError(f"{self.path}: cannot write: {reason(error)}; this was not done") from error
        self._take(states, undone, key)
        return True

    def close(self) -> None:
        """Close the file, which unlocks it."""
        self._file.close()

    def _take(self, states: list[marking.MarkingState], undone: list[marking.MarkingState], key: str) -> None:
        self._earlier.append(self.state)
        self._states, self._undone = states, undone
        self._seen.add(key)
        self.count += 1

    def _append(self, line: bytes) -> None:
        """Write a whole line through to the disk; if that fails, nothing of it stays in the file."""
        file = self._file.fileno()
        # Nothing is left here unless cutting it off failed, too.
        os.ftruncate(file, self._end)
        try:
            written = 0
            while written < len(line):
                written += os.write(file, line[written:])
            os.fsync(file)
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(file, self._end)
            raise
        self._end += len(line)

    def _after(
        self, action: marking.Change | marking.Step
    ) -> tuple[list[marking.MarkingState], list[marking.MarkingState]]:
        if isinstance(action, marking.Places):
            states, undone = ([marking.applied(one, action) for one in each] for each in (self._states, self._undone))
            return states, undone
        if not isinstance(action, marking.Step):
            return [*self._states, marking.applied(self.state, action)], []
        if action.do == "undo":
            if not self.undoable[0]:
                raise InputError("there is nothing to undo")
            return self._states[:-1], [*self._undone, self._states[-1]]
        if not self._undone:
            raise InputError("there is nothing to redo")
        return [*self._states, self._undone[-1]], self._undone[:-1]

    def _open(self) -> None:
        try:
            # Without a buffer, which would keep what a full disk did not take.
            file = open(self.path, "a+b", buffering=0)  # noqa: SIM115
        except OSError as error:
            raise FileError(f"{self.path}: cannot open: {reason(error)}") from error
        try:
            self._read(file)
        except OSError as error:
            file.close()
            raise FileError(f"{self.path}: cannot read or write: {reason(error)}") from error
        except BaseException:
            file.close()
            raise

    def _read(self, file: IO[bytes]) -> None:
        if not try_lock(file.fileno()):
            raise FileError(f"{self.path}: another `kcal mark` has these marks open; end it first")
        file.seek(0)
        whole = file.read()
        # A line without its end was being written when the server was killed.
        kept = whole[: whole.rfind(b"\n") + 1]
        self._replay(kept.split(b"\n")[:-1])
        self._file, self._end = file, len(kept)
        if kept:
            os.ftruncate(file.fileno(), self._end)
        else:
            self._append((json.dumps(_HEAD) + "\n").encode())

    def _replay(self, lines: list[bytes]) -> None:
        damaged = []
        for number, line in enumerate(lines, start=1):
            try:
                content = json.loads(line)
                if number == 1:
                    if content != _HEAD:
                        raise FileError(f"{self.path}: not a log of `kcal mark` of this version; give another -o")
                    continue
                action, key = marking.ACTION.validate_python(content["action"]), str(content["key"])
                states, undone = self._after(self._named(action))
            except (ValueError, KeyError, TypeError, RecursionError) as error:
                # Also of errors of pydantic and of kcal, both of which are values that cannot be.
                damaged.append(f"line {number} is damaged and was left out ({' '.join(str(error).split())[:60]})")
                if number > 1:
                    # Undoing goes back over as many actions as there were.
                    self._states = [*self._states, self.state]
                continue
            self._take(states, undone, key)
        if damaged and damaged[0].startswith("line 1 ") and not self.count:
            raise FileError(f"{self.path}: not a log of `kcal mark`, or nothing of it can be read; give another -o")
        self.notes += [f"{self.path}: {text}" for text in damaged]

    def _named(self, action: marking.Change | marking.Step) -> marking.Change | marking.Step:
        """The action; marks of an item whose own line was lost bring the item back."""
        if isinstance(action, marking.Put) and action.name not in self.state.items:
            states, _ = self._after(marking.Add(do="add", name=action.name, kind="target"))
            self._states[-1] = states[-1]
        return action


def reason(error: OSError) -> str:
    """Why a file could not be written, in words."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return "the disk is full"
    return error.strerror or str(error)


# Surveyed places as they stand in their file, so that they can be shown, added to and written again.


class SurveyedPlaces(NamedTuple):
    """Places by name, and which three columns their coordinates stand in."""

    columns: tuple[str, str, str]
    places: Mapping[str, marking.Place]


NO_PLACES = SurveyedPlaces(EARTH, {})


def read_places(path: Path) -> SurveyedPlaces:
    """Read a survey as `kcal.locate.survey.read_survey` does, without changing its numbers.

    Raises:
        FileError: see `read_survey`; local meters in an earlier session and latitudes now.
    """
    read_survey(path)  # its checks name the line
    rows, columns = _place_rows(path)
    places = {}
    for row in rows:
        first, second, third = (row.number(column) for column in columns)
        places[row.name] = marking.Place(
            at=(first, second, third), sigma=row.number("sigma"), sigma_up=row.positive("sigma_up")
        )
    return SurveyedPlaces(columns, places)


def read_names(path: Path) -> tuple[str, ...]:
    """The column `name` of a table; its other columns are not read.

    Raises:
        FileError: a file that cannot be read, or without that column; a name twice, or longer than 60 characters.
    """
    return tuple(row.name for row in _named_rows(path, "name,mark", header_of(path), "name"))


def _place_rows(path: Path) -> tuple[Sequence[TableRow], tuple[str, str, str]]:
    rows = _named_rows(path, "name,lat,lon,height,sigma", PLACE_COLUMNS, "sigma")
    return rows, EARTH if EARTH[0] in rows[0].cells else LOCAL


def _named_rows(path: Path, header: str, columns: Sequence[str], required: str) -> Sequence[TableRow]:
    rows = read_rows(path, header, columns, (required,))
    if any(not row.name.isprintable() or len(row.name) > 60 for row in rows):
        raise FileError(f"{path}: a name has more than 60 characters; give it a shorter one")
    return rows


def places_text(survey: SurveyedPlaces) -> str:
    """The places as CSV that `read_survey` reads."""
    rows = ([name, *place.at, place.sigma, place.sigma_up] for name, place in survey.places.items())
    return places_csv(survey.columns, rows)


# The files of a session: marks, points and landmarks as CSV, rewritten after every action, and the undo log.

_MARKED: tuple[marking.Kind, ...] = ("landmark", "feature")
_LOADED = "loaded from a file"


class MarkingFiles(NamedTuple):
    """Where a session writes; all follow from the file of marks.

    Args:
        marks: of landmarks and features, as `kcal rig` reads them.
        points: of targets that are marked in both images, as `kcal locate` reads them.
        landmarks: the survey with what was typed in, as `kcal rig` reads it.
        log: of all actions.
    """

    marks: Path
    points: Path
    landmarks: Path
    log: Path

    @classmethod
    def beside(cls, marks: Path) -> MarkingFiles:
        """`site.csv` to `site.points.csv`, `site.landmarks.csv` and `site.log`."""
        stem = marks.with_suffix("") if marks.suffix.lower() == ".csv" else marks
        return cls(marks, *(Path(f"{stem}.{end}") for end in ("points.csv", "landmarks.csv", "log")))


class Session:
    """State, files and undo log of marking; every method may be called from any thread.

    Args:
        marks: the file of marks.
        survey: a file of surveyed places; those are the landmarks.
        targets: a file whose column `name` lists what will be located.
        hand_sigma: of a mark that was placed by hand or read without covariance, px.

    Attributes:
        trouble: why the files are behind the log, for example a full disk; empty if they are not.
        notes: what was found at the start: damaged lines of the log, files that were behind it.

    Raises:
        FileError: a file that cannot be read or written, or that another session has open.
    """

    def __init__(
        self, marks: Path, survey: Path | None = None, hand_sigma: float = 0.3, targets: Path | None = None
    ) -> None:
        self.files = MarkingFiles.beside(marks)
        self.hand_sigma = hand_sigma
        self._lock = threading.Lock()
        self.trouble = ""
        for path in self.files:
            check_writable(path, *filter(None, (survey, targets)))
        places = NO_PLACES if survey is None else read_places(survey)
        named = () if targets is None else read_names(targets)
        self._journal = Journal(self.files.log)
        self.notes = self._journal.notes
        try:
            self.columns = self._take_over_places(places, named)
            self._take_over_changes()
            self._write()
        except BaseException:
            self._journal.close()
            raise

    @property
    def state(self) -> marking.MarkingState:
        """The present one."""
        return self._journal.state

    @property
    def version(self) -> int:
        """How many actions there were."""
        return self._journal.count

    @property
    def undoable(self) -> tuple[bool, bool]:
        """Whether there is something to undo and something to redo."""
        return self._journal.undoable

    def do(self, action: marking.Change | marking.Step, key: str) -> marking.MarkingState:
        """Apply an action, write the log and the files, and return the new state; see `Journal.do`.

        What is in the log is done. Files that cannot be written then are written after a later action, or at the next
        start, and `trouble` says so.

        Raises:
            InputError: see `Journal.do`; a place out of range.
            FileError: see `Journal.do`.
        """
        with self._lock:
            if self.columns == EARTH:
                for place in marking.typed_places(action).values():
                    Origin(lat=place.at[0], lon=place.at[1], height=place.at[2])
            self._journal.do(action, key)
            self._write()
            return self.state

    def close(self) -> None:
        """Write what could not be written before, and release the log."""
        with self._lock:
            if self.trouble:
                self._write()
            self._journal.close()

    def _write(self) -> None:
        state = self.state
        files = [
            (self.files.marks, marks_text(marks_of(state, _MARKED))),
            (self.files.points, marks_text(marks_of(state, ("target",), single=False))),
        ]
        if state.survey:
            files.append((self.files.landmarks, places_text(SurveyedPlaces(self.columns, state.survey))))
        trouble = ""
        for path, text in files:
            try:
                _write_if_new(path, text)
            except FileError as error:
                cause = error.__cause__
                why = f"{path}: cannot write: {reason(cause)}" if isinstance(cause, OSError) else str(error)
                trouble = f"{why}. Nothing is lost: all marks are in {self.files.log}"
        # Once: it is read meanwhile.
        self.trouble = trouble

    def _take_over_places(self, places: SurveyedPlaces, targets: tuple[str, ...]) -> tuple[str, str, str]:
        """Log the places that are new or have changed and the targets that are new; return the coordinates' columns."""
        columns = places.columns
        if not places.places and self.files.landmarks.exists():
            # Its places are in the log, too: one that cannot be right is mended on the page.
            columns = _place_rows(self.files.landmarks)[1]
        new = {name: place for name, place in places.places.items() if self.state.survey.get(name) != place}
        names = tuple(name for name in targets if name not in self.state.items and name not in new)
        if new or names:
            self._journal.do(marking.Places(do="places", places=new, targets=names), f"{_LOADED} {self.version}")
        return columns

    def _take_over_changes(self) -> None:
        """Load files of marks that are not as any action of the log left them."""
        groups: tuple[tuple[Path, tuple[marking.Kind, ...], bool], ...] = (
            (self.files.marks, _MARKED, True), (self.files.points, ("target",), False),
        )  # fmt: skip
        for path, kinds, single in groups:
            if not path.exists():
                continue
            text = path.read_text(encoding="utf-8-sig")
            if len(text.splitlines()) < 2:
                continue
            before = (marks_text(marks_of(state, kinds, single=single)) for state in self._journal.earlier())
            if text == marks_text(marks_of(self.state, kinds, single=single)):
                continue
            if text in before:
                self.notes.append(f"{path}: was behind {self.files.log}, and was written again from it")
                continue
            self._journal.do(self._load(read_marks(path, single=single), kinds), f"{_LOADED} {self.version}")

    def _load(self, marks: Marks, kinds: tuple[marking.Kind, ...]) -> marking.Load:
        items: dict[str, tuple[marking.Kind, marking.Mark | None, marking.Mark | None]] = {}
        covariance = marks.covariance_or(self.hand_sigma)
        if covariance is None:
            covariance = (self.hand_sigma**2 * torch.eye(4, dtype=torch.float64)).expand(len(marks.names), 4, 4)
        for row, name in enumerate(marks.names):
            old = self.state.items.get(name)
            kind: marking.Kind = old.kind if old is not None and old.kind in kinds else kinds[-1]
            both: list[marking.Mark | None] = [None, None]
            for side, (u, v) in enumerate((marks.left[row].tolist(), marks.right[row].tolist())):
                if math.isfinite(u) and math.isfinite(v):
                    cov = three_of(covariance[row, 2 * side :, 2 * side :])
                    both[side] = marking.Mark(u=u, v=v, cov=cov, how="file")
            items[name] = (kind, both[0], both[1])
        # Landmarks without marks stay where they are.
        for name, item in self.state.items.items():
            if item.kind in kinds and name not in items and name in self.state.survey:
                items[name] = (item.kind, None, None)
        return marking.Load(do="load", items=items, kinds=kinds)


def marks_of(state: marking.MarkingState, kinds: tuple[marking.Kind, ...], *, single: bool = True) -> Marks:
    """Marks of the items of some kinds, with their covariance where both images have one."""
    enough = any if single else all
    items = {name: item for name, item in state.items.items() if item.kind in kinds}
    chosen = {name: item for name, item in items.items() if enough((item.left, item.right))}

    def pixels(side: marking.Side) -> Tensor:
        found = [item.mark(side) for item in chosen.values()]
        rows = [(math.nan, math.nan) if mark is None else (mark.u, mark.v) for mark in found]
        return torch.tensor(rows, dtype=torch.float64).reshape(-1, 2)

    covariance = torch.stack([pair_covariance(item) for item in chosen.values()]) if chosen else None
    return Marks.of_pair(tuple(chosen), pixels("left"), pixels("right"), covariance)


def pair_covariance(item: marking.Item) -> Tensor:
    """(4, 4) px² of left u, v and right u, v; NaN where it is not marked.

    A mark that was matched has the error of the mark that it was matched to, and that of the match besides.
    """
    left, right = (
        torch.full((2, 2), math.nan, dtype=torch.float64)
        if mark is None
        else torch.tensor([[mark.cov[0], mark.cov[1]], [mark.cov[1], mark.cov[2]]], dtype=torch.float64)
        for mark in (item.left, item.right)
    )
    if item.cross == "left":
        return torch.block_diag(torch.zeros_like(left), right) + left.repeat(2, 2)
    if item.cross == "right":
        return torch.block_diag(left, torch.zeros_like(right)) + right.repeat(2, 2)
    return torch.block_diag(left, right)


def _write_if_new(path: Path, text: str) -> None:
    """Write a file atomically unless it has this content."""
    with contextlib.suppress(OSError, UnicodeDecodeError):
        if path.read_text(encoding="utf-8") == text:
            return
    write_atomic(path, text)
