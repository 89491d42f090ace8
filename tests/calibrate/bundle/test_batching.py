"""Many cameras in one call: the same answers as one by one, whatever their views, and each with its own status."""

from __future__ import annotations

import math

import pytest
import torch
from calibrate_scenes import BOARD, SIZE, camera, motions, observe, pixels_of

from kcal.calibrate.bundle.board_problem import BoardProblem, BoardState
from kcal.calibrate.bundle.compressed_problem import CompressedProblem, compress
from kcal.calibrate.bundle.priors import FoldBarrier
from kcal.calibrate.bundle.views import CameraViews, free_parameters
from kcal.calibrate.camera.calibrate import (
    CalibrationOptions,
    CameraCalibrationResult,
    calibrate_camera,
    calibrate_cameras,
)
from kcal.calibrate.camera.outliers import OutlierRejection
from kcal.calibrate.search.model_ladder import embed
from kcal.corners.board import Board
from kcal.corners.observations import Observations
from kcal.errors import DegenerateError
from kcal.lens.model import LensModel
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.result import SolverStatus, map_state, pick, stack

CPU = torch.device("cpu")


def scene(views: int, seed: int, *, focal: float = 500.0, missing: int = 0, model: str = "opencv5") -> Observations:
    truth = camera(model, focal)
    pixels = pixels_of(truth, motions(truth, views, seed), noise=0.2, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    for v in range(missing):
        pixels[v, torch.randperm(pixels.shape[1], generator=generator)[:7]] = torch.nan
    return observe(pixels)


def with_covariance(seen: Observations, seed: int) -> Observations:
    draw = torch.rand(
        len(seen.views), BOARD.corners, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )
    views = []
    for view, size in zip(seen.views, (0.1 + 0.2 * draw).square().tolist(), strict=True):
        covariance = tuple(None if pixel is None else (c, 0.0, c) for pixel, c in zip(view.pixels, size, strict=True))
        views.append(view.model_copy(update={"covariance": covariance}))
    return seen.model_copy(update={"views": tuple(views)})


def assert_same(found: object, alone: CameraCalibrationResult) -> None:
    assert isinstance(found, CameraCalibrationResult)
    assert found.rms == pytest.approx(alone.rms, rel=1e-9)
    assert (found.status, found.rejected_corners) == (alone.status, alone.rejected_corners)
    for name, sigma in alone.sigma.items():
        k = alone.camera.names.index(name)
        here, there = found.camera.params[k], alone.camera.params[k]
        assert abs(float(here - there)) <= 1e-4 * (sigma or 0.0), name
    torch.testing.assert_close(found.residuals, alone.residuals, rtol=0, atol=1e-5, equal_nan=True)
    torch.testing.assert_close(found.cam_from_board_rotation, alone.cam_from_board_rotation, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "options",
    [
        CalibrationOptions(model="opencv5"),
        CalibrationOptions(model="opencv5", priors={"cx": (325.0, 2.0)}, board_warp=True),
        CalibrationOptions(model="opencv5", fixed={"cx": None}, tied=(("fx", "fy"),)),
        CalibrationOptions(model="opencv5", reject=OutlierRejection(limit=0.3), weighted=False),
        CalibrationOptions(camera=camera("opencv14", 505.0), free=("fx", "fy")),
    ],
    ids=["plain", "prior and warp", "rules", "reject", "known camera"],
)  # fmt: skip
def test_ragged_cameras_are_those_of_one_call_each(options: CalibrationOptions) -> None:
    sets = [scene(9, 1), scene(26, 2, focal=470.0, missing=5), scene(7, 3, missing=2), with_covariance(scene(12, 4), 4)]
    for found, seen in zip(calibrate_cameras(sets, options), sets, strict=True):
        assert_same(found, calibrate_camera(seen, options))


def test_rich_models_are_those_of_one_call_each() -> None:
    sets = [scene(26, 2, focal=470.0, missing=5, model="opencv8"), scene(28, 3, model="opencv8")]
    options = CalibrationOptions(weak_prior=None, model="opencv8")
    for found, seen in zip(calibrate_cameras(sets, options), sets, strict=True):
        assert_same(found, calibrate_camera(seen, options))


def test_one_bad_set_does_not_spoil_the_others() -> None:
    other_board = Board(columns=6, rows=5, square=0.05)
    truth = camera()
    poses = motions(truth, 8, 9, board=other_board)
    sets = [
        scene(8, 5),
        observe(pixels_of(truth, motions(truth, 2, 6), noise=0.2)),
        observe(pixels_of(truth, poses, board=other_board, noise=0.2), board=other_board),
    ]
    told: list[str] = []
    first, bad, other = calibrate_cameras(sets, CalibrationOptions(model="opencv5"), progress=told.append)
    assert_same(first, calibrate_camera(sets[0], CalibrationOptions(model="opencv5")))
    assert_same(other, calibrate_camera(sets[2], CalibrationOptions(model="opencv5")))
    assert isinstance(bad, DegenerateError)
    assert "2 view(s)" in str(bad)
    assert told == ["1 of 3 cameras", "2 of 3 cameras", "3 of 3 cameras"]
    assert calibrate_cameras([], CalibrationOptions(model="opencv5")) == []


def views_of(count: int, seed: int, missing: int = 0) -> tuple[CameraViews, BoardState]:
    seen = scene(count, seed, missing=missing)
    result = calibrate_camera(seen, CalibrationOptions(model="opencv5"))
    views = CameraViews(board_points=BOARD.points, pixels=seen.pixels(), size=SIZE)
    poses = result.cam_from_board_rotation, result.cam_from_board_translation
    return views, BoardState.flat(result.camera.params.detach(), *poses)


class TestJoined:
    SMALL, LARGE = LensModel.named("opencv5"), LensModel.named("opencv8")

    def both(self) -> tuple[list[CameraViews], list[BoardState]]:
        some, state = views_of(6, 1)
        more, other = views_of(10, 2, missing=3)
        return [some, more], [state, other]

    def test_padded_views_have_no_part(self) -> None:
        (some, more), (state, other) = self.both()
        values = torch.cat([state.parameters, state.warp])
        tries = [FoldBarrier(self.SMALL, radius, 0.1) for radius in torch.linspace(1, 3, 100).tolist()]
        # For one camera a barrier that is met, for the other one that is not.
        met = next(b for b in reversed(tries) if bool(b.rows(values).isfinite().all()))
        assert float(met.rows(values)[-1].abs().max()) > 0
        bounds = [(met,), (tries[0],)]
        problems = [some.lens_problem(self.SMALL, terms=bounds[0]), more.lens_problem(self.SMALL, (2,), bounds[1])]
        starts = [state, stack([other, other])]
        joined, start = BoardProblem.joined(problems, starts, CPU)
        assert joined.batch == (3,)
        linear, alone = joined.linearize(start), [p.linearize(s) for p, s in zip(problems, starts, strict=True)]
        expected = torch.cat([alone[0].cost[None], alone[1].cost])
        torch.testing.assert_close(linear.cost, expected, rtol=1e-12, atol=0)
        damping = torch.full((3,), 1e-3, dtype=torch.float64)
        (shared, local), predicted = linear.step(damping)
        assert float(local[0, 6:].abs().max()) == 0.0
        (own, own_local), own_predicted = alone[0].step(damping[0])
        torch.testing.assert_close(predicted[0], own_predicted, rtol=1e-8, atol=0)
        scale = own.abs().max()
        torch.testing.assert_close(shared[0], own, rtol=1e-6, atol=1e-9 * float(scale))
        torch.testing.assert_close(local[0, :6], own_local, rtol=1e-6, atol=1e-9)

    def test_each_element_has_its_own_status(self) -> None:
        (some, more), (state, other) = self.both()
        problems = [some.lens_problem(self.SMALL), more.lens_problem(self.SMALL), some.lens_problem(self.SMALL)]
        behind = state._replace(translation=-state.translation)
        first, second = (one._replace(parameters=one.parameters * by) for one, by in ((state, 1.02), (other, 0.98)))
        starts = [first, second, behind]
        options = LMOptions(max_iterations=60)
        joined, start = BoardProblem.joined(problems, starts, CPU)
        found = joined.split(minimize(joined, start, options), problems)
        assert [result.state.translation.shape[0] for result in found] == [6, 10, 6]
        assert int(found[2].status) == SolverStatus.BAD_START
        assert math.isnan(float(found[2].cost))
        for result, problem, begin in zip(found[:2], problems, starts, strict=False):
            alone = minimize(problem, begin, options)
            assert int(result.status) == int(alone.status) == SolverStatus.CONVERGED
            assert float(result.cost) == pytest.approx(float(alone.cost), rel=1e-10)

    def test_searches_on_compressed_views(self) -> None:
        (some, more), states = self.both()
        small = self.SMALL
        problems, starts = [], []
        for views, state, count in ((some, states[0], 1), (more, states[1], 3)):
            compressed = compress(views.problem(small), state, views.observed_radius(state))
            problem = CompressedProblem(compressed, self.LARGE, free_parameters(self.LARGE), batch=(count,))
            begin = embed(state.parameters, small, self.LARGE) * torch.linspace(1.0, 1.001, count).double()[:, None]
            problems.append(problem)
            starts.append(problem.start(begin))
        joined, start = CompressedProblem.joined(problems, starts, CPU)
        costs = joined.linearize(start).cost
        alone = [p.linearize(s).cost for p, s in zip(problems, starts, strict=True)]
        torch.testing.assert_close(costs[0, 0], alone[0][0], rtol=1e-11, atol=0)
        torch.testing.assert_close(costs[1], alone[1], rtol=1e-11, atol=0)


def test_all_starts_of_a_batch_are_taken_apart() -> None:
    """Some have converged long before others; what is then left out of the work changes no answer."""
    views, state = views_of(8, 3)
    problem = views.lens_problem(LensModel.named("opencv5"), (5,))
    spread = torch.linspace(0.9, 1.3, 5, dtype=torch.float64)[:, None]
    start = map_state(lambda tensor: tensor.expand(5, *tensor.shape).clone(), state)
    start = start._replace(parameters=state.parameters * torch.cat([spread, spread, torch.ones(5, 8).double()], 1))
    options = LMOptions(tolerance=1e-12)
    found = minimize(problem, start, options)
    for i in range(5):
        own = minimize(views.lens_problem(LensModel.named("opencv5")), pick(start, i), options)
        assert abs(int(found.iterations[i]) - int(own.iterations)) <= 2
        assert float(found.cost[i]) == pytest.approx(float(own.cost), rel=1e-10)
    torch.testing.assert_close(found.history[-1], found.cost, rtol=0, atol=0)
