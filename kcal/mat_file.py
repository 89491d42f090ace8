"""Read MATLAB's `.mat` files of version 5 to 7.2 without SciPy, whose reader crashes on damaged ones.

Source: MathWorks, "MAT-File Format" (Level 5). Numbers become arrays, characters text, structs dicts (an array of
structs a list of them) and cells lists. Objects, functions and sparse matrices are left out.
"""

from __future__ import annotations

import math
import struct
import zlib
from typing import Any, Literal, NamedTuple

import numpy as np

from kcal.errors import FileError

MOST_BYTES, MOST_DEPTH = 256 * 2**20, 16
# Of elements: their numbers in the file, and how numpy calls what they contain.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8", 16: "u1",
          17: "u2", 18: "u4"}  # fmt: skip
_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT, _CHARACTERS = 1, 2, 4
# Classes of arrays of numbers.
_NUMBERS = range(6, 16)


ByteOrder = Literal["<", ">"]


class _Element(NamedTuple):
    kind: int
    data: bytes


class _Reader:
    """Elements one after the other in bytes of one byte order."""

    def __init__(self, data: bytes, order: ByteOrder) -> None:
        self.data, self.order, self.at = data, order, 0

    def more(self) -> bool:
        return self.at + 8 <= len(self.data)

    def element(self) -> _Element:
        """The next one; a small one has its data in its tag."""
        if not self.more():
            raise ValueError("it ends too early")
        kind, size = struct.unpack_from(f"{self.order}II", self.data, self.at)
        begin = self.at + 8
        if kind >> 16:
            kind, size, begin = kind & 0xFFFF, kind >> 16, self.at + 4
            if size > 4:
                raise ValueError("a small element is longer than it can be")
        if begin + size > len(self.data):
            raise ValueError("an element is longer than the file")
        end = begin + size
        self.at = end if kind == _COMPRESSED else end + -end % 8 if begin > self.at + 4 else self.at + 8
        return _Element(kind, self.data[begin:end])

    def values(self, *kinds: int) -> np.ndarray:
        """The numbers of the next element."""
        kind, data = self.element()
        if kind not in (kinds or _TYPES):
            raise ValueError(f"an element of kind {kind} where numbers belong")
        form = np.dtype(_TYPES[kind]).newbyteorder(self.order)
        if len(data) % form.itemsize:
            raise ValueError("half a number")
        return np.frombuffer(data, form).astype(form.newbyteorder("="))


def read_mat(data: bytes, source: str) -> dict[str, Any]:
    """The variables of a file by their names.

    Raises:
        FileError: another version, damaged, nested deeper than 16 levels, or larger than 256 MiB unpacked; `source`
            names the file.

    Example:
        >>> import io, scipy.io
        >>> file = io.BytesIO()
        >>> scipy.io.savemat(file, {"s": {"K": np.eye(2), "unit": "mm"}})
        >>> found = read_mat(file.getvalue(), "memory")
        >>> found["s"]["unit"], found["s"]["K"].tolist()
        ('mm', [[1.0, 0.0], [0.0, 1.0]])
    """
    if data[:4] == b"\x89HDF" or data[:19] == b"MATLAB 7.3 MAT-file":
        raise FileError(f"{source}: a .mat file of version 7.3; save it with -v7")
    orders: dict[bytes, ByteOrder] = {b"IM": "<", b"MI": ">"}
    order = orders.get(data[126:128])
    if order is None or len(data) < 136:
        raise FileError(f"{source}: not a .mat file of version 5 to 7.2; save it with -v7")
    found: dict[str, Any] = {}
    left = MOST_BYTES
    try:
        reader = _Reader(data[128:], order)
        while reader.more():
            kind, content = reader.element()
            if kind == _COMPRESSED:
                unpacker = zlib.decompressobj()
                content = unpacker.decompress(content, left)
                if unpacker.unconsumed_tail:
                    raise ValueError(f"it unpacks to more than {MOST_BYTES // 2**20} MiB")
                kind, content = _Reader(content, order).element()
            left -= len(content)
            if left <= 0:
                raise ValueError(f"it unpacks to more than {MOST_BYTES // 2**20} MiB")
            if kind == _MATRIX:
                name, value = _array(_Reader(content, order), 1)
                found[name] = value
    except (ValueError, struct.error, zlib.error, OverflowError, MemoryError) as error:
        raise FileError(f"{source}: not a .mat file that can be read: {error}") from error
    return found


def _array(reader: _Reader, depth: int) -> tuple[str, Any]:
    """Name and value of an array; None for what is not read."""
    if depth > MOST_DEPTH:
        raise ValueError(f"nested deeper than {MOST_DEPTH} levels")
    if not reader.data:
        return "", np.empty(0)
    flags = reader.values(6)
    kind = int(flags[0]) & 0xFF if len(flags) else 0
    if kind not in (_CELL, _STRUCT, _CHARACTERS, *_NUMBERS):
        return "", None
    sides = [int(side) for side in reader.values(5)]
    name = reader.values(1, 2, 16).astype(np.uint8).tobytes().decode("utf-8", "replace")
    if len(sides) < 2 or min(sides) < 0:
        raise ValueError(f"{name}: an array without rows and columns")
    count = math.prod(sides)
    if kind == _CHARACTERS:
        coding, text = reader.element()
        # Old files have a number for each character.
        name_of_coding = {1: "utf-8", 2: "utf-8", 16: "utf-8", 4: "utf-16", 17: "utf-16", 18: "utf-32"}.get(coding)
        if name_of_coding is None:
            raise ValueError(f"{name}: characters of kind {coding}")
        endings = {"<": "-le", ">": "-be"}
        suffix = "" if name_of_coding == "utf-8" else endings[reader.order]
        return name, text.decode(name_of_coding + suffix, "replace")
    if kind in _NUMBERS:
        values = reader.values()
        if len(values) != count:
            raise ValueError(f"{name}: {len(values)} numbers for {count} places")
        # Arrays are stored down the columns first.
        return name, values.reshape(sides, order="F")
    if kind == _CELL:
        return name, [_inside(reader, depth) for _ in _counted(reader, count)]
    width = reader.values(5)
    names = reader.values(1).astype(np.uint8).tobytes()
    size = int(width[0]) if len(width) else 0
    if size < 1 or len(names) % size:
        raise ValueError(f"{name}: the names of a struct's fields are damaged")
    fields = [names[i : i + size].split(b"\0")[0].decode("utf-8", "replace") for i in range(0, len(names), size)]
    structs = [
        {field: _inside(reader, depth) for field in fields}
        for _ in _counted(reader, count * max(1, len(fields)), count)
    ]
    return name, structs[0] if count == 1 else structs


def _counted(reader: _Reader, elements: int, times: int | None = None) -> range:
    """So many times, if as many elements can still come: each has 8 bytes at least."""
    if 8 * elements > len(reader.data) - reader.at:
        raise ValueError("more elements than there are bytes")
    return range(elements if times is None else times)


def _inside(reader: _Reader, depth: int) -> Any:
    kind, content = reader.element()
    if kind != _MATRIX:
        raise ValueError(f"an element of kind {kind} where an array belongs")
    return _array(_Reader(content, reader.order), depth + 1)[1]
