"""The undo log: every action is one line of a file, written through to the disk before it is answered.

Whatever was answered is there after a crash: the state is what the lines say, from the first to the last. A line that
was cut off by a crash was not answered, and is removed.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from types import ModuleType
from typing import IO

import pydantic

from kcal.errors import FileError, InputError
from kcal.mark.items import ACTION, Change, MarkingState, Places, Step, applied

_fcntl: ModuleType | None
try:
    import fcntl as _fcntl
except ImportError:  # Windows has no such locks: two servers on one file are not noticed there
    _fcntl = None

_HEAD = {"kcal": "marking log", "version": 1}


class Journal:
    """States of all actions so far, with undo and redo, and the file that they come from.

    Args:
        path: of the log; made if it is missing.

    Raises:
        FileError: a log that cannot be read or written, a damaged line, or one that another server has open.
    """

    def __init__(self, path: Path) -> None:
        self._states = [MarkingState()]
        self._undone: list[MarkingState] = []
        self._seen: set[str] = set()
        self.count = 0
        self.path = path
        self._file = self._opened()

    @property
    def state(self) -> MarkingState:
        """The present one."""
        return self._states[-1]

    @property
    def before(self) -> MarkingState:
        """The state before the last action that changed something."""
        return self._undone[-1] if self._undone else self._states[max(len(self._states) - 2, 0)]

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
            end = self._file.tell()
            self._file.write(line.encode())
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            self._file.truncate(end)
            raise FileError(f"{self.path}: cannot write: {error.strerror or error}") from error
        self._states, self._undone = states, undone
        self._seen.add(key)
        self.count += 1
        return True

    def close(self) -> None:
        """Close the file, which unlocks it."""
        self._file.close()

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
            file = open(self.path, "a+b")  # noqa: SIM115
        except OSError as error:
            raise FileError(f"{self.path}: cannot open: {error.strerror or error}") from error
        if _fcntl is not None:
            try:
                _fcntl.flock(file, _fcntl.LOCK_EX | _fcntl.LOCK_NB)
            except OSError as error:
                raise FileError(f"{self.path}: another `kcal mark` has these marks open; end it first") from error
        file.seek(0)
        whole = file.read()
        # A line without its end was being written when the server was killed.
        kept = whole[: whole.rfind(b"\n") + 1]
        file.truncate(len(kept))
        file.seek(0, os.SEEK_END)
        if not kept:
            file.write((json.dumps(_HEAD) + "\n").encode())
            file.flush()
            os.fsync(file.fileno())
            return file
        self._replay(kept.split(b"\n")[:-1])
        return file

    def _replay(self, lines: list[bytes]) -> None:
        for number, line in enumerate(lines, start=1):
            try:
                content = json.loads(line)
                if number == 1:
                    if content != _HEAD:
                        raise FileError(f"{self.path}: not a log of `kcal mark` of this version; give another -o")
                    continue
                self._states, self._undone = self._after(ACTION.validate_python(content["action"]))
                self._seen.add(content["key"])
                self.count += 1
            except (ValueError, KeyError, TypeError, pydantic.ValidationError, InputError) as error:
                raise FileError(f"{self.path}: line {number} is damaged; delete it and what follows") from error
