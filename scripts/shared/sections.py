"""Sections of the measured pages: each is a function that makes its lines, and `scripts.measure` calls it.

Draws, then metrics, then a table: what takes long goes through `Kept`, so that it can be interrupted and split.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

Record = dict[str, Any]


class Section(NamedTuple):
    """Part of a page: the function that makes its lines, and arguments with which that takes seconds."""

    page: str
    name: str
    make: Callable[..., Iterable[str | Sequence[object]] | None]
    quick: Record

    @property
    def options(self) -> Record:
        """Parameters of the function with their defaults."""
        return {name: one.default for name, one in inspect.signature(self.make).parameters.items()}


SECTIONS: list[Section] = []


def section(page: str, name: str, **quick: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register a function that makes a section of a page.

    Its parameters are options; their defaults tell of which type. One named `write` is told whether pages are written,
    and one named `kept` keeps draws. It may return None; else it gives texts, and heads and rows of tables
    (`scripts.shared.page.laid_out`).

    Args:
        page: file in docs/measured.
        name: of the section.
        quick: arguments in place of the defaults for a run that only shows that it works.
    """

    def keep(make: Callable[..., Any]) -> Callable[..., Any]:
        SECTIONS.append(Section(page, name, make, quick))
        return make

    return keep


@dataclass(frozen=True)
class Kept:
    """Where records of draws are kept: JSON lines, one record each, whose "key" tells what it belongs to.

    Args:
        files: all are read, and the first is written to; nothing is kept if there are none.
        only: make no draws beside those that are there.
    """

    files: tuple[Path, ...] = ()
    only: bool = False

    def read(self) -> list[Record]:
        """All records of the files that exist. Of records with one key, which split runs may make twice, the first."""
        there = (path for path in self.files if path.exists())
        lines = (line for path in there for line in path.read_text(encoding="utf-8").splitlines())
        found: dict[str, Record] = {}
        for record in map(json.loads, filter(str.strip, lines)):
            found.setdefault(json.dumps(record["key"]), record)
        return list(found.values())

    def records(
        self, keys: Iterable[Sequence[object]], work: Callable[..., Record], show: Callable[[Record], str] = str
    ) -> list[Record]:
        """Do what the files do not yet have, `work(*key)` for each key, and keep each record as soon as it is made.

        Args:
            keys: what is to be done.
            work: makes the record of one key, without the key.
            show: one line to print of a record.

        Returns:
            all records of the files, or those that were made.
        """
        found = self.read()
        done = {json.dumps(record["key"]) for record in found}
        for key in () if self.only else map(list, keys):
            if (text := json.dumps(key)) in done:
                continue
            # As the file has it: tuples are lists.
            record = json.loads(json.dumps({"key": key} | work(*key)))
            done.add(text)
            found.append(record)
            if self.files:
                self.files[0].parent.mkdir(parents=True, exist_ok=True)
                with self.files[0].open("a", encoding="utf-8") as file:
                    file.write(json.dumps(record) + "\n")
            print(*key, show(record)[:200], flush=True)
        return found


NOT_KEPT = Kept()


def seeds(text: str) -> range:
    """Seeds of an option: "0-99", the last one included, or "7"."""
    first, _, last = text.partition("-")
    return range(int(first), int(last or first) + 1)
