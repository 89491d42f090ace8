"""Files written whole or not at all, locks that processes share, and which names are live sources."""

from __future__ import annotations

import datetime
import hashlib
import json
import os
import re
import secrets
import stat
import zlib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO
from urllib.parse import urlsplit

from kcal.errors import FileError, InputError

# Live sources of images: which texts name them, and their names without passwords.

_STREAM = re.compile(r"(rtsps?|rtmps?|https?|udp|tcp|srt)://|camera:\d+$", re.IGNORECASE)


def is_stream(source: str | Path) -> bool:
    """Whether a source is live: an address such as `rtsp://...`, or `camera:0`, a device of this machine.

    Example:
        >>> is_stream("rtsp://10.0.0.7/main"), is_stream("camera:0"), is_stream("shots.mp4")
        (True, True, False)
    """
    return _STREAM.match(str(source)) is not None


def source_name(source: str | Path) -> str:
    """The name of a source in its views: the file's name, the device, or the stream's host without any password.

    Example:
        >>> source_name("rtsp://user:secret@10.0.0.7:554/main?token=1"), source_name("camera:0")
        ('10.0.0.7', 'camera:0')
    """
    text = str(source)
    if "://" in text and is_stream(source):
        return urlsplit(text).hostname or "stream"
    return text if is_stream(source) else Path(source).name


# Files that one process writes at a time: a lock that a crash or a kill releases, and that says who has it.

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


class FileLock(ExitStack):
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

    release = ExitStack.close

    def __init__(self, paths: Sequence[Path], work: str) -> None:
        super().__init__()
        try:
            for path in dict.fromkeys(Path(os.path.realpath(path)) for path in paths):
                lock = path.with_name(f".{path.name}.lock")
                self.callback(_unlock, lock, _locked(lock, path, work))
        except BaseException:
            self.close()
            raise


def _unlock(lock: Path, handle: int) -> None:
    # While it is still locked: nobody else has it by then. Windows removes no open file.
    with suppress(OSError):
        lock.unlink()
    os.close(handle)


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


# Files that are never half written, read whole or refused, and JSON with exact floats.
#
# Floats are written with Python's shortest representation, which reads back to the same float64.


def read_bytes(path: str | Path, most: int = 2**30) -> bytes:
    """The bytes of a regular file, unpacked if it is a .gz; a pipe or a device, which may never end, is refused.

    Raises:
        FileError: missing, no regular file, larger than `most` bytes, or not readable.
    """
    with _regular_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise FileError(f"{path}: {size / 2**20:.0f} MiB; at most {most / 2**20:.0f} MiB are read")
        data = file.read(most)
    if Path(path).suffix.lower() != ".gz":
        return data
    unpacker = zlib.decompressobj(31)
    try:
        data = unpacker.decompress(data, most)
    except zlib.error as error:
        raise FileError(f"{path}: not gzip that can be unpacked: {error}") from None
    if not unpacker.eof:
        raise FileError(f"{path}: cut short, or more than {most / 2**20:.0f} MiB unpacked")
    return data


def read_text(path: str | Path, most: int) -> str:
    """The UTF-8 text of a regular file, without a byte order mark.

    Raises:
        FileError: as `read_bytes`, or another encoding.
    """
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileError(f"{path}: not UTF-8 text") from error


def read_head(path: str | Path, count: int) -> bytes:
    """The first bytes of a regular file, at most so many; with 0, check that it is one and can be read.

    Raises:
        FileError: missing, no regular file, or not readable.
    """
    with _regular_file(path) as file:
        return file.read(count)


@contextmanager
def _regular_file(path: str | Path) -> Iterator[BinaryIO]:
    try:
        # Opening a pipe would wait for somebody to write into it.
        with open(path, "rb", opener=lambda name, flags: os.open(name, flags | getattr(os, "O_NONBLOCK", 0))) as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise FileError(f"{path}: not a regular file; a pipe or a device cannot be read here")
            if _watching:
                _read.add(os.path.realpath(path))
            yield file
    except (OSError, ValueError) as error:
        raise FileError(f"{path}: cannot read: {_reason(error)}") from error


def _reason(error: OSError | ValueError) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


def check_writable(path: str | Path, *inputs: str | Path) -> Path:
    """Raise `FileError` now if `path` could not be written later, before minutes of work are spent.

    Args:
        path: of the file to write.
        inputs: files that are read; writing over one of them is refused.
    """
    path = Path(path)
    try:
        target = Path(os.path.realpath(path))
        mode = target.stat().st_mode
    except FileNotFoundError:
        mode = 0
    except (OSError, ValueError) as error:
        raise FileError(f"{path}: cannot write: {_reason(error)}") from error
    for other in inputs:
        if mode and os.path.exists(other) and os.path.samefile(target, other):
            raise FileError(f"{path}: this is an input; give the output another name")
    if stat.S_ISDIR(mode):
        raise FileError(f"{path}: is a folder; give a file name")
    if mode and not stat.S_ISREG(mode):
        raise FileError(f"{path}: not a regular file; give another name")
    folder = target.parent if path.is_symlink() else path.parent
    if not folder.is_dir():
        raise FileError(f"{path}: the folder {folder} does not exist; make it first")
    if not os.access(folder, os.W_OK) or (mode and not os.access(target, os.W_OK)):
        raise FileError(f"{path}: no permission to write here; choose another place")
    return path


def check_picture(path: str | Path) -> Path:
    """Raise an error now if `path` could not be written as a picture later.

    Raises:
        InputError: a suffix other than .png, .svg and .pdf.
        FileError: the file cannot be written.
    """
    if Path(path).suffix.lower() not in (".png", ".svg", ".pdf"):
        raise InputError(f"{path}: the name of a picture must end with .png, .svg or .pdf")
    return check_writable(path)


def make_folder(path: str | Path) -> Path:
    """Make a folder, with those that it is in, unless it is there.

    Raises:
        FileError: it cannot be made, for example because a file has its name.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise FileError(f"{path}: cannot make this folder: {_reason(error)}") from error
    return path


# The paths of files as they are written, and whether each replaced one that was not read before.
_watching: list[dict[Path, bool]] = []
_read: set[str] = set()


@contextmanager
def written_files() -> Iterator[dict[Path, bool]]:
    """Collect the paths of all files that are written meanwhile, and whether each replaced another one.

    What goes on from a file that was read meanwhile, as journals do, replaces nothing.
    """
    if not _watching:
        _read.clear()
    _watching.append({})
    try:
        yield _watching[-1]
    finally:
        _watching.pop()


def replaced(path: str | Path) -> bool:
    """Whether a file that was just written took the place of another one (`written_files`)."""
    return any(written.get(Path(path), False) for written in _watching)


@contextmanager
def open_atomic(path: str | Path, *, told: bool = True) -> Iterator[BinaryIO]:
    """Open a file beside `path` for writing, and move it into place when the block ends.

    If the block fails or is interrupted, the new file is removed and an old one is untouched. What a killed process
    left of this file is removed by the next one that writes it.

    If `path` is a link, the file it points at is replaced. A file that exists keeps its permissions; a new one gets
    those of the umask. Unless it is `told`, nothing is said of it after an interruption (`written_files`): a cache.

    Raises:
        FileError: the folder is missing, or nothing can be written there.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with open_atomic(Path(folder, "a.txt")) as file:
        ...         _ = file.write(b"part by part")
        ...     Path(folder, "a.txt").read_text()
        'part by part'
    """
    path = check_writable(path)
    target = Path(os.path.realpath(path))
    _sweep(target)
    try:
        mode = stat.S_IMODE(target.stat().st_mode) if target.exists() else None
        temporary, handle = _part_of(target, 0o666 if mode is None else 0o600)
        # As long as this is open, other processes see that the part is in use.
        held = os.dup(handle) if PARTS_ARE_LOCKED else None
        try:
            with os.fdopen(handle, "wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            if mode is not None:
                os.chmod(temporary, mode)
            os.replace(temporary, target)
        finally:
            if held is not None:
                os.close(held)
            if temporary.exists():
                temporary.unlink()
            else:
                # In place, also where an interruption came right after that.
                for written in _watching if told else ():
                    written.setdefault(path, mode is not None and str(target) not in _read)
    except OSError as error:
        raise FileError(f"{path}: cannot write: {error.strerror or error}") from error


def _part_prefix(target: Path) -> str:
    # A short one: the name of the file may have all the characters that a name may have.
    return f".kcal-{hashlib.blake2s(target.name.encode(), digest_size=6).hexdigest()}-"


def _part_of(target: Path, mode: int) -> tuple[Path, int]:
    """A new file beside the target, open and locked."""
    while True:
        part = target.with_name(f"{_part_prefix(target)}{secrets.token_hex(6)}.part")
        handle = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        if PARTS_ARE_LOCKED:
            try_lock(handle)
            if not os.fstat(handle).st_nlink:
                # Another process took it for one of a dead process before it was locked.
                os.close(handle)
                continue
        return part, handle


# Names of parts in each folder, listed once: folders may have many files.
_parts: dict[Path, list[str]] = {}


def _sweep(target: Path) -> None:
    """Remove what killed processes left of this file: parts that nobody has locked."""
    if not PARTS_ARE_LOCKED:
        return
    folder = target.parent
    if folder not in _parts:
        _parts[folder] = []
        with suppress(OSError), os.scandir(folder) as entries:
            _parts[folder] = [e.name for e in entries if e.name.startswith(".kcal-") and e.name.endswith(".part")]
    prefix = _part_prefix(target)
    for name in [name for name in _parts[folder] if name.startswith(prefix)]:
        _parts[folder].remove(name)
        with suppress(OSError):
            handle = os.open(folder / name, os.O_RDONLY | os.O_NOFOLLOW)
            try:
                if try_lock(handle):
                    os.unlink(folder / name)
            finally:
                os.close(handle)


def write_atomic(path: str | Path, data: str | bytes, *, told: bool = True) -> Path:
    """Write `data` beside `path` and move it into place, so that a reader never sees half a file.

    Args:
        path: the file.
        data: all that it contains.
        told: see `open_atomic`.

    Raises:
        FileError: the folder is missing, or nothing can be written there; an old file is then untouched.
    """
    with open_atomic(path, told=told) as file:
        file.write(data.encode() if isinstance(data, str) else data)
    return Path(path)


def dump_json(value: Any) -> str:
    """JSON text with exact floats; NaN and infinity are refused, because JSON has neither."""
    try:
        return json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    except ValueError as error:
        raise InputError(f"a value that is not finite cannot be stored: {error}") from error
