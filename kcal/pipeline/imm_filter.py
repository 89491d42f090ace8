"""Interacting models: predict, compare and update what is believed of each track, all tracks and models at once."""

from __future__ import annotations

from typing import NamedTuple, Self

import torch
from torch import Tensor

from kcal.pipeline.measurements import Anchored
from kcal.pipeline.motion import Transition, by_rates, moved, rates
from kcal.pipeline.small_matrices import congruent, eliminate, mahalanobis, outer, product, rooted, solved, squared


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
    """T tracks under J models; see `kcal.pipeline.motion` for the state and `kcal.pipeline.shared_errors` for b.

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
    # Velocities of earlier moments are today's, turned back; a memory that fades would let them grow without end. The
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


def born(seen: Anchored, timing: Timing, speed: float, models: int) -> Beliefs:
    """Beliefs from one sighting each, with velocities of zero and a standard deviation of `speed` along each axis."""
    slope = seen.late.sum(0)
    normal = product(slope.transpose(0, 1), slope)
    still = torch.eye(3, dtype=slope.dtype, device=slope.device)[..., None]
    spread = solved(eliminate(normal, still.expand_as(normal)))
    gain = product(spread, slope.transpose(0, 1))  # (3, M, N)
    place = seen.place + (gain * seen.value).sum(1)
    state = torch.cat([place, torch.zeros_like(place)])
    late = by_rates(product(gain, (seen.late * timing.delay[:, None, None]).sum(0)), state)[:, 3:]
    # The range is hardly known at first, but a speed per meter of range must not vanish.
    drift = speed**2 * (place[2].square() + spread[2, 2])
    here, by_clock = spread + drift * squared(late), []
    for which in range(len(timing.clock)):
        by_camera = by_rates(product(gain, seen.late[1 + which]), state)[:, 3:]
        here = here + drift * timing.unsure[which].square() * squared(by_camera)
        by_clock.append(by_camera[:, None] * timing.clock[which, :, None])
    pace, both = still * drift, -drift * late
    noise = torch.cat([torch.cat([here, both], 1), torch.cat([both.transpose(0, 1), pace], 1)])
    shared = torch.nn.functional.pad(product(gain, seen.shared), (0, 0, 0, 0, 0, 3))
    clocks = torch.cat(by_clock, 1) if by_clock else state.new_zeros(3, 0, *late.shape[1:])
    clocks = torch.nn.functional.pad(-clocks, (0, 0, 0, 0, 0, 0, 0, 3))
    columns = torch.cat([noise, -shared], 1)
    state, columns, clocks = (value[..., None, :].repeat_interleave(models, -2) for value in (state, columns, clocks))
    return Beliefs(state, columns, clocks, state.new_full((models, place.shape[-1]), 1.0 / models))
