"""The base of kcal's own files: apart from the rest of files, because pydantic takes long to load."""

from __future__ import annotations

import copy
import functools
import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, Self

import pydantic

from kcal.errors import FileError, InputError, warn_user
from kcal.files import dump_json, read_bytes, write_atomic
from kcal.strict_json import MOST_BYTES, read_json
from kcal.texts import brief


def digest(content: Mapping[str, Any]) -> str:
    """Sixteen hex digits that change with any value in a file's content; its head and its `summary` do not count."""
    rest = {key: value for key, value in content.items() if key not in ("kcal", "version", "summary")}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()[:16]


# Derived from the rest when a file is written, see `kcal.io.file_summary`: a wrong one counts as missing.
_DERIVED = "summary"


def _array_as_lists(value: Any) -> Any:
    """An array or tensor as lists, with None for rows that contain NaN, and without OpenCV's middle axis of one."""
    rows = value.tolist() if hasattr(value, "tolist") else None
    if not isinstance(rows, list):
        return value if rows is None else rows
    rows = [row[0] if isinstance(row, list) and len(row) == 1 else row for row in rows]
    return [None if isinstance(row, list) and any(number != number for number in row) else row for row in rows]


class Record(pydantic.BaseModel):
    """Base of the blocks inside kcal's files: unknown fields, NaN and infinity are refused.

    `_LATER`: fields that a version of the format got after files of it had been written, with the value that stands for
    "not said"; in "calibration.without", within a field. A field that has this value is left out, so that an older kcal
    reads the file.
    """

    __repr__ = brief

    def __str__(self) -> str:
        return repr(self)

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    _LATER: ClassVar[Mapping[str, Any]] = {}

    def __init__(self, /, **data: Any) -> None:
        try:
            super().__init__(**{name: _array_as_lists(value) for name, value in data.items()})
        except pydantic.ValidationError as error:
            found = error.errors(include_url=False)[0]
            got = f", got {found['input']!r:.60}" if not found["msg"].startswith("Value error") else ""
            raise InputError(f"{type(self).__name__}: {fault_text(error)}{got}") from error
        if doubt := self._doubt():
            warn_user(doubt)

    # As of pydantic's own: a record inside another one is not made by a call, and its fault gets the way to its field.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    def _doubt(self) -> str:
        """Why what was passed is more likely a slip; empty if there is no reason to doubt it."""
        return ""

    # No type for what it returns: in JSON schemas, pydantic would put that type in place of the fields.
    @pydantic.model_serializer(mode="wrap")
    def _as_before(self, plain: pydantic.SerializerFunctionWrapHandler):  # type: ignore[no-untyped-def]
        content = plain(self)
        for later, unsaid in self._LATER.items():
            *outer, name = later.split(".")
            block = functools.reduce(lambda found, key: found and found[key], outer, content)
            if block and (block[name] or unsaid) == unsaid:
                del block[name]
        return content


def _underived(content: Any, places: Iterable[tuple[int | str, ...]]) -> Any:
    """The content without what is derived, in the blocks at these places."""
    rest: Any = copy.deepcopy(content)
    for place in places:
        functools.reduce(lambda block, key: block[key], place, rest).pop(_DERIVED)
    return rest


@contextmanager
def storing(kind: str) -> Iterator[None]:
    """While a camera or rig is put in the form of its file: what does not fit there is refused with its field.

    Raises:
        InputError: values that do not fit together.
    """
    try:
        yield
    except (InputError, pydantic.ValidationError) as error:
        fault = error.__cause__ if isinstance(error, InputError) else error
        if not isinstance(fault, pydantic.ValidationError):
            raise
        raise InputError(f"this {kind} cannot be stored: {fault_text(fault)}") from fault


def fault_text(error: pydantic.ValidationError) -> str:
    """The first field that is wrong, and what is wrong with it."""
    return ": ".join(filter(None, _first_fault(error.errors(include_input=False)[0])))


def _first_fault(found: Any) -> tuple[str, str]:
    return ".".join(map(str, found["loc"])), found["msg"].removeprefix("Value error, ")


def _not_finite(value: Any) -> list[str] | None:
    """The keys that lead to a number of a decoded JSON value that is not finite; None where all are."""
    if isinstance(value, float):
        return None if math.isfinite(value) else []
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inside in pairs:
        if (found := _not_finite(inside)) is not None:
            return [str(key), *found]
    return None


class NativeFile(Record):
    """Base of kcal's files: a pydantic model that is stored with its `kind` and `version`.

    Subclasses set `KIND` and `VERSION`. The JSON text begins `{"kcal": KIND, "version": VERSION, ...}`.
    """

    KIND: ClassVar[str]
    VERSION: ClassVar[int]

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
            raise FileError(f"{source}: this is a kcal {kind!s:.40} file; a kcal {cls.KIND} file is needed here")
        if type(version) is not int or version != cls.VERSION:
            says = f"version {version!s:.40} of the {kind} format; this kcal reads version {cls.VERSION}"
            raise FileError(f"{source}: {says}")
        text = json.dumps(content)
        try:
            # As JSON, not as Python values: in strict mode only JSON's numbers are numbers, but arrays are tuples.
            checked = cls.model_validate_json(text, strict=True)
        except pydantic.ValidationError as error:
            found = error.errors(include_input=False)
            if wrong := {one["loc"][: one["loc"].index(_DERIVED)] for one in found if _DERIVED in one["loc"]}:
                return cls.parse({"kcal": kind, "version": version, **_underived(content, wrong)}, source)
            raise FileError(": ".join(filter(None, [source, f"bad {kind} file", *_first_fault(found[0])]))) from error
        if (place := _not_finite(content)) is not None:
            raise FileError(
                f"{source}: bad {kind} file: {'.'.join(place)}: not finite: JSON has neither NaN nor infinity"
            )
        return checked

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read and check a file.

        Raises:
            FileError: missing, not JSON, another kind of file, another version, or a field that is wrong.
        """
        path = Path(path)
        return cls.parse(read_json(read_bytes(path, MOST_BYTES), str(path)), str(path))
