"""Views that move while their rows are read, and pixels that are not square: found where they are, and only there."""

import functools
import math

import numpy as np
import pytest
import torch
from hybrid_views import views_of
from printed_boards import WIDE, middle_error
from torch import Tensor

from kcal import Board, Camera
from kcal.calibrate.hybrid.base_fit import fit_base
from kcal.calibrate.hybrid.board_modes import board_modes
from kcal.calibrate.hybrid.evidence import Amplitudes, Quadratic, ViewData, maximize_evidence, view_data
from kcal.calibrate.hybrid.families import prior_families, typical_hyperprior
from kcal.calibrate.hybrid.fit import FitOptions, HybridFit, fit_hybrid
from kcal.calibrate.hybrid.fitted_views import FittedViews, motion_is_worth, run_rounds
from kcal.calibrate.problem import board_problem
from kcal.calibrate.problem.board_problem import POSE, BoardProblem
from kcal.calibrate.problem.state import (
    AMPLITUDES,
    LARGEST,
    MEDIAN,
    MOTION,
    SMALLEST,
    BoardState,
    Readout,
    by_number,
    motion_sigma,
    stillness,
    widening,
)
from kcal.lens import LensModel, rotation_from_vector
from kcal.lens.model import HybridForm
from kcal.lens.zernike import ZernikeModes
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.schur import Products, without_local

F64 = torch.float64
BOARD = Board(columns=9, rows=7, square=0.04)
SIZE = (1280, 960)
MODES = ZernikeModes(radial=9, decentered=4, astigmatic=3, other=2)
NOISE = 0.05
# Of turns and shifts of first and second order, as they are drawn.
MOVES = (2e-3, 7e-4, 5e-4, 1e-3)
# Logarithms of deviations over the noise: of motion, and of bending.
RATIO = np.array([-3.0, -2.0, -4.0, -2.5, -1.5])


@functools.cache
def capture(amplitude: float, count: int = 12, seed: int = 1, noise: float = NOISE) -> Tensor:
    """(V, N, 2) corners of a board, each where the board stood when its row was read."""
    generator, middle, found = torch.Generator().manual_seed(seed), BOARD.points.mean(0), []
    camera = WIDE
    while len(found) < count:
        u = 2.0 * torch.rand(6, generator=generator, dtype=F64) - 1.0
        turn = rotation_from_vector(torch.stack([0.6 * u[0], 0.6 * u[1], math.pi * u[2]]))
        shift = torch.stack([0.3 * u[3], 0.2 * u[4], 0.6 + 0.1 * u[5]])
        rate = amplitude * torch.randn(2, 6, generator=generator, dtype=F64)
        pixels, valid = camera.project((BOARD.points - middle) @ turn.T + shift)
        for _ in range(8):
            time = ((pixels[:, 1] + 0.5) / SIZE[1] - 0.5)[:, None]
            step = time * rate[0] + time * time * rate[1]
            moved = rotation_from_vector(step[:, :3]) @ (BOARD.points - middle)[..., None]
            pixels, valid = camera.project(moved[..., 0] @ turn.T + shift + 0.6 * step[:, 3:])
        if bool((valid & camera.inside(pixels)).all()):
            found.append(pixels + noise * torch.randn(pixels.shape, generator=generator, dtype=F64))
    return torch.stack(found)


@functools.cache
def fitted(amplitude: float, motion: bool = True) -> HybridFit:
    return fit_hybrid(BOARD.points, capture(amplitude), SIZE, options=FitOptions(modes=MODES, motion=motion))


def test_time_runs_from_the_first_edge_to_the_last() -> None:
    rows = Readout(center=torch.zeros(3), distance=1.0, size=(640, 480))
    pixels = torch.tensor([[-0.5, -0.5], [639.5, 479.5], [319.5, 239.5], [torch.nan, torch.nan]], dtype=F64)
    assert rows.time(pixels).tolist() == [-0.5, 0.5, 0.0, 0.0]
    columns = Readout(center=torch.zeros(3), distance=1.0, size=(640, 480), columns=True)
    assert columns.time(pixels[:, [0, 1]] * torch.tensor([1.0, 0.0])).tolist() == [-0.5, 0.5, 0.0, 0.0]


def moving_problem(square: bool, bends: bool = False) -> tuple[BoardProblem, BoardState]:
    """A problem at a state where views move and the board is bent; in each of them otherwise, if it `bends`."""
    generator = torch.Generator().manual_seed(2)
    pixels = capture(2e-3, 4)
    model = LensModel(hybrid=HybridForm(shape=0.6, radius=1.1, modes=MODES))
    modes = board_modes(BOARD.points)
    shapes = modes.shapes
    count = 3 + model.size + len(shapes) + (0 if square else 1)
    heights = board_modes(BOARD.points).heights if bends else None
    readout = Readout(center=BOARD.points.mean(0), distance=0.6, size=SIZE, bends=heights)
    still = stillness(RATIO[: 5 if bends else 4], torch.tensor([0.5, 1.0, 2.0, 0.7], dtype=F64) if bends else None)
    nothing, views = (
        torch.zeros(count, dtype=F64),
        views_of(BOARD.points, modes, pixels, readout=readout, square=square),
    )
    problem = views.problem_under(model, nothing, nothing, still)
    params = torch.zeros(5 + model.size, dtype=F64)
    params[:4] = torch.tensor([800.0, 800.0 if square else 830.0, 640.0, 480.0])
    params[8:] = 1e-3 * torch.randn(len(MODES), generator=generator, dtype=F64)
    base = fitted(2e-3).state
    motion = 5e-3 * torch.randn(4, readout.numbers, generator=generator, dtype=F64)
    board = 1e-3 * torch.randn(len(shapes), generator=generator, dtype=F64)
    return problem, BoardState(params, board, base.rotation[:4], base.translation[:4], motion)


@pytest.mark.parametrize(("square", "bends"), [(True, False), (False, False), (True, True)])
def test_rows_are_derivatives_of_residuals(square: bool, bends: bool) -> None:
    """By pose, motion, bending, lens, focal lengths and board, where views move and the board is bent."""
    problem, state = moving_problem(square, bends)
    rows, local = problem.rows(state), problem.local_size
    shared = problem.shared_size
    for index in (0, 1, 3, 5, 6, 8, 10, 13, 16, 17, 18, 19, 21, 22, 30, local + shared - 29, local + shared - 1):
        step = 1e-4 if index in (local, local + 1, local + 2, local + shared - 29) else 1e-6
        both = []
        for sign in (step, -step):
            others, own = torch.zeros(shared, dtype=F64), torch.zeros(4, local, dtype=F64)
            if index < local:
                own[:, index] = sign
            else:
                others[index - local] = sign
            both.append(problem.residuals(problem.retract(state, (others, own))).flatten(1))
        # Central differences of pixels near 1000: 1e-13 of these over the step.
        torch.testing.assert_close(rows[:, index], (both[0] - both[1]) / (2.0 * step), rtol=1e-5, atol=2e-4)


@pytest.mark.parametrize("bends", [False, True])
def test_motions_are_eliminated_like_poses(bends: bool) -> None:
    """By QR with the rows of their prior, by the Schur complement, and by integrating the Gaussian model."""
    problem, state = moving_problem(True, bends)
    M = problem.local_size - POSE
    x = problem.unknowns(state)
    flat = problem.off_poses(state).transpose(0, 1).flatten(1)
    matrix, scale = problem.linearize(state).information()
    reduced = matrix / scale[:, None] / scale
    torch.testing.assert_close(flat[:-1] @ flat[:-1].T, reduced, rtol=1e-6, atol=1e-6 * float(reduced.max()))
    data, ratio = view_data(problem.products(state).off(POSE), x, state.motion, 100.0), RATIO[: 5 if bends else 4]
    data = data._replace(relative=torch.tensor([0.5, 1.0, 2.0, 0.7], dtype=F64) if bends else None)
    found = data.integrated(ratio)
    torch.testing.assert_close(found.data.K, reduced, rtol=1e-6, atol=1e-6 * float(reduced.max()))
    # Chi² at any x is that of residuals whose covariance contains the motions.
    each = without_local(problem.corner_rows(state), POSE)
    there = x + 1e-3 * torch.randn(len(x), generator=torch.Generator().manual_seed(3), dtype=F64) / scale
    spreads = by_number(ratio, data.relative).expand(4, M)
    chi2, logdet, own = 0.0, 0.0, []
    for rows, motion, spread in zip(each, state.motion, spreads, strict=True):
        mixed = (rows[:M] * spread[:, None]).T
        covariance = torch.eye(rows.shape[1], dtype=F64) + mixed @ mixed.T
        here = rows[-1] - motion @ rows[:M]
        still = here + (there - x) @ rows[M:-1]
        chi2 += float(still @ torch.linalg.solve(covariance, still))
        logdet += float(torch.logdet(covariance))
        own.append(rows[M:-1] @ torch.linalg.solve(covariance, here))
    step = there - found.data.at
    value = found.data.c - 2.0 * float(found.data.g @ step) + float(step @ found.data.K @ step)
    assert value == pytest.approx(chi2, rel=1e-9)
    assert found.log_determinant == pytest.approx(logdet, rel=1e-9)
    scale = float(data.score.abs().max())
    torch.testing.assert_close(data.scores(ratio), torch.stack(own), rtol=1e-6, atol=1e-8 * scale)


def test_products_serve_under_other_priors() -> None:
    """Of the last state, for problems with other priors; not with other weights."""
    problem, state = moving_problem(True)
    first = problem.products(state)
    other = problem.with_priors([], torch.ones(MOTION, dtype=F64))
    assert other.products(state) is first
    assert other.with_weights(torch.full((4, BOARD.corners), 0.5, dtype=F64)).products(state) is not first
    other.products(state._replace(board=0.0 * state.board))
    assert other.products(state) is not first
    torch.testing.assert_close(other.products(state).total, first.total, rtol=1e-13, atol=0.0)
    fresh = BoardProblem(
        BOARD.points, problem.pixels, problem.model, problem.free, shapes=problem.shapes, free_board=True,
        readout=problem.readout, stillness=torch.ones(MOTION, dtype=F64),
    )  # fmt: skip
    for mine, its in zip(vars(other.linearize(state)).values(), vars(fresh.linearize(state)).values(), strict=True):
        torch.testing.assert_close(mine, its)


def weighed_problem(square: bool) -> tuple[BoardProblem, BoardState]:
    """With weights, of which some are zero."""
    problem, state = moving_problem(square)
    weights = 0.3 + torch.rand(4, BOARD.corners, generator=torch.Generator().manual_seed(5), dtype=F64)
    weights[1, :9], weights[3, 20] = 0.0, 0.0
    return problem.with_weights(weights), state


@pytest.mark.parametrize("square", [True, False])
def test_rows_in_one_piece_of_memory(square: bool) -> None:
    """As those that are differentiated, which are formed column by column; of some views, too."""
    problem, state = weighed_problem(square)
    wanted = problem.rows(state._replace(parameters=state.parameters.clone().requires_grad_())).detach()
    size = float(wanted.abs().max())
    torch.testing.assert_close(problem.rows(state), wanted, rtol=1e-11, atol=1e-12 * size)
    assert float(wanted[1, :, [0, 8, BOARD.corners]].abs().max()) == 0.0
    some = slice(1, 3)
    torch.testing.assert_close(problem.rows(state, some), wanted[some], rtol=1e-11, atol=1e-12 * size)


@pytest.mark.parametrize("hidden", [0.0, 0.2, 0.8, "uneven"])
@pytest.mark.parametrize("bends", [False, True])
def test_corners_that_are_not_seen_say_nothing(
    hidden: float | str, bends: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows of the others are those of a board that is seen entirely; where few are seen, work is done on these."""
    whole, state = moving_problem(True, bends)
    share = 0.6 if hidden == "uneven" else hidden
    seen = torch.rand(4, BOARD.corners, generator=torch.Generator().manual_seed(8)) >= share
    seen[0, 10:] &= hidden != "uneven"
    weights = torch.ones(4, BOARD.corners, dtype=F64)
    readout = Readout(
        center=BOARD.points.mean(0), distance=0.6, size=SIZE, bends=board_modes(BOARD.points).heights if bends else None
    )
    problem = BoardProblem(
        BOARD.points, torch.where(seen[..., None], whole.pixels, torch.nan), whole.model, whole.free,
        shapes=whole.shapes, free_board=True, weights=weights, readout=readout, stillness=whole._still,
    )  # fmt: skip
    monkeypatch.setattr("kcal.calibrate.problem.board_problem._CHUNK", 1)
    most = int(seen.sum(1).max()) if 2 * int(seen.sum()) <= seen.numel() else BOARD.corners
    assert problem.corner_rows(state).shape[-1] == 2 * most
    assert torch.equal(problem.seen, seen)
    assert torch.equal(problem.shown(problem.pixels)[..., 0].isfinite(), problem.shown(seen))
    rows = whole.corner_rows(state) * seen.repeat(1, 2)[:, None]
    for found, wanted in zip(problem.products(state), Products.of_rows(rows, problem.local_size), strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-12 * float(wanted.abs().max()))
    reduced, off = problem.reduced_rows(state), without_local(problem.rows(state), problem.local_size)
    flat = off.transpose(0, 1).flatten(1)
    torch.testing.assert_close(reduced.T @ reduced, flat @ flat.T, rtol=1e-8, atol=1e-12 * float(flat.square().sum()))
    errors = torch.where(seen[:, None], whole.pixel_errors(state), 0.0)
    torch.testing.assert_close(problem.pixel_errors(state), errors, rtol=1e-12, atol=1e-12)
    found = problem.corner_residuals(state)
    assert torch.equal(found[..., 0].isfinite(), seen)
    torch.testing.assert_close(found.nan_to_num(0.0), errors.mT, rtol=1e-12, atol=1e-12)
    less = torch.where(seen, 0.5, 0.0).double()
    torch.testing.assert_close(problem.with_weights(less).products(state).total, 0.25 * problem.products(state).total)


def test_products_of_few_views_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """They use one piece of memory in turn; of three views, then of one."""
    problem, state = weighed_problem(True)
    rows, local = problem.corner_rows(state), problem.local_size
    columns = rows.shape[1] * rows.shape[2]
    monkeypatch.setattr("kcal.calibrate.problem.board_problem._CHUNK", 3 * columns)
    assert [len(range(*views.indices(4))) for views in problem._chunks(state)] == [3, 1]
    found = problem.products(state)
    across = rows.mT
    torch.testing.assert_close(found.local, rows[:, :local] @ across[..., :local])
    torch.testing.assert_close(found.right, rows[:, :local] @ across[..., local:])
    torch.testing.assert_close(found.score, (rows[:, local:] @ across[..., -1:])[..., 0])
    torch.testing.assert_close(found.total, (rows[:, local:] @ across[..., local:]).sum(0))


def test_corners_of_a_trial_are_projected_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its cost and its linearization share them; another state, and one that is differentiated, do not."""
    problem, state = moving_problem(True)
    calls = []
    project = board_problem.project_components
    monkeypatch.setattr(board_problem, "project_components", lambda *a: calls.append(1) or project(*a))
    cost = problem.cost(state)
    torch.testing.assert_close(problem.linearize(state).cost, cost, rtol=1e-12, atol=0.0)
    assert len(calls) == 1
    other = state._replace(translation=1.001 * state.translation)
    assert float(problem.cost(other)) != float(cost)
    assert len(calls) == 2
    followed = other._replace(parameters=other.parameters.clone().requires_grad_())
    with torch.no_grad():
        problem.cost(followed)
    assert problem.cost(followed).requires_grad


def linear_views() -> tuple[ViewData, object]:
    """Views of a Gaussian linear model whose motions are drawn with known deviations."""
    generator = torch.Generator().manual_seed(7)
    form = HybridForm(shape=0.6, radius=1.1, modes=ZernikeModes(radial=5, decentered=2, astigmatic=1, other=0))
    families = prior_families(form, 800.0, board_modes(BOARD.points), SIZE, 0.6)
    deviation = families.deviation(typical_hyperprior(form.modes).mean)
    views, residuals, size = 30, 80, len(deviation)
    lens = torch.randn(views, size, residuals, generator=generator, dtype=F64) / deviation[:, None]
    motion = 1e3 * torch.randn(views, MOTION, residuals, generator=generator, dtype=F64)
    x = deviation * torch.randn(size, generator=generator, dtype=F64)
    moves = torch.tensor(MOVES, dtype=F64).repeat_interleave(3)
    m = moves * torch.randn(views, MOTION, generator=generator, dtype=F64)
    error = torch.einsum("s,vsr->vr", x, lens) + torch.einsum("vm,vmr->vr", m, motion)
    error = -error + 0.3 * torch.randn(views, residuals, generator=generator, dtype=F64)
    rows = torch.cat([motion, lens, error[:, None]], 1)
    products, still = Products.of_rows(rows, MOTION), torch.zeros(views, MOTION, dtype=F64)
    return view_data(products, torch.zeros(size, dtype=F64), still, views * residuals), (families, form.modes)


def test_deviations_of_motions_by_evidence() -> None:
    """They come back as they were drawn."""
    data, (families, modes) = linear_views()
    prior = typical_hyperprior(modes)
    start = np.full(AMPLITUDES, math.log(MEDIAN / 0.3))
    best = maximize_evidence(data, families, Amplitudes(prior.mean, 0.2, start), prior)
    found = np.exp(best.log_ratio) * math.sqrt(best.variance)
    # 90 numbers each know their deviation to 8 %.
    assert found == pytest.approx(MOVES, rel=0.3)
    assert best.variance == pytest.approx(0.09, rel=0.1)


def test_motion_is_found_and_taken_out() -> None:
    """Its deviation as drawn, the noise, and a lens that a fit of still views does not find."""
    found, still = fitted(2e-3), fitted(2e-3, motion=False)
    assert found.motion_sigma is not None
    # Twelve views: 36 numbers each, of which poses take up a part, and of second order most.
    assert found.motion_sigma[:2] == pytest.approx((2e-3, 2e-3), rel=0.5)
    assert max(found.motion_sigma[2:]) < 4e-3
    assert found.sigma == pytest.approx(NOISE, rel=0.15)
    assert found.rms == pytest.approx(NOISE * math.sqrt(2.0), rel=0.15)
    assert middle_error(found.camera, WIDE, 0.7) < 0.5 * middle_error(still.camera, WIDE, 0.7)
    assert still.sigma > 2.0 * NOISE
    # Residuals of corners that are given again are those of the fit.
    torch.testing.assert_close(found.residuals_of(capture(2e-3)), found.residuals, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_motions_do_not_take_up_the_noise_of_many_corners() -> None:
    """20 still views of 961 corners: no motion, the noise as it is, and the focal length within its error bar."""
    board = Board(columns=31, rows=31, square=0.03)
    camera = Camera.build(focal=(1500, 1500), center=(965, 545), size=(1920, 1080), model="pinhole")
    generator = torch.Generator().manual_seed(1)
    u = torch.rand(20, 6, generator=generator, dtype=F64) - 0.5
    shift = torch.cat([0.3 * u[:, 3:5], torch.full_like(u[:, 5:], 2.5)], 1)
    placed = (board.points - board.points.mean(0)) @ rotation_from_vector(1.2 * u[:, :3]).mT + shift[:, None]
    pixels = camera.project(placed)[0]
    pixels = pixels + 0.1 * torch.randn(pixels.shape, generator=generator, dtype=F64)
    found = fit_hybrid(board.points, pixels, (1920, 1080))
    assert found.motion_sigma is None
    assert found.rms == pytest.approx(0.1 * math.sqrt(2.0), rel=0.01)
    sigma = float(found.covariance[0, 0].sqrt())
    assert sigma < 10.0
    assert abs(float(found.camera.focal[0]) - 1500.0) < 2.0 * sigma


def test_few_views_that_moved_are_less_sure(monkeypatch: pytest.MonkeyPatch) -> None:
    """All variances alike, in the covariance and in what other fits take of the camera."""
    found = fitted(2e-3)
    monkeypatch.setattr("kcal.calibrate.hybrid.fit.widening", lambda _: 1.0)
    plain = fit_hybrid(BOARD.points, capture(2e-3), SIZE, options=FitOptions(modes=MODES))
    wider = widening(12)
    assert 1.05 < wider < 1.2
    torch.testing.assert_close(found.covariance, wider * plain.covariance, rtol=1e-9, atol=0)
    ours, theirs = found.information, plain.information
    # By another way to the same: the triangle of rows is rounded.
    both = (one.covariance().diagonal() for one in (ours, theirs))
    torch.testing.assert_close(next(both), wider * next(both), rtol=1e-9, atol=0)
    torch.testing.assert_close(ours.estimate, theirs.estimate, rtol=1e-12, atol=0)
    assert [widening(n) > widening(n + 1) for n in (3, 5, 8, 30)] == [True] * 4


def test_nothing_moves_on_a_stand() -> None:
    found = fitted(0.0)
    assert found.readout is None
    assert found.motion_sigma is None
    assert found.state.motion.numel() == 0
    still = fitted(0.0, motion=False)
    # Another way to the same minimum.
    sigma = still.covariance.diagonal().sqrt()[[0, 2, 3]]
    moved = (found.camera.params - still.camera.params)[[0, 2, 3]].abs() / sigma
    assert float(moved.max()) < 0.1


def test_a_picture_that_was_turned_is_read_by_columns() -> None:
    pixels = capture(2e-3)
    turned = torch.stack([SIZE[1] - 1.0 - pixels[..., 1], pixels[..., 0]], -1)
    found = fit_hybrid(BOARD.points, turned, SIZE[::-1], options=FitOptions(modes=MODES))
    assert found.readout is not None
    assert found.readout.columns
    assert not fitted(2e-3).readout.columns  # type: ignore[union-attr]
    assert found.sigma == pytest.approx(fitted(2e-3).sigma, rel=1e-3)


@pytest.mark.parametrize("aspect", [0.75, 1.02])
def test_a_stretched_picture(aspect: float) -> None:
    """Rows of an image that was resized."""
    pixels = capture(0.0).clone()
    pixels[..., 1] = (pixels[..., 1] + 0.5) * aspect - 0.5
    found = fit_hybrid(BOARD.points, pixels, (SIZE[0], round(SIZE[1] * aspect)), options=FitOptions(modes=MODES))
    fx, fy, _, cy = found.camera.params[:4].tolist()
    assert not found.square
    covariance = found.covariance[:2, :2]
    slope = torch.tensor([-fy / fx**2, 1.0 / fx], dtype=F64)
    sigma = math.sqrt(float(slope @ covariance @ slope))
    assert sigma < 2e-3
    assert abs(fy / fx - aspect) < 4.0 * sigma
    assert cy == pytest.approx((476 + 0.5) * aspect - 0.5, abs=3.0)


def test_square_pixels_stay_square() -> None:
    for found in (fitted(0.0), fitted(2e-3)):
        assert found.square
        assert torch.equal(found.camera.params[0], found.camera.params[1])
        # Products of equal columns, which a matrix product need not sum in the same order.
        torch.testing.assert_close(found.covariance[0], found.covariance[1], rtol=1e-12, atol=0)


def test_unknowns_of_two_focal_lengths() -> None:
    problem, state = moving_problem(False)
    own = problem.unknowns(state)[: len(problem.free)]
    assert own[0] == state.parameters[0]
    assert own[-1] == state.parameters[1]
    torch.testing.assert_close(problem.free.expand(own), state.parameters[list(problem.free.indices)])
    # A robust weight of zero leaves a corner out; motions keep their prior.
    weights = torch.ones(4, BOARD.corners, dtype=F64)
    weights[0] = 0.0
    assert float(problem.with_weights(weights).corner_rows(state)[0].abs().max()) == 0.0
    result = minimize(problem.with_weights(0.0 * weights), state, LMOptions(max_iterations=3))
    assert float(result.state[4].abs().max()) < 1e-9


def test_numbers_of_a_motion() -> None:
    """Standard deviations from ratios, and how many pixels they move a corner, first and second order together."""
    sigma = motion_sigma(np.log([2.0, 3.0, 4.0, 5.0]), 0.25)
    assert sigma == pytest.approx((1.0, 1.5, 2.0, 2.5))
    # The second order covers a quarter: turns of hypot(1, .5), shifts of hypot(1.5, .625), at half a distance.
    expected = 800.0 * math.hypot(math.hypot(1.5, 0.625), 0.5 * math.hypot(1.0, 0.5))
    assert sigma.moved(800.0, 0.5) == pytest.approx(expected)
    readout = Readout(center=torch.tensor([1.0, 0.0, 0.0]), distance=2.0, size=SIZE)
    assert readout.reach(torch.tensor([[1.0, 1.0, 0.0], [4.0, 4.0, 0.0], [1.5, 0.0, 0.0]])) == pytest.approx(2.5)


def test_limits_of_motions() -> None:
    data, (families, modes) = linear_views()
    prior = typical_hyperprior(modes)
    wild = ViewData(data.still, data.own * 1e-6, data.cross * 1e-3, data.score)
    best = maximize_evidence(
        wild, families, Amplitudes(prior.mean, 0.09, np.full(AMPLITUDES, math.log(MEDIAN / 0.3))), prior
    )
    # Motions a thousand times as large come to the limit, which refers to the noise before.
    assert float((np.exp(best.log_ratio) * 0.3).max()) <= LARGEST * (1 + 1e-9)
    assert float((np.exp(best.log_ratio) * 0.3).min()) >= SMALLEST * (1 - 1e-9)
    assert isinstance(wild.still, Quadratic)


@pytest.mark.parametrize(("rate", "worth"), [(2e-3, True), (0.0, False)])
def test_motion_is_looked_for_beside_a_fit_of_views_that_stand_still(rate: float, worth: bool) -> None:
    pixels, points = capture(rate, 8), BOARD.points
    weights, board = torch.ones_like(pixels[..., 0]), board_modes(BOARD.points)
    views = FittedViews(
        points=points, board=board, pixels=pixels, size=SIZE, weights=weights, hyperprior=typical_hyperprior(MODES)
    )
    estimate, _ = fit_base(views, MODES)
    rounds = run_rounds(views, estimate, cold=True, rough=True)
    distance = float(estimate.state.translation.norm(dim=-1).median())
    assert motion_is_worth(rounds, Readout(center=points.mean(0), distance=distance, size=SIZE)) is worth


@pytest.mark.parametrize("columns", [False, True])
def test_corners_are_read_again_where_a_state_shows_them_elsewhere(columns: bool) -> None:
    """Not for less than asked for: what is known of a problem would be lost."""
    camera, points = WIDE, BOARD.points - BOARD.points.mean(0)
    shift = torch.tensor([0.0, 0.0, 0.7], dtype=F64).expand(3, 3)
    state = BoardState.flat(camera.params.detach(), torch.eye(3, dtype=F64).expand(3, 3, 3), shift)
    state = state._replace(motion=torch.zeros(3, MOTION, dtype=F64))
    shown = camera.project(points + shift[:, None])[0].detach()
    readout = Readout(center=torch.zeros(3, dtype=F64), distance=0.7, size=SIZE, columns=columns)
    # Of one view alone.
    problem = BoardProblem(
        points, shown + torch.tensor([[[0.0]], [[3.0]], [[0.0]]]), camera.model, [0], readout=readout
    )
    assert problem.read_as_shown(state, 3.1) is problem
    for beyond in (0.0, 2.9):
        again = problem.read_as_shown(state, beyond)
        assert again is not problem
        torch.testing.assert_close(again._time, readout.time(shown))
        assert again.read_as_shown(state, 1e-6) is again
