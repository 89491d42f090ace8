"""Parsers of JSON and XML that hostile files do not harm."""

from __future__ import annotations

import json
import re
from itertools import accumulate
from typing import Any
from xml.etree import ElementTree

from kcal.errors import FileError

# Read JSON of unknown origin: limits on size, depth and numbers are checked before they can do harm.

# Far more than any file of kcal has: a thousand views of a large board take 50 MB, and a rig is 6 levels deep.
MOST_BYTES, MOST_DEPTH = 128 * 2**20, 32
# Of the largest double.
_MOST_DIGITS = 309
_STRING = re.compile(rb'"(?:[^"\\]|\\.)*+(?:"|$)', re.DOTALL)
_STEPS = {ord("["): 1, ord("{"): 1, ord("]"): -1, ord("}"): -1}
_NOT_BRACKETS = bytes(set(range(256)) - set(_STEPS))


def read_json(data: bytes, source: str) -> Any:
    """Decode a JSON text in UTF-8.

    Besides what JSON itself refuses, a text is refused that is larger than 128 MiB or nested deeper than 32 levels,
    has a key twice in one object, or has an integer beyond the range of float64. NaN and infinity are left to the
    caller, who can name the field.

    Args:
        data: the text.
        source: names it in errors.

    Raises:
        FileError: not JSON, or refused.

    Example:
        >>> read_json(b"[1, 2.5]", "memory")
        [1, 2.5]
    """
    if len(data) > MOST_BYTES:
        raise FileError(f"{source}: {len(data) / 2**20:.0f} MiB of JSON; at most {MOST_BYTES // 2**20} MiB are read")
    if nesting(data) > MOST_DEPTH:
        raise FileError(f"{source}: nested deeper than {MOST_DEPTH} levels; this is no file of kcal")
    try:
        return json.loads(data.decode("utf-8"), parse_int=_integer, object_pairs_hook=_object)
    except ValueError as error:
        raise FileError(f"{source}: not a JSON file: {error}") from error


def nesting(data: bytes) -> int:
    """How deep square and curly brackets are nested, outside of texts in quotation marks.

    Example:
        >>> nesting(b'[{"a": "[["}]')
        2
    """
    brackets = _STRING.sub(b"", data).translate(None, _NOT_BRACKETS)
    return max(accumulate((_STEPS[byte] for byte in brackets), initial=0))


def _integer(digits: str) -> int:
    if len(digits.lstrip("-")) >= _MOST_DIGITS:
        raise ValueError(f"the integer {digits[:12]}... has {len(digits)} digits, more than a number may have")
    return int(digits)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {twice[:40]!r} occurs twice in one object")
    return found


# Read XML of unknown origin: no document types, no entities, no deep nesting.

# Far more than GPX and OpenCV's files have.
MOST_XML_DEPTH, MOST_ELEMENTS = 32, 1_000_000


class _Builder(ElementTree.TreeBuilder):
    """Builds a tree and counts while it does."""

    depth = count = 0

    def start(self, tag: Any, attrs: Any, /) -> ElementTree.Element:
        self.depth, self.count = self.depth + 1, self.count + 1
        if self.depth > MOST_XML_DEPTH:
            raise ValueError(f"nested deeper than {MOST_XML_DEPTH} levels")
        if self.count > MOST_ELEMENTS:
            raise ValueError(f"more than {MOST_ELEMENTS:,} elements")
        return super().start(tag, attrs)

    def end(self, tag: str, /) -> ElementTree.Element:
        self.depth -= 1
        return super().end(tag)

    def doctype(self, name: str, public: str | None, system: str | None) -> None:
        raise ValueError("document types and entities are not read")


def read_xml(data: bytes | str, source: str) -> ElementTree.Element:
    """The root element of an XML text.

    Raises:
        FileError: not XML, or refused; `source` names it.

    Example:
        >>> read_xml("<a><b>1</b></a>", "memory").findtext("b")
        '1'
    """
    try:
        return ElementTree.fromstring(data, ElementTree.XMLParser(target=_Builder()))
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise FileError(f"{source}: not XML that can be read: {error}") from error
