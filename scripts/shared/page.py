"""Tables of the pages in docs/measured/ that scripts write: each between two comments that name it.

Everything else on those pages is written by hand: the conclusion, what columns mean, and the command of each table.
Read the conclusion again whenever a table changes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from scripts.shared.timing import row, show

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


def tell(page: str, name: str, lines: list[str], *, write: bool) -> None:
    """Print a section, and put it into its page if `write`."""
    write_section(page, name, show(lines), write=write)


def read_section(page: str, name: str) -> str:
    """What `write_section` put there; empty if it never did."""
    whole = (DOCS / page).read_text(encoding="utf-8")
    begin, end = f"<!-- begin: {name} -->", f"<!-- end: {name} -->"
    return whole.split(begin)[1].split(end)[0].strip() if begin in whole else ""


def write_row(page: str, name: str, heads: Sequence[object], cells: Sequence[object]) -> None:
    """Put a row into the table that is a section of a page, in place of the one with the same first cell.

    A cell that is None stays as it was.
    """
    lines = read_section(page, name).splitlines()
    rows = [line.strip("| ").split(" | ") for line in lines[2:]] if lines[:1] == [row(*heads)] else []
    place = next((i for i, old in enumerate(rows) if old[0] == cells[0]), len(rows))
    before = [*rows[place], *[""] * len(heads)] if place < len(rows) else [""] * len(heads)
    rows[place : place + 1] = [[old if new is None else str(new) for old, new in zip(before, cells, strict=False)]]
    write_section(page, name, table(heads, rows))


def rows_of_others(page: str, name: str, column: int, here: Iterable[str]) -> list[list[str]]:
    """Rows of a table on a page whose cell in a column is none of those measured here: of programs that are missing."""
    known = set(here)
    found = [line.strip("| ").split(" | ") for line in read_section(page, name).splitlines()[2:]]
    return [cells for cells in found if cells[column].strip() not in known]


def table(heads: Sequence[object], rows: Iterable[Sequence[object]]) -> list[str]:
    """A Markdown table."""
    return [row(*heads), row(*["---"] * len(heads)), *(row(*cells) for cells in rows)]
