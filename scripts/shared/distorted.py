"""Points of the plane z = 1 through the terms of a lens alone, for tests and measurements of those."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.lens.model import LensModel, check_coefficients, distort_components


def distort(normalized: Tensor, coefficients: Tensor, model: LensModel | str) -> Tensor:
    """Distort points on the plane z = 1 (Eq. 4, Eq. 10).

    Args:
        normalized: (..., N, 2) undistorted coordinates; for a fisheye, angles from the axis along x and y.
        coefficients: (..., P) in the order of `model.names`.
        model: a `LensModel` or the name of one.

    Returns:
        (..., N, 2) distorted coordinates, float64. They are meaningless beyond a pole or fold; `Camera.project` flags
        such points.

    Raises:
        InputError: a wrong shape or an integer dtype.

    Example:
        >>> point = torch.tensor([[0.5, 0.0]], dtype=torch.float64)
        >>> k = torch.tensor([-0.25, 0.0, 0.0, 0.0], dtype=torch.float64)
        >>> distort(point, k, "opencv4").tolist()
        [[0.46875, 0.0]]
    """
    model = LensModel.named(model)
    normalized = as_points("normalized", normalized, 2)
    lens = distort_components(
        normalized[..., 0], normalized[..., 1], check_coefficients(coefficients, model), model, slopes=False
    )
    return torch.stack([lens.x, lens.y], -1)
