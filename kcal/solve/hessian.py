"""The minimum of many unknowns to rounding, systems with the exact Hessian there, and gradients through it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcal.errors import DegenerateError
from kcal.solve.lm import LMOptions, Problem, S, State, minimize
from kcal.solve.schur import SchurLinearization

# A cost (scalar) of a shared step (S,), a local step (V, L) and data.
SteppedCost = Callable[..., Tensor]
# Products with the Hessian, and the share of the right side's squared size, in the Hessian's norm, that they may leave.
_PRODUCTS, _SMALL = 100, 1e-26
# Newton steps to a minimum, and the decrease, in shares of the cost, that is rounding.
_NEWTON_STEPS, _ROUNDING = 8, 1e-22
# At a minimum a Newton step predicts a decrease below this share of the cost, or below the cost of residuals of 1e-10
# pixels (root mean square), which are rounding errors.
_AT_MINIMUM, _EXACT = 1e-10, 1e-10
NO_MINIMUM = (
    "the solution has no derivatives, because it is no minimum that the data determine (a flat cost, a saddle, a "
    "barrier): fix parameters, choose a smaller model, add views or priors"
)


class HessianSolve(NamedTuple):
    """Solve systems with the exact Hessian of a cost at a step of zero, which is never formed.

    Conjugate gradients, preconditioned by Gauss and Newton's matrix: it leaves out the curvature of residuals only, so
    that a few products with the Hessian suffice whatever the number of unknowns.

    Args:
        cost: maps steps ((S,), (V, L)) to a scalar, in operations that autograd differentiates twice.
        linear: Gauss and Newton's system there.
        zero: a step of zero, ((S,), (V, L)).

    Example:
        >>> gram = torch.tensor([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)[None]
        >>> def cost(s, l):  # 1.5 (s² + l²) where Gauss and Newton see s² + l²
        ...     return 1.5 * (s.square().sum() + l.square().sum())
        >>> zero = torch.zeros(1).double(), torch.zeros(1, 1).double()
        >>> solve = HessianSolve(cost, SchurLinearization.of_gram(gram, 1), zero)
        >>> [round(float(x), 12) for x in solve((zero[0] + 3.0, zero[1] + 6.0))]
        [1.0, 2.0]
    """

    cost: SteppedCost
    linear: SchurLinearization
    zero: State

    def gradient(self) -> State:
        """Of the cost."""
        with torch.enable_grad():
            steps = tuple(part.detach().requires_grad_(True) for part in self.zero)
            return gradient_of(self.cost(*steps), steps)

    def __call__(self, right: State) -> State:
        """H⁻¹ times a pair ((S,), (V, L)).

        Raises:
            DegenerateError: the Hessian is not positive definite, so that there is no minimum.
        """
        with torch.enable_grad():
            steps = tuple(part.detach().requires_grad_(True) for part in self.zero)
            slope = gradient_of(self.cost(*steps), steps, twice=True)
        found, left = tuple(map(torch.zeros_like, right)), right
        near = self.linear.solve(*left)
        along, size = near, _dot(left, near)
        least = _SMALL * size
        for _ in range(_PRODUCTS):
            if float(size) <= float(least):
                return found
            with torch.enable_grad():
                bent = gradient_of(_dot(slope, along), steps, again=True)
            curve = _dot(along, bent)
            if not float(curve) > 0:
                break
            share = size / curve
            found = tuple(x + share * p for x, p in zip(found, along, strict=True))
            left = tuple(r - share * b for r, b in zip(left, bent, strict=True))
            near = self.linear.solve(*left)
            size, before = _dot(left, near), size
            along = tuple(z + size / before * p for z, p in zip(near, along, strict=True))
        raise DegenerateError(NO_MINIMUM)


def newton_minimum(problem: Problem[S], state: S, effort: LMOptions) -> tuple[S, HessianSolve]:
    """The minimum next to a state to rounding, and systems with the Hessian there.

    Args:
        problem: of one element, with local blocks; its cost in operations that autograd differentiates twice.
        state: near a minimum.
        effort: of a solver that comes close to it.

    Raises:
        DegenerateError: there is no minimum that the data determine.
    """
    state = minimize(problem, state, effort).state
    exact = 0.5 * problem.residual_count * _EXACT**2
    least = math.inf
    for _ in range(_NEWTON_STEPS):
        here, linear = state, problem.linearize(state)

        def cost(shared: Tensor, local: Tensor, here: S = here) -> Tensor:
            return problem.cost(problem.retract(here, (shared, local)))

        (shared, local), _ = linear.step(torch.ones_like(linear.cost))
        solve = HessianSolve(cost, linear, (torch.zeros_like(shared), torch.zeros_like(local)))
        gradient = solve.gradient()
        step = solve(gradient)
        decrease = 0.5 * float(_dot(gradient, step))
        if not _ROUNDING * float(linear.cost) < decrease < least:
            break
        least, state = decrease, problem.retract(here, tuple(-part for part in step))
    if not decrease <= max(_AT_MINIMUM * float(linear.cost), exact):
        raise DegenerateError(NO_MINIMUM)
    return here, solve


def _dot(one: State, other: State) -> Tensor:
    return torch.stack([(a * b).sum() for a, b in zip(one, other, strict=True)]).sum()


def implicit_step(cost: SteppedCost, found: HessianSolve, data: tuple[Tensor, ...]) -> State:
    """Steps of zero from a minimum that carry the derivatives of the minimum by the data.

    As `kcal.solve.lm.attach_implicit_gradient`, for many local blocks: dx/dd = -H⁻¹ ∂g/∂d. Nothing is computed
    unless a gradient is requested; that takes one solve with the Hessian and two passes through the cost.

    Args:
        cost: as for `HessianSolve`, with the data as further arguments.
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
    def forward(ctx: Any, cost: SteppedCost, found: HessianSolve, *data: Tensor) -> State:
        ctx.cost, ctx.found = cost, found
        ctx.save_for_backward(*data)
        shared, local = found.zero
        return torch.zeros_like(shared), torch.zeros_like(local)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, by_shared: Tensor, by_local: Tensor) -> tuple[Tensor | None, ...]:
        weights = tuple(-part for part in ctx.found((by_shared, by_local)))
        with torch.enable_grad():
            data = tuple(tensor.detach().requires_grad_(True) for tensor in ctx.saved_tensors)
            steps = tuple(torch.zeros_like(weight).requires_grad_(True) for weight in weights)
            gradient = gradient_of(ctx.cost(*steps, *data), steps, twice=True)
            along = sum(((g * w).sum() for g, w in zip(gradient, weights, strict=True)), start=by_shared.new_zeros(()))
            return None, None, *gradient_of(along, data)


def gradient_of(
    value: Tensor, inputs: tuple[Tensor, ...], *, again: bool = False, twice: bool = False
) -> tuple[Tensor, ...]:
    """Derivatives by inputs, zero by those without effect; `again` keeps the graph, `twice` differentiates it too."""
    if not value.requires_grad:
        return tuple(torch.zeros_like(tensor) for tensor in inputs)
    return torch.autograd.grad(
        value, inputs, retain_graph=again or twice, create_graph=twice, allow_unused=True, materialize_grads=True
    )
