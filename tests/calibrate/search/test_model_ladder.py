"""What the search for minima rests on: steps along twists, barriers before folds, and compressed views."""

from __future__ import annotations

import pytest
import torch
from calibrate_scenes import BOARD, SIZE, camera, motions, pixels_of
from torch import Tensor

from kcal.calibrate.bundle.board_problem import BoardState
from kcal.calibrate.bundle.compressed_problem import CompressedProblem, compress
from kcal.calibrate.bundle.parameters import ParameterConstraints
from kcal.calibrate.bundle.priors import FoldBarrier, GaussianPrior
from kcal.calibrate.bundle.twist import apply_twist
from kcal.calibrate.bundle.views import CameraViews, free_parameters
from kcal.calibrate.search.model_ladder import _solve_within_barrier, embed
from kcal.lens.model import LensModel
from kcal.lens.pose import rotation_from_vector
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.result import SolverStatus, stack


@pytest.mark.parametrize("size", [1e-7, 0.0099, 0.0101, 0.3, 3.0])
def test_a_step_is_the_exponential_of_its_twist(size: float) -> None:
    draw = torch.randn(4, 12, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    turn = size * torch.nn.functional.normalize(draw[:, :3], dim=-1)
    shift, translation, rotation = draw[:, 3:6], draw[:, 6:9], rotation_from_vector(draw[:, 9:])
    twist = torch.zeros(4, 4, 4, dtype=torch.float64)
    twist[:, :3, :3] = torch.linalg.cross(turn[:, None].expand(4, 3, 3), torch.eye(3).double().expand(4, 3, 3)).mT
    twist[:, :3, 3] = shift - torch.linalg.cross(turn, translation)
    expected = torch.linalg.matrix_exp(twist)
    moved = apply_twist(rotation, translation, torch.cat([turn, shift], -1))
    torch.testing.assert_close(moved[0], expected[:, :3, :3] @ rotation, rtol=0, atol=1e-13)
    image = (expected[:, :3, :3] @ translation[..., None])[..., 0] + expected[:, :3, 3]
    torch.testing.assert_close(moved[1], image, rtol=0, atol=1e-13)


def barrier_values(model: LensModel, radial: dict[str, float]) -> Tensor:
    names = ["fx", "fy", "cx", "cy", "skew", *model.names, "warp_x", "warp_y"]
    return torch.tensor([radial.get(name, 0.0) for name in names], dtype=torch.float64)


class TestFoldBarrier:
    MODEL = LensModel.named("opencv8")

    def test_a_regular_lens_costs_nothing(self) -> None:
        barrier = FoldBarrier(self.MODEL, 1.0, 0.1)
        assert barrier.rows(barrier_values(self.MODEL, {"k1": -0.2, "k4": 0.1})).shape == (15 + 1, 0)

    @pytest.mark.parametrize("radial", [{"k1": -0.4}, {"k4": -1.01}, {"k4": 100.0, "k1": 100.0}])
    def test_no_lens_that_folds_has_a_cost(self, radial: dict[str, float]) -> None:
        """r (1 - 0.4 r²) folds at 0.91; 1 - 1.01 r² has a pole at 0.995; the third only shapes the axis: dear."""
        rows = FoldBarrier(self.MODEL, 1.0, 0.1).rows(barrier_values(self.MODEL, radial))
        cost = float((rows[-1] ** 2).sum())
        assert cost != cost or cost > 0.01

    @pytest.mark.parametrize("radial", [{"k1": -0.32}, {"k4": -0.85}, {"k1": 40.0, "k4": 45.0, "k5": -0.3}])
    def test_derivatives(self, radial: dict[str, float]) -> None:
        barrier, values = FoldBarrier(self.MODEL, 1.0, 0.1), barrier_values(self.MODEL, radial)
        rows = barrier.rows(values)
        assert float(rows[-1].abs().max()) > 0
        numeric = [
            (barrier.rows(values + 1e-7 * unit)[-1] - barrier.rows(values - 1e-7 * unit)[-1]) / 2e-7
            for unit in torch.eye(len(values), dtype=torch.float64)
        ]
        torch.testing.assert_close(rows[:-1], torch.stack(numeric), rtol=1e-5, atol=1e-6)


def test_prior_rows() -> None:
    prior = GaussianPrior(
        torch.tensor([0, 3]), torch.tensor([500.0, 1.0]).double(), torch.tensor([0.1, 2.0], dtype=torch.float64)
    )
    rows = prior.rows(torch.tensor([[510.0, 0.0, 0.0, 2.0]], dtype=torch.float64))
    assert rows[0, -1].tolist() == [1.0, 2.0]
    assert rows[0, :-1].tolist() == [[0.1, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 2.0]]


class TestCompressed:
    """A 5-coefficient solution of a lens with 14, compressed, against all views."""

    LARGE = LensModel.named("opencv14")

    def solved(self, count: int = 30) -> tuple[CameraViews, BoardState]:
        truth = camera("opencv14")
        poses = motions(truth, count, 4)
        pixels = pixels_of(truth, poses, noise=0.2, seed=6)
        views = CameraViews(board_points=BOARD.points, pixels=pixels, size=SIZE)
        start = BoardState.flat(camera("opencv5").params.detach(), *poses)
        return views, minimize(views.lens_problem(LensModel.named("opencv5")), start, LMOptions()).state

    def test_costs_the_same_where_it_was_compressed_and_nearly_so_at_its_minimum(self) -> None:
        views, state = self.solved()
        small = LensModel.named("opencv5")
        compressed = compress(views.problem(small), state, views.observed_radius(state))
        problem = CompressedProblem(compressed, self.LARGE, free_parameters(self.LARGE))
        start = problem.start(embed(state.parameters, small, self.LARGE))
        full = views.lens_problem(self.LARGE)
        before = float(views.lens_problem(small).cost(state))
        # At a minimum the poses have nothing left to answer.
        assert float(problem.cost(start)) == pytest.approx(before, rel=1e-6)
        found = minimize(problem, start, LMOptions(tolerance=1e-8))
        there = float(full.cost(problem.expand(found.state)))
        best = float(minimize(full, problem.expand(found.state), LMOptions()).cost)
        # Measured: compression and one expansion recover all but 12 % of what 14 coefficients gain on 5.
        assert there - best < 0.2 * (before - best)
        assert float(found.cost) == pytest.approx(there, rel=5e-3)

    def test_derivatives_are_those_of_the_cost(self) -> None:
        views, state = self.solved(8)
        small = LensModel.named("opencv5")
        compressed = compress(views.problem(small), state, views.observed_radius(state))
        problem = CompressedProblem(compressed, self.LARGE, free_parameters(self.LARGE))
        start = problem.start(embed(state.parameters, small, self.LARGE))
        size = len(free_parameters(self.LARGE)) + 3
        move = 1e-4 * torch.randn(size, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
        state = problem.retract(start, (move,))
        linear = problem.linearize(state)
        # The full step of Gauss and Newton promises half the slope along it.
        step, predicted = linear.step(torch.tensor(0.0, dtype=torch.float64))
        h = 1e-5
        slope = (
            problem.cost(problem.retract(state, (h * step[0],))) - problem.cost(problem.retract(state, (-h * step[0],)))
        ) / (2 * h)
        assert float(slope) == pytest.approx(-2.0 * float(predicted), rel=1e-4)


def test_steps_are_the_same_for_numpy_and_for_torch() -> None:
    generator = torch.Generator().manual_seed(3)
    step = torch.randn(4, 6, generator=generator, dtype=torch.float64) * torch.tensor([1e-9, 1e-3, 0.1, 2.0])[:, None]
    rotation = rotation_from_vector(torch.randn(4, 3, generator=generator, dtype=torch.float64))
    translation = torch.randn(4, 3, generator=generator, dtype=torch.float64)
    with torch.no_grad():
        fast = apply_twist(rotation, translation, step)
    for found, expected in zip(fast, apply_twist(rotation, translation, step), strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-14)


def test_rows_are_the_same_for_numpy_and_for_torch() -> None:
    """Of all corners and of compressed views, with a warp, tied parameters and some corners unseen."""
    truth = camera("opencv14")
    poses = motions(truth, 6, 4)
    pixels = pixels_of(truth, poses, noise=0.2)
    pixels[2, :5] = torch.nan
    known = ParameterConstraints(tied=(("fx", "fy"),), free=("skew",))
    views = CameraViews(board_points=BOARD.points, pixels=pixels, size=SIZE, free_warp=True, constraints=known)
    state = BoardState(truth.params.detach(), torch.tensor([1e-3, -2e-3]).double(), *poses)
    problem, stacked = views.lens_problem(truth.model), stack([state, state])
    compressed = compress(views.problem(truth.model), state, 1.0)
    reduced = CompressedProblem(compressed, truth.model, known.free_parameters(truth.model), batch=(2,))
    start = reduced.start(torch.stack([state.parameters, 1.001 * state.parameters]))
    with torch.no_grad():
        rows, both, cost = problem.rows(state), problem.rows(stacked), reduced.linearize(start).cost
        assert rows.isfinite().all()
    slow = problem.rows(state)
    scale = slow.abs().amax((0, 2))[:, None]
    torch.testing.assert_close(rows / scale, slow / scale, rtol=0, atol=1e-12)
    torch.testing.assert_close(both[1] / scale, slow / scale, rtol=0, atol=1e-12)
    torch.testing.assert_close(cost, reduced.linearize(start).cost, rtol=1e-10, atol=0)


def test_a_lens_at_its_minimum_is_not_held_back() -> None:
    """The solve ends above or below its start by rounding; both are the minimum, and converged."""
    views, state = TestCompressed().solved()
    model = LensModel.named("opencv5")
    generator = torch.Generator().manual_seed(1)
    for _ in range(8):
        noise = torch.randn(state.parameters.shape, generator=generator, dtype=torch.float64)
        start = state._replace(parameters=state.parameters * (1.0 + 1e-14 * noise))
        result, _ = _solve_within_barrier(views, start, model, LMOptions())
        assert int(result.status) == SolverStatus.CONVERGED
