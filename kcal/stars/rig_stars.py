"""From named stars of night images of several cameras to what a rig is solved from."""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from kcal.calibrate.rig.marks import StarSource
from kcal.calibrate.rig.source import Effect
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.projection import FAR
from kcal.lens.rig import Origin
from kcal.stars.night import NamedStars
from kcal.stars.sky import EARTH_RATE, StarCatalog, pole_in_enu, refraction_sigma
from kcal.threads import in_one_thread

# Radians: of the Yale catalog along an axis, 1 second of arc.
_CATALOG_SIGMA = math.radians(1.0 / 3600)
# px: stars without a name are matched within this distance of where the named ones put them.
_MATCH = 2.0
# s: images of one time.
_SAME_TIME = 1e-3
# h: a gap that is longer is a day; and the shortest night in which clocks drift by something.
_DAY_BETWEEN, _LEAST_NIGHT = 6.0, 1.0

# Images of one time: NamedStars by the number of the camera.
Moment = Mapping[int, NamedStars]


@in_one_thread
def star_source(
    moments: Sequence[Moment],
    cameras: Sequence[Camera],
    *,
    clock_sigma: float = 0.1,
    drift_sigma: float = 0.05,
    origin: Origin | None = None,
    catalog: StarCatalog | None = None,
) -> StarSource:
    """Stars of night images as a source of a rig, with or without directions on the Earth.

    If all images have their attitude on the Earth (`NamedStars.on_earth`), named stars are known in east, north, up,
    and the clock, UT1 and the air's temperature and pressure are unknowns with their sigmas. Otherwise stars only tell
    how the cameras are turned against each other. In both cases the offset between the cameras' clocks is an unknown:
    no residual shows it, and a second of it is 15 seconds of arc.

    Args:
        moments: images of each moment by the number of their camera.
        cameras: of the rig.
        clock_sigma: of the offset between the clock of each camera and that of the first, seconds, as each night
            begins.
        drift_sigma: of the rate at which it changes, seconds an hour, another one each night; it counts in nights
            of an hour or more. 0.05 are 14 millionths, a free quartz; 0 where GPS or a network keeps the clocks.
        origin: of the rig's frame, if that is one on the Earth.
        catalog: the stars; kcal's own if left out.

    Raises:
        InputError: no stars, or a clock_sigma that is no number of seconds.

    Example:
        >>> camera = Camera.build(focal=(900, 900), center=(479.5, 299.5), size=(960, 600), model="pinhole")
        >>> star_source([], (camera, camera))
        Traceback (most recent call last):
        kcal.errors.InputError: no stars were named in two cameras at the same time
    """
    for name, value in (("clock_sigma", clock_sigma), ("drift_sigma", drift_sigma)):
        if not 0 <= value < math.inf:
            raise InputError(f"{name} {value}: seconds, not below 0, are needed")
    catalog = catalog or StarCatalog.bundled()
    images = [image for moment in moments for image in moment.values()]
    on_earth = bool(images) and all(image.on_earth for image in images)
    rows = [
        row for number, moment in enumerate(moments)
        for row in (*_with_names(moment, catalog, number, on_earth=on_earth), *_without_names(moment, cameras, number))
    ]  # fmt: skip
    if not rows:
        raise InputError("no stars were named in two cameras at the same time")
    marks = np.full((len(rows), len(cameras), 3), np.nan)
    for k, row in enumerate(rows):
        for camera, place in row.places.items():
            found = moments[row.moment][camera].detected
            marks[k, camera] = *found.pixels[place], found.sigma[place]
    direction = torch.from_numpy(np.array([row.direction for row in rows]))
    altitude = torch.arcsin(direction[:, 2].clamp(-1, 1)).numpy()
    sigma = torch.from_numpy(np.hypot(_CATALOG_SIGMA, refraction_sigma(np.nan_to_num(altitude, nan=1.0))))
    sigma[direction.isnan().any(-1)] = math.inf
    if origin is not None:
        pole = torch.from_numpy(pole_in_enu(origin.lat))
    else:
        # In the first camera's frame, which is that of the rig; the pole of J2000 is near enough.
        first = next((moment[0] for moment in moments if 0 in moment), None)
        if first is None:
            raise InputError("stars without a place on the Earth: images of the first camera are needed")
        pole = first.attitude.rotation[:, 2]
    # An hour later the sky has turned from east to west: against the axis that points north.
    second = -EARTH_RATE * pole
    nights = _nights(moments, rows) if drift_sigma > 0 else {}
    effects = _clock_effects(second, len(cameras), nights, clock_sigma, drift_sigma)
    if on_earth:
        effects += _effects_on_earth(second, moments, rows, len(cameras), catalog)
    return StarSource(
        names=tuple(row.name for row in rows),
        pixels=torch.from_numpy(marks[..., :2].copy()),
        pixel_sigma=torch.from_numpy(marks[..., 2].copy()),
        direction=direction,
        direction_sigma=sigma,
        effects=tuple(effects),
    )


def moments_of(
    images: Sequence[Sequence[NamedStars]], *, tolerance: float = _SAME_TIME
) -> tuple[list[dict[int, NamedStars]], int]:
    """Images of each camera put together by their times; without times, in their order.

    Args:
        images: of each camera; none of some.
        tolerance: seconds.

    Returns:
        the times, and how many images have no partner. On the Earth these are times of their own.

    Raises:
        InputError: images without times that are not as many for each camera.
    """
    if not all(image.view.time is not None for own in images for image in own):
        some = [camera for camera, own in enumerate(images) if own]
        if len({len(images[camera]) for camera in some}) > 1:
            raise InputError("images without times are paired in their order: as many are needed for each camera")
        together = zip(*(images[camera] for camera in some), strict=True)
        return [dict(zip(some, moment, strict=True)) for moment in together], 0
    found: list[tuple[datetime.datetime, dict[int, NamedStars]]] = []
    for camera, own in enumerate(images):
        for image in own:
            time = image.view.time
            assert time is not None
            here = next((m for t, m in found if abs((t - time).total_seconds()) <= tolerance and camera not in m), None)
            if here is None:
                found.append((time, {camera: image}))
            else:
                here[camera] = image
    moments = [moment for _, moment in sorted(found, key=lambda one: one[0])]
    alone = sum(len(moment) == 1 for moment in moments)
    on_earth = all(image.on_earth for own in images for image in own)
    return [moment for moment in moments if on_earth or len(moment) > 1], alone


class _Row(NamedTuple):
    """A star of a time; `places` are its numbers among the detected stars of the cameras that see it."""

    name: str
    moment: int
    star: int
    direction: NDArray[np.float64]
    places: dict[int, int]


def _with_names(moment: Moment, catalog: StarCatalog, number: int, *, on_earth: bool) -> Iterator[_Row]:
    seen: dict[int, dict[int, int]] = {}
    for camera, image in moment.items():
        for place, star in enumerate(image.attitude.star.tolist()):
            if star >= 0:
                seen.setdefault(star, {})[camera] = place
    for star, places in seen.items():
        if on_earth or len(places) > 1:
            direction = moment[next(iter(places))].directions[star] if on_earth else np.full(3, np.nan)
            yield _Row(f"{catalog.name_of(catalog.number[star])} at {number + 1}", number, star, direction, places)


def _without_names(moment: Moment, cameras: Sequence[Camera], number: int) -> Iterator[_Row]:
    """Stars that the catalog does not have, seen by the first and another camera where the named ones put them."""
    first = min(moment)
    here = moment[first]
    free = np.flatnonzero(here.attitude.star < 0)
    for camera in sorted(set(moment) - {first}):
        there = moment[camera]
        others = np.flatnonzero(there.attitude.star < 0)
        if not len(free) or not len(others):
            continue
        rays, valid = cameras[first].unproject(torch.from_numpy(here.detected.pixels[free]))
        expected, seen = cameras[camera].project(FAR * rays @ (there.attitude.rotation @ here.attitude.rotation.T).T)
        expected = torch.where((valid & seen)[:, None], expected, 1e9)
        tree = cKDTree(there.detected.pixels[others])
        distance, match = tree.query(expected.numpy(), distance_upper_bound=_MATCH)
        back = cKDTree(expected.numpy()).query(there.detected.pixels[others])[1]
        for k in np.flatnonzero(np.isfinite(distance)):
            if back[match[k]] == k:
                places = {first: int(free[k]), camera: int(others[match[k]])}
                yield _Row(f"light {free[k]} at {number + 1}, {camera}", number, -1, np.full(3, np.nan), places)


def _nights(moments: Sequence[Moment], rows: Sequence[_Row]) -> dict[int, Tensor]:
    """By the number of each night of an hour or more: (S,) hours of each star since it began, 0 in other nights."""
    times = [next(iter(moment.values())).view.time for moment in moments]
    if None in times:
        return {}
    hours = np.array([time.timestamp() / 3600.0 for time in times if time is not None])
    order = np.argsort(hours, kind="stable")
    night = np.empty(len(hours), np.int64)
    night[order] = np.cumsum(np.diff(hours[order], prepend=hours[order[0]]) > _DAY_BETWEEN)
    of_row = np.array([row.moment for row in rows])
    found = {}
    for number in range(night.max() + 1):
        own = night == number
        if np.ptp(hours[own]) >= _LEAST_NIGHT:
            since = np.where(own, hours - hours[own].min(), 0.0)
            found[number + 1] = torch.from_numpy(since[of_row])
    return found


def _clock_effects(
    second: Tensor, cameras: int, nights: Mapping[int, Tensor], clock_sigma: float, drift_sigma: float
) -> list[Effect]:
    """Clocks against that of the first camera, whose turn of the sky in a second is given."""
    found = []
    for camera in range(1, cameras):
        turn, whose = torch.zeros(cameras, 3, dtype=torch.float64), f"the clock of camera {camera + 1}"
        turn[camera] = second
        if clock_sigma > 0:
            found.append(Effect(name=f"{whose} against that of the first", turn=clock_sigma * turn))
        for number, hours in nights.items():
            found.append(Effect(name=f"drift of {whose}, night {number}", turn=drift_sigma * turn, factor=hours))
    return found


def _effects_on_earth(
    second: Tensor, moments: Sequence[Moment], rows: Sequence[_Row], cameras: int, catalog: StarCatalog
) -> list[Effect]:
    """The clock against UT1, and the air."""
    some = next(iter(moments[0].values()))
    found = [Effect(name="the clocks against UT1", turn=(some.view.clock_sigma * second).expand(cameras, 3))]
    shifts: dict[str, Tensor] = {}
    for number, moment in enumerate(moments):
        at = [k for k, row in enumerate(rows) if row.moment == number and row.star >= 0]
        if not at:
            continue
        view = next(iter(moment.values())).view
        for name, shift in view.by_air(catalog, np.array([rows[k].star for k in at])):
            whole = shifts.setdefault(name, torch.zeros(len(rows), cameras, 3, dtype=torch.float64))
            whole[at] = torch.from_numpy(shift)[:, None]
    return found + [Effect(name=name, shift=shift) for name, shift in shifts.items()]
