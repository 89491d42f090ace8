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
        reach: (T, J, 3, 3) seconds.
        keep: (T, J, 3, 3).
        noise: (T, J, 6, 6) covariance of position and velocity, meters and seconds.
    """

    reach: Tensor
    keep: Tensor
    noise: Tensor


def transition(motions: tuple[Motion, ...], dt: float, up: Tensor) -> Transition:
    """The step of some models by `dt` seconds.

    Args:
        motions: J models.
        dt: seconds, not negative.
        up: (T, 3) unit vectors: the axis of turns in each target's frame.
    """
    zero = torch.zeros_like(up[:, 0])
    x, y, z = up.unbind(-1)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    still = torch.eye(3, dtype=up.dtype, device=up.device)
    along = up[:, :, None] * up[:, None, :]
    # Of what is level, of its turn to the left, and of what is upright.
    parts = torch.stack([still - along, cross, along], 1)[:, None, None]
    steps, blocks = [], []
    for motion in motions:
        # Velocity decays and turns at once: v(t) = e^(-t / memory) exp(t rate [up]x) v, integrated for the position.
        decay, rate = 1.0 / motion.memory_s, motion.turn_rate
        left = math.exp(-decay * dt)
        kept, turned = complex(left), complex(-decay, rate)
        kept *= complex(math.cos(rate * dt), math.sin(rate * dt))
        moved = (kept - 1.0) / turned if abs(turned) * dt > 1e-9 else complex(dt)
        upright = (1.0 - left) / decay if decay * dt > 1e-9 else dt
        steps.append([[moved.real, moved.imag, upright], [kept.real, kept.imag, left]])
        place, both, velocity = _noise_entries(motion, dt)
        blocks.append([[place, both], [both, velocity]])
    reach, keep = (up.new_tensor(steps)[..., None, None] * parts).sum(3).unbind(2)
    noise = torch.kron(up.new_tensor(blocks), still).expand(len(up), -1, 6, 6)
    return Transition(reach, keep, noise)


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


def moved(state: Tensor, step: Transition, turn: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Move states (T, J, 6) by a step, and turn their frames.

    Args:
        state: see the module.
        step: from `transition`.
        turn: (T, 3, 3) rotations from the old frames into new ones; None: the frames stay.

    Returns:
        The new states, derivatives (T, J, 6, 6) by the old ones, and the noise (T, J, 6, 6) added.
    """
    reach, keep, rotation = step.reach, step.keep, None
    if turn is not None:
        rotation = turn[:, None]
        reach, keep = rotation @ reach, rotation @ keep
    inverse, velocity = state[..., 2], state[..., 3:]
    ray = torch.cat([state[..., :2], torch.ones_like(state[..., :1])], -1)
    ray = ray if rotation is None else (rotation @ ray[..., None])[..., 0]
    ahead = ray + (reach @ velocity[..., None])[..., 0]
    share = 1.0 / ahead[..., 2:]
    new = torch.cat([ahead[..., :2], inverse[..., None], (keep @ velocity[..., None])[..., 0]], -1) * share
    by_ray = torch.zeros(*state.shape, 3, dtype=state.dtype, device=state.device)
    by_ray[..., 0, 0] = by_ray[..., 1, 1] = share[..., 0]
    by_ray[..., 2] = -new * share
    by_state = torch.zeros(*state.shape, 6, dtype=state.dtype, device=state.device)
    by_state[..., :2] = by_ray[..., :2] if rotation is None else by_ray @ rotation[..., :2]
    by_state[..., 2, 2] = share[..., 0]
    by_velocity = torch.nn.functional.pad(keep * share[..., None], (0, 0, 3, 0))
    by_state[..., 3:] = by_ray @ reach + by_velocity
    push = torch.nn.functional.pad(torch.eye(3).to(state) * share[..., None], (0, 0, 3, 0))
    by_noise = inverse[..., None, None] * torch.cat([by_ray, push], -1)
    return new, by_state, by_noise @ step.noise @ by_noise.mT


def rates(state: Tensor) -> tuple[Tensor, Tensor]:
    """Rates (..., 3) of the first three numbers, and their derivatives (..., 3, 6) by the state."""
    x, y, inverse, u, v, closing = state.unbind(-1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    slope = torch.stack([
        -closing, zero, zero, one, zero, -x,
        zero, -closing, zero, zero, one, -y,
        zero, zero, -closing, zero, zero, -inverse,
    ], -1).unflatten(-1, (3, 6))  # fmt: skip
    return torch.stack([u - x * closing, v - y * closing, -inverse * closing], -1), slope
