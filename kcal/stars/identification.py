"""Name stars without knowing where the camera looks, from the angles between the brightest of them."""

from __future__ import annotations

import functools
import hashlib
import io
import itertools
import math
import os
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.spatial import cKDTree

from kcal.errors import FileError
from kcal.files import make_folder, read_bytes, write_atomic
from kcal.stars.sky import StarCatalog

# Angles between bright stars, sorted, for identification; kept on disk in the user's folder for caches.

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


# Name stars without knowing where the camera looks, from the angles between the brightest of them.
#
# Triangles of bright stars propose attitudes, and all other stars test them. How many stars agree by chance follows
# from how many stars the sky has there: an attitude is accepted only where chance explains it less than once in 10⁹
# images.

Floats = NDArray[np.float64]

# Expected number of attitudes that agree as well by chance.
_BY_CHANCE = 1e-9
# More stars of an image are not needed.
_TESTED = 80
# Triangles with a side below this share of the field propose attitudes that are too rough.
_SHORTEST = 0.06
# Stars of the catalogue in the field for each star of the image, of which not all are the brightest.
_DEEPER, _LEAST_IN_FIELD = 3.0, 24.0
_MOST_PROPOSALS = 20_000
# Of the reach within which matches are counted: a good attitude is nearer than the reach.
_SHARES = (1.0, 0.5, 0.25)


class Identification(NamedTuple):
    """An attitude on which many stars agree.

    Attributes:
        rotation: (3, 3) camera from the catalogue's frame.
        star: (N,) index in the catalogue of each star of the image; -1 where it has none.
        by_chance: expected number of attitudes on which as many stars agree by chance.
    """

    rotation: Floats
    star: NDArray[np.int64]
    by_chance: float

    @property
    def matches(self) -> int:
        """How many stars have a name."""
        return int((self.star >= 0).sum())


def identify(
    rays: Floats,
    reach: float,
    *,
    catalog: StarCatalog | None = None,
    scale_error: float = 0.0,
    field: float = 0.0,
    corners: int = 10,
) -> Identification | None:
    """Find which stars of the catalogue are seen, and from that where the camera looks; nothing need be known of it.

    Args:
        rays: (N, 3) unit vectors in the camera's frame towards the stars of an image, the brightest first.
        reach: radians by which rays may be wrong, by the lens more than by the marks.
        catalog: the stars; kcal's own if left out.
        scale_error: share by which the focal length may be wrong.
        field: angle in radians between opposite corners of the image; by the stars themselves if left out.
        corners: how many of the brightest stars make triangles; the others only test.

    Returns:
        None where no attitude agrees with more stars than by chance: fewer than five or six stars never do.

    Example:
        >>> stars = StarCatalog.bundled()
        >>> seen = stars.directions()[np.argsort(stars.magnitude)]
        >>> ahead = seen[seen[:, 2] > 0.9][:12]
        >>> found = identify(ahead, 1e-4)
        >>> found.matches, bool(np.allclose(found.rotation, np.eye(3), atol=1e-4))
        (12, True)
    """
    rays = rays[:_TESTED]
    if len(rays) < 4:
        return None
    if not field:
        field = 2.0 * float(np.arccos(np.clip(rays @ _middle(rays), -1, 1)).max())
    table = pair_table(catalog or StarCatalog.bundled(), field)
    area = 2.0 * math.pi * (1.0 - math.cos(min(field, math.pi) / 2.0))
    in_field = max(_DEEPER * len(rays), _LEAST_IN_FIELD)
    pool = int(min(in_field * 4.0 * math.pi / area, len(table.order)))
    tree = cKDTree(table.directions[:pool])
    proposals, best = 0, None
    triples = sorted(itertools.combinations(range(min(corners, len(rays))), 3), key=lambda triple: triple[2])
    for triple in triples:
        at = list(triple)
        stars = _triangles(rays[at], table, min(pool, table.stars), reach, scale_error, _SHORTEST * field)
        if not len(stars):
            continue
        proposals += len(stars)
        found = _best_turn(
            _kabsch_turns(table.directions[stars], rays[at]), rays, tree, reach + scale_error * field / 2
        )
        if best is None or found[1] > best[1]:
            best = found
            tested = _tested(best[0], rays, tree, table, reach + scale_error * field / 2, area, proposals, pool)
            if tested is not None:
                return tested
        if proposals > _MOST_PROPOSALS:
            break
    return None


def turn_between(first: Floats, second: Floats) -> Floats:
    """(3, 3) rotation R of smallest |second - R first|² for unit vectors (N, 3) (Kabsch 1976)."""
    return _kabsch_turns(first[None], second)[0]


def _kabsch_turns(first: Floats, second: Floats) -> Floats:
    """(C, 3, 3) rotations of each of first (C, N, 3) to second (N, 3)."""
    u, _, vt = np.linalg.svd(np.einsum("ni,cnj->cij", second, first))
    u[..., 2] *= np.linalg.det(u @ vt)[:, None]
    return u @ vt


def _middle(rays: Floats) -> Floats:
    mean = rays.mean(0)
    return mean / np.linalg.norm(mean)


def _angle(first: Floats, second: Floats) -> Floats:
    return 2.0 * np.arcsin(np.clip(np.linalg.norm(first - second, axis=-1) / 2.0, 0.0, 1.0))


def _triangles(
    corners: Floats, table: PairTable, pool: int, reach: float, scale_error: float, shortest: float
) -> NDArray[np.int64]:
    """(C, 3) stars of the table whose triangle has the sides and the sense of three rays."""
    sides = [float(_angle(corners[a], corners[b])) for a, b in ((0, 1), (0, 2), (1, 2))]
    none = np.empty((0, 3), np.int64)
    if min(sides) < shortest or max(sides[:2]) > table.angle[-1]:
        return none
    lists = []
    for side in sides[:2]:
        margin = reach + scale_error * side
        # In the type of the table, all of which would be converted otherwise.
        ends = np.array([side - margin, side + margin], table.angle.dtype)
        low, high = np.searchsorted(table.angle, ends)
        pairs = table.pairs[low:high].astype(np.int64)
        lists.append(pairs[(pairs < pool).all(1)])
    first, second = lists
    second = second[np.argsort(second[:, 0], kind="stable")]
    begin = np.searchsorted(second[:, 0], first[:, 0])
    count = np.searchsorted(second[:, 0], first[:, 0], "right") - begin
    if not count.sum():
        return none
    at = np.repeat(np.arange(len(first)), count)
    partner = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(begin, count)
    stars = np.stack([first[at, 0], first[at, 1], second[partner, 1]], 1)
    third = _angle(table.directions[stars[:, 1]], table.directions[stars[:, 2]])
    stars = stars[np.abs(third - sides[2]) < reach + scale_error * sides[2]]
    sense = np.linalg.det(table.directions[stars]) * np.linalg.det(corners)
    return stars[sense > 0]


def _best_turn(rotations: Floats, rays: Floats, tree: cKDTree, reach: float) -> tuple[Floats, int]:
    """The rotation of which most rays meet a star, and how many."""
    there = np.einsum("cji,nj->cni", rotations, rays)
    distance, _ = tree.query(there.reshape(-1, 3), distance_upper_bound=reach)
    hits = np.isfinite(distance).reshape(len(rotations), -1).sum(1)
    return rotations[hits.argmax()], int(hits.max())


def _tested(
    rotation: Floats, rays: Floats, tree: cKDTree, table: PairTable, reach: float, area: float, tried: int, pool: int
) -> Identification | None:
    """The attitude refined by all stars that meet one, if chance does not explain how many do."""
    star = _met(rotation, rays, tree, reach)
    for _ in range(3):
        known = star >= 0
        if known.sum() < 4:
            return None
        rotation = turn_between(table.directions[star[known]], rays[known])
        star = _met(rotation, rays, tree, reach)
    # The share of the field that the stars there cover: those of the Milky Way are denser than elsewhere.
    axis = _middle(rays) @ rotation
    radius = 2.0 * math.asin(min(math.sqrt(area / (4.0 * math.pi)), 1.0))
    near = len(tree.query_ball_point(axis, 2.0 * math.sin(radius / 2.0)))
    density = max(near / area, pool / (4.0 * math.pi))
    distance = _angle(rays, table.directions[np.maximum(star, 0)] @ rotation.T)
    by_chance = min(
        _by_chance((star >= 0) & (distance < share * reach), min(density * math.pi * (share * reach) ** 2, 1.0))
        for share in _SHARES
    )
    by_chance *= tried * len(_SHARES)
    if by_chance > _BY_CHANCE:
        return None
    return Identification(rotation, np.where(star >= 0, table.order[np.maximum(star, 0)], -1), by_chance)


def _by_chance(met: NDArray[np.bool_], chance: float) -> float:
    """How probable it is that chance explains the matches among the brightest stars, at the number that suits it least.

    The brightest stars of an image are in the catalogue; of the many faint ones most may be too faint for it.
    """
    sizes = np.arange(4, len(met) + 1)
    # Three matches are those of the triangle.
    matches = np.cumsum(met)[sizes - 1] - 3
    return float((len(sizes) * stats.binom.sf(matches - 1, sizes - 3, chance)).min())


def _met(rotation: Floats, rays: Floats, tree: cKDTree, reach: float) -> NDArray[np.int64]:
    """(N,) the star that each ray meets, each star once (by the nearest ray); -1 for none."""
    distance, star = tree.query(rays @ rotation, distance_upper_bound=reach)
    star = np.where(np.isfinite(distance), star, -1)
    order = np.argsort(distance, kind="stable")
    _, first = np.unique(star[order], return_index=True)
    kept = np.zeros(len(star), bool)
    kept[order[first]] = True
    return np.where(kept, star, -1)
