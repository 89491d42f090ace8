"""Read XML of unknown origin: no document types, no entities, no deep nesting."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

from kcal.errors import FileError

# Far more than GPX and OpenCV's files have.
MOST_DEPTH, MOST_ELEMENTS = 32, 1_000_000


class _Builder(ElementTree.TreeBuilder):
    """Builds a tree and counts while it does."""

    depth = count = 0

    def start(self, tag: Any, attrs: Any, /) -> ElementTree.Element:
        self.depth, self.count = self.depth + 1, self.count + 1
        if self.depth > MOST_DEPTH:
            raise ValueError(f"nested deeper than {MOST_DEPTH} levels")
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
