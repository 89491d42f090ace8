"""Keys of a table of any length that must differ, checked in constant memory."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Collection, Hashable, Iterable
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kcal.errors import FileError

# Hashes in memory (8 MB), and the parts in which those on the disk are compared: of 10⁸ keys, 1 MB each.
_IN_MEMORY, _PARTS = 1 << 20, 1 << 10
_EDGES = np.arange(1 - _PARTS // 2, _PARTS // 2, dtype=np.int64) << 54
# Equal hashes that are looked up in the table at once. Unlike keys with equal hashes are far fewer.
_AT_ONCE = 1 << 16


class Doubled(NamedTuple):
    """A key that was used before, and the lines of its first and its second use."""

    key: Any
    first: int
    again: int


class DistinctKeys:
    """Finds a key that comes twice: at once if few came since, in `finish` if it is far from its first use.

    Eight bytes are kept for each key, its hash: the latest million in memory, the others sorted in a temporary file.
    Whether keys with equal hashes are really equal, the table says, which is read again up to there.

    Args:
        path: of the table, for messages.
        walk: reads it from the beginning: each key and its line.

    Example:
        >>> names = DistinctKeys(Path("marks.csv"), lambda: [("a", 2), ("b", 3), ("a", 4)])
        >>> names.add(["a", "b"]), names.add(["a"])
        (None, Doubled(key='a', first=2, again=4))
    """

    def __init__(self, path: Path, walk: Callable[[], Iterable[tuple[Hashable, int]]]) -> None:
        self._path, self._walk = path, walk
        self._latest = np.empty(0, np.int64)
        self._file: IO[bytes] | None = None
        self._starts: list[NDArray[np.int64]] = []  # of the parts of each sorted run in the file

    def add(self, keys: Collection[Hashable]) -> Doubled | None:
        """Take the next keys; one that was used before among the latest.

        Raises:
            FileError: no room on the disk.
        """
        hashes = np.fromiter(map(hash, keys), np.int64, len(keys))
        # Almost sorted, which the stable sort makes use of.
        self._latest = np.sort(np.concatenate([self._latest, hashes]), kind="stable")
        twice = self._latest[1:][self._latest[1:] == self._latest[:-1]]
        if len(twice):
            if found := self._really(twice):
                return found
            self._latest = np.unique(self._latest)
        if len(self._latest) >= _IN_MEMORY:
            self._put_away()
        return None

    def finish(self) -> Doubled | None:
        """A key that was used twice, of all that came.

        Raises:
            FileError: no room on the disk.
        """
        if self._file is None:
            return None
        self._put_away()
        suspects = np.empty(0, np.int64)
        for part in range(_PARTS):
            hashes = np.sort(np.concatenate([self._stored(starts[part : part + 2]) for starts in self._starts]))
            suspects = np.union1d(suspects, hashes[1:][hashes[1:] == hashes[:-1]])
            if len(suspects) > _AT_ONCE:
                break
        return self._really(suspects) if len(suspects) else None

    def close(self) -> None:
        """Remove the temporary file."""
        if self._file is not None:
            self._file.close()

    def _really(self, suspects: NDArray[np.int64]) -> Doubled | None:
        wanted = frozenset(suspects.tolist())
        lines: dict[Hashable, int] = {}
        for key, line in self._walk():
            if hash(key) in wanted:
                if key in lines:
                    return Doubled(key, lines[key], line)
                lines[key] = line
        return None

    def _put_away(self) -> None:
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile()  # noqa: SIM115
            start = self._file.seek(0, 2) // 8
            self._file.write(self._latest.data)
            self._file.flush()
        except OSError as error:
            raise FileError(
                f"{self._path}: to find names that are used twice, 8 bytes for each are kept in "
                f"{tempfile.gettempdir()}: {error.strerror or error}; set TMPDIR to a folder with more room"
            ) from error
        edges = np.searchsorted(self._latest, _EDGES)
        self._starts.append(np.concatenate([[start], start + edges, [start + len(self._latest)]]))
        self._latest = self._latest[:0]

    def _stored(self, span: NDArray[np.int64]) -> NDArray[np.int64]:
        assert self._file is not None
        first, end = span.tolist()
        self._file.seek(8 * first)
        return np.frombuffer(self._file.read(8 * (end - first)), np.int64)
