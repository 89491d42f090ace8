"""Normal equations: elimination, batches, dense problems and weights."""

import math

import pytest
import torch
from solve_problems import Scripted, rosenbrock
from torch import Tensor

from kcal.errors import InputError
from kcal.solve.lm import (
    DenseLinearization,
    DenseProblem,
    LevenbergMarquardt,
    LMOptions,
    RobustLoss,
    SolverStatus,
    State,
    minimize,
)
from kcal.solve.schur import EliminatedItems, PartlyEliminated, SchurLinearization, SchurProblem, without_local

# Eliminating the local blocks changes nothing but the work: Schur equals dense.


# (batch, views, local, shared, residuals a view)
SIZES = [
    ((), 1, 1, 1, 3),
    ((), 1, 6, 4, 20),
    ((), 7, 6, 9, 30),
    ((), 40, 2, 24, 5),
    ((), 5, 3, 0, 8),
    ((4,), 6, 6, 5, 16),
    ((2, 3), 3, 2, 4, 9),
    ((3,), 4, 2, 0, 6),
]


def random_rows(
    batch: tuple[int, ...], views: int, local: int, shared: int, residuals: int, *, spread: float = 3.0, seed: int = 5
) -> Tensor:
    """Rows whose columns differ in size by up to 10^(2 spread)."""
    generator = torch.Generator().manual_seed(seed)
    shape = (*batch, views, local + shared + 1, residuals)
    rows = torch.randn(shape, generator=generator, dtype=torch.float64)
    sizes = 10.0 ** (spread * (2.0 * torch.rand(local + shared + 1, generator=generator, dtype=torch.float64) - 1.0))
    sizes[-1] = 1.0
    return rows * sizes[:, None]


def dense_form(rows: Tensor, local: int) -> tuple[Tensor, Tensor]:
    """Residuals (..., V R) and the Jacobian (..., V R, S + V L): shared parameters first, then view by view."""
    *batch, views, height, residuals = rows.shape
    shared = height - local - 1
    jacobian = rows.new_zeros(*batch, views * residuals, shared + views * local)
    for v in range(views):
        place = slice(v * residuals, (v + 1) * residuals)
        jacobian[..., place, :shared] = rows[..., v, local:-1, :].transpose(-1, -2)
        own = slice(shared + v * local, shared + (v + 1) * local)
        jacobian[..., place, own] = rows[..., v, :local, :].transpose(-1, -2)
    return rows[..., -1, :].flatten(-2), jacobian


def joined(step: State) -> Tensor:
    shared, local = step
    return torch.cat([shared, local.flatten(-2)], -1)


def close(a: Tensor, b: Tensor, scale: Tensor, tolerance: float) -> None:
    """Each entry within `tolerance` in units of `scale`."""
    assert float(((a - b) * scale).abs().max()) <= tolerance * max(1.0, float((b * scale).abs().max()))


@pytest.mark.parametrize("damping", [1e-10, 1e-3, 1.0, 1e6])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_a_step_solves_the_damped_normal_equations_and_equals_the_dense_one(size: tuple, damping: float) -> None:
    """(JᵀJ + λ diag JᵀJ) δ = -Jᵀr, and the predicted decrease is that of the linear model."""
    rows, local = random_rows(*size), size[2]
    residuals, jacobian = dense_form(rows, local)
    lam = torch.full(size[0], damping, dtype=torch.float64)
    # Elements of a batch differ in damping, too.
    lam = lam * (1.0 + torch.arange(lam.numel(), dtype=torch.float64).reshape(size[0]))
    schur, dense = SchurLinearization.of_gram(rows @ rows.mT, local), DenseLinearization(residuals, jacobian)
    torch.testing.assert_close(schur.cost, dense.cost, rtol=1e-13, atol=0)
    step, predicted = schur.step(lam)
    (expected,), decrease = dense.step(lam)
    delta, norm = joined(step), torch.linalg.vector_norm(jacobian, dim=-2)
    close(delta, expected, norm, 1e-10)
    torch.testing.assert_close(predicted, decrease, rtol=1e-10, atol=0)
    normal = jacobian.transpose(-1, -2) @ jacobian
    left = (normal @ delta[..., None])[..., 0] + lam[..., None] * normal.diagonal(dim1=-2, dim2=-1) * delta
    close(left, -(jacobian * residuals[..., None]).sum(-2), 1.0 / norm, 1e-10)
    after = residuals + (jacobian @ delta[..., None])[..., 0]
    drop = 0.5 * (residuals**2).sum(-1) - 0.5 * (after**2).sum(-1)
    # A difference of costs: small drops at large damping keep fewer digits.
    torch.testing.assert_close(predicted, drop, rtol=1e-6 if damping > 1e3 else 1e-9, atol=0)


@pytest.mark.parametrize("size", [size for size in SIZES if size[3]], ids=str)
def test_information_is_the_inverse_covariance(size: tuple) -> None:
    rows, local = random_rows(*size), size[2]
    _, jacobian = dense_form(rows, local)
    norm = torch.linalg.vector_norm(jacobian, dim=-2)
    scaled = jacobian / norm[..., None, :]
    shared = size[3]
    covariance = torch.linalg.inv(scaled.transpose(-1, -2) @ scaled)[..., :shared, :shared]
    matrix, scale = SchurLinearization.of_gram(rows @ rows.mT, local).information()
    torch.testing.assert_close(scale, 1.0 / norm[..., :shared], rtol=1e-13, atol=0)
    # Two inverses of matrices with condition numbers up to 1e4.
    torch.testing.assert_close(torch.linalg.inv(matrix), covariance, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("where", ["shared", "local", "local in one view", "all local"])
def test_columns_of_zeros_stay_and_disturb_nothing(where: str) -> None:
    rows = random_rows((2,), 5, 3, 4, 9, spread=1.0)
    if where == "shared":
        rows[..., 5, :] = 0.0
    elif where == "local":
        rows[..., 1, :] = 0.0
    elif where == "local in one view":
        rows[..., 2, 1, :] = 0.0
    else:
        rows[..., :3, :] = 0.0
    residuals, jacobian = dense_form(rows, 3)
    lam = torch.full((2,), 1e-3, dtype=torch.float64)
    step, predicted = SchurLinearization.of_gram(rows @ rows.mT, 3).step(lam)
    (expected,), decrease = DenseLinearization(residuals, jacobian).step(lam)
    delta = joined(step)
    dead = torch.linalg.vector_norm(jacobian, dim=-2) == 0
    assert bool(dead.any())
    assert bool((delta[dead] == 0).all())
    torch.testing.assert_close(delta, expected, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(predicted, decrease, rtol=1e-10, atol=0)


def test_what_cannot_be_solved_is_not_predicted() -> None:
    """NaN rows, and a damping too small for twin columns, give no finite prediction, in their element alone."""
    rows = random_rows((3,), 4, 2, 3, 9, spread=0.0)
    rows[1, 2, 0, 3] = torch.nan
    _, predicted = SchurLinearization.of_gram(rows @ rows.mT, 2).step(torch.full((3,), 1e-3, dtype=torch.float64))
    assert torch.isfinite(predicted).tolist() == [True, False, True]
    # A shared column that is minus another's, and of a smooth size, so that rounding cannot hide it.
    rows = random_rows((), 4, 2, 3, 9, spread=0.0).sign()
    rows[..., 3, :] = -rows[..., 2, :]
    _, predicted = SchurLinearization.of_gram(rows @ rows.mT, 2).step(torch.tensor(-1e-3, dtype=torch.float64))
    assert not bool(torch.isfinite(predicted))


class Planes(SchurProblem):
    """Curves a_v + b_v x + exp(-s0 x) + s1 x², one a view, with their own offset and slope."""

    def __init__(self, y: Tensor, x: Tensor, batch: tuple[int, ...] = ()) -> None:
        self._y, self._x = y, x
        self.batch, self.local_size = batch, 2
        self.residual_count = y.shape[-1] * y.shape[-2]

    def residuals(self, state: State) -> Tensor:
        shared, local = state
        decay = torch.exp(-shared[..., None, :1] * self._x) + shared[..., None, 1:] * self._x**2
        return local[..., :1] + local[..., 1:] * self._x + decay - self._y

    def rows(self, state: State) -> Tensor:
        value = self.residuals(state)
        x = self._x.expand_as(value)
        first = -x * torch.exp(-state[0][..., None, :1] * x)
        return torch.stack([torch.ones_like(x), x, first, x**2, value], -2)

    def retract(self, state: State, step: State) -> State:
        return state[0] + step[0], state[1] + step[1]


def curves() -> tuple[Tensor, Tensor]:
    x = torch.linspace(0.0, 3.0, 25, dtype=torch.float64)
    shared = torch.tensor([1.3, 0.2], dtype=torch.float64)
    local = torch.randn(6, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    noise = 0.01 * torch.randn(6, 25, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    y = Planes(torch.zeros(6, 25).double(), x).residuals((shared, local)) + noise
    return x, y


def test_same_minimum_as_one_dense_solve() -> None:
    x, y = curves()
    problem = Planes(y, x)

    def residual(flat: Tensor) -> Tensor:
        return problem.residuals((flat[:2], flat[2:].reshape(6, 2))).flatten()

    start = torch.cat([torch.tensor([0.5, 0.0]), torch.zeros(12)]).double()
    dense = LevenbergMarquardt(residual)(start)
    state = (start[:2].clone(), start[2:].reshape(6, 2).clone())
    kept = tuple(tensor.clone() for tensor in state)
    schur = minimize(problem, state)
    assert int(schur.status) == int(dense.status) == SolverStatus.CONVERGED
    torch.testing.assert_close(schur.cost, dense.cost, rtol=1e-11, atol=0)
    # Same steps, so that even the path is the same.
    torch.testing.assert_close(schur.history[:6], dense.history[:6], rtol=1e-10, atol=0)
    torch.testing.assert_close(torch.cat([schur.state[0], schur.state[1].flatten()]), dense.x, rtol=0, atol=1e-9)
    assert all(torch.equal(a, b) for a, b in zip(state, kept, strict=True)), "the caller's start was written to"


def test_batch_of_starts_is_one_by_one() -> None:
    x, y = curves()
    shared = torch.tensor([[0.5, 0.0], [3.0, 1.0], [2.0, -0.3]], dtype=torch.float64)
    local = torch.zeros(3, 6, 2, dtype=torch.float64)
    together = minimize(Planes(y, x, (3,)), (shared, local))
    for i in range(3):
        alone = minimize(Planes(y, x), (shared[i], local[i]))
        assert int(together.status[i]) == int(alone.status)
        torch.testing.assert_close(together.cost[i], alone.cost, rtol=1e-12, atol=0)
        # Both stop where the cost is flat to 1e-12 of itself.
        torch.testing.assert_close(together.state[0][i], alone.state[0], rtol=0, atol=1e-8)


class Pulled(Planes):
    """The same with a prior of unit weight on the shared unknowns."""

    def shared_gram(self, state: State) -> Tensor:
        rows = torch.cat([torch.eye(2, dtype=torch.float64), state[0][:, None]], 1)
        return rows.T @ rows


def test_the_cost_of_priors_is_half_their_squares() -> None:
    x, y = curves()
    state = (torch.tensor([3.0, 4.0]).double(), torch.zeros(6, 2).double())
    assert float(Pulled(y, x).cost(state) - Planes(y, x).cost(state)) == pytest.approx(12.5)
    free, pulled = (minimize(kind(y, x), state).state[0].norm() for kind in (Planes, Pulled))
    assert float(pulled) < float(free)


# Items that are eliminated before a system is damped: the same solution, and what their own unknowns do after.


ITEMS, OWN, SHARED, RESIDUALS = 6, 3, 4, 5


def rows_of(items: int, own: int, residuals: int, seed: int) -> Tensor:
    """(V, L + S + 1, R) whose columns differ in size."""
    generator = torch.Generator().manual_seed(seed)
    rows = torch.randn(items, own + SHARED + 1, residuals, generator=generator, dtype=torch.float64)
    sizes = 10.0 ** torch.linspace(-2.0, 2.0, own + SHARED + 1, dtype=torch.float64)
    sizes[-1] = 1.0
    return rows * sizes[:, None]


ROWS = rows_of(ITEMS, OWN, RESIDUALS, 1)


def test_residuals_that_are_left_are_what_own_unknowns_cannot_change() -> None:
    """Products of what is left are those of rows off the own ones, by pseudo-inverse as by QR."""
    items = EliminatedItems(ROWS, OWN)
    assert items.rows.shape == (ITEMS, SHARED + 1, RESIDUALS - OWN)
    off = ROWS[:, OWN:] - ROWS[:, OWN:] @ torch.linalg.pinv(ROWS[:, :OWN]) @ ROWS[:, :OWN]
    torch.testing.assert_close(items.rows @ items.rows.mT, off @ off.mT, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(items.gram, (off @ off.mT).sum(0), rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(without_local(ROWS, OWN), off, rtol=1e-9, atol=1e-11)


def test_an_unknown_without_effect_is_no_reason_to_fail() -> None:
    rows = ROWS.clone()
    rows[2, 1] = 0.0
    off = without_local(rows, OWN)
    assert bool(off.isfinite().all())
    kept = rows[2, [0, 2]]
    # What two columns can do is out of the rows; the third takes out one direction more, whichever it is.
    torch.testing.assert_close(off[2] @ kept.mT, torch.zeros(SHARED + 1, 2).double(), rtol=0, atol=1e-9)


@pytest.mark.parametrize("damping", [1e-9, 0.3, 50.0])
def test_own_steps_solve_the_damped_equations(damping: float) -> None:
    """With the shared step held; what they gain beyond `rows` makes up the fall of all squares."""
    items = EliminatedItems(ROWS, OWN)
    shared = torch.tensor([3.0, -0.2, 0.05, 0.01], dtype=torch.float64)
    step, gain = items.step(shared, torch.tensor(damping, dtype=torch.float64))
    own, moved = ROWS[:, :OWN], ROWS[:, -1] + shared @ ROWS[:, OWN:-1]
    normal = own @ own.mT
    normal = normal + damping * torch.diag_embed(normal.diagonal(dim1=-2, dim2=-1))
    expected = -torch.linalg.solve(normal, (own @ moved[..., None])[..., 0])
    torch.testing.assert_close(step, expected, rtol=1e-7, atol=1e-12)
    after = moved + (step[:, None] @ own)[:, 0]
    left = items.rows[:, -1] + shared @ items.rows[:, :-1]
    fall = ROWS[:, -1].square().sum() - after.square().sum()
    beside = items.rows[:, -1].square().sum() - left.square().sum()
    torch.testing.assert_close(gain, 0.5 * (fall - beside), rtol=1e-9, atol=1e-12)


def test_own_unknowns_follow_the_shared_ones() -> None:
    follow, inverse = EliminatedItems(ROWS, OWN).response()
    gram = ROWS @ ROWS.mT
    own = torch.linalg.inv(gram[:, :OWN, :OWN])
    torch.testing.assert_close(follow, -own @ gram[:, :OWN, OWN:-1], rtol=1e-7, atol=1e-12)
    torch.testing.assert_close(inverse, own, rtol=1e-7, atol=1e-14)


@pytest.mark.parametrize("first", [0, 2, 4])
def test_a_step_is_that_of_all_items_together(first: int) -> None:
    """Others have four unknowns each; items with three come after the first so many of them, with a zero before."""
    rest = rows_of(4, 4, 9, 2)
    padded = torch.nn.functional.pad(ROWS @ ROWS.mT, (1, 0, 1, 0))
    padded[:, 0, 0] = 1.0
    grams = rest @ rest.mT
    whole = SchurLinearization.of_gram(torch.cat([grams[:first], padded, grams[first:]]), 4)
    items = EliminatedItems(ROWS, OWN)
    others = SchurLinearization.of_gram(grams, 4, items.gram)
    cost = torch.tensor(7.0).double()
    partly = PartlyEliminated(others, items, first, cost)
    assert partly.cost is cost
    (shared, local), predicted = partly.step(torch.tensor(1e-13, dtype=torch.float64))
    (expected, own), decrease = whole.step(torch.tensor(1e-13, dtype=torch.float64))
    torch.testing.assert_close(shared, expected, rtol=1e-7, atol=1e-12)
    torch.testing.assert_close(local, own, rtol=1e-6, atol=1e-11)
    torch.testing.assert_close(predicted, decrease, rtol=1e-8, atol=0)
    for part, other in zip(partly.information(), others.information(), strict=True):
        assert torch.equal(part, other)
    second = PartlyEliminated(others, items, first, cost)
    assert partly.blend(torch.tensor(True), second) is second
    assert partly.blend(torch.tensor(False), second) is partly


# Dense normal equations.


GENERATOR = torch.Generator().manual_seed(3)

JACOBIAN = torch.randn(2, 9, 4, generator=GENERATOR, dtype=torch.float64) * torch.tensor([1e3, 1.0, 1e-3, 1.0])

DENSE_RESIDUALS = torch.randn(2, 9, generator=GENERATOR, dtype=torch.float64)


def test_the_undamped_step_is_that_of_least_squares() -> None:
    (step,), decrease = DenseLinearization(DENSE_RESIDUALS, JACOBIAN).step(torch.zeros(2).double())
    expected = torch.linalg.lstsq(JACOBIAN, -DENSE_RESIDUALS[..., None]).solution[..., 0]
    torch.testing.assert_close(step, expected, rtol=1e-10, atol=0)
    left = DENSE_RESIDUALS + (JACOBIAN @ step[..., None])[..., 0]
    torch.testing.assert_close(decrease, 0.5 * (DENSE_RESIDUALS.square() - left.square()).sum(-1), rtol=1e-10, atol=0)


def test_blending_takes_elements_from_both() -> None:
    one, other = DenseLinearization(DENSE_RESIDUALS, JACOBIAN), DenseLinearization(2.0 * DENSE_RESIDUALS, JACOBIAN)
    assert one.blend(torch.tensor([True, False]), other).cost.tolist() == [other.cost[0].item(), one.cost[1].item()]


# Batches whose elements stop at different times end as each of them alone does.


STARTS = torch.tensor([[1.0, 1.0], [-1.2, 1.0], [-12.0, 10.0], [0.5, 2.0], [3.0, -4.0]], dtype=torch.float64)


class Joint(DenseProblem):
    """One that linearizes trial states."""

    joint = True


def test_trial_states_may_be_linearized() -> None:
    """Where some elements of a batch accept a step and others do not, too: not a bit is different."""
    usual = minimize(DenseProblem(rosenbrock, (5,)), (STARTS,))
    joint = minimize(Joint(rosenbrock, (5,)), (STARTS,))
    for name in ("cost", "status", "iterations", "history"):
        assert torch.equal(getattr(joint, name), getattr(usual, name)), name
    assert torch.equal(joint.state[0], usual.state[0])
    accepted = usual.history[1:] < usual.history[:-1]
    assert bool((accepted.any(1) & ~accepted.all(1)).any())
    one = minimize(Joint(rosenbrock, ()), (STARTS[1],))
    torch.testing.assert_close(one.state[0], torch.ones(2).double(), rtol=0, atol=1e-9)
    assert int(one.iterations) == int(usual.iterations[1])


@pytest.mark.parametrize(("promised", "steps"), [(5e-6, 20), (1e-9, 100)])
def test_little_gain_is_counted_from_each_elements_own_costs(promised: float, steps: int) -> None:
    """Three of four converge at once and are dropped; the last, which is not the first, gains little all the time."""
    trials = torch.arange(1.0, 200.0, dtype=torch.float64)
    costs = torch.stack([0.5 - 0 * trials, 0.5 - 0 * trials, 1.0 - 1e-9 * trials, 0.5 - 0 * trials])
    decreases = torch.stack([0 * trials, 0 * trials, promised + 0 * trials, 0 * trials])
    options = LMOptions(flatness=1e-6, residual_floor=0.0)
    found = minimize(Scripted(costs, decreases), (torch.zeros(4, 1).double(),), options)  # type: ignore[arg-type,type-var]
    assert found.status.tolist() == [SolverStatus.CONVERGED] * 2 + [SolverStatus.FLAT, SolverStatus.CONVERGED]
    assert found.iterations.tolist() == [1, 1, steps, 1]
    assert found.cost.tolist() == [0.5, 0.5, pytest.approx(1.0 - 1e-9 * steps, rel=1e-15), 0.5]
    assert found.history.shape == (steps + 1, 4)


@pytest.mark.parametrize(("promised", "steps"), [(5e-6, 20), (1e-9, 100)])
def test_only_the_last_steps_count(promised: float, steps: int) -> None:
    """Thirty steps gain much, each half of the cost; those after them little."""
    costs = torch.cat([0.5 ** torch.arange(1.0, 31.0), torch.full((200,), 0.5**30)]).double()
    costs = costs * (1.0 - 1e-9 * torch.arange(len(costs), dtype=torch.float64))
    options = LMOptions(flatness=1e-6, residual_floor=0.0)
    problem = Scripted(costs[None], promised * costs[None])
    found = minimize(problem, (torch.zeros(1, 1).double(),), options)  # type: ignore[arg-type,type-var]
    assert found.status.tolist() == [SolverStatus.FLAT]
    assert found.iterations.tolist() == [30 + steps]


# Robust losses: their values, and weights that are their derivatives.


KINDS = ("huber", "cauchy", "tukey")


@pytest.mark.parametrize("kind", KINDS)
def test_weight_is_the_derivative_of_value(kind: str) -> None:
    squared = torch.tensor([0.0, 0.3, 2.2, 2.3, 90.0], dtype=torch.float64, requires_grad=True)
    loss = RobustLoss(kind=kind, scale=1.5)
    (slope,) = torch.autograd.grad(loss.value(squared).sum(), squared)
    torch.testing.assert_close(loss.weight(squared.detach()), slope, rtol=1e-12, atol=1e-14)
    assert loss.weight(torch.zeros(1)).item() == 1.0
    assert torch.autograd.gradcheck(loss.weight, squared)


@pytest.mark.parametrize(
    ("kind", "squared", "value", "weight"),
    [
        ("huber", 4.0, 4.0, 1.0),
        ("huber", 9.0, 8.0, 2.0 / 3.0),
        ("cauchy", 4.0, 4.0 * math.log(2.0), 0.5),
        ("cauchy", 12.0, 4.0 * math.log(4.0), 0.25),
        ("tukey", 1.0, 4.0 / 3.0 * (1.0 - 0.75**3), 0.75**2),
        ("tukey", 4.0, 4.0 / 3.0, 0.0),
        ("tukey", 400.0, 4.0 / 3.0, 0.0),
    ],
)
def test_known_values(kind: str, squared: float, value: float, weight: float) -> None:
    """For a scale of 2, worked out by hand."""
    loss, place = RobustLoss(kind=kind, scale=2.0), torch.tensor([squared], dtype=torch.float64)  # type: ignore[arg-type]
    assert loss.value(place).item() == pytest.approx(value, rel=1e-14)
    assert loss.weight(place).item() == pytest.approx(weight, rel=1e-14)


@pytest.mark.parametrize("kind", KINDS)
def test_small_residuals_count_fully_and_nan_stays(kind: str) -> None:
    loss = RobustLoss(kind=kind, scale=3.0)
    # The next term of each series is s²/c² at most.
    assert loss.value(torch.tensor([1e-6]).double()).item() == pytest.approx(1e-6, rel=1e-6)
    assert loss.value(torch.tensor([torch.nan])).isnan().all()
    assert loss.weight(torch.tensor([torch.nan])).isnan().all()


def test_huber_with_a_scale_of_one_unless_told_otherwise() -> None:
    assert RobustLoss() == RobustLoss(kind="huber", scale=1.0)


@pytest.mark.parametrize("wrong", [{"kind": "square"}, {"scale": 0.0}, {"scale": -1.0}, {"scale": math.inf}])
def test_what_cannot_be_is_refused(wrong: dict) -> None:
    with pytest.raises(InputError, match="robust loss"):
        RobustLoss(**wrong)
