"""Results of long simulations: one JSON line for each finished capture, so that a run can be interrupted and split."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

Record = dict[str, Any]


def read(paths: Iterable[Path]) -> list[Record]:
    """All records of the files that exist. Of records with one key, which split runs may make twice, keep the first."""
    lines = (line for path in paths if path.exists() for line in path.read_text(encoding="utf-8").splitlines())
    found: dict[str, Record] = {}
    for line in lines:
        if line.strip():
            record = json.loads(line)
            found.setdefault(json.dumps(record["key"]), record)
    return list(found.values())


def seeds(text: str) -> range:
    """Seeds of an option: "0-99", the last one included, or "7"."""
    first, _, last = text.partition("-")
    return range(int(first), int(last or first) + 1)


def finish(
    path: Path, keys: Iterable[Sequence[object]], work: Callable[..., Record], show: Callable[[Record], str]
) -> list[Record]:
    """Do what a file does not yet have, `work(*key)` for each key, and append each record as soon as it is made.

    Args:
        path: JSON lines, one record each; a record's "key" tells what it belongs to.
        keys: what is to be done.
        work: makes the record of one key, without the key.
        show: one line to print of a record.

    Returns:
        all records of the file.
    """
    done = {json.dumps(record["key"]) for record in read([path])}
    path.parent.mkdir(parents=True, exist_ok=True)
    for key in keys:
        if json.dumps(list(key)) in done:
            continue
        record = {"key": list(key)} | work(*key)
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")
        print(*key, show(record), flush=True)
    return read([path])


def kept(path: Path, names: Iterable[str], seeds: Iterable[int], run: Callable[[int], Record]) -> dict[str, list[Any]]:
    """Trials of all seeds by name; `finish` makes those that the file does not have."""
    found = {record["key"][0]: record for record in finish(path, [(seed,) for seed in seeds], run, lambda _: "done")}
    return {name: [found[seed][name] for seed in seeds] for name in names}
