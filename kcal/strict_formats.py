"""Parsers of YAML, .npz, .mat and what OpenCV writes that hostile files do not harm."""

from __future__ import annotations

import io
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Mapping
from typing import Any, Literal
from xml.etree.ElementTree import Element

import numpy as np
import yaml

from kcal.errors import FileError
from kcal.strict_json import MOST_DEPTH as _MOST_NESTED
from kcal.strict_json import nesting, read_json, read_xml

# The parser is slow: this much takes it some ten seconds. Values that a document may have once anchors are followed.
MOST_YAML, MOST_VALUES = 2**20, 200_000


def read_yaml(text: str, source: str) -> dict[str, Any]:
    """The mapping in a YAML text; nothing in it is executed.

    Raises:
        FileError: no YAML, no mapping, nested deeper than 32 levels, or anchors that say more than 200,000 values;
            `source` names the file.

    Example:
        >>> read_yaml("tagCols: 6", "memory")
        {'tagCols': 6}
    """
    if nesting(text.encode("utf-8", "replace")) > _MOST_NESTED:
        raise FileError(f"{source}: nested deeper than {_MOST_NESTED} levels; no file of a camera or a board is")
    try:
        # OpenCV's first line is no directive of YAML, and `ros2 topic echo` ends with the start of another document.
        content = yaml.safe_load(re.sub(r"\A\s*%YAML:.*|^---\s*\Z", "", text, flags=re.MULTILINE))
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        raise FileError(f"{source}: no YAML file: {' '.join(str(error).split())[:300]}") from error
    if not isinstance(content, dict):
        raise FileError(f"{source}: a mapping of names to values is needed")
    if _values(content, {}) > MOST_VALUES:
        raise FileError(f"{source}: its anchors repeat more than {MOST_VALUES:,} values, or themselves")
    return content


def _values(value: Any, counted: dict[int, float]) -> float:
    """How many values there are, each as often as it is named; infinitely many in what contains itself."""
    if not isinstance(value, dict | list | set | tuple):
        return 1
    if id(value) not in counted:
        counted[id(value)] = float("inf")
        inside = [*value, *value.values()] if isinstance(value, dict) else value
        counted[id(value)] = 1 + sum(_values(part, counted) for part in inside)
    return counted[id(value)]


# Read numpy archives of unknown origin: no objects, no more than was allowed once unpacked.


def read_npz(data: bytes, source: str, most: int, what: str) -> dict[str, np.ndarray]:
    """The arrays of an .npz file by their names.

    Args:
        data: its bytes.
        source: names the file in errors.
        most: bytes that it may unpack to.
        what: it should contain, for errors.

    Raises:
        FileError: no archive, a damaged one, or one that unpacks to more.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > most:
            raise FileError(
                f"{source}: unpacks to {size / 2**20:.0f} MiB; no {what} is larger than {most // 2**20} MiB"
            )
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            return {name: np.asarray(file[name]) for name in file.files}
    except FileError:
        raise
    except Exception as error:
        # Damaged archives and headers raise errors of a dozen kinds, from zlib.error to MemoryError.
        raise FileError(f"{source}: not an .npz file with a {what}, or a damaged one") from error


# Read MATLAB's `.mat` files of version 5 to 7.2 without SciPy, whose reader crashes on damaged ones.
#
# Source: MathWorks, "MAT-File Format" (Level 5). Numbers become arrays, characters text, structs dicts (an array of
# structs a list of them) and cells lists. Objects, functions and sparse matrices are left out.

_MOST_UNPACKED = 256 * 2**20
# Of elements: their numbers in the file, and how numpy calls what they contain.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8", 16: "u1",
          17: "u2", 18: "u4"}  # fmt: skip
_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT, _CHARACTERS = 1, 2, 4
# Classes of arrays of numbers.
_NUMBERS = range(6, 16)


ByteOrder = Literal["<", ">"]


class _Reader:
    """Elements one after the other in bytes of one byte order."""

    def __init__(self, data: bytes, order: ByteOrder) -> None:
        self.data, self.order, self.at = data, order, 0

    def more(self) -> bool:
        return self.at + 8 <= len(self.data)

    def element(self) -> tuple[int, bytes]:
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
        return kind, self.data[begin:end]

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
    left = _MOST_UNPACKED
    try:
        reader = _Reader(data[128:], order)
        while reader.more():
            kind, content = reader.element()
            if kind == _COMPRESSED:
                unpacker = zlib.decompressobj()
                content = unpacker.decompress(content, left)
                if unpacker.unconsumed_tail:
                    raise ValueError(f"it unpacks to more than {_MOST_UNPACKED // 2**20} MiB")
                kind, content = _Reader(content, order).element()
            left -= len(content)
            if left <= 0:
                raise ValueError(f"it unpacks to more than {_MOST_UNPACKED // 2**20} MiB")
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


# Read what OpenCV's FileStorage writes, YAML 1.0, XML or JSON, without OpenCV: its parsers crash on hostile files.
#
# Maps are dicts, sequences are lists, numbers are floats, everything else is text, and matrices are arrays.

MOST_DEPTH = 16
# Of a matrix: a thousand views of a large board have ten million.
MOST_NUMBERS = 20_000_000
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")
_SPECIAL = {".nan": math.nan, ".inf": math.inf, "-.inf": -math.inf, "+.inf": math.inf}
# Long lists of numbers outside texts: the parser of YAML would take seconds for them.
_LONG_LIST = re.compile(r""""(?:[^"\\]|\\.)*+"|'[^']*+'|#.*|(?:!\S+\s+)?\[(?P<numbers>[-+.,\d\seEnaifNAIF]{200,})\]""")
_ESCAPES = {"n": "\n", "t": "\t", "r": "\r"}


def read_storage(data: bytes, source: str) -> dict[str, Any]:
    r"""The top level of a file.

    Raises:
        FileError: none of the three formats, nested deeper than 16 levels, a name twice, or a matrix whose numbers do
            not fit its shape; `source` names the file.

    Example:
        >>> text = b"%YAML:1.0\nwidth: 640\nK: !!opencv-matrix\n  rows: 1\n  cols: 2\n  dt: d\n  data: [ 1., 2. ]\n"
        >>> found = read_storage(text, "memory")
        >>> found["width"], found["K"].tolist()
        (640.0, [[1.0, 2.0]])
    """
    try:
        text = data.decode("utf-8-sig")
        start = text.lstrip()[:1]
        if start == "<":
            root = read_xml(text, source)
            if root.tag != "opencv_storage":
                raise ValueError(f"the root element is {root.tag[:40]!r}, not opencv_storage")
            found = _of_element(root)
        else:
            found = _plain(read_json(data, source)) if start == "{" else _from_yaml(text)
    except (ValueError, OverflowError) as error:
        raise FileError(f"{source}: not a file of OpenCV that can be read: {error}") from error
    if not isinstance(found, dict):
        raise FileError(f"{source}: not a file of OpenCV: names with values are needed")
    return found


def _stored_matrix(value: Any) -> Any:
    """A map as it is, or the matrix that it describes."""
    if not isinstance(value, Mapping) or "dt" not in value or "data" not in value:
        return value
    shape = value["sizes"] if "sizes" in value else [value.get("rows"), value.get("cols")]
    sides = [int(side) for side in shape if isinstance(side, float) and side == side // 1 and 0 <= side < 2**31]
    channels = re.fullmatch(r"([0-9]{0,4})[ucswifdh]", str(value["dt"]))
    numbers = value["data"] if isinstance(value["data"], list) else []
    if channels is None or not sides or len(sides) != len(shape) or not all(type(n) is float for n in numbers):
        raise ValueError("a matrix without rows, cols, a known dt or numbers")
    if int(channels[1] or 1) > 1:
        sides.append(int(channels[1]))
    if len(numbers) > MOST_NUMBERS or math.prod(sides) != len(numbers):
        raise ValueError(f"a matrix of {' x '.join(map(str, sides))} with {len(numbers)} numbers")
    return np.array(numbers, dtype=np.float64).reshape(sides)


def _scalar(text: str) -> Any:
    text = text.strip()
    if text[:1] in ("'", '"'):
        if len(text) < 2 or text[-1] != text[0]:
            raise ValueError(f"a text without its end: {text[:40]}")
        inside = text[1:-1]
        if text[0] == "'":
            return inside.replace("''", "'")
        return re.sub(r"\\(.)", lambda match: _ESCAPES.get(match[1], match[1]), inside)
    if _NUMBER.fullmatch(text):
        return float(text)
    return _SPECIAL.get(text.lower(), text)


def _plain(value: Any) -> Any:
    """JSON's values with matrices and floats."""
    if isinstance(value, dict):
        return _stored_matrix({key: _plain(inside) for key, inside in value.items()})
    if isinstance(value, list):
        return [_plain(inside) for inside in value]
    if isinstance(value, str):
        return _SPECIAL.get(value.lower(), value)
    return float(value) if isinstance(value, int | float) else str(value)


def _of_element(element: Element) -> Any:
    children = list(element)
    if not children:
        parts = re.findall(r'"(?:[^"\\]|\\.)*"|[^\s"]+', element.text or "")
        values = [_scalar(part) for part in parts]
        if len(values) == 1:
            return values[0]
        numbers = all(isinstance(value, float) for value in values)
        return values if numbers or '"' in (element.text or "") else (element.text or "").strip()
    if all(child.tag == "_" for child in children):
        return [_of_element(child) for child in children]
    found: dict[str, Any] = {}
    for child in children:
        value = _of_element(child)
        if child.tag == "data" and isinstance(value, float):
            value = [value]
        _add(found, str(child.tag), value)
    return _stored_matrix(found)


def _add(found: dict[str, Any], key: str, value: Any) -> None:
    if key in found:
        raise ValueError(f"the name {key[:40]!r} occurs twice")
    found[key] = value


def _from_yaml(text: str) -> Any:
    lists: list[list[Any]] = []

    def put_away(match: re.Match[str]) -> str:
        cells = match["numbers"] and match["numbers"].split(",")
        if not cells or not all(cell.strip() for cell in cells):
            return match[0]
        lists.append([_scalar(cell) for cell in cells])
        # As many lines as before, so that messages name the right one.
        return f"!numbers {len(lists) - 1}" + "\n" * match[0].count("\n")

    # The first line is no directive of YAML 1.1, tabs are not its white space, and its names end without a space.
    spaced = re.sub(r"^%.*", "", text, flags=re.MULTILINE).expandtabs()
    spaced = re.sub(r"^( *(?:- +)?[A-Za-z_][\w.]*):(?=[^\s:/])", r"\1: ", spaced, flags=re.MULTILINE)
    plain = _LONG_LIST.sub(put_away, spaced)
    if len(plain) > MOST_YAML:
        raise ValueError(f"more than {MOST_YAML // 2**20} MiB besides lists of numbers")
    try:
        root = yaml.compose(plain, _Nodes)
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())[:300]) from error
    if root is None:
        raise ValueError("it is empty")
    return _of_node(root, lists)


class _Nodes(yaml.BaseLoader):
    """Composes nodes that are not nested too deeply, and none twice."""

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Called for each node."""
        if str(getattr(self.peek_event(), "tag", "")).startswith("tag:yaml.org,2002:python"):
            raise ValueError("an object of Python; write arrays as lists (array.tolist())")
        if self.check_event(yaml.AliasEvent):
            raise ValueError("a reference to another part (*name); OpenCV writes none")
        self.depth += 1
        if self.depth > MOST_DEPTH + 1:
            raise ValueError(f"nested deeper than {MOST_DEPTH} levels")
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


def _of_node(node: yaml.Node, lists: list[list[Any]]) -> Any:
    if isinstance(node, yaml.SequenceNode):
        return [_of_node(item, lists) for item in node.value]
    if isinstance(node, yaml.MappingNode):
        found: dict[str, Any] = {}
        for key, value in node.value:
            _add(found, str(key.value), _of_node(value, lists))
        return _stored_matrix(found)
    if node.tag == "!numbers":
        return lists[int(node.value)]
    return _scalar(node.value) if node.style is None else node.value
