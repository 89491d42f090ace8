"""Least-squares problems with known minima, and every solver that must find them.

Starts and minima are those of Moré, Garbow and Hillstrom, "Testing Unconstrained Optimization Software", ACM TOMS 7
(1981); data and certified values of the fits are NIST's Statistical Reference Datasets (StRD, nonlinear regression).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from types import SimpleNamespace

import torch
from torch import Tensor

from kcal.solve.lm import DenseProblem, LMOptions, Result, State, minimize
from kcal.solve.schur import SchurProblem

Residual = Callable[[Tensor], Tensor]


@dataclasses.dataclass(frozen=True)
class Known:
    """A residual function, its usual starts, and the minimum: 2 x cost and, where it is a point, x."""

    name: str
    residual: Residual
    starts: tuple[tuple[float, ...], ...]
    sum_of_squares: float
    x: tuple[float, ...] | None
    # How far x may be off, relative to the largest of it.
    digits: float = 1e-9


def rosenbrock(x: Tensor) -> Tensor:
    return torch.stack([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])


def powell_singular(x: Tensor) -> Tensor:
    return torch.stack(
        [
            x[0] + 10.0 * x[1],
            math.sqrt(5.0) * (x[2] - x[3]),
            (x[1] - 2.0 * x[2]) ** 2,
            math.sqrt(10.0) * (x[0] - x[3]) ** 2,
        ]
    )


def beale(x: Tensor) -> Tensor:
    return torch.stack([1.5 - x[0] * (1.0 - x[1]), 2.25 - x[0] * (1.0 - x[1] ** 2), 2.625 - x[0] * (1.0 - x[1] ** 3)])


def freudenstein_roth(x: Tensor) -> Tensor:
    return torch.stack(
        [-13.0 + x[0] + ((5.0 - x[1]) * x[1] - 2.0) * x[1], -29.0 + x[0] + ((x[1] + 1.0) * x[1] - 14.0) * x[1]]
    )


_MISRA_X = [77.6, 114.9, 141.1, 190.8, 239.9, 289.0, 332.8, 378.4, 434.8, 477.3, 536.8, 593.1, 689.1, 760.0]
_MISRA_Y = [10.07, 14.73, 17.94, 23.93, 29.61, 35.18, 40.02, 44.82, 50.76, 55.05, 61.01, 66.40, 75.47, 81.78]
MISRA_X, MISRA_Y = (torch.tensor(values, dtype=torch.float64) for values in (_MISRA_X, _MISRA_Y))


def misra1a(b: Tensor) -> Tensor:
    return b[0] * (1.0 - torch.exp(-b[1] * MISRA_X)) - MISRA_Y


_DANWOOD_X = torch.tensor([1.309, 1.471, 1.490, 1.565, 1.611, 1.680], dtype=torch.float64)
_DANWOOD_Y = torch.tensor([2.138, 3.421, 3.597, 4.340, 4.882, 5.660], dtype=torch.float64)


def danwood(b: Tensor) -> Tensor:
    return b[0] * _DANWOOD_X ** b[1] - _DANWOOD_Y


# The line through (1, 1), (2, 3), (3, 2) is 1 + x / 2 and leaves 1/2, -1, 1/2.
_LINE_X, _LINE_Y = torch.tensor([[1.0, 2.0, 3.0], [1.0, 3.0, 2.0]], dtype=torch.float64)


def line_twice(x: Tensor) -> Tensor:
    """Rank two in four parameters: the slope appears twice, the last parameter nowhere."""
    return (x[0] + x[1]) * _LINE_X + x[2] - _LINE_Y


KNOWN = (
    Known("Rosenbrock", rosenbrock, ((-1.2, 1.0), (-12.0, 10.0)), 0.0, (1.0, 1.0)),
    # The Jacobian is singular at the minimum: half the digits of x are lost, not those of the cost.
    Known("Powell's singular", powell_singular, ((3.0, -1.0, 0.0, 1.0),), 0.0, (0.0, 0.0, 0.0, 0.0), digits=1e-5),
    Known("Beale", beale, ((1.0, 1.0),), 0.0, (3.0, 0.5)),
    Known("Freudenstein-Roth", freudenstein_roth, ((6.0, 3.0),), 0.0, (5.0, 4.0)),
    # The local minimum that the usual start leads to; the source gives 48.9842..., (11.41..., -0.8968...), more digits
    # are from mpmath.findroot of the gradient. The cost is flat to rounding within 1e-8 of it.
    Known(
        "Freudenstein-Roth, local",
        freudenstein_roth,
        ((0.5, -2.0),),
        48.98425367924001,
        (11.41277898690209, -0.89680525327448),
        digits=1e-7,
    ),
    # StRD certifies eleven digits of each parameter and of the sum of squares. A cost within 1e-12 of its minimum
    # leaves x within 1e-6 σ or so, here 1e-8 of its size.
    Known("Misra1a", misra1a, ((500.0, 1e-4), (250.0, 5e-4)), 1.2455138894e-1, (2.3894212918e2, 5.5015643181e-4), 1e-7),
    Known("DanWood", danwood, ((1.0, 5.0), (0.7, 4.0)), 4.3173084083e-3, (7.6886226176e-1, 3.8604055871e0), 1e-7),
    Known("rank-deficient", line_twice, ((0.0, 3.0, -1.0, 7.0),), 1.5, None),
)


class OneView(SchurProblem):
    """A residual function as a Schur problem whose first `shared` parameters are shared, the others local."""

    def __init__(self, residual: Residual, shared: int, size: int) -> None:
        self._residual = residual
        self._shared = shared
        self.local_size = size - shared
        self.batch = ()
        self.residual_count = 1

    def _x(self, state: State) -> Tensor:
        return torch.cat([state[0], state[1][0]])

    def residuals(self, state: State) -> Tensor:
        return self._residual(self._x(state))[None]

    def rows(self, state: State) -> Tensor:
        x = self._x(state)
        jacobian = torch.func.jacfwd(self._residual)(x).T
        value = self._residual(x)[None]
        self.residual_count = value.shape[-1]
        return torch.cat([jacobian[self._shared :], jacobian[: self._shared], value])[None]

    def retract(self, state: State, step: State) -> State:
        return state[0] + step[0], state[1] + step[1]


def solve_dense(residual: Residual, start: Tensor, options: LMOptions | None = None) -> tuple[Tensor, Result]:
    result = minimize(DenseProblem(residual, ()), (start,), options)
    return result.x, result


def solve_schur(residual: Residual, start: Tensor, options: LMOptions | None = None) -> tuple[Tensor, Result]:
    """With the last parameter as the only local one."""
    shared = len(start) - 1
    result = minimize(OneView(residual, shared, len(start)), (start[:shared], start[None, shared:]), options)
    return torch.cat([result.state[0], result.state[1][0]]), result


SOLVERS = {"dense": solve_dense, "schur": solve_schur}


class Scripted:
    """Elements whose costs and promised decreases are given, trial by trial: (E, T) each; it notes dampings (E,)."""

    joint, residual_count = False, 1

    def __init__(self, costs: Tensor, promised: Tensor, start: float = 1.0, trial: int = 0) -> None:
        self.costs, self.promised, self.start, self.trial = costs, promised, start, trial
        self.dampings: list[Tensor] = []

    def linearize(self, state: tuple[Tensor]) -> SimpleNamespace:
        return SimpleNamespace(cost=torch.full((len(self.costs),), self.start).double(), step=self.step)

    def step(self, damping: Tensor) -> tuple[Tensor, Tensor]:
        self.dampings.append(damping)
        return torch.zeros(len(self.costs)).double(), self.promised[:, self.trial]

    def retract(self, state: tuple[Tensor], step: Tensor) -> tuple[Tensor]:
        return state

    def cost(self, state: tuple[Tensor]) -> Tensor:
        self.trial += 1
        return self.costs[:, self.trial - 1]

    def select(self, elements: Tensor) -> Scripted:
        return Scripted(self.costs[elements], self.promised[elements], self.start, self.trial)
