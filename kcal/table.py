"""A table of results, each number written once: for the screen, for pages, as JSON and as CSV."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

from kcal.texts import csv_line

Columns: TypeAlias = Mapping[str, str | tuple[str, str | Callable[[Any], str]]]


@dataclasses.dataclass(frozen=True)
class Table:
    r"""Rows of results.

    Args:
        columns: name of each column for programs -> its head for people; or that and what writes a number: a template
            as of `str.format`, or a function.
        rows: cells, one for each column: a text; a number; a value with its text; or None where there is none.

    Example:
        >>> found = Table({"model": "model", "rms_px": ("RMS, px", "{:.3f}")}, [["opencv5", 0.12345], ["mine", None]])
        >>> found.cells
        [['model', 'RMS, px'], ['opencv5', '0.123'], ['mine', '']]
        >>> found.records
        [{'model': 'opencv5', 'rms_px': 0.12345}, {'model': 'mine', 'rms_px': None}]
        >>> found.csv
        'model,rms_px\nopencv5,0.12345\nmine,\n'
    """

    columns: Columns
    rows: Sequence[Sequence[Any]]

    @property
    def cells(self) -> list[list[str]]:
        """Texts, the heads first."""
        heads, forms = zip(*((one, str) if isinstance(one, str) else one for one in self.columns.values()), strict=True)
        return [[*heads], *([*map(_text, row, forms)] for row in self.rows)]

    @property
    def records(self) -> list[dict[str, Any]]:
        """Each row as values by name."""
        values = [[cell[0] if isinstance(cell, tuple) else cell for cell in row] for row in self.rows]
        return [dict(zip(self.columns, row, strict=True)) for row in values]

    @property
    def csv(self) -> str:
        """With every digit."""
        return "".join(map(csv_line, [self.columns, *(record.values() for record in self.records)]))


def _text(cell: Any, form: str | Callable[[Any], str]) -> str:
    if cell is None or isinstance(cell, str | tuple):
        return cell[1] if isinstance(cell, tuple) else cell or ""
    return form.format(cell) if isinstance(form, str) else form(cell)
