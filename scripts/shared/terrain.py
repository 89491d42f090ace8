"""Pictures of a terrain by both cameras of a rig: ground, hills, blocks from 50 m to 20 km, in any light and weather.

It is made of flat pieces (`kcal.sim.coast`), so that the truth of every pixel is known, and each moment has vehicles
elsewhere. The finest texture is four pixels wide, so that one line of sight for each pixel is enough.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.sim.captures import TrueRig
from kcal.sim.coast import (
    Cut,
    Eye,
    Facet,
    Haze,
    box_outline,
    cut,
    exposed,
    eye,
    facet_windows,
    facing,
    paint,
    rotation_of,
    smooth_noise,
)

Floats = NDArray[np.float64]
EYE_HEIGHT = 14.0  # meters of the left camera above the ground
_SKY = 205.0
# x right, y ahead, z up from the left camera's axes.
_SCENE_FROM_LEFT = torch.tensor([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]], dtype=torch.float64)
_FARTHEST = 25_000.0
_HILLS = ((20_000.0, 520.0), (11_000.0, 200.0), (6_000.0, 70.0), (3_200.0, 18.0), (1_700.0, 0.0))
# Azimuth to which the cameras look, latitude, and the sun's declination of late summer, degrees.
_HEADING, _LATITUDE, _DECLINATION = 40.0, 47.0, 10.0
# Of light at noon on the level: what comes from the sky, and of the sun's what a shadow lets through.
_FROM_SKY = 0.3
_HIGHEST = math.sin(math.radians(90.0 - _LATITUDE + _DECLINATION))


@dataclass(frozen=True, kw_only=True)
class Weather:
    """How a site looks at a time.

    Args:
        hour: of the sun, which is in the south at 12; shade, shadows and brightness follow.
        haze: meters in which a contrast falls to 1/e.
        season: share of the texture of ground and hills that has changed, 0 to 1; blocks stay.
        noise: sigma of the sensor's noise, gray levels.
        blur: sigma of the optics' blur, px.
        shutter: radians by which both masts turn to the right while an image is read out from its first row to its
            last (a rolling shutter); the image's middle row is where the cameras stand.
    """

    hour: float = 12.0
    haze: float = 25_000.0
    season: float = 0.0
    noise: float = 1.5
    blur: float = 0.7
    shutter: float = 0.0

    @property
    def sun(self) -> Floats:
        """(3,) unit vector to the sun: right, ahead, up of the left camera."""
        turn, latitude, declination = (
            math.radians(angle) for angle in (15.0 * (self.hour - 12.0), _LATITUDE, _DECLINATION)
        )
        north = math.cos(latitude) * math.sin(declination) - math.sin(latitude) * math.cos(declination) * math.cos(turn)
        east = -math.cos(declination) * math.sin(turn)
        up = math.sin(latitude) * math.sin(declination) + math.cos(latitude) * math.cos(declination) * math.cos(turn)
        heading = math.radians(_HEADING)
        turned = np.array([[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]])
        across, ahead = turned @ (east, north)
        return np.array([across, ahead, up])


class Picture(NamedTuple):
    """What a camera sees.

    Attributes:
        light: (H, W) gray levels before blur and noise.
        depth: (H, W) meters ahead of the left camera, of what is seen; infinite for the sky.
        ground: (H, W) whether it is the level ground.
        moving: (H, W) whether it moves.
    """

    light: Floats
    depth: Floats
    ground: NDArray[np.bool_]
    moving: NDArray[np.bool_]


class Terrain:
    """A terrain before a rig; one weather's pictures are kept at a time.

    Args:
        rig: the true cameras.
        seed: of the terrain.

    Example:
        >>> from kcal.sim.captures import drawn_rig
        >>> from kcal.sim.raytrace import SURVEILLANCE
        >>> rig = drawn_rig(SURVEILLANCE, 1.0, 1, focal_mm=4.64, wander=1.0, scale=0.125)
        >>> left, right = Terrain(rig, 1).images(1, Weather(hour=9.0, haze=8000.0))
        >>> left.shape, left.dtype
        ((135, 240), dtype('uint8'))
    """

    def __init__(self, rig: TrueRig, seed: int) -> None:
        self.rig, self.seed = rig, seed
        self._focal = float(rig.left.focal[0])
        self._still = functools.lru_cache(2)(self._still_picture)
        self._eye = functools.lru_cache(2)(self._turning_eye)

    def picture(self, side: int, moment: int | None, weather: Weather) -> Picture:
        """What the left (0) or right (1) camera sees: still things alone, or with what moves at a moment."""
        still = self._still(side, weather)
        if moment is None:
            return still
        random = np.random.default_rng([self.seed, moment, 7])
        return self._painted(side, still, _vehicles(random, weather, self._focal), weather, moving=True)

    def images(self, moment: int, weather: Weather | None = None) -> list[NDArray[np.uint8]]:
        """Both images (H, W) of a moment."""
        weather = weather or Weather()
        random = np.random.default_rng([self.seed, moment])
        return [
            exposed(self.picture(side, moment, weather).light, weather.blur, weather.noise, random) for side in (0, 1)
        ]

    def true_right(self, left: Tensor, moment: int | None, weather: Weather | None = None) -> tuple[Tensor, Tensor]:
        """Where (N, 2) the right camera sees what the left one sees at pixels (N, 2), and meters to it."""
        weather = weather or Weather()
        picture = self.picture(0, moment, weather)
        width, height = self.rig.left.size
        near = left.round().long().clamp(torch.zeros(2).long(), torch.tensor([width - 1, height - 1]))
        depth, level = (torch.from_numpy(part)[near[:, 1], near[:, 0]] for part in (picture.depth, picture.ground))
        at, heading = self.rig.left.lines(left).spatial()
        turned = _about_upright(self._row_angle(left[:, 1], weather))
        at, heading = ((turned.mT @ part[..., None])[..., 0] for part in (at, heading))
        # On the ground the depth changes from row to row.
        far = torch.where(level, (EYE_HEIGHT - at[:, 1]) / heading[:, 1],
                          (depth.clamp_max(1e7) - at[:, 2]) / heading[:, 2])  # fmt: skip
        points = at + far[:, None] * heading
        moved = self.rig.right_from_left(points)
        pixels = self.rig.right.project(moved)[0]
        for _ in range(3 if weather.shutter else 0):
            turned = _about_upright(self._row_angle(pixels[:, 1], weather))
            pixels = self.rig.right.project((turned @ moved[..., None])[..., 0])[0]
        return pixels, points.norm(dim=-1)

    def _row_angle(self, row: Tensor, weather: Weather) -> Tensor:
        """Radians by which a camera has turned to the right when a row is read."""
        height = self.rig.left.size[1]
        return weather.shutter * (row - 0.5 * (height - 1)) / height

    def _turning_eye(self, side: int, shutter: float) -> Eye:
        """A camera whose lines of sight turn with its rows."""
        lens = self.rig.right if side else self.rig.left
        turn, center = _SCENE_FROM_LEFT.T, np.zeros(3)
        if side:
            rotation = self.rig.right_from_left_rotation
            center = rotation_of(_SCENE_FROM_LEFT) @ rotation_of(-rotation.T @ self.rig.right_from_left_translation)
            turn = rotation @ turn
        found = eye(lens, rotation_of(turn), center)
        if shutter:
            rows = torch.arange(lens.size[1], dtype=torch.float64)
            turned = _about_upright(self._row_angle(rows, Weather(shutter=shutter))).numpy()[:, None]
            looks, along = found.looks, np.ones((*found.looks.shape[:2], 3))
            along[..., :2] = looks[..., :2]
            start = np.concatenate([looks[..., 2:], np.zeros_like(looks[..., :1])], -1)
            along, start = ((part[..., None, :] @ turned)[..., 0, :] for part in (along, start))
            slopes = along[..., :2] / along[..., 2:]
            found = found._replace(looks=np.concatenate([slopes, start[..., :2] - start[..., 2:] * slopes], -1))
        return found

    def _still_picture(self, side: int, weather: Weather) -> Picture:
        size = self.rig.left.size[::-1]
        nothing = np.zeros(size, dtype=bool)
        sky = Picture(np.full(size, _SKY * _brightness(weather)), np.full(size, np.inf), nothing, nothing)
        return self._painted(side, sky, _pieces(self.seed, weather, self._focal), weather)

    def _painted(
        self, side: int, behind: Picture, facets: list[Facet], weather: Weather, *, moving: bool = False
    ) -> Picture:
        """A picture with pieces over it, what is nearer staying in front of them."""
        camera = self._eye(side, weather.shutter)
        found = Picture(behind.light.copy(), behind.depth.copy(), behind.ground.copy(), behind.moving.copy())
        haze = Haze((_SKY * _brightness(weather),), weather.haze)
        for facet, window in zip(facets, facet_windows(camera, facets), strict=True):
            if window is None:
                continue
            at = cut(camera, facet, window)
            part = found.light[window][..., None]
            hidden = found.depth[window] < facet.origin[1] if moving else None
            before = part[hidden] if hidden is not None else None
            share = paint(part, facet, at, haze)
            if hidden is not None:
                part[hidden] = before
                share[hidden] = 0.0
            if facet.shadow is None:
                front = share > 0.5
                level = facet.up[2] == 0.0
                where = facet.origin[1] + at.along * facet.along[1] + at.up * facet.up[1]
                found.depth[window][front] = where[front]
                found.ground[window][front] = level
                found.moving[window][front] = moving
        return found


def _about_upright(angle: Tensor) -> Tensor:
    """Rotations (N, 3, 3) that take points into the frame of a camera that turned to the right by angles (N,)."""
    cosine, sine, nothing, one = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    rows = [cosine, nothing, -sine, nothing, one, nothing, sine, nothing, cosine]
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def _brightness(weather: Weather) -> float:
    """Of the level ground, beside that at noon; after sunset a tenth of the sky's light is left half an hour later."""
    height = float(weather.sun[2])
    sky = _FROM_SKY * min(1.0, 10.0 ** (height / 0.1)) if height < 0 else _FROM_SKY
    return sky + (1.0 - _FROM_SKY) * max(height, 0.0) / _HIGHEST


def _lit(normal: Floats, weather: Weather) -> float:
    """Light on a face, beside that on the level ground at noon."""
    direct = max(float(normal @ weather.sun), 0.0) if weather.sun[2] > 0 else 0.0
    sky = _brightness(weather) - (1.0 - _FROM_SKY) * max(float(weather.sun[2]), 0.0) / _HIGHEST
    return sky + (1.0 - _FROM_SKY) * direct / _HIGHEST


def _patterned(
    seed: float,
    waves: tuple[float, ...],
    light: float,
    season: float,
    pixel: Callable[[Cut], tuple[Floats | float, Floats | float]],
) -> Callable[[Cut], Floats]:
    """Relative brightness with texture of some wavelengths, meters; what is finer than four pixels is left out.

    `pixel` tells the meters of a pixel along its longer and its shorter side by the place alone: by how a camera sees
    it, both would see another texture there, which moved matches of the ground before them to one side by 0.007 px.
    """
    new, old = math.sin(0.5 * math.pi * season), math.cos(0.5 * math.pi * season)

    def pattern(at: Cut) -> Floats:
        found = np.ones_like(at.along)
        longer, shorter = (np.broadcast_to(size, found.shape) for size in pixel(at))
        for wave in waves:
            fine = np.clip(wave / (4.0 * longer) - 0.25, 0.0, 1.0) * np.clip(60.0 * shorter / wave, 0.0, 1.0)
            some = (fine > 0.01) & (at.far > 0)
            if some.any():
                x, y = at.along[some] / wave + seed, at.up[some] / wave + wave
                value = old * smooth_noise(x, y, 1)
                if new:
                    value = value + new * smooth_noise(x + 91.7, y + 37.3, 1)
                found[some] += 0.16 * fine[some] * value
        return light * found

    return pattern


def _ground_pixel(focal: float, at: Cut) -> tuple[Floats, Floats]:
    """Meters of a pixel on the level ground ahead and across, longer first."""
    across = np.maximum(at.up, 1.0) / focal
    ahead = across * np.maximum(at.up, 1.0) / EYE_HEIGHT
    return np.maximum(across, ahead), np.minimum(across, ahead)


def _pieces(seed: int, weather: Weather, focal: float) -> list[Facet]:
    """Ground, hills, shadows and blocks of a seed, in the order in which they are painted."""
    random = np.random.default_rng(seed)
    ahead, right = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    waves = tuple(0.08 * 2.0**octave for octave in range(12))
    ground = Facet(
        origin=np.array([0.0, 0.0, -EYE_HEIGHT]), along=right, up=ahead, color=(105.0,),
        outline=box_outline((-2.0 * _FARTHEST, 5.0, 2.0 * _FARTHEST, _FARTHEST)),
        pattern=_patterned(seed, waves, _brightness(weather), weather.season, functools.partial(_ground_pixel, focal)),
    )  # fmt: skip
    hills, blocks = [], []
    for distance, top in _HILLS:
        offset, gray = float(random.uniform(0, 99)), float(random.uniform(80, 130))
        outline = box_outline((-2 * distance, -EYE_HEIGHT, 2 * distance, top + 0.1 * distance))
        edge = functools.partial(_skyline, top, distance, offset)
        hill = facing(np.array([0.0, distance, 0.0]), outline, (gray,), top=edge)
        hills.append(_textured(hill, offset, weather, weather.season, focal))
    for distance in np.geomspace(50.0, 2500.0, 48):
        side, width = float(distance * random.uniform(-0.6, 0.6)), float(distance * random.uniform(0.015, 0.05))
        height, offset = float(random.uniform(1.0, 3.0) * width), float(random.uniform(0, 99))
        gray, turn = float(random.uniform(70, 170)), float(random.uniform(-35.0, 35.0))
        foot, outline = np.array([side, float(distance), -EYE_HEIGHT]), box_outline((-width, 0.0, width, height))
        block = facing(foot, outline, (gray,), turn=turn)
        blocks.append(_textured(block, offset, weather, 0.0, focal))
    shadows = [shadow for block in blocks if (shadow := _shadow(block, weather)) is not None]
    return [ground, *hills, *shadows, *blocks[::-1]]


def _vehicles(random: np.random.Generator, weather: Weather, focal: float) -> list[Facet]:
    found = []
    for distance in np.geomspace(60.0, 400.0, 10)[::-1]:
        place = np.array([float(distance * random.uniform(-0.5, 0.5)), float(distance), -EYE_HEIGHT])
        body = facing(place, box_outline((-2.5, 0.0, 2.5, 3.0)), (float(random.uniform(50, 200)),))
        found.append(_textured(body, float(random.uniform(0, 99)), weather, 0.0, focal))
    return found


def _skyline(top: float, distance: float, offset: float, along: Floats) -> Floats:
    rough: Floats = top + 0.016 * distance * smooth_noise(along / (0.06 * distance) + offset, 0.0 * along, 4)
    return rough


def _textured(facet: Facet, offset: float, weather: Weather, season: float, focal: float) -> Facet:
    """An upright piece with light and with texture of 5 to 40 pixels of a camera of 1500 pixels' focal length."""
    distance = float(np.linalg.norm(facet.origin))
    waves = tuple(distance / 1500.0 * wide for wide in (5.0, 9.0, 17.0, 40.0))
    light = _lit(np.cross(facet.along, facet.up), weather)
    pattern = _patterned(offset, waves, light, season, lambda _: (distance / focal,) * 2)
    return replace(facet, pattern=pattern)


def _shadow(block: Facet, weather: Weather) -> Facet | None:
    """The shadow of a block on the ground; None without sun."""
    sun = weather.sun
    if sun[2] < 0.02:
        return None
    width, height = block.outline[2, 0], block.outline[2, 1]
    tip = -height / sun[2] * sun[:2]
    foot = width * block.along[:2]
    corners = np.stack([-foot, foot, foot + tip, tip - foot])
    left = _FROM_SKY / _brightness(weather)
    return Facet(
        origin=block.origin, along=np.array([1.0, 0.0, 0.0]), up=np.array([0.0, 1.0, 0.0]), outline=corners,
        color=(0.0,), shadow=left,
    )  # fmt: skip
