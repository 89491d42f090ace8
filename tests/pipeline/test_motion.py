"""Motion of targets: exact straight lines and circles, exact derivatives, noise as integrated by brute force."""

from __future__ import annotations

import math

import pytest
import torch

from kcal.errors import InputError
from kcal.lens.pose import rotation_from_vector
from kcal.pipeline.motion import MOTIONS, Motion, moved, rates, transition

UP = torch.tensor([[0.0, -1.0, 0.0]], dtype=torch.float64)


def state_of(place: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
    z = place[..., 2:]
    return torch.cat([place[..., :2] / z, 1.0 / z, velocity / z], -1)


def test_straight_motion_is_exact_also_in_a_turned_frame() -> None:
    place, velocity = torch.tensor([[[30.0, -5.0, 400.0]]]).double(), torch.tensor([[[8.0, 1.0, -20.0]]]).double()
    turn = rotation_from_vector(torch.tensor([[0.1, -0.3, 0.2]]).double())
    step = transition((Motion(acceleration=0.0),), 1.5, UP)
    new, _, noise = moved(state_of(place, velocity), step, turn)
    true = state_of((place + 1.5 * velocity) @ turn.mT, velocity @ turn.mT)
    torch.testing.assert_close(new, true, rtol=1e-12, atol=1e-15)
    assert not bool(noise.any())


def test_a_turning_target_goes_in_a_circle_to_the_left() -> None:
    place, velocity = torch.tensor([[[0.0, 0.0, 300.0]]]).double(), torch.tensor([[[10.0, 0.0, 0.0]]]).double()
    state = state_of(place, velocity)
    rate = 2 * math.pi / 40
    for step in range(40):
        state, _, _ = moved(state, transition((Motion(acceleration=0.0, turn_rate=rate),), 1.0, UP))
        if step == 9:
            # A quarter, seen from above, to the left of eastward is away from the camera.
            torch.testing.assert_close(state[0, 0, 3:] / state[0, 0, 2], torch.tensor([0.0, 0.0, 10.0]).double())
    torch.testing.assert_close(state, state_of(place, velocity), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("turned", [False, True])
def test_derivatives(turned: bool) -> None:
    state = torch.tensor([[[0.1, -0.05, 0.002, 0.03, -0.01, 0.02]]]).double().repeat(1, len(MOTIONS), 1)
    turn = rotation_from_vector(torch.tensor([[0.1, -0.3, 0.2]]).double()) if turned else None
    step = transition(MOTIONS, 0.7, UP)
    _, slope, noise = moved(state, step, turn)
    for model in range(len(MOTIONS)):
        by_autograd = torch.autograd.functional.jacobian(lambda s: moved(s, step, turn)[0][0], state)[
            model, :, 0, model
        ]
        torch.testing.assert_close(slope[0, model], by_autograd, rtol=1e-10, atol=1e-12)
    torch.linalg.cholesky(noise)
    by_state = torch.autograd.functional.jacobian(lambda s: rates(s)[0], state[0, 0])
    torch.testing.assert_close(rates(state[0, 0])[1], by_state)


@pytest.mark.parametrize("memory", [math.inf, 0.8, 5000.0])
def test_noise_is_that_of_many_small_steps(memory: float) -> None:
    motion = Motion(acceleration=2.0, memory_s=memory)
    covariance = torch.zeros(6, 6, dtype=torch.float64)
    small = transition((motion,), 0.01, UP)
    push = torch.cat([torch.cat([torch.eye(3).double(), small.reach[0, 0]], 1),
                      torch.cat([torch.zeros(3, 3).double(), small.keep[0, 0]], 1)])  # fmt: skip
    added = torch.zeros(6, 6, dtype=torch.float64)
    added[3:, 3:] = 0.01 * 4.0 * torch.eye(3)
    for _ in range(100):
        covariance = push @ covariance @ push.T + added
    torch.testing.assert_close(transition((motion,), 1.0, UP).noise[0, 0], covariance, rtol=0.025, atol=1e-3)


def test_a_hovering_target_forgets_its_velocity() -> None:
    step = transition((Motion(acceleration=0.0, memory_s=2.0),), 4.0, UP)
    torch.testing.assert_close(step.keep[0, 0], math.exp(-2) * torch.eye(3).double())
    torch.testing.assert_close(step.reach[0, 0], 2 * (1 - math.exp(-2)) * torch.eye(3).double())


@pytest.mark.parametrize("wrong", [{"acceleration": -1.0}, {"acceleration": 1.0, "memory_s": 0.0},
                                   {"acceleration": 1.0, "turn_rate": math.nan}])  # fmt: skip
def test_impossible_motions(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match="motion"):
        Motion(**wrong)
