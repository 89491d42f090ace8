"""Small networks: closed-form derivatives equal autograd's and numeric ones."""

import pytest
import torch

from kcal.errors import InputError
from kcal.nets.inverse import evaluate, evaluate_with_slopes, initial_weights, layers

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
