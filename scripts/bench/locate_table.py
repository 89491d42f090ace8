"""`kcal locate` on long tables, measured: rows per second of processor time, and peak memory, for each format.

Each run is a process of its own with one thread, which locates a table of one row first. Processor time (user and
system), not time of day, so that other work on the machine counts less. Of several runs the fastest counts.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import torch

from kcal import save_rig
from kcal.rig import Mounting, mounting_covariance
from scripts.bench.locate import known_to, some_points
from scripts.shared.children import answer
from scripts.shared.long_range import ORIGIN, rig
from scripts.shared.page import table
from scripts.shared.sections import section

COUNTS = (1_000, 1_000_000)
SUFFIXES = ("csv", "geojson", "geojsonl", "kml", "cot")
_RUN = """
import json, sys, time
from kcal.cli.main import main
rig, small, large, out = sys.argv[1:]
for points in (small, large):
    sys.argv = ["kcal", "locate", rig, points, "-o", out]
    start = time.process_time()
    try:
        main()
    except SystemExit as end:
        assert not end.code, end.code
from scripts.shared.memory import peak_megabytes
print(json.dumps({"seconds": time.process_time() - start, "megabytes": peak_megabytes()}))
"""


def write_table(path: Path, count: int) -> Path:
    """Marks with 0.1 px of noise."""
    with torch.no_grad():
        left, right = rig()(some_points(count))[0].unbind(-2)
    marks = torch.cat([left, right], -1)
    marks += 0.1 * torch.randn(marks.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    with path.open("w") as file:
        file.write("name,left_u,left_v,right_u,right_v\n")
        for i, row in enumerate(marks.tolist()):
            file.write(f"p{i},{','.join(map(repr, row))}\n")
    return path


def _rows(folder: Path, suffixes: tuple[str, ...], counts: tuple[int, ...], repeat: int) -> Iterator[list[str]]:
    """After a table of one row."""
    exact, known = rig(), rig()
    exact.mounting = Mounting(origin=ORIGIN, heading_deg=35.0)
    known.mounting = Mounting(
        origin=ORIGIN, heading_deg=35.0, covariance=mounting_covariance(origin_m=[0.05] * 3, attitude_deg=[0.005] * 3)
    )
    known.covariance = known_to()
    rigs = {"exact": save_rig(exact, folder / "exact.json"), "with covariances": save_rig(known, folder / "known.json")}
    tables = {count: write_table(folder / f"{count}.csv", count) for count in [1, *counts]}
    for suffix in suffixes:
        for name, path in rigs.items():
            if name != "exact" and suffix not in ("csv", "geojson"):
                continue
            out = folder / f"out.{suffix}"
            for count in counts:
                command = sys.executable, "-c", _RUN, path, tables[1], tables[count], out
                found = [answer(*command) for _ in range(repeat)]
                seconds, peak = min(each["seconds"] for each in found), max(each["megabytes"] for each in found)
                yield [f".{suffix}", name, f"{count:,}", f"{count / seconds:,.0f}", f"{peak:.0f}"]
                out.unlink()


@section("locate.md", "tables", rows=(1000,), formats=("csv",), repeat=1)
def tables(rows: tuple[int, ...] = COUNTS, formats: tuple[str, ...] = SUFFIXES, repeat: int = 3) -> Iterator[str]:
    """Each format with each rig."""
    with tempfile.TemporaryDirectory() as name:
        made = _rows(Path(name), formats, rows, repeat)
        yield from table(["file", "rig", "rows", "rows a second of processor time", "peak MB"], made)
