"""What the ground hides: lines of sight over a surface of heights, with the Earth's curve and bent light."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.mounting import Origin
from kcal.locate.geodesy import anchor, place_enu
from kcal.locate.ground import Ground

# Samples of the ground, and along the rays of one place: beyond, the steps get coarser.
_MOST_SAMPLES = 16_000_000
# Where the ground is, from a point on the tangent plane: each step leaves a thousandth.
_STEPS = 2


class GroundSurface(NamedTuple):
    """Ground in the axes east, north, up of an origin, on a grid of equal steps.

    Attributes:
        up: (rows, columns) meters up of the tangent plane, NaN where the ground is not known.
        corner: east and north of `up[0, 0]`, meters.
        step: meters.
        below: (rows, columns) meters above the ellipsoid.
    """

    up: Tensor
    corner: tuple[float, float]
    step: float
    below: Tensor

    def at(self, east: Tensor, north: Tensor, heights: bool = False) -> Tensor:
        """`up` (or heights above the ellipsoid) between the points of the grid; NaN outside."""
        rows, columns = self.up.shape
        x = 2.0 * (east - self.corner[0]) / (self.step * (columns - 1)) - 1.0
        y = 2.0 * (north - self.corner[1]) / (self.step * (rows - 1)) - 1.0
        table = (self.below if heights else self.up)[None, None]
        found = torch.nn.functional.grid_sample(table, torch.stack([x, y], -1).reshape(1, 1, -1, 2), align_corners=True)
        inside = (x.abs() <= 1.0) & (y.abs() <= 1.0)
        return torch.where(inside, found.reshape(x.shape), math.nan)


def surface_of(ground: Ground, origin: Origin, low: Tensor, high: Tensor, step: float) -> GroundSurface:
    """Sample ground over a rectangle.

    Args:
        ground: from `kcal.locate.level_ground` or `terrain`.
        origin: of the axes.
        low: (2,) east and north of its southwestern corner, meters.
        high: (2,) of its northeastern corner.
        step: meters between samples; larger where there would be more than 16 million.

    Example:
        >>> from kcal.locate.ground import level_ground
        >>> there = Origin(lat=45.0, lon=6.0, height=0.0)
        >>> sea = surface_of(level_ground(0.0), there, torch.tensor([-9e3, -9e3]), torch.tensor([9e3, 9e3]), 1e3)
        >>> sea.at(torch.tensor([0.0, 8000.0]).double(), torch.zeros(2).double()).round(decimals=1).abs().tolist()
        [0.0, 5.0]
    """
    span = (high - low).double()
    step = max(step, math.sqrt(float(span.prod()) / _MOST_SAMPLES))
    columns, rows = (math.ceil(float(side) / step) + 1 for side in span)
    east = float(low[0]) + step * torch.arange(columns, dtype=torch.float64)
    north = float(low[1]) + step * torch.arange(rows, dtype=torch.float64)
    y, x = torch.meshgrid(north, east, indexing="ij")
    up, place = torch.zeros_like(x), anchor(origin)
    for _ in range(_STEPS):
        lat, lon, height = place_enu(torch.stack([x, y, up], -1), *place).unbind(-1)
        below = ground(lat, lon)
        up = torch.where(below.isfinite(), up + below - height, up)
    return GroundSurface(torch.where(below.isfinite(), up, math.nan), (float(low[0]), float(low[1])), step, below)


@torch.no_grad()
def seen_over(surface: GroundSurface, eye: Tensor, points: Tensor, bending: float) -> Tensor:
    """(N,) whether points are seen from an eye over the ground; unknown ground hides nothing.

    The highest slope up to each distance is found along rays in all directions, as far apart as the grid's points;
    a point is compared with the nearest ray, up to one step before it.

    Args:
        surface: the ground.
        eye: (3,) east, north, up, meters.
        points: (N, 3).
        bending: k / 2R, 1/m: light from the level distance d comes from bending · d² too high.
    """
    away = points[:, :2] - eye[:2]
    distance = torch.linalg.vector_norm(away, dim=-1)
    farthest = float(distance.nan_to_num().max())
    step = max(surface.step, math.sqrt(2.0 * math.pi / _MOST_SAMPLES) * farthest)
    if farthest <= step:
        return torch.ones_like(distance, dtype=torch.bool)
    rays = math.ceil(2.0 * math.pi * farthest / step)
    angle = 2.0 * math.pi / rays * torch.arange(rays, dtype=torch.float64)
    reach = step * torch.arange(1, int(farthest / step) + 1, dtype=torch.float64)
    up = surface.at(eye[0] + angle.sin()[:, None] * reach, eye[1] + angle.cos()[:, None] * reach)
    slope = ((up - eye[2]) / reach + bending * reach).nan_to_num(nan=-math.inf, neginf=-math.inf)
    highest = slope.cummax(-1).values
    known = distance.isfinite()
    way = torch.where(known, torch.atan2(away[:, 0], away[:, 1]), 0.0)
    ray = (way * (rays / (2.0 * math.pi))).round().long() % rays
    before = (torch.where(known, distance, 0.0) / step).long() - 2
    own = (points[:, 2] - eye[2]) / distance.clamp_min(1e-9) + bending * distance
    horizon = highest[ray, before.clamp(0, len(reach) - 1)]
    return known & ((before < 0) | (own >= horizon))


def eye_height(surface: GroundSurface, name: str, eye: Tensor) -> None:
    """Raise `InputError` if an eye (3,) is below the ground."""
    ground = float(surface.at(eye[:1], eye[1:2])[0])
    if float(eye[2]) < ground:
        raise InputError(
            f"site {name}: it stands {ground - float(eye[2]):.1f} m below the ground of the terrain; is its height "
            "above the ellipsoid, as the terrain's is? A column mast (meters above the ground) needs no height"
        )
