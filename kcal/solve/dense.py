"""Dense least squares for any residual function, batched, with Jacobians from `torch.func`."""

from __future__ import annotations

import copy
from collections.abc import Callable

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.solve.result import State, blend


class DenseLinearization:
    """Normal equations of one dense Jacobian (..., R, P), columns scaled to length one."""

    def __init__(self, residuals: Tensor, jacobian: Tensor) -> None:
        norm = torch.linalg.vector_norm(jacobian, dim=-2)
        # A zero column belongs to a parameter without effect, which never moves.
        scale = torch.where(norm > 0, 1.0 / norm, 1.0)
        scaled = jacobian * scale[..., None, :]
        normal, gradient = scaled.transpose(-1, -2) @ scaled, (scaled * residuals[..., None]).sum(-2)
        self._parts = 0.5 * (residuals * residuals).sum(-1), scale, normal, gradient

    @property
    def cost(self) -> Tensor:
        """See `Linearization`."""
        return self._parts[0]

    def blend(self, mask: Tensor, other: DenseLinearization) -> DenseLinearization:
        """See `Linearization.blend`."""
        out = copy.copy(self)
        out._parts = blend(mask, self._parts, other._parts)
        return out

    def step(self, damping: Tensor) -> tuple[State, Tensor]:
        """See `Linearization.step`."""
        _, scale, normal, gradient = self._parts
        identity = torch.eye(normal.shape[-1], dtype=normal.dtype, device=normal.device)
        factor, info = torch.linalg.cholesky_ex(normal + damping[..., None, None] * identity)
        delta = -torch.cholesky_solve(gradient[..., None], factor)[..., 0]
        predicted = 0.5 * (damping * (delta * delta).sum(-1) - (gradient * delta).sum(-1))
        return (delta * scale,), torch.where(info == 0, predicted, torch.nan)


class DenseProblem:
    """Residuals r(x, data) for x (..., P), the leading dimensions a batch of independent problems."""

    joint = False

    def __init__(self, residual: Callable[..., Tensor], batch: tuple[int, ...], data: tuple[Tensor, ...] = ()) -> None:
        self.batch = tuple(batch)
        self._residual, self._data = residual, tuple(data)
        value, jacobian = residual, torch.func.jacfwd(residual)
        for _ in self.batch:
            value, jacobian = torch.func.vmap(value), torch.func.vmap(jacobian)
        self._value, self._jacobian = value, jacobian
        self.residual_count = 1

    def cost(self, state: State) -> Tensor:
        """See `Problem.cost`."""
        residuals = self.residuals(state)
        return 0.5 * (residuals * residuals).sum(-1)

    def linearize(self, state: State) -> DenseLinearization:
        """See `Problem.linearize`."""
        return DenseLinearization(self.residuals(state), self._jacobian(state[0], *self._data))

    def residuals(self, state: State) -> Tensor:
        """(..., R) at a state."""
        residuals = self._value(state[0], *self._data)
        if residuals.ndim != len(self.batch) + 1 or residuals.dtype != torch.float64:
            shape = tuple(residuals.shape[len(self.batch) :])
            raise InputError(
                f"residual function: a float64 vector (R,) is needed for each element, got {residuals.dtype} of shape "
                f"{shape}"
            )
        self.residual_count = residuals.shape[-1]
        return residuals

    def retract(self, state: State, step: State) -> State:
        """Plain addition."""
        return (state[0] + step[0],)

    def select(self, elements: Tensor) -> DenseProblem:
        """See `Problem.select`."""
        return DenseProblem(self._residual, (len(elements),), tuple(tensor[elements] for tensor in self._data))
