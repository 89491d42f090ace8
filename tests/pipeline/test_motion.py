"""Motion of targets: exact straight lines and circles, exact derivatives, noise as integrated by brute force."""

from __future__ import annotations

import math

import pytest
import torch

from kcal.errors import InputError
from kcal.lens.pose import rotation_from_vector
from kcal.pipeline.imm_filter import MOTIONS, Motion, Transition, by_rates, moved, rates, step_numbers, transition

UP = torch.tensor([[0.0], [-1.0], [0.0]], dtype=torch.float64)


def after(motions: tuple[Motion, ...], seconds: float) -> Transition:
    return transition(torch.tensor(step_numbers(motions, seconds), dtype=torch.float64), UP)


def state_of(place: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
    """(6, 1, 1) from vectors."""
    return (torch.cat([place[:2], torch.ones(1).double(), velocity]) / place[2])[:, None, None]


def test_straight_motion_is_exact_also_in_a_turned_frame() -> None:
    place, velocity = torch.tensor([30.0, -5.0, 400.0]).double(), torch.tensor([8.0, 1.0, -20.0]).double()
    turn = rotation_from_vector(torch.tensor([0.1, -0.3, 0.2]).double())
    found = moved(state_of(place, velocity), after((Motion(acceleration=0.0),), 1.5), turn[..., None])
    true = state_of(turn @ (place + 1.5 * velocity), turn @ velocity)
    torch.testing.assert_close(found.state, true, rtol=1e-12, atol=1e-15)
    assert not bool(found.noise.any())


def test_a_turning_target_goes_in_a_circle_to_the_left() -> None:
    place, velocity = torch.tensor([0.0, 0.0, 300.0]).double(), torch.tensor([10.0, 0.0, 0.0]).double()
    state = state_of(place, velocity)
    rate = 2 * math.pi / 40
    for step in range(40):
        state = moved(state, after((Motion(acceleration=0.0, turn_rate=rate),), 1.0)).state
        if step == 9:
            # A quarter, seen from above, to the left of eastward is away from the camera.
            expected = torch.tensor([0.0, 0.0, 10.0]).double()
            torch.testing.assert_close(state[3:, 0, 0] / state[2, 0, 0], expected)
    torch.testing.assert_close(state, state_of(place, velocity), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("turned", [False, True])
def test_derivatives(turned: bool) -> None:
    state = torch.tensor([0.1, -0.05, 0.002, 0.03, -0.01, 0.02]).double()
    turn = rotation_from_vector(torch.tensor([0.1, -0.3, 0.2]).double())[..., None] if turned else None
    step = after(MOTIONS, 0.7)
    models = len(MOTIONS)
    here = state[:, None, None].expand(6, models, 1)
    found = moved(here, step, turn)
    slope = found.through(torch.eye(6).double()[..., None, None].expand(6, 6, models, 1))
    for model in range(models):
        by_autograd = torch.autograd.functional.jacobian(
            lambda s, model=model: moved(s[:, None, None].expand(6, models, 1), step, turn).state[:, model, 0], state
        )
        torch.testing.assert_close(slope[..., model, 0], by_autograd, rtol=1e-10, atol=1e-12)
    torch.linalg.cholesky(found.noise[..., 0].movedim(-1, 0))


@pytest.mark.parametrize("turned", [False, True])
def test_noise_reaches_the_state_by_its_derivatives(turned: bool) -> None:
    """Meters and meters per second are added to the place and velocity that the new state stands for."""
    state = torch.tensor([0.1, -0.05, 0.002, 0.03, -0.01, 0.02]).double()[:, None, None]
    turn = rotation_from_vector(torch.tensor([0.1, -0.3, 0.2]).double())[..., None] if turned else None
    step = after((MOTIONS[2],), 0.7)
    found = moved(state, step, turn)

    def pushed(push: torch.Tensor) -> torch.Tensor:
        """The new state, if its place (meters) and velocity are changed by this."""
        z = 1.0 / found.state[2, 0, 0]
        place = torch.cat([found.state[:2, 0, 0], torch.ones(1).double()]) * z + push[:3]
        return state_of(place, found.state[3:, 0, 0] * z + push[3:])[:, 0, 0]

    slope = torch.autograd.functional.jacobian(pushed, torch.zeros(6).double())
    place, both, velocity = step.noise[:, 0, 0].tolist()
    cartesian = torch.kron(torch.tensor([[place, both], [both, velocity]], dtype=torch.float64), torch.eye(3).double())
    torch.testing.assert_close(found.noise[..., 0, 0], slope @ cartesian @ slope.T, rtol=1e-10, atol=1e-18)


def test_rates_are_those_of_straight_motion() -> None:
    state = torch.tensor([0.1, -0.05, 0.002, 0.03, -0.01, 0.02], dtype=torch.float64)
    found, by_state = rates(state), by_rates(torch.eye(3, dtype=torch.float64), state)

    def later(seconds: float) -> torch.Tensor:
        return moved(state[:, None, None], after((Motion(acceleration=0.0),), seconds)).state[:3, 0, 0]

    # The second derivative is left out: 1e-6 s of half of 1e-3 a second.
    torch.testing.assert_close((later(1e-6) - later(0.0)) / 1e-6, found, rtol=1e-6, atol=1e-9)
    by_autograd = torch.autograd.functional.jacobian(rates, state)
    torch.testing.assert_close(by_state, by_autograd, rtol=1e-12, atol=0.0)


@pytest.mark.parametrize("memory", [math.inf, 0.8, 5000.0])
def test_noise_is_that_of_many_small_steps(memory: float) -> None:
    motion = Motion(acceleration=2.0, memory_s=memory)
    covariance = torch.zeros(2, 2, dtype=torch.float64)
    small = after((motion,), 0.01)
    # Along one axis.
    push = torch.tensor([[1.0, float(small.reach[0, 0])], [0.0, float(small.keep[0, 0])]]).double()
    added = torch.tensor([[0.0, 0.0], [0.0, 0.01 * 4.0]]).double()
    for _ in range(100):
        covariance = push @ covariance @ push.T + added
    place, both, velocity = after((motion,), 1.0).noise[:, 0, 0]
    found = torch.stack([place, both, both, velocity]).reshape(2, 2)
    torch.testing.assert_close(found, covariance, rtol=0.025, atol=1e-3)


def test_a_hovering_target_forgets_its_velocity() -> None:
    step = after((Motion(acceleration=0.0, memory_s=2.0),), 4.0)
    torch.testing.assert_close(step.keep[..., 0, 0], math.exp(-2) * torch.eye(3).double())
    torch.testing.assert_close(step.reach[..., 0, 0], 2 * (1 - math.exp(-2)) * torch.eye(3).double())


@pytest.mark.parametrize("wrong", [{"acceleration": -1.0}, {"acceleration": 1.0, "memory_s": 0.0},
                                   {"acceleration": 1.0, "turn_rate": math.nan}])  # fmt: skip
def test_impossible_motions(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match="motion"):
        Motion(**wrong)


def test_another_origin() -> None:
    """Counted from 30 m to the side and 100 m behind; derivatives are those of the map."""
    place, velocity = torch.tensor([30.0, -5.0, 400.0]).double(), torch.tensor([8.0, 1.0, -20.0]).double()
    shift = torch.tensor([-30.0, 4.0, 100.0]).double()
    turn = rotation_from_vector(torch.tensor([0.1, -0.3, 0.2]).double())
    step = after((Motion(acceleration=0.5),), 1.5)
    state = state_of(place, velocity)
    found = moved(state, step, turn[..., None], shift[:, None])
    true = state_of(turn @ (place + 1.5 * velocity) + shift, turn @ velocity)
    torch.testing.assert_close(found.state, true, rtol=1e-12, atol=1e-15)
    by_autograd = torch.autograd.functional.jacobian(
        lambda s: moved(s[:, None, None], step, turn[..., None], shift[:, None]).state[:, 0, 0], state[:, 0, 0]
    )
    slope = found.through(torch.eye(6).double()[..., None, None])
    torch.testing.assert_close(slope[:, :, 0, 0], by_autograd)
