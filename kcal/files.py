"""Files that are never half written, and kcal's own JSON files with their kind and version checked.

Floats are written with Python's shortest representation, which reads back to the same float64.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Self

import pydantic

from kcal.errors import FileError, InputError


def check_writable(path: str | Path, *inputs: str | Path) -> Path:
    """Raise `FileError` now if `path` could not be written later, before minutes of work are spent.

    Args:
        path: of the file to write.
        inputs: files that are read; writing over one of them is refused.
    """
    path = Path(path)
    for other in inputs:
        if path.exists() and Path(other).exists() and path.samefile(other):
            raise FileError(f"{path}: this is an input; give the output another name")
    if path.is_dir():
        raise FileError(f"{path}: is a folder; give a file name")
    if not path.parent.is_dir():
        raise FileError(f"{path}: the folder {path.parent} does not exist; make it first")
    if not os.access(path.parent, os.W_OK) or (path.exists() and not os.access(path, os.W_OK)):
        raise FileError(f"{path}: no permission to write here; choose another place")
    return path


@contextmanager
def open_atomic(path: str | Path) -> Iterator[BinaryIO]:
    """Open a file beside `path` for writing, and move it into place when the block ends.

    If the block fails or is interrupted, the new file is removed and an old one is untouched.

    Raises:
        FileError: the folder is missing, or nothing can be written there.

    Example:
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with open_atomic(Path(folder, "a.txt")) as file:
        ...         _ = file.write(b"part by part")
        ...     Path(folder, "a.txt").read_text()
        'part by part'
    """
    path = check_writable(path)
    temporary = None
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
        with os.fdopen(handle, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        os.replace(temporary, path)
        temporary = None
    except OSError as error:
        raise FileError(f"{path}: cannot write: {error.strerror or error}") from error
    finally:
        if temporary is not None:
            os.unlink(temporary)


def write_atomic(path: str | Path, data: str | bytes) -> Path:
    """Write `data` beside `path` and move it into place, so that a reader never sees half a file.

    Raises:
        FileError: the folder is missing, or nothing can be written there; an old file is then untouched.
    """
    with open_atomic(path) as file:
        file.write(data.encode() if isinstance(data, str) else data)
    return Path(path)


def dump_json(value: Any) -> str:
    """JSON text with exact floats; NaN and infinity are refused, because JSON has neither."""
    try:
        return json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    except ValueError as error:
        raise InputError(f"a value that is not finite cannot be stored: {error}") from error


class NativeFile(pydantic.BaseModel):
    """Base of kcal's files: a pydantic model that is stored with its `kind` and `version`.

    Subclasses set `KIND`, `VERSION`, and in `OLDER` the versions that they read as well. The JSON text begins
    `{"kcal": KIND, "version": VERSION, ...}`.
    """

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    KIND: ClassVar[str]
    VERSION: ClassVar[int]
    OLDER: ClassVar[tuple[int, ...]] = ()

    def dump(self) -> dict[str, Any]:
        """The content as it is stored: plain dicts, lists and numbers, kind and version first."""
        return {"kcal": self.KIND, "version": self.VERSION, **self.model_dump(mode="json")}

    def save(self, path: str | Path) -> Path:
        """Write the file atomically and return its path."""
        return write_atomic(path, dump_json(self.dump()))

    @classmethod
    def parse(cls, content: Any, source: str) -> Self:
        """Check a decoded JSON value; `source` names it in errors."""
        if not isinstance(content, dict) or "kcal" not in content:
            raise FileError(f"{source}: not a kcal file; a kcal {cls.KIND} file is needed here")
        content = dict(content)
        kind, version = content.pop("kcal"), content.pop("version", None)
        if kind != cls.KIND:
            raise FileError(f"{source}: this is a kcal {kind} file; a kcal {cls.KIND} file is needed here")
        if version not in (*cls.OLDER, cls.VERSION):
            reads = " or ".join(str(known) for known in (*cls.OLDER, cls.VERSION))
            raise FileError(f"{source}: version {version} of the {kind} format; this kcal reads version {reads}")
        try:
            return cls.model_validate(content)
        except pydantic.ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            what = first["msg"].removeprefix("Value error, ")
            raise FileError(": ".join(filter(None, [source, f"bad {kind} file", where, what]))) from error

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read and check a file.

        Raises:
            FileError: missing, not JSON, another kind of file, another version, or a field that is wrong.
        """
        path = Path(path)
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise FileError(f"{path}: cannot read: {error.strerror or error}") from error
        except ValueError as error:
            raise FileError(f"{path}: not a JSON file: {error}") from error
        return cls.parse(content, str(path))
