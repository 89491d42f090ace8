"""The 95 % region of a position as a ring on the map: an ellipse in inverse range, skewed outward in meters."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.lens.mounting import Origin
from kcal.locate.columns import NUMBERS, PositionColumns
from kcal.locate.ellipsoid import latitude_longitude
from kcal.locate.geodesy import anchor
from kcal.locate.positions import Located

REGION_SHARE = 0.95
# In files, of the degrees of a region's corners: 0.1 mm (RFC 7946, section 11.2). Positions keep all digits. The last
# digits of functions such as the arc tangent depend on how many values are computed at once.
CORNER_DECIMALS = 9
_RING_POINTS = 72
# An ellipse that comes this close to the camera, in shares of the distance, has no inverse to speak of.
_TOO_WIDE = 0.85
# Regions at once: fewer cost more calls, more do not fit the cache.
_AT_ONCE = 512

Ring = list[tuple[float, float]]


def region_outline(enu: Tensor, covariance: Tensor, share: float = REGION_SHARE, *, plain: bool = False) -> Tensor:
    """Outlines of the horizontal regions that contain the true positions with a probability of `share`.

    The ellipse is drawn where errors are Gaussian, in X / |X|² of the horizontal position, and carried back.

    Args:
        enu: (..., 3) meters from the left camera.
        covariance: (..., 3, 3) to first order.
        share: probability.
        plain: ellipses in meters: of lines of sight from several places.

    Returns:
        (..., 72, 2) east, north in meters, counterclockwise.

    Example:
        >>> spread = torch.diag(torch.tensor([0.1, 200.0, 0.1], dtype=torch.float64) ** 2)
        >>> outline = region_outline(torch.tensor([0.0, 5000.0, 0.0]), spread)
        >>> outline[:, 1].min().round().item(), outline[:, 1].max().round().item()
        (4554.0, 5543.0)
    """
    return torch.stack(_level_outline(enu[..., :2].double(), covariance[..., :2, :2].double(), share, plain), -1)


def _level_outline(place: Tensor, spread: Tensor, share: float, plain: bool = False) -> tuple[Tensor, Tensor]:
    """East and north (..., 72) each: one by one they take a third of the time. `plain`: ellipses in meters."""
    squared = place.square().sum(-1)
    some = torch.where(squared > 0, squared, 1.0)
    reach = math.sqrt(-2.0 * math.log(1.0 - share))
    along = (place * (spread @ place[..., None])[..., 0]).sum(-1)
    wide = (squared == 0) | (reach * along.sqrt() > _TOO_WIDE * squared) | plain
    still = torch.eye(2, dtype=torch.float64)
    slope = (still - 2.0 * place[..., :, None] * place[..., None, :] / some[..., None, None]) / some[..., None, None]
    root = _covariance_root(torch.where(wide[..., None, None], spread, slope @ spread @ slope.mT))
    middle = torch.where(wide[..., None], place, place / some[..., None])
    # The inversion turns the sense of rotation, and the root may.
    clockwise = (torch.linalg.det(root) > 0) != wide
    angle = torch.linspace(0, 2 * math.pi, _RING_POINTS + 1, dtype=torch.float64)[:-1]
    cosine, sine = reach * torch.stack([angle, angle.flip(0)]).cos(), reach * torch.stack([angle, angle.flip(0)]).sin()
    cosine, sine = cosine[clockwise.long()], sine[clockwise.long()]
    east = middle[..., :1] + root[..., :1, 0] * cosine + root[..., :1, 1] * sine
    north = middle[..., 1:] + root[..., 1:, 0] * cosine + root[..., 1:, 1] * sine
    length = torch.where(wide[..., None], 1.0, (east * east + north * north).clamp_min(1e-300))
    return east / length, north / length


def _covariance_root(matrix: Tensor) -> Tensor:
    values, vectors = torch.linalg.eigh(matrix)
    return vectors * values.clamp_min(0.0).sqrt()[..., None, :]


def region_rings(located: Located) -> list[Ring]:
    """The ring of each position: (latitude, longitude), closed, counterclockwise, longitudes without a jump."""
    blocks = ring_blocks(located.columns, located.origin, plain=located.feet is not None)
    return [[(lat, lon) for lat, lon in ring] for block in blocks for ring in block.tolist()]


def ring_blocks(columns: PositionColumns, origin: Origin, *, plain: bool = False) -> Iterator[NDArray[np.float64]]:
    """The rings (M, 73, 2) of those rows that have a position, some rows at a time.

    Only lines of sight from one place skew a region; `plain` ones are ellipses.
    """
    upper = NUMBERS.index("cov_ee_m2") + np.array([[0, 1], [1, 3]])
    rotation, translation = anchor(origin)
    located = torch.from_numpy(columns.numbers[columns.located])
    # Splitting no rows gives one part, of no rows.
    for part in located.split(_AT_ONCE) if len(located) else ():
        east, north, up, lon_of_point = (part[:, NUMBERS.index(name)] for name in ("east_m", "north_m", "up_m", "lon"))
        outline = _level_outline(torch.stack([east, north], -1), part[:, upper], REGION_SHARE, plain)
        x, y, z = (
            row[0] * outline[0] + row[1] * outline[1] + (row[2] * up[:, None] + offset)
            for row, offset in zip(rotation, translation, strict=True)
        )
        lat, lon = latitude_longitude(x, y, z)
        lon = lon + 360.0 * torch.round((lon_of_point[:, None] - lon) / 360.0)
        yield torch.stack([torch.cat([value, value[:, :1]], 1) for value in (lat, lon)], -1).numpy()


def near(lon: float, other: float) -> float:
    """The longitude by which `lon` lies less than half a turn from `other`: beyond ±180 across the antimeridian."""
    return lon + 360.0 * round((other - lon) / 360.0)


def cut_at_antimeridian(ring: Sequence[tuple[float, float]]) -> list[Ring]:
    """A ring whose longitudes run beyond ±180 as one or two rings within ±180 (RFC 7946, section 3.1.9)."""
    edge = 180.0 if max(lon for _, lon in ring) > 180.0 else -180.0
    sides = []
    for outer in (False, True):
        kept: Ring = []
        for (lat0, lon0), (lat1, lon1) in itertools.pairwise(ring):
            out0, out1 = abs(lon0) > 180.0, abs(lon1) > 180.0
            if out0 == outer:
                kept.append((lat0, lon0))
            if out0 != out1:
                share = (edge - lon0) / (lon1 - lon0)
                kept.append((lat0 + share * (lat1 - lat0), edge))
        if kept:
            turn = -math.copysign(360.0, edge) if outer else 0.0
            kept = [(lat, lon + turn) for lat, lon in kept]
            sides.append([*kept, kept[0]])
    return sides
