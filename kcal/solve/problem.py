"""What the Levenberg-Marquardt loop needs from a problem. Nothing here knows cameras."""

from __future__ import annotations

from typing import Any, Protocol, Self

from torch import Tensor

from kcal.solve.result import S, State


class Linearization(Protocol):
    """A problem near one state: its cost, and the damped Gauss-Newton step.

    Every column of the Jacobian is first scaled to length one (Marquardt's scaling). So the damping has no units, and
    the solution does not depend on the units of the parameters.
    """

    @property
    def cost(self) -> Tensor:
        """(...) half the sum of squared residuals."""
        ...

    def blend(self, mask: Tensor, other: Self) -> Self:
        """The other linearization where the mask (...) of the batch is true, else this one."""
        ...

    def step(self, damping: Tensor) -> tuple[State, Tensor]:
        """Solve (JᵀJ + λ D) δ = -Jᵀr with D = diag(JᵀJ).

        Returns:
            δ in the problem's form, and the decrease of the cost (...) that the linear model predicts. Where the
            system cannot be solved the decrease is not finite.
        """
        ...


class Problem(Protocol[S]):
    """A least-squares problem: residuals r(state), their Jacobian, and how a step is applied.

    A state is a tuple of tensors, plain or named. `batch` is the shape of independent problems solved side by side,
    () for one; every tensor of a state and of a step begins with it.
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

    def cost(self, state: S) -> Tensor:
        """Half the sum of squared residuals, (...)."""
        ...

    def linearize(self, state: S) -> Any:
        """The problem's linearization at `state`."""
        ...

    def retract(self, state: S, step: State) -> S:
        """Apply a step: plain addition, or a move on a manifold."""
        ...

    def select(self, elements: Tensor) -> Problem[S] | None:
        """The problem of some elements (K,) of a batch with one dimension; None where that is not possible.

        The solver uses it to drop elements that have stopped.
        """
        ...
