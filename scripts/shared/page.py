"""What the measured pages are made with: sections and what their draws keep, tables, timed calls, statistics.

Tables stand on the pages in docs/measured/, each between two comments that name it. Everything else there is written
by hand: the conclusion, what columns mean, and the command of each table. Read the conclusion again whenever a table
changes.

A section is a function that makes its lines, and `scripts.measure` calls it: draws, then metrics, then a table. What
takes long goes through `Kept`, so that it can be interrupted and split.
"""

from __future__ import annotations

import inspect
import itertools
import json
import math
import resource
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
T = TypeVar("T")

# What a section of a page yields: texts, and the heads and rows of tables (`laid_out`).
Line = str | Sequence[object]
Lines = Iterator[Line]
DOCS = Path(__file__).parents[2] / "docs" / "measured"


def _around(page: str, name: str) -> tuple[str, str, str]:
    """A page up to a section, what stands in it, and the rest; a section that is not there yet is at the end."""
    whole = (DOCS / page).read_text(encoding="utf-8")
    begin, end = f"<!-- begin: {name} -->", f"<!-- end: {name} -->"
    head, rest = (whole if begin in whole else f"{whole.rstrip()}\n\n{begin}\n{end}\n").split(begin)
    inside, tail = rest.split(end)
    return head + begin, inside.strip(), end + tail


def write_section(page: str, name: str, lines: list[str]) -> None:
    """Put lines between their markers in a page, at its end if they are not there yet."""
    (head, _, tail), text = _around(page, name), "\n".join(lines).strip()
    (DOCS / page).write_text(f"{head}\n{text}\n{tail}", encoding="utf-8")


def read_section(page: str, name: str) -> str:
    """What `write_section` put there; empty if it never did."""
    return _around(page, name)[1]


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


def in_folder(rows: Callable[[Path], Iterable[Sequence[object]]]) -> list[Sequence[object]]:
    """Rows that need a folder while they are made."""
    with tempfile.TemporaryDirectory() as name:
        return [*rows(Path(name))]


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


# A call faster than this is repeated within a round until it takes as long.
SHORTEST_S = 0.003


def times(
    calls: Sequence[Callable[[], object]], rounds: int, clock: Callable[[], float] = time.perf_counter
) -> list[list[float]]:
    """Seconds of each call in each round; some runs of each first, not counted, settle how often it is repeated."""
    repeats = []
    for call in calls:
        call()
        start = clock()
        call()
        repeats.append(max(1, math.ceil(SHORTEST_S / max(clock() - start, 1e-7))))
    found: list[list[float]] = [[] for _ in calls]
    for _ in range(rounds):
        for which, call in enumerate(calls):
            start = clock()
            for _ in range(repeats[which]):
                call()
            found[which].append((clock() - start) / repeats[which])
    return found


def timed(call: Callable[P, T], *given: P.args, **named: P.kwargs) -> tuple[T, float]:
    """What a call gives, and the CPU seconds of this process that it took."""
    start = time.process_time()
    return call(*given, **named), time.process_time() - start


def spread(values: Sequence[float], digits: int = 1) -> str:
    """`median (smallest to largest)`."""
    return f"{statistics.median(values):.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def median(values: Sequence[float], digits: int = 1) -> str:
    return f"{statistics.median(values):.{digits}f}"


def ratio(own: Sequence[float], other: Sequence[float], digits: int = 2) -> str:
    """Median of one's own time over the other's, round by round: below 1, one's own is faster."""
    return median([a / b for a, b in zip(own, other, strict=True)], digits)


def row(*cells: object) -> str:
    """A row of a Markdown table."""
    return f"| {' | '.join(map(str, cells))} |"


def show(lines: list[str]) -> list[str]:
    """Print lines and return them."""
    print("\n".join(lines), flush=True)
    return lines


def rms(values: Any) -> float:
    """Root mean square of numbers, an array or a tensor."""
    return float(np.sqrt(np.square(np.asarray(values, dtype=float)).mean()))


def share(values: Iterable[float], unit: str = "") -> str:
    """Mean of shares in percent, with its standard error if draws are independent; NaN is left out."""
    known = [100.0 * value for value in values if math.isfinite(value)]
    if len(known) < 2:
        return "–"
    return f"{statistics.fmean(known):.1f} ± {statistics.stdev(known) / math.sqrt(len(known)):.1f}{unit}"


def children_seconds() -> float:
    """Processor time of the processes that this one has started and that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def peak_megabytes(process: int | str = "self") -> float:
    """Peak of what this process, or the one of a number, had in memory, libraries included (Linux).

    Not `resource.getrusage`: its peak is inherited from the process that started this one.
    """
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith("VmHWM"))) / 1024.0
