"""Interacting models: predict, compare and update what is believed of each track, all tracks and models at once."""

from __future__ import annotations

from typing import NamedTuple, Self

import torch
from torch import Tensor

from kcal.pipeline.motion import Transition, moved, rates
from kcal.pipeline.sightings import Anchored


class Beliefs(NamedTuple):
    """T tracks under J models; see `kcal.pipeline.motion` for the state and `kcal.pipeline.consider` for b.

    Attributes:
        mean: (T, J, 6) as if b were zero.
        noise: (T, J, 6, 6) covariance from marks and motion alone.
        shared: (T, J, 6, B): the true state is mean + shared b + noise.
        weight: (T, J) probabilities of the models.
    """

    mean: Tensor
    noise: Tensor
    shared: Tensor
    weight: Tensor

    def at(self, which: Tensor) -> Self:
        """The tracks at some places."""
        return type(self)(*(value[which] for value in self))

    def merged(self) -> Self:
        """One model with the same mean and covariance."""
        weight = self.weight[..., None]
        mean = (weight * self.mean).sum(1, keepdim=True)
        apart = self.mean - mean
        noise = (weight[..., None] * (self.noise + apart[..., :, None] * apart[..., None, :])).sum(1, keepdim=True)
        shared = (weight[..., None] * self.shared).sum(1, keepdim=True)
        return type(self)(mean, noise, shared, torch.ones_like(self.weight[:, :1]))

    def mixed(self, stay: float) -> Self:
        """Before a prediction: models may have switched. `stay` is the probability that they did not, by chance too."""
        count = self.weight.shape[1]
        if count == 1:
            return self
        switch = torch.full((count, count), (1 - stay) / count).to(self.weight)
        switch = switch + stay * torch.eye(count).to(self.weight)
        weight = self.weight @ switch
        share = (self.weight[:, :, None] * switch / weight[:, None, :]).mT  # (T, to, from)
        mean = share @ self.mean
        apart = self.mean[:, None] - mean[:, :, None]  # (T, to, from, 6)
        noise = torch.einsum("tji,tiab->tjab", share, self.noise) + (share[..., None] * apart).mT @ apart
        shared = torch.einsum("tji,tiab->tjab", share, self.shared)
        return type(self)(mean, noise, shared, weight)


class Predicted(NamedTuple):
    """Beliefs after a step, and for smoothing (T, 6, 6): the covariance of the merged state before and after it."""

    beliefs: Beliefs
    cross: Tensor


def predicted(beliefs: Beliefs, step: Transition, turn: Tensor | None = None) -> Predicted:
    """Move all by a step; see `moved`."""
    mean, slope, noise = moved(beliefs.mean, step, turn)
    new = Beliefs(mean, slope @ beliefs.noise @ slope.mT + noise, slope @ beliefs.shared, beliefs.weight)
    weight = beliefs.weight[..., None, None]
    before, after = beliefs.merged().mean, new.merged().mean
    apart = (beliefs.mean - before)[..., :, None] * (mean - after)[..., None, :]
    return Predicted(new, (weight * (beliefs.noise @ slope.mT + apart)).sum(1))


class Timing(NamedTuple):
    """How late the marks of N sightings are.

    Attributes:
        delay: (N, 2) seconds by which the left and the right mark are later than the beliefs' time, as far as known.
        clock: (N, C) seconds by which a unit of each of the clock's errors makes the right mark late.
        unsure: (N,) standard deviation of what they make together, seconds.
    """

    delay: Tensor
    clock: Tensor
    unsure: Tensor

    def at(self, which: Tensor) -> Self:
        """The sightings at some places."""
        return type(self)(*(value[which] for value in self))


class Innovations(NamedTuple):
    """Measured minus predicted: innovation = effect b + noise, (N, J, ...).

    Attributes:
        value: (N, J, 4).
        slope: (N, J, 4, 6) of the measurement by the state.
        effect: (N, J, 4, B).
        noise: (N, J, 4, 4) of innovations.
        marks: (N, J, 4, 4) the part of it that does not come from the belief.
    """

    value: Tensor
    slope: Tensor
    effect: Tensor
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
    late = (seen.late * timing.delay.T[..., None, None]).sum(0)[:, None]  # (N, 1, 4, 3)
    direct = torch.eye(4, 6).to(late)
    direct[3] = 0.0
    slope = direct + late @ by_state
    padded = torch.nn.functional.pad(beliefs.mean[..., :3], (0, 1))
    value = seen.value[:, None] - padded - (late @ rate[..., None])[..., 0]
    by_clock = (seen.late[1][:, None] @ rate[..., None]) * timing.clock[:, None, None, :]
    own = seen.shared[:, None].expand(*rate.shape[:2], *seen.shared.shape[1:])
    effect = torch.cat([own, by_clock], -1) + slope @ beliefs.shared
    marks = seen.noise[:, None] + _unknown_motion(seen, by_state @ beliefs.noise @ by_state.mT, timing.unsure)
    return Innovations(value, slope, effect, slope @ beliefs.noise @ slope.mT + marks, marks)


def _unknown_motion(seen: Anchored, rate: Tensor, unsure: Tensor) -> Tensor:
    """The product of two unknowns, a rate with the covariance (N, J, 3, 3) and a delay: noise of second order."""
    late = unsure[:, None, None] * seen.late[1]
    return late[:, None] @ rate @ late.mT[:, None]


class Fit(NamedTuple):
    """How well innovations agree with what was predicted: squared Mahalanobis distances and log densities (N, J)."""

    squared: Tensor
    log_density: Tensor


def fit_of(found: Innovations, root: Tensor) -> Fit:
    """Judge innovations with all errors: the covariance of b is root rootᵀ."""
    spread = found.effect @ root
    covariance = found.noise + spread @ spread.mT
    # Units of one sigma: directions and inverse ranges differ by orders of magnitude.
    unit = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).sqrt()
    factor, _ = torch.linalg.cholesky_ex(covariance / unit[..., :, None] / unit[..., None, :])
    white = torch.linalg.solve_triangular(factor, (found.value / unit)[..., None], upper=False)[..., 0]
    squared = white.square().sum(-1)
    volume = 2.0 * (factor.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).log() + unit.log()).sum(-1)
    return Fit(squared, -0.5 * (squared + volume))


def updated(beliefs: Beliefs, found: Innovations, fit: Fit) -> Beliefs:
    """Take sightings in, one for each track; the gain follows the noise alone."""
    unit = found.noise.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    white = unit[..., :, None] * found.noise * unit[..., None, :]
    inverse = unit[..., :, None] * torch.linalg.inv_ex(white)[0] * unit[..., None, :]
    gain = beliefs.noise @ found.slope.mT @ inverse
    mean = beliefs.mean + (gain @ found.value[..., None])[..., 0]
    # Joseph's form: symmetric and positive whatever the rounding.
    rest = torch.eye(6).to(mean) - gain @ found.slope
    noise = rest @ beliefs.noise @ rest.mT + gain @ found.marks @ gain.mT
    log = beliefs.weight.log() + fit.log_density
    return Beliefs(mean, noise, beliefs.shared - gain @ found.effect, torch.softmax(log, -1).clamp_min(1e-12))


def born(seen: Anchored, timing: Timing, speed: float, models: int) -> Beliefs:
    """Beliefs from one sighting each, with velocities of zero and a standard deviation of `speed` along each axis."""
    count, place = len(seen.value), seen.value[:, :3]
    state = torch.cat([place, torch.zeros_like(place)], -1)
    _, by_state = rates(state)
    late = (seen.late * timing.delay.T[..., None, None]).sum(0)[:, :3] @ by_state[..., 3:]
    # The range is hardly known at first, but a speed per meter of range must not vanish.
    sigma = place[:, 2].square() + seen.noise[:, 2, 2]
    drift = speed**2 * sigma[:, None, None] * torch.eye(3).to(state)
    noise = state.new_zeros(count, 6, 6)
    pace = by_state[..., 3:] @ drift @ by_state[..., 3:].mT
    marks = seen.noise + _unknown_motion(seen, pace[:, None], timing.unsure)[:, 0]
    noise[:, :3, :3] = marks[:, :3, :3] + late @ drift @ late.mT
    noise[:, :3, 3:] = -late @ drift
    noise[:, 3:, :3] = noise[:, :3, 3:].mT
    noise[:, 3:, 3:] = drift
    shared = state.new_zeros(count, 6, seen.shared.shape[-1] + timing.clock.shape[-1])
    shared[:, :3, : seen.shared.shape[-1]] = -seen.shared[:, :3]
    start = Beliefs(state[:, None], noise[:, None], shared[:, None], state.new_ones(count, 1))
    every = [value.repeat_interleave(models, 1) for value in start]
    return Beliefs(every[0], every[1], every[2], every[3] / models)
