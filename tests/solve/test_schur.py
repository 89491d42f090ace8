"""Eliminating the local blocks changes nothing but the work: Schur equals dense."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from kcal.solve.lm import DenseLinearization, LevenbergMarquardt, minimize
from kcal.solve.problem import SolverStatus, State
from kcal.solve.schur import SchurLinearization, SchurProblem

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
class TestStep:
    def test_equals_dense(self, size: tuple, damping: float) -> None:
        rows, local = random_rows(*size), size[2]
        residuals, jacobian = dense_form(rows, local)
        lam = torch.full(size[0], damping, dtype=torch.float64)
        # Elements of a batch differ in damping, too.
        lam = lam * (1.0 + torch.arange(lam.numel(), dtype=torch.float64).reshape(size[0]))
        schur, dense = SchurLinearization.of_gram(rows @ rows.mT, local), DenseLinearization(residuals, jacobian)
        torch.testing.assert_close(schur.cost, dense.cost, rtol=1e-13, atol=0)
        step, predicted = schur.step(lam)
        (expected,), decrease = dense.step(lam)
        norm = torch.linalg.vector_norm(jacobian, dim=-2)
        close(joined(step), expected, norm, 1e-10)
        torch.testing.assert_close(predicted, decrease, rtol=1e-10, atol=0)

    def test_solves_the_damped_normal_equations(self, size: tuple, damping: float) -> None:
        """(JᵀJ + λ diag JᵀJ) δ = -Jᵀr, and the predicted decrease is that of the linear model."""
        rows, local = random_rows(*size), size[2]
        residuals, jacobian = dense_form(rows, local)
        step, predicted = SchurLinearization.of_gram(rows @ rows.mT, local).step(
            torch.full(size[0], damping, dtype=torch.float64)
        )
        delta = joined(step)
        normal = jacobian.transpose(-1, -2) @ jacobian
        gradient = (jacobian * residuals[..., None]).sum(-2)
        norm = torch.linalg.vector_norm(jacobian, dim=-2)
        left = (normal @ delta[..., None])[..., 0] + damping * normal.diagonal(dim1=-2, dim2=-1) * delta
        close(left, -gradient, 1.0 / norm, 1e-10)
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
