"""Joint training, and the residual networks.

Small networks: closed-form derivatives equal autograd's and numeric ones.
"""

import functools
from unittest.mock import Mock

import pytest
import torch
from calibrate_scenes import BOARD, SIZE, camera, motions, pixels_of
from lenses import hybrid_camera
from torch import Tensor

from kcal import Camera, DegenerateError, InputError
from kcal.lens.projection import from_pixels, plane_from_points
from kcal.nets.inverse import InverseNet, evaluate, evaluate_with_slopes, initial_weights, layers, train_inverse
from kcal.nets.joint import JointFit, JointOptions, ResidualNet, _JointProblem, train_jointly
from kcal.solve import SolverStatus
from kcal.solve.lm import LMOptions, minimize
from scripts.paper.pure_lens import PureLensNet, PureLensProblem, train_pure_lens

# Eq. 12: both terms of the loss, its derivatives, and which method ends lower.


BALANCE = 0.7


@functools.cache
def corners(model: str = "opencv5") -> tuple[Camera, Tensor, Tensor]:
    """A camera that is some pixels wrong, corners (V, N, 3) in the camera frame, and their noisy pixels."""
    truth = camera(model)
    rotation, translation = poses = motions(truth, 12, 5)
    start = truth.params.detach().clone()
    start[:4] += torch.tensor([3.0, -2.0, 1.5, 2.5])
    points = BOARD.points @ rotation.transpose(-1, -2) + translation[:, None]
    return Camera(start, size=SIZE, model=model), points, pixels_of(truth, poses, noise=0.1, seed=2)


def problem_of(model: str) -> tuple[_JointProblem, tuple[Tensor, Tensor]]:
    start, points, pixels = corners(model)
    residual, inverse = ResidualNet(start, hidden=2), InverseNet(start, hidden=3, radial=False)
    weight = torch.linspace(0.5, 1.5, pixels.shape[0] * pixels.shape[1], dtype=torch.float64)
    problem = _JointProblem(residual, inverse, points.reshape(-1, 3).T, pixels.reshape(-1, 2).T, weight, BALANCE)
    generator = torch.Generator().manual_seed(1)
    state = tuple(
        0.3 * torch.randn(net.weights.shape, generator=generator, dtype=torch.float64) for net in (residual, inverse)
    )
    return problem, state  # type: ignore[return-value]


@functools.cache
def fitted(method: str) -> JointFit:
    steps = {"lm": 60, "adam": 300}[method]
    return train_jointly(*corners(), JointOptions(method=method, steps=steps, hidden=(4, 6)))  # type: ignore[arg-type]


@pytest.mark.parametrize("model", ["opencv5", "ext20", "fisheye4"])
def test_derivatives_are_those_of_autograd(model: str) -> None:
    problem, state = problem_of(model)
    rows = problem.rows(state)
    wanted = torch.func.jacrev(lambda *weights: problem.residuals(weights)[0], argnums=(0, 1))(*state)
    torch.testing.assert_close(rows[:-1].T, torch.cat(wanted, 1), rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(rows[-1], problem.residuals(state)[0])
    torch.testing.assert_close(problem.gram(state)[0], rows @ rows.T, rtol=1e-9, atol=1e-9)


def test_the_loss_is_that_of_the_paper() -> None:
    """Both mean squares from the nets themselves, corner by corner."""
    fit = fitted("lm")
    _, points, pixels = corners()
    seen = fit.camera.project(points)[0] - pixels
    assert fit.rms == pytest.approx(float(seen.square().sum(-1).mean().sqrt()), rel=1e-9)
    distorted = torch.stack(from_pixels(*fit.camera.project(points)[0].unbind(-1), fit.camera.params), -1)
    before = torch.stack(fit.inverse.net.to_chart(*plane_from_points(*points.unbind(-1), fit.camera.model)), -1)
    after = torch.stack(fit.inverse.net.to_chart(*fit.inverse.net(distorted).unbind(-1)), -1)
    undone = float(corners()[0].focal.mean()) * (after - before)
    assert fit.inverse_rms == pytest.approx(float(undone.square().sum(-1).mean().sqrt()), rel=1e-9)
    assert float(fit.losses[-1]) == pytest.approx(fit.rms**2 + fit.inverse_rms**2, rel=1e-9)
    assert float(fit.losses[0]) > fit.start_rms**2


def test_both_methods_lower_it_and_least_squares_more() -> None:
    lm, adam = fitted("lm"), fitted("adam")
    assert float(lm.losses[0]) == pytest.approx(float(adam.losses[0]), rel=1e-12)
    assert bool((lm.losses.diff() <= 0).all())
    assert bool((adam.losses.diff() <= 0).all())
    assert lm.start_rms > 3.0
    assert lm.rms < 0.16  # the noise is 0.1 px along each axis
    assert float(lm.losses[-1]) < 0.01 * float(adam.losses[-1]) < 0.01 * float(adam.losses[0])
    assert adam.inverse.status == SolverStatus.ITERATION_LIMIT
    assert (lm.inverse.iterations, adam.inverse.iterations) == (len(lm.losses) - 1, 300)


def test_the_inverse_over_the_image_is_worse_than_one_trained_there() -> None:
    joint, alone = fitted("lm").inverse, train_inverse(fitted("lm").camera)
    assert joint.rms < 0.2 * joint.start_rms
    assert alone.rms < 0.2 * joint.rms


def test_corners_that_do_not_count_change_nothing() -> None:
    start, points, pixels = corners()
    options = JointOptions(steps=3, hidden=(2, 2))
    wanted = train_jointly(start, points[1:], pixels[1:], options)
    torn, weights = pixels.clone(), torch.ones(pixels.shape[:-1])
    torn[0, ::2], weights[0, 1::2] = torch.nan, 0.0
    found = train_jointly(start, points, torn, options, weights=weights)
    assert found.rms == pytest.approx(wanted.rms, rel=1e-9)
    doubled = train_jointly(start, points, torn, options, weights=weights + weights)
    torch.testing.assert_close(doubled.losses, found.losses)


@pytest.mark.parametrize("method", ["lm", "adam"])
def test_progress_may_end_it(method: str) -> None:
    progress = Mock(side_effect=lambda step, _: step == 2)
    options = JointOptions(method=method, hidden=(2, 2))  # type: ignore[arg-type]
    fit = train_jointly(*corners(), options, progress=progress)
    told = [call.args for call in progress.call_args_list]
    assert [step for step, _ in told] == [1, 2]
    assert fit.inverse.status == SolverStatus.INTERRUPTED
    assert float(fit.losses[-1]) == pytest.approx(min(float(fit.losses[0]), *(loss for _, loss in told)))


def test_a_rate_that_is_too_large_ends_honestly() -> None:
    """The lowest loss is kept, whatever came later."""
    fit = train_jointly(*corners(), JointOptions(method="adam", rates=(1e3, 1e3), steps=30, hidden=(2, 2)))
    assert bool(fit.losses.isfinite().all())
    assert fit.rms <= fit.start_rms * (1 + 1e-12)


def test_bad_input_is_refused() -> None:
    start, points, pixels = corners()
    with pytest.raises(InputError, match="hybrid"):
        train_jointly(hybrid_camera("webcam"), points, pixels)
    with pytest.raises(InputError, match="same corners"):
        train_jointly(start, points, pixels[1:])
    with pytest.raises(DegenerateError, match="too few"):
        train_jointly(start, points[0, :4], pixels[0, :4])
    with pytest.raises(DegenerateError, match="no image"):
        train_jointly(start, -points, pixels)
    for wrong in ({"method": "sgd"}, {"steps": 0}, {"hidden": (0, 2)}, {"inverse_weight": -1.0}):
        with pytest.raises(InputError, match="JointOptions"):
            JointOptions(**wrong)  # type: ignore[arg-type]


# Eq. 11 read literally: a constant offset, with no more to fit than the parameters have.


def start_of(model: str = "opencv5") -> Camera:
    """A* and K*: a camera that is some pixels wrong."""
    start = camera(model).params.detach().clone()
    start[:4] += torch.tensor([3.0, -2.0, 1.5, 2.5])
    start[5] += 0.01
    return Camera(start, size=SIZE, model=model)


def random_weights(residual: ResidualNet, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 0.3 * torch.randn(residual.weights.shape, generator=generator, dtype=torch.float64)


def test_a_new_one_corrects_nothing_and_leaves_skew_alone() -> None:
    start = start_of()
    residual = ResidualNet(start)
    assert torch.equal(residual(), start.params)
    residual.weights.copy_(random_weights(residual, 0))
    moved = residual() - start.params
    assert float(moved[4]) == 0.0
    assert int((moved != 0).sum()) == 4 + start.model.size
    assert torch.equal(residual.camera().params, residual())


def test_inputs_are_shares_of_the_largest_coefficient_and_corrections_small_ones_of_the_camera() -> None:
    start = Camera.build(focal=(800, 820), center=(300, 200), size=SIZE, coefficients=[-0.2, 0.05, 0.0, 0.001, 0.0])
    residual = ResidualNet(start)
    assert residual.inputs[:, 0].tolist() == pytest.approx([-1.0, 0.25, 0.0, 0.005, 0.0])
    assert residual.units.tolist() == pytest.approx([0.81] * 4 + [2e-3, 5e-4, 1e-9, 1e-5, 1e-9])


def test_slopes_are_those_of_autograd_and_numeric_ones() -> None:
    residual = ResidualNet(start_of("opencv14"), hidden=3)
    weights = random_weights(residual, 1)
    wanted = torch.func.jacrev(residual.parameters_at)(weights)[list(residual.corrected)]
    torch.testing.assert_close(residual.slopes(weights), wanted)
    assert torch.autograd.gradcheck(residual.parameters_at, (weights.requires_grad_(),), atol=1e-5)


@pytest.mark.parametrize("model", ["opencv5", "ext20"])
def test_it_has_no_capacity_beyond_the_parameters(model: str) -> None:
    """However many weights: what they can do to pixels is what the parameters can."""
    start = start_of(model)
    residual = ResidualNet(start, hidden=16)
    weights = random_weights(residual, 2)
    rays, valid = start.unproject(start.grid(9, 7).reshape(-1, 2))
    assert bool(valid.all())

    def pixels(parameters: Tensor) -> Tensor:
        return torch.func.functional_call(start, {"params": parameters}, (rays,))[0]

    by_weights = torch.func.jacrev(residual.parameters_at)(weights)
    at = residual.parameters_at(weights)
    by_parameters = torch.func.jacfwd(pixels)(at).flatten(0, 1)[:, list(residual.corrected)]
    through = torch.func.jacrev(lambda w: pixels(residual.parameters_at(w)))(weights).flatten(0, 1)
    count = 4 + start.model.size
    assert residual.weights.numel() > 10 * count
    assert int(torch.linalg.matrix_rank(by_weights)) == count
    # The same column space: each is a combination of the other's columns.
    scaled = by_parameters / torch.linalg.vector_norm(by_parameters, dim=0)
    basis, _, _ = torch.linalg.svd(scaled, full_matrices=False)
    beside = through - basis @ (basis.T @ through)
    assert float(beside.abs().max()) < 1e-9 * float(through.abs().max())


def test_residual_net_refuses_bad_input() -> None:
    start = start_of()
    with pytest.raises(InputError, match="single"):
        ResidualNet(Camera(start.params.expand(2, -1), size=start.size, model=start.model))
    with pytest.raises(InputError, match="distortion vector"):
        ResidualNet(Camera.build(focal=(100, 100), center=(50, 50), size=(100, 100), model="pinhole"))


# The pure network lens: what it computes, its derivatives, and that Levenberg-Marquardt fits it.


INTRINSICS = torch.tensor([500.0, 505.0, 325.0, 236.0], dtype=torch.float64)


def scene(views: int = 8, noise: float = 0.0) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    truth = camera("opencv5")
    poses = motions(truth, views, 4)
    return pixels_of(truth, poses, noise=noise, seed=1), poses


def perturbed(lens: PureLensNet) -> Tensor:
    generator = torch.Generator().manual_seed(6)
    return lens.weights + 0.1 * torch.randn(lens.weights.shape, generator=generator, dtype=torch.float64)


def test_with_a_skip_it_begins_as_a_pinhole() -> None:
    lens = PureLensNet(INTRINSICS, skip=True, reach=0.7)
    points = torch.tensor([[0.1, -0.2, 2.0], [0.3, 0.1, 1.0], [0.1, 0.1, -1.0], [torch.nan, 0.0, 1.0]])
    pixels, valid = lens(points)
    wanted = INTRINSICS[:2] * points[:2, :2].double() / points[:2, 2:].double() + INTRINSICS[2:]
    torch.testing.assert_close(pixels[:2], wanted)
    assert valid.tolist() == [True, True, False, False]
    assert torch.equal(pixels[2:], INTRINSICS[2:].expand(2, 2))
    # Without one it begins as a random map.
    assert float((PureLensNet(INTRINSICS)(points)[0][:2] - wanted).norm()) > 50


@pytest.mark.parametrize("skip", [True, False])
def test_rows_are_the_derivatives(skip: bool) -> None:
    pixels, poses = scene(3)
    lens = PureLensNet(INTRINSICS, hidden=3, skip=skip, reach=0.8)
    problem = PureLensProblem(BOARD.points, pixels, lens)
    state = problem.start(*poses)
    state = (perturbed(lens), *state[1:])
    rows = problem.rows(state)
    shared = torch.zeros(problem.shared_size, dtype=torch.float64)
    local = torch.zeros(3, 6, dtype=torch.float64)

    def residuals(s: Tensor, p: Tensor) -> Tensor:
        return problem.residuals(problem.retract(state, (s, p)))

    by_shared, by_local = torch.func.jacfwd(residuals, argnums=(0, 1))(shared, local)
    torch.testing.assert_close(rows[:, -1], residuals(shared, local))
    torch.testing.assert_close(rows[:, 6:-1], by_shared.transpose(1, 2))
    torch.testing.assert_close(rows[:, :6], by_local.diagonal(dim1=0, dim2=2).permute(2, 1, 0))


def test_levenberg_marquardt_fits_it() -> None:
    """To the noise, from no distortion: the network is no worse an approximation than the formula it replaces."""
    pixels, poses = scene(10, noise=0.1)
    lens = PureLensNet(INTRINSICS, skip=True, reach=0.7)
    problem = PureLensProblem(BOARD.points, pixels, lens)
    start = problem.start(*poses)
    result = train_pure_lens(lens, BOARD.points, pixels, poses, LMOptions(max_iterations=60))
    rms = (4.0 * result.cost / problem.residual_count).sqrt()
    assert float((4.0 * problem.cost(start) / problem.residual_count).sqrt()) > 3.0
    assert float(rms) < 0.15

    # Its poses alone, the lens held: nothing shared is left, and the fit cannot get worse.
    alone = PureLensProblem(BOARD.points, pixels, lens, fixed=True)
    again = minimize(alone, alone.start(*poses), LMOptions(max_iterations=60))
    assert float(again.cost) == pytest.approx(float(alone.cost(result.state)), rel=1e-3)


def test_corners_behind_the_camera_have_no_cost() -> None:
    pixels, (rotation, translation) = scene(3)
    problem = PureLensProblem(BOARD.points, pixels, PureLensNet(INTRINSICS, skip=True))
    assert bool(torch.isnan(problem.cost(problem.start(rotation, -translation))))


def test_state_gradients_graphs_and_precision() -> None:
    torch.compiler.reset()
    lens, other = PureLensNet(INTRINSICS, hidden=3, seed=1), PureLensNet(2 * INTRINSICS, hidden=3, seed=2)
    other.load_state_dict(lens.state_dict())
    points = torch.tensor([[0.1, -0.2, 2.0], [0.3, 0.1, 1.0]], dtype=torch.float64, requires_grad=True)
    wanted = lens(points)
    assert torch.equal(other.half()(points)[0], wanted[0])
    compiled = torch.compile(lens, fullgraph=True, backend="eager")(points)
    torch.testing.assert_close(compiled[0], wanted[0], rtol=1e-12, atol=1e-12)
    assert torch.autograd.gradcheck(
        lambda p, w: torch.func.functional_call(lens, {"weights": w}, (p,))[0],
        (points, lens.weights.detach().requires_grad_()),
        atol=1e-4,
    )


@pytest.mark.parametrize("bad", [torch.ones(3), torch.tensor([-1.0, 1.0, 0.0, 0.0]), torch.ones(2, 4)])
def test_pure_lens_refuses_bad_input(bad: Tensor) -> None:
    with pytest.raises(InputError):
        PureLensNet(bad)


WIDTHS = [(2, 3), (2, 5, 4, 2), (3, 4, 6, 4, 1)]


def random_net(widths: tuple[int, ...], *lead: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    weights = torch.randn(len(initial_weights(widths)), generator=generator, dtype=torch.float64)
    return torch.randn(*lead, widths[0], 7, generator=generator, dtype=torch.float64), weights


@pytest.mark.parametrize("widths", WIDTHS)
def test_slopes_are_those_of_autograd(widths: tuple[int, ...]) -> None:
    inputs, weights = random_net(widths)
    net = evaluate_with_slopes(inputs, weights, widths)
    assert net.by_weights.shape == (len(weights), widths[-1], 7)
    torch.testing.assert_close(net.values, evaluate(inputs, weights, widths))
    by_weights = torch.func.jacfwd(evaluate, argnums=1)(inputs, weights, widths)
    torch.testing.assert_close(net.by_weights, by_weights.movedim(-1, 0))
    # Each point depends on itself only.
    by_input = torch.func.jacfwd(evaluate)(inputs, weights, widths).diagonal(dim1=1, dim2=3)
    torch.testing.assert_close(net.by_input, by_input.transpose(0, 1))


def test_values_and_second_derivatives_are_numeric_ones() -> None:
    inputs, weights = random_net((2, 3, 3, 2))
    arguments = (inputs[:, :2].clone().requires_grad_(), weights.requires_grad_())
    assert torch.autograd.gradcheck(lambda x, w: evaluate(x, w, (2, 3, 3, 2)), arguments)
    assert torch.autograd.gradgradcheck(lambda x, w: evaluate(x, w, (2, 3, 3, 2)), arguments)


def test_leading_dimensions() -> None:
    widths = (2, 5, 4, 2)
    inputs, weights = random_net(widths, 3, 2)
    net = evaluate_with_slopes(inputs, weights, widths)
    for i in range(3):
        for got, wanted in zip(net, evaluate_with_slopes(inputs[i, 1], weights, widths), strict=True):
            torch.testing.assert_close(got[i, 1], wanted)


def test_a_new_net_is_zero_and_seeded() -> None:
    widths = (2, 5, 4, 2)
    weights = initial_weights(widths, seed=3)
    assert not bool(evaluate(torch.randn(2, 9).double(), weights, widths).any())
    assert torch.equal(weights, initial_weights(widths, seed=3))
    assert not torch.equal(weights, initial_weights(widths, seed=4))
    assert [tuple(matrix.shape) for matrix, _ in layers(weights, widths)] == [(5, 2), (4, 5), (2, 4)]


@pytest.mark.parametrize("widths", [(2,), (2, 0, 2)])
def test_nonsense_is_refused(widths: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match="stage"):
        initial_weights(widths)
