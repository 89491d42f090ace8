"""Pack the coastlines of Natural Earth into kcal/web/map/coast.npz.

    npm pack world-atlas@2.0.2 && tar xzf world-atlas-2.0.2.tgz
    python -m scripts.make_coastline package/land-50m.json

The source is Natural Earth 1:50m land, version 4.1, in the public domain, as the npm package world-atlas packs it. Its
numbers are taken as they are. Lines that close the land at the poles and at the antimeridian are left out.
"""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import numpy as np

from kcal.files import read_bytes, write_atomic
from kcal.web.coast import PACKED_FILE, coast_near


def pack(path: Path) -> bytes:
    """The packed bytes of the TopoJSON file at `path`."""
    topology = json.loads(read_bytes(path))
    (east, north), (west, south) = (topology["transform"][name] for name in ("scale", "translate"))
    steps, starts, counts = [], [], []
    for arc in topology["arcs"]:
        points = np.cumsum(np.array(arc), axis=0)
        lon, lat = west + east * points[:, 0], south + north * points[:, 1]
        edge = (np.abs(lon) > 179.99) | (lat < -89.9)
        cuts = np.flatnonzero((edge[1:] & edge[:-1]) | (np.abs(np.diff(lon)) > 90.0)) + 1
        for part in np.split(points, cuts):
            if len(part) > 1:
                starts.append(part[0])
                counts.append(len(part))
                steps.append(np.diff(part, axis=0))
    packed = io.BytesIO()
    np.savez_compressed(
        packed, steps=np.concatenate(steps).astype(np.int16), starts=np.array(starts, np.int32),
        counts=np.array(counts, np.int32), scale=np.array([north, east]), corner=np.array([south, west]),
    )  # fmt: skip
    return packed.getvalue()


def main() -> None:
    """Write the packed lines and say how many there are."""
    data = pack(Path(sys.argv[1]))
    write_atomic(PACKED_FILE, data)
    lines = coast_near(0.0, 0.0, 180.0)
    print(f"{len(lines)} lines, {sum(map(len, lines))} points, {len(data)} bytes")


if __name__ == "__main__":
    main()
