"""How well somebody did on a practice site: cameras, rig, positions and tracks against the truth, in meters."""

from __future__ import annotations

import csv
import io
import math
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import orjson
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.errors import FileError, InputError
from kcal.files import read_bytes
from kcal.lens.camera import Camera
from kcal.lens.rig import Origin, Rig
from kcal.lens.turning import rotation_between
from kcal.locate.budget import range_sigmas
from kcal.locate.geodesy import geodetic_to_enu
from kcal.locate.localizer import Localizer

Floats = NDArray[np.float64]
_FAR = 5000.0  # meters, at which errors of lenses are told
_EXACT = 1e-3  # px: noise of marks that are exact
_STRAY = 0.2  # share of a ship's distance: a track that is farther off belongs to no ship


class LensScore(NamedTuple):
    """How far a camera is off after the turn that fits best, over the whole image.

    Attributes:
        rms: px.
        largest: px.
        middle: px, RMS over the middle half of the image's width and height.
        sideways_m: what the RMS is at 5 km, across the line of sight.
        range_m: and in range, for a second camera at the site's baseline.
    """

    rms: float
    largest: float
    middle: float
    sideways_m: float
    range_m: float


def score_lens(camera: Camera, truth: dict[str, Any], baseline: float) -> LensScore:
    """Compare a camera with the true one.

    Args:
        camera: calibrated.
        truth: of one camera, see `kcal.sim.practice`.
        baseline: meters.

    Raises:
        InputError: images of another size.
    """
    if list(camera.size) != truth["size"]:
        raise InputError(
            f"this camera has images of {camera.size[0]}x{camera.size[1]} px, those of the site have "
            f"{truth['size'][0]}x{truth['size'][1]}"
        )
    pixels, true = (torch.tensor(truth[name], dtype=torch.float64) for name in ("pixels", "rays"))
    with torch.no_grad():
        rays, valid = camera.unproject(pixels)
        turn = rotation_between(true[valid], rays[valid])
        focal = float(camera.focal.detach().mean())
        seen, there = camera.project(1e9 * (true @ turn.T))
    off = torch.linalg.vector_norm(seen - pixels, dim=-1)
    off = torch.where(valid & there, off, torch.nan)
    size = torch.tensor(camera.size, dtype=torch.float64)
    central = ((pixels - 0.5 * (size - 1)).abs() < 0.25 * size).all(-1)

    def rms(values: Tensor) -> float:
        return float(values[values.isfinite()].square().mean().sqrt())

    whole = rms(off)
    return LensScore(
        rms=whole,
        largest=float(off[off.isfinite()].max()),
        middle=rms(off[central]),
        sideways_m=whole / focal * _FAR,
        range_m=whole * _FAR**2 / (focal * baseline),
    )


class RangeScore(NamedTuple):
    """How far ranges are off at a true range, with marks that have no noise.

    Attributes:
        range_m: the true one.
        mean: error over the image, meters.
        rms: of the error.
        stated: one sigma as the rig states it in the middle of the image; None if it states none.
    """

    range_m: float
    mean: float
    rms: float
    stated: float | None


@torch.no_grad()
def score_rig(rig: Rig, truth: dict[str, Any]) -> list[RangeScore]:
    """Compare ranges of exact marks with the true ones, over the image."""
    placed = rig.mounting is not None
    localize = Localizer(
        rig,
        pixel_sigma=_EXACT,
        origin=None if placed else Origin(lat=0.0, lon=0.0, height=0.0),
        heading_deg=None if placed else 0.0,
    )
    found = []
    for pairs in truth["pairs"]:
        left, right = (torch.tensor(pairs[side], dtype=torch.float64) for side in ("left", "right"))
        ranges = torch.linalg.vector_norm(localize(left, right).enu, dim=-1)
        off = (ranges - pairs["range_m"]).numpy()
        off = off[np.isfinite(off)]
        stated = None
        if rig.covariance is not None:
            stated = float(range_sigmas(rig, [pairs["range_m"]], pixel_sigma=_EXACT).total[0])
        mean, rms = (float(off.mean()), math.sqrt(float(np.square(off).mean()))) if len(off) else (math.nan, math.nan)
        found.append(RangeScore(pairs["range_m"], mean, rms, stated))
    return found


class PositionScore(NamedTuple):
    """How far a position is off.

    Attributes:
        name: of the target.
        range_m: the true one.
        level: meters from the truth, on the map.
        range_off: range minus the true one, meters.
        contains: whether the 95 % interval contains the true range.
    """

    name: str
    range_m: float
    level: float
    range_off: float
    contains: bool


def score_positions(path: Path, truth: dict[str, Any]) -> list[PositionScore]:
    """Compare positions with the true ones, by name."""
    true = {name.casefold(): np.array(place) for name, place in truth["targets"].items()}
    found = []
    for row in located_rows(path, truth):
        place = true.get(row.name.strip().casefold())
        if place is not None:
            found.append(_position_score(row, place))
    return sorted(found, key=lambda score: score.range_m)


class TrackScore(NamedTuple):
    """How well a ship was followed.

    Attributes:
        name: of the ship.
        range_m: true one, on average.
        followed: share of the moments at which there was a position.
        tracks: how many tracks it had.
        level: median distance from the truth on the map, meters.
        range_off: median size of the range's error.
        contained: share of 95 % intervals that contain the true range.
    """

    name: str
    range_m: float
    followed: float
    tracks: int
    level: float
    range_off: float
    contained: float


def score_tracks(path: Path, truth: dict[str, Any]) -> tuple[list[TrackScore], int]:
    """Compare tracks with the ships that they are nearest to; and how many tracks are near none."""
    times = np.array(truth["ships"]["times"])
    ships = {name: np.array(places) for name, places in truth["ships"]["places"].items()}
    tracks: dict[str, list[tuple[float, PositionRow]]] = defaultdict(list)
    for row in located_rows(path, truth):
        if row.time is not None:
            tracks[row.name].append((row.time, row))
    scores: dict[str, list[tuple[int, PositionScore]]] = {ship: [] for ship in ships}
    strays = 0
    for rows in tracks.values():
        each = {
            ship: [(round(1e3 * time), _position_score(row, _place_at(places, times, time))) for time, row in rows]
            for ship, places in ships.items()
        }
        nearest = min(each, key=lambda ship: float(np.median([score.level for _, score in each[ship]])))
        if np.median([score.level / score.range_m for _, score in each[nearest]]) > _STRAY:
            strays += 1
        else:
            scores[nearest] += each[nearest]
    found = []
    for ship, own in scores.items():
        found.append(
            TrackScore(
                name=ship,
                range_m=float(np.linalg.norm(ships[ship], axis=-1).mean()),
                followed=len({moment for moment, _ in own}) / len(times),
                tracks=len({score.name for _, score in own}),
                level=_median([score.level for _, score in own]),
                range_off=_median([abs(score.range_off) for _, score in own]),
                contained=float(np.mean([score.contains for _, score in own])) if own else math.nan,
            )
        )
    return sorted(found, key=lambda score: score.range_m), strays


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else math.nan


def _place_at(places: Floats, times: Floats, time: float) -> Floats:
    return np.array([np.interp(time, times, column) for column in places.T])


def _position_score(row: PositionRow, true: Floats) -> PositionScore:
    away = float(np.linalg.norm(true))
    east, north = row.enu[:2] - true[:2]
    contains = row.range_low_m <= away <= row.range_high_m
    return PositionScore(row.name, away, math.hypot(east, north), row.range_m - away, contains)


class PositionRow(NamedTuple):
    """A located row of a file; `enu` in meters from where the left camera truly stands, time in seconds."""

    name: str
    enu: Floats
    range_m: float
    range_low_m: float
    range_high_m: float
    time: float | None


def located_rows(path: Path, truth: dict[str, Any]) -> list[PositionRow]:
    """The located rows of a CSV, GeoJSON or GeoJSONL of `kcal locate` or `kcal live`.

    Raises:
        FileError: a file that is none of these.
    """
    origin = Origin(**truth["origin"])
    found = []
    for row in _records(path):
        if row.get("status") != "ok":
            continue
        try:
            numbers = [float(row[key]) for key in ("lat", "lon", "height_ellipsoidal_m", "range_m", "range_low_m")]
            # Infinity is null in JSON.
            high = row.get("range_high_m")
            high_m = math.inf if high in (None, "") else float(high)
            time = row.get("time_s")
            name = str(row["name"])
            enu = geodetic_to_enu(torch.tensor(numbers[:3], dtype=torch.float64), origin).numpy()
            if not all(map(math.isfinite, numbers)) or math.isnan(high_m):
                raise ValueError(f"finite numbers, of {name}")
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise FileError(f"{path}: a row without {error}; kcal locate and kcal live write other files") from error
        found.append(PositionRow(name, enu, numbers[3], numbers[4], high_m, None if time is None else float(time)))
    return found


def _records(path: Path) -> Iterator[dict[str, Any]]:
    text = read_bytes(path)
    try:
        if path.suffix == ".csv":
            yield from csv.DictReader(io.StringIO(text.decode("utf-8-sig")))
            return
        lines = text.splitlines() if path.suffix == ".geojsonl" else [text]
        for line in lines:
            content = orjson.loads(line)
            for feature in content.get("features", [content]):
                yield dict(feature["properties"])
    except (ValueError, KeyError, TypeError, AttributeError, csv.Error) as error:
        raise FileError(f"{path}: no positions of kcal: {error}") from error
