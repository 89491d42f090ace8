"""Interacting models: predict, compare and update what is believed of each track, all tracks and models at once."""

from __future__ import annotations

from typing import NamedTuple, Self

import torch
from torch import Tensor

from kcal.pipeline.measurements import Anchored
from kcal.pipeline.motion import Transition, moved, rates
from kcal.pipeline.shared_errors import CLOCK_TERMS
from kcal.pipeline.small_matrices import congruent, eliminate, mahalanobis, outer, product, solved, squared

# The clock's errors times the components of a velocity.
_CLOCK_COLUMNS = 3 * CLOCK_TERMS


class Summary(NamedTuple):
    """What is believed of T tracks, all models together: the true state is mean + effect b + noise.

    Attributes:
        mean: (T, 6) as if b were zero.
        noise: (T, 6, 6) covariance from marks and motion alone.
        effect: (T, 6, K + 3) of the calibration's errors and the clock's.
    """

    mean: Tensor
    noise: Tensor
    effect: Tensor

    def at(self, which: Tensor) -> Self:
        """The tracks at some places."""
        return type(self)(*(value[which] for value in self))


class Beliefs(NamedTuple):
    """T tracks under J models; see `kcal.pipeline.motion` for the state and `kcal.pipeline.shared_errors` for b.

    The errors of a state have 6 + K + 9 columns: of `noise`, `shared` and `late`.

    Attributes:
        mean: (6, J, T) as if b were zero.
        columns: (6, 6 + K + 9, J, T).
        weight: (J, T) probabilities of the models.
    """

    mean: Tensor
    columns: Tensor
    weight: Tensor

    @property
    def noise(self) -> Tensor:
        """(6, 6, J, T) covariance from marks and motion alone."""
        return self.columns[:, :6]

    @property
    def shared(self) -> Tensor:
        """(6, K, J, T) effect of the calibration's errors."""
        return self.columns[:, 6:-_CLOCK_COLUMNS]

    @property
    def late(self) -> Tensor:
        """(6, 3, 3, J, T) effect of the clock's three errors, for each component of the velocity in the state.

        What was seen before a velocity was known counts with the velocity that is known now.
        """
        return _late(self.columns)

    @property
    def effect(self) -> Tensor:
        """(6, K + 3, J, T): the true state is mean + effect b + noise."""
        return _effect(self.columns[:, 6:], self.mean[3:])

    def at(self, which: Tensor) -> Self:
        """The tracks at some places."""
        return type(self)(*(value[..., which] for value in self))

    @property
    def middle(self) -> Tensor:
        """(6, 1, T) the mean over the models."""
        return (self.weight * self.mean).sum(1, keepdim=True)

    def merged(self) -> Self:
        """One model with the same mean and covariance."""
        mean = self.middle
        apart = self.mean - mean
        between = outer(self.weight * apart, apart).sum(-2, keepdim=True)
        columns = (self.weight * self.columns).sum(-2, keepdim=True)
        return type(self)(mean, _with_noise(columns, between), torch.ones_like(self.weight[:1]))

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
        columns = (share * self.columns[:, :, None]).sum(3)
        return type(self)(mean, _with_noise(columns, outer(share * apart, apart).sum(-2)), weight)


def no_beliefs(errors: int, models: int, device: torch.device) -> Beliefs:
    """Of no tracks, with `errors` K of the calibration."""
    shapes = ((6, models, 0), (6, 6 + errors + _CLOCK_COLUMNS, models, 0), (models, 0))
    return Beliefs(*(torch.zeros(shape, dtype=torch.float64, device=device) for shape in shapes))


def _late(columns: Tensor) -> Tensor:
    """(R, 3, 3, ...) of columns (R, C, ...), the last of which are the clock's."""
    return columns[:, -_CLOCK_COLUMNS:].unflatten(1, (CLOCK_TERMS, 3))


def _effect(columns: Tensor, pace: Tensor) -> Tensor:
    """(R, K + 3, ...) of columns (R, K + 9, ...), with a velocity (3, ...)."""
    return torch.cat([columns[:, :-_CLOCK_COLUMNS], (_late(columns) * pace).sum(2)], 1)


def _with_noise(columns: Tensor, noise: Tensor) -> Tensor:
    """The columns with more noise (6, 6, ...)."""
    return torch.cat([columns[:, :6] + noise, columns[:, 6:]], 1)


def predicted(beliefs: Beliefs, step: Transition, turn: Tensor | None = None) -> Beliefs:
    """Move all by a step; see `moved`."""
    found = moved(beliefs.mean, step, turn)
    columns = found.through(beliefs.columns)
    noise = found.through(columns[:, :6].transpose(0, 1)) + found.noise
    # Velocities of earlier moments are today's, turned back; a memory that fades would let them grow without end. The
    # velocity in the state is divided by z, and z has changed by `ahead`.
    keep = step.keep if turn is None else product(turn[:, :, None], step.keep)
    back = keep.transpose(0, 1) * (found.ahead / step.left)
    late = (_late(columns)[:, :, :, None] * back).sum(2).flatten(1, 2)
    columns = torch.cat([noise, columns[:, 6:-_CLOCK_COLUMNS], late], 1)
    return Beliefs(found.state, columns, beliefs.weight)


def cross_covariance(before: Beliefs, after: Beliefs, step: Transition, turn: Tensor | None = None) -> Tensor:
    """(T, 6, 6) of the merged states before and after a prediction, for smoothing."""
    carried = moved(before.mean, step, turn).through(before.noise).transpose(0, 1)
    apart = outer(before.mean - before.middle, after.mean - after.middle)
    return (before.weight * (carried + apart)).sum(-2).movedim(-1, 0)


class Timing(NamedTuple):
    """How late the marks of N sightings are.

    Attributes:
        delay: (2, N) seconds by which the left and the right mark are later than the beliefs' time, as far as known.
        clock: (3, N) seconds by which a unit of each of the clock's errors makes the right mark late.
        unsure: (N,) standard deviation of what they make together, seconds.
    """

    delay: Tensor
    clock: Tensor
    unsure: Tensor

    def at(self, which: Tensor) -> Self:
        """The sightings at some places."""
        return type(self)(*(value[..., which] for value in self))


class Innovations(NamedTuple):
    """Measured minus predicted: innovation = effect b + noise, (..., J, N).

    Attributes:
        value: (4, J, N).
        slope: (4, 6, J, N) of the measurement by the state.
        own: (4, K + 9, J, N) what the sightings themselves add to the columns of b.
        effect: (4, K + 3, J, N) of b, with the velocity as predicted.
        crossed: (4, 6, J, N) covariance of the prediction with the state.
        noise: (4, 4, J, N) of innovations.
        marks: (4, 4, J, N) the part of it that does not come from the belief.
    """

    value: Tensor
    slope: Tensor
    own: Tensor
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
    rate, by_state = rates(beliefs.mean)
    late = (seen.late * timing.delay[:, None, None]).sum(0)[:, :, None]  # (4, 3, 1, N)
    direct = torch.eye(4, 6, dtype=late.dtype, device=late.device)[..., None, None]
    still = torch.cat([direct[:3], torch.zeros_like(direct[:1])])
    slope = still + product(late, by_state)
    value = seen.value[:, None] - (still * beliefs.mean).sum(1) - (late * rate).sum(1)
    by_right = product(seen.late[1][:, :, None], by_state)
    by_clock = (by_right[:, None, 3:] * timing.clock[:, None, None]).flatten(1, 2)
    own = torch.cat([seen.shared[:, :, None].expand(-1, -1, *by_clock.shape[2:]), by_clock], 1)
    carried = product(slope, beliefs.columns)
    crossed, after = carried[:, :6], own + carried[:, 6:]
    effect = _effect(after, beliefs.mean[3:])
    # The product of two unknowns, a rate and a delay, is noise of second order.
    marks = seen.noise[:, :, None] + congruent(timing.unsure * by_right, beliefs.noise)
    noise = product(crossed, slope.transpose(0, 1)) + marks
    return Innovations(value, slope, own, effect, crossed, noise, marks)


class Fit(NamedTuple):
    """How well innovations agree with what was predicted: squared Mahalanobis distances and log densities (J, N)."""

    squared: Tensor
    log_density: Tensor


def fit_of(found: Innovations, root: Tensor) -> Fit:
    """Judge innovations with all errors: the covariance of b is root rootᵀ."""
    covariance = found.noise + squared(product(found.effect, root[..., None, None]))
    distance, volume = mahalanobis(covariance, found.value)
    return Fit(distance, -0.5 * (distance + volume))


def updated(beliefs: Beliefs, found: Innovations, fit: Fit) -> Beliefs:
    """Take sightings in, one for each track; the gain follows the noise alone."""
    gain = solved(eliminate(found.noise, found.crossed)).transpose(0, 1)
    mean = beliefs.mean + (gain * found.value).sum(1)
    rest = torch.eye(6, dtype=mean.dtype, device=mean.device)[..., None, None] - product(gain, found.slope)
    columns = product(rest, beliefs.columns)
    # Joseph's form: symmetric and positive whatever the rounding.
    noise = product(columns[:, :6], rest.transpose(0, 1)) + congruent(gain, found.marks)
    columns = torch.cat([noise, columns[:, 6:] - product(gain, found.own)], 1)
    log = beliefs.weight.log() + fit.log_density
    return Beliefs(mean, columns, torch.softmax(log, 0).clamp_min(1e-12))


def born(seen: Anchored, timing: Timing, speed: float, models: int) -> Beliefs:
    """Beliefs from one sighting each, with velocities of zero and a standard deviation of `speed` along each axis."""
    place = seen.value[:3]
    state = torch.cat([place, torch.zeros_like(place)])
    by_pace = rates(state)[1][:, 3:]
    late = product((seen.late[:, :3] * timing.delay[:, None, None]).sum(0), by_pace)
    by_right = product(seen.late[1, :3], by_pace)
    # The range is hardly known at first, but a speed per meter of range must not vanish.
    drift = speed**2 * (place[2].square() + seen.noise[2, 2])
    here = seen.noise[:3, :3] + drift * (timing.unsure.square() * squared(by_right) + squared(late))
    pace = torch.eye(3, dtype=state.dtype, device=state.device)[..., None] * drift
    both = -drift * late
    noise = torch.cat([torch.cat([here, both], 1), torch.cat([both.transpose(0, 1), pace], 1)])
    by_clock = (by_right[:, None] * timing.clock[:, None]).flatten(1, 2)
    own = torch.nn.functional.pad(torch.cat([seen.shared[:3], by_clock], 1), (0, 0, 0, 0, 0, 3))
    columns = torch.cat([noise, -own], 1)
    state, columns = (value[..., None, :].repeat_interleave(models, -2) for value in (state, columns))
    return Beliefs(state, columns, state.new_full((models, place.shape[-1]), 1.0 / models))
