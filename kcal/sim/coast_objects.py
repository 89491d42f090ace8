"""Things on a coast, made of flat pieces: panels, poles, buildings, ridges, ships."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from kcal.sim.facets import Color, Facet
from kcal.sim.noise import smooth_noise

Floats = NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])
BLACK: Color = (34.0, 36.0, 40.0)
WHITE: Color = (236.0, 236.0, 232.0)
RED: Color = (168.0, 52.0, 42.0)
ROCK: Color = (112.0, 106.0, 98.0)
GRASS: Color = (92.0, 108.0, 72.0)
Box = tuple[float, float, float, float]


def box_outline(box: Box) -> Floats:
    """Corners (4, 2) of left, bottom, right, top."""
    left, bottom, right, top = box
    return np.array([[left, bottom], [right, bottom], [right, top], [left, top]])


def facing(
    place: Floats, outline: Floats, color: Color, *, turn: float = 0.0, texture: float = 0.0, grain: float = 1.0,
    windows: tuple[float, float] | None = None, top: Callable[[Floats], Floats] | None = None,
) -> Facet:  # fmt: skip
    """An upright piece at a place (3,) that faces the scene's origin, or is turned from that by some degrees."""
    angle = math.atan2(place[0], place[1]) + math.radians(turn)
    along = np.array([math.cos(angle), -math.sin(angle), 0.0])
    return Facet(
        origin=place, along=along, up=UP, outline=outline, color=color, texture=texture, grain=grain, windows=windows,
        top=top,
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
    bearings: tuple[float, float], distance: float, heights: Sequence[tuple[float, float]], foot: float, color: Color,
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
        edge: Floats = np.interp(share, shares, levels) + rough * detail
        return edge

    high = max(levels) + 2 * rough + 1.0
    return facing(place, box_outline((-half, foot, half, high)), color, texture=texture, grain=grain, top=top)


def ground(box: Box, height: float, color: Color, *, heading: float, grain: float = 1.5) -> list[Facet]:
    """Level land: left, near, right and far edge in meters to the right and ahead; its far edges have a low wall."""
    angle = math.radians(heading)
    right = np.array([math.cos(angle), -math.sin(angle), 0.0])
    ahead = np.array([math.sin(angle), math.cos(angle), 0.0])
    return [
        Facet(
            origin=height * UP, along=right, up=ahead, outline=box_outline(box), color=color, texture=0.16, grain=grain
        )
    ]


def ship(place: Floats, length: float, style: int, forward: float) -> list[Facet]:
    """A ship at a place on the water: `forward` is 1 if it moves to the right, -1 to the left.

    Args:
        place: (3,) its middle, on the waterline.
        length: meters.
        style: 0 ferry, 1 trawler, 2 freighter, 3 sailing boat.
        forward: 1 or -1.
    """
    parts = _STYLES[style]
    found = []
    for corners, color, windows in parts:
        outline = length * np.array(corners)
        outline[:, 0] *= forward
        found.append(facing(place, outline, color, windows=windows))
    return found


def _rectangle(left: float, bottom: float, right: float, top: float) -> list[tuple[float, float]]:
    return [(left, bottom), (right, bottom), (right, top), (left, top)]


_Part = tuple[list[tuple[float, float]], Color, tuple[float, float] | None]
# Pieces of ships of length 1, bow to the right.
_STYLES: tuple[list[_Part], ...] = (
    [
        ([(-0.48, 0.0), (0.44, 0.0), (0.5, 0.08), (-0.5, 0.08)], (38.0, 58.0, 96.0), None),
        (_rectangle(-0.44, 0.08, 0.36, 0.16), WHITE, (2.6, 2.4)),
        (_rectangle(-0.3, 0.16, 0.24, 0.21), WHITE, (2.6, 2.4)),
        (_rectangle(-0.2, 0.21, -0.08, 0.29), RED, None),
        (_rectangle(0.12, 0.21, 0.135, 0.32), BLACK, None),
    ],
    [
        ([(-0.46, 0.0), (0.4, 0.0), (0.5, 0.17), (-0.5, 0.11)], (150.0, 58.0, 40.0), None),
        (_rectangle(-0.05, 0.12, 0.22, 0.34), WHITE, (2.2, 2.6)),
        (_rectangle(-0.3, 0.1, -0.275, 0.42), BLACK, None),
        (_rectangle(0.08, 0.34, 0.1, 0.44), BLACK, None),
    ],
    [
        ([(-0.48, 0.0), (0.46, 0.0), (0.5, 0.08), (-0.49, 0.07)], (46.0, 44.0, 50.0), None),
        (_rectangle(-0.46, 0.07, -0.33, 0.21), WHITE, (4.0, 3.4)),
        (_rectangle(-0.42, 0.21, -0.37, 0.26), (196.0, 128.0, 40.0), None),
        (_rectangle(-0.28, 0.07, 0.02, 0.13), (150.0, 66.0, 48.0), (6.2, 40.0)),
        (_rectangle(0.05, 0.07, 0.38, 0.11), (58.0, 98.0, 128.0), (6.2, 40.0)),
    ],
    [
        ([(-0.5, 0.02), (0.4, 0.0), (0.52, 0.1), (-0.5, 0.1)], WHITE, None),
        ([(0.02, 0.14), (0.46, 0.14), (0.02, 1.1)], (232.0, 226.0, 210.0), None),
        ([(-0.46, 0.17), (-0.01, 0.17), (-0.01, 1.16)], (226.0, 220.0, 204.0), None),
    ],
)  # fmt: skip
