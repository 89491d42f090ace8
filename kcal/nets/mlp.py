"""Small fully connected networks as functions of one vector of weights, with closed-form Jacobians.

Convention: features come first and points last, (..., F, N), as everywhere inside kcal. Hidden layers are tanh, so that
a network is smooth; the last layer is linear. The weights of all layers are one vector: of each layer the matrix
(out, in) row by row, then the bias (out,). `widths` are the features of each stage: (2, 8, 8, 2) has three layers.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.errors import InputError

Widths = tuple[int, ...]
# Spread of the first layer's weights, whose inputs lie in [-1, 1], and of the hidden biases.
_FIRST, _BIAS = 1.5, 0.5


class NetValues(NamedTuple):
    """Values (..., out, N); their derivatives by the inputs (..., in, out, N) and by the weights (..., P, out, N)."""

    values: Tensor
    by_input: Tensor
    by_weights: Tensor


def weight_count(widths: Widths) -> int:
    """How many weights a network has.

    Example:
        >>> weight_count((2, 8, 8, 2))
        114
    """
    return sum(out * (inside + 1) for inside, out in itertools.pairwise(widths))


def initial_weights(widths: Widths, seed: int = 0) -> Tensor:
    """Random hidden layers and a last layer of zeros: the network's value is zero everywhere.

    Raises:
        InputError: fewer than two stages, or a stage without features.
    """
    if len(widths) < 2 or min(widths) < 1:
        raise InputError(f"network: at least two stages of at least one feature are needed, got {widths}")
    generator = torch.Generator().manual_seed(seed)
    parts = []
    for layer, (inside, out) in enumerate(itertools.pairwise(widths)):
        matrix = torch.randn(out, inside, generator=generator, dtype=torch.float64) * inside**-0.5
        bias = torch.randn(out, generator=generator, dtype=torch.float64) * _BIAS
        if layer == 0:
            matrix = matrix * _FIRST
        if layer == len(widths) - 2:
            matrix, bias = torch.zeros_like(matrix), torch.zeros_like(bias)
        parts += [matrix.flatten(), bias]
    return torch.cat(parts)


def layers(weights: Tensor, widths: Widths) -> list[tuple[Tensor, Tensor]]:
    """The weights (P,) as one matrix (out, in) and bias (out, 1) a layer."""
    found, place = [], 0
    for inside, out in itertools.pairwise(widths):
        end = place + out * inside
        found.append((weights[place:end].unflatten(0, (out, inside)), weights[end : end + out, None]))
        place = end + out
    return found


def evaluate(inputs: Tensor, weights: Tensor, widths: Widths) -> Tensor:
    """The network's values (..., out, N) at inputs (..., in, N)."""
    *hidden, (matrix, bias) = layers(weights, widths)
    values = inputs
    for inner, offset in hidden:
        values = torch.tanh(inner @ values + offset)
    return matrix @ values + bias


def evaluate_with_slopes(inputs: Tensor, weights: Tensor, widths: Widths) -> NetValues:
    """As `evaluate`, with derivatives by the inputs and by every weight, by the chain rule from the last layer back."""
    stack = layers(weights, widths)
    stages = [inputs]
    for matrix, bias in stack[:-1]:
        stages.append(torch.tanh(matrix @ stages[-1] + bias))
    matrix, bias = stack[-1]
    values = matrix @ stages[-1] + bias
    out, count = values.shape[-2:]
    # Derivative of each value by the sums that enter a stage, (..., stage, out, N).
    slope = torch.eye(out, dtype=values.dtype, device=values.device)[..., None].expand(
        *values.shape[:-2], out, out, count
    )
    columns = []
    for stage, (matrix, _) in zip(reversed(stages), reversed(stack), strict=True):
        by_matrix = slope[..., :, None, :, :] * stage[..., None, :, None, :]
        columns.append(torch.cat([by_matrix.flatten(-4, -3), slope], -3))
        slope = torch.einsum("oi,...okn->...ikn", matrix, slope)
        if stage is not inputs:
            slope = slope * (1.0 - stage * stage)[..., None, :]
    return NetValues(values, slope, torch.cat(columns[::-1], -3))
