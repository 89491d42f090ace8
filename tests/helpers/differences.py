"""Numeric derivatives for tests."""

from collections.abc import Callable

import torch
from torch import Tensor


def numeric(function: Callable[[Tensor], Tensor], at: Tensor, step: float) -> Tensor:
    """Fourth-order central differences of a function of a vector, output shape (*out, len(at))."""
    columns = []
    for i in range(at.numel()):
        h = torch.zeros_like(at)
        h.view(-1)[i] = step
        near, far = function(at + h) - function(at - h), function(at + 2 * h) - function(at - 2 * h)
        columns.append((8.0 * near - far) / (12.0 * step))
    return torch.stack(columns, -1)
