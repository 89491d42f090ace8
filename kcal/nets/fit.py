"""Least squares over the weights of a network, for `kcal.solve`."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.nets.mlp import Widths, evaluate, evaluate_with_slopes
from kcal.solve.dense import DenseLinearization
from kcal.solve.result import State


class NetProblem:
    """Residuals net(inputs; weights) - targets. The state is one vector of weights (P,).

    Args:
        inputs: (in, N).
        targets: (out, N).
        widths: features of each stage.
    """

    batch: tuple[int, ...] = ()
    joint = False

    def __init__(self, inputs: Tensor, targets: Tensor, widths: Widths) -> None:
        self._inputs, self._targets, self._widths = inputs, targets, widths
        self.residual_count = targets.numel()

    def cost(self, state: State) -> Tensor:
        """See `Problem.cost`."""
        return 0.5 * (evaluate(self._inputs, state[0], self._widths) - self._targets).square().sum()

    def linearize(self, state: State) -> DenseLinearization:
        """See `Problem.linearize`."""
        net = evaluate_with_slopes(self._inputs, state[0], self._widths)
        residuals = (net.values - self._targets).flatten()
        # Contiguous with the weights last: what the normal equations read.
        return DenseLinearization(residuals, net.by_weights.flatten(-2).T.contiguous())

    def select(self, elements: Tensor) -> None:
        """See `Problem.select`: there is one element only."""
        return

    def retract(self, state: State, step: State) -> State:
        """Plain addition."""
        return (torch.add(state[0], step[0]),)
