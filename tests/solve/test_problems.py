"""The Levenberg-Marquardt loop: known minima through every solver, and honest behavior where there is none."""

import itertools
import math

import pytest
import torch
from solve_problems import (
    KNOWN,
    MISRA_X,
    MISRA_Y,
    SOLVERS,
    Known,
    Scripted,
    beale,
    freudenstein_roth,
    misra1a,
    rosenbrock,
)
from torch import Tensor

from kcal.errors import InputError
from kcal.solve.lm import DenseLinearization, DenseProblem, LevenbergMarquardt, LMOptions, SolverStatus, minimize


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


CASES = [pytest.param(known, start, id=f"{known.name} {start}") for known in KNOWN for start in known.starts]
# The cost is compared to 1e-11 of itself (the tolerance of the solver is 1e-12, certified values have 11 digits), and
# where it is zero to what the residual floor of 1e-12 allows.
COST = {"rtol": 1e-10, "atol": 1e-23}


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(("known", "start"), CASES)
class TestKnownMinima:
    def test_minimum(self, known: Known, start: tuple[float, ...], solver: str) -> None:
        x, result = SOLVERS[solver](known.residual, vector(*start))
        assert bool(result.converged)
        assert (int(result.status) == SolverStatus.EXACT) == (known.sum_of_squares == 0)
        torch.testing.assert_close(2.0 * result.cost, torch.tensor(known.sum_of_squares, dtype=torch.float64), **COST)
        if known.x is not None:
            expected = vector(*known.x)
            # Parameter by parameter, because sizes differ by 1e6; zeros absolutely.
            scale = torch.where(expected == 0, 1.0, expected.abs())
            assert float(((x - expected).abs() / scale).max()) < known.digits

    def test_history_never_rises_and_belongs_to_the_state(
        self, known: Known, start: tuple[float, ...], solver: str
    ) -> None:
        x, result = SOLVERS[solver](known.residual, vector(*start))
        assert bool((result.history[1:] <= result.history[:-1]).all())
        assert len(result.history) == int(result.iterations) + 1
        assert float(result.history[-1]) == float(result.cost)
        begun = 0.5 * (known.residual(vector(*start)) ** 2).sum()
        ended = 0.5 * (known.residual(x) ** 2).sum()
        torch.testing.assert_close(result.history[0], begun, rtol=1e-14, atol=0)
        torch.testing.assert_close(result.cost, ended, rtol=1e-13, atol=1e-30)

    @pytest.mark.parametrize("factor", [1e-6, 1e6])
    def test_units_do_not_matter(self, known: Known, start: tuple[float, ...], solver: str, factor: float) -> None:
        """Trap 4: every second parameter in other units, the same steps, the same minimum."""
        units = torch.tensor([factor if i % 2 else 1.0 for i in range(len(start))], dtype=torch.float64)
        _, plain = SOLVERS[solver](known.residual, vector(*start))
        x, scaled = SOLVERS[solver](lambda y: known.residual(y * units), vector(*start) / units)
        assert bool(scaled.converged)
        torch.testing.assert_close(scaled.cost, plain.cost, **COST)
        # The first steps are the same; later ones differ as rounding grows.
        torch.testing.assert_close(scaled.history[:4], plain.history[:4], rtol=1e-8, atol=1e-20)
        if known.x is not None:
            expected = vector(*known.x)
            scale = torch.where(expected == 0, 1.0, expected.abs())
            assert float(((x * units - expected).abs() / scale).max()) < known.digits


@pytest.mark.parametrize("solver", SOLVERS)
class TestHoles:
    def test_parameter_that_nothing_depends_on_stays(self, solver: str) -> None:
        def residual(x: Tensor) -> Tensor:
            return torch.cat([beale(x[:2]), 0.0 * x[2:]])

        x, result = SOLVERS[solver](residual, vector(1.0, 1.0, 7.25))
        assert bool(result.converged)
        assert float(x[2]) == 7.25
        torch.testing.assert_close(x[:2], vector(3.0, 0.5), rtol=0, atol=1e-12)

    def test_steps_into_nan_are_rejected(self, solver: str) -> None:
        """From x = 30 the full step of log(x) = 1 lands below zero, where there is nothing."""

        def residual(x: Tensor) -> Tensor:
            assert x.ndim == 1
            return torch.stack([torch.log(x[0]) - 1.0, x[1] * torch.sqrt(x[0]) - 2.0])

        x, result = SOLVERS[solver](residual, vector(30.0, 1.0))
        assert int(result.status) == SolverStatus.EXACT
        assert bool(torch.isfinite(result.history).all())
        assert bool((result.history[1:] == result.history[:-1]).any()), "no step was rejected"
        torch.testing.assert_close(x, vector(math.e, 2.0 / math.sqrt(math.e)), rtol=0, atol=1e-11)

    def test_start_outside(self, solver: str) -> None:
        x, result = SOLVERS[solver](torch.log, vector(-1.0, 1.0))
        assert int(result.status) == SolverStatus.BAD_START
        assert not bool(result.converged)
        assert int(result.iterations) == 0
        assert torch.equal(x, vector(-1.0, 1.0))
        assert "start is not finite" in result.message

    def test_kink_stalls(self, solver: str) -> None:
        """|x| + 1 promises a decrease at its kink that no step gives."""
        x, result = SOLVERS[solver](lambda x: torch.cat([x[:1].abs() + 1.0, x[1:] - 4.0]), vector(0.3, 1.0))
        assert int(result.status) == SolverStatus.STALLED
        assert not bool(result.converged)
        assert float(x[0].abs()) < 1e-4
        assert "stalled" in result.message

    def test_limit(self, solver: str) -> None:
        _, result = SOLVERS[solver](rosenbrock, vector(-1.2, 1.0), LMOptions(max_iterations=5))
        assert int(result.status) == SolverStatus.ITERATION_LIMIT
        assert int(result.iterations) == 5
        assert len(result.history) == 6
        assert "iteration limit" in result.message

    def test_start_at_the_minimum(self, solver: str) -> None:
        _, result = SOLVERS[solver](rosenbrock, vector(1.0, 1.0))
        assert int(result.status) == SolverStatus.EXACT
        assert int(result.iterations) == 0
        _, result = SOLVERS[solver](lambda x: torch.cat([x - 1.0, torch.ones(1).double()]), vector(1.0, 1.0))
        assert int(result.status) == SolverStatus.CONVERGED
        assert int(result.iterations) == 1

    def test_a_step_that_damping_shortens_is_no_minimum(self, solver: str) -> None:
        """λ = 3e9 lets a step promise 3e-10 of the cost: below the tolerance, and far from the minimum."""
        options = LMOptions(initial_damping=3e9, tolerance=1e-8)
        x, result = SOLVERS[solver](lambda x: torch.cat([beale(x), torch.ones(1).double()]), vector(1.0, 1.0), options)
        assert int(result.status) == SolverStatus.CONVERGED
        assert int(result.iterations) > 9
        torch.testing.assert_close(x, vector(3.0, 0.5), rtol=0, atol=1e-3)

    def test_residual_floor_is_per_residual(self, solver: str) -> None:
        """The same misfit in every one of many residuals counts as the same, not as more."""

        def constant(x: Tensor) -> Tensor:
            return torch.cat([x - 1.0, 1e-6 * torch.ones(200).double()])

        for floor, status in ((1.1e-6, SolverStatus.EXACT), (0.9e-6, SolverStatus.CONVERGED)):
            _, result = SOLVERS[solver](constant, vector(3.0, 3.0), LMOptions(residual_floor=floor))
            assert int(result.status) == status

    def test_known_decrease_of_one_step(self, solver: str) -> None:
        """One step of damping λ on r = x - 1 (a column of length one): 1/(1 + λ) of the way."""
        options = LMOptions(max_iterations=1, initial_damping=0.25)
        x, result = SOLVERS[solver](lambda x: x - 1.0, vector(0.0, 0.0), options)
        torch.testing.assert_close(x, vector(0.8, 0.8), rtol=0, atol=1e-15)
        torch.testing.assert_close(result.history, vector(1.0, 0.04), rtol=1e-14, atol=0)


def decay(b: Tensor, x: Tensor, y: Tensor) -> Tensor:
    return b[0] * (1.0 - torch.exp(-b[1] * x)) - y


class TestBatch:
    def test_starts_together_are_starts_alone(self) -> None:
        starts = torch.tensor([[6.0, 3.0], [0.5, -2.0], [15.0, -3.0], [0.0, 0.0]], dtype=torch.float64)
        solver = LevenbergMarquardt(freudenstein_roth)
        together = solver(starts)
        for i, start in enumerate(starts):
            alone = solver(start)
            torch.testing.assert_close(together.x[i], alone.x, rtol=1e-12, atol=1e-12)
            torch.testing.assert_close(together.cost[i], alone.cost, rtol=1e-12, atol=1e-24)
            assert int(together.status[i]) == int(alone.status)
            assert int(together.iterations[i]) == int(alone.iterations)
            known = len(alone.history)
            # Near a zero residual the cost is rounding.
            torch.testing.assert_close(together.history[:known, i], alone.history, rtol=1e-9, atol=1e-20)
            assert bool((together.history[known:, i] == together.history[known - 1, i]).all())
        costs = (2.0 * together.cost).tolist()
        assert sorted(round(cost, 6) for cost in costs)[0] == 0.0
        assert max(costs) == pytest.approx(48.98425367924001, rel=1e-12)

    def test_two_batch_dimensions(self) -> None:
        starts = torch.tensor([[[-1.2, 1.0], [2.0, 2.0], [0.0, 3.0]], [[5.0, -1.0], [1.0, 1.0], [-3.0, -4.0]]])
        result = LevenbergMarquardt(rosenbrock)(starts.double())
        assert result.cost.shape == result.status.shape == result.iterations.shape == (2, 3)
        assert bool((result.status == SolverStatus.EXACT).all())
        torch.testing.assert_close(result.x, torch.ones(2, 3, 2, dtype=torch.float64), rtol=0, atol=1e-10)
        assert int(result.iterations[1, 1]) == 0

    def test_data_of_each_element(self) -> None:
        """Misra1a with y in three units at once: b1 follows, b2 does not."""
        units = vector(1.0, 10.0, 1e-3)
        starts = torch.stack([vector(500.0 * unit, 1e-4) for unit in units.tolist()])
        result = LevenbergMarquardt(decay)(starts, MISRA_X.expand(3, -1), units[:, None] * MISRA_Y)
        assert bool((result.status == SolverStatus.CONVERGED).all())
        torch.testing.assert_close(result.x[:, 0] / units, vector(*[2.3894212918e2] * 3), rtol=1e-8, atol=0)
        torch.testing.assert_close(result.x[:, 1], vector(*[5.5015643181e-4] * 3), rtol=1e-8, atol=0)
        alone = LevenbergMarquardt(misra1a)(vector(500.0, 1e-4))
        torch.testing.assert_close(result.cost[0], alone.cost, rtol=1e-12, atol=0)

    def test_a_bad_element_leaves_the_others_alone(self) -> None:
        result = LevenbergMarquardt(torch.log)(torch.tensor([[2.0, 3.0], [-1.0, 1.0], [0.5, 9.0]], dtype=torch.float64))
        assert result.status.tolist() == [SolverStatus.EXACT, SolverStatus.BAD_START, SolverStatus.EXACT]
        assert result.converged.tolist() == [True, False, True]
        torch.testing.assert_close(result.x[[0, 2]], torch.ones(2, 2, dtype=torch.float64), rtol=0, atol=1e-11)
        assert result.message == (
            "2 x converged: the residual is zero to rounding; 1 x the cost at the start is not finite"
        )


class TestCallback:
    def test_is_told_every_trial_and_the_best_cost(self) -> None:
        told: list[tuple[int, float]] = []

        def note(trial: int, cost: Tensor) -> None:
            told.append((trial, float(cost)))

        result = LevenbergMarquardt(rosenbrock)(vector(-1.2, 1.0), callback=note)
        assert [trial for trial, _ in told] == list(range(1, int(result.iterations) + 1))
        assert [cost for _, cost in told] == result.history[1:].tolist()

    def test_stops(self) -> None:
        result = LevenbergMarquardt(rosenbrock)(vector(-1.2, 1.0), callback=lambda trial, _: trial == 7)
        assert int(result.status) == SolverStatus.INTERRUPTED
        assert int(result.iterations) == 7
        assert "best state so far" in result.message
        torch.testing.assert_close(0.5 * (rosenbrock(result.x) ** 2).sum(), result.cost, rtol=1e-14, atol=0)
        assert float(result.cost) < float(result.history[0])

    def test_a_finished_element_is_not_called_interrupted(self) -> None:
        starts = torch.tensor([[1.0, 1.0], [-1.2, 1.0]], dtype=torch.float64)
        result = LevenbergMarquardt(rosenbrock)(starts, callback=lambda trial, _: trial == 2)
        assert result.status.tolist() == [SolverStatus.EXACT, SolverStatus.INTERRUPTED]


def scripted(trials: list[tuple[float, float]], start: float = 1.0) -> Scripted:
    """`trials`: the cost of each candidate, and the decrease that was predicted for it."""
    costs, promised = vector(*trials).T
    return Scripted(costs[None], promised[None], start)


@pytest.mark.parametrize("steps", [17, 19, 20, 21, 23, 80])
def test_a_minimum_that_is_reached_slowly_is_one(steps: int) -> None:
    """Twenty steps gain little, and convergence comes some steps before or after the twentieth: the same status."""
    trials = [(1.0 - 1e-9 * k, 1e-9) for k in range(1, steps)]
    options = LMOptions(flatness=1e-6, residual_floor=0.0)
    found = minimize(scripted([*trials, (1.0, 1e-13)]), (torch.zeros(1, 1).double(),), options)  # type: ignore[arg-type,type-var]
    assert (found.status.tolist(), found.iterations.tolist()) == ([SolverStatus.CONVERGED], [steps])


def test_damping_follows_the_gain_ratio() -> None:
    """Nielsen 1999: max(1/10, 1 - (2 ρ - 1)³) after a step that helps; 2, 4, 8, ... times after steps that do not."""
    gains = (1.0, 0.5, 0.8, 0.1)
    costs = [100.0]
    for gain in gains:
        costs.append(costs[-1] - gain)
    # What is worse, or NaN, is rejected; a step that helps begins anew with 2.
    trials = [(cost, 1.0) for cost in costs[1:]]
    trials = [*trials[:2], (200.0, 1.0), (math.nan, 1.0), (99.0, 1.0), *trials[2:], (150.0, 1.0), (150.0, 1.0)]
    problem = scripted(trials, 100.0)
    minimize(problem, (torch.zeros(1, 1).double(),), LMOptions(max_iterations=len(trials), initial_damping=1.0))  # type: ignore[arg-type,type-var]
    factors = [float(b / a) for a, b in itertools.pairwise(problem.dampings)]
    helped = [max(0.1, 1.0 - (2.0 * gain - 1.0) ** 3) for gain in gains]
    assert factors == pytest.approx([*helped[:2], 2.0, 4.0, 8.0, *helped[2:], 2.0], rel=1e-9)


class TestRefusals:
    @pytest.mark.parametrize(
        ("start", "message"),
        [
            *(
                (torch.ones(2, dtype=dtype), r"must be float64, got torch\.\w+; use \.double\(\)")
                for dtype in (torch.float32, torch.float16, torch.int64)
            ),
            *((vector(value, 1.0), "1 of 2 values are not finite") for value in (math.nan, math.inf)),
            *((torch.zeros(shape).double(), r"a tensor \(\.\.\., P\) with values") for shape in ((), (0,), (0, 2))),
            ([1.0, 2.0], "got list"),
        ],
    )
    def test_starts(self, start: Tensor, message: str) -> None:
        with pytest.raises(InputError, match=message):
            LevenbergMarquardt(lambda x: x)(start)

    def test_residuals_in_single_precision(self) -> None:
        with pytest.raises(InputError, match=r"got torch\.float32"):
            LevenbergMarquardt(lambda x: rosenbrock(x).float())(vector(-1.2, 1.0))

    @pytest.mark.parametrize("batch", [(), (3,)])
    def test_residuals_that_are_no_vector(self, batch: tuple[int, ...]) -> None:
        start = torch.ones(*batch, 2, dtype=torch.float64)
        with pytest.raises(InputError, match=r"shape \(\)"):
            LevenbergMarquardt(lambda x: (x * x).sum())(start)
        with pytest.raises(InputError, match=r"shape \(2, 2\)"):
            LevenbergMarquardt(lambda x: torch.stack([x, x]))(start)

    def test_data_of_another_batch(self) -> None:
        with pytest.raises(InputError, match=r"\(2, 14\) do not begin with the batch shape \(3,\)"):
            LevenbergMarquardt(decay)(torch.ones(3, 2).double(), MISRA_X.expand(2, -1), MISRA_Y.expand(2, -1))

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"max_iterations": 0}, "at least 1"),
            ({"tolerance": 1.0}, "tolerance"),
            ({"tolerance": -1e-9}, "tolerance"),
            ({"tolerance": math.nan}, "tolerance"),
            ({"initial_damping": 0.0}, "initial_damping"),
            ({"initial_damping": math.nan}, "initial_damping"),
            ({"residual_floor": -1.0}, "residual_floor"),
            ({"residual_floor": math.nan}, "residual_floor"),
        ],
    )
    def test_options(self, options: dict[str, float], message: str) -> None:
        with pytest.raises(InputError, match=message):
            LMOptions(**options)


def test_start_and_data_are_left_as_they_were_and_only_the_solution_has_a_gradient() -> None:
    start = vector(500.0, 1e-4).requires_grad_()
    y = MISRA_Y.clone().requires_grad_()
    result = LevenbergMarquardt(decay)(start, MISRA_X, y)
    assert start.tolist() == [500.0, 1e-4]
    assert torch.equal(y, MISRA_Y)
    assert result.x.requires_grad
    assert not result.cost.requires_grad
    assert torch.autograd.grad(result.x.sum(), start, allow_unused=True) == (None,)


def test_every_status_has_a_sentence_of_its_own() -> None:
    assert len({status.message for status in SolverStatus}) == len(SolverStatus)


def test_without_a_last_step_the_solution_is_where_the_problem_was_linearized() -> None:
    where: list[Tensor] = []

    class Watched(DenseProblem):
        def linearize(self, state: tuple[Tensor]) -> DenseLinearization:
            where.append(state[0])
            return super().linearize(state)

    start, problem = (vector(500.0, 1e-4),), Watched(misra1a, batch=())
    whole = minimize(problem, start, LMOptions(tolerance=1e-6))
    short = minimize(problem, start, LMOptions(tolerance=1e-6, last_step=False))
    torch.testing.assert_close(where[-1], short.state[0], rtol=0, atol=0)
    before = minimize(problem, start, LMOptions(tolerance=1e-6, max_iterations=int(whole.iterations) - 1))
    torch.testing.assert_close(short.state[0], before.state[0], rtol=0, atol=0)
    assert bool(whole.converged)
    assert bool(short.converged)
    assert not bool(before.converged)
    assert int(short.iterations) == int(whole.iterations) == len(short.history) - 1
    assert float(short.cost) == float(short.history[-1]) == float(before.cost) > float(whole.cost)


def test_a_step_that_raises_the_cost_is_bent_before_it_is_shortened() -> None:
    """The valley of Rosenbrock's function is a parabola; a bend that follows it leads to the minimum at once."""
    start, problem = (vector(-1.2, 1.0),), DenseProblem(rosenbrock, batch=())
    options = LMOptions(initial_damping=1e-10)

    def bend(state: tuple[Tensor], step: tuple[Tensor], *_: object) -> tuple[Tensor]:
        across = step[0][0]
        return (torch.stack([across, (state[0][0] + across).square() - state[0][1]]),)

    straight, bent = (minimize(problem, start, options, bend=way) for way in (None, bend))
    assert int(bent.iterations) <= 2 < int(straight.iterations)
    torch.testing.assert_close(bent.state[0], torch.ones_like(bent.state[0]), rtol=0, atol=1e-9)
    # What it bends without a gain is shortened as ever.
    worse = minimize(problem, start, options, bend=lambda state, step, *_: (100.0 * step[0],))
    assert int(worse.iterations) == int(straight.iterations)
