"""Nonlinear least squares: what a problem is, its result, and Levenberg-Marquardt."""

from __future__ import annotations

import copy
import dataclasses
import enum
from collections.abc import Callable
from typing import Any, Generic, Literal, Protocol, Self, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from kcal.checks import StatedModule, require_finite
from kcal.dispatch import host_values, is_differentiated, is_traced, known_true, may_branch
from kcal.errors import InputError
from kcal.texts import brief

# What a solver needs of a problem, its robust losses, and what a solver returns. Nothing here knows cameras.

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

    RUNNING = 0, "still running"
    CONVERGED = 1, "converged: no step lowers the cost by more than the tolerance"
    EXACT = 2, "converged: the residual is zero to rounding"
    ITERATION_LIMIT = 3, "stopped at the iteration limit while still improving"
    STALLED = 4, "stalled: no step lowers the cost although one was predicted"
    BAD_START = 5, "the cost at the start is not finite"
    INTERRUPTED = 6, "interrupted; this is the best state so far"
    AT_BOUND = 7, "stopped at a bound: lower costs lie beyond what is allowed"
    FLAT = 8, "stopped where the cost is flat: the last steps lowered it by too little to matter"

    _message: str

    def __new__(cls, value: int, message: str = "") -> Self:
        """A number with its reason in words."""
        made = int.__new__(cls, value)
        made._value_, made._message = value, message
        return made

    @property
    def message(self) -> str:
        """The reason in words."""
        return self._message


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

    def blend(self, mask: Tensor, other: Self) -> Self:
        """The other linearization where the mask (...) of the batch is true, else this one."""

    def step(self, damping: Tensor) -> tuple[State, Tensor]:
        """Solve (JᵀJ + λ D) δ = -Jᵀr with D = diag(JᵀJ).

        Returns:
            δ in the problem's form, and the decrease of the cost (...) that the linear model predicts. Where the
            system cannot be solved the decrease is not finite.
        """


Bend = Callable[[S, State, Any, Tensor], State | None]


class Problem(Protocol[S]):
    """A least-squares problem: residuals r(state), their Jacobian, and how a step is applied.

    A state is a tuple of tensors, plain or named. `batch` is the shape of independent problems solved side by side,
    () for one; every tensor of a state and of a step begins with it.
    """

    @property
    def batch(self) -> tuple[int, ...]:
        """Shape of the batch."""

    @property
    def joint(self) -> bool:
        """Whether a linearization costs little more than the cost alone, so that trial states are linearized."""

    @property
    def residual_count(self) -> int:
        """Number of scalar residuals of one element, for the rounding floor."""

    def cost(self, state: S) -> Tensor:
        """Half the sum of squared residuals, (...)."""

    def linearize(self, state: S) -> Any:
        """The problem's linearization at `state`."""

    def retract(self, state: S, step: State) -> S:
        """Apply a step: plain addition, or a move on a manifold."""

    def select(self, elements: Tensor) -> Problem[S] | None:
        """The problem of some elements (K,) of a batch with one dimension; None where that is not possible.

        The solver uses it to drop elements that have stopped.
        """


# Levenberg-Marquardt with trust-region damping, for problems and residual functions, and gradients through it.

# Gradients through a solution by the implicit function theorem, not through the iterations.


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

    at = solution, *data
    if not known_true(converged):
        # What is not finite would make derivatives by what elements share so, although it counts zero: one that
        # converged stands in.
        one = converged.reshape(-1).to(torch.int8).argmax().reshape(1)
        first = (value.detach().reshape(-1, *value.shape[converged.ndim :]).index_select(0, one)[0] for value in at)
        at = blend(
            converged, tuple(own.nan_to_num().expand_as(value) for own, value in zip(first, at, strict=True)), at
        )
    gradient, hessian = torch.func.grad(cost), torch.func.hessian(cost)
    for _ in range(solution.ndim - 1):
        gradient, hessian = torch.func.vmap(gradient), torch.func.vmap(hessian)
    with torch.no_grad():
        inverse = torch.linalg.pinv(hessian(*at), hermitian=True)
    step = -(inverse @ gradient(*at)[..., None])[..., 0]
    step = torch.where(converged[..., None], step, 0.0)
    return solution + (step - step.detach())


# Dense least squares for any residual function, batched, with Jacobians from `torch.func`.


class BatchLinearization:
    """Base of linearizations whose attributes are all tensors that begin with the batch."""

    cost: Tensor

    def blend(self, mask: Tensor, other: Self) -> Self:
        """See `Linearization.blend`."""
        out = copy.copy(self)
        old, new = (tuple(vars(one)[name] for name in vars(self)) for one in (self, other))
        vars(out).update(zip(vars(self), blend(mask, old, new), strict=True))
        return out


class DenseLinearization(BatchLinearization):
    """Normal equations of one dense Jacobian (..., R, P), columns scaled to length one."""

    def __init__(self, residuals: Tensor, jacobian: Tensor) -> None:
        norm = torch.linalg.vector_norm(jacobian, dim=-2)
        # A zero column belongs to a parameter without effect, which never moves.
        self._scale = torch.where(norm > 0, 1.0 / norm, 1.0)
        scaled = jacobian * self._scale[..., None, :]
        self._normal, self._gradient = scaled.transpose(-1, -2) @ scaled, (scaled * residuals[..., None]).sum(-2)
        self.cost = 0.5 * (residuals * residuals).sum(-1)

    def step(self, damping: Tensor) -> tuple[State, Tensor]:
        """See `Linearization.step`."""
        normal, gradient = self._normal, self._gradient
        identity = torch.eye(normal.shape[-1], dtype=normal.dtype, device=normal.device)
        factor, info = torch.linalg.cholesky_ex(normal + damping[..., None, None] * identity)
        delta = -torch.cholesky_solve(gradient[..., None], factor)[..., 0]
        predicted = 0.5 * (damping * (delta * delta).sum(-1) - (gradient * delta).sum(-1))
        return (delta * self._scale,), torch.where(info == 0, predicted, torch.nan)


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


# Levenberg-Marquardt with trust-region damping, and its `nn.Module` for any residual function.

# Called after each trial step with (trial, cost (...)); returning True stops.
Callback = Callable[[int, Tensor], bool | None]

# Range of λ; below 1e-14 it is lost in rounding, above 1e10 a step no longer changes the state.
_LOWEST_DAMPING, _HIGHEST_DAMPING = 1e-14, 1e10
# Up to this λ a step is nearly that of Gauss and Newton, whose predicted decrease tells whether this is a minimum.
_LITTLE_DAMPING = 1e-3
# Trial steps over which `LMOptions.flatness` is judged.
_PATIENCE = 20
# The same where little is predicted either.
_LONG_PATIENCE = 100


@dataclasses.dataclass(frozen=True, kw_only=True)
class LMOptions:
    """Options of the Levenberg-Marquardt method.

    Args:
        max_iterations: maximum number of trial steps, rejected ones included.
        tolerance: stop when the next step is predicted to lower the cost by less than this fraction. 1e-12 of the
            cost is 5e-13 of the RMS.
        flatness: stop when 20 steps together have lowered the cost by less than this fraction although more was
            predicted, or 100 steps in any case; 0: never.
        initial_damping: λ at the start, in units of the scaled normal matrix, whose diagonal is one.
        residual_floor: a root-mean-square residual below this counts as zero.
        last_step: take the last step, too, of which little is predicted. False: end before it, where the problem is
            linearized already, which saves a linearization to a caller that needs one.
    """

    max_iterations: int = 300
    tolerance: float = 1e-12
    flatness: float = 0.0
    initial_damping: float = 1e-3
    residual_floor: float = 1e-12
    last_step: bool = True

    def __post_init__(self) -> None:
        if self.max_iterations < 1 or not 0 <= self.tolerance < 1:
            raise InputError("LMOptions: max_iterations must be at least 1 and tolerance in [0, 1)")
        if not 0 <= self.flatness < 1:
            raise InputError("LMOptions: flatness must be in [0, 1)")
        if not self.initial_damping > 0 or not self.residual_floor >= 0:
            raise InputError("LMOptions: initial_damping must be positive, residual_floor not negative")


def minimize(
    problem: Problem[S],
    start: S,
    options: LMOptions | None = None,
    callback: Callback | None = None,
    *,
    unroll: bool = False,
    bend: Bend[S] | None = None,
) -> Result[S]:
    """Minimize half the sum of squares by the Levenberg-Marquardt method.

    θ_new = θ - (JᵀJ + λ D)⁻¹ Jᵀr, the paper's Eq. 6 with r = f(θ) - y and with D = diag(JᵀJ) in place of the
    identity, so that the units of the parameters do not matter. A step that raises the cost, or makes it NaN, is
    never taken. λ follows the gain ratio (Nielsen 1999). Every element of a batch has its own λ, its own decisions
    and its own reason for stopping.

    Args:
        problem: anything that follows `kcal.solve.lm.Problem`. Ready-made: `DenseProblem` for a
            residual function, `kcal.calibrate.problem.board_problem.BoardProblem` for views of a board (example there).
        start: the state to begin with: a tuple of tensors, for a `BoardProblem` a `BoardState`.
        options: see `LMOptions`.
        callback: called after each trial with the trial's number and the best cost; return True to stop.
        unroll: record the accepted steps for autograd, as far as the problem's operations are differentiable. What
            decides about them (damping, acceptance) counts as constant.
        bend: of problems without a batch: maps a state, a step that raised the cost, the linearization and the damping
            to a step that is right to second order, or None. It is tried before a shorter one.

    Returns:
        The best state with its status. Nothing is raised for a failure to converge: read `status`.

    Example:
        >>> problem = DenseProblem(lambda x: torch.stack([x[0] - 3.0, x[0] * x[1] + 3.0]), batch=())
        >>> result = minimize(problem, (torch.tensor([1.0, 1.0], dtype=torch.float64),))
        >>> [round(float(value), 9) for value in result.state[0]], bool(result.converged)
        ([3.0, -1.0], True)
    """
    with torch.set_grad_enabled(unroll and torch.is_grad_enabled()):
        return _minimize(problem, start, options or LMOptions(), callback, bend)


def _minimize(
    problem: Problem[S], start: S, options: LMOptions, callback: Callback | None, bend: Bend[S] | None
) -> Result[S]:
    state = start
    linear = problem.linearize(state)
    device = linear.cost.device

    def on_device(values: np.ndarray) -> Tensor:
        return torch.from_numpy(np.asarray(values)).to(device)

    # Decisions need a handful of numbers per element; NumPy handles these several times faster than torch.
    cost = host_values(linear.cost)
    damping, growth = np.full_like(cost, options.initial_damping), np.full_like(cost, 2.0)
    iterations = np.zeros(cost.shape, np.int64)
    status = np.where(np.isfinite(cost), int(SolverStatus.RUNNING), int(SolverStatus.BAD_START))
    floor = 0.5 * problem.residual_count * options.residual_floor**2
    status = np.where((status == 0) & (cost <= floor), int(SolverStatus.EXACT), status)
    history = [cost]
    whole: _WholeBatch[S] | None = None

    for trial in range(1, options.max_iterations + 1):
        running = status == SolverStatus.RUNNING
        if not running.any():
            break
        # Elements that have stopped are dropped once they are half of a batch of four or more.
        few = running.ndim == 1 and len(running) >= 4 and 2 * running.sum() <= len(running)
        if few and not torch.is_grad_enabled():
            kept = np.flatnonzero(running)
            smaller = problem.select(on_device(kept))
            if smaller is not None:
                whole = whole or _WholeBatch(state, status, iterations)
                whole.put(state, status, iterations)
                whole.index, problem = whole.index[kept], smaller
                state = pick(state, on_device(kept))
                cost, damping, growth, status, iterations = (
                    values[kept] for values in (cost, damping, growth, status, iterations)
                )
                running = running[kept]
                linear = problem.linearize(state)
        step, decrease = linear.step(on_device(damping))
        predicted = host_values(decrease)
        solved = np.isfinite(predicted)
        # A tiny prediction means a minimum only where little damping shaped the step.
        flat = running & solved & (predicted <= options.tolerance * cost) & (damping <= _LITTLE_DAMPING)
        iterations = iterations + running
        if not options.last_step and (flat == running).all():
            status = np.where(flat, int(SolverStatus.CONVERGED), status)
            history.append(history[-1])
            break
        candidate = problem.retract(state, step)
        joint = problem.linearize(candidate) if problem.joint else None
        new_cost = host_values(problem.cost(candidate) if joint is None else joint.cost)
        if bend is not None and solved and not new_cost < cost:
            bent = bend(state, step, linear, on_device(damping))
            other = candidate if bent is None else problem.retract(state, bent)
            if bent is not None and (other_cost := host_values(problem.cost(other))) < cost:
                candidate, new_cost = other, other_cost
        # An infinite fall over an infinite prediction is no gain, and not accepted.
        with np.errstate(invalid="ignore"):
            gain = (cost - np.where(np.isfinite(new_cost), new_cost, np.inf)) / np.where(
                solved & (predicted > 0), predicted, np.inf
            )
        accept = running & solved & (new_cost < cost)
        shrink = np.maximum(1.0 - (2.0 * np.where(accept, gain, 0.5) - 1.0) ** 3, 1.0 / 10.0)
        damping = np.where(accept, damping * shrink, np.where(running, damping * growth, damping))
        damping = np.maximum(damping, _LOWEST_DAMPING)
        growth = np.where(accept, 2.0, np.where(running, growth * 2.0, growth))
        if accept.all():
            state = candidate
        elif accept.any():
            state = blend(on_device(accept), state, candidate)
        cost = np.where(accept, new_cost, cost)
        history.append(cost if whole is None else whole.costs(history[-1], cost))

        status = np.where(flat, int(SolverStatus.CONVERGED), status)
        status = np.where((status == 0) & (cost <= floor), int(SolverStatus.EXACT), status)
        stalled = (status == 0) & ~accept & (damping > _HIGHEST_DAMPING)
        if stalled.any():
            # Where the residual stays large and curved, steps need damping even at the minimum and end in rounding.
            # The undamped step then tells whether this is a minimum.
            _, free = linear.step(on_device(np.full_like(damping, _LITTLE_DAMPING)))
            at_minimum = stalled & (host_values(free) <= options.tolerance * cost)
            status = np.where(at_minimum, int(SolverStatus.CONVERGED), status)
            status = np.where(stalled & ~at_minimum, int(SolverStatus.STALLED), status)
        if options.flatness and trial >= _PATIENCE:
            lately, long_since = (
                history[-1 - steps] if trial >= steps else np.full_like(history[0], np.inf)
                for steps in (_PATIENCE, _LONG_PATIENCE)
            )
            if whole is not None:
                lately, long_since = lately[whole.index], long_since[whole.index]
            little = (status == 0) & (lately - cost <= options.flatness * cost)
            if little.any():
                # Close to a minimum steps gain little, too, and its status must not depend on which comes first, the
                # last of these steps or convergence. What is predicted is less there by orders of magnitude.
                left, damped = predicted, damping > _LITTLE_DAMPING
                if (little & damped).any():
                    _, free = linear.step(on_device(np.full_like(damping, _LITTLE_DAMPING)))
                    left = np.where(damped, host_values(free), predicted)
                slow = ~(left <= options.flatness * cost) | (long_since - cost <= options.flatness * cost)
                status = np.where(little & slow, int(SolverStatus.FLAT), status)
        if callback is not None and callback(trial, on_device(history[-1])):
            status = np.where(status == 0, int(SolverStatus.INTERRUPTED), status)
        if (accept & (status == 0)).any():
            if joint is None:
                linear = problem.linearize(state)
            else:
                linear = joint if accept.all() else linear.blend(on_device(accept), joint)

    status = np.where(status == 0, int(SolverStatus.ITERATION_LIMIT), status)
    if whole is not None:
        whole.put(state, status, iterations)
        state, status, iterations = whole.state, whole.status, whole.iterations
    return Result(
        state=state,
        cost=on_device(history[-1]),
        status=on_device(status),
        iterations=on_device(iterations),
        history=on_device(np.stack(history)),
    )


class _WholeBatch(Generic[S]):
    """All elements of a batch while only those of `index` are still being solved."""

    def __init__(self, state: S, status: np.ndarray, iterations: np.ndarray) -> None:
        self.state = map_state(torch.clone, state)
        self.status, self.iterations = status.copy(), iterations.copy()
        self.index = np.arange(len(status))

    def put(self, state: S, status: np.ndarray, iterations: np.ndarray) -> None:
        """Store the present values of the elements of `index`."""
        place = torch.from_numpy(self.index).to(state[0].device)
        for tensor, part in zip(self.state, state, strict=True):
            tensor[place] = part
        self.status[self.index], self.iterations[self.index] = status, iterations

    def costs(self, before: np.ndarray, cost: np.ndarray) -> np.ndarray:
        """All costs, of which those of `index` have changed."""
        out = before.copy()
        out[self.index] = cost
        return out


class LevenbergMarquardt(StatedModule):
    """Levenberg-Marquardt for any residual function, batched over leading dimensions.

    Args:
        residual: maps x (P,) and the data of one element to residuals (R,), in operations that `torch.func` can
            differentiate.
        options: see `LMOptions`.
        backward: how the solution `x` gets gradients by data, by weights of a residual that is a module, and by tensors
            that a function closes over. "implicit": exact first derivatives by the implicit function theorem, at the
            cost of one Hessian; elements that did not converge carry none.
            "unroll": autograd through the steps that were taken, also for a start that requires gradients; memory grows
            with the steps, and the derivative lags one step behind the solution. "none": no gradients.

    Convention: float64 only, because squared condition numbers leave float32 nothing.

    Example:
        >>> def rosenbrock(x):
        ...     return torch.stack([1 - x[0], 10 * (x[1] - x[0] ** 2)])
        >>> result = LevenbergMarquardt(rosenbrock)(torch.tensor([-1.2, 1.0], dtype=torch.float64))
        >>> [round(float(value), 9) for value in result.x], result.message
        ([1.0, 1.0], 'converged: the residual is zero to rounding')
    """

    def __init__(
        self,
        residual: Callable[..., Tensor],
        options: LMOptions | None = None,
        *,
        backward: Literal["implicit", "unroll", "none"] = "implicit",
    ) -> None:
        super().__init__()
        if backward not in ("implicit", "unroll", "none"):
            raise InputError(f"LevenbergMarquardt: backward must be implicit, unroll or none, got {backward!r}")
        self.residual = residual
        self.options = options or LMOptions()
        self.backward = backward

    def forward(self, start: Tensor, *data: Tensor, callback: Callback | None = None) -> Result:
        """Minimize from `start` (..., P); each data tensor has the same leading shape (...).

        Returns:
            A `Result` with `x` (..., P) and a status for each element.

        Raises:
            InputError: a start or residuals that are not float64 vectors, a start that is not finite, or data whose
                leading shape differs.
        """
        if not isinstance(start, Tensor) or start.ndim == 0 or start.numel() == 0:
            shape = tuple(start.shape) if isinstance(start, Tensor) else type(start).__name__
            raise InputError(f"LevenbergMarquardt: the start must be a tensor (..., P) with values, got {shape}")
        if start.dtype != torch.float64:
            raise InputError(f"LevenbergMarquardt: the start must be float64, got {start.dtype}; use .double()")
        if not (is_traced() or may_branch(start, *data, *self.parameters(), *self.buffers())):
            raise InputError(
                "LevenbergMarquardt: it stops by values, which vmap hides; give the batch as leading dimensions of the "
                "start and the data"
            )
        require_finite("LevenbergMarquardt start", start)
        for tensor in data:
            if tensor.shape[: start.ndim - 1] != start.shape[:-1]:
                raise InputError(
                    f"LevenbergMarquardt: data of shape {tuple(tensor.shape)} do not begin with the batch shape "
                    f"{tuple(start.shape[:-1])}"
                )
        if self.backward == "unroll":
            return minimize(
                DenseProblem(self.residual, start.shape[:-1], data), (start,), self.options, callback, unroll=True
            )
        problem = DenseProblem(self.residual, start.shape[:-1], tuple(tensor.detach() for tensor in data))
        result = minimize(problem, (start.detach(),), self.options, callback)
        result = dataclasses.replace(result, state=(result.x.detach(),))
        # Weights of the residual and tensors that it closes over enter the solution as data do.
        if self.backward == "implicit" and is_differentiated(*data, problem.residuals(result.state)):
            x = attach_implicit_gradient(self.residual, result.x, result.converged, data)
            result = dataclasses.replace(result, state=(x,))
        return result

    @property
    def constants(self) -> object:
        """Options; the residual, if it is a module, has a state of its own."""
        return self.options, self.backward

    def __call__(self, *args: Any, **kwargs: Any) -> Result:
        """See `forward`."""
        result: Result = super().__call__(*args, **kwargs)
        return result
