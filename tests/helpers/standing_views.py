"""Data of views that stand still, from a quadratic form alone."""

import torch
from torch import Tensor

from kcal.calibrate.hybrid.evidence import Quadratic, ViewData


def quadratic(rows: Tensor, target: Tensor, at: Tensor) -> Quadratic:
    """Data with rows (R, S), which aim at the target (R,) from `at` (S,)."""
    K, g = rows.T @ rows, rows.T @ target[:, None]
    products = torch.cat([torch.cat([K, -g], 1), torch.cat([-g.T, (target @ target)[None, None]], 1)])
    return Quadratic(products, float(len(rows)), at)


def standing(data: Quadratic) -> ViewData:
    """A single view without motion that says this."""
    size = len(data.g)
    none = torch.zeros(1, 0, size + 1, dtype=data.K.dtype)
    return ViewData(data, none[..., :0], none, torch.zeros(1, size, dtype=data.K.dtype))
