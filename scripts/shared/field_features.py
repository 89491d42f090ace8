"""The hidden layer of a field's network, trained (Eq. 11 of the paper: position in, correction out)."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.lens.network_modes import NetworkModes
from kcal.nets.fit import RegressionProblem, fit_weights
from kcal.nets.mlp import Network, initial_weights, layers
from kcal.solve.lm import LMOptions


def train_features(
    places: Tensor, corrections: Tensor, count: int = 40, seed: int = 0, iterations: int = 100
) -> NetworkModes:
    """Train a network with one hidden layer on corrections of a first fit, and keep its hidden layer.

    The last layer is fitted again by `fit_hybrid`, together with lens, pupil, board and poses.

    Args:
        places: (N, 2) on the unit disc of the hybrid lens.
        corrections: (N, 2) what the field should be there: that of the first fit and its residuals, in any unit.
        count: number of features.
        seed: of the initial weights.
        iterations: maximum number of trial steps of Levenberg-Marquardt.

    Raises:
        InputError: places or corrections of a wrong shape.

    Example:
        >>> places = 2.0 * torch.rand(300, 2, dtype=torch.float64) - 1.0
        >>> modes = train_features(places, torch.sin(3.0 * places), count=6)
        >>> len(modes)
        12
    """
    inputs, targets = as_points("places", places, 2).T, as_points("corrections", corrections, 2).T
    widths = (2, count, 2)
    net = Network(widths, initial_weights(widths, seed))
    unit = targets.square().mean().sqrt().clamp(min=1e-300)
    problem = RegressionProblem(inputs, targets / unit, widths)
    options = LMOptions(max_iterations=iterations, tolerance=1e-6)
    fit_weights(net, problem, (net.weights.detach(),), options)
    (matrix, bias), _ = layers(net.weights.detach(), widths)
    return NetworkModes.hidden_layer(torch.cat([matrix, bias], 1).tolist())
