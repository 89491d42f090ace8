"""What a solver returns: the best state, its cost, and an honest reason for stopping."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Callable
from typing import Any, Generic, TypeVar, cast

import torch
from torch import Tensor

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
