"""Sections of pages in docs/measured/ that scripts write: each between two comments that name it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from scripts.shared.timing import row

DOCS = Path(__file__).parents[2] / "docs" / "measured"


def write_section(page: str, name: str, text: str) -> None:
    """Put a section between its markers in a page, at the page's end if it is not there yet."""
    path = DOCS / page
    begin, end = f"<!-- begin: {name} -->", f"<!-- end: {name} -->"
    whole = path.read_text(encoding="utf-8")
    block = f"{begin}\n{text.strip()}\n{end}"
    if begin in whole:
        head, rest = whole.split(begin)
        whole = head + block + rest.split(end)[1]
    else:
        whole = f"{whole.rstrip()}\n\n{block}\n"
    path.write_text(whole, encoding="utf-8")


def read_section(page: str, name: str) -> str:
    """What `write_section` put there; empty if it never did."""
    whole = (DOCS / page).read_text(encoding="utf-8")
    begin, end = f"<!-- begin: {name} -->", f"<!-- end: {name} -->"
    return whole.split(begin)[1].split(end)[0].strip() if begin in whole else ""


def table(heads: Sequence[object], rows: Iterable[Sequence[object]]) -> list[str]:
    """A Markdown table."""
    return [row(*heads), row(*["---"] * len(heads)), *(row(*cells) for cells in rows)]
