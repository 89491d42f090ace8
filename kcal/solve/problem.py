"""What the Levenberg-Marquardt loop asks of a problem. Nothing here knows cameras."""

from __future__ import annotations

from typing import Any, Protocol, Self

from torch import Tensor

from kcal.solve.result import State


class Linearization(Protocol):
    """A problem near one state: cost, and the damped Gauss-Newton step.

    Every column of the Jacobian is scaled to length one first (Marquardt's scaling), so that the damping has no
    units and the answer does not depend on the units of the parameters.
    """

    @property
    def cost(self) -> Tensor:
        """(...) half the sum of squared residuals."""
        ...

    def blend(self, mask: Tensor, other: Self) -> Self:
        """This one, but where the mask (...) of the batch is true the other."""
        ...

    def step(self, damping: Tensor) -> tuple[State, Tensor]:
        """Solve (JᵀJ + λ D) δ = -Jᵀr with D = diag(JᵀJ).

        Returns:
            δ in the problem's form, and the decrease of the cost (...) that the linear model predicts. Where the
            system cannot be solved the decrease is not finite.
        """
        ...


class Problem(Protocol):
    """A least-squares problem: residuals r(state), their Jacobian, and how a step is applied.

    `batch` is the shape of independent problems solved side by side; () for one. Every tensor of a state and of a
    step begins with it.
    """

    @property
    def batch(self) -> tuple[int, ...]:
        """Shape of the batch."""
        ...

    @property
    def joint(self) -> bool:
        """Whether a linearization costs little more than the cost alone, so that trial states are linearized."""
        ...

    @property
    def residual_count(self) -> int:
        """Number of scalar residuals of one element, for the rounding floor."""
        ...

    def cost(self, state: State) -> Tensor:
        """Half the sum of squared residuals, (...)."""
        ...

    def linearize(self, state: State) -> Any:
        """The problem's linearization at `state`."""
        ...

    def retract(self, state: State, step: State) -> State:
        """Apply a step: plain addition, or a move on a manifold."""
        ...

    def select(self, elements: Tensor) -> Problem | None:
        """The problem of some elements (K,) of a batch of one dimension; None where it cannot be taken apart.

        By it a solver leaves out what has converged.
        """
        ...
