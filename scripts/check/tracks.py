"""Tracks of a simulated site: 30 targets from 100 m to 5 km, cameras of 10 and 25 frames a second, 40 ms apart.

Each seed draws the rig's true yaw, the targets and the noise anew. Single frames, filter, smoother and Stone Soup's
filter (the package `stonesoup`) get the same pairs.
"""

from __future__ import annotations

import collections
import dataclasses
import datetime
import math
from typing import Any, NamedTuple

import numpy as np
import torch
from stonesoup.base import Property
from stonesoup.models.measurement.base import MeasurementModel
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.array import StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import KalmanUpdater, UnscentedKalmanUpdater
from torch import Tensor

from kcal import Localizer, Origin, Rig
from kcal.lens import rotation_from_vector
from kcal.pipeline.pairing import ObjectViews
from kcal.pipeline.tracks import Tracker, TrackOptions, Tracks
from kcal.rig import RigCovariance, planned_rig
from kcal.track import ClockPrior, Motion
from scripts.shared.page import Lines, rms, section

START = datetime.datetime(2026, 1, 1)


class CartesianFilters:
    """One filter for each target, with straight motion in east, north and up.

    Args:
        acceleration: white noise, as that of `Motion`.
        speed: standard deviation of a new target's velocity along each axis.
    """

    def __init__(self, acceleration: float, speed: float) -> None:
        self.predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([ConstantVelocity(acceleration**2)] * 3))
        self.speed = speed
        self.states: dict[int, Any] = {}

    def begin(self, target: int, mean: Any, covariance: Any, time: float) -> None:
        """A new target with the state (6,): place and velocity of each axis in turn."""
        when = START + datetime.timedelta(seconds=time)
        self.states[target] = GaussianState(mean[:, None], covariance, timestamp=when)

    def update(self, target: int, updater: Any, seen: Any, time: float) -> None:
        """Move a target to a time and take in a sighting (K,)."""
        when = START + datetime.timedelta(seconds=time)
        prediction = self.predictor.predict(self.states[target], timestamp=when)
        made = updater.update(SingleHypothesis(prediction, Detection(np.asarray(seen)[:, None], timestamp=when)))
        self.states[target] = GaussianState(made.state_vector, made.covar, timestamp=when)

    def places(self, time: float) -> tuple[list[int], Tensor]:
        """Targets and where they are believed to be."""
        when = START + datetime.timedelta(seconds=time)
        found = [self.predictor.predict(state, timestamp=when) for state in self.states.values()]
        rows = [np.asarray(state.state_vector, float).ravel()[::2] for state in found]
        return list(self.states), torch.from_numpy(np.array(rows))


class OfPositions(CartesianFilters):
    """Takes in positions with covariances, as one would without kcal's tracker."""

    def take(self, targets: Tensor, enu: Tensor, covariance: Tensor, ok: Tensor, time: float) -> None:
        """Take in the sightings of a moment."""
        for i, target in enumerate(targets.tolist()):
            if not bool(ok[i]):
                continue
            if target not in self.states:
                mean, spread = np.zeros(6), np.diag([0.0, self.speed**2] * 3)
                mean[::2], spread[::2, ::2] = enu[i].numpy(), covariance[i].numpy()
                self.begin(target, mean, spread, time)
                continue
            updater = KalmanUpdater(LinearGaussian(6, (0, 2, 4), covariance[i].numpy()))
            self.update(target, updater, enu[i].numpy(), time)


class Pixels(MeasurementModel):
    """Four pixel coordinates of a target, of which the right two are seen `delay` seconds later; pinholes only."""

    ndim_state: int = 6
    ndim_meas: int = 4
    mapping: Any = (0, 2, 4)
    rvs: Any = None  # not needed
    pdf: Any = None
    cameras: Any = Property(doc="Matrix, rotation from east, north and up, and shift of both cameras.")
    delay: float = Property(doc="Seconds.")
    covariance: Any = Property(doc="Of the pixels.")

    @classmethod
    def of(cls, localize: Localizer, delay: float, covariance: Tensor) -> Pixels:
        """The model of a rig that stands somewhere."""
        rig, turn = localize.rig, localize.enu_from_rig.T
        cameras = [
            (camera.matrix.numpy(), rotation.numpy(), shift.numpy())
            for camera, rotation, shift in (
                (rig.left, turn, torch.zeros(3)),
                (rig.right, rig.right_from_left_rotation @ turn, rig.right_from_left_translation),
            )
        ]
        return cls(cameras=cameras, delay=delay, covariance=covariance.numpy())

    def covar(self, **_: Any) -> Any:
        """Of the pixels."""
        return self.covariance

    def function(self, state: Any, noise: Any = False, **_: Any) -> Any:
        """Where states are seen."""
        return StateVectors(self.seen_at(np.asarray(state.state_vector, float)))

    def seen_at(self, vector: Any) -> Any:
        """Pixels (4, N) of states (6, N)."""
        rows: list[Any] = []
        for (matrix, rotation, shift), delay in zip(self.cameras, (0.0, self.delay), strict=True):
            seen = matrix @ (rotation @ (vector[::2] + delay * vector[1::2]) + shift[:, None])
            rows += [seen[0] / seen[2], seen[1] / seen[2]]
        return np.array(rows)

    def born(self, seen: Any, place: Any, speed: float) -> tuple[Any, Any]:
        """State and covariance of a new target at about a place (3,), by Gauss and Newton's method."""
        state = np.zeros(6)
        state[::2] = place
        weight, prior = np.linalg.inv(self.covariance), np.diag([0.0, speed**-2] * 3)
        for _ in range(6):
            steps = np.diag([1.0, 0.1] * 3)
            ends = np.hstack([state[:, None] + steps, state[:, None] - steps, state[:, None]])
            values = self.seen_at(ends)
            slope = (values[:, :6] - values[:, 6:12]) / (2 * np.diag(steps))
            information = slope.T @ weight @ slope + prior
            state = state + np.linalg.solve(information, slope.T @ weight @ (seen - values[:, 12]) - prior @ state)
        return state, np.linalg.inv(information)


class OfPixels(CartesianFilters):
    """Takes in the pairs themselves, unscented: the same information as kcal's tracker, in other coordinates."""

    def take(self, targets: Tensor, pairs: ObjectViews, places: Tensor, localize: Localizer, offset: float) -> None:
        """Take in the pairs of a moment.

        Args:
            targets: whose each pair is.
            pairs: of one moment.
            places: (N, 3) of the pairs alone, east, north, up: where the search for new targets begins.
            localize: the rig.
            offset: seconds by which the right images are later than their times say.
        """
        for i, target in enumerate(targets.tolist()):
            time = float(pairs.time[i, 0])
            seen = torch.cat([pairs.left[i], pairs.right[i]]).numpy()
            delay = float(pairs.time[i, 1]) + offset - time
            model = Pixels.of(localize, delay, pairs.covariance[i])
            if target not in self.states:
                self.begin(target, *model.born(seen, places[i].numpy(), self.speed), time)
                continue
            self.update(target, UnscentedKalmanUpdater(model, alpha=1.0, kappa=0.0), seen, time)


# Degrees: the relative yaw is known to this, 44 m at 5 km.
YAW_SIGMA = 0.001
# Seconds: the right clock is late by the first, and known to the second before.
OFFSET, OFFSET_SIGMA = 0.040, 0.1
# For the long runs: a crystal's drift in s/s, the right image's last row against its first in s, and what is known.
DRIFT, SLOPE, DRIFT_SIGMA, SLOPE_SIGMA = 5e-5, 0.010, 1e-4, 0.02
BEARING_PX, MATCH_PX = 0.5, 0.1
ACCELERATION = 0.2
TARGETS = 30


class Site(NamedTuple):
    """One draw: places and velocities (F, T, 3) at each tenth of a second, the true rig and the believed one."""

    localize: Localizer
    true: Rig
    path: Tensor
    pace: Tensor
    generator: torch.Generator


def drawn_site(seed: int, frames: int) -> Site:
    generator = torch.Generator().manual_seed(seed)
    rig = planned_rig()
    pose = torch.zeros(6, 6, dtype=torch.float64)
    pose[1, 1] = math.radians(YAW_SIGMA) ** 2
    rig.covariance = RigCovariance.of(rig, pose=pose)
    place = Origin(lat=19.07, lon=72.87, height=14.0)
    localize = Localizer(rig.placed(origin=place, heading_deg=0.0, refraction=0.0, refraction_sigma=0.0))
    yaw = math.radians(YAW_SIGMA) * torch.randn((), generator=generator, dtype=torch.float64)
    turn = rotation_from_vector(torch.tensor([0.0, float(yaw), 0.0], dtype=torch.float64))
    true = Rig.pair(rig.left, rig.right, turn @ rig.right_from_left_rotation, rig.right_from_left_translation)
    z = torch.cat([torch.logspace(2, math.log10(5000), TARGETS - 6), torch.full((6,), 5000.0)]).double()
    across = torch.linspace(-0.4, 0.4, TARGETS).double()[torch.randperm(TARGETS, generator=generator)]
    up = 0.25 * (torch.rand(TARGETS, generator=generator).double() - 0.5)
    velocity = torch.randn(TARGETS, 3, generator=generator).double()
    # The near ones walk, so that they stay in view; the far ones fly at some 30 m/s.
    velocity = velocity * (z / 5000.0).sqrt()[:, None] * torch.tensor([20.0, 4.0, 15.0]).double()
    velocity[-6:, 0] = 30.0 * torch.tensor([1, -1, 1, -1, 1, -1]).double()
    push = ACCELERATION * math.sqrt(0.1) * torch.randn(frames, TARGETS, 3, generator=generator, dtype=torch.float64)
    pace = velocity + push.cumsum(0)
    path = torch.stack([across * z, up * z, z], -1) + 0.1 * torch.cat([0.0 * pace[:1], pace[:-1]]).cumsum(0)
    return Site(localize, true, path, pace, generator)


def seen_pairs(site: Site, frame: int, drift: float = 0.0, slope: float = 0.0) -> tuple[ObjectViews, Tensor, Tensor]:
    """Pairs of a moment, the targets that they are of, and the true places when the left camera looked."""
    g, time = site.generator, frame / 10.0
    # The right camera runs at 25 frames a second; the nearest frame is taken, and its clock is late.
    stamp = round(25 * (time + 0.013)) / 25 - 0.013
    places = site.path[frame]
    row = site.true.right.project(site.true.right_from_left(places))[0][:, 1:] / site.true.right.size[1] - 0.5
    later = places + (stamp + OFFSET + drift * time + slope * row - time) * site.pace[frame]
    left, fine = site.true.left.project(places)
    right, seen = site.true.right.project(site.true.right_from_left(later))
    # One target in 20 is hidden, for a second at a time.
    hidden = ((torch.arange(TARGETS) * 7 + int(time)) % 20) == 0
    inside = fine & seen & site.true.left.inside(left) & site.true.right.inside(right) & ~hidden
    which = inside.nonzero()[:, 0]
    box = BEARING_PX * torch.randn(TARGETS, 2, generator=g).double()
    match = MATCH_PX * torch.randn(TARGETS, 2, generator=g).double()
    still = torch.eye(2, dtype=torch.float64)
    shared = BEARING_PX**2 * torch.ones(2, 2, dtype=torch.float64)
    shared[1, 1] += MATCH_PX**2
    pairs = ObjectViews.of_pairs(
        (left + box)[which],
        (right + box + match)[which],
        covariance=torch.kron(shared, still).expand(len(which), 4, 4),
        time=torch.tensor([time, stamp], dtype=torch.float64).expand(len(which), 2),
        score=torch.ones(len(which)),
        category=("object",) * len(which),
    )
    return pairs, which, places


def owner(tracks: Tracks, site: Site, places: Tensor) -> Tensor:
    """The target nearest in direction to each track."""
    direction = torch.nn.functional.normalize(places @ site.localize.enu_from_rig.T, dim=-1)
    return torch.cdist(tracks.state.bearing, direction).argmin(-1)


def gospa(found: Tensor, true: Tensor, cutoff: float) -> float:
    """Generalized optimal sub-pattern assignment (Rahmathullah et al. 2017), alpha = 2.

    Example:
        >>> gospa(torch.tensor([[1.0, 0, 0]]), torch.tensor([[0.0, 0, 0], [50.0, 0, 0]]), 10.0) ** 2
        51.0
    """
    from scipy.optimize import linear_sum_assignment

    cost = torch.cdist(found, true).clamp_max(cutoff).numpy() ** 2
    rows, columns = linear_sum_assignment(cost)
    matched = cost[rows, columns]
    real = matched < cutoff**2
    alone = len(found) + len(true) - 2 * int(real.sum())
    return math.sqrt(float(matched[real].sum() + cutoff**2 / 2 * alone))


class Figures(collections.defaultdict[str, list[Tensor]]):
    """Values over seeds by name."""

    def __init__(self) -> None:
        super().__init__(list)

    def add(self, name: str, values: Tensor | float) -> None:
        """Keep values under a name."""
        self[name].append(torch.as_tensor(values, dtype=torch.float64).flatten())

    def all(self, name: str) -> Tensor:
        """All that was kept."""
        return torch.cat(self[name])


def relative(state: Any, true: Tensor) -> Tensor:
    """Errors of the inverse range in sigmas."""
    return (state.inverse_range - 1.0 / torch.linalg.vector_norm(true, dim=-1)) / state.inverse_range_sigma


def run_seed(seed: int, seconds: float, figures: Figures) -> None:
    frames = round(seconds * 10)
    site = drawn_site(seed, frames)
    options = TrackOptions(motions=(Motion(acceleration=ACCELERATION),), speed_mps=15.0)
    tracker = Tracker(site.localize, options, clock=ClockPrior(offset_sigma_s=OFFSET_SIGMA), record=True)
    # The same without clock errors in the estimate of what is expected: knows the offset exactly.
    informed = Tracker(site.localize, options, clock=ClockPrior(offset_s=OFFSET))
    # Filter against filter: both know the rig and the clock, and get the same pairs.
    plain = Localizer(
        site.true.placed(origin=site.localize.origin, heading_deg=0.0, refraction=0.0, refraction_sigma=0.0)
    )
    # The rival knows no errors that last, and the marks have none.
    equal = Tracker(plain, dataclasses.replace(options, lasting_px=0.0), clock=ClockPrior(offset_s=OFFSET))
    positions, pixels = OfPositions(ACCELERATION, options.speed_mps), OfPixels(ACCELERATION, options.speed_mps)
    for frame in range(frames):
        time = frame / 10.0
        pairs, which, places = seen_pairs(site, frame)
        enu, pace = places @ site.localize.enu_from_rig.T, site.pace[frame] @ site.localize.enu_from_rig.T
        tracks, exact = tracker(pairs), informed(pairs)
        one = site.localize(pairs.left, pairs.right, pairs.covariance)
        mine = owner(tracks, site, places)
        same = equal(pairs)
        pixels.take(which, pairs, plain(pairs.left, pairs.right, pairs.covariance).enu, plain, OFFSET)
        if frame >= 5:
            # This one is even told the velocities that bring the two times of a pair together.
            late = (pairs.time[:, 1:] - pairs.time[:, :1] + OFFSET) * pace[which, :1] / float(site.true.baseline)
            ahead = one.enu * (1.0 - late)
            positions.take(which, ahead, one.covariance, one.status == 0, time)
        far = which >= TARGETS - 6
        lost = torch.linalg.vector_norm(places, dim=-1)
        if frame == 9:
            figures.add("single", one.inverse_range[far] - 1.0 / lost[which[far]])
        for name, moment in (("1 s", 10), ("10 s", 100)):
            if frame == moment:
                there = mine >= TARGETS - 6
                figures.add(f"range {name}", tracks.state.inverse_range[there] - 1.0 / lost[mine[there]])
                figures.add(f"bound {name}", tracks.state.inverse_range_sigma[there])
        if frame >= 20 and frame % 10 == 0:
            figures.add("filter", relative(tracks.state, places[mine]))
            ok = tracks.state.status == 0
            error = (tracks.state.velocity - pace[mine])[ok]
            figures.add("velocity", error / tracks.state.velocity_covariance[ok].diagonal(dim1=-2, dim2=-1).sqrt())
            near = torch.linalg.vector_norm(enu[mine], dim=-1) < 1500
            error = (tracks.state.enu - enu[mine])[ok & near]
            sigma = tracks.state.covariance[ok & near].diagonal(dim1=-2, dim2=-1).sqrt()
            figures.add("position", error / sigma)
            floor = tracks.state.covariance[ok] - tracks.state.systematic[ok]
            figures.add("floor", torch.linalg.eigvalsh(floor)[:, 0] / floor.diagonal(dim1=-2, dim2=-1).sum(-1))
            if frame >= 30:
                compare(figures, "positions", positions, exact, owner(exact, site, places), enu, time)
                compare(figures, "pixels", pixels, same, owner(same, site, places), enu, time)
    offset, doubt = tracker.clock_estimate().offset(seconds / 2)
    figures.add("clock", torch.tensor([(offset - OFFSET) / doubt]))
    figures.add("clock ms", torch.tensor([1e3 * (offset - OFFSET)]))
    figures.add("clock sigma ms", torch.tensor([1e3 * doubt]))
    for track in tracker.smoothed():
        step = len(track.time) // 2
        true = site.path[round(10 * float(track.time[step]))]
        bearing = torch.nn.functional.normalize(true @ site.localize.enu_from_rig.T, dim=-1)
        target = torch.cdist(track.state.bearing[step : step + 1], bearing).argmin()
        ratio = track.state.inverse_range[step] - 1.0 / torch.linalg.vector_norm(true[target])
        figures.add("smoother", ratio / track.state.inverse_range_sigma[step])


def run_clock(seed: int, seconds: float, figures: Figures) -> None:
    """The clock alone, with drift and unlike rolling shutters; judged at the end."""
    frames = round(seconds * 10)
    site = drawn_site(seed, frames)
    prior = ClockPrior(offset_sigma_s=OFFSET_SIGMA, drift_sigma=DRIFT_SIGMA, slope_sigma_s=SLOPE_SIGMA)
    options = TrackOptions(motions=(Motion(acceleration=ACCELERATION),), speed_mps=15.0)
    tracker = Tracker(site.localize, options, clock=prior)
    for frame in range(frames):
        tracker(seen_pairs(site, frame, DRIFT, SLOPE)[0], frame / 10.0)
    estimate = tracker.clock_estimate()
    offset, sigma = estimate.offset(tracker.time)
    sigmas = estimate.covariance.diagonal().sqrt()
    found = torch.stack([torch.tensor(offset), *estimate.values[1:]])
    true = torch.tensor([OFFSET + DRIFT * tracker.time, DRIFT, SLOPE])
    figures.add("long clock", (found - true)[None])
    figures.add("long clock sigma", torch.stack([torch.tensor(sigma), *sigmas[1:]])[None])


def compare(
    figures: Figures, kind: str, rival: CartesianFilters, tracks: Tracks, owners: Tensor, enu: Tensor, time: float
) -> None:
    """Both filters on the targets that both follow; what kcal's tracker misses or doubles is counted apart."""
    names, guessed = rival.places(time)
    ours = {int(target): row for row, target in enumerate(owners.tolist()) if int(tracks.state.status[row]) == 0}
    both = [i for i, name in enumerate(names) if name in ours]
    there = torch.tensor([names[i] for i in both])
    mine = torch.stack([tracks.state.enu[ours[names[i]]] for i in both])
    figures.add(f"{kind}: kcal", gospa(mine, enu[there], 300.0))
    figures.add(f"{kind}: stonesoup", gospa(guessed[both], enu[there], 300.0))
    figures.add(f"{kind}: missed", float(len(names) - len(both)))
    figures.add(f"{kind}: doubled", float(len(owners) - len(set(owners.tolist()))))
    figures.add(f"{kind}: followed", float(len(names)))


@section("tracks.md", "tracks", seeds=range(1), seconds=4.0, clock_seeds=1, clock_seconds=3.0)
def tracks(seeds: range = range(4), seconds: float = 12.0, clock_seeds: int = 4, clock_seconds: float = 60.0) -> Lines:
    """Seeds and seconds of the tracks, and of the runs of the clock."""
    figures = Figures()
    for seed in seeds:
        run_seed(seed, seconds, figures)
    for seed in range(clock_seeds):
        run_clock(100 + seed, clock_seconds, figures)
    meters = 5000.0**2
    yield (
        f"{TARGETS} targets from 100 m to 5 km, six of them at 5 km and 30 m/s; cameras of 10 and 25 frames a second; "
        f"boxes {BEARING_PX} px, matching {MATCH_PX} px; relative yaw known to {YAW_SIGMA}°; {seconds:g} s, "
        f"{len(seeds)} draws of rig, targets and noise."
    )
    yield ["range at 5 km", "RMS of error (of the inverse range, times 5 km squared)", "over its stated sigma"]
    yield ["single frame", f"{rms(figures.all('single')) * meters:,.0f} m", ""]
    for name in ("1 s", "10 s"):
        if f"range {name}" in figures:
            error, bound = rms(figures.all(f"range {name}")), rms(figures.all(f"bound {name}"))
            yield [f"after {name}", f"{error * meters:,.0f} m", f"{error / bound:.2f}"]
    yield ""
    yield ["output", "in the 95 % interval", "cases"]
    for name, key in (("range", "filter"), ("position, each axis", "position"), ("velocity, each axis", "velocity"),
                      ("range, smoothed", "smoother"), ("clock offset", "clock")):  # fmt: skip
        values = figures.all(key)
        yield [name, f"{100 * float((values.abs() < 1.96).double().mean()):.1f} %", len(values)]
    smallest = float(figures.all("floor").min())
    yield f"Smallest eigenvalue of covariance minus systematic part, over its trace: {smallest:.1e}."
    offset = figures.all("clock ms")
    # Of a target at 30 m/s that crosses at 5 km: range times speed over baseline.
    lost = [5000.0 * 30.0 / 10.0 * ms / 1e3 for ms in (40.0, rms(offset))]
    yield ""
    yield (
        f"Clock: offset of {1e3 * OFFSET:g} ms found with an RMS error of {rms(offset):.2f} ms, stated "
        f"{rms(figures.all('clock sigma ms')):.2f} ms. A target at 30 m/s that crosses at 5 km is wrong by "
        f"{lost[0]:.0f} m without and {lost[1]:.0f} m with it."
    )
    yield ["GOSPA (cutoff 300 m) of the targets that both follow", "kcal", "Stone Soup", "kcal over Stone Soup"]
    for what, kind in (
        ("equal information: the pairs, the true rig, the clock; unscented, Cartesian", "pixels"),
        ("positions as measurements, Kalman filter, Cartesian; the believed rig", "positions"),
    ):
        own, other = (float(figures.all(f"{kind}: {who}").mean()) for who in ("kcal", "stonesoup"))
        yield [what, f"{own:.1f} m", f"{other:.1f} m", f"{own / other:.3f}"]
    missed, doubled, followed = (
        float(figures.all(f"pixels: {name}").sum()) for name in ("missed", "doubled", "followed")
    )
    yield (
        f"Stone Soup's filters are told whose each sighting is. Of {followed:,.0f} targets in all moments kcal's "
        f"tracker has no position for {missed:,.0f} and two for {doubled:,.0f}."
    )
    yield from clock_table(figures, clock_seconds)


def clock_table(figures: Figures, seconds: float) -> Lines:
    error, sigma = (figures.all(name).reshape(-1, 3) for name in ("long clock", "long clock sigma"))
    yield [f"clock after {seconds:g} s", "truth", "RMS of error", "stated sigma", "in the 95 % interval"]
    for column, (what, true, unit, scale) in enumerate((
        ("offset at the end", OFFSET + DRIFT * seconds, "ms", 1e3),
        ("drift", DRIFT, "ppm", 1e6),
        ("last row against first", SLOPE, "ms", 1e3),
    )):  # fmt: skip
        inside = int((error[:, column].abs() < 1.96 * sigma[:, column]).sum())
        yield [
            what, f"{scale * true:g} {unit}", f"{scale * rms(error[:, column]):.2f} {unit}",
            f"{scale * rms(sigma[:, column]):.2f} {unit}", f"{inside} of {len(error)}",
        ]  # fmt: skip
