"""Gradients through a solution by the implicit function theorem, not through the iterations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcal.solve.result import State
from kcal.solve.schur import SchurLinearization

# A cost (scalar) of a shared step (S,), a local step (V, L) and data.
SteppedCost = Callable[..., Tensor]


def attach_implicit_gradient(
    residual: Callable[..., Tensor], solution: Tensor, converged: Tensor, data: tuple[Tensor, ...]
) -> Tensor:
    """Return the solution with its exact first derivatives by the data.

    At a minimum the gradient of the cost vanishes: g(x, d) = Jᵀr = 0. Hence dx/dd = -H⁻¹ ∂g/∂d with the full Hessian H
    of the cost; Gauss and Newton's JᵀJ would be wrong wherever residuals remain. The derivative is that of one Newton
    step from the solution, without the value of that step.

    Args:
        residual: maps x (P,) and the data of one element to residuals (R,).
        solution: (..., P), detached.
        converged: (...) where the solution is a minimum; elsewhere no gradient flows.
        data: tensors that begin with the batch shape.

    Returns:
        (..., P), equal to `solution`. Derivatives of higher order are not those of the solution.
    """

    def cost(x: Tensor, *element: Tensor) -> Tensor:
        r = residual(x, *element)
        return 0.5 * (r * r).sum()

    gradient, hessian = torch.func.grad(cost), torch.func.hessian(cost)
    for _ in range(solution.ndim - 1):
        gradient, hessian = torch.func.vmap(gradient), torch.func.vmap(hessian)
    with torch.no_grad():
        inverse = torch.linalg.pinv(hessian(solution, *data), hermitian=True)
    step = -(inverse @ gradient(solution, *data)[..., None])[..., 0]
    step = torch.where(converged[..., None], step, 0.0)
    return solution + (step - step.detach())


class Curvature(NamedTuple):
    """The exact Hessian of a cost with many local blocks that are coupled only through shared parameters.

    Args:
        shared: (S, S).
        coupling: (V, L, S).
        local: (V, L, L); local parameters of different views are not coupled.
    """

    shared: Tensor
    coupling: Tensor
    local: Tensor

    def system(self, shared: Tensor, local: Tensor) -> SchurLinearization:
        """The linear system with a gradient ((S,), (V, L)); its undamped step is minus H⁻¹ times the gradient."""
        L, S = self.local.shape[-1], len(self.shared)
        gram = self.local.new_zeros(len(self.local), L + S + 1, L + S + 1)
        gram[:, :L, :L], gram[:, :L, L:-1], gram[:, :L, -1] = self.local, self.coupling, local
        gram[0, L:-1, L:-1], gram[0, L:-1, -1] = self.shared, shared
        return SchurLinearization.of_gram(gram, L)


def curvature(cost: SteppedCost, shared: Tensor, local: Tensor) -> tuple[State, Curvature]:
    """Gradient and exact Hessian of a cost at a step of zero, by S + L reverse passes over all views at once.

    Args:
        cost: maps steps ((S,), (V, L)) to a scalar, in operations that autograd differentiates twice; a sum over views,
            each of which depends on its own row of the local step alone.
        shared: (S,) zeros of the right type and device.
        local: (V, L) likewise.

    Example:
        >>> def cost(s, l):
        ...     return 0.5 * (s.sum() ** 2 + ((l[:, 0] - s[0]) ** 2).sum())
        >>> _, found = curvature(cost, torch.zeros(1).double(), torch.zeros(2, 1).double())
        >>> found.shared.tolist(), found.coupling.flatten().tolist(), found.local.flatten().tolist()
        ([[3.0]], [-1.0, -1.0], [1.0, 1.0])
    """
    with torch.enable_grad():
        steps = (shared.detach().requires_grad_(True), local.detach().requires_grad_(True))
        by_shared, by_local = _gradient(cost(*steps), steps, twice=True)
        shape = (len(shared), *local.shape)
        rows = [_gradient(value, steps, again=True) for value in by_shared]
        square = torch.stack([row[0] for row in rows]) if rows else shared.new_zeros(0, 0)
        coupling = torch.stack([row[1] for row in rows]) if rows else local.new_zeros(shape)
        own = [_gradient(column.sum(), steps[1:], again=True)[0] for column in by_local.unbind(-1)]
    found = Curvature(square, coupling.permute(1, 2, 0), torch.stack(own, -1))
    return (by_shared.detach(), by_local.detach()), found


def implicit_step(cost: SteppedCost, found: Curvature, data: tuple[Tensor, ...]) -> State:
    """Steps of zero from a minimum that carry the derivatives of the minimum by the data.

    As `attach_implicit_gradient`, with the exact Hessian in blocks: dx/dd = -H⁻¹ ∂g/∂d. Nothing is computed unless a
    gradient is requested; that takes one solve by the Schur complement and two passes through the cost.

    Args:
        cost: as for `curvature`, with the data as further arguments.
        found: the Hessian at the minimum.
        data: what the cost depends on.

    Returns:
        (S,) and (V, L) zeros; autograd refuses second derivatives.
    """
    out: State = _ImplicitStep.apply(cost, found, *data)
    return out


class _ImplicitStep(torch.autograd.Function):
    """See `implicit_step`."""

    @staticmethod
    def forward(ctx: Any, cost: SteppedCost, found: Curvature, *data: Tensor) -> State:
        ctx.cost, ctx.found = cost, found
        ctx.save_for_backward(*data)
        return found.shared.new_zeros(len(found.shared)), found.local.new_zeros(found.local.shape[:-1])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, by_shared: Tensor, by_local: Tensor) -> tuple[Tensor | None, ...]:
        weights, _ = ctx.found.system(by_shared, by_local).step(by_shared.new_zeros(()))
        with torch.enable_grad():
            data = tuple(tensor.detach().requires_grad_(True) for tensor in ctx.saved_tensors)
            steps = tuple(torch.zeros_like(weight).requires_grad_(True) for weight in weights)
            gradient = _gradient(ctx.cost(*steps, *data), steps, twice=True)
            along = sum(((g * w).sum() for g, w in zip(gradient, weights, strict=True)), start=by_shared.new_zeros(()))
            return None, None, *_gradient(along, data)


def _gradient(
    value: Tensor, inputs: tuple[Tensor, ...], *, again: bool = False, twice: bool = False
) -> tuple[Tensor, ...]:
    """Derivatives by inputs, zero by those without effect; `again` keeps the graph, `twice` differentiates it too."""
    if not value.requires_grad:
        return tuple(torch.zeros_like(tensor) for tensor in inputs)
    return torch.autograd.grad(
        value, inputs, retain_graph=again or twice, create_graph=twice, allow_unused=True, materialize_grads=True
    )
