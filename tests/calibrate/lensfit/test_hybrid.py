"""Hybrid calibration: forms are the views, stacking is a minimum, the gate tells a field from noise."""

from __future__ import annotations

import copy
import dataclasses
import functools

import pytest
import torch
from torch import Tensor

from kcal.calibrate.bundle.board_problem import BoardProblem, BoardState
from kcal.calibrate.bundle.poses import refine_poses
from kcal.calibrate.bundle.views import Views
from kcal.calibrate.lensfit.held_out import group_views, without_border
from kcal.calibrate.lensfit.hybrid import HybridOptions, HybridResult, calibrate_hybrid
from kcal.calibrate.lensfit.quadratic_forms import linearize_views
from kcal.calibrate.lensfit.stacking import CANDIDATES, FieldPrior, simplex_minimum, stack_weights
from kcal.corners.board import Board
from kcal.corners.observations import Observations, View
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.hybrid import HybridCamera
from kcal.lens.pose import rotation_from_vector
from kcal.lens.residual import Field, FieldGrid, FieldResidual
from kcal.solve.lm import LMOptions

SIZE = (640, 480)
BOARD = Board(columns=8, rows=6, square=0.04)
EXACT = LMOptions(max_iterations=50, tolerance=1e-14)


def lens(field: float) -> Camera:
    """A camera, with a smooth correction of `field` pixels if that is not zero."""
    camera = Camera.build(focal=(500, 502), center=(322, 238), size=SIZE, coefficients=[-0.2, 0.05])
    if not field:
        return camera
    grid = FieldGrid.covering((-0.65, -0.5), (0.65, 0.5), widths=[0.25])
    weights = torch.randn(2, grid.count, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    return HybridCamera.of(camera, FieldResidual(grid, weights * field / 500))


@functools.cache
def views(camera_field: float, noise: float, count: int, seed: int = 0) -> tuple[Observations, Tensor, Tensor]:
    """Views whose boards fill different parts of the image, and their poses."""
    camera = lens(camera_field)
    generator = torch.Generator().manual_seed(seed)
    found: list[View] = []
    rotations, translations = [], []
    middle = BOARD.points.mean(0)
    while len(found) < count:
        turn = rotation_from_vector((torch.rand(3, dtype=torch.float64, generator=generator) - 0.5) * 1.2)
        depth = 0.45 + 0.3 * float(torch.rand((), generator=generator))
        aim = (torch.rand(2, dtype=torch.float64, generator=generator) - 0.5) * torch.tensor([0.9, 0.6])
        shift = torch.cat([aim * depth, torch.tensor([depth], dtype=torch.float64)]) - turn @ middle
        pixels, valid = camera.project(BOARD.points @ turn.T + shift)
        if not bool((valid & camera.inside(pixels)).all()):
            continue
        pixels = pixels + noise * torch.randn(pixels.shape, dtype=torch.float64, generator=generator)
        found.append(View(name=f"{len(found):02d}", pixels=tuple((u, v) for u, v in pixels.tolist())))
        rotations.append(turn)
        translations.append(shift)
    return (
        Observations(board=BOARD, image_size=SIZE, views=tuple(found)),
        torch.stack(rotations),
        torch.stack(translations),
    )


def setting(count: int = 10) -> tuple[BoardProblem, BoardState, FieldGrid]:
    seen, rotation, translation = views(0.0, 0.1, count)
    camera = lens(0.0)
    views_of = Views(board_points=BOARD.points, pixels=seen.pixels(), free_warp=True)
    state = BoardState.flat(camera.params, rotation, translation)
    state, _ = refine_poses(views_of, camera.model, state, EXACT)
    return (
        views_of.problem(camera.model, [0, 1, 2, 3, 5, 6]),
        state,
        FieldGrid.covering((-0.65, -0.5), (0.65, 0.5), widths=[0.3]),
    )


class TestForms:
    def test_predict_the_cost_with_poses_solved_again(self) -> None:
        problem, state, grid = setting()
        zero = torch.zeros(2, grid.count, dtype=torch.float64)
        forms = linearize_views(problem, state, Field(grid, zero), [4, 6])
        step = 0.2 * torch.randn(len(forms.groups[0]), dtype=torch.float64, generator=torch.Generator().manual_seed(1))
        step[2 : forms.lens] = 0.0
        step[:2] = torch.tensor([0.3, -0.2])
        step[-1] = 1.0
        after = problem.retract(state, (step[: forms.lens], torch.zeros(10, 6, dtype=torch.float64)))
        unit = float(state.parameters[:2].log().mean().exp())
        field = Field(grid, step[forms.lens : -1].unflatten(0, (2, -1)) / unit)
        given = Views(board_points=BOARD.points, pixels=problem.pixels)
        _, cost = refine_poses(given, problem.model, after, EXACT, field)
        true = torch.stack([2 * cost[:4].sum(), 2 * cost[4:].sum()])
        predicted = torch.stack([step @ form @ step for form in forms.groups])
        at_start = forms.groups[:, -1, -1]
        assert float((true / at_start).min()) > 1.5  # a real change
        # Second order in the step is left: poses that turn, and the field that moves with what it moves.
        torch.testing.assert_close(predicted - at_start, true - at_start, rtol=0.05, atol=0)

    @pytest.mark.parametrize("alike", [True, False])
    def test_are_the_rows_with_poses_projected_out(self, alike: bool) -> None:
        problem, state, grid = setting(6)
        state.parameters[4] = 3.0  # skew: a shift along y moves both coordinates
        seen = torch.rand(6, 48, generator=torch.Generator().manual_seed(7)) < 0.8
        pixels = torch.where(seen[..., None], problem.pixels, torch.nan)
        root = torch.tensor([[2.0, 0.0], [0.0, 2.0]] if alike else [[2.0, 0.5], [0.0, 1.0]], dtype=torch.float64)
        free = [0, 1, 2, 3, 5, 6]
        each = torch.rand(6, 48, 1, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(8))
        weighed = root * (1.0 + each)
        problem, inner = (
            BoardProblem(BOARD.points, p, problem.model, free, free_warp=True, whitening=weighed)
            for p in (problem.pixels, pixels)
        )
        field = Field(grid, torch.zeros(2, grid.count, dtype=torch.float64))
        forms = linearize_views(problem, state, field, [6], inner)

        def residuals(given: BoardProblem, shared: Tensor, weights: Tensor, local: Tensor) -> Tensor:
            moved = copy.copy(given)
            moved.field = Field(grid, weights.unflatten(0, (2, -1)) / unit)
            return moved.residuals(given.retract(state, (shared, local))).flatten()

        unit = state.parameters[:2].log().mean().exp()
        zero = torch.zeros(8).double(), torch.zeros(2 * grid.count).double(), torch.zeros(6, 6).double()
        for given, form in ((problem, forms.groups[0]), (inner, forms.inner[0])):
            blocks = torch.func.jacfwd(functools.partial(residuals, given), (0, 1, 2))(*zero)
            pose = blocks[2].flatten(1)
            rows = torch.cat([blocks[0], blocks[1], residuals(given, *zero)[:, None]], 1)
            left = rows - pose @ torch.linalg.lstsq(pose, rows).solution
            scale = torch.sqrt(form.diagonal()[:, None] * form.diagonal())
            torch.testing.assert_close(left.T @ left / scale, form / scale, rtol=0, atol=1e-9)

    def test_fit_is_the_minimum_under_the_prior(self) -> None:
        problem, state, grid = setting()
        weights = 1e-5 * torch.randn(2, grid.count, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
        problem.field = Field(grid, weights)
        forms = linearize_views(problem, state, Field(grid, weights), [5, 5])
        form = forms.total(torch.ones(2, dtype=torch.bool))
        precision = torch.full((2 * grid.count,), 3.0, dtype=torch.float64)
        precision[::3] = torch.inf
        step = forms.fit(form, precision)
        now = forms.weights + step[forms.lens : -1]
        assert float(now[::3].abs().max()) == 0.0
        gradient = (form @ step)[:-1]
        kept = torch.isfinite(precision)
        gradient[forms.lens :][kept] += 3.0 * now[kept]
        gradient[forms.lens :][~kept] = 0.0
        scale = form.diagonal()[:-1].sqrt() * form[-1, -1].sqrt()
        assert float((gradient / scale).abs().max()) < 1e-8

    def test_effective_number(self) -> None:
        problem, state, grid = setting()
        zero = torch.zeros(2, grid.count, dtype=torch.float64)
        forms = linearize_views(problem, state, Field(grid, zero), [5, 5])
        form = forms.total(torch.ones(2, dtype=torch.bool))
        free = [forms.freedom(form, torch.full((2 * grid.count,), p, dtype=torch.float64)) for p in (1e-9, 1.0, 1e9)]
        # Two shifts, two scales and two radial terms are the lens's.
        assert free[0] == pytest.approx(2 * grid.count, abs=12)
        assert free[0] > free[1] > free[2] >= 0
        assert free[2] < 1e-3
        assert forms.freedom(form, torch.full((2 * grid.count,), torch.inf, dtype=torch.float64)) == 0.0


class TestStacking:
    def test_one_candidate_takes_all(self) -> None:
        torch.testing.assert_close(simplex_minimum(torch.tensor([[3.0]], dtype=torch.float64)), torch.ones(1).double())

    def test_simplex_minimum_is_one(self) -> None:
        generator = torch.Generator().manual_seed(3)
        for _ in range(10):
            root = torch.randn(6, 6, dtype=torch.float64, generator=generator) + 2.0
            matrix = root @ root.T
            weights = simplex_minimum(matrix)
            assert float(weights.sum()) == pytest.approx(1.0, abs=1e-12)
            assert float(weights.min()) >= 0.0
            # Optimal: no candidate's slope lies below the slope of those that are used.
            slope = matrix @ weights
            assert float(slope.min()) >= float(weights @ slope) * (1 - 1e-6)

    def test_precision_grows_as_widths_shrink(self) -> None:
        grid = FieldGrid.covering((-1.0, -0.6), (1.0, 0.6), widths=[0.8, 0.4])
        precision = FieldPrior(3.0, 1).precision(grid, 1.0)
        count = grid.scales[0].count
        assert precision[:count].unique().tolist() == [3.0]
        assert precision[count : grid.count].unique().tolist() == pytest.approx([12.0])
        assert torch.equal(precision[: grid.count], precision[grid.count :])
        assert bool(FieldPrior(torch.inf).precision(grid, 1.0).isinf().all())

    def test_a_form_without_a_minimum_leaves_no_field(self) -> None:
        problem, state, grid = setting()
        forms = linearize_views(problem, state, Field(grid, torch.zeros(2, grid.count, dtype=torch.float64)), [2] * 5)
        broken = dataclasses.replace(forms, groups=-forms.groups, inner=-forms.groups)
        precisions = [prior.precision(grid, 0.65) for prior in CANDIDATES]
        weights = stack_weights(broken, torch.ones(5, dtype=torch.bool), precisions)
        assert weights.tolist() == [1.0] + [0.0] * (len(CANDIDATES) - 1)

    def test_weights_are_those_of_training_groups_alone(self) -> None:
        problem, state, grid = setting()
        zero = torch.zeros(2, grid.count, dtype=torch.float64)
        forms = linearize_views(problem, state, Field(grid, zero), [2] * 5)
        precisions = [prior.precision(grid, 0.65) for prior in CANDIDATES]
        chosen = torch.tensor([True, True, True, True, False])
        weights = stack_weights(forms, chosen, precisions)
        spoilt = dataclasses.replace(forms, groups=forms.groups.clone())
        spoilt.groups[4] *= 1e6
        assert torch.equal(stack_weights(spoilt, chosen, precisions), weights)


@functools.cache
def solved(field: float, gate: bool = True) -> HybridResult:
    seen, *_ = views(field, 0.05, 20)
    options = HybridOptions(models=("opencv5",), rivals=("opencv5",), widths=(1.2, 0.6, 0.3), gate=gate)
    return calibrate_hybrid(seen, options)


class TestCalibration:
    def test_a_field_is_found_and_kept(self) -> None:
        result = solved(0.7)
        camera, truth = result.calibration.camera, lens(0.7)
        assert result.kept
        assert isinstance(camera, HybridCamera)
        assert result.held_out["hybrid"] < 0.6 * result.held_out["opencv5"]
        # Nearer to the truth than what noise and the parametric lens leave: fresh views say so.
        fresh, rotation, translation = views(0.7, 0.0, 12, seed=9)
        given, errors = Views(board_points=BOARD.points, pixels=fresh.pixels()), {}
        rival = solved(0.7, False).held_out
        assert rival == pytest.approx(result.held_out, rel=1e-6)
        for name, one in (("hybrid", camera), ("truth", truth)):
            state = BoardState.flat(one.params.detach(), rotation, translation)
            _, cost = refine_poses(given, one.model, state, EXACT, one.field)
            errors[name] = float((2 * cost.sum() / (12 * 48)) ** 0.5)
        assert errors["truth"] < 1e-9
        assert errors["hybrid"] < 0.12
        assert result.effective > 10
        assert 0.7 < result.largest < 10

    def test_rms_is_that_of_the_camera(self) -> None:
        result = solved(0.7).calibration
        seen, *_ = views(0.7, 0.05, 20)
        points = BOARD.points @ result.cam_from_board_rotation.mT + result.cam_from_board_translation[:, None]
        errors = result.camera.project(points)[0] - seen.pixels()
        assert result.rms == pytest.approx(float(errors.square().sum(-1).mean().sqrt()), rel=1e-9)
        torch.testing.assert_close(result.residuals, errors, rtol=0, atol=1e-9)

    def test_a_parametric_lens_stays_parametric(self) -> None:
        result = solved(0.0)
        assert not result.kept
        assert type(result.calibration.camera) is Camera
        assert "no better than" in result.reason
        assert result.choice == "opencv5"
        # Nor does the hybrid do harm where it is asked for in any case.
        forced = solved(0.0, False)
        assert isinstance(forced.calibration.camera, HybridCamera)
        assert forced.held_out["hybrid"] < 1.02 * forced.held_out["opencv5"]

    def test_alone_nothing_is_compared(self) -> None:
        seen, *_ = views(0.7, 0.05, 20)
        options = HybridOptions(models=("opencv5",), rivals=(), widths=(1.2, 0.6, 0.3), gate=False)
        result = calibrate_hybrid(seen, options)
        assert result.held_out == {}
        assert result.kept
        same = solved(0.7).calibration
        assert result.calibration.rms == pytest.approx(same.rms, rel=1e-7)

    def test_the_border_is_as_deep_as_what_nobody_saw(self) -> None:
        axis = torch.linspace(40.0, 560.0, 27, dtype=torch.float64)
        pixels = torch.cartesian_prod(axis, axis[:20])[None]
        left = torch.isfinite(without_border(pixels, (640, 480))).all(-1)[0]
        low, high = pixels[0][left].amin(0), pixels[0][left].amax(0)
        # Seen up to 40.5 px from the left and upper edges, 79.5 from the right one, 59.5 from the lower one.
        assert low.tolist() == pytest.approx([100.0, 100.0])
        assert high.tolist() == pytest.approx([480.0, 360.0])
        # A view that would keep too little stays whole.
        few = torch.cat([pixels, torch.full_like(pixels, torch.nan)])
        few[1, :20] = pixels[0, :20]
        assert bool(torch.isfinite(without_border(few, (640, 480))[1, :20]).all())

    def test_groups(self) -> None:
        seen, *_ = views(0.0, 0.05, 20)
        assert group_views(seen, "blocks") == [list(range(i, i + 4)) for i in range(0, 20, 4)]
        assert group_views(seen, "views") == [[i] for i in range(20)]
        labels = [i % 6 for i in range(20)]
        assert group_views(seen, labels)[1] == [1, 7, 13, 19]
        with pytest.raises(InputError, match="label for each of the 20 views"):
            group_views(seen, [1, 2])
        with pytest.raises(DegenerateError, match="4 groups"):
            group_views(seen, [i % 4 for i in range(20)])
