"""Targets that move and report where they are: their tracks and sightings, and how both are matched."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import Akima1DInterpolator, BSpline, make_smoothing_spline
from torch import Tensor

from kcal.calibrate.rig.marks import Landmarks
from kcal.calibrate.rig.resection import consensus_pose, consensus_rotation
from kcal.calibrate.rig.source import Effect
from kcal.calibrate.rig.sources import MeasuredPosition
from kcal.errors import FileError, InputError
from kcal.lens.camera import Camera
from kcal.lens.rig import Origin
from kcal.locate.survey import EARTH, LOCAL, place_sigma, places_of
from kcal.locate.tables import TableRow, read_chunks
from kcal.texts import brief, briefly, unix_seconds

# Tracks of targets whose positions are known while they move: a drone with RTK, ships with AIS, aircraft with ADS-B.
#
# They are control as surveyed landmarks are, only that a position belongs to a time. Between two fixes it is
# interpolated, and how well is learned from the track itself: from fixes that are predicted without being used.

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
    """Reported positions of one moving target.

    Args:
        name: of the target.
        times: (M,) seconds, rising; the clock that all tracks share.
        points: (M, 3) meters in the local frame.
        sigma: (M, 3) meters, of each fix by itself.
        constant: (3,) meters, of what is the same in all fixes: where the antenna is on the target that is seen.
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

    __repr__ = brief

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
            raise InputError(f"track {self.name}: times must rise, with no time twice")
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
    is of what is the same in all fixes of a target, as where the antenna is on it, and `latency_sigma`, seconds, of how
    late its times are; both from the first line of each target.

    Args:
        path: of the file.
        origin: of the local frame; the first fix if left out and the file has latitudes.

    Returns:
        the tracks, and the origin; None for local meters without one.

    Raises:
        FileError: see `kcal.locate.tables.read_rows`; a target with a fix twice, or with fewer than four.

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

    __repr__ = brief

    label: str
    camera: int
    times: Tensor
    pixels: Tensor
    sigma: Tensor


def read_sightings(path: str | Path, cameras: Sequence[str]) -> tuple[Sighting, ...]:
    r"""Read `name,camera,time,u,v` and, if they are there, `sigma` (px) and `note`: what each camera followed.

    Lines with one name and one camera are one target. The name is that of a track, where somebody says so; any other
    name is a target that nobody named.

    Args:
        path: of the file.
        cameras: their names, in the order of the rig.

    Raises:
        FileError: see `kcal.locate.tables.read_rows`; a camera that is not there; a target seen twice at one time.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "sightings.csv")
        ...     _ = path.write_text("name,camera,time,u,v\nblob,left,0.0,10,20\nblob,left,0.5,12,20\n")
        ...     read_sightings(path, ("left", "right"))[0].times.tolist()
        [0.0, 0.5]
    """
    of: dict[tuple[int, str], dict[float, tuple[float, float, float]]] = {}
    for chunk in read_chunks(path, ",".join(_SEEN), (*_SEEN, "sigma", "note"), _SEEN, unique=False):
        for row in chunk.rows():
            camera = row.cells["camera"]
            if camera not in cameras:
                raise FileError(f"{row.where}: no camera is named {camera!r}; they are {', '.join(cameras)}")
            own = of.setdefault((cameras.index(camera), row.name), {})
            time = time_of_row(row)
            if time in own:
                raise FileError(f"{row.where}: {row.name!r} was seen by {camera} at that time before; once is needed")
            pixel = row.number("u", "a pixel coordinate"), row.number("v", "a pixel coordinate")
            own[time] = (*pixel, row.positive("sigma") or math.nan)
    found = []
    for (camera_number, label), own in of.items():
        times = sorted(own)
        stamps = torch.tensor(times, dtype=torch.float64)
        values = torch.tensor([own[time] for time in times], dtype=torch.float64)
        pixels, sigma = values[:, :2], values[:, 2]
        found.append(Sighting(label=label, camera=camera_number, times=stamps, pixels=pixels, sigma=sigma))
    return tuple(found)


# Match what cameras followed to tracks of known positions: which is which, and how late the cameras' clocks are.

# The name of the effect.
CLOCK = "the clock of the cameras"
# Times of a sighting that take part in the search, and sightings whose pairing with every track is tried where names
# do not tell.
_MOMENTS, _TRIED = 12, 3
# Radians by which a pose from the search may be off; how many sigmas a sighting may be from its track, and how many
# times nearer than the second it must be.
_ROUGH, _NEAR, _CLEARLY = 3e-3, 3.0, 2.0
# Steps of the clock's search on each side, at most, and by what it is refined, twice.
_STEPS, _FINER = 60, 5
# Seconds: sightings by several cameras are of one time.
_SAME = 1e-3


@dataclasses.dataclass(frozen=True, kw_only=True)
class MovingOptions:
    """Standard deviations of clocks and marks.

    Args:
        clock_sigma: seconds, of the cameras' clocks against that of the tracks; searched within three of it.
        between_sigma: seconds, of the cameras' clocks against each other.
        pixel_sigma: px along an axis, where the sightings do not state it.
    """

    clock_sigma: float = 2.0
    between_sigma: float = 0.1
    pixel_sigma: float = 0.3

    def __post_init__(self) -> None:
        if not all(0 <= s < math.inf for s in (self.clock_sigma, self.between_sigma)) or not self.pixel_sigma > 0:
            raise InputError("sigmas of clocks must not be negative, that of pixels must be positive")


class Identity(NamedTuple):
    """The track that a sighting was assigned to, or why there is none.

    Attributes:
        camera: number of the camera.
        label: as it was called.
        track: name of its track; None if it is none of them, or if that is not clear.
        sigmas: how far from the track that fits best, in sigmas of the search.

    Example:
        >>> Identity(0, "blob17", "ship", 0.4).track
        'ship'
    """

    camera: int
    label: str
    track: str | None
    sigmas: float


@briefly
class MovingControl(NamedTuple):
    """Sightings as landmarks, one for each time of a track.

    Attributes:
        landmarks: with clocks, latencies and constant offsets as effects.
        identities: one for each sighting.
        clock: seconds to be added to the cameras' times, as found by the search; the effects correct it.

    Example:
        >>> MovingControl._fields  # what `match_moving` returns
        ('landmarks', 'identities', 'clock')
    """

    landmarks: Landmarks
    identities: tuple[Identity, ...]
    clock: float


class _Seen(NamedTuple):
    """A sighting as rays: all of it, and what takes part in the search."""

    sighting: Sighting
    times: Tensor
    rays: Tensor


def match_moving(
    tracks: Sequence[MovingTrack],
    sightings: Sequence[Sighting],
    cameras: Sequence[Camera],
    names: Sequence[str],
    positions: Sequence[MeasuredPosition] = (),
    options: MovingOptions | None = None,
) -> MovingControl:
    """Find which track each sighting is, and make landmarks of them.

    Names of sightings are what somebody says and are checked: a pose of each camera that most of them agree on is
    searched together with the offset of its clock, then every sighting goes to the track that it follows. Where no
    name helps, pairings are tried, for cameras whose positions are known. Each fix of a track is used once.

    Args:
        tracks: of known positions, in the local frame.
        sightings: by the cameras.
        cameras: calibrated, C of them.
        names: of the cameras.
        positions: where cameras stand, as far as it was measured.
        options: see `MovingOptions`.

    Raises:
        InputError: no sighting can be matched; tracks and sightings that have no time in common.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(640, 360), size=(1280, 720), model="pinhole")
        >>> t = torch.arange(0.0, 30.0, dtype=torch.float64)
        >>> points = torch.stack([8 * torch.sin(t / 4), 20 + 0.1 * t, 4 * torch.cos(t / 3)], 1)
        >>> drone = MovingTrack(name="drone", times=t, points=points, sigma=torch.full((30, 3), 0.02).double())
        >>> seen = points[3:28] @ torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
        >>> blob = Sighting(label="blob", camera=0, times=t[3:28] - 0.5, pixels=camera.project(seen)[0],
        ...                 sigma=torch.full((25,), 0.3).double())
        >>> there = MeasuredPosition(camera=0, point=torch.zeros(3).double(), sigma=torch.ones(3).double())
        >>> found = match_moving([drone], [blob], [camera], ["mast"], [there])
        >>> found.identities[0].track, round(found.clock, 1), len(found.landmarks.names)
        ('drone', 0.5, 25)
    """
    options = options or MovingOptions()
    ordered = sorted(sightings, key=lambda sighting: sighting.camera)
    seen = [one for own in ordered if len((one := _searched(own, cameras[own.camera])).times)]
    near = {p.camera: p.point for p in positions}
    clock = _clock(tracks, seen, near, options.clock_sigma)
    identities: list[Identity] = []
    for camera in sorted({one.sighting.camera for one in seen}):
        own = [one for one in seen if one.sighting.camera == camera]
        identities += _identities(tracks, own, near.get(camera), clock, names[camera])
    matched = [(one, name.track) for one, name in zip(seen, identities, strict=True) if name.track]
    if not matched:
        raise InputError("none of the sightings follows a track: check times, names and the cameras' positions")
    landmarks = _moving_landmarks(tracks, matched, len(cameras), names, clock, options)
    return MovingControl(landmarks, tuple(identities), clock)


def _searched(sighting: Sighting, camera: Camera) -> _Seen:
    rays, valid = camera.unproject(sighting.pixels)
    some = valid.nonzero()[:, 0]
    some = some[torch.linspace(0, len(some) - 1, min(_MOMENTS, len(some))).round().long()] if len(some) else some
    return _Seen(sighting, sighting.times[some], rays[some])


def _claims(tracks: Sequence[MovingTrack], seen: Sequence[_Seen]) -> list[tuple[_Seen, MovingTrack]]:
    """Sightings with the track whose name they have; with a single track, all are taken for it."""
    named = {track.name: track for track in tracks}
    claimed = [(one, named[one.sighting.label]) for one in seen if one.sighting.label in named]
    if not claimed and len(tracks) == 1:
        return [(one, tracks[0]) for one in seen]
    return claimed


def _agreed_pose(
    pairs: Sequence[tuple[_Seen, MovingTrack]], near: Tensor | None, clock: float
) -> tuple[Tensor, Tensor, float] | None:
    """Rotation, center and mean score of the pose that most of the pairs agree on."""
    if not pairs:
        return None
    rays = torch.cat([one.rays for one, _ in pairs])
    points = torch.cat([track.at(one.times + clock).points for one, track in pairs])
    known = torch.isfinite(points).all(-1)
    rays, points = rays[known], points[known]
    if len(rays) < (2 if near is not None else 4):
        return None
    if near is not None:
        towards = points - near
        rotation, score = consensus_rotation(rays, towards / torch.linalg.vector_norm(towards, dim=-1, keepdim=True))
        return rotation, near, score / len(rays)
    found = consensus_pose(rays, points)
    return None if found is None else (found[0], found[1], found[2] / len(rays))


def _clock(tracks: Sequence[MovingTrack], seen: Sequence[_Seen], near: dict[int, Tensor], sigma: float) -> float:
    """Seconds to be added to the cameras' times: where the poses of all cameras together fit best."""
    claims = _claims(tracks, seen)
    seeing = sorted({one.sighting.camera for one, _ in claims})
    pairs = {c: [p for p in claims if p[0].sighting.camera == c] for c in seeing}
    if not pairs:
        if len(near) == 0:
            raise InputError(
                "no sighting has the name of a track, and no camera's position is known: name some of them as in the "
                "table of tracks, or give --positions"
            )
        return 0.0

    def score(clock: float) -> float:
        poses = [_agreed_pose(own, near.get(c), clock) for c, own in pairs.items()]
        return sum(math.inf if pose is None else pose[2] for pose in poses)

    if not sigma:
        return 0.0
    # The search must not step over the right time: half of what is gross, at the fastest angular rate.
    rate = max(_rate(one) for own in pairs.values() for one, _ in own)
    step = max(3.0 * sigma / _STEPS, min(3.0 * sigma / 4, _ROUGH / max(rate, 1e-9)))
    best, offsets = 0.0, torch.arange(-3.0 * sigma, 3.0 * sigma + step / 2, step).tolist()
    for _ in range(3):
        best = min(offsets, key=score)
        step /= _FINER
        offsets = [best + step * i for i in range(1 - _FINER, _FINER)]
    if math.isinf(score(best)):
        raise InputError("tracks and sightings have too few times in common: check clocks and time zones")
    return best


def _rate(one: _Seen) -> float:
    """Radians a second at which a sighting moves at most."""
    if len(one.times) < 2:
        return 0.0
    turned = torch.linalg.vector_norm(one.rays.diff(dim=0), dim=-1)
    return float((turned / one.times.diff().clamp_min(1e-9)).max())


def _identities(
    tracks: Sequence[MovingTrack], own: Sequence[_Seen], near: Tensor | None, clock: float, camera: str
) -> list[Identity]:
    """The track of each sighting of one camera."""
    pose = _agreed_pose(_claims(tracks, own), near, clock)
    tried = [] if near is None else [
        _agreed_pose([(one, track)], near, clock)
        for one in sorted(own, key=lambda one: -float(one.times[-1] - one.times[0]))[:_TRIED] for track in tracks
    ]  # fmt: skip
    poses = [found for found in (pose, *tried) if found is not None]
    if not poses:
        return [Identity(one.sighting.camera, one.sighting.label, None, math.inf) for one in own]

    def misfits(found: tuple[Tensor, Tensor, float]) -> Tensor:
        return torch.tensor([[_sigmas(track, one, found, clock) for track in tracks] for one in own])

    tables = [misfits(found) for found in poses]
    found = poses[min(range(len(poses)), key=lambda i: float(tables[i].amin(1).clamp_max(2 * _NEAR).sum()))]
    for _ in range(2):
        table = misfits(found)
        chosen = [_chosen(row, tracks, one) for row, one in zip(table, own, strict=True)]
        pairs = [(one, tracks[k]) for one, k in zip(own, chosen, strict=True) if k is not None]
        found = _agreed_pose(pairs, near, clock) or found
    identities = []
    for row, one in zip(misfits(found), own, strict=True):
        k = _chosen(row, tracks, one)
        name = None if k is None else tracks[k].name
        identities.append(Identity(one.sighting.camera, one.sighting.label, name, float(row.min())))
    return identities


def _sigmas(track: MovingTrack, one: _Seen, pose: tuple[Tensor, Tensor, float], clock: float) -> float:
    """RMS distance of a sighting from a track in sigmas of both; infinite with fewer than two times in common."""
    rotation, center, _ = pose
    fixes = track.at(one.times + clock)
    known = torch.isfinite(fixes.points).all(-1)
    if int(known.sum()) < min(2, len(one.times)) or not bool(known.any()):
        return math.inf
    towards = fixes.points[known] - center
    distance = torch.linalg.vector_norm(towards, dim=-1)
    off = torch.linalg.vector_norm((towards / distance[:, None]) @ rotation.T - one.rays[known], dim=-1)
    late = track.latency * torch.linalg.vector_norm(fixes.velocity[known], dim=-1)
    meters = (fixes.sigma[known].amax(-1).square() + max(track.constant) ** 2 + late.square()).sqrt()
    return float((off.square() / (_ROUGH**2 + (meters / distance).square())).mean().sqrt())


def _chosen(row: Tensor, tracks: Sequence[MovingTrack], one: _Seen) -> int | None:
    """Which track a sighting is; None where none is near. Of several, the one that it is called, if that is near."""
    near = (row < _NEAR).nonzero()[:, 0].tolist()
    if not near:
        return None
    best = min(near, key=lambda k: float(row[k]))
    rivals = [k for k in near if float(row[k]) < _CLEARLY * max(float(row[best]), 0.5)]
    if len(rivals) == 1:
        return best
    return next((k for k in rivals if tracks[k].name == one.sighting.label), None)


def _moving_landmarks(
    tracks: Sequence[MovingTrack],
    matched: Sequence[tuple[_Seen, str]],
    count: int,
    names: Sequence[str],
    clock: float,
    options: MovingOptions,
) -> Landmarks:
    """One landmark for each fix: at the time nearest to it, preferably one that several cameras saw."""
    rows = []
    for k, track in enumerate(tracks):
        moments: dict[int, dict[int, tuple[Tensor, float]]] = {}
        for one in (one for one, name in matched if name == track.name):
            sight = one.sighting
            stated = torch.where(sight.sigma.isfinite(), sight.sigma, options.pixel_sigma)
            for time, pixel, px in zip(sight.times.tolist(), sight.pixels, stated.tolist(), strict=True):
                moments.setdefault(round(time / _SAME), {}).setdefault(sight.camera, (pixel, px))
        ticks = sorted(moments)
        fixes = track.at(torch.tensor(ticks, dtype=torch.float64) * _SAME + clock)
        away = (track.times[fixes.nearest] - clock - torch.tensor(ticks, dtype=torch.float64) * _SAME).abs()
        best: dict[int, int] = {}
        for i, fix in enumerate(fixes.nearest.tolist()):
            if not bool(torch.isfinite(fixes.points[i]).all()):
                continue
            old = best.get(fix)
            rank = (-len(moments[ticks[i]]), float(away[i]))
            if old is None or rank < (-len(moments[ticks[old]]), float(away[old])):
                best[fix] = i
        for i in best.values():
            marks = torch.full((count, 3), math.nan, dtype=torch.float64)
            for camera, (pixel, px) in moments[ticks[i]].items():
                marks[camera] = torch.tensor([*pixel.tolist(), px], dtype=torch.float64)
            label, *seen = f"{track.name} {ticks[i] * _SAME:.3f}", marks[:, :2], marks[:, 2]
            rows.append((label, k, fixes.points[i], fixes.sigma[i], fixes.velocity[i], *seen))
    if not rows:
        raise InputError("tracks and sightings have no time in common: check clocks and time zones")
    labels, of, *parts = zip(*rows, strict=True)
    points, sigma, velocity, pixels, noise = map(torch.stack, parts)
    effects = _shared_shifts(tracks, torch.tensor(of), velocity, pixels, names, options)
    return Landmarks(names=labels, points=points, sigma=sigma, pixels=pixels, pixel_sigma=noise, effects=effects)


def _shared_shifts(
    tracks: Sequence[MovingTrack],
    of: Tensor,
    velocity: Tensor,
    pixels: Tensor,
    names: Sequence[str],
    options: MovingOptions,
) -> tuple[Effect, ...]:
    """Clocks, latencies and constant offsets, as far as there are any."""
    count = pixels.shape[1]
    everywhere = velocity[:, None].expand(-1, count, -1)
    found = []
    if options.clock_sigma:
        found.append(Effect(name=CLOCK, shift=options.clock_sigma * everywhere))
    seeing = torch.isfinite(pixels).all(-1).any(0).nonzero()[:, 0].tolist()
    for camera in seeing[1:] if options.between_sigma else ():
        shift = torch.zeros(len(of), count, 3, dtype=torch.float64)
        shift[:, camera] = options.between_sigma * velocity
        found.append(Effect(name=f"the clock of {names[camera]} against {names[seeing[0]]}", shift=shift))
    for k, track in enumerate(tracks):
        own = (of == k).double()[:, None, None]
        if not bool(own.any()):
            continue
        if track.latency:
            found.append(Effect(name=f"how late {track.name} is", shift=track.latency * own * everywhere))
        for axis, (way, constant) in enumerate(zip(("east", "north", "up"), track.constant, strict=True)):
            if constant:
                unit = constant * torch.eye(3, dtype=torch.float64)[axis]
                shift = own * unit.expand(len(of), count, 3)
                found.append(Effect(name=f"where on {track.name} its antenna is, {way}", shift=shift))
    return tuple(found)
