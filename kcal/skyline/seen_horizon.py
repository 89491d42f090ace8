"""Compare the border of an image with the horizon of a terrain: residuals in pixels and how they change."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from kcal.lens.camera import Camera
from kcal.lens.pose import step_rows
from kcal.lens.projection import project_components
from kcal.skyline.horizon import Horizon

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Meters: so far away a camera sees a horizon; entrance pupils do not matter there.
_FAR = 1e9


class Columns(NamedTuple):
    """Clear columns of a border with their rays.

    Attributes:
        pixel: (N, 2).
        sigma: (N,) px, along the column.
        ray: (N, 3) unit vectors in the camera's axes.
    """

    pixel: Floats
    sigma: Floats
    ray: Floats

    def some(self, chosen: Bools | NDArray[np.int64]) -> Columns:
        """Some of them."""
        return Columns(*(part[chosen] for part in self))


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """Residuals of columns across the skyline, positive where the image's is above the raster's.

    Args:
        residual: (N,) px.
        sigma: (N,) px, of the image.
        by_turn: (N, 3) derivatives by a turn about the camera's axes, which comes after the rotation.
        by_elevation: (N,) by a higher horizon, px/rad.
        by_shift: (N, 3) by a camera that stands elsewhere, px/m, along east, north, up of the eye.
        by_lens: (N, P) by the parameters of the camera; none if they were not asked for.
        elevation: (N,) radians, of the horizon.
        distance: (N,) level meters to it.
        point: (N, 3) meters, where it stands from the eye.
        raised: (N,) radians by which errors of the raster change it on average.
        blunted: (N,) meters by which its cells may have lowered it.
        known: (N,) whether the raster has a horizon there.
    """

    residual: Floats
    sigma: Floats
    by_turn: Floats
    by_elevation: Floats
    by_shift: Floats
    by_lens: Floats
    elevation: Floats
    distance: Floats
    point: Floats
    raised: Floats
    blunted: Floats
    known: Bools

    @classmethod
    def together(cls, parts: Sequence[Comparison]) -> Comparison:
        """Columns of several images after each other, without derivatives by their lenses."""
        names = [field.name for field in dataclasses.fields(cls) if field.name != "by_lens"]
        found = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        return cls(**found, by_lens=np.zeros((len(found["residual"]), 0)))

    def by_height(self) -> Floats:
        """(N,) by the raster's height there, px/m."""
        found: Floats = self.by_elevation * np.square(np.cos(self.elevation)) / self.distance
        return found

    def by_refraction(self, radius: float) -> Floats:
        """(N,) by the coefficient of refraction, px, over the Earth's radius in meters."""
        found: Floats = self.by_elevation * self.distance / (2.0 * radius)
        return found


def compare(columns: Columns, horizon: Horizon, rotation: Floats, camera: Camera, *, lens: bool = False) -> Comparison:
    """Compare borders with a horizon.

    Args:
        columns: of the border.
        horizon: in the axes of the eye.
        rotation: (3, 3) the camera's axes from east, north, up of the eye.
        camera: which lens.
        lens: also find derivatives by its parameters.
    """
    heading = columns.ray @ rotation
    step = horizon.azimuth[1] - horizon.azimuth[0]
    begin = horizon.azimuth[0]
    azimuth = begin + np.remainder(np.arctan2(heading[:, 0], heading[:, 1]) - begin, 2.0 * math.pi)
    at = (azimuth - begin) / step
    left = np.clip(np.floor(at), 0, len(horizon.azimuth) - 2).astype(int)
    share = at - left
    inside = (share >= 0.0) & (share <= 1.0)
    share = np.clip(share, 0.0, 1.0)
    elevation = (1.0 - share) * horizon.elevation[left] + share * horizon.elevation[left + 1]
    slope = (horizon.elevation[left + 1] - horizon.elevation[left]) / step
    near = left + (share > 0.5)
    known = inside & horizon.known[left] & horizon.known[left + 1] & np.isfinite(elevation)
    elevation = np.where(known, elevation, np.arcsin(np.clip(heading[:, 2], -1.0, 1.0)))
    slope = np.where(known, slope, 0.0)
    sine, cosine, low, up = np.sin(azimuth), np.cos(azimuth), np.cos(elevation), np.sin(elevation)
    toward = np.stack([sine * low, cosine * low, up])
    by_azimuth = np.stack([cosine * low, -sine * low, 0.0 * low])
    by_elevation = np.stack([-sine * up, -cosine * up, low])
    turned = torch.from_numpy(_FAR * rotation @ toward)
    wanted = range(camera.params.shape[-1]) if lens else ()
    seen = project_components(turned, camera.params.detach(), camera.model, wanted)
    known &= seen.regular.numpy()
    off = columns.pixel.T - seen.pixels.numpy()
    # (3, 2, N) of pixels by a direction in east, north, up.
    by_toward = np.einsum("jk,jun->kun", _FAR * rotation, seen.by_point.numpy())

    def moved(direction: Floats) -> Floats:
        found: Floats = np.einsum("kun,kn->un", by_toward, direction)
        return found

    # Across the skyline as the camera sees it, and upwards.
    along, higher = moved(by_azimuth + slope * by_elevation), moved(by_elevation)
    across = np.stack([along[1], -along[0]]) / np.maximum(np.hypot(*along), 1e-12)
    across = across * np.where((across * higher).sum(0) < 0.0, -1.0, 1.0)

    def of(motion: Floats) -> Floats:
        found: Floats = -np.einsum("...un,un->n...", motion, across)
        return found

    # A column's border has its error along the column.
    distance = np.where(known, horizon.distance[near], 1.0)
    # A camera farther in the east, north, up sees what stands still turned and lower, and what it nears higher.
    aside = (-cosine, sine, np.zeros_like(sine))
    risen = (low * up * sine, low * up * cosine, -np.square(low))
    shift = [(by_azimuth * a + by_elevation * e) / distance for a, e in zip(aside, risen, strict=True)]
    return Comparison(
        residual=(off * across).sum(0),
        sigma=columns.sigma * np.abs(across[1]),
        by_turn=of(step_rows(seen.by_point, turned)[:3].numpy()),
        by_elevation=of(higher),
        by_shift=np.stack([of(moved(one)) for one in shift], -1),
        by_lens=of(seen.by_camera.numpy()) if lens else np.zeros((len(azimuth), 0)),
        elevation=elevation,
        distance=distance,
        point=np.where(known[:, None], horizon.point[near], 0.0),
        raised=horizon.raised[near],
        blunted=horizon.blunted[near],
        known=known,
    )


def columns_of(row: Floats, sigma: Floats, camera: Camera) -> Columns:
    """Clear columns of a border (W,), those with a ray."""
    clear = np.isfinite(row)
    pixel = np.stack([np.flatnonzero(clear).astype(np.float64), row[clear]], -1)
    rays, valid = camera.unproject(torch.from_numpy(pixel))
    found = Columns(pixel, sigma[clear], (rays / rays.norm(dim=-1, keepdim=True)).numpy())
    return found.some(valid.numpy())
