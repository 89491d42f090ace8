"""A practice site: its pictures, its film, its night, and its truth."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass
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


LANDMARKS = (
    Thing("panel 1", 120.0, 20.0, -12.5, "middle of the black and white panel"),
    Thing("panel 2", 180.0, -29.0, -11.5, "middle of the black and white panel"),
    Thing("panel 3", 150.0, 8.0, -12.7, "middle of the black and white panel"),
    Thing("hut", 260.0, -4.0, -9.0, "upper left corner of its front"),
    Thing("barn", 340.0, -18.0, -8.0, "upper left corner of its front"),
    Thing("chimney", 420.0, 28.0, 20.0, "middle of its top"),
    Thing("depot", 650.0, -13.0, 8.0, "upper left corner of its front"),
    Thing("silo", 900.0, 13.5, 6.0, "upper left corner of its front"),
    Thing("beacon", 1150.0, -8.5, 8.0, "top of the pole on the mole"),
    Thing("antenna", 1500.0, -23.0, 95.0, "top of the mast on the left headland"),
    Thing("hill mast", 2100.0, 19.0, 150.0, "top of the mast on the right hill"),
    Thing("lighthouse", 2600.0, 3.5, 26.0, "middle of its top"),
)
TARGETS = (
    Thing("gate", 100.0, -9.0, -12.6, "top of the white post"),
    Thing("yawl", 250.0, 14.5, -9.5, "top of the mast of the moored boat"),
    Thing("buoy", 500.0, -23.5, -11.0, "top of the yellow spar buoy"),
    Thing("ferry", 1000.0, 6.0, 12.0, "upper left corner of its blue deckhouse"),
    Thing("tower", 2000.0, -31.5, 72.0, "upper left corner of the tower on the left headland"),
    Thing("turbine", 3500.0, 30.5, 185.0, "tip of the blade that points up"),
    Thing("freighter", 5000.0, 0.4, 40.0, "upper left corner of its dark deckhouse"),
)


@dataclass(frozen=True, kw_only=True)
class Passage:
    """A ship's way in the film.

    Args:
        name: of the ship.
        style: see `kcal.sim.coast.ship`.
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


PASSAGES = (
    Passage(name="sailing boat", style=3, length=11.0, start=(520.0, -3.0), end=(640.0, 21.0), bow=25.0),
    Passage(name="trawler", style=1, length=24.0, start=(690.0, 25.0), end=(700.0, -6.0), bow=-30.0),
    Passage(name="patrol boat", style=0, length=32.0, start=(930.0, 12.6), end=(970.0, -9.3), bow=-30.0),
    Passage(name="coaster", style=2, length=140.0, start=(3260.0, -7.0), end=(3140.0, 4.6)),
)


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

    def sea_at(self, distance: float, bearing: float) -> Floats:
        """A place on the sea, as it seems to be."""
        return self.at(distance, bearing, self.coast.surface(distance))

    def _facets(self) -> list[shore.Facet]:
        place = {thing.name: self.at(*thing[1:4]) for thing in (*LANDMARKS, *TARGETS)}
        return [*self._land(), *self._landmarks(place), *self._targets(place)]

    def _land(self) -> list[shore.Facet]:
        heading, sea = self.scene.heading_deg, -self.coast.sea
        concrete, gravel = (150.0, 146.0, 138.0), (128.0, 120.0, 106.0)
        return [
            shore.ridge((-60.0, 75.0), 14000.0, ((0.0, 330.0), (0.2, 180.0), (0.3, -60.0), (0.56, -60.0), (0.68, 120.0),
                  (1.0, 420.0)), -34.0,
                  (74.0, 84.0, 92.0), heading=heading, rough=50.0, grain=260.0, seed=3.0),
            shore.ridge((22.0, 70.0), 3500.0, ((0.0, -25.0), (0.12, 30.0), (0.25, 75.0), (1.0, 160.0)), -25.0,
                  (82.0, 96.0, 74.0), heading=heading, rough=14.0, grain=60.0, seed=8.0),
            shore.ridge((8.0, 70.0), 2100.0, ((0.0, -22.0), (0.06, 30.0), (0.18, 112.0), (0.3, 80.0), (0.45, 30.0),
                  (1.0, 60.0)), -22.0, shore.GRASS, heading=heading, rough=12.0, grain=40.0, seed=5.0),
            shore.ridge((-75.0, -12.0), 2000.0, ((0.0, 120.0), (0.62, 48.0), (0.9, 12.0), (1.0, -24.0)), -22.0,
                  (88.0, 100.0, 76.0), heading=heading, rough=9.0, grain=35.0, seed=1.0),
            shore.ridge((-75.0, -17.0), 1500.0, ((0.0, 100.0), (0.7, 35.0), (0.93, 16.0), (1.0, -22.0)), -20.0,
                  shore.GRASS, heading=heading, rough=6.0, grain=25.0, seed=2.0),
            shore.ridge((1.9, 5.3), 2600.0, ((0.0, -22.0), (0.3, -12.0), (0.6, -10.0), (1.0, -22.0)), -22.0, shore.ROCK,
                  heading=heading, rough=3.0, grain=18.0, seed=6.0),
            shore.ridge((-16.0, -7.6), 1160.0, ((0.0, -14.0), (0.95, -14.5), (1.0, -19.0)), sea - 1, shore.ROCK,
                  heading=heading, rough=1.2, grain=4.0, seed=9.0),
            shore.ridge((10.5, 18.5), 905.0, ((0.0, -19.0), (0.15, -14.0), (0.85, -13.0), (1.0, -19.0)), sea - 1,
                  shore.ROCK, heading=heading, rough=1.5, grain=5.0, seed=4.0),
            shore.ridge((-16.0, -9.5), 655.0, ((0.0, -19.0), (0.2, -15.0), (0.8, -14.0), (1.0, -19.0)), sea - 1,
                  shore.ROCK, heading=heading, rough=1.2, grain=4.0, seed=7.0),
            *shore.ground((-420.0, 150.0, -10.0, 385.0), _QUAY, gravel, heading=heading),
            *shore.ground((130.0, 190.0, 420.0, 450.0), _QUAY, gravel, heading=heading),
            *shore.ground((-300.0, 15.0, 300.0, 205.0), _QUAY, concrete, heading=heading),
            *self._harbor(),
            *self._houses(),
        ]  # fmt: skip

    def _harbor(self) -> list[shore.Facet]:
        """What stands on the quay."""
        heading, mark, dark = self.scene.heading_deg, (206.0, 204.0, 196.0), (72.0, 76.0, 80.0)
        found = [
            *shore.ground((-300.0, 203.0, 300.0, 204.2), _QUAY, mark, heading=heading),
            *shore.ground((-300.0, 15.0, 300.0, 64.0), _QUAY, (86.0, 104.0, 58.0), heading=heading, grain=0.7),
            *shore.ground((-300.0, 64.0, 300.0, 65.0), _QUAY, (176.0, 172.0, 162.0), heading=heading),
            *shore.ground((-300.0, 65.0, 300.0, 74.0), _QUAY, (84.0, 86.0, 90.0), heading=heading, grain=0.5),
        ]
        found += [
            part
            for x in range(-90, 90, 9)
            for part in shore.ground((x, 69.3, x + 3.0, 69.6), _QUAY, mark, heading=heading)
        ]
        found += [
            part
            for x in range(-60, 60, 6)
            for part in shore.ground((x, 78.0, x + 0.2, 83.0), _QUAY, mark, heading=heading)
        ]
        for bearing in (-35.0, -23.0, -15.2, -2.4, 14.6, 24.6, 33.5):
            lamp = self.at(76.0 / math.cos(math.radians(bearing)), bearing, -6.5)
            arm = np.array([[-0.08, -0.1], [1.6, 0.05], [1.6, 0.25], [-0.08, 0.1]])
            found += [*shore.pole(lamp, 0.16, _QUAY, dark), shore.facing(lamp, arm, dark)]
        for bearing, color in ((-31.0, shore.RED), (-22.0, shore.WHITE), (-19.5, (44.0, 62.0, 96.0)),
                               (10.6, (60.0, 64.0, 70.0)),
                               (28.5, shore.WHITE), (1.2, (150.0, 132.0, 60.0))):  # fmt: skip
            found += _car(self.at(80.0 / math.cos(math.radians(bearing)), bearing, _QUAY), color)
        # A crane at the edge of the quay.
        steel = (198.0, 152.0, 44.0)
        foot = self.at(198.0, -34.5, _QUAY)
        for shape in (
            [(-5.0, 0.0), (-4.0, 0.0), (-4.0, 22.0), (-5.0, 22.0)], [(4.0, 0.0), (5.0, 0.0), (5.0, 22.0), (4.0, 22.0)],
            [(-5.0, 20.5), (5.0, 20.5), (5.0, 22.0), (-5.0, 22.0)],
            [(-1.6, 22.0), (2.4, 22.0), (2.4, 25.5), (-1.6, 25.5)],
            [(-1.0, 24.6), (-18.0, 37.6), (-18.4, 36.8), (-1.4, 23.2)],
        ):  # fmt: skip
            found.append(shore.facing(foot, np.array(shape), steel))
        return found

    def _houses(self) -> list[shore.Facet]:
        """Houses that are no landmarks: so that it looks like a place."""
        random = np.random.default_rng(20)
        found: list[shore.Facet] = []
        paints = ((206.0, 198.0, 184.0), (170.0, 84.0, 66.0), (196.0, 168.0, 110.0), (222.0, 222.0, 216.0))
        for bearing, distance, up in (
            (-33.0, 1480.0, 22.0), (-31.0, 1490.0, 16.0), (-29.5, 1470.0, 20.0), (-27.8, 1485.0, 10.0),
            (-26.0, 1478.0, 12.0), (-20.6, 1480.0, 4.0), (24.5, 2080.0, 24.0), (26.2, 2075.0, 14.0),
            (27.9, 2085.0, 20.0), (30.2, 2078.0, 10.0), (32.4, 2080.0, 16.0),
        ):  # fmt: skip
            size = (float(random.uniform(16, 34)), float(random.uniform(10, 18)))
            paint_ = paints[int(random.integers(len(paints)))]
            found += shore.building(self.at(distance, bearing, up + size[1] / 2), size, paint_, windows=(4.0, 3.4))
        rust, green, blue = (158.0, 70.0, 48.0), (92.0, 110.0, 84.0), (58.0, 92.0, 124.0)
        for bearing, distance, color in (
            (-34.0, 150.0, rust), (-32.4, 150.0, green), (-36.5, 160.0, blue),
            (-14.5, 170.0, blue), (-19.5, 165.0, rust), (25.0, 160.0, green), (-24.0, 300.0, blue),
            (-21.9, 300.0, rust),
            (-11.5, 280.0, green), (24.5, 250.0, rust), (26.0, 252.0, blue), (31.5, 330.0, (188.0, 184.0, 172.0)),
        ):  # fmt: skip
            found += shore.building(self.at(distance, bearing, _QUAY + 2.8), (9.0, 2.8), color)
        return found

    def _landmarks(self, place: dict[str, Floats]) -> list[shore.Facet]:
        return [
            *shore.panel(place["panel 1"], 2.4, _QUAY),
            *shore.panel(place["panel 2"], 3.0, _QUAY),
            *shore.panel(place["panel 3"], 3.2, _QUAY),
            *shore.building(place["hut"], (11.0, 6.0), (228.0, 222.0, 208.0), windows=(3.6, 4.4)),
            *shore.building(place["barn"], (18.0, 7.0), (196.0, 170.0, 120.0), windows=(4.5, 5.0)),
            *shore.pole(place["chimney"], 1.6, _QUAY, (128.0, 70.0, 56.0)),
            *shore.building(self.at(424.0, 28.6, -6.0), (24.0, 9.0), (170.0, 160.0, 146.0), windows=(4.0, 4.4)),
            *shore.building(place["depot"], (26.0, 22.0), (176.0, 88.0, 66.0), windows=(5.0, 5.4)),
            *shore.building(place["silo"], (30.0, 19.0), (226.0, 224.0, 218.0), side=0.5),
            *shore.pole(place["beacon"], 2.6, -18.0, shore.BLACK),
            *shore.pole(place["antenna"], 3.0, 10.0, (110.0, 44.0, 40.0)),
            *shore.pole(place["hill mast"], 4.0, 90.0, (70.0, 66.0, 70.0)),
            *shore.pole(place["lighthouse"], 7.0, -16.0, shore.RED),
        ]

    def _targets(self, place: dict[str, Floats]) -> list[shore.Facet]:
        hull = (44.0, 40.0, 46.0)
        ferry, freighter = place["ferry"], place["freighter"]
        turbine, yawl = place["turbine"], place["yawl"]
        blade = shore.box_outline((-2.6, -56.0, 2.6, 0.0))
        hub = turbine - np.array([0.0, 0.0, 58.0])
        white = (206.0, 208.0, 210.0)
        others = [
            shore.facing(hub, np.array([[0.0, -2.6], [s * 49.0, -30.9], [s * 47.0, -34.0], [0.0, 2.6]]), white)
            for s in (-1.0, 1.0)
        ]
        outline = np.array([[-16.0, -30.4], [62.0, -30.4], [68.0, -20.0], [-18.0, -20.0]])
        return [
            *shore.pole(place["gate"], 0.36, _QUAY, shore.WHITE),
            *shore.ship(self.sea_at(250.0, 14.5), 10.0, 3, 1.0)[:1],
            shore.facing(yawl, shore.box_outline((-0.25, -8.0, 0.25, 0.0)), (214.0, 206.0, 190.0)),
            *shore.pole(place["buoy"], 1.3, -18.4, (226.0, 206.0, 70.0)),
            shore.facing(ferry, outline, (36.0, 52.0, 88.0)),
            shore.facing(ferry, shore.box_outline((0.0, -20.5, 52.0, 0.0)), (58.0, 84.0, 136.0)),
            shore.facing(ferry, shore.box_outline((14.0, -19.0, 50.0, -9.0)), shore.WHITE, windows=(5.0, 5.0)),
            shore.facing(ferry, shore.box_outline((-12.0, -20.0, -1.0, -15.0)), shore.WHITE),
            shore.facing(ferry, shore.box_outline((34.0, 0.0, 41.0, 8.0)), shore.RED),
            *shore.building(place["tower"], (16.0, 50.0), (72.0, 66.0, 62.0), side=0.4),
            shore.facing(turbine, shore.box_outline((-3.0, -160.0, 3.0, -56.0)), (96.0, 98.0, 102.0)),
            *others,
            shore.facing(turbine, blade, (88.0, 90.0, 96.0)),
            shore.facing(freighter, np.array([[-60.0, -60.5], [220.0, -60.5], [236.0, -36.0], [-66.0, -36.0]]), hull),
            shore.facing(freighter, shore.box_outline((0.0, -37.0, 48.0, 0.0)), shore.BLACK),
            shore.facing(freighter, shore.box_outline((70.0, -36.0, 150.0, -14.0)), (150.0, 66.0, 48.0)),
            shore.facing(freighter, shore.box_outline((158.0, -36.0, 214.0, -18.0)), (60.0, 98.0, 128.0)),
        ]  # fmt: skip


def _car(foot: Floats, color: shore.Color) -> list[shore.Facet]:
    cabin = np.array([[-1.2, 0.8], [1.5, 0.8], [1.0, 1.45], [-0.7, 1.45]])
    tires = [shore.facing(foot, shore.box_outline((x - 0.32, 0.0, x + 0.32, 0.6)), shore.BLACK) for x in (-1.35, 1.35)]
    return [
        shore.facing(foot, shore.box_outline((-2.1, 0.28, 2.1, 0.85)), color),
        shore.facing(foot, cabin, (64.0, 76.0, 88.0)),
        *tires,
    ]


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
        "ships": {
            "times": [number / RATE for number in range(frames)],
            "places": _ship_places(site, frames),
        },
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
        facets = shore.ship(site.sea_at(distance, bearing), passage.length, passage.style, forward)
        corners = np.concatenate([facet.outline for facet in facets])
        across, up = 0.5 * (corners.min(0) + corners.max(0))
        angle = math.radians(site.scene.heading_deg + bearing)
        water = site.coast.surface(distance)
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
    sides = [
        slice(
            max(0, min(window[axis].start for window in windows) - _AROUND),
            min(shape[axis], max(window[axis].stop for window in windows) + _AROUND),
        )
        for axis in (0, 1)
    ]
    return sides[0], sides[1]


def _meet(first: tuple[slice, slice], second: tuple[slice, slice]) -> bool:
    return all(a.start < b.stop and b.start < a.stop for a, b in zip(first, second, strict=True))


# The night above a practice site: stars as the cameras see them, wherever a catalogue says that they stand.

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
    levels: NDArray[np.uint8] = np.clip(np.rint(light + NOISE * random.standard_normal(light.shape)), 0, 255).astype(
        np.uint8
    )
    return levels
