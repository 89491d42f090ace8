"""How well somebody did on a practice site: cameras, rig, positions and tracks against the truth, in meters."""

from __future__ import annotations

import csv
import io
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
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
from kcal.lens.pose import rotation_between
from kcal.lens.rig import Origin, Rig
from kcal.locate.budget import range_sigmas
from kcal.locate.geodesy import geodetic_to_enu
from kcal.locate.localizer import Localizer
from kcal.table import Columns, Table

Floats = NDArray[np.float64]
_FAR = 5000.0  # meters, at which errors of lenses are told
_EXACT = 1e-3  # px: noise of marks that are exact
_STRAY = 0.2  # share of a ship's distance: a track that is farther off belongs to no ship


def score_cameras(cameras: Mapping[str, Camera], truth: dict[str, Any]) -> Table:
    """How far each camera is off after the turn that fits best, over the whole image and in its middle half.

    What the RMS is at 5 km is told across the line of sight, and in range for two such cameras at the site's baseline.

    Args:
        cameras: calibrated, by their sides.
        truth: of the site, see `kcal.sim.practice`.

    Raises:
        InputError: images of another size.
    """
    columns: Columns = {
        "camera": "camera", "rms_px": ("RMS px", "{:.3f}"), "middle_px": ("middle px", "{:.3f}"),
        "largest_px": ("largest px", "{:.3f}"), "sideways_m": ("sideways at 5 km", "{:.2f} m"),
        "range_m": ("range at 5 km", "{:.0f} m"),
    }  # fmt: skip
    rows: list[list[Any]] = []
    for side, camera in cameras.items():
        off, central, focal = _pixels_off(camera, truth["cameras"][side])
        found = off.isfinite()
        rms, middle = (float(off[some].square().mean().sqrt()) for some in (found, found & central))
        sideways, along = rms / focal * _FAR, rms * _FAR**2 / (focal * truth["baseline_m"])
        rows.append([side, rms, middle, float(off[found].max()), sideways, along])
    return Table(columns, rows)


@torch.no_grad()
def _pixels_off(camera: Camera, truth: dict[str, Any]) -> tuple[Tensor, Tensor, float]:
    """Errors at the truth's pixels (NaN: outside), which of these are in the middle half, and the focal length, px."""
    if list(camera.size) != truth["size"]:
        raise InputError(
            f"this camera has images of {camera.size[0]}x{camera.size[1]} px, those of the site have "
            f"{truth['size'][0]}x{truth['size'][1]}"
        )
    pixels, true = (torch.tensor(truth[name], dtype=torch.float64) for name in ("pixels", "rays"))
    rays, valid = camera.unproject(pixels)
    seen, there = camera.project(1e9 * (true @ rotation_between(true[valid], rays[valid]).T))
    off = torch.where(valid & there, torch.linalg.vector_norm(seen - pixels, dim=-1), torch.nan)
    size = torch.tensor(camera.size, dtype=torch.float64)
    return off, ((pixels - 0.5 * (size - 1)).abs() < 0.25 * size).all(-1), float(camera.focal.mean())


@torch.no_grad()
def score_rig(rig: Rig, truth: dict[str, Any]) -> Table:
    """Ranges of marks without noise against the true ones, over the image, beside one sigma that the rig states."""
    if rig.mounting is None:
        rig = rig.placed(origin=Origin(lat=0.0, lon=0.0, height=0.0), heading_deg=0.0)
    localize = Localizer(rig, pixel_sigma=_EXACT)
    columns: Columns = {
        "range_m": ("at", lambda far: f"{far / 1000:g} km"), "mean_m": ("mean m", _signed), "rms_m": ("RMS m", _meters),
        "stated_m": ("one sigma as stated m", _meters),
    }  # fmt: skip
    rows: list[list[Any]] = []
    for pairs in truth["pairs"]:
        left, right = (torch.tensor(pairs[side], dtype=torch.float64) for side in ("left", "right"))
        off = torch.linalg.vector_norm(localize(left, right).enu, dim=-1) - pairs["range_m"]
        off = off[off.isfinite()]
        stated: Any = (None, "none")
        if rig.covariance is not None:
            stated = float(range_sigmas(rig, [pairs["range_m"]], pixel_sigma=_EXACT).total[0])
        rows.append([pairs["range_m"], float(off.mean()), float(off.square().mean().sqrt()), stated])
    return Table(columns, rows)


def score_positions(path: Path, truth: dict[str, Any]) -> Table:
    """Positions of a file against the true ones of the same names: on the map, in range, and by their intervals."""
    true = {name.casefold(): np.array(place) for name, place in truth["targets"].items()}
    columns: Columns = {
        "target": "target", "range_m": ("range m", "{:.0f}"), "level_m": ("off on the map m", _meters),
        "range_off_m": ("off in range m", _signed),
        "contains": ("95 % interval contains it", lambda inside: "yes" if inside else "no"),
    }  # fmt: skip
    rows: list[list[Any]] = []
    for row in located_rows(path, truth):
        if (place := true.get(row.name.strip().casefold())) is not None:
            rows.append([row.name, *row.against(place)])
    rows.sort(key=lambda row: float(row[1]))
    return Table(columns, rows)


def score_tracks(path: Path, truth: dict[str, Any]) -> tuple[Table, int]:
    """Tracks against the ships that they are nearest to, by their medians; and how many tracks are near none.

    A ship is followed at the share of the moments at which it has a position.
    """
    times = np.array(truth["ships"]["times"])
    ships = {name: np.array(places) for name, places in truth["ships"]["places"].items()}
    tracks: dict[str, list[PositionRow]] = defaultdict(list)
    for row in located_rows(path, truth):
        if row.time is not None:
            tracks[row.name].append(row)
    # Of each ship: track, moment, distance, and errors on the map and in range of each row.
    own: dict[str, list[tuple[Any, ...]]] = {ship: [] for ship in ships}
    strays = 0
    for name, rows in tracks.items():
        each = {
            ship: [(name, round(1e3 * (row.time or 0.0)), *row.against(_place_at(places, times, row.time or 0.0)))
                   for row in rows]
            for ship, places in ships.items()
        }  # fmt: skip
        nearest = min(each, key=lambda ship: float(np.median([level for _, _, _, level, *_ in each[ship]])))
        if np.median([level / far for _, _, far, level, *_ in each[nearest]]) > _STRAY:
            strays += 1
        else:
            own[nearest] += each[nearest]
    columns: Columns = {
        "ship": "ship", "range_m": ("range m", "{:.0f}"), "followed": ("followed", _shares), "tracks": "tracks",
        "level_m": ("off on the map m", _meters), "range_off_m": ("off in range m", _meters),
        "contained": ("intervals with the truth", _shares),
    }  # fmt: skip
    found: list[list[Any]] = []
    for ship, some in own.items():
        far = float(np.linalg.norm(ships[ship], axis=-1).mean())
        names, moments, _, levels, offs, inside = zip(*some, strict=True) if some else [()] * 6
        level, off = ((float(np.median(np.abs(each))) if each else math.nan) for each in (levels, offs))
        share, contained = len(set(moments)) / len(times), float(np.mean(inside)) if inside else math.nan
        found.append([ship, far, share, len(set(names)), level, off, contained])
    found.sort(key=lambda row: float(row[1]))
    return Table(columns, found), strays


def _place_at(places: Floats, times: Floats, time: float) -> Floats:
    return np.array([np.interp(time, times, column) for column in places.T])


def _meters(value: float) -> str:
    if math.isnan(value):
        return ""
    return f"{value:.0f}" if abs(value) >= 10 else f"{value:.2g}" if abs(value) >= 0.01 else f"{value:.3f}"


def _signed(value: float) -> str:
    return f"{'-' if value < 0 else '+'}{_meters(abs(value))}"


def _shares(share: float) -> str:
    return "" if math.isnan(share) else f"{100 * share:.0f} %"


class PositionRow(NamedTuple):
    """A located row of a file; `enu` in meters from where the left camera truly stands, time in seconds."""

    name: str
    enu: Floats
    range_m: float
    range_low_m: float
    range_high_m: float
    time: float | None

    def against(self, true: Floats) -> tuple[float, float, float, bool]:
        """The true range, errors on the map and in range, and whether the interval contains the true range."""
        away = float(np.linalg.norm(true))
        level = math.hypot(*(self.enu[:2] - true[:2]))
        return away, level, self.range_m - away, self.range_low_m <= away <= self.range_high_m


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
        for line in text.splitlines() if path.suffix == ".geojsonl" else [text]:
            content = orjson.loads(line)
            for feature in content.get("features", [content]):
                yield dict(feature["properties"])
    except (ValueError, KeyError, TypeError, AttributeError, csv.Error) as error:
        raise FileError(f"{path}: no positions of kcal: {error}") from error
