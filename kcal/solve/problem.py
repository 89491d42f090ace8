"""What a solver needs of a problem, its robust losses, and what a solver returns. Nothing here knows cameras."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Callable
from typing import Any, Generic, Literal, Protocol, Self, TypeVar, cast

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.texts import brief

# Losses that grow more slowly than the square, so that a few wrong measurements cannot spoil a solution.


@dataclasses.dataclass(frozen=True, kw_only=True)
class RobustLoss:
    """ρ(‖r‖²) in place of the squared length of a residual vector.

    With s = ‖r‖² and the scale c: Huber s up to c², then 2 c √s - c²; Cauchy c² ln(1 + s / c²); Tukey
    c² / 3 (1 - (1 - s / c²)³) up to c², then constant: residuals beyond have no influence at all, so the start must
    be near the solution. All equal s for small residuals. Every residual is multiplied by √ρ'(s) before a least-squares
    step, which has the gradient of the robust cost and its Hessian without the negative part (iteratively reweighted
    least squares; Triggs, McLauchlan, Hartley and Fitzgibbon 2000).

    Args:
        kind: "huber", "cauchy" or "tukey".
        scale: c, in the units of the residuals; about three times their noise.

    Example:
        >>> loss = RobustLoss(kind="huber", scale=1.0)
        >>> loss.value(torch.tensor([0.25, 4.0])).tolist(), loss.weight(torch.tensor([0.25, 4.0])).tolist()
        ([0.25, 3.0], [1.0, 0.5])
    """

    kind: Literal["huber", "cauchy", "tukey"] = "huber"
    scale: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in ("huber", "cauchy", "tukey"):
            raise InputError(f"robust loss: kind must be huber, cauchy or tukey, got {self.kind!r}")
        if not 0 < self.scale < float("inf"):
            raise InputError(f"robust loss: the scale must be positive, got {self.scale}")

    def value(self, squared: Tensor) -> Tensor:
        """ρ(s), elementwise and differentiable."""
        c2 = self.scale**2
        if self.kind == "huber":
            far = squared > c2
            return torch.where(far, 2.0 * self.scale * torch.where(far, squared, c2).sqrt() - c2, squared)
        if self.kind == "cauchy":
            return c2 * torch.log1p(squared / c2)
        kept = 1.0 - squared / c2
        # Not clamped, because NaN must stay NaN.
        return c2 / 3.0 * (1.0 - torch.where(kept < 0, 0.0, kept) ** 3)

    def weight(self, squared: Tensor) -> Tensor:
        """ρ'(s), elementwise and differentiable."""
        c2 = self.scale**2
        if self.kind == "huber":
            far = squared > c2
            return torch.where(far, self.scale * torch.where(far, squared, c2).rsqrt(), 1.0 + 0.0 * squared)
        if self.kind == "cauchy":
            return 1.0 / (1.0 + squared / c2)
        kept = 1.0 - squared / c2
        return torch.where(kept < 0, 0.0, kept) ** 2


# What a solver returns: the best state, its cost, and an honest reason for stopping.

State = tuple[Tensor, ...]
# A plain tuple of tensors, or a named one.
S = TypeVar("S", bound=State)


def map_state(function: Callable[..., Tensor], *states: S) -> S:
    """Apply a function tensor by tensor; named tuples stay named.

    Example:
        >>> map_state(torch.add, (torch.tensor(1.0), torch.tensor(2.0)), (torch.tensor(3.0), torch.tensor(4.0)))
        (tensor(4.), tensor(6.))
    """
    kind: Any = type(states[0])
    tensors = (function(*group) for group in zip(*states, strict=True))
    return cast(S, kind._make(tensors) if hasattr(kind, "_make") else tuple(tensors))


def blend(mask: Tensor, old: S, new: S) -> S:
    """Of each pair of tensors, which begin with the batch, the new one where the mask (...) is true."""
    return map_state(lambda a, b: torch.where(mask.reshape(mask.shape + (1,) * (a.ndim - mask.ndim)), a, b), new, old)


def pick(state: S, elements: int | slice | Tensor) -> S:
    """One element of a batch, or several."""
    return map_state(lambda tensor: tensor[elements], state)


class SolverStatus(enum.IntEnum):
    """Why the solver stopped, for each element of a batch.

    `CONVERGED`: no step can lower the cost by more than the tolerance. `EXACT`: the residual is zero to rounding.
    `ITERATION_LIMIT`: still improving. `STALLED`: a lower cost was predicted, but no step, however short, reached one.
    `BAD_START`: the cost at the start is not finite. `INTERRUPTED`: the caller's callback asked to stop. `AT_BOUND`:
    the caller held the solution back, because lower costs lie where the problem makes no sense. `FLAT`: still
    improving, but many steps together by too little to matter: the data hardly determine some direction.
    """

    RUNNING = 0
    CONVERGED = 1
    EXACT = 2
    ITERATION_LIMIT = 3
    STALLED = 4
    BAD_START = 5
    INTERRUPTED = 6
    AT_BOUND = 7
    FLAT = 8

    @property
    def message(self) -> str:
        """The reason in words."""
        return _MESSAGES[self]


_MESSAGES = {
    SolverStatus.RUNNING: "still running",
    SolverStatus.CONVERGED: "converged: no step lowers the cost by more than the tolerance",
    SolverStatus.EXACT: "converged: the residual is zero to rounding",
    SolverStatus.ITERATION_LIMIT: "stopped at the iteration limit while still improving",
    SolverStatus.STALLED: "stalled: no step lowers the cost although one was predicted",
    SolverStatus.BAD_START: "the cost at the start is not finite",
    SolverStatus.AT_BOUND: "stopped at a bound: lower costs lie beyond what is allowed",
    SolverStatus.FLAT: "stopped where the cost is flat: the last steps lowered it by too little to matter",
    SolverStatus.INTERRUPTED: "interrupted; this is the best state so far",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Result(Generic[S]):
    """The outcome of `minimize`.

    Args:
        state: the best state found, of the type of the start.
        cost: (...) half the sum of squared residuals there.
        status: (...) int64 values of `SolverStatus`.
        iterations: (...) int64, trial steps taken.
        history: (iterations + 1, ...) cost after each trial step, the start first.
    """

    __repr__ = brief

    state: S
    cost: Tensor
    status: Tensor
    iterations: Tensor
    history: Tensor

    @property
    def x(self) -> Tensor:
        """The solution where the state is a single tensor."""
        return self.state[0]

    @property
    def converged(self) -> Tensor:
        """(...) whether the element is at a minimum: `CONVERGED` or `EXACT`."""
        return (self.status == SolverStatus.CONVERGED) | (self.status == SolverStatus.EXACT)

    @property
    def message(self) -> str:
        """The reason for stopping in words; for a batch, each reason with its count."""
        found, counts = torch.unique(self.status, return_counts=True)
        parts = [(SolverStatus(int(value)).message, int(n)) for value, n in zip(found, counts, strict=True)]
        return parts[0][0] if self.status.ndim == 0 else "; ".join(f"{n} x {text}" for text, n in parts)


# What the Levenberg-Marquardt loop needs from a problem. Nothing here knows cameras.


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
