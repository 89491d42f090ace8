"""Gradients through a solution by the implicit function theorem, not through the iterations."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


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
