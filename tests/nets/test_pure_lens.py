"""The pure network lens: what it computes, its derivatives, and that Levenberg-Marquardt fits it."""

from __future__ import annotations

import pytest
import torch
from calibrate_scenes import BOARD, camera, motions, pixels_of
from torch import Tensor

from kcal.errors import InputError
from kcal.solve.lm import LMOptions, minimize
from scripts.paper.pure_lens import PureLensNet, PureLensProblem, train_pure_lens

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
    own = by_local.diagonal(dim1=0, dim2=2).permute(2, 1, 0)
    torch.testing.assert_close(rows[:, :6], own)


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
def test_bad_input_is_refused(bad: Tensor) -> None:
    with pytest.raises(InputError):
        PureLensNet(bad)
