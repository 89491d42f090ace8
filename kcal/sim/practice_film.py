"""A film of the coast: ships that move before a still picture, and where they truly are."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kcal.sim.backdrop import exposed
from kcal.sim.coast_objects import ship
from kcal.sim.facets import Cut, Facet, cut, facet_windows, paint
from kcal.sim.practice import BLUR, NOISE, PASSAGES, SIDES, Passage, PracticeSite, Side

Floats = NDArray[np.float64]
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
    facets: list[Facet]


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
        facets = ship(site.sea_at(distance, bearing), passage.length, passage.style, forward)
        corners = np.concatenate([facet.outline for facet in facets])
        across, up = 0.5 * (corners.min(0) + corners.max(0))
        angle = math.radians(site.scene.heading_deg + bearing)
        water = site.coast.surface(distance)
        place = np.array([distance * math.sin(angle), distance * math.cos(angle), water + up])
        found.append(ShipAt(passage, place + across * facets[0].along, facets))
    return sorted(found, key=lambda each: -each.facets[0].distance)


def frames(site: PracticeSite, side: Side, count: int = RATE * SECONDS) -> Iterator[NDArray[np.uint8]]:
    """Frames (H, W) of one camera, in gray; what does not move has the same noise in all of them, which films smaller.

    Args:
        site: the coast.
        side: which camera.
        count: how many.
    """
    camera, light = site.eyes[side], site.light(side)
    random = np.random.default_rng([site.scene.seed, SIDES.index(side), 2])
    still = exposed(light @ _LUMA, BLUR, NOISE, random)
    windows = facet_windows(camera, site.facets)
    fixed = [(facet, window) for facet, window in zip(site.facets, windows, strict=True) if window is not None]
    for first in range(0, count, _AT_ONCE):
        moments = [ships_at(site, n / max(count - 1, 1)) for n in range(first, min(first + _AT_ONCE, count))]
        pieces = [facet for ships in moments for each in ships for facet in each.facets]
        places = iter(facet_windows(camera, pieces))
        for ships in moments:
            frame = still.copy()
            moving = [(facet, place) for each in ships for facet in each.facets if (place := next(places)) is not None]
            for each in ships:
                own = [place for facet, place in moving if facet in each.facets]
                if own:
                    window = _ship_window(own, frame.shape)
                    light = _with_ships(site, side, window, fixed, moving)
                    seen = exposed(light @ _LUMA, BLUR, NOISE, random)
                    inner = tuple(slice(_AROUND, size - _AROUND) for size in seen.shape)
                    frame[window][inner] = seen[inner]
            yield frame


_Placed = tuple[Facet, tuple[slice, slice]]


def _with_ships(
    site: PracticeSite, side: Side, window: tuple[slice, slice], fixed: list[_Placed], moving: list[_Placed]
) -> Floats:
    """Light (H, W, 3) in a window with all ships in it, and over them what is nearer than they are."""
    camera, part = site.eyes[side], site.light(side)[window].copy()
    ships = [each for each in moving if _meet(each[1], window)]
    farthest = max(facet.distance for facet, _ in ships)
    nearer = [each for each in fixed if each[0].distance < farthest and _meet(each[1], window)]
    cuts: dict[bytes, Cut] = {}
    for facet, place in sorted((*ships, *nearer), key=lambda each: -each[0].distance):
        # All pieces of a ship lie on one plane.
        plane = facet.origin.tobytes() + facet.along.tobytes() + facet.up.tobytes()
        cuts[plane] = at = cuts.get(plane) or cut(camera, facet, window, small=facet.up[2] == 1)
        inner = tuple(
            slice(max(own.start - whole.start, 0), max(own.stop - whole.start, 0))
            for own, whole in zip(place, window, strict=True)
        )
        paint(part[inner], facet, at.part(inner), site.coast.haze)
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
