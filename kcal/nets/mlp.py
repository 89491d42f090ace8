"""Small fully connected networks as functions of one vector of weights, and the fit that all of them share."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import torch
from torch import Tensor, nn

from kcal.checks import StatedModule
from kcal.errors import InputError
from kcal.solve.lm import DenseLinearization, DenseProblem, LMOptions, minimize
from kcal.solve.problem import Problem, Result, State

# Small fully connected networks as functions of one vector of weights, with closed-form Jacobians.
#
# Convention: features come first and points last, (..., F, N). Hidden layers are tanh, the last layer is linear.
# `widths` lists the features of each stage: (2, 8, 8, 2) has three layers. All weights are one vector: for each layer
# the matrix (out, in) row by row, then the bias (out,).

Widths = tuple[int, ...]
# Standard deviations of the initial first-layer weights, whose inputs lie in [-1, 1], and of the hidden biases: wide
# enough for tanh to bend, narrow enough not to saturate.
_FIRST_SPREAD, _BIAS_SPREAD = 1.5, 0.5


class NetValues(NamedTuple):
    """Values (..., out, N); their derivatives by the inputs (..., in, out, N) and by the weights (..., P, out, N)."""

    values: Tensor
    by_input: Tensor
    by_weights: Tensor


class Network(StatedModule):
    """Base of networks: one vector of float64 weights, without gradients until asked."""

    weights: Tensor

    def __init__(self, widths: Widths, weights: Tensor) -> None:
        super().__init__()
        self.widths = widths
        self.weights = nn.Parameter(weights, requires_grad=False)

    @property
    def constants(self) -> object:
        """Widths of the layers."""
        return self.widths


def weight_count(widths: Widths) -> int:
    """Return the number of weights of a network.

    Example:
        >>> weight_count((2, 8, 8, 2))
        114
    """
    return sum(out * (inside + 1) for inside, out in itertools.pairwise(widths))


def initial_weights(widths: Widths, seed: int = 0) -> Tensor:
    """Draw random hidden layers and a last layer of zeros, so that the network's value is zero everywhere.

    Raises:
        InputError: fewer than two stages, or a stage without features.
    """
    if len(widths) < 2 or min(widths) < 1:
        raise InputError(f"network: at least two stages of at least one feature are needed, got {widths}")
    generator = torch.Generator().manual_seed(seed)
    parts = []
    for layer, (inside, out) in enumerate(itertools.pairwise(widths)):
        matrix = torch.randn(out, inside, generator=generator, dtype=torch.float64) * inside**-0.5
        bias = torch.randn(out, generator=generator, dtype=torch.float64) * _BIAS_SPREAD
        if layer == 0:
            matrix = matrix * _FIRST_SPREAD
        if layer == len(widths) - 2:
            matrix, bias = torch.zeros_like(matrix), torch.zeros_like(bias)
        parts += [matrix.flatten(), bias]
    return torch.cat(parts)


def layers(weights: Tensor, widths: Widths) -> list[tuple[Tensor, Tensor]]:
    """Split weights (P,) into one matrix (out, in) and bias (out, 1) per layer."""
    found, place = [], 0
    for inside, out in itertools.pairwise(widths):
        end = place + out * inside
        found.append((weights[place:end].unflatten(0, (out, inside)), weights[end : end + out, None]))
        place = end + out
    return found


def evaluate(inputs: Tensor, weights: Tensor, widths: Widths) -> Tensor:
    """Evaluate the network: values (..., out, N) at inputs (..., in, N)."""
    *hidden, (matrix, bias) = layers(weights, widths)
    values = inputs
    for inner, offset in hidden:
        values = torch.tanh(inner @ values + offset)
    return matrix @ values + bias


def evaluate_with_slopes(inputs: Tensor, weights: Tensor, widths: Widths) -> NetValues:
    """As `evaluate`, with derivatives by the inputs and by every weight (backpropagation in closed form)."""
    stack = layers(weights, widths)
    stages = [inputs]
    for matrix, bias in stack[:-1]:
        stages.append(torch.tanh(matrix @ stages[-1] + bias))
    matrix, bias = stack[-1]
    values = matrix @ stages[-1] + bias
    out, count = values.shape[-2:]
    # Derivative of each value by the sums that enter a stage, (..., stage, out, N).
    identity = torch.eye(out, dtype=values.dtype, device=values.device)
    slope = identity[..., None].expand(*values.shape[:-2], out, out, count)
    columns = []
    for stage, (matrix, _) in zip(reversed(stages), reversed(stack), strict=True):
        by_matrix = slope[..., :, None, :, :] * stage[..., None, :, None, :]
        columns.append(torch.cat([by_matrix.flatten(-4, -3), slope], -3))
        slope = torch.einsum("oi,...okn->...ikn", matrix, slope)
        if stage is not inputs:
            slope = slope * (1.0 - stage * stage)[..., None, :]
    return NetValues(values, slope, torch.cat(columns[::-1], -3))


# The fit that all networks share: least squares over their weights by Levenberg-Marquardt.


@torch.no_grad()
def fit_weights(net: Network, problem: Problem, start: State, options: LMOptions | None = None) -> Result:
    """Minimize a problem whose states begin with the network's weights, and copy the weights found into `net`."""
    result = minimize(problem, start, options)
    net.weights.copy_(result.state[0])
    return result


class RegressionProblem(DenseProblem):
    """Residuals net(inputs) - targets, with the Jacobian in closed form. The state is the vector of weights (P,).

    Args:
        inputs: (in, N).
        targets: (out, N).
        widths: features of each stage.
    """

    def __init__(self, inputs: Tensor, targets: Tensor, widths: Widths) -> None:
        super().__init__(lambda weights: (evaluate(inputs, weights, widths) - targets).flatten(), ())
        self._inputs, self._targets, self._widths = inputs, targets, widths

    def linearize(self, state: State) -> DenseLinearization:
        """See `Problem.linearize`."""
        net = evaluate_with_slopes(self._inputs, state[0], self._widths)
        residuals = (net.values - self._targets).flatten()
        self.residual_count = len(residuals)
        # Contiguous with the weights last, as the normal equations read it.
        return DenseLinearization(residuals, net.by_weights.flatten(-2).T.contiguous())
