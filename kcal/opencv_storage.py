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
import yaml

from kcal.errors import FileError
from kcal.strict_json import read_json, read_xml
from kcal.strict_yaml import MOST_BYTES as MOST_YAML

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
