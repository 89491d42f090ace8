"""Where a camera's line of sight reaches a stated height or the ground, by which one camera alone is enough."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcal.locate.geodesy import place_enu
from kcal.locate.ground import Ground, first_meeting, search_distances
from kcal.locate.views import StatedHeight

# Steps to a stated height; each leaves a thousandth.
_HEIGHT_STEPS = 3
# Meters: how far a line of sight is followed until it meets the ground.
_FARTHEST = 60_000.0


class EarthFrame(NamedTuple):
    """How the frame of a rig lies on the Earth, and how light bends there.

    Attributes:
        up: (C, 3) the vertical at each camera, in the frame.
        heights: (C,) of the cameras above the ellipsoid, meters.
        ecef_from_enu: (3, 3).
        ecef_of_origin: (3,) meters.
        refraction: coefficient k.
        half_curvature: 1 / 2R, 1/m.
    """

    up: Tensor
    heights: Tensor
    ecef_from_enu: Tensor
    ecef_of_origin: Tensor
    refraction: float
    half_curvature: float


def stated_ahead(
    frame: EarthFrame,
    place: Tensor,
    ray: Tensor,
    first: Tensor,
    alone: Tensor,
    *,
    height: Tensor | Ground,
    sigma: float,
    differentiated: bool,
) -> StatedHeight:
    """Where rays (N, 3) from places of cameras first reach heights (N,) above the ellipsoid, or the ground.

    Args:
        frame: on the Earth.
        place: (N, 3) centers of cameras.
        ray: (N, 3) directions.
        first: (N, C) bool: whose they are.
        alone: (N,) what one camera alone saw.
        height: (N,) meters, or the ground.
        sigma: of the height, meters.
        differentiated: derivatives by heights and frame are wanted; `StatedHeight.off` has them.
    """
    still = frame._replace(**{name: v.detach() for name, v in frame._asdict().items() if isinstance(v, Tensor)})  # type: ignore[arg-type]
    at = still, place.detach(), ray.detach(), first, alone
    found = (
        _height_ahead(*at, height.detach(), sigma) if isinstance(height, Tensor) else _ground_ahead(*at, height, sigma)
    )
    with torch.set_grad_enabled(differentiated):
        point = found.point @ frame.ecef_from_enu.mT + frame.ecef_of_origin
        off = (found.up * ((point - point.detach()) @ still.ecef_from_enu)).sum(-1)
        if isinstance(height, Tensor):
            off = off - torch.where(found.reached, height - height.detach(), 0.0)
    return found._replace(off=off)


def _ground_ahead(
    frame: EarthFrame, place: Tensor, ray: Tensor, first: Tensor, alone: Tensor, ground: Ground, sigma: float
) -> StatedHeight:
    """Where rays (N, 3) from places of cameras meet the ground for the first time, of those that are `alone`."""
    wanted = alone.nonzero()[:, 0]
    start, sight, up = place[wanted], ray[wanted], first[wanted].to(torch.float64) @ frame.up
    bent = frame.refraction * frame.half_curvature * (1.0 - (sight * up).sum(-1).square())
    anchored = frame.ecef_from_enu, frame.ecef_of_origin

    def along(distance: Tensor, rows: Tensor) -> Tensor:
        own = [value[rows].reshape(len(rows), *[1] * (distance.ndim - 1), 3) for value in (start, sight, up)]
        fall = bent[rows].reshape(len(rows), *[1] * (distance.ndim - 1)) * distance.square()
        return own[0] + distance[..., None] * own[1] - fall[..., None] * own[2]

    def above(points: Tensor) -> Tensor:
        lat, lon, height = place_enu(points, *anchored).unbind(-1)
        return height - ground(lat, lon)

    step = getattr(ground, "cell_m", None)
    found = first_meeting(along, above, len(wanted), search_distances(_FARTHEST, step))
    met = torch.zeros_like(alone)
    met[wanted] = found.met
    point, normal = place + ray, torch.zeros_like(place)
    point[wanted] = torch.where(found.met[:, None], found.point, point[wanted])
    normal[wanted] = torch.where(found.met[:, None], found.normal, 0.0)
    return StatedHeight(point, normal, torch.full_like(place[:, 0], sigma), met)


def _height_ahead(
    frame: EarthFrame, place: Tensor, ray: Tensor, first: Tensor, alone: Tensor, height: Tensor, sigma: float
) -> StatedHeight:
    """Where rays (N, 3) from places of cameras reach heights (N,) above the ellipsoid for the first time."""
    del alone  # what several cameras saw is computed too, and not used
    one = first.to(torch.float64)
    up, own = one @ frame.up, one @ frame.heights
    target = torch.where(torch.isfinite(height), height, own)
    climb = (ray * up).sum(-1)
    # Above the ellipsoid, a line of sight rises by the distance's square over twice the radius of its curve.
    curve = frame.half_curvature * (1.0 - frame.refraction) * (1.0 - climb * climb)
    drop = own - target
    root = climb * climb - 4.0 * curve * drop
    reached = torch.isfinite(height) & (drop > 0) & (climb < 0) & (root > 0)
    far = torch.where(reached, 2.0 * drop / (torch.sqrt(torch.where(reached, root, 1.0)) - climb), 1.0)
    for _ in range(_HEIGHT_STEPS):
        bent = frame.refraction * frame.half_curvature * (1.0 - climb * climb) * far * far
        point = place + far[..., None] * ray - bent[..., None] * up
        off = place_enu(point, frame.ecef_from_enu, frame.ecef_of_origin)[..., 2] - target
        slope = torch.where(reached, climb + 2.0 * curve * far, -1.0)
        far = far - torch.where(reached, off, 0.0) / slope
    away = point - place
    level = away - (away * up).sum(-1, keepdim=True) * up
    return StatedHeight(point, up + 2.0 * frame.half_curvature * level, torch.full_like(height, sigma), reached)
