"""A practice site: its pictures, its film, its night, and its truth."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

import kcal.sim.coast as shore
from kcal.sim.captures import PrintedBoard, drawn_rig
from kcal.sim.raytrace import SURVEILLANCE
from kcal.sim.scene import FOCAL_MM, DemoScene
from kcal.sim.truth import TruthLens

# A coast to practise on: two cameras on masts, surveyed landmarks, targets out to 5 km, and moving ships.
#
# All of it is made of flat pieces whose geometry is exact (`kcal.sim.coast`), behind the ray-traced lenses of
# `kcal.sim.scene`. Light is bent as in life.

Floats = NDArray[np.float64]
Side = Literal["left", "right"]
SIDES: tuple[Side, Side] = ("left", "right")
# Sigma of the optics' blur in pixels, and of the sensor's noise in gray levels.
BLUR, NOISE = 0.7, 1.5
_QUAY = -15.0  # height of the quay, meters from the left camera


class Thing(NamedTuple):
    """Something to mark: name, distance in meters, degrees to the right of the heading, height in meters, and words.

    Heights are those above the left camera. `where` says which point of it is meant.
    """

    name: str
    distance: float
    bearing: float
    up: float
    where: str


@dataclass(frozen=True, kw_only=True)
class Passage:
    """A ship's way in the film.

    Args:
        name: of the ship.
        style: which ship of `harbor.json`: 0 ferry, 1 trawler, 2 freighter, 3 sailing boat.
        length: meters.
        start: distance and bearing of its middle at the start, meters and degrees.
        end: at the end.
        bow: meters to the side by which the way curves in its middle.
    """

    name: str
    style: int
    length: float
    start: tuple[float, float]
    end: tuple[float, float]
    bow: float = 0.0


# What is there: things to mark, ships, and all pieces of the land, a file of numbers.
_HARBOR = json.loads(resources.files("kcal.sim").joinpath("harbor.json").read_text(encoding="utf-8"))
LANDMARKS, TARGETS = (tuple(Thing(*one) for one in _HARBOR[name]) for name in ("landmarks", "targets"))
PASSAGES = tuple(Passage(**one) for one in _HARBOR["passages"])


def practice_scene(seed: int = 1, views: int = 12, scale: float = 1.0) -> DemoScene:
    """The site of a seed: its cameras, boards, landmarks and targets.

    Args:
        seed: of lenses, poses, noise and survey.
        views: of the board by each camera.
        scale: of the images, see `kcal.sim.captures.drawn_lens`.

    Example:
        >>> scene = practice_scene()
        >>> scene.landmarks.names[:2], len(scene.targets.names)
        (('panel 1', 'panel 2'), 7)
    """
    return DemoScene(
        seed=seed,
        rig=drawn_rig(SURVEILLANCE, 1.0, 10 + seed, focal_mm=FOCAL_MM, wander=1.0, scale=scale),
        lat=58.094, lon=6.571, height=61.0, heading_deg=236.0, pitch_deg=2.2, roll_deg=0.3,
        near_board=PrintedBoard(9, 6, 0.06, seed=10 + seed), near_views=views,
        targets_at=tuple(thing[:4] for thing in TARGETS), landmarks_at=tuple(thing[:4] for thing in LANDMARKS),
    )  # fmt: skip


class PracticeSite:
    """The coast as both cameras see it.

    Args:
        scene: cameras and places.
        coast: sky, sea and air.
    """

    def __init__(self, scene: DemoScene, coast: shore.Coast | None = None) -> None:
        self.scene = scene
        self.coast = coast or shore.Coast()
        self.facets = sorted(self._facets(), key=lambda facet: -facet.distance)

    @functools.cached_property
    def eyes(self) -> dict[Side, shore.Eye]:
        """Both cameras, with the lines of sight of all pixels."""
        rig, into_enu = self.scene.rig, self.scene.enu_from_rig
        turn, shift = rig.right_from_left_rotation, rig.right_from_left_translation
        center = shore.rotation_of(into_enu) @ shore.rotation_of(-turn.T @ shift)
        return {
            "left": shore.eye(rig.left, shore.rotation_of(into_enu.T), np.zeros(3)),
            "right": shore.eye(rig.right, shore.rotation_of(turn @ into_enu.T), center),
        }

    def true_pixels(self, side: Side, enu: torch.Tensor | Floats) -> Floats:
        """Pixels (N, 2) at which a camera sees points (N, 3) east, north, up, through bent light."""
        pixels, valid = self.eyes[side].project(self.coast.apparent(np.asarray(enu, dtype=np.float64)))
        assert valid.all()
        return pixels

    @functools.cache  # noqa: B019  the site lives as long as its pictures are needed
    def light(self, side: Side) -> Floats:
        """The site without ships as light on a sensor, before blur and noise: (H, W, 3) gray levels."""
        camera = self.eyes[side]
        image = shore.backdrop(camera, self.coast)
        for facet, window in zip(self.facets, shore.facet_windows(camera, self.facets), strict=True):
            if window is not None:
                shore.paint(image[window], facet, shore.cut(camera, facet, window), self.coast.haze)
        return image

    def picture(self, side: Side, noise: float = NOISE) -> NDArray[np.uint8]:
        """The site in color, (H, W, 3), with blur and noise."""
        random = np.random.default_rng([self.scene.seed, SIDES.index(side), 1])
        return shore.exposed(self.light(side), BLUR, noise, random)

    def at(self, distance: float, bearing: float, up: float) -> Floats:
        """East, north, up of a place, as it seems to be."""
        angle = math.radians(self.scene.heading_deg + bearing)
        return self.coast.apparent(np.array([distance * math.sin(angle), distance * math.cos(angle), up]))

    def _facets(self) -> Iterator[shore.Facet]:
        known = {thing.name: thing[1:4] for thing in (*LANDMARKS, *TARGETS)}
        for piece in _HARBOR["pieces"]:
            own = dict(piece)
            make, places, boxes = getattr(shore, own.pop("kind")), own.pop("places", ()), own.pop("boxes", ())
            if "box" in own:
                own["outline"] = shore.box_outline(own.pop("box"))
            for box in boxes:
                yield make(box, heading=self.scene.heading_deg, **own)
            for place in places:
                made = make(self.at(*(known[place] if isinstance(place, str) else place)), **own)
                yield from made if isinstance(made, list) else [made]
            if not (places or boxes):
                yield make(heading=self.scene.heading_deg, **own)


# The truth of a practice site as plain numbers, which results are compared with later without the simulator.

DISTANCES = (1000.0, 2000.0, 5000.0)
_GRID, _COARSE = (33, 19), (11, 5)


def practice_truth(site: PracticeSite, frames: int) -> dict[str, Any]:
    """What `kcal.report.practice_score` compares with.

    Args:
        site: the coast.
        frames: of the film.
    """
    scene, rig = site.scene, site.scene.rig
    things = {**_places_by_name(scene.landmarks), **_places_by_name(scene.targets)}
    pixels = {side: site.true_pixels(side, np.array([*things.values()])) for side in SIDES}
    return {
        "kcal": "practice truth",
        "version": 1,
        "seed": scene.seed,
        "origin": {"lat": scene.lat, "lon": scene.lon, "height": scene.height},
        "heading_deg": scene.heading_deg,
        "cameras": {side: _lens_record(getattr(rig, side)) for side in SIDES},
        "baseline_m": float(rig.baseline),
        "pairs": [_pairs_record(site, distance) for distance in DISTANCES],
        "landmarks": _places_by_name(scene.landmarks),
        "targets": _places_by_name(scene.targets),
        "marks": {
            name: [*pixels["left"][row].tolist(), *pixels["right"][row].tolist()] for row, name in enumerate(things)
        },
        "ships": {"times": [number / RATE for number in range(frames)], "places": _ship_places(site, frames)},
    }


def ship_boxes(site: PracticeSite, side: Side, frames: int) -> NDArray[np.float64]:
    """Middles of the boxes around the ships in the images of one camera: (frames, ships, 2) pixels, nearest last."""
    camera = site.eyes[side]
    ships = [each for number in range(frames) for each in ships_at(site, number / max(frames - 1, 1))]
    points = np.stack([site.coast.apparent(each.middle) for each in ships])
    return camera.project(points)[0].reshape(frames, -1, 2)


def _places_by_name(points: Any) -> dict[str, list[float]]:
    return dict(zip(points.names, points.enu.tolist(), strict=True))


def _lens_record(lens: TruthLens) -> dict[str, Any]:
    x, y = (np.linspace(0.0, size - 1.0, count) for size, count in zip(lens.size, _GRID, strict=True))
    pixels = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    rays, _ = lens.unproject(torch.from_numpy(pixels))
    return {"size": list(lens.size), "pixels": pixels.tolist(), "rays": rays.tolist()}


def _pairs_record(site: PracticeSite, distance: float) -> dict[str, Any]:
    """Exact marks, over the image, of points at a distance."""
    rig = site.scene.rig
    width, height = rig.left.size
    x, y = np.linspace(0.03 * width, 0.97 * width, _COARSE[0]), np.linspace(0.1 * height, 0.9 * height, _COARSE[1])
    rays, _ = rig.left.unproject(torch.from_numpy(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)))
    pixels, valid = rig(distance * rays)
    (left, right), valid = pixels.unbind(-2), valid.all(-1)
    seen = valid & rig.left.inside(left) & rig.right.inside(right)
    return {"range_m": distance, "left": left[seen].tolist(), "right": right[seen].tolist()}


def _ship_places(site: PracticeSite, frames: int) -> dict[str, list[list[float]]]:
    places: dict[str, list[list[float]]] = {}
    for number in range(frames):
        for each in ships_at(site, number / max(frames - 1, 1)):
            places.setdefault(each.passage.name, []).append(each.middle.tolist())
    return places


# A film of the coast: ships that move before a still picture, and where they truly are.

RATE, SECONDS = 5, 120
_LUMA = np.array([0.299, 0.587, 0.114])
_AT_ONCE = 60  # frames whose ships are projected together
_AROUND = 4  # pixels that blur mixes into a ship's part of the image


class ShipAt(NamedTuple):
    """A ship at a moment.

    Attributes:
        passage: which one.
        middle: (3,) of the box around it, east, north, up of the left camera in meters, where it truly is.
        facets: its pieces, where they seem to be.
    """

    passage: Passage
    middle: Floats
    facets: list[shore.Facet]


def ships_at(site: PracticeSite, share: float) -> list[ShipAt]:
    """All ships when a share of the film is over, the farthest first.

    Example:
        >>> from kcal.sim.practice import practice_scene
        >>> ships = ships_at(PracticeSite(practice_scene()), 0.5)
        >>> [round(float(np.hypot(*each.middle[:2])), -2) for each in ships]
        [3200.0, 900.0, 700.0, 600.0]
    """
    found = []
    for passage in PASSAGES:
        distance, bearing = (a + share * (b - a) for a, b in zip(passage.start, passage.end, strict=True))
        distance += passage.bow * 4.0 * share * (1.0 - share)
        forward = math.copysign(1.0, passage.end[1] - passage.start[1])
        scale, water = passage.length * np.array([forward, 1.0]), site.coast.surface(distance)
        at, pieces = site.at(distance, bearing, water), _HARBOR["ships"][passage.style]
        facets = [shore.facing(at, scale * corners, color, windows=glass) for corners, color, glass in pieces]
        corners = np.concatenate([facet.outline for facet in facets])
        across, up = 0.5 * (corners.min(0) + corners.max(0))
        angle = math.radians(site.scene.heading_deg + bearing)
        place = np.array([distance * math.sin(angle), distance * math.cos(angle), water + up])
        found.append(ShipAt(passage, place + across * facets[0].along, facets))
    return sorted(found, key=lambda each: -each.facets[0].distance)


def frames(site: PracticeSite, side: Side, count: int = RATE * SECONDS) -> Iterator[NDArray[np.uint8]]:
    """Gray frames (H, W) of one camera; still parts have the same noise in every frame, so that the video stays small.

    Args:
        site: the coast.
        side: which camera.
        count: how many.
    """
    camera, light = site.eyes[side], site.light(side)
    random = np.random.default_rng([site.scene.seed, SIDES.index(side), 2])
    still = shore.exposed(light @ _LUMA, BLUR, NOISE, random)
    windows = shore.facet_windows(camera, site.facets)
    fixed = [(facet, window) for facet, window in zip(site.facets, windows, strict=True) if window is not None]
    for first in range(0, count, _AT_ONCE):
        moments = [ships_at(site, n / max(count - 1, 1)) for n in range(first, min(first + _AT_ONCE, count))]
        pieces = [facet for ships in moments for each in ships for facet in each.facets]
        places = iter(shore.facet_windows(camera, pieces))
        for ships in moments:
            frame = still.copy()
            moving = [(facet, place) for each in ships for facet in each.facets if (place := next(places)) is not None]
            for each in ships:
                own = [place for facet, place in moving if facet in each.facets]
                if own:
                    window = _ship_window(own, frame.shape)
                    light = _with_ships(site, side, window, fixed, moving)
                    seen = shore.exposed(light @ _LUMA, BLUR, NOISE, random)
                    inner = tuple(slice(_AROUND, size - _AROUND) for size in seen.shape)
                    frame[window][inner] = seen[inner]
            yield frame


_Placed = tuple[shore.Facet, tuple[slice, slice]]


def _with_ships(
    site: PracticeSite, side: Side, window: tuple[slice, slice], fixed: list[_Placed], moving: list[_Placed]
) -> Floats:
    """Light (H, W, 3) in a window with all ships in it, covered by what is nearer than they are."""
    camera, part = site.eyes[side], site.light(side)[window].copy()
    ships = [each for each in moving if _meet(each[1], window)]
    farthest = max(facet.distance for facet, _ in ships)
    nearer = [each for each in fixed if each[0].distance < farthest and _meet(each[1], window)]
    cuts: dict[bytes, shore.Cut] = {}
    for facet, place in sorted((*ships, *nearer), key=lambda each: -each[0].distance):
        # All pieces of a ship lie on one plane.
        plane = facet.origin.tobytes() + facet.along.tobytes() + facet.up.tobytes()
        cuts[plane] = at = cuts.get(plane) or shore.cut(camera, facet, window, small=facet.up[2] == 1)
        inner = tuple(
            slice(max(own.start - whole.start, 0), max(own.stop - whole.start, 0))
            for own, whole in zip(place, window, strict=True)
        )
        shore.paint(part[inner], facet, at.part(inner), site.coast.haze)
    return part


def _ship_window(windows: list[tuple[slice, slice]], shape: tuple[int, ...]) -> tuple[slice, slice]:
    down, across = (
        slice(max(0, min(own.start for own in side) - _AROUND), min(size, max(own.stop for own in side) + _AROUND))
        for side, size in zip(zip(*windows, strict=True), shape, strict=True)
    )
    return down, across


def _meet(first: tuple[slice, slice], second: tuple[slice, slice]) -> bool:
    return all(a.start < b.stop and b.start < a.stop for a, b in zip(first, second, strict=True))


# The night above a practice site: stars as the cameras see them, wherever a catalog says that they stand.

# Gray levels of the dark sky, and all of a star of magnitude 0.
_SKY, _BRIGHTEST = 14.0, 60_000.0
_STAR_BLUR = 1.1  # px: sigma of a star's image
_HALF = 6  # pixels around a star that it lights


def night_picture(site: PracticeSite, side: Side, directions: Floats, magnitudes: Floats) -> NDArray[np.uint8]:
    """A picture (H, W) of the night sky in gray; the ground is dark.

    Args:
        site: cameras.
        side: which of them.
        directions: (N, 3) unit vectors east, north, up to where stars seem to be, refraction included.
        magnitudes: (N,) visual; 2.5 of it are a factor of ten.
    """
    camera = site.eyes[side]
    height, width = camera.looks.shape[:2]
    light = np.full((height, width), _SKY)
    up = directions[:, 2] > 0.0
    pixels, valid = camera.project(1e9 * directions[up])
    inside = valid & (pixels > -_HALF).all(-1) & (pixels < np.array([width, height]) + _HALF).all(-1)
    for (u, v), magnitude in zip(pixels[inside], magnitudes[up][inside], strict=True):
        column, row = round(u), round(v)
        x, y = np.arange(column - _HALF, column + _HALF + 1), np.arange(row - _HALF, row + _HALF + 1)
        x, y = x[(x >= 0) & (x < width)], y[(y >= 0) & (y < height)]
        if len(x) and len(y):
            profile = np.exp(-0.5 * (((x - u) ** 2) + ((y - v) ** 2)[:, None]) / _STAR_BLUR**2)
            flux = _BRIGHTEST * 10.0 ** (-0.4 * magnitude) / (2 * np.pi * _STAR_BLUR**2)
            light[y[0] : y[-1] + 1, x[0] : x[-1] + 1] += flux * profile
    random = np.random.default_rng([site.scene.seed, SIDES.index(side), 4])
    noisy = light + NOISE * random.standard_normal(light.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
