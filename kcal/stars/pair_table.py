"""Angles between bright stars, sorted, for identification; kept on disk in the user's folder for caches."""

from __future__ import annotations

import functools
import hashlib
import io
import os
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from kcal.errors import FileError
from kcal.files import make_folder, read_bytes, write_atomic
from kcal.stars.catalog import StarCatalog

# Degrees. A table is made for the first that is enough for a field.
_ANGLES = (3.0, 5.0, 7.0, 10.0, 14.0, 20.0, 28.0, 40.0, 60.0)
# Of one table: for wide angles, fewer stars take part.
_MOST_PAIRS = 700_000
_VERSION = 1


class PairTable(NamedTuple):
    """Pairs of stars by their angle; stars are counted by brightness, the brightest being 0.

    Attributes:
        order: (N,) index in the catalogue of each star by brightness.
        directions: (N, 3) unit vectors of these.
        pairs: (2 P, 2) uint16, each pair both ways.
        angle: (2 P,) radians, ascending.
        stars: how many of the brightest stars take part.
    """

    order: NDArray[np.int64]
    directions: NDArray[np.float64]
    pairs: NDArray[np.uint16]
    angle: NDArray[np.float32]
    stars: int


def cache_folder() -> Path:
    """The user's folder for caches of kcal; `KCAL_CACHE` names another one."""
    if given := os.environ.get("KCAL_CACHE"):
        return Path(given)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local") / "kcal"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "kcal"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "kcal"


def pair_table(catalog: StarCatalog, field: float) -> PairTable:
    """The table for images whose diagonal is `field` radians, from the disk or made now (a second or less)."""
    degrees = next((angle for angle in _ANGLES if angle >= min(0.8 * np.degrees(field), _ANGLES[-1])), _ANGLES[-1])
    return _table_of(catalog, degrees, cache_folder())


# Of many images of one camera; a table of 700,000 pairs takes 17 MB.
@functools.lru_cache(maxsize=3)
def _table_of(catalog: StarCatalog, degrees: float, folder: Path) -> PairTable:
    order = np.argsort(catalog.magnitude, kind="stable")
    directions = catalog.directions()[order]
    content = hashlib.sha256(directions.tobytes()).hexdigest()[:12]
    path = folder / f"stars-{_VERSION}-{content}-{degrees:g}.npz"
    found = _table_on_disk(path)
    if found is None:
        found = _close_pairs(directions, np.radians(degrees))
        _keep_table(path, found)
    pairs, angle, stars = found
    both = np.stack([pairs, pairs[:, ::-1]], 1).reshape(-1, 2)
    return PairTable(order, directions, both, np.repeat(angle, 2), stars)


_Pairs = tuple[NDArray[np.uint16], NDArray[np.float32], int]


def _close_pairs(directions: NDArray[np.float64], largest: float) -> _Pairs:
    share = (1.0 - np.cos(largest)) / 2.0
    stars = int(min(len(directions), np.sqrt(2.0 * _MOST_PAIRS / share), 2**16 - 1))
    tree = cKDTree(directions[:stars])
    pairs = tree.query_pairs(2.0 * np.sin(largest / 2.0), output_type="ndarray")
    chord = np.linalg.norm(directions[pairs[:, 0]] - directions[pairs[:, 1]], axis=1)
    angle = (2.0 * np.arcsin(chord / 2.0)).astype(np.float32)
    order = np.argsort(angle, kind="stable")
    return pairs[order].astype(np.uint16), angle[order], stars


def _table_on_disk(path: Path) -> _Pairs | None:
    """What the file contains; None if it is not there or not whole."""
    try:
        with np.load(io.BytesIO(read_bytes(path)), allow_pickle=False) as table:
            pairs, angle, stars = table["pairs"], table["angle"], int(table["stars"])
    except Exception:  # whatever is wrong with the file, the table can be made anew
        return None
    whole = pairs.ndim == 2 and pairs.shape == (len(angle), 2) and pairs.dtype == np.uint16 and stars > 0
    return (pairs, angle, stars) if whole and (np.diff(angle) >= 0).all() and pairs.max(initial=0) < stars else None


def _keep_table(path: Path, table: _Pairs) -> None:
    pairs, angle, stars = table
    data = io.BytesIO()
    np.savez(data, pairs=pairs, angle=angle, stars=np.array(stars))
    try:
        make_folder(path.parent)
        write_atomic(path, data.getvalue(), told=False)
    except FileError:
        return  # a home that cannot be written costs a second each time, no more
