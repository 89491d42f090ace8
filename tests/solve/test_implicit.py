"""Derivatives of the solution: implicit gradients and the Hessian."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from kcal.errors import DegenerateError, InputError
from kcal.solve.hessian import HessianSolve, implicit_step, newton_minimum
from kcal.solve.lm import LevenbergMarquardt, LMOptions, State
from kcal.solve.schur import SchurLinearization, SchurProblem

# Gradients through a solution.


TIMES = torch.linspace(0.0, 2.0, 9, dtype=torch.float64)


def decay(x: Tensor, observed: Tensor) -> Tensor:
    """An exponential with an offset, fitted to nine observations: residuals remain, so that JᵀJ is not the Hessian."""
    return x[0] * torch.exp(-x[1] * TIMES) + x[2] - observed


def observations(*batch: int) -> Tensor:
    noise = torch.randn((*batch, len(TIMES)), generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    return 2.0 * torch.exp(-1.3 * TIMES) + 0.5 + 0.2 * noise


START = torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)


class TestGradient:
    def test_against_refits(self) -> None:
        solver = LevenbergMarquardt(decay, LMOptions(tolerance=1e-16))
        # Central differences of whole refits, each of which stops some 1e-8 from its minimum: a step of 1e-3 makes that
        # 1e-5, and its own curvature adds about as much.
        assert torch.autograd.gradcheck(
            lambda observed: solver(START, observed).x,
            (observations().requires_grad_(True),),
            eps=1e-3,
            atol=5e-5,
            rtol=5e-5,
        )

    def test_in_a_batch_as_alone(self) -> None:
        solver = LevenbergMarquardt(decay)
        observed = observations(4).requires_grad_(True)
        (together,) = torch.autograd.grad(solver(START.expand(4, 3), observed).x[:, 1].sum(), observed)
        for i in range(4):
            one = observations(4)[i].requires_grad_(True)
            (alone,) = torch.autograd.grad(solver(START, one).x[1], one)
            # The batch multiplies in another order.
            torch.testing.assert_close(together[i], alone, rtol=1e-9, atol=1e-12)

    def test_the_value_is_the_solution_to_the_last_bit(self) -> None:
        observed = observations()
        plain = LevenbergMarquardt(decay)(START, observed)
        assert not plain.x.requires_grad
        assert torch.equal(LevenbergMarquardt(decay)(START, observed.requires_grad_(True)).x, plain.x)

    def test_none_where_it_did_not_converge(self) -> None:
        observed = observations().requires_grad_(True)
        result = LevenbergMarquardt(decay, LMOptions(max_iterations=1))(START, observed)
        assert not bool(result.converged)
        (gradient,) = torch.autograd.grad(result.x.sum(), observed)
        assert torch.equal(gradient, torch.zeros_like(gradient))

    def test_one_that_failed_leaves_what_elements_share_alone(self) -> None:
        """Its residual is not finite, and its part of the gradient zero."""
        weights = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64, requires_grad=True)

        def residual(x: Tensor, seen: Tensor) -> Tensor:
            return weights * (x[0] + 0.1 * x[0] ** 2 - seen)

        seen = torch.tensor([[0.1, 0.2, -0.1], [math.nan, 0.0, 0.0], [0.3, -0.2, 0.5]], dtype=torch.float64)
        found = []
        for rows in (seen, seen[[0, 2]], seen[1:2]):
            result = LevenbergMarquardt(residual)(torch.zeros(len(rows), 1).double(), rows)
            found.append(torch.autograd.grad(result.x[result.converged].sum(), weights)[0])
        assert found[1].abs().min() > 1e-3
        torch.testing.assert_close(found[0], found[1])
        assert not found[2].any()

    def test_none_without_grad(self) -> None:
        with torch.no_grad():
            assert not LevenbergMarquardt(decay)(START, observations().requires_grad_(True)).x.requires_grad


class TestBackward:
    def test_unrolled_steps_agree_with_the_implicit_gradient(self) -> None:
        """Steps that go on after convergence make the derivative converge too."""
        observed = observations(2).requires_grad_(True)
        options = LMOptions(tolerance=1e-18)
        gradients = []
        for backward in ("implicit", "unroll"):
            x = LevenbergMarquardt(decay, options, backward=backward)(START.expand(2, 3), observed).x
            gradients.append(torch.autograd.grad(x[:, 1].sum(), observed)[0])
        torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-4, atol=1e-6)

    def test_one_unrolled_step_is_the_derivative_of_that_step(self) -> None:
        solver = LevenbergMarquardt(decay, LMOptions(max_iterations=1), backward="unroll")
        start = START.clone().requires_grad_(True)
        assert torch.autograd.gradcheck(
            lambda x, observed: solver(x, observed).x, (start, observations().requires_grad_(True)), atol=1e-6
        )

    def test_none(self) -> None:
        observed = observations().requires_grad_(True)
        result = LevenbergMarquardt(decay, backward="none")(START, observed)
        assert not result.x.requires_grad
        assert torch.equal(result.x, LevenbergMarquardt(decay)(START, observed).x)

    def test_refuses_other_words(self) -> None:
        with pytest.raises(InputError, match="implicit, unroll or none"):
            LevenbergMarquardt(decay, backward="explicit")


class Weighed(nn.Module):
    """w (x - d - b): its minimum is a mean, whose derivatives are known."""

    def __init__(self) -> None:
        super().__init__()
        self.w = nn.Parameter(torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
        self.register_buffer("b", torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64))

    def forward(self, x: Tensor, d: Tensor) -> Tensor:
        return self.w * (x[0] - d - self.b)  # type: ignore[operator]


class TestWeightsOfAResidual:
    start, data = torch.zeros(1).double(), torch.tensor([0.0, 1.0, 2.0], dtype=torch.float64)

    def exact(self) -> dict[str, Tensor]:
        module = Weighed()
        w, moved = module.w.detach(), self.data + module.b
        x = (w**2 * moved).sum() / (w**2).sum()
        return {"residual.w": 2 * w * (moved - x) / (w**2).sum(), "residual.b": w**2 / (w**2).sum()}

    @pytest.mark.parametrize("backward", ["implicit", "unroll"])
    @pytest.mark.parametrize("batch", [(), (7,)])
    def test_an_optimizer_sees_them(self, backward: str, batch: tuple[int, ...]) -> None:
        """Found: no gradient at all while no data required one."""
        solver = LevenbergMarquardt(Weighed(), backward=backward)  # type: ignore[arg-type]
        solver(self.start.expand(*batch, 1), self.data.expand(*batch, 3)).x.mean().backward()
        (weight,) = solver.parameters()
        torch.testing.assert_close(weight.grad, self.exact()["residual.w"])

    @pytest.mark.parametrize("transform", [torch.func.jacrev, torch.func.jacfwd])
    @pytest.mark.parametrize("name", ["residual.w", "residual.b"])
    def test_functional(self, transform: Callable[..., Callable[..., Tensor]], name: str) -> None:
        solver = LevenbergMarquardt(Weighed())

        def solution(value: Tensor) -> Tensor:
            return torch.func.functional_call(solver, {name: value}, (self.start, self.data)).x[0]

        torch.testing.assert_close(transform(solution)(solver.state_dict()[name]), self.exact()[name])

    def test_closures(self) -> None:
        w = Weighed().w.detach().requires_grad_()
        solver = LevenbergMarquardt(lambda x, d: w * (x[0] - d - Weighed().b))
        (found,) = torch.autograd.grad(solver(self.start, self.data).x.sum(), w)
        torch.testing.assert_close(found, self.exact()["residual.w"])

    def test_what_is_not_asked_for_is_not_computed(self) -> None:
        solver = LevenbergMarquardt(Weighed().requires_grad_(False))
        assert not solver(self.start, self.data).x.requires_grad
        with torch.no_grad():
            assert not LevenbergMarquardt(Weighed())(self.start, self.data).x.requires_grad

    def test_vmap_is_refused(self) -> None:
        solver = LevenbergMarquardt(Weighed())
        with pytest.raises(InputError, match="leading dimensions"):
            torch.func.vmap(lambda data: solver(self.start, data).x)(self.data.expand(2, 3))
        with pytest.raises(InputError, match="leading dimensions"):
            torch.func.vmap(lambda w: torch.func.functional_call(solver, {"residual.w": w}, (self.start, self.data)).x)(
                torch.ones(2, 3).double()
            )


# Systems with the exact Hessian of a cost with local blocks, and minima to rounding.


def quadratic(shared: int, views: int, local: int) -> tuple[Tensor, Tensor]:
    """A positive matrix over (shared, local of each view) whose views are coupled through the shared part alone."""
    generator = torch.Generator().manual_seed(4)
    size = shared + views * local
    matrix = torch.zeros(size, size, dtype=torch.float64)
    for v in range(views):
        which = [*range(shared), *range(shared + v * local, shared + (v + 1) * local)]
        root = torch.randn(len(which), len(which) + 2, generator=generator, dtype=torch.float64)
        matrix[torch.tensor(which)[:, None], torch.tensor(which)] += root @ root.T
    return matrix, torch.randn(size, generator=generator, dtype=torch.float64)


def products(matrix: Tensor, shared: int, views: int, local: int) -> SchurLinearization:
    """Normal equations of which this is the matrix."""
    gram = torch.zeros(views, local + shared + 1, local + shared + 1, dtype=torch.float64)
    for v in range(views):
        which = torch.tensor([*range(shared + v * local, shared + (v + 1) * local), *range(shared)])
        gram[v, :-1, :-1] = matrix[which[:, None], which]
        gram[v, local:-1, local:-1] /= views
    return SchurLinearization.of_gram(gram, local)


@pytest.mark.parametrize(("shared", "views", "local"), [(3, 4, 2), (1, 2, 6), (5, 1, 1)])
def test_a_quadratic_gives_its_matrix_back_and_newton_its_minimum(shared: int, views: int, local: int) -> None:
    matrix, slope = quadratic(shared, views, local)

    def cost(s: Tensor, own: Tensor) -> Tensor:
        x = torch.cat([s, own.flatten()])
        return slope @ x + 0.5 * x @ matrix @ x

    # A preconditioner that is a tenth off.
    near = matrix + 0.1 * torch.diag(matrix.diagonal())
    zero = torch.zeros(shared, dtype=torch.float64), torch.zeros(views, local, dtype=torch.float64)
    solve = HessianSolve(cost, products(near, shared, views, local), zero)
    gradient = solve.gradient()
    torch.testing.assert_close(torch.cat([part.flatten() for part in gradient]), slope, rtol=1e-13, atol=1e-13)
    step = torch.cat([part.flatten() for part in solve(gradient)])
    # As well as the matrix is conditioned.
    torch.testing.assert_close(step, torch.linalg.solve(matrix, slope), rtol=1e-9, atol=1e-9)


def test_a_saddle_has_no_minimum() -> None:
    gram = torch.diag(torch.tensor([2.0, 2.0, 0.0], dtype=torch.float64))[None]
    zero = torch.zeros(1, dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64)

    def cost(s: Tensor, own: Tensor) -> Tensor:
        return s.square().sum() - own.square().sum()

    solve = HessianSolve(cost, SchurLinearization.of_gram(gram, 1), zero)
    with pytest.raises(DegenerateError, match="no minimum"):
        solve((zero[0] + 1.0, zero[1] + 2.0))


def test_rows_of_the_shared_parameters_alone_count_once() -> None:
    """As if a view of their own had them, whatever their number."""
    generator = torch.Generator().manual_seed(5)
    rows = torch.randn(3, 2 + 3 + 1, 12, generator=generator, dtype=torch.float64)
    alone = torch.randn(3 + 1, 7, generator=generator, dtype=torch.float64)
    found = SchurLinearization.of_gram(rows @ rows.mT, 2, alone @ alone.T)
    # The same residuals in the first view, whose own parameters do not touch them.
    wider = torch.zeros(3, 6, 12 + 7, dtype=torch.float64)
    wider[..., :12], wider[0, 2:, 12:] = rows, alone
    expected = SchurLinearization.of_gram(wider @ wider.mT, 2)
    torch.testing.assert_close(found.cost, expected.cost, rtol=1e-13, atol=0)
    lam = torch.full((), 0.1, dtype=torch.float64)
    for own, other in zip(found.step(lam)[0], expected.step(lam)[0], strict=True):
        torch.testing.assert_close(own, other, rtol=1e-11, atol=1e-12)


def test_a_minimum_follows_its_data() -> None:
    """Of dᵀx + ½ xᵀ M x, the minimum is -M⁻¹ d: so are its derivatives, sign and scale included."""
    shared, views, local = 3, 2, 2
    matrix, slope = quadratic(shared, views, local)

    def cost(s: Tensor, own: Tensor, data: Tensor) -> Tensor:
        x = torch.cat([s, own.flatten()])
        return data @ x + 0.5 * x @ matrix @ x

    zero = torch.zeros(shared, dtype=torch.float64), torch.zeros(views, local, dtype=torch.float64)
    found = HessianSolve(lambda s, own: cost(s, own, slope), products(matrix, shared, views, local), zero)
    data = slope.clone().requires_grad_(True)
    step = torch.cat([part.flatten() for part in implicit_step(cost, found, (data,))])
    weight = torch.arange(1.0, len(slope) + 1, dtype=torch.float64)
    (by_data,) = torch.autograd.grad(weight @ step, data)
    torch.testing.assert_close(by_data, -torch.linalg.solve(matrix, weight), rtol=1e-9, atol=1e-9)


class Decays(SchurProblem[State]):
    """Curves a_v exp(-s x), one a view, with their own heights: large residuals, so that their curvature counts."""

    batch, local_size = (), 1
    x = torch.linspace(0.0, 2.0, 15, dtype=torch.float64)

    def __init__(self, y: Tensor) -> None:
        self.y, self.residual_count = y, y.numel()

    def residuals(self, state: State) -> Tensor:
        shared, local = state
        return local * torch.exp(-shared.sum() * self.x) - self.y

    def rows(self, state: State) -> Tensor:
        shared, local = state
        shape = torch.exp(-shared.sum() * self.x).expand_as(self.y)
        slope = -local * self.x * shape
        return torch.stack([shape, *[slope] * len(shared), local * shape - self.y], -2)

    def retract(self, state: State, step: State) -> State:
        return state[0] + step[0], state[1] + step[1]


def decays(noise: float, views: int = 4) -> tuple[Decays, State]:
    """The problem, and a state that a few steps bring near its minimum."""
    draw = torch.randn(views, 15, generator=torch.Generator().manual_seed(8), dtype=torch.float64)
    y = torch.arange(1.0, views + 1, dtype=torch.float64)[:, None] * torch.exp(-0.9 * Decays.x) + noise * draw
    return Decays(y), (torch.tensor([0.7]).double(), torch.ones(views, 1).double())


@pytest.mark.parametrize("noise", [0.3, 1e-3])
def test_newton_ends_at_the_minimum_to_rounding(noise: float) -> None:
    """After a solver that stops early; and the systems are those of the Hessian there."""
    problem, start = decays(noise)
    (shared, local), solve = newton_minimum(problem, start, LMOptions(max_iterations=4, tolerance=0.1))
    flat = torch.cat([shared, local.flatten()])

    def cost(x: Tensor) -> Tensor:
        return problem.cost((x[:1], x[1:, None]))

    gradient, hessian = torch.func.grad(cost)(flat), torch.func.hessian(cost)(flat)
    away = torch.linalg.solve(hessian, gradient)
    # Of steps against standard deviations: rounding alone.
    assert float((away.abs() / (noise * torch.linalg.inv(hessian).diagonal().sqrt())).max()) < 1e-9
    right = torch.arange(1.0, len(flat) + 1, dtype=torch.float64)
    found = solve((right[:1], right[1:, None]))
    expected = torch.linalg.solve(hessian, right)
    torch.testing.assert_close(torch.cat([found[0], found[1].flatten()]), expected, rtol=1e-9, atol=1e-12)


def test_newton_accepts_data_without_noise() -> None:
    problem, start = decays(0.0)
    (shared, local), _ = newton_minimum(problem, start, LMOptions(max_iterations=30))
    assert float(shared[0]) == pytest.approx(0.9, abs=1e-12)
    torch.testing.assert_close(local[:, 0], torch.arange(1.0, 5.0).double(), rtol=1e-12, atol=0)


def test_newton_refuses_a_flat_cost() -> None:
    """Two shared unknowns of which only the sum counts."""
    problem, start = decays(0.1)
    with pytest.raises(DegenerateError, match="no minimum"):
        newton_minimum(problem, (torch.tensor([0.3, 0.4]).double(), start[1]), LMOptions(max_iterations=30))


def test_newton_refuses_a_start_far_from_a_minimum() -> None:
    """A cost whose curvature is negative there: no step of Newton's leads to a minimum."""
    problem, _ = decays(0.1)
    far = torch.tensor([60.0]).double(), torch.full((4, 1), 1e-3).double()
    with pytest.raises(DegenerateError, match="no minimum"):
        newton_minimum(problem, far, LMOptions(max_iterations=1))
