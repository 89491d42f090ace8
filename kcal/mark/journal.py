"""The undo log: every action is one line of a file, written through to the disk before it is answered.

Whatever was answered is there after a crash: the state is what the lines say, from the first to the last. A line that
was cut off by a crash, or by a full disk, was not answered, and is removed. A line that was damaged later loses itself
alone.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from kcal.errors import FileError, InputError
from kcal.file_lock import try_lock
from kcal.mark.items import ACTION, Add, Change, MarkingState, Places, Put, Step, applied

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
        self._states = [MarkingState()]
        self._undone: list[MarkingState] = []
        self._earlier: list[MarkingState] = []
        self._seen: set[str] = set()
        self.count = 0
        self.notes: list[str] = []
        self.path = path
        # Bytes that are whole lines: what follows them was not answered.
        self._end = 0
        self._file = self._opened()

    @property
    def state(self) -> MarkingState:
        """The present one."""
        return self._states[-1]

    def earlier(self) -> Iterator[MarkingState]:
        """States after earlier actions, latest first."""
        return reversed(self._earlier)

    @property
    def can_undo(self) -> bool:
        """Whether there is anything to undo."""
        return len(self._states) > 1

    @property
    def can_redo(self) -> bool:
        """Whether anything was undone last."""
        return bool(self._undone)

    def do(self, action: Change | Step, key: str) -> bool:
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

    def _take(self, states: list[MarkingState], undone: list[MarkingState], key: str) -> None:
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

    def _after(self, action: Change | Step) -> tuple[list[MarkingState], list[MarkingState]]:
        if isinstance(action, Places):
            return [applied(state, action) for state in self._states], [applied(s, action) for s in self._undone]
        if not isinstance(action, Step):
            return [*self._states, applied(self.state, action)], []
        if action.do == "undo":
            if not self.can_undo:
                raise InputError("there is nothing to undo")
            return self._states[:-1], [*self._undone, self._states[-1]]
        if not self._undone:
            raise InputError("there is nothing to redo")
        return [*self._states, self._undone[-1]], self._undone[:-1]

    def _opened(self) -> IO[bytes]:
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
        return file

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
                action, key = ACTION.validate_python(content["action"]), str(content["key"])
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

    def _named(self, action: Change | Step) -> Change | Step:
        """The action; marks of a thing whose own line was lost bring the thing back."""
        if isinstance(action, Put) and action.name not in self.state.items:
            states, _ = self._after(Add(do="add", name=action.name, kind="target"))
            self._states[-1] = states[-1]
        return action


def reason(error: OSError) -> str:
    """Why a file could not be written, in words."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return "the disk is full"
    return error.strerror or str(error)
