"""Motion of targets: hovering, straight and turning models, and a state in which they stay linear at any range.

A target is the six numbers (x / z, y / z, 1 / z, velocity / z) in its own frame, a rotation of the rig's axes. Straight
motion is then a projective map: nothing is divided by the inverse range, so that a target whose range is hardly known,
or at infinity, is no exception. Pixels are nearly linear in the first three.

Source: modified polar coordinates (Stallard 1991) and inverse depth (Civera et al. 2008), in homogeneous form.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.pipeline.small_matrices import outer, product


@dataclasses.dataclass(frozen=True, kw_only=True)
class Motion:
    """How targets may move.

    Args:
        acceleration: white noise of the acceleration, m/s² in a band of 1 Hz.
        turn_rate: radians per second to the left, as seen from above.
        memory_s: seconds in which a velocity is forgotten; infinite: it stays.

    Raises:
        InputError: a noise that is negative or not finite, or a memory that is not positive.
    """

    acceleration: float
    turn_rate: float = 0.0
    memory_s: float = math.inf

    def __post_init__(self) -> None:
        if not (0 <= self.acceleration < math.inf and math.isfinite(self.turn_rate) and self.memory_s > 0):
            raise InputError("motion: a finite noise, not negative, a finite rate and a positive memory are needed")


STRAIGHT = Motion(acceleration=0.3)
MOTIONS = (
    Motion(acceleration=0.3, memory_s=1.0),
    STRAIGHT,
    Motion(acceleration=2.0, turn_rate=0.2),
    Motion(acceleration=2.0, turn_rate=-0.2),
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
