"""The 95 % region of a position as a ring on the map: an ellipse in inverse range, skewed outward in meters."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.locate.geodesy import enu_to_geodetic
from kcal.locate.positions import Located, Position

REGION_SHARE = 0.95
_RING_POINTS = 72
# An ellipse that comes this close to the camera, in shares of the distance, has no inverse to speak of.
_TOO_WIDE = 0.85

Ring = list[tuple[float, float]]


def region_outline(enu: Tensor, covariance: Tensor, share: float = REGION_SHARE) -> Tensor:
    """Outline of the horizontal region that contains the true position with a probability of `share`.

    The ellipse is drawn where errors are Gaussian, in X / |X|² of the horizontal position, and carried back.

    Args:
        enu: (3,) meters from the left camera.
        covariance: (3, 3) to first order.
        share: probability.

    Returns:
        (72, 2) east, north in meters, counterclockwise.

    Example:
        >>> spread = torch.diag(torch.tensor([0.1, 200.0, 0.1], dtype=torch.float64) ** 2)
        >>> outline = region_outline(torch.tensor([0.0, 5000.0, 0.0]), spread)
        >>> outline[:, 1].min().round().item(), outline[:, 1].max().round().item()
        (4554.0, 5543.0)
    """
    place, spread = enu[:2].double(), covariance[:2, :2].double()
    reach = math.sqrt(-2.0 * math.log(1.0 - share))
    angle = torch.linspace(0, 2 * math.pi, _RING_POINTS + 1, dtype=torch.float64)[:-1]
    circle = reach * torch.stack([torch.cos(angle), torch.sin(angle)], -1)
    squared = float(place @ place)
    radial = math.sqrt(float(place @ spread @ place)) / squared if squared > 0 else math.inf
    if reach * radial > _TOO_WIDE:
        ring = place + circle @ _covariance_root(spread).T
    else:
        still = torch.eye(2, dtype=torch.float64)
        slope = (still - 2.0 * torch.outer(place, place) / squared) / squared
        inverse = place / squared + circle @ _covariance_root(slope @ spread @ slope.T).T
        ring = inverse / (inverse * inverse).sum(-1, keepdim=True)
    following = ring.roll(-1, 0)
    area = (ring[:, 0] * following[:, 1] - ring[:, 1] * following[:, 0]).sum()
    return ring if float(area) > 0 else ring.flip(0)


def _covariance_root(matrix: Tensor) -> Tensor:
    values, vectors = torch.linalg.eigh(matrix)
    return vectors * values.clamp_min(0.0).sqrt()


def region_rings(located: Located) -> list[tuple[Position, Ring]]:
    """Each position with its ring: (latitude, longitude), closed, counterclockwise, longitudes without a jump."""
    found = []
    for position in located.positions:
        if position.enu is None or position.covariance is None:
            continue
        outline = region_outline(torch.tensor(position.enu), torch.tensor(position.covariance, dtype=torch.float64))
        up = torch.full((len(outline), 1), position.enu[2], dtype=torch.float64)
        geodetic = enu_to_geodetic(torch.cat([outline, up], -1), located.origin)
        ring = [(lat, near(lon, position.lon or 0.0)) for lat, lon, _ in geodetic.tolist()]
        found.append((position, [*ring, ring[0]]))
    return found


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
