"""The base of kcal's own files: apart from the rest of files, because pydantic takes long to load."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

import pydantic

from kcal.errors import FileError, InputError
from kcal.files import dump_json, read_bytes, write_atomic
from kcal.strict_json import MOST_BYTES, read_json


def digest(content: Mapping[str, Any]) -> str:
    """Sixteen hex digits that change with any value in a file's content; its head and its `summary` do not count."""
    rest = {key: value for key, value in content.items() if key not in ("kcal", "version", "summary")}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()[:16]


class NativeFile(pydantic.BaseModel):
    """Base of kcal's files: a pydantic model that is stored with its `kind` and `version`.

    Subclasses set `KIND`, `VERSION`, in `OLDER` the versions that they read as well, and in `RETIRED` what to say of
    fields that are read no more. The JSON text begins `{"kcal": KIND, "version": VERSION, ...}`.
    """

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    KIND: ClassVar[str]
    VERSION: ClassVar[int]
    OLDER: ClassVar[tuple[int, ...]] = ()
    RETIRED: ClassVar[Mapping[str, str]] = {}

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
        known = (*cls.OLDER, cls.VERSION)
        if type(version) is not int or version not in known:
            reads = " or ".join(map(str, known))
            raise FileError(f"{source}: version {version!s:.40} of the {kind} format; this kcal reads version {reads}")
        text = json.dumps(content)
        try:
            # As JSON, not as Python values: in strict mode only JSON's numbers are numbers, but arrays are tuples.
            checked = cls.model_validate_json(text, strict=True)
        except pydantic.ValidationError as error:
            found = error.errors(include_input=False)
            retired = [one for one in found if one["type"] == "extra_forbidden" and one["loc"][-1] in cls.RETIRED]
            first = (retired or found)[0]
            where = ".".join(str(part) for part in (first["loc"][:-1] if retired else first["loc"]))
            what = cls.RETIRED[str(first["loc"][-1])] if retired else first["msg"].removeprefix("Value error, ")
            raise FileError(": ".join(filter(None, [source, f"bad {kind} file", where, what]))) from error
        try:
            dump_json(content)
        except InputError as error:
            raise FileError(f"{source}: bad {kind} file: {error}") from error
        return checked

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read and check a file.

        Raises:
            FileError: missing, not JSON, another kind of file, another version, or a field that is wrong.
        """
        path = Path(path)
        return cls.parse(read_json(read_bytes(path, MOST_BYTES), str(path)), str(path))
