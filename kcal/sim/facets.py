"""Paint flat convex pieces of a scene through a true lens: walls, roofs, poles, hulls, the ground.

Every pixel's line of sight is cut with the plane of the piece, and the share of the pixel that it covers follows from
the distances to its edges. Edges so lie where the lens puts them, without steps of a pixel's parts, and gray levels are
mixed as they are: a pixel half covered has the mean of both, so that blur moves no edge.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from kcal.sim.noise import smooth_noise
from kcal.sim.rectangle import PixelRectangle
from kcal.sim.truth import TruthLens
from kcal.sim.window import invert_window

Floats = NDArray[np.float64]
Color = tuple[float, ...]
_EDGE = 3  # pixels around the corners of a piece that are painted too
_FAR = 8.0  # times the distance of a piece: nothing of it is farther away
_COARSE = 8  # pixels between those that tell roughly where a large piece is
_BATCH = 200_000  # pixels inverted at a time


@dataclass(frozen=True, kw_only=True, eq=False)
class Facet:
    """A flat convex piece.

    Args:
        origin: (3,) meters in the scene's frame.
        along: (3,) unit vector of the first coordinate on the piece.
        up: (3,) unit vector of the second one, at right angles.
        outline: (K, 2) its corners on the piece in order, meters.
        color: gray levels of red, green and blue, or one for an image in gray.
        texture: share by which the color varies.
        grain: meters, size of what varies.
        windows: width and height of a field with one window in its middle, meters; None for a plain wall.
        glass: color of these windows.
        top: height of the upper edge above the outline's, for positions along it in meters; None for a straight edge.
        pattern: factor of the color where lines of sight meet the piece; None for what `texture` says.
        shadow: share of the light that is left on what is already there, in place of a color; None for a piece.
    """

    origin: Floats
    along: Floats
    up: Floats
    outline: Floats
    color: Color
    texture: float = 0.0
    grain: float = 1.0
    windows: tuple[float, float] | None = None
    glass: Color = (62.0, 72.0, 84.0)
    top: Callable[[Floats], Floats] | None = None
    pattern: Callable[[Cut], Floats] | None = None
    shadow: float | None = None

    @functools.cached_property
    def corners(self) -> Floats:
        """(K, 3) corners in the scene's frame; points along the upper edge too where it is not straight."""
        outline = self.outline
        if self.top is not None:
            along = np.linspace(outline[:, 0].min(), outline[:, 0].max(), 33)
            outline = np.concatenate([outline, np.stack([along, self.top(along)], -1)])
        at: Floats = self.origin + outline[:, :1] * self.along + outline[:, 1:] * self.up
        return at

    @functools.cached_property
    def distance(self) -> float:
        """Level distance from the scene's origin, meters; of level land that of its farthest corner.

        What is farther away is painted first; pieces at one place are painted in the order in which they were made.
        """
        at = self.corners if self.up[2] == 0 else self.origin[None]
        return float(np.hypot(at[:, 0], at[:, 1]).max())


class Eye(NamedTuple):
    """A camera in the scene.

    Attributes:
        lens: the lens.
        rotation: (3, 3) camera_from_scene.
        center: (3,) of the camera, meters in the scene's frame.
        looks: (H, W, 4) slopes of each pixel's line of sight, and where it crosses the camera's plane z = 0, meters.
    """

    lens: TruthLens
    rotation: Floats
    center: Floats
    looks: Floats

    def to_camera(self, points: Floats) -> Floats:
        """Points (..., 3) of the scene in the camera's frame."""
        moved: Floats = (points - self.center) @ self.rotation.T
        return moved

    def project(self, points: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Pixels (N, 2) of points (N, 3) of the scene, and whether the lens sees them."""
        pixels, valid = self.lens.project(torch.from_numpy(self.to_camera(points)))
        return pixels.numpy(), valid.numpy()


def eye(lens: TruthLens, rotation: Floats, center: Floats) -> Eye:
    """A camera with the lines of sight of all its pixels."""
    width, height = lens.size
    rows = max(1, _BATCH // width)
    parts = [
        invert_window(lens, PixelRectangle(0, top, width, min(rows, height - top)))[0].numpy()
        for top in range(0, height, rows)
    ]
    return Eye(lens, rotation, center, np.concatenate(parts))


def facet_windows(camera: Eye, facets: Sequence[Facet]) -> list[tuple[slice, slice] | None]:
    """Rows and columns of the image that each piece may cover; None if it is not in the image."""
    corners = [facet.corners for facet in facets]
    if not corners:
        return []
    pixels, valid = camera.project(np.concatenate(corners))
    depth = camera.to_camera(np.concatenate(corners))[:, 2]
    ends = np.cumsum([len(each) for each in corners])
    width, height = camera.lens.size
    found: list[tuple[slice, slice] | None] = []
    for low, high in zip([0, *ends[:-1]], ends, strict=True):
        if not (depth[low:high] > 0).any():
            found.append(None)
        elif not valid[low:high].all():
            found.append(_seen_part(camera, facets[len(found)]))
        else:
            first = np.maximum(np.floor(pixels[low:high].min(0)).astype(int) - _EDGE, 0)
            last = np.minimum(np.ceil(pixels[low:high].max(0)).astype(int) + _EDGE + 1, (width, height))
            seen = bool((last - first > 1).all())
            found.append((slice(first[1], last[1]), slice(first[0], last[0])) if seen else None)
    return found


def _seen_part(camera: Eye, facet: Facet) -> tuple[slice, slice] | None:
    """Rows and columns around what a coarse grid of pixels sees of a large piece that reaches out of sight."""
    height, width = camera.looks.shape[:2]
    coarse = slice(0, height, _COARSE), slice(0, width, _COARSE)
    rows, columns = np.nonzero(_covered(facet, cut(camera, facet, coarse)))
    if not len(rows):
        return None
    return tuple(  # type: ignore[return-value]
        slice(max(0, _COARSE * (int(at.min()) - 1)), min(size, _COARSE * (int(at.max()) + 2)))
        for at, size in ((rows, height), (columns, width))
    )


class Haze(NamedTuple):
    """Air between the camera and things.

    Attributes:
        color: of the air.
        length: meters after which 37 % of a contrast is left.
    """

    color: Color
    length: float

    def seen(self, color: Floats, distance: Floats) -> Floats:
        """Colors (..., 3) of things at distances (...,) in meters."""
        clear = np.exp(-np.maximum(distance, 0.0) / self.length)[..., None]
        air: Floats = np.array(self.color) + clear * (color - np.array(self.color))
        return air


class Cut(NamedTuple):
    """Where the lines of sight of a window of pixels meet the plane of a piece; each is (H, W).

    Attributes:
        along: meters along the piece.
        up: meters up.
        far: meters from the camera; negative behind it.
        slopes: change of `along` down and across, and of `up` down and across, per pixel; or (1, 1) for all pixels.
    """

    along: Floats
    up: Floats
    far: Floats
    slopes: tuple[Floats, Floats, Floats, Floats]

    def part(self, window: tuple[slice, ...]) -> Cut:
        """The same in rows and columns of the window."""
        down, across, up_down, up_across = (each if each.size == 1 else each[window] for each in self.slopes)
        slopes = down, across, up_down, up_across
        return Cut(self.along[window], self.up[window], self.far[window], slopes)

    def slope(self, by_along: float, by_up: float) -> Floats:
        """Change per pixel of `by_along` along + `by_up` up, in the direction in which it is largest."""
        down, across, up_down, up_across = self.slopes
        steep: Floats = np.hypot(by_along * down + by_up * up_down, by_along * across + by_up * up_across)
        return np.maximum(steep, 1e-12)


def cut(camera: Eye, facet: Facet, window: tuple[slice, slice], *, small: bool = False) -> Cut:
    """Cut the lines of sight of a window with the plane of a piece; all pieces on that plane share the result.

    In a small window slopes are taken as the same everywhere, which widens edges by a few percent and moves none.
    """
    origin = camera.to_camera(facet.origin)
    along, up = camera.rotation @ facet.along, camera.rotation @ facet.up
    normal = np.cross(along, up)
    looks = camera.looks[window]
    x, y, start_x, start_y = (looks[..., i] for i in range(4))
    toward = normal[0] * x + normal[1] * y + normal[2]
    depth = (normal @ origin - normal[0] * start_x - normal[1] * start_y) / np.where(toward == 0, 1e-12, toward)
    depth = np.clip(depth, -1e7, 1e7)
    at_x, at_y, at_z = start_x + depth * x - origin[0], start_y + depth * y - origin[1], depth - origin[2]
    a = along[0] * at_x + along[1] * at_y + along[2] * at_z
    b = up[0] * at_x + up[1] * at_y + up[2] * at_z
    far = depth * np.sqrt(1 + x**2 + y**2)
    if not small:
        return Cut(a, b, far, (*np.gradient(a), *np.gradient(b)))
    down, across, up_down, up_across = (
        np.array([[np.diff(values.mean(1 - axis)).mean()]]) for values in (a, b) for axis in (0, 1)
    )
    return Cut(a, b, far, (down, across, up_down, up_across))


def paint(part: Floats, facet: Facet, at: Cut, haze: Haze) -> Floats:
    """Paint a piece over a part (H, W, 3) of an image, whose lines of sight were cut with its plane.

    Returns:
        share (H, W) of each pixel that it covers.
    """
    share = _covered(facet, at)
    if not share.any():
        return share
    if facet.shadow is not None:
        # The light of the air in front of it stays.
        part -= share[..., None] * (1.0 - facet.shadow) * (part - haze.seen(np.zeros(part.shape[-1]), at.far))
        return share
    color = np.array(facet.color)
    if facet.windows is not None:
        color = color + _windows(facet, at)[..., None] * (np.array(facet.glass) - color)
    if facet.texture:
        # What is finer than a pixel is not seen.
        fine = np.clip(facet.grain / at.slope(1.0, 0.0), 0.0, 1.0)
        waves = smooth_noise(at.along / facet.grain, at.up / facet.grain)
        color = color * (1 + facet.texture * fine * waves)[..., None]
    if facet.pattern is not None:
        color = color * facet.pattern(at)[..., None]
    part += share[..., None] * (haze.seen(color, at.far) - part)
    return share


def _covered(facet: Facet, at: Cut) -> Floats:
    """Share of each pixel that the piece covers."""
    # Toward the horizon a level plane has no end.
    share = ((at.far > 0) & (at.far < _FAR * facet.distance)).astype(np.float64)
    corners = facet.outline
    following = np.roll(corners, -1, 0)
    turn = np.sign(np.sum(corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]))
    for (x, y), (next_x, next_y) in zip(corners, following, strict=True):
        # Inside is to the left of each edge if the corners turn left.
        by_along, by_up = -turn * (next_y - y), turn * (next_x - x)
        inside = by_along * (at.along - x) + by_up * (at.up - y)
        share *= np.clip(0.5 + inside / at.slope(by_along, by_up), 0.0, 1.0)
    if facet.top is not None:
        share *= np.clip(0.5 + (facet.top(at.along) - at.up) / at.slope(0.0, 1.0), 0.0, 1.0)
    return share


def _windows(facet: Facet, at: Cut) -> Floats:
    """Share of each pixel that is glass."""
    assert facet.windows is not None
    share = np.ones_like(at.far)
    for values, period, axis in zip((at.along, at.up), facet.windows, ((1.0, 0.0), (0.0, 1.0)), strict=True):
        wide = at.slope(*axis) / period
        low, high = (_glass_before(values / period + sign * 0.5 * wide) for sign in (-1, 1))
        share *= (high - low) / wide
    return share


def _glass_before(t: Floats) -> Floats:
    """Length of glass up to a position in periods: the middle half of each."""
    whole = np.floor(t)
    before: Floats = 0.5 * whole + np.clip(t - whole - 0.25, 0.0, 0.5)
    return before
