"""Interacting models: predict, compare and update what is believed of each track, all tracks and models at once."""

from __future__ import annotations

from typing import NamedTuple, Self

import torch
from torch import Tensor

from kcal.pipeline.motion import Transition, moved, rates
from kcal.pipeline.sightings import Anchored


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
    """T tracks under J models; see `kcal.pipeline.motion` for the state and `kcal.pipeline.consider` for b.

    Attributes:
        mean: (T, J, 6) as if b were zero.
        noise: (T, J, 6, 6) covariance from marks and motion alone.
        shared: (T, J, 6, K) effect of the calibration's errors.
        late: (T, J, 6, 3, 3) effect of the clock's three errors, for each component of the velocity in the state: what
            was seen before a velocity was known counts with the velocity that is known now.
        weight: (T, J) probabilities of the models.
    """

    mean: Tensor
    noise: Tensor
    shared: Tensor
    late: Tensor
    weight: Tensor

    @property
    def effect(self) -> Tensor:
        """(T, J, 6, K + 3): the true state is mean + effect b + noise."""
        return torch.cat([self.shared, (self.late @ self.mean[..., None, 3:, None])[..., 0]], -1)

    def at(self, which: Tensor) -> Self:
        """The tracks at some places."""
        return type(self)(*(value[which] for value in self))

    @property
    def middle(self) -> Tensor:
        """(T, 1, 6) the mean over the models."""
        return (self.weight[..., None] * self.mean).sum(1, keepdim=True)

    def merged(self) -> Self:
        """One model with the same mean and covariance."""
        weight, mean = self.weight[..., None], self.middle
        apart = self.mean - mean
        noise = (weight[..., None] * (self.noise + apart[..., :, None] * apart[..., None, :])).sum(1, keepdim=True)
        shared = (weight[..., None] * self.shared).sum(1, keepdim=True)
        late = (weight[..., None, None] * self.late).sum(1, keepdim=True)
        return type(self)(mean, noise, shared, late, torch.ones_like(self.weight[:, :1]))

    def summary(self) -> Summary:
        """The same without the axis of models."""
        merged = self.merged()
        return Summary(merged.mean[:, 0], merged.noise[:, 0], merged.effect[:, 0])

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
        late = torch.einsum("tji,tiabc->tjabc", share, self.late)
        return type(self)(mean, noise, shared, late, weight)


class Predicted(NamedTuple):
    """Beliefs after a step, and for smoothing (T, 6, 6): the covariance of the merged state before and after it."""

    beliefs: Beliefs
    cross: Tensor


def predicted(beliefs: Beliefs, step: Transition, turn: Tensor | None = None) -> Predicted:
    """Move all by a step; see `moved`."""
    mean, slope, noise = moved(beliefs.mean, step, turn)
    # Velocities of earlier moments are today's, turned back; a memory that fades would let them grow without end.
    keep = step.keep if turn is None else turn[:, None] @ step.keep
    # The velocity in the state is divided by z, and z has changed by this.
    share = 1.0 / slope[..., 2, 2][..., None, None, None]
    turned = keep / torch.linalg.vector_norm(keep[..., :1], dim=-2, keepdim=True)
    late = (slope @ beliefs.late.flatten(-2)).unflatten(-1, (-1, 3)) @ (share * turned.mT[..., None, :, :])
    new = Beliefs(mean, slope @ beliefs.noise @ slope.mT + noise, slope @ beliefs.shared, late, beliefs.weight)
    weight = beliefs.weight[..., None, None]
    apart = (beliefs.mean - beliefs.middle)[..., :, None] * (mean - new.middle)[..., None, :]
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
        shared: (N, J, 4, K) effect of the calibration's errors.
        late: (N, J, 4, 3, 3) of the clock's, for each component of the velocity.
        effect: (N, J, 4, K + 3) both, with the velocity as predicted.
        noise: (N, J, 4, 4) of innovations.
        marks: (N, J, 4, 4) the part of it that does not come from the belief.
    """

    value: Tensor
    slope: Tensor
    shared: Tensor
    late: Tensor
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
    shared = seen.shared[:, None] + slope @ beliefs.shared
    by_clock = (seen.late[1][:, None] @ by_state[..., 3:])[..., None, :] * timing.clock[:, None, None, :, None]
    after = by_clock + (slope @ beliefs.late.flatten(-2)).unflatten(-1, (-1, 3))
    effect = torch.cat([shared, (after @ beliefs.mean[..., None, 3:, None])[..., 0]], -1)
    marks = seen.noise[:, None] + _unknown_motion(seen, by_state @ beliefs.noise @ by_state.mT, timing.unsure)
    noise = slope @ beliefs.noise @ slope.mT + marks
    return Innovations(value, slope, shared, after, effect, noise, marks)


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
    shared = beliefs.shared - gain @ found.shared
    late = beliefs.late - (gain @ found.late.flatten(-2)).unflatten(-1, (-1, 3))
    return Beliefs(mean, noise, shared, late, torch.softmax(log, -1).clamp_min(1e-12))


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
    shared = torch.nn.functional.pad(-seen.shared[:, :3], (0, 0, 0, 3))
    by_clock = (seen.late[1, :, :3] @ by_state[..., 3:])[..., None, :] * timing.clock[:, None, :, None]
    late = torch.nn.functional.pad(-by_clock, (0, 0, 0, 0, 0, 3))
    weight = state.new_full((count, models), 1.0 / models)
    every = [value[:, None].repeat_interleave(models, 1) for value in (state, noise, shared, late)]
    return Beliefs(every[0], every[1], every[2], every[3], weight)
