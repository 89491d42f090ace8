"""The journal of a stream: which moments are in the outputs, so that a restart neither loses nor doubles any.

The first line is a checkpoint with the state of the tracker; each further line is a moment whose positions are in the
outputs. A moment is written to the outputs first. What a crash left of a moment that is not in the journal is cut off
the outputs at the next start, and the moment is done again.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import orjson

from kcal.errors import FileError
from kcal.files import FileLock, read_bytes, write_atomic


class StreamPlace(NamedTuple):
    """How far a stream has come.

    Attributes:
        sequence: how many moments are in the outputs.
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
        """Write a moment's bytes to the outputs, and then to the journal."""
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
        """Begin the journal again with the state after the last moment."""
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
