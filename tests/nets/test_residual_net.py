"""Eq. 11 read literally: a constant offset, with no more to fit than the parameters have."""

from __future__ import annotations

import pytest
import torch
from calibrate_scenes import SIZE, camera
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.nets.inverse import initial_weights
from kcal.nets.joint import ResidualNet


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


def test_slopes_are_those_of_autograd_and_numeric_ones() -> None:
    start = start_of("opencv14")
    residual = ResidualNet(start, hidden=3)
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


def test_bad_input_is_refused() -> None:
    start = start_of()
    with pytest.raises(InputError, match="single"):
        ResidualNet(Camera(start.params.expand(2, -1), size=start.size, model=start.model))
    with pytest.raises(InputError, match="distortion vector"):
        ResidualNet(Camera.build(focal=(100, 100), center=(50, 50), size=(100, 100), model="pinhole"))


def test_state_and_precision() -> None:
    start = start_of()
    residual, other = ResidualNet(start), ResidualNet(start, seed=1)
    residual.weights.copy_(random_weights(residual, 4))
    other.load_state_dict(residual.state_dict())
    assert torch.equal(other.half()(), residual())
    assert torch.equal(residual.weights, other.weights)
    assert residual.weights.numel() == len(initial_weights(residual.widths))
