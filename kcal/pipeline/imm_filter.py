"""Models of motion, and the filter that mixes them: predict, compare and update all tracks at once."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple, Self

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.pipeline.measurements import (
    Anchored,
    congruent,
    eliminate,
    mahalanobis,
    outer,
    product,
    rooted,
    solved,
    squared,
)

# Motion of targets: hovering, straight and turning models, and a state in which they stay linear at any range.
#
# A target is the six numbers (x / z, y / z, 1 / z, velocity / z) in its own frame, a rotation of the rig's axes.
# Straight motion is then a projective map: nothing is divided by the inverse range, so that a target whose range is
# hardly known, or at infinity, is no exception. Pixels are nearly linear in the first three.
#
# Source: modified polar coordinates (Stallard 1991) and inverse depth (Civera et al. 2008), in homogeneous form.


@dataclasses.dataclass(frozen=True, kw_only=True)
class Motion:
    """How targets may move.

    Args:
        acceleration: white noise of the acceleration, m/s² in a band of 1 Hz.
        turn_rate: radians per second to the left, as seen from above.
        memory_s: seconds in which a velocity is forgotten; infinite: it stays.
        fast: how many times `TrackOptions.speed_mps` the velocity of a new target is that moves so, across the line of
            sight and along it.

    Raises:
        InputError: a noise that is negative or not finite, a memory that is not positive, or anything but two positive
            numbers of times.
    """

    acceleration: float
    turn_rate: float = 0.0
    memory_s: float = math.inf
    fast: tuple[float, float] = (1.0, 1.0)

    def __post_init__(self) -> None:
        if not (0 <= self.acceleration < math.inf and math.isfinite(self.turn_rate) and self.memory_s > 0):
            raise InputError("motion: a finite noise, not negative, a finite rate and a positive memory are needed")
        if not (isinstance(self.fast, tuple) and len(self.fast) == 2 and all(0 < n < math.inf for n in self.fast)):
            raise InputError(f"motion: fast must be two positive numbers, across and along, got {self.fast!r}")


# New targets may be aircraft at 150 m/s. How fast they cross shows at once, so that only what turns begins as fast; how
# fast they come shows late, and no model may rule it out before.
STRAIGHT = Motion(acceleration=0.3, fast=(1.0, 7.0))
MOTIONS = (
    Motion(acceleration=0.3, memory_s=1.0, fast=(1.0, 7.0)),
    STRAIGHT,
    Motion(acceleration=2.0, turn_rate=0.2, fast=(7.0, 7.0)),
    Motion(acceleration=2.0, turn_rate=-0.2, fast=(7.0, 7.0)),
)


class Transition(NamedTuple):
    """One step of J models for T targets: positions move by `reach` velocity, velocities become `keep` velocity.

    Attributes:
        reach: (3, 3, J, T) seconds.
        keep: (3, 3, J, T), a rotation times `left`.
        left: (J, 1) share of the velocity that is left.
        noise: (3, J, 1) variances of position, of position with velocity, and of velocity, along each axis.
    """

    reach: Tensor
    keep: Tensor
    left: Tensor
    noise: Tensor


def step_numbers(motions: tuple[Motion, ...], dt: float) -> list[list[float]]:
    """What `transition` needs of J models and a step of `dt` seconds: nine rows of J numbers."""
    columns = []
    for motion in motions:
        # Velocity decays and turns at once: v(t) = e^(-t / memory) exp(t rate [up]x) v, integrated for the position.
        decay, rate = 1.0 / motion.memory_s, motion.turn_rate
        left = math.exp(-decay * dt)
        kept, turned = complex(left), complex(-decay, rate)
        kept *= complex(math.cos(rate * dt), math.sin(rate * dt))
        moved = (kept - 1.0) / turned if abs(turned) * dt > 1e-9 else complex(dt)
        upright = (1.0 - left) / decay if decay * dt > 1e-9 else dt
        entries = _noise_entries(motion, dt)
        columns.append([moved.real, moved.imag, upright, kept.real, kept.imag, left, *entries])
    return [list(row) for row in zip(*columns, strict=True)]


def transition(numbers: Tensor, up: Tensor) -> Transition:
    """The step of some models.

    Args:
        numbers: (9, J) from `step_numbers`.
        up: (3, T) unit vectors: the axis of turns in each target's frame.
    """
    x, y, z = up
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).unflatten(0, (3, 3))
    along = outer(up, up)
    still = torch.eye(3, dtype=up.dtype, device=up.device)[..., None]
    # Of what is level, of its turn to the left, and of what is upright.
    parts = torch.stack([still - along, cross, along])[..., None, :]
    steps = numbers[:6].unflatten(0, (2, 3))[:, :, None, None, :, None]
    reach, keep = (steps * parts).sum(1)
    return Transition(reach, keep, numbers[5, :, None], numbers[6:, :, None])


def _noise_entries(motion: Motion, dt: float) -> tuple[float, float, float]:
    """Variances of position, of both together, and of velocity, after `dt` of white acceleration.

    Turns are left out: over the steps of a video they change these by a share of (rate dt)².
    """
    power, k = motion.acceleration**2, dt / motion.memory_s
    if k < 1e-3:
        return power * dt**3 / 3 * (1 - 0.75 * k), power * dt**2 / 2 * (1 - k), power * dt * (1 - k)
    tau, once, twice = motion.memory_s, -math.expm1(-k), -math.expm1(-2 * k)
    return (
        power * tau**3 * (k - 2 * once + twice / 2),
        power * tau**2 * (once - twice / 2),
        power * tau * twice / 2,
    )


class Moved(NamedTuple):
    """States (6, J, T) after a step, a projective map: what is linear in the old state, divided by `ahead`.

    Attributes:
        state: (6, J, T).
        ahead: (J, T) what the new numbers are divided by.
        noise: (6, 6, J, T) what the step adds.
        by_pace: (6, 3, J, T) derivatives of ray and velocity by the old velocity, before the division.
        turn: (3, 3, 1, T) what turns rays, or None.
        shift: (3, 1, T) what another origin adds to a ray for each unit of 1 / z, or None.
    """

    state: Tensor
    ahead: Tensor
    noise: Tensor
    by_pace: Tensor
    turn: Tensor | None
    shift: Tensor | None

    def through(self, columns: Tensor) -> Tensor:
        """The derivatives (6, 6, J, T) of the new state by the old one, times columns (6, C, J, T)."""
        ray = torch.cat([columns[:2], torch.zeros_like(columns[:1])])
        if self.turn is not None:
            ray = product(self.turn, ray)
        if self.shift is not None:
            ray = ray + outer(self.shift, columns[2])
        carried = product(self.by_pace, columns[3:])
        ray = ray + carried[:3]
        new = torch.cat([ray[:2], columns[2:3], carried[3:]])
        return (new - outer(self.state, ray[2])) / self.ahead


def moved(state: Tensor, step: Transition, turn: Tensor | None = None, shift: Tensor | None = None) -> Moved:
    """Move states (6, J, T) by a step, turn their frames, and count from other origins.

    Args:
        state: see the module.
        step: from `transition`.
        turn: (3, 3, T) rotations from the old frames into new ones; None: the frames stay.
        shift: (3, T) the old origins as seen from the new ones, meters, in the new frames; None: they stay.
    """
    reach, keep, rotation = step.reach, step.keep, None
    ray = torch.cat([state[:2], torch.ones_like(state[:1])])
    if turn is not None:
        rotation = turn[:, :, None]
        reach, keep, ray = product(rotation, reach), product(rotation, keep), (rotation * ray).sum(1)
    by_pace = torch.cat([reach, keep])
    carried = (by_pace * state[3:]).sum(1)
    ray = ray + carried[:3]
    origin = None if shift is None else shift[:, None]
    if origin is not None:
        ray = ray + origin * state[2]
    new = torch.cat([ray[:2], state[2:3], carried[3:]]) / ray[2]
    return Moved(new, ray[2], (state[2] / ray[2]).square() * _step_noise(new, step.noise), by_pace, rotation, origin)


# What noise of position, of both together and of velocity adds to the 36 entries, where nothing depends on the state;
# and the last of six numbers.
_BASIS = torch.zeros(6, 6, 3, dtype=torch.float64)
_BASIS[:2, :2, 0] = _BASIS[:2, 3:5, 1] = _BASIS[3:5, :2, 1] = torch.eye(2)
_BASIS[3:, 3:, 2] = torch.eye(3)
_BASIS = _BASIS.flatten(0, 1)
_LAST = torch.eye(6, dtype=torch.float64)[5, :, None, None]


def _step_noise(new: Tensor, noise: Tensor) -> Tensor:
    """Isotropic noise of position and velocity in the new state's numbers, where 1 / z is one: (6, 6, J, T)."""
    fixed = (_BASIS.to(new) @ noise[..., 0]).unflatten(0, (6, 6))[..., None]
    half = outer(new, 0.5 * noise[0] * new - noise[1] * _LAST.to(new))
    return fixed + half + half.transpose(0, 1)


def rates(state: Tensor) -> Tensor:
    """Rates (3, ...) of the first three numbers of a state (6, ...)."""
    across = torch.cat([state[3:5], torch.zeros_like(state[:1])])
    return across - state[:3] * state[5]


def by_rates(rows: Tensor, state: Tensor) -> Tensor:
    """Rows (R, 3, ...) times the derivatives of `rates` by the state: (R, 6, ...)."""
    by_closing = (rows * state[:3]).sum(1, keepdim=True)
    by_place = rows * state[5]
    return torch.cat([-by_place, rows[:, :2].expand(-1, -1, *by_place.shape[2:]), -by_closing], 1)


# Interacting models: predict, compare and update what is believed of each track, all tracks and models at once.


class Summary(NamedTuple):
    """What is believed of T tracks, all models together: the true state is mean + effect b + noise.

    Attributes:
        mean: (T, 6) as if b were zero.
        noise: (T, 6, 6) covariance from marks and motion alone.
        effect: (T, 6, K + Q) of the calibration's errors and the clocks'.
    """

    mean: Tensor
    noise: Tensor
    effect: Tensor

    def at(self, which: Tensor) -> Self:
        """The tracks at some places."""
        return type(self)(*(value[which] for value in self))


class Beliefs(NamedTuple):
    """T tracks under J models; see `kcal.pipeline.imm_filter` for the state and `kcal.pipeline.measurements` for b.

    Attributes:
        mean: (6, J, T) as if b were zero.
        columns: (6, 6 + K, J, T): `noise` and `shared`.
        late: (6, Q, 3, J, T) effect of the clocks' Q errors, for each component of the velocity in the state. What was
            seen before a velocity was known counts with the velocity that is known now.
        weight: (J, T) probabilities of the models.
    """

    mean: Tensor
    columns: Tensor
    late: Tensor
    weight: Tensor

    @property
    def noise(self) -> Tensor:
        """(6, 6, J, T) covariance from marks and motion alone."""
        return self.columns[:, :6]

    @property
    def shared(self) -> Tensor:
        """(6, K, J, T) effect of the calibration's errors."""
        return self.columns[:, 6:]

    @property
    def effect(self) -> Tensor:
        """(6, K + Q, J, T): the true state is mean + effect b + noise."""
        return _effect(self.shared, self.late, self.mean[3:])

    def at(self, which: Tensor) -> Self:
        """The tracks at some places."""
        return type(self)(*(value.index_select(-1, which) for value in self))

    @property
    def middle(self) -> Tensor:
        """(6, 1, T) the mean over the models."""
        return (self.weight * self.mean).sum(1, keepdim=True)

    def merged(self) -> Self:
        """One model with the same mean and covariance."""
        mean = self.middle
        apart = self.mean - mean
        between = outer(self.weight * apart, apart).sum(-2, keepdim=True)
        columns, late = ((self.weight * value).sum(-2, keepdim=True) for value in (self.columns, self.late))
        return type(self)(mean, _with_noise(columns, between), late, torch.ones_like(self.weight[:1]))

    def summary(self) -> Summary:
        """The same without the axis of models."""
        merged = self.merged()
        mean, noise, effect = (value[..., 0, :].movedim(-1, 0) for value in (merged.mean, merged.noise, merged.effect))
        return Summary(mean, noise, effect)

    def mixed(self, stay: Tensor) -> Self:
        """Before a prediction: models may have switched. `stay` is the probability that they did not, by chance too."""
        count = len(self.weight)
        if count == 1:
            return self
        switch = (1 - stay) / count + stay * torch.eye(count, dtype=stay.dtype, device=stay.device)
        joint = switch[..., None] * self.weight  # (to, from, T)
        weight = joint.sum(1)
        share = joint / weight[:, None]
        mean = (share * self.mean[:, None]).sum(2)
        apart = self.mean[:, None] - mean[:, :, None]  # (6, to, from, T)
        columns, late = ((share * value.unsqueeze(-3)).sum(-2) for value in (self.columns, self.late))
        return type(self)(mean, _with_noise(columns, outer(share * apart, apart).sum(-2)), late, weight)


def no_beliefs(errors: int, clock_errors: int, models: int, device: torch.device) -> Beliefs:
    """Of no tracks, with K errors of the calibration and Q of clocks."""
    shapes = ((6, models, 0), (6, 6 + errors, models, 0), (6, clock_errors, 3, models, 0), (models, 0))
    return Beliefs(*(torch.zeros(shape, dtype=torch.float64, device=device) for shape in shapes))


def _effect(shared: Tensor, late: Tensor, pace: Tensor) -> Tensor:
    """(R, K + Q, ...) of effects (R, K, ...) and (R, Q, 3, ...), the latter with a velocity (3, ...)."""
    return torch.cat([shared, (late * pace).sum(2)], 1) if late.shape[1] else shared


def _with_noise(columns: Tensor, noise: Tensor) -> Tensor:
    """The columns with more noise (6, 6, ...)."""
    return torch.cat([columns[:, :6] + noise, columns[:, 6:]], 1)


def predicted(beliefs: Beliefs, step: Transition, turn: Tensor | None = None, shift: Tensor | None = None) -> Beliefs:
    """Move all by a step; see `moved`."""
    found = moved(beliefs.mean, step, turn, shift)
    exact, columns, width = not beliefs.late.shape[1], beliefs.columns, beliefs.columns.shape[1]
    columns = found.through(columns if exact else torch.cat([columns, beliefs.late.flatten(1, 2)], 1))
    noise = found.through(columns[:, :6].transpose(0, 1)) + found.noise
    both = torch.cat([noise, columns[:, 6:width]], 1)
    if exact:
        return Beliefs(found.state, both, beliefs.late, beliefs.weight)
    # Velocities of earlier time steps are today's, turned back; a fading memory would let them grow without end. The
    # velocity in the state is divided by z, and z has changed by `ahead`.
    keep = step.keep if turn is None else product(turn[:, :, None], step.keep)
    back = keep.transpose(0, 1) * (found.ahead / step.left)
    late = columns[:, width:].unflatten(1, beliefs.late.shape[1:3])
    late = (late[:, :, :, None] * back).sum(2)
    return Beliefs(found.state, both, late, beliefs.weight)


def cross_covariance(before: Beliefs, after: Beliefs, step: Transition, turn: Tensor | None = None) -> Tensor:
    """(T, 6, 6) of the merged states before and after a prediction, for smoothing."""
    carried = moved(before.mean, step, turn).through(before.noise).transpose(0, 1)
    apart = outer(before.mean - before.middle, after.mean - after.middle)
    return (before.weight * (carried + apart)).sum(-2).movedim(-1, 0)


class Timing(NamedTuple):
    """How late the marks of N sightings are.

    Attributes:
        delay: (V, N) seconds by which the mark of each camera is later than the beliefs' time, as far as known.
        clock: (V - 1, 3, N) seconds by which a unit of each error of a clock makes the marks of its camera late; the
            first camera's clock is the one that counts. (0, 3, N) where clocks are exact.
        unsure: (V - 1, N) standard deviation of what they make together, seconds; (0, N) where clocks are exact.
    """

    delay: Tensor
    clock: Tensor
    unsure: Tensor

    def at(self, which: Tensor) -> Self:
        """The sightings at some places."""
        return type(self)(*(value.index_select(-1, which) for value in self))


class Innovations(NamedTuple):
    """Measured minus predicted: innovation = effect b + noise, (..., J, N).

    Attributes:
        value: (M, J, N).
        slope: (M, 6, J, N) of the measurement by the state.
        shared: (M, K, 1, N) what the sightings themselves add to the effects of the calibration's errors.
        late: (M, Q, 3, J, N) what they add to those of the clocks'.
        effect: (M, K + Q, J, N) of b, with the velocity as predicted.
        crossed: (M, 6, J, N) covariance of the prediction with the state.
        noise: (M, M, J, N) of innovations.
        marks: (M, M, J, N) the part of it that does not come from the belief.
    """

    value: Tensor
    slope: Tensor
    shared: Tensor
    late: Tensor
    effect: Tensor
    crossed: Tensor
    noise: Tensor
    marks: Tensor


def innovations(beliefs: Beliefs, seen: Anchored, timing: Timing) -> Innovations:
    """Compare beliefs with sightings, one for each track.

    Args:
        beliefs: predicted, N tracks.
        seen: N sightings in the tracks' frames.
        timing: of the sightings.
    """
    by_place = seen.late.sum(0)[:, :, None]  # (M, 3, 1, N)
    moving = (seen.late * timing.delay[:, None, None]).sum(0)[:, :, None]
    slope = by_rates(moving, beliefs.mean) + torch.nn.functional.pad(by_place, (0, 0, 0, 0, 0, 3))
    apart = seen.place[:, None] - beliefs.mean[:3]
    value = seen.value[:, None] + (by_place * apart).sum(1) - (moving * rates(beliefs.mean)).sum(1)
    marks = torch.eye(len(value), dtype=value.dtype, device=value.device)[..., None, None]
    late, own = [], seen.late[1:, :, :, None]
    for which in range(len(timing.clock)):
        by_camera = by_rates(own[which], beliefs.mean)
        late.append(by_camera[:, None, 3:] * timing.clock[which, :, None, None])
        # The product of two unknowns, a rate and a delay, is noise of second order.
        marks = marks + congruent(timing.unsure[which] * by_camera, beliefs.noise)
    shared = seen.shared[:, :, None]
    all_late = torch.cat(late, 1) if late else slope.new_zeros(len(value), 0, 3, *slope.shape[2:])
    carried = product(slope, beliefs.columns)
    crossed = carried[:, :6]
    by_clock = all_late
    if late:
        by_clock = all_late + product(slope, beliefs.late.flatten(1, 2)).unflatten(1, all_late.shape[1:3])
    effect = _effect(shared + carried[:, 6:], by_clock, beliefs.mean[3:])
    noise = product(crossed, slope.transpose(0, 1)) + marks
    return Innovations(value, slope, shared, all_late, effect, crossed, noise, marks.expand_as(noise))


class Fit(NamedTuple):
    """How well innovations agree with what was predicted: squared Mahalanobis distances and log densities (J, N)."""

    squared: Tensor
    log_density: Tensor


def _whole(found: Innovations, root: Tensor | None) -> Tensor:
    """(M, M, J, N) covariance of innovations, with all errors."""
    return found.noise + squared(rooted(found.effect, root))


def fit_of(found: Innovations, root: Tensor | None) -> Fit:
    """Judge innovations with all errors: the covariance of b is root rootᵀ, or the identity."""
    distance, volume = mahalanobis(_whole(found, root), found.value)
    return Fit(distance, -0.5 * (distance + volume))


def updated(beliefs: Beliefs, found: Innovations, root: Tensor | None) -> Beliefs:
    """Take sightings in, one for each track: the gain follows the noise alone, and models are judged as in `fit_of`."""
    models, still = len(beliefs.weight), torch.eye(len(found.value)).to(found.value)[..., None, None]
    columns = torch.cat([found.crossed, found.value[:, None], still.expand_as(found.noise)], 1)
    # Both at once: of the noise alone, and of all.
    done = eliminate(torch.cat([found.noise, _whole(found, root)], 2), columns.repeat(1, 1, 2, 1))
    white = done.columns / done.pivots[:, None]
    gain = product(white[:, :6, :models].transpose(0, 1), done.columns[:, 7:, :models])
    pivots = done.pivots[:, models:]
    distance = (done.columns[:, 6, models:] * white[:, 6, models:]).sum(0)
    mean = beliefs.mean + (gain * found.value).sum(1)
    rest = torch.eye(6, dtype=mean.dtype, device=mean.device)[..., None, None] - product(gain, found.slope)
    columns = product(rest, beliefs.columns)
    # Joseph's form: symmetric and positive whatever the rounding.
    noise = product(columns[:, :6], rest.transpose(0, 1)) + congruent(gain, found.marks)
    columns = torch.cat([noise, columns[:, 6:] - product(gain, found.shared)], 1)
    late = beliefs.late
    if late.shape[1]:
        moved = product(rest, late.flatten(1, 2)) - product(gain, found.late.flatten(1, 2))
        late = moved.unflatten(1, late.shape[1:3])
    log = beliefs.weight.log() - 0.5 * (distance + pivots.log().sum(0))
    return Beliefs(mean, columns, late, torch.softmax(log, 0).clamp_min(1e-12))


def born(seen: Anchored, timing: Timing, speeds: Tensor) -> Beliefs:
    """Beliefs from one sighting each, with velocities of zero.

    Args:
        seen: N sightings in the tracks' frames.
        timing: of the sightings.
        speeds: (2, J) standard deviations of the velocity across the line of sight and along it, meters per second, of
            each model.
    """
    slope = seen.late.sum(0)
    normal = product(slope.transpose(0, 1), slope)
    still = torch.eye(3, dtype=slope.dtype, device=slope.device)[..., None]
    spread = solved(eliminate(normal, still.expand_as(normal)))
    gain = product(spread, slope.transpose(0, 1))  # (3, M, N)
    place = seen.place + (gain * seen.value).sum(1)
    state = torch.cat([place, torch.zeros_like(place)])
    late = by_rates(product(gain, (seen.late * timing.delay[:, None, None]).sum(0)), state)[:, 3:]
    # The range is hardly known at first, but a speed per meter of range must not vanish.
    pace = speeds[[0, 0, 1], :, None] * (place[2].square() + spread[2, 2]).sqrt()  # (3, J, N)
    here, by_clock = spread[..., None, :] + squared(late[..., None, :] * pace), []
    for which in range(len(timing.clock)):
        by_camera = by_rates(product(gain, seen.late[1 + which]), state)[:, 3:]
        here = here + squared((timing.unsure[which] * by_camera)[..., None, :] * pace)
        by_clock.append(by_camera[:, None] * timing.clock[which, :, None])
    both = -late[..., None, :] * pace.square()
    noise = torch.cat([
        torch.cat([here, both], 1), torch.cat([both.transpose(0, 1), still[..., None] * pace.square()], 1)
    ])  # fmt: skip
    shared = torch.nn.functional.pad(product(gain, seen.shared), (0, 0, 0, 0, 0, 3))
    clocks = torch.cat(by_clock, 1) if by_clock else state.new_zeros(3, 0, *late.shape[1:])
    clocks = torch.nn.functional.pad(-clocks, (0, 0, 0, 0, 0, 0, 0, 3))
    models = speeds.shape[1]
    state, shared, clocks = (value[..., None, :].repeat_interleave(models, -2) for value in (state, -shared, clocks))
    columns = torch.cat([noise, shared], 1)
    return Beliefs(state, columns, clocks, state.new_full((models, place.shape[-1]), 1.0 / models))
