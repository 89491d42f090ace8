"""From what is believed of tracks to places and velocities on the Earth, at each time step and smoothed afterwards."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcal.arrow import arrow_table
from kcal.locate.geodesy import place_enu
from kcal.locate.localizer import Localizer
from kcal.locate.stereo import BEARING_SIGMAS, PositionStatus, flagged, range_interval, status_counts
from kcal.pipeline.imm_filter import Summary
from kcal.pipeline.measurements import product, rooted, squared
from kcal.texts import brief, briefly

# From what is believed of tracks in the rig frame to places and velocities on the Earth, with all their errors.


class TrackStates(NamedTuple):
    """Places of T tracks at one time; nothing is NaN. Look at `status` before anything else.

    Attributes:
        enu: (T, 3) meters east, north, up in the rig's frame (of two cameras: from the left one); zeros unless the
            status is OK.
        covariance: (T, 3, 3) of `enu`; an infinite diagonal unless OK.
        systematic: (T, 3, 3) the part of it that more frames do not reduce: calibration, mounting, clocks,
            refraction, and what lasts of errors in the marks.
        velocity: (T, 3) m/s east, north, up; zeros unless OK.
        velocity_covariance: (T, 3, 3); an infinite diagonal unless OK.
        geodetic: (T, 3) latitude, longitude (degrees), ellipsoidal height (meters); the origin unless OK.
        range_low: (T,) meters from the anchor, lower end of the 95 % interval.
        range_high: (T,) its upper end, infinite where the target may be at infinity.
        status: (T,) int8 codes of `PositionStatus`: OK, BEARING_ONLY or PARALLEL.
        bearing: (T, 3) unit vector east, north, up, from the anchor to the target; light bends beside it.
        inverse_range: (T,) one over meters: the quantity whose errors are Gaussian.
        inverse_range_sigma: (T,).
        anchor: (T,) int64, number of the camera from which bearing and range count: the first that saw the target.
    """

    enu: Tensor
    covariance: Tensor
    systematic: Tensor
    velocity: Tensor
    velocity_covariance: Tensor
    geodetic: Tensor
    range_low: Tensor
    range_high: Tensor
    status: Tensor
    bearing: Tensor
    inverse_range: Tensor
    inverse_range_sigma: Tensor
    anchor: Tensor

    def __repr__(self) -> str:
        return brief(self, status=status_counts(self.status))


def track_table(
    state: TrackStates, number: Sequence[int], time: Tensor, texts: dict[str, list[str]], more: dict[str, Tensor]
) -> Any:
    """Places and velocities of tracks of these numbers as a `pyarrow.Table`; null where the status is not OK."""
    ok = (state.status == int(PositionStatus.OK))[:, None]
    upper = [[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    blocks = {
        "lat lon height_ellipsoidal_m": state.geodetic,
        "east_m north_m up_m": state.enu,
        "range_m": state.inverse_range.reciprocal()[:, None],
        "cov_ee_m2 cov_en_m2 cov_eu_m2 cov_nn_m2 cov_nu_m2 cov_uu_m2": state.covariance[:, upper[0], upper[1]],
        "velocity_east_mps velocity_north_mps velocity_up_mps": state.velocity,
        "velocity_east_sigma_mps velocity_north_sigma_mps velocity_up_sigma_mps": (
            state.velocity_covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0.0).sqrt()
        ),
    }
    numbers = {"time_s": time, **more, "range_low_m": state.range_low, "range_high_m": state.range_high}
    for names, values in blocks.items():
        numbers |= dict(zip(names.split(), torch.where(ok, values, torch.nan).T, strict=True))
    status = [PositionStatus(code).name.lower() for code in state.status.tolist()]
    columns: dict[str, Any] = {"name": [f"track {one}" for one in number], "status": status, **texts}
    return arrow_table(columns | {name: values.cpu().numpy() for name, values in numbers.items()})


def track_states(
    localize: Localizer, frame: Tensor, home: Tensor, beliefs: Summary, root: Tensor | None
) -> TrackStates:
    """Place beliefs on the Earth.

    Args:
        localize: the rig and where it stands.
        frame: (T, 3, 3) rotations from the rig's axes into the tracks' frames.
        home: (T,) cameras from which the tracks are told.
        beliefs: of T tracks.
        root: (B, R) of the covariance of the shared errors; None: the identity.
    """
    mean, noise, effect = (value.movedim(0, -1) for value in beliefs)
    spread = rooted(effect, root)
    axes = frame.movedim(0, -1).transpose(0, 1)
    ray = torch.cat([mean[:2], torch.ones_like(mean[:1])])
    squares = ray.square().sum(0)
    length = squares.sqrt()
    inverse_range = mean[2] / length
    slope = torch.cat([-inverse_range * ray[:2] / squares, (1.0 / length)[None]])
    variance = ((slope[:, None] * noise[:3, :3]).sum(0) * slope).sum(0)
    sigma = (variance + (slope[:, None] * spread[:3]).sum(0).square().sum(0)).clamp_min(0.0).sqrt()
    status = torch.zeros_like(inverse_range, dtype=torch.int8)
    weak = inverse_range < BEARING_SIGMAS * sigma
    status = flagged(status, (weak, PositionStatus.BEARING_ONLY), (inverse_range <= 0, PositionStatus.PARALLEL))
    ok = status == int(PositionStatus.OK)
    low, high = range_interval(inverse_range, sigma)

    depth = 1.0 / torch.where(ok, mean[2], 1.0)
    bearing = (axes * ray).sum(1)
    straight, velocity = bearing * depth, (axes * mean[3:]).sum(1) * depth
    # East, north, up and the velocity by the state.
    none = torch.zeros_like(axes)
    by_place = torch.cat([axes[:, :2], -straight[:, None], none], 1)
    by_state = torch.cat([by_place, torch.cat([none[:, :2], -velocity[:, None], axes], 1)]) * depth
    carried = product(by_state, torch.cat([noise, spread], 1))
    random, systematic = product(carried[:, :6], by_state.transpose(0, 1)), squared(carried[:, 6:])
    enu = localize.rig.center[home] + straight.T
    whole, systematic = (value.movedim(-1, 0) for value in (random + systematic, systematic))
    nowhere = torch.diag(mean.new_full((3,), math.inf))
    there = ok[:, None, None]
    assert localize.ecef_from_enu is not None
    geodetic = place_enu(enu, localize.ecef_from_enu, localize.ecef_of_origin)
    return TrackStates(
        enu=torch.where(ok[:, None], enu, 0.0),
        covariance=torch.where(there, whole[:, :3, :3], nowhere),
        systematic=torch.where(there, systematic[:, :3, :3], nowhere),
        velocity=torch.where(ok[:, None], velocity.T, 0.0),
        velocity_covariance=torch.where(there, whole[:, 3:, 3:], nowhere),
        geodetic=torch.where(ok[:, None], geodetic, localize.geodetic_of_origin),
        range_low=low,
        range_high=high,
        status=status,
        bearing=(bearing / length).T,
        inverse_range=inverse_range,
        inverse_range_sigma=sigma,
        anchor=home,
    )


# Smoothing afterwards: what later sightings say of earlier time steps (Rauch, Tung, Striebel).
#
# The pass back follows the noise alone, like the filter's gain. The effect of the shared errors is carried through it,
# so that it stays in the smoothed covariance as it was.


@briefly
class SmoothedTrack(NamedTuple):
    """One track at the M time steps of its life.

    Attributes:
        number: as in `Tracks`.
        time: (M,) seconds.
        state: places and velocities, M of them.
    """

    number: int
    time: Tensor
    state: TrackStates

    def to_arrow(self) -> Any:
        """A `pyarrow.Table`, a row for each time, with the columns of the files of tracks; needs the extra `tables`."""
        return track_table(self.state, [self.number] * len(self.time), self.time, {}, {})


class _Moment(NamedTuple):
    """A track at one time, each (1, ...); `prior` and `cross` tell how it was predicted, None at birth.

    `clock` are the values of the clock's errors with which both were made.
    """

    time: float
    frame: Tensor
    home: Tensor
    belief: Summary
    prior: Summary | None
    cross: Tensor | None
    clock: Tensor


class History:
    """What smoothing needs of each track, by its key: it grows by some kilobytes for each track and time step."""

    def __init__(self) -> None:
        self._moments: dict[int, list[_Moment]] = {}
        self._priors: dict[int, tuple[Summary, Tensor]] = {}
        self._clock = torch.zeros(0)
        # Of tracks, once they have one; several share a number if motion recognized the target.
        self.numbers: dict[int, int] = {}

    def predicted(self, keys: Sequence[int], prior: Summary, cross: Tensor, clock: Tensor) -> None:
        """Note what is believed before the sightings of a time step."""
        places = [torch.tensor([i], device=cross.device) for i in range(len(keys))]
        self._clock = clock
        self._priors = {key: (prior.at(i), cross[i]) for key, i in zip(keys, places, strict=True)}

    def filtered(
        self, time: float, keys: Sequence[int], frame: Tensor, home: Tensor, beliefs: Summary, clock: Tensor
    ) -> None:
        """Note what is believed after them; tracks that are gone may be missing."""
        for place, key in enumerate(keys):
            which = torch.tensor([place], device=frame.device)
            prior, cross = self._priors.get(key, (None, None))
            # The sightings of this time step told something of the clock.
            prior = None if prior is None else _moved(prior, clock - self._clock)
            moment = _Moment(time, frame[which], home[which], beliefs.at(which), prior, cross, clock)
            self._moments.setdefault(key, []).append(moment)
        self._priors = {}

    def smoothed(self, localize: Localizer, clock: Tensor, root: Tensor | None) -> list[SmoothedTrack]:
        """All confirmed tracks, with the clock as now known and a root of the covariance of the shared errors."""
        by_number: dict[int, list[tuple[_Moment, Summary]]] = {}
        for key, number in self.numbers.items():
            moments = [_with_clock(moment, clock) for moment in self._moments[key]]
            by_number.setdefault(number, []).extend(zip(moments, _passed_back(moments), strict=True))
        found = []
        for number, pairs in sorted(by_number.items()):
            pairs.sort(key=lambda pair: pair[0].time)
            beliefs = Summary(*(torch.cat(values) for values in zip(*(belief for _, belief in pairs), strict=True)))
            frame, home = (torch.cat([getattr(moment, name) for moment, _ in pairs]) for name in ("frame", "home"))
            time = torch.tensor([moment.time for moment, _ in pairs], dtype=torch.float64)
            found.append(SmoothedTrack(number, time, track_states(localize, frame, home, beliefs, root)))
        return found


def _moved(belief: Summary, clock: Tensor) -> Summary:
    """The belief after the clock's errors became known to be larger by `clock`."""
    first = belief.effect.shape[-1] - len(clock)
    return belief._replace(mean=belief.mean + belief.effect[..., first:] @ clock)


def _with_clock(moment: _Moment, clock: Tensor) -> _Moment:
    change = clock - moment.clock
    prior = None if moment.prior is None else _moved(moment.prior, change)
    return moment._replace(belief=_moved(moment.belief, change), prior=prior)


def _passed_back(moments: list[_Moment]) -> list[Summary]:
    beliefs = [moments[-1].belief]
    for now, later in zip(moments[-2::-1], moments[:0:-1], strict=True):
        if later.prior is None or later.cross is None:
            beliefs.append(now.belief)
            continue
        mean, noise, effect = now.belief
        prior, after = later.prior, beliefs[-1]
        # Units of one sigma: directions and inverse ranges differ by orders of magnitude.
        unit = prior.noise.diagonal(dim1=-2, dim2=-1).rsqrt()
        white = unit[..., :, None] * prior.noise * unit[..., None, :]
        gain = (later.cross * unit[..., None, :]) @ torch.linalg.inv_ex(white)[0] * unit[..., None, :]
        mean = mean + (gain @ (after.mean - prior.mean)[..., None])[..., 0]
        noise = noise + gain @ (after.noise - prior.noise) @ gain.mT
        beliefs.append(Summary(mean, noise, effect + gain @ (after.effect - prior.effect)))
    return beliefs[::-1]
