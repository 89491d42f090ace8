"""Match what cameras followed to tracks of known positions: which is which, and how late the cameras' clocks are."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.rig.resection import consensus_pose, consensus_rotation
from kcal.calibrate.rig.sources import LandmarkEffect, Landmarks, MeasuredPosition
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.locate.moving import MovingTrack, Sighting

# The name of the effect.
CLOCK = "the clock of the cameras"
# Moments of a sighting that take part in the search, and sightings whose pairing with every track is tried where names
# do not tell.
_MOMENTS, _TRIED = 12, 3
# Radians by which a pose from the search may be off; how many sigmas a sighting may be from its track, and how many
# times nearer than the second it must be.
_ROUGH, _NEAR, _CLEARLY = 3e-3, 3.0, 2.0
# Steps of the clock's search on each side, at most, and by what it is refined, twice.
_STEPS, _FINER = 60, 5
# Seconds: sightings by several cameras are of one moment.
_SAME = 1e-3


@dataclasses.dataclass(frozen=True, kw_only=True)
class MovingOptions:
    """What is known beforehand of clocks and marks.

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
    """What a sighting turned out to be.

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


class MovingControl(NamedTuple):
    """Sightings as landmarks, one for each moment of a track.

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
    seen = [_searched(sighting, cameras[sighting.camera]) for sighting in sightings]
    seen = [one for one in seen if len(one.times)]
    near = {p.camera: p.point for p in positions}
    clock = _clock(tracks, seen, near, options.clock_sigma)
    identities: list[Identity] = []
    for camera in sorted({one.sighting.camera for one in seen}):
        own = [one for one in seen if one.sighting.camera == camera]
        identities += _identities(tracks, own, near.get(camera), clock, names[camera])
    matched = [(one, name.track) for one, name in zip(_camera_by_camera(seen), identities, strict=True) if name.track]
    if not matched:
        raise InputError("none of the sightings follows a track: check times, names and the cameras' positions")
    landmarks = _moving_landmarks(tracks, matched, len(cameras), names, clock, options)
    return MovingControl(landmarks, tuple(identities), clock)


def _camera_by_camera(seen: Sequence[_Seen]) -> list[_Seen]:
    return sorted(seen, key=lambda one: one.sighting.camera)


def _searched(sighting: Sighting, camera: Camera) -> _Seen:
    rays, valid = camera.unproject(sighting.pixels)
    some = valid.nonzero()[:, 0]
    some = some[torch.linspace(0, len(some) - 1, min(_MOMENTS, len(some))).round().long()] if len(some) else some
    return _Seen(sighting, sighting.times[some], rays[some])


def _in_common(track: MovingTrack, seen: _Seen, clock: float) -> tuple[Tensor, Tensor]:
    """Rays (M, 3) and points (M, 3) at the moments that the track knows."""
    points = track.at(seen.times + clock).points
    known = torch.isfinite(points).all(-1)
    return seen.rays[known], points[known]


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
    parts = [_in_common(track, one, clock) for one, track in pairs]
    if not parts:
        return None
    rays, points = (torch.cat(part) for part in zip(*parts, strict=True))
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
    pairs = {
        c: [p for p in claims if p[0].sighting.camera == c] for c in sorted({p[0].sighting.camera for p in claims})
    }
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
        raise InputError("tracks and sightings have too few moments in common: check clocks and time zones")
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
    best = min(range(len(poses)), key=lambda i: float(tables[i].amin(1).clamp_max(2 * _NEAR).sum()))
    found = poses[best]
    for _ in range(2):
        table = misfits(found)
        chosen = [_chosen(row, tracks, one) for row, one in zip(table, own, strict=True)]
        pairs = [(one, tracks[k]) for one, k in zip(own, chosen, strict=True) if k is not None]
        found = _agreed_pose(pairs, near, clock) or found
    table = misfits(found)
    return [
        Identity(
            one.sighting.camera, one.sighting.label,
            None if (k := _chosen(row, tracks, one)) is None else tracks[k].name, float(row.min()),
        )
        for row, one in zip(table, own, strict=True)
    ]  # fmt: skip


def _sigmas(track: MovingTrack, one: _Seen, pose: tuple[Tensor, Tensor, float], clock: float) -> float:
    """RMS distance of a sighting from a track in sigmas of both; infinite with fewer than two moments in common."""
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
    """One landmark for each fix: at the moment nearest to it, preferably one that several cameras saw."""
    labels, points, sigma, velocity, pixels, noise = [], [], [], [], [], []
    of: list[int] = []
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
            labels.append(f"{track.name} {ticks[i] * _SAME:.3f}")
            marks = torch.full((count, 3), math.nan, dtype=torch.float64)
            for camera, (pixel, px) in moments[ticks[i]].items():
                marks[camera] = torch.tensor([*pixel.tolist(), px], dtype=torch.float64)
            points.append(fixes.points[i])
            sigma.append(fixes.sigma[i])
            velocity.append(fixes.velocity[i])
            pixels.append(marks[:, :2])
            noise.append(marks[:, 2])
            of.append(k)
    if not labels:
        raise InputError("tracks and sightings have no time in common: check clocks and time zones")
    return Landmarks(
        names=tuple(labels),
        points=torch.stack(points),
        sigma=torch.stack(sigma),
        pixels=torch.stack(pixels),
        pixel_sigma=torch.stack(noise),
        effects=_shared_shifts(tracks, torch.tensor(of), torch.stack(velocity), torch.stack(pixels), names, options),
    )


def _shared_shifts(
    tracks: Sequence[MovingTrack],
    of: Tensor,
    velocity: Tensor,
    pixels: Tensor,
    names: Sequence[str],
    options: MovingOptions,
) -> tuple[LandmarkEffect, ...]:
    """Clocks, latencies and constant offsets, as far as there are any."""
    count = pixels.shape[1]
    everywhere = velocity[:, None].expand(-1, count, -1)
    found = []
    if options.clock_sigma:
        found.append(LandmarkEffect(name=CLOCK, shift=options.clock_sigma * everywhere))
    seeing = torch.isfinite(pixels).all(-1).any(0).nonzero()[:, 0].tolist()
    for camera in seeing[1:] if options.between_sigma else ():
        shift = torch.zeros(len(of), count, 3, dtype=torch.float64)
        shift[:, camera] = options.between_sigma * velocity
        found.append(LandmarkEffect(name=f"the clock of {names[camera]} against {names[seeing[0]]}", shift=shift))
    for k, track in enumerate(tracks):
        own = (of == k).double()[:, None, None]
        if not bool(own.any()):
            continue
        if track.latency:
            found.append(LandmarkEffect(name=f"how late {track.name} is", shift=track.latency * own * everywhere))
        for axis, (way, constant) in enumerate(zip(("east", "north", "up"), track.constant, strict=True)):
            if constant:
                unit = constant * torch.eye(3, dtype=torch.float64)[axis]
                shift = own * unit.expand(len(of), count, 3)
                found.append(LandmarkEffect(name=f"where on {track.name} its antenna is, {way}", shift=shift))
    return tuple(found)
