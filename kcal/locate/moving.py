"""Tracks of things whose positions are known while they move: a drone with RTK, ships with AIS, aircraft with ADS-B.

They are control as surveyed landmarks are, only that a position belongs to a moment. Between two fixes it is
interpolated, and how well is learned from the track itself: from fixes that are predicted without being used.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import Akima1DInterpolator, BSpline, make_smoothing_spline
from torch import Tensor

from kcal.errors import FileError, InputError
from kcal.lens.mounting import Origin
from kcal.locate.survey import EARTH, LOCAL, place_sigma, places_of
from kcal.locate.tables import TableRow, read_chunks
from kcal.texts import unix_seconds

_TRACK = "name,time,lat,lon,height,sigma"
_TRACK_COLUMNS = (
    "name", "time", *EARTH, *LOCAL, "sigma", "sigma_up", "constant_sigma", "constant_sigma_up", "latency_sigma", "note",
)  # fmt: skip
_SEEN = ("name", "camera", "time", "u", "v")
# Fixes that a track needs: two to interpolate between, two to check that with.
_FEWEST = 4
# Fixes that a smoothing spline needs; by how many powers of ten it may be softer than a line.
_SMOOTH, _DECADES = 5, 16
# An interval that is so many times the typical one is a gap.
_GAP = 3.0


class Fixes(NamedTuple):
    """Where something was at N times.

    Attributes:
        points: (N, 3) meters; NaN in gaps, before and after the track.
        velocity: (N, 3) m/s.
        sigma: (N, 3) meters, of the nearest fix and of the interpolation.
        nearest: (N,) index of the nearest fix.
    """

    points: Tensor
    velocity: Tensor
    sigma: Tensor
    nearest: Tensor


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class MovingTrack:
    """What a receiver tells of one thing that moves.

    Args:
        name: of the thing.
        times: (M,) seconds, rising; the clock that all tracks share.
        points: (M, 3) meters in the local frame.
        sigma: (M, 3) meters, of each fix by itself.
        constant: (3,) meters, of what is the same in all fixes: where the antenna is on the thing that is seen.
        latency: seconds by which all its times may be late or early, one sigma.

    Raises:
        InputError: fewer than four fixes, times that do not rise, sigmas that are not positive.

    Example:
        >>> t = torch.arange(0.0, 10.0, dtype=torch.float64)
        >>> ship = MovingTrack(name="ship", times=t, points=torch.stack([5 * t, 0 * t, 0 * t], 1),
        ...                    sigma=torch.ones(10, 3).double())
        >>> ship.at(torch.tensor([2.5, 20.0])).points[:, 0].tolist()
        [12.5, nan]
    """

    name: str
    times: Tensor
    points: Tensor
    sigma: Tensor
    constant: tuple[float, float, float] = (0.0, 0.0, 0.0)
    latency: float = 0.0

    def __post_init__(self) -> None:
        count = len(self.times)
        if count < _FEWEST:
            raise InputError(f"track {self.name}: {count} fixes; {_FEWEST} or more are needed")
        if self.points.shape != (count, 3) or self.sigma.shape != (count, 3):
            raise InputError(f"track {self.name}: points and sigma ({count}, 3) are needed")
        if not bool(torch.isfinite(self.points).all() & torch.isfinite(self.times).all()):
            raise InputError(f"track {self.name}: every time and position must be finite")
        if not bool((self.times.diff() > 0).all()):
            raise InputError(f"track {self.name}: times must rise, with no moment twice")
        if not bool((self.sigma > 0).all() & torch.isfinite(self.sigma).all()):
            raise InputError(f"track {self.name}: every sigma must be a positive number of meters")
        if not all(0 <= value < math.inf for value in (*self.constant, self.latency)):
            raise InputError(f"track {self.name}: constant and latency sigmas must not be negative")

    def at(self, times: Tensor) -> Fixes:
        """Where it was at some times (N,)."""
        own, wanted = self.times.numpy(), times.detach().double().numpy()
        step = np.diff(own)
        after = np.clip(np.searchsorted(own, wanted, side="right"), 1, len(own) - 1)
        share = (wanted - own[after - 1]) / step[after - 1]
        known = (share >= 0) & (share <= 1) & (step[after - 1] <= _GAP * np.median(step))
        inside = np.clip(wanted, own[0], own[-1])
        points = self._curve(inside)
        velocity = np.stack([path(inside - own[0]) for path in self._velocity], 1)
        nearest = np.where(share < 0.5, after - 1, after)
        between = 4.0 * share * (1.0 - share)
        sigma = np.hypot(self.sigma.numpy()[nearest], np.where(known, between, 0.0)[:, None] * self._interpolation)
        points[~known] = np.nan
        return Fixes(*(torch.from_numpy(np.ascontiguousarray(v)) for v in (points, velocity, sigma, nearest)))

    @functools.cached_property
    def _curve(self) -> Akima1DInterpolator:
        return Akima1DInterpolator(self.times.numpy(), self.points.numpy(), method="makima")

    @functools.cached_property
    def _velocity(self) -> list[Callable[[NDArray[np.float64]], NDArray[np.float64]]]:
        """Along each axis: the noise of fixes in it would tell a clock, which it cannot."""
        own, points, sigma = self.times.numpy(), self.points.numpy(), self.sigma.numpy()
        if len(own) < _SMOOTH:
            return [np.polynomial.Polynomial.fit(own - own[0], points[:, i], 1).deriv() for i in range(3)]
        return [_smoothest(own - own[0], points[:, i], sigma[:, i]).derivative() for i in range(3)]

    @functools.cached_property
    def _interpolation(self) -> NDArray[np.float64]:
        """(3,) sigma of a position in the middle between two fixes.

        From how well every other fix predicts those between: over half the interval the error falls by 2^1.5 at
        least, which holds for a velocity that wanders, and more where it is smooth.
        """
        own, points = self.times.numpy(), self.points.numpy()
        used, left = slice(0, None, 2), slice(1, len(own) - (len(own) + 1) % 2, 2)
        if len(own[used]) < 3:
            error = np.stack([np.interp(own[left], own[used], points[used, axis]) for axis in range(3)], 1)
        else:
            error = Akima1DInterpolator(own[used], points[used], method="makima")(own[left])
        return np.asarray(np.sqrt(np.square(error - points[left]).mean(0)) / 2.0**1.5)


def _smoothest(times: NDArray[np.float64], values: NDArray[np.float64], sigma: NDArray[np.float64]) -> BSpline:
    """The smoothest path that fixes allow by their sigmas (the discrepancy principle, Morozov 1966)."""
    weight = 1.0 / np.square(sigma)
    allowed = len(times) + 2.0 * math.sqrt(2.0 * len(times))
    # From a straight line: bending over the whole duration would cost more than all fixes.
    stiff = float(weight.sum() * (times[-1] - times[0]) ** 3)
    for decade in range(_DECADES):
        path = make_smoothing_spline(times, values, weight, lam=stiff * 10.0**-decade)
        if float(weight @ np.square(path(times) - values)) <= allowed:
            break
    return path


def time_of_row(row: TableRow) -> float:
    """The `time` of a row: seconds, or a date with its zone (`2026-11-24T20:47:26Z`), then seconds since 1970.

    Raises:
        FileError: neither.
    """
    seconds = unix_seconds(row.cells["time"])
    if not math.isfinite(seconds):
        raise FileError(
            f"{row.where}: time is {row.cells['time']!r}; write seconds, or a date with its zone: 2026-11-24T20:47:26Z"
        )
    return seconds


def read_tracks(path: str | Path, origin: Origin | None = None) -> tuple[tuple[MovingTrack, ...], Origin | None]:
    r"""Read tracks: `name,time,lat,lon,height,sigma` or with `east,north,up`; one line for each fix, in any order.

    `sigma` (and `sigma_up` where it differs) is of each fix by itself, meters. `constant_sigma` (`constant_sigma_up`)
    is of what is the same in all fixes of a thing, as where the antenna is on it, and `latency_sigma`, seconds, of how
    late its times are; both from the first line of each thing.

    Args:
        path: of the file.
        origin: of the local frame; the first fix if left out and the file has latitudes.

    Returns:
        the tracks, and the origin; None for local meters without one.

    Raises:
        FileError: see `kcal.locate.tables.read_rows`; a thing with a fix twice, or with fewer than four.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "tracks.csv")
        ...     _ = path.write_text("name,time,east,north,up,sigma\n" + "".join(
        ...         f"drone,{t},{3 * t},100,50,0.02\n" for t in range(5)))
        ...     tracks, _ = read_tracks(path)
        >>> tracks[0].at(torch.tensor([1.5])).points[0].tolist()
        [4.5, 100.0, 50.0]
    """
    chunks = read_chunks(path, _TRACK, _TRACK_COLUMNS, ("name", "time", "sigma"), unique=False)
    rows = [row for chunk in chunks for row in chunk.rows()]
    values, origin = places_of(rows, path, origin)
    of: dict[str, list[int]] = {}
    times = [time_of_row(row) for row in rows]
    for i, row in enumerate(rows):
        of.setdefault(row.name, []).append(i)
    found = []
    for name, own in of.items():
        own.sort(key=times.__getitem__)
        first_row = rows[min(own)]
        level = _amount(first_row, "constant_sigma", 0.0)
        try:
            track = MovingTrack(
                name=name,
                times=torch.tensor([times[i] for i in own], dtype=torch.float64),
                points=values[own],
                sigma=torch.tensor([place_sigma(rows[i], "fix") for i in own], dtype=torch.float64),
                constant=(level, level, _amount(first_row, "constant_sigma_up", level)),
                latency=_amount(first_row, "latency_sigma", 0.0),
            )
        except InputError as error:
            raise FileError(f"{path}: {error}") from error
        found.append(track)
    return tuple(found), origin


def _amount(row: TableRow, column: str, default: float) -> float:
    """A number that is not negative; the default where the column is absent or the cell is empty."""
    if not row.cells.get(column):
        return default
    value = row.number(column)
    if value < 0:
        raise FileError(f"{row.where}: {column} is {value:g}; zero or a positive number is needed")
    return value


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Sighting:
    """What one camera followed through time.

    Args:
        label: what it was called: the name of a track, if somebody says so, or anything else.
        camera: number of the camera.
        times: (N,) seconds, of the camera's clock, rising.
        pixels: (N, 2).
        sigma: (N,) px along an axis; NaN where it is not stated.

    Example:
        >>> t = torch.arange(3.0)
        >>> Sighting(label="blob", camera=0, times=t, pixels=torch.stack([t, t], 1), sigma=0.3 + 0 * t).label
        'blob'
    """

    label: str
    camera: int
    times: Tensor
    pixels: Tensor
    sigma: Tensor


def read_sightings(path: str | Path, cameras: Sequence[str]) -> tuple[Sighting, ...]:
    r"""Read `name,camera,time,u,v` and, if they are there, `sigma` (px) and `note`: what each camera followed.

    Lines with one name and one camera are one thing. The name is that of a track, where somebody says so; any other
    name is a thing that nobody named.

    Args:
        path: of the file.
        cameras: their names, in the order of the rig.

    Raises:
        FileError: see `kcal.locate.tables.read_rows`; a camera that is not there; a thing seen twice at one moment.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "sightings.csv")
        ...     _ = path.write_text("name,camera,time,u,v\nblob,left,0.0,10,20\nblob,left,0.5,12,20\n")
        ...     read_sightings(path, ("left", "right"))[0].times.tolist()
        [0.0, 0.5]
    """
    number: Mapping[str, int] = {name: c for c, name in enumerate(cameras)}
    of: dict[tuple[int, str], dict[float, tuple[float, float, float]]] = {}
    for chunk in read_chunks(path, ",".join(_SEEN), (*_SEEN, "sigma", "note"), _SEEN, unique=False):
        for row in chunk.rows():
            camera = row.cells["camera"]
            if camera not in number:
                raise FileError(f"{row.where}: no camera is named {camera!r}; they are {', '.join(cameras)}")
            own = of.setdefault((number[camera], row.name), {})
            time = time_of_row(row)
            if time in own:
                raise FileError(f"{row.where}: {row.name!r} was seen by {camera} at that time before; once is needed")
            pixel = row.number("u", "a pixel coordinate"), row.number("v", "a pixel coordinate")
            own[time] = (*pixel, row.positive("sigma") or math.nan)
    found = []
    for (camera_number, label), own in of.items():
        times = sorted(own)
        values = torch.tensor([own[time] for time in times], dtype=torch.float64)
        found.append(
            Sighting(
                label=label, camera=camera_number, times=torch.tensor(times, dtype=torch.float64),
                pixels=values[:, :2], sigma=values[:, 2],
            )
        )  # fmt: skip
    return tuple(found)
