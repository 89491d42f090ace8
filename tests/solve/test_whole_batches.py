"""Batches whose elements stop at different times end as each of them alone does."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from solve_problems import rosenbrock
from torch import Tensor

from kcal.solve.lm import DenseProblem, LMOptions, minimize
from kcal.solve.problem import SolverStatus

STARTS = torch.tensor([[1.0, 1.0], [-1.2, 1.0], [-12.0, 10.0], [0.5, 2.0], [3.0, -4.0]], dtype=torch.float64)


class Joint(DenseProblem):
    """One that linearizes trial states."""

    joint = True


def test_trial_states_may_be_linearized() -> None:
    """Where some elements of a batch accept a step and others do not, too: not a bit is different."""
    usual = minimize(DenseProblem(rosenbrock, (5,)), (STARTS,))
    joint = minimize(Joint(rosenbrock, (5,)), (STARTS,))
    for name in ("cost", "status", "iterations", "history"):
        assert torch.equal(getattr(joint, name), getattr(usual, name)), name
    assert torch.equal(joint.state[0], usual.state[0])
    accepted = usual.history[1:] < usual.history[:-1]
    assert bool((accepted.any(1) & ~accepted.all(1)).any())
    one = minimize(Joint(rosenbrock, ()), (STARTS[1],))
    torch.testing.assert_close(one.state[0], torch.ones(2).double(), rtol=0, atol=1e-9)
    assert int(one.iterations) == int(usual.iterations[1])


class ScriptedBatch:
    """Elements whose costs and promised decreases are given, trial by trial: (E, T) each."""

    joint, residual_count = False, 1

    def __init__(self, costs: Tensor, promised: Tensor) -> None:
        self.costs, self.promised, self.trial = costs, promised, 0

    def linearize(self, state: tuple[Tensor]) -> SimpleNamespace:
        return SimpleNamespace(cost=torch.ones(len(self.costs)).double(), step=self.step)

    def step(self, damping: Tensor) -> tuple[Tensor, Tensor]:
        return torch.zeros(len(self.costs)).double(), self.promised[:, self.trial]

    def retract(self, state: tuple[Tensor], step: Tensor) -> tuple[Tensor]:
        return state

    def cost(self, state: tuple[Tensor]) -> Tensor:
        self.trial += 1
        return self.costs[:, self.trial - 1]

    def select(self, elements: Tensor) -> ScriptedBatch:
        smaller = ScriptedBatch(self.costs[elements], self.promised[elements])
        smaller.trial = self.trial
        return smaller


@pytest.mark.parametrize(("promised", "steps"), [(5e-6, 20), (1e-9, 100)])
def test_little_gain_is_counted_from_each_elements_own_costs(promised: float, steps: int) -> None:
    """Three of four converge at once and are dropped; the last, which is not the first, gains little all the time."""
    trials = torch.arange(1.0, 200.0, dtype=torch.float64)
    costs = torch.stack([0.5 - 0 * trials, 0.5 - 0 * trials, 1.0 - 1e-9 * trials, 0.5 - 0 * trials])
    decreases = torch.stack([0 * trials, 0 * trials, promised + 0 * trials, 0 * trials])
    options = LMOptions(flatness=1e-6, residual_floor=0.0)
    found = minimize(ScriptedBatch(costs, decreases), (torch.zeros(4, 1).double(),), options)  # type: ignore[arg-type,type-var]
    assert found.status.tolist() == [SolverStatus.CONVERGED] * 2 + [SolverStatus.FLAT, SolverStatus.CONVERGED]
    assert found.iterations.tolist() == [1, 1, steps, 1]
    assert found.cost.tolist() == [0.5, 0.5, pytest.approx(1.0 - 1e-9 * steps, rel=1e-15), 0.5]
    assert found.history.shape == (steps + 1, 4)


@pytest.mark.parametrize(("promised", "steps"), [(5e-6, 20), (1e-9, 100)])
def test_only_the_last_steps_count(promised: float, steps: int) -> None:
    """Thirty steps gain much, each half of the cost; those after them little."""
    costs = torch.cat([0.5 ** torch.arange(1.0, 31.0), torch.full((200,), 0.5**30)]).double()
    costs = costs * (1.0 - 1e-9 * torch.arange(len(costs), dtype=torch.float64))
    options = LMOptions(flatness=1e-6, residual_floor=0.0)
    problem = ScriptedBatch(costs[None], promised * costs[None])
    found = minimize(problem, (torch.zeros(1, 1).double(),), options)  # type: ignore[arg-type,type-var]
    assert found.status.tolist() == [SolverStatus.FLAT]
    assert found.iterations.tolist() == [30 + steps]
