"""Give every reader, server and command damaged files and messages; what breaks an invariant is a finding.

    python -m scripts.fuzz --minutes 60                       all harnesses, each for its share of the time
    python -m scripts.fuzz --minutes 5 --seed 7 camera rig    two of them, again with the seed that a report names
    python -m scripts.fuzz --replay tests/fuzz/corpus         the cases that are kept there, and no others
    python -m scripts.fuzz --list

Invariants of a reader: a file is refused by one of kcal's errors that names it, or what was read has finite numbers, a
status for each that is not, and is the same after saving and loading; within 10 s of computing and 2 GiB. Of a server:
no status of 500, JSON with finite numbers, nothing without the token, and a log that gives the same state again. Of a
command: no traceback and no number that is not finite. `--keep FOLDER` leaves the smallest case of each finding there;
a case that was mended goes into tests/fuzz/corpus/HARNESS.
"""

from __future__ import annotations

import argparse
import functools
import math
import re
import sys
import tempfile
import time
from pathlib import Path

from kcal.files import make_folder
from scripts.fuzz.harnesses import HARNESSES, prepared
from scripts.fuzz.hunt import corpus, hunt, replay
from scripts.fuzz.readers import missing


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("harness", nargs="*", metavar="HARNESS", help="all if none is named")
    parser.add_argument("--minutes", type=float, default=5.0, help="for all harnesses together")
    parser.add_argument("--cases", type=int, help="so many of each harness, however long they take")
    parser.add_argument("--seed", type=int, default=int(time.time()), help="a new one if left out")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="for the smallest case of each finding")
    parser.add_argument("--replay", type=Path, metavar="FOLDER", help="run the cases that are kept there, once")
    parser.add_argument("--list", action="store_true", help="print the names of all harnesses")
    chosen = parser.parse_args(arguments)
    names = chosen.harness or list(HARNESSES)
    if unknown := [name for name in names if name not in HARNESSES]:
        parser.error(f"no harness is named {unknown[0]!r}; --list shows them")
    if chosen.list:
        print("\n".join(names))
        return
    kept = None if chosen.replay is None else dict(corpus(chosen.replay))
    if kept is not None:
        names = [name for name in names if name in kept]
    print(f"seed {chosen.seed}", flush=True)
    total = 0
    for name in names:
        if package := missing(name):
            print(f"{name}: left out, {package} is not installed", flush=True)
            continue
        with tempfile.TemporaryDirectory() as folder:
            harness = functools.partial(prepared, name)
            if kept is not None:
                found, count = replay(harness, Path(folder), kept[name]), len(kept[name])
            else:
                seconds = math.inf if chosen.cases else 60.0 * chosen.minutes / len(names)
                found, count = hunt(harness, Path(folder), chosen.seed, seconds, cases=chosen.cases)
        total += len(found)
        print(f"{name}: {count} cases, {len(found)} findings", flush=True)
        for number, finding in enumerate(found):
            print(f"  {finding}\n", flush=True)
            if chosen.keep is not None:
                place = make_folder(chosen.keep / name)
                label = re.sub(r"\W+", "-", finding.what.splitlines()[-1])[:40]
                (place / f"{chosen.seed}-{number}-{label}").write_bytes(finding.case)
    sys.exit(int(bool(total)))


if __name__ == "__main__":
    main()
