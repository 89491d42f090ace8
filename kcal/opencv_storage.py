"""Read what OpenCV's FileStorage writes, YAML 1.0, XML or JSON, without OpenCV: its parsers crash on hostile files.

Maps are dicts, sequences are lists, numbers are floats, everything else is text, and matrices are arrays.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from kcal.errors import FileError
from kcal.strict_json import read_json
from kcal.strict_xml import read_xml

MOST_DEPTH = 16
# Of a matrix: a thousand views of a large board have ten million.
MOST_NUMBERS = 20_000_000
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_SPECIAL = {".nan": math.nan, ".inf": math.inf, "-.inf": -math.inf, "+.inf": math.inf}
_KEY = re.compile(r'("(?:[^"\\]|\\.)*"|[A-Za-z_][^:#"\'\[\]{}]*?)\s*:(?=\s|$)')
_TAG = re.compile(r"!\S*\s*")
_TOKEN = re.compile(r"""\s*(?:([\[\]{},:])|("(?:[^"\\]|\\.)*"|'(?:[^']|'')*')|([^\s\[\]{},:"'][^\[\]{},:"']*))""")
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
            found = _from_xml(read_xml(text, source))
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


def _from_xml(root: Element) -> Any:
    if root.tag != "opencv_storage":
        raise ValueError(f"the root element is {root.tag[:40]!r}, not opencv_storage")
    return _of_element(root)


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
    lines = []
    for number, line in enumerate(text.splitlines(), 1):
        bare = line.strip()
        if bare and not bare.startswith(("#", "%")) and bare not in ("---", "..."):
            lines.append((number, len(line) - len(line.lstrip(" ")), bare))
    if not lines:
        raise ValueError("it is empty")
    reader = _YamlLines(lines)
    found = reader.block(lines[0][1], 1)
    if reader.at < len(lines):
        raise reader.wrong("it does not belong to what stands above")
    return found


class _YamlLines:
    """Lines with their numbers and indentation, read from the top down."""

    def __init__(self, lines: list[tuple[int, int, str]]) -> None:
        self.lines, self.at = lines, 0

    def wrong(self, what: str) -> ValueError:
        number, _, text = self.lines[min(self.at, len(self.lines) - 1)]
        return ValueError(f"line {number}: {what}: {text[:40]!r}")

    def indent(self) -> int:
        """Of the next line; -1 at the end."""
        return self.lines[self.at][1] if self.at < len(self.lines) else -1

    def starts_item(self) -> bool:
        return self.at < len(self.lines) and re.match(r"-(\s|$)", self.lines[self.at][2]) is not None

    def block(self, indent: int, depth: int) -> Any:
        """A map or a sequence whose lines begin at this column."""
        if depth > MOST_DEPTH:
            raise self.wrong(f"nested deeper than {MOST_DEPTH} levels")
        if self.starts_item():
            items = []
            while self.indent() == indent and self.starts_item():
                items.append(self.value(self.lines[self.at][2][1:].strip(), indent, depth, True))
            return items
        found: dict[str, Any] = {}
        while self.indent() == indent and not self.starts_item():
            text = self.lines[self.at][2]
            key = _KEY.match(text)
            if key is None:
                raise self.wrong("a name and a colon are needed")
            name = str(_scalar(key[1])) if key[1].startswith('"') else key[1].strip()
            _add(found, name, self.value(text[key.end() :].strip(), indent, depth, False))
        return _stored_matrix(found)

    def value(self, rest: str, indent: int, depth: int, item: bool) -> Any:
        """What stands behind a name or a dash, and on the lines below."""
        if rest.startswith("!"):
            rest = _TAG.sub("", rest, count=1)
        if rest and rest[0] not in "[{\"'" and item and _KEY.match(rest):
            # A map that begins behind the dash.
            number, _, text = self.lines[self.at]
            inner = indent + len(text) - len(text[1:].lstrip())
            self.lines[self.at] = (number, inner, rest)
            return self.block(inner, depth + 1)
        if not rest or rest.startswith("#"):
            self.at += 1
            inner = self.indent()
            if inner > indent or (inner == indent and not item and self.starts_item()):
                return self.block(inner, depth + 1)
            return ""
        if rest[0] in "[{":
            return self.flow(rest, depth)
        self.at += 1
        return _scalar(rest if rest[0] in "\"'" else rest.split(" #")[0])

    def flow(self, rest: str, depth: int) -> Any:
        """A sequence or map in brackets, which may go on over lines."""
        begin, parts = self.at, [rest]
        # Brackets in texts end it too late at worst, and are then found to be missing.
        balance = _open_brackets(rest)
        while balance > 0 and self.at + 1 < len(self.lines):
            self.at += 1
            parts.append(self.lines[self.at][2])
            balance += _open_brackets(parts[-1])
        text = " ".join(parts)
        self.at += 1
        if text[0] == "[" and text[-1] == "]" and not any(sign in text[1:-1] for sign in "[]{}\"'#:"):
            # A long list of numbers, without tokens.
            cells = text[1:-1].split(",")
            if all(cell.strip() for cell in cells):
                return [_scalar(cell) for cell in cells]
        tokens = _tokens(text)
        value, end = _flow(tokens, 0, depth + 1)
        if end != len(tokens):
            self.at = begin
            raise self.wrong("more than one value")
        return value


def _open_brackets(text: str) -> int:
    bare = re.sub(r"\"(?:[^\"\\]|\\.)*\"|'[^']*'", "", text)
    return bare.count("[") + bare.count("{") - bare.count("]") - bare.count("}")


def _tokens(text: str) -> list[str]:
    """Brackets, commas, colons, quoted and bare texts; a bare text is never one of the signs alone."""
    found, place, text = [], 0, text.rstrip()
    while place < len(text):
        match = _TOKEN.match(text, place)
        if match is None:
            raise ValueError(f"not understood: {text[place : place + 40]!r}")
        place = match.end()
        found.append(match[0].strip())
    return found


def _flow(tokens: list[str], at: int, depth: int) -> tuple[Any, int]:
    """The value that begins at a token, and the number of the token after it."""
    if depth > MOST_DEPTH:
        raise ValueError(f"nested deeper than {MOST_DEPTH} levels")
    opening = _at(tokens, at)
    if opening not in ("[", "{"):
        if opening in ("]", "}", ",", ":"):
            raise ValueError(f"{opening!r} where a value belongs")
        return _scalar(opening), at + 1
    closing, items, found = {"[": "]", "{": "}"}[opening], [], dict[str, Any]()
    at += 1
    while _at(tokens, at) != closing:
        if opening == "{":
            name = _scalar(_at(tokens, at))
            if _at(tokens, at + 1) != ":":
                raise ValueError(f"{str(name)[:40]!r} has no colon")
            value, at = _flow(tokens, at + 2, depth + 1)
            _add(found, str(name), value)
        else:
            value, at = _flow(tokens, at, depth + 1)
            items.append(value)
        if _at(tokens, at) == ",":
            at += 1
        elif _at(tokens, at) != closing:
            raise ValueError(f"{closing!r} or a comma is missing before {_at(tokens, at)[:40]!r}")
    return (items if opening == "[" else _stored_matrix(found)), at + 1


def _at(tokens: list[str], at: int) -> str:
    if at >= len(tokens):
        raise ValueError("a bracket is not closed")
    return tokens[at]
