"""The fit that all networks share: least squares over their weights by Levenberg-Marquardt."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.nets.mlp import Network, Widths, evaluate, evaluate_with_slopes
from kcal.solve.dense import DenseLinearization, DenseProblem
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.problem import Problem
from kcal.solve.result import Result, State


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
