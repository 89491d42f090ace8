"""Files that one process writes at a time: a lock that a crash or a kill releases, and that says who has it."""

from __future__ import annotations

import contextlib
import datetime
import os
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Self

from kcal.errors import FileError

_fcntl: ModuleType | None
_msvcrt: ModuleType | None
try:
    import fcntl as _fcntl
except ImportError:
    _fcntl = None
    import msvcrt as _msvcrt
else:
    _msvcrt = None

# Windows does not rename a file that is open and locked.
PARTS_ARE_LOCKED = _fcntl is not None
# Windows locks bytes against reading, too: one that no text reaches.
_FAR = 1 << 20


class FileLock:
    """Keep other processes that ask for the same files from getting them, until `release` or the end of this one.

    Beside each file, a hidden `.NAME.lock` says who has it. The lock itself is the operating system's: what a killed
    process left behind locks nothing.

    Args:
        paths: files, which need not exist; links stand for what they point at.
        work: what this process does, for messages.

    Raises:
        FileError: another process has one of them, or no lock can be written beside it.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, FileLock([Path(folder, "a.csv")], "a test"):
        ...     sorted(os.listdir(folder))
        ['.a.csv.lock']
    """

    def __init__(self, paths: Sequence[Path], work: str) -> None:
        self._held: list[tuple[Path, int]] = []
        try:
            for path in dict.fromkeys(Path(os.path.realpath(path)) for path in paths):
                lock = path.with_name(f".{path.name}.lock")
                self._held.append((lock, _locked(lock, path, work)))
        except BaseException:
            self.release()
            raise

    def release(self) -> None:
        """Let others have the files."""
        while self._held:
            lock, handle = self._held.pop()
            # While it is still locked: nobody else has it by then. Windows removes no open file.
            with contextlib.suppress(OSError):
                lock.unlink()
            os.close(handle)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()


def _locked(lock: Path, path: Path, work: str) -> int:
    while True:
        try:
            handle = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise FileError(f"{path}: cannot lock it with {lock}: {error.strerror or error}") from error
        try:
            if not try_lock(handle):
                raise FileError(f"{path}: {_holder(handle)} writes it; end that first, or choose another output")
            # The one before may have removed the file after it was opened here.
            if lock.exists() and os.path.samestat(os.fstat(handle), lock.stat()):
                now = datetime.datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
                os.truncate(handle, 0)
                os.write(handle, f"{work}, process {os.getpid()}, since {now}\n".encode())
                return handle
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def try_lock(handle: int) -> bool:
    """Lock an open file until it is closed; False if another process has it."""
    try:
        if _fcntl is not None:
            _fcntl.flock(handle, _fcntl.LOCK_EX | _fcntl.LOCK_NB)
        elif _msvcrt is not None:
            os.lseek(handle, _FAR, os.SEEK_SET)
            _msvcrt.locking(handle, _msvcrt.LK_NBLCK, 1)
            os.lseek(handle, 0, os.SEEK_SET)
    except OSError:
        return False
    return True


def _holder(handle: int) -> str:
    os.lseek(handle, 0, os.SEEK_SET)
    return os.read(handle, 200).decode(errors="replace").strip() or "another process"
