"""A coast to look at: noise, facets, objects that stand on it, and what is behind."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from kcal.sim.scene import invert_window
from kcal.sim.truth import PixelRectangle, TruthLens

# Smooth random fields that have a value everywhere: clouds, waves, rock, grass.

Floats = NDArray[np.float64]
_SIZE = 256


@functools.cache
def _random_lattice() -> NDArray[np.float32]:
    return np.random.default_rng(7).uniform(-1.0, 1.0, _SIZE * _SIZE).astype(np.float32)


def smooth_noise(x: Floats, y: Floats, octaves: int = 3) -> Floats:
    """Values about -1 to 1 at positions of any shape; details are one wide, and half and a quarter for more octaves.

    Random values on a lattice are joined smoothly (K. Perlin's value noise), each octave with half the weight.

    Example:
        >>> x = np.linspace(0.0, 3.0, 4)
        >>> smooth_noise(x, x, octaves=1).shape
        (4,)
    """
    total: Floats = np.zeros(np.broadcast(x, y).shape)
    for octave in range(octaves):
        scale = 2.0**octave
        total += _one_octave(x * scale + 17.3 * octave, y * scale + 5.1 * octave) / scale
    return total / (2.0 - 2.0 ** (1 - octaves))


def _one_octave(x: Floats, y: Floats) -> NDArray[np.float32]:
    lattice = _random_lattice()
    column, row = np.floor(x), np.floor(y)
    u, v = (x - column).astype(np.float32), (y - row).astype(np.float32)
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    left, top = column.astype(np.int32) % _SIZE, row.astype(np.int32) % _SIZE * _SIZE
    right, bottom = (left + 1) % _SIZE, (top + _SIZE) % lattice.size
    upper = lattice[top + left]
    upper += u * (lattice[top + right] - upper)
    lower = lattice[bottom + left]
    lower += u * (lattice[bottom + right] - lower)
    return upper + v * (lower - upper)


# Paint flat convex pieces of a scene through a true lens: walls, roofs, poles, hulls, the ground.
#
# Every pixel's line of sight is cut with the plane of the piece, and the share of the pixel that it covers follows from
# the distances to its edges. Edges so lie where the lens puts them, without steps of a pixel's parts, and gray levels
# are mixed as they are: a pixel half covered has the mean of both, so that blur moves no edge.

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
        return self.origin + outline[:, :1] * self.along + outline[:, 1:] * self.up

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
        return (points - self.center) @ self.rotation.T

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
    """Air between the camera and objects.

    Attributes:
        color: of the air.
        length: meters after which 37 % of a contrast is left.
    """

    color: Color
    length: float

    def seen(self, color: Floats, distance: Floats) -> Floats:
        """Colors (..., 3) of objects at distances (...,) in meters."""
        clear = np.exp(-np.maximum(distance, 0.0) / self.length)[..., None]
        return np.array(self.color) + clear * (color - np.array(self.color))


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
        """The part of this cut in some rows and columns of the window."""
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
    return 0.5 * whole + np.clip(t - whole - 0.25, 0.0, 0.5)


# Objects on a coast, made of flat pieces: panels, poles, buildings, ridges, ships.

UP = np.array([0.0, 0.0, 1.0])
BLACK: Color = (34.0, 36.0, 40.0)
WHITE: Color = (236.0, 236.0, 232.0)
Box = tuple[float, float, float, float]


def box_outline(box: Box) -> Floats:
    """Corners (4, 2) of left, bottom, right, top."""
    left, bottom, right, top = box
    return np.array([[left, bottom], [right, bottom], [right, top], [left, top]], dtype=np.float64)


def facing(
    place: Floats, outline: Floats, color: Color, *, turn: float = 0.0, texture: float = 0.0, grain: float = 1.0,
    windows: tuple[float, float] | None = None, top: Callable[[Floats], Floats] | None = None,
) -> Facet:  # fmt: skip
    """An upright piece at a place (3,) that faces the scene's origin, or is turned from that by some degrees."""
    angle = math.atan2(place[0], place[1]) + math.radians(turn)
    along = np.array([math.cos(angle), -math.sin(angle), 0.0])
    return Facet(
        origin=place, along=along, up=UP, outline=np.asarray(outline, dtype=np.float64), color=color, texture=texture,
        grain=grain, windows=windows, top=top,
    )  # fmt: skip


def panel(place: Floats, width: float, ground: float) -> list[Facet]:
    """A board on two posts with two black and two white quarters that meet in its middle, which is the place."""
    half = 0.5 * width
    posts = [
        facing(place, box_outline((x - 0.05 * width, ground - place[2], x + 0.05 * width, -half)), (96.0, 84.0, 70.0))
        for x in (-0.35 * width, 0.35 * width)
    ]
    return [
        *posts,
        facing(place, box_outline((-half, -half, half, half)), WHITE),
        facing(place, box_outline((-half, 0.0, 0.0, half)), BLACK),
        facing(place, box_outline((0.0, -half, half, 0.0)), BLACK),
    ]


def pole(place: Floats, width: float, ground: float, color: Color) -> list[Facet]:
    """A pole whose upper end is the place."""
    return [facing(place, box_outline((-width / 2, ground - place[2], width / 2, 0.0)), color)]


def building(
    place: Floats, size: tuple[float, float], color: Color, *, side: float = 0.35, turn: float = 0.0,
    windows: tuple[float, float] | None = None,
) -> list[Facet]:  # fmt: skip
    """A house with a flat roof whose upper left corner in front is the place.

    Args:
        place: (3,) meters.
        size: width and height in meters.
        color: of the front.
        side: width of the wall at its right side that is seen, as a share of the front's.
        turn: of the front, degrees.
        windows: see `Facet`.
    """
    width, height = size
    front = facing(place, box_outline((0.0, -height, width, 0.0)), color, turn=turn)
    shade = (0.62 * color[0], 0.62 * color[1], 0.66 * color[2])
    edge = place + width * front.along
    wall = facing(edge, box_outline((0.0, -height, side * width, 0.0)), shade, turn=turn - 62.0)
    if windows is None:
        return [wall, front]
    # Far enough from the corner that this is all that one sees around it.
    rows = box_outline((0.3 * width, -0.95 * height, 0.96 * width, -0.4 * height))
    return [wall, front, facing(place, rows, color, turn=turn, windows=windows)]


def ridge(
    bearings: Sequence[float], distance: float, heights: Sequence[tuple[float, float]], foot: float, color: Color,
    *, heading: float, rough: float, texture: float = 0.25, grain: float = 20.0, seed: float = 0.0,
) -> Facet:  # fmt: skip
    """Land in front of the sky: an upright piece whose upper edge runs through heights, with rocks on it.

    Args:
        bearings: degrees to the right of the heading where it begins and ends.
        distance: of its middle, meters.
        heights: share of the way from left to right, and meters above the scene's origin.
        foot: height of its lower edge.
        color: of the land.
        heading: degrees.
        rough: meters by which the edge is off a smooth line.
        texture: see `Facet`.
        grain: see `Facet`.
        seed: of its edge.
    """
    middle = math.radians(heading + 0.5 * (bearings[0] + bearings[1]))
    half = distance * math.tan(math.radians(0.5 * (bearings[1] - bearings[0])))
    place = np.array([distance * math.sin(middle), distance * math.cos(middle), 0.0])
    shares, levels = (np.array(column) for column in zip(*heights, strict=True))

    def top(along: Floats) -> Floats:
        share = 0.5 + 0.5 * along / half
        detail = smooth_noise(along / (6.0 * grain) + seed, np.full_like(along, seed), 4)
        return np.interp(share, shares, levels) + rough * detail

    high = max(levels) + 2 * rough + 1.0
    return facing(place, box_outline((-half, foot, half, high)), color, texture=texture, grain=grain, top=top)


def ground(box: Box, height: float, color: Color, *, heading: float, grain: float = 1.5) -> Facet:
    """Level land: left, near, right and far edge in meters to the right and ahead; its far edges have a low wall."""
    angle = math.radians(heading)
    right = np.array([math.cos(angle), -math.sin(angle), 0.0])
    ahead = np.array([math.sin(angle), math.cos(angle), 0.0])
    return Facet(
        origin=height * UP, along=right, up=ahead, outline=box_outline(box), color=color, texture=0.16, grain=grain
    )


# What lies behind the pieces of a coast: sky with clouds, and the sea on a round Earth up to its horizon.

EARTH = 6_371_000.0  # meters
_HAZE = Haze((196.0, 206.0, 214.0), 16_000.0)
_FEW = 4  # pixels between those for which clouds are computed


@dataclass(frozen=True, kw_only=True)
class Coast:
    """Sky, sea and air.

    Args:
        sea: meters by which the sea lies below the scene's origin.
        refraction: bending of light as a share of the Earth's curvature.
        zenith: color high up in the sky.
        water: color of the sea near by.
        haze: air, and with it the color of the sky at the horizon.
    """

    sea: float = 18.0
    refraction: float = 0.13
    zenith: Color = (96.0, 138.0, 186.0)
    water: Color = (52.0, 82.0, 96.0)
    haze: Haze = _HAZE

    @property
    def bend(self) -> float:
        """Meters, over the square of a distance, by which level light rises above the Earth's surface."""
        return (1.0 - self.refraction) / (2.0 * EARTH)

    def apparent(self, points: Floats) -> Floats:
        """Where points (..., 3) east, north, up seem to be: bent light raises them (meters)."""
        seen = np.array(points, dtype=np.float64)
        seen[..., 2] += self.refraction * np.square(seen[..., :2]).sum(-1) / (2.0 * EARTH)
        return seen

    def surface(self, distance: float) -> float:
        """Height of the sea's surface at a distance, meters from the scene's origin, where it truly is."""
        return -self.sea - distance**2 / (2.0 * EARTH)


def backdrop(camera: Eye, coast: Coast) -> Floats:
    """Render sky and sea as a camera sees them: (H, W, 3) gray levels."""
    slopes = camera.looks[..., :2]
    heading = np.concatenate([slopes, np.ones_like(slopes[..., :1])], -1) @ camera.rotation
    heading /= np.linalg.norm(heading, axis=-1, keepdims=True)
    level = np.hypot(heading[..., 0], heading[..., 1])
    height = coast.sea + float(camera.center[2])
    rising = -heading[..., 2]
    # The near root of bend (level t)² - rising t + height = 0: where the ray meets the surface.
    below = rising - 2.0 * level * math.sqrt(coast.bend * height)
    share = np.clip(0.5 + below / np.maximum(np.abs(np.gradient(below)[0]), 1e-12), 0.0, 1.0)
    above, wet = (np.flatnonzero(rows.any(1)) for rows in (share < 1, share > 0))
    image = np.zeros((*share.shape, 3))
    if len(above):
        image[: above[-1] + 1] = _sky(heading[: above[-1] + 1], coast)
    if len(wet):
        rows = slice(int(wet[0]), None)
        square = rising[rows] ** 2 - 4.0 * coast.bend * level[rows] ** 2 * height
        distance = 2.0 * height / np.maximum(rising[rows] + np.sqrt(np.maximum(square, 0.0)), 1e-9)
        sea = _sea(camera, heading[rows], np.where(share[rows] > 0, distance, 1.0), coast)
        image[rows] += share[rows, :, None] * (sea - image[rows])
    return image


def _sky(heading: Floats, coast: Coast) -> Floats:
    up = np.clip(heading[..., 2], 0.0, 1.0)
    high = 1.0 - np.exp(-up / 0.16)
    color = np.array(coast.haze.color) + high[..., None] * (np.array(coast.zenith) - np.array(coast.haze.color))
    # Clouds on a level layer: its places are the slopes of the lines of sight.
    steep = np.maximum(heading[..., 2], 0.02)
    few = heading[::_FEW, ::_FEW] / steep[::_FEW, ::_FEW, None]
    cloud = _joined_values(smooth_noise(0.55 * few[..., 0], 0.8 * few[..., 1], 5), up.shape)
    cover = np.clip(1.6 * cloud + 0.1, 0.0, 1.0) * np.clip((heading[..., 2] - 0.03) / 0.1, 0.0, 1.0)
    return color + 0.75 * cover[..., None] * (np.array([238.0, 240.0, 242.0]) - color)


def _joined_values(values: Floats, shape: tuple[int, ...]) -> Floats:
    """Values of every fourth pixel, joined by straight lines."""
    for axis, size in enumerate(shape):
        at = np.arange(size) / _FEW
        low = np.minimum(at.astype(int), max(values.shape[axis] - 2, 0))
        high = np.minimum(low + 1, values.shape[axis] - 1)
        share = np.expand_dims(at - low, 1 - axis).clip(0.0, 1.0)
        first = values.take(low, axis)
        values = first + share * (values.take(high, axis) - first)
    return values


def _sea(camera: Eye, heading: Floats, distance: Floats, coast: Coast) -> Floats:
    x, y = (camera.center[i] + distance * heading[..., i] for i in (0, 1))
    waves = np.zeros_like(x)
    # Waves that are narrower than a pixel, mostly those far away, are not seen.
    depth = np.abs(np.gradient(np.hypot(x, y))[0])
    for size, strength in ((3.0, 0.12), (11.0, 0.10), (60.0, 0.07)):
        fine = np.clip(2.0 * size / np.maximum(depth, 1e-9), 0.0, 1.0)
        waves += strength * fine * smooth_noise(x / size, y / size, 2)
    color = np.array(coast.water) * (1 + waves)[..., None]
    # Water mirrors the sky more, the flatter it is looked at.
    mirrored = np.exp(heading[..., 2:3] / 0.05)
    color = color + 0.45 * mirrored * (np.array(coast.haze.color) - color)
    return coast.haze.seen(color, distance)


def exposed(light: Floats, blur: float, noise: float, random: np.random.Generator) -> NDArray[np.uint8]:
    """Blur light (H, W, ...) as the optics do, add noise, and round to 8 bits."""
    from scipy.ndimage import gaussian_filter

    sigma = (blur, blur) + (0.0,) * (light.ndim - 2)
    seen = gaussian_filter(light, sigma) if blur else light
    if noise:
        seen = seen + noise * random.standard_normal(light.shape, dtype=np.float32)
    return np.clip(np.rint(seen), 0, 255).astype(np.uint8)


def rotation_of(matrix: torch.Tensor) -> Floats:
    """A rotation as NumPy's floats."""
    return matrix.detach().numpy().astype(np.float64)
