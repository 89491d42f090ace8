"""Pack the Yale Bright Star Catalogue into kcal/stars/bright_stars.bin.

    python -m scripts.make_star_catalog /path/to/bsc5

The source is the binary form of the Bright Star Catalogue, 5th revised edition (D. Hoffleit, W. H. Warren Jr., 1991,
CDS V/50): 28 bytes, then 9110 entries of 32. Novae and other entries without a position are left out.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from kcal.files import read_bytes, write_atomic
from kcal.stars.sky import PACKED, PACKED_FILE, StarCatalog

_ENTRY = np.dtype([
    ("number", "<f4"), ("ra", "<f8"), ("dec", "<f8"), ("kind", "S2"), ("magnitude", "<i2"), ("pm_ra", "<f4"),
    ("pm_dec", "<f4"),
])  # fmt: skip


def pack(path: Path) -> bytes:
    """The packed bytes of the binary catalog at `path`."""
    table = np.frombuffer(read_bytes(path), _ENTRY, offset=28)
    table = table[(table["ra"] != 0) | (table["magnitude"] != 0)]
    packed = np.zeros(len(table), PACKED)
    packed["number"] = table["number"]
    for name in ("ra", "dec"):
        packed[name] = np.rint(table[name] / (2 * np.pi) * 2**32).astype(np.int64).astype(np.uint32).astype(np.int32)
    milliarcseconds = np.degrees(1.0) * 3_600_000
    for name in ("pm_ra", "pm_dec"):  # that of right ascension times cos δ
        packed[name] = np.rint(table[name] * milliarcseconds)
    packed["magnitude"] = table["magnitude"]
    return packed.tobytes()


def main() -> None:
    """Write the packed catalog and say what is in it."""
    data = pack(Path(sys.argv[1]))
    write_atomic(PACKED_FILE, data)
    catalog = StarCatalog.bundled()
    brightest = catalog.number[catalog.magnitude.argmin()]
    print(f"{len(catalog)} stars, {len(data)} bytes, the brightest is HR {brightest}")


if __name__ == "__main__":
    main()
