"""Tables of the pages in docs/measured/ that scripts write: each between two comments that name it.

Everything else on those pages is written by hand: the conclusion, what columns mean, and the command of each table.
Read the conclusion again whenever a table changes.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from scripts.shared.timing import row

# What a section of a page yields: texts, and the heads and rows of tables (`laid_out`).
Line = str | Sequence[object]
Lines = Iterator[Line]
DOCS = Path(__file__).parents[2] / "docs" / "measured"


def write_section(page: str, name: str, text: str | list[str], *, write: bool = True) -> None:
    """Put text or lines between their markers in a page, at its end if they are not there yet; not without `write`."""
    if not write:
        return
    text = text if isinstance(text, str) else "\n".join(text)
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


def merged(
    page: str, name: str, heads: Sequence[object], rows: Iterable[Sequence[object]], keys: int = 1
) -> Iterator[str]:
    """The table of a page with some rows anew, which their first cells tell; a cell that is None stays as it is."""
    lines = read_section(page, name).splitlines()
    whole = (
        [[cell.strip() for cell in line[1:-1].split("|")] for line in lines[2:]] if lines[:1] == [row(*heads)] else []
    )
    whole = [cells for cells in whole if len(cells) == len(heads)]
    for cells in rows:
        key = [str(cell) for cell in cells[:keys]]
        at = next((i for i, old in enumerate(whole) if old[:keys] == key), len(whole))
        before = [*whole[at : at + 1], [""] * len(heads)][0]
        whole[at : at + 1] = [[old if new is None else str(new) for old, new in zip(before, cells, strict=True)]]
    return table(heads, whole)


def table(heads: Sequence[object], rows: Iterable[Sequence[object]]) -> Iterator[str]:
    """The lines of a Markdown table, each as soon as its row is there."""
    return laid_out(itertools.chain([heads], rows))


def laid_out(parts: Iterable[Line]) -> Iterator[str]:
    """Lines of Markdown, each as soon as its part is there: texts as they are, and rows as tables, heads first.

    A text ends a table; an empty line is put between the two.
    """
    heads: Sequence[object] | None = None
    last: object = ""
    for part in parts:
        if last and part and isinstance(last, str) != isinstance(part, str):
            yield ""
        last = part
        if isinstance(part, str):
            heads = None
            yield part
        elif heads is None:
            heads = part
            yield row(*heads)
            yield row(*["---"] * len(heads))
        elif len(part) == len(heads):
            yield row(*part)
        else:
            raise ValueError(f"{len(part)} cells below {len(heads)} heads: {part}")
