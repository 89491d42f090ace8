"""Weights of residuals, from the covariances of corners."""

from __future__ import annotations

import torch
from torch import Tensor


def whitening(covariances: Tensor, variance: float) -> Tensor:
    """Matrices that make residuals of unequal corners equally uncertain.

    Residuals of a calibration contain more than the noise of the corners: boards are not flat and lenses differ from
    their models. So the same variance is added to every corner, as much as the residuals have beyond what the
    covariances predict; where the corners' noise is the smaller error, all count nearly alike. The scale is chosen for
    a mean information of one, so that weighted residuals remain pixels.

    Args:
        covariances: (..., N, 2, 2) px²; NaN where a corner was not seen.
        variance: of the residuals along an axis when all corners count alike, px².

    Returns:
        W (..., N, 2, 2) with Wᵀ W = s² (C + f² 1)⁻¹; NaN where not seen.

    Example:
        >>> corners = torch.eye(2, dtype=torch.float64) * torch.tensor([0.01, 0.04]).double()[:, None, None] ** 2
        >>> weights = whitening(corners, 0.00085)  # the mean variance: nothing beyond the corners' own
        >>> round(float(weights[0, 0, 0] / weights[1, 0, 0]), 4)
        4.0
    """
    seen = torch.isfinite(covariances).all(-1).all(-1)
    identity = torch.eye(2, dtype=covariances.dtype, device=covariances.device)
    filled = torch.where(seen[..., None, None], covariances, identity)
    own = float(covariances[seen].diagonal(dim1=-2, dim2=-1).mean())
    factor = torch.linalg.cholesky(filled + max(variance - own, 0.0) * identity)
    inverse = torch.linalg.solve_triangular(factor, identity.expand_as(factor), upper=False)
    information = inverse[seen].square().sum((-2, -1)).mean() / 2.0
    return torch.where(seen[..., None, None], inverse / information.sqrt(), torch.nan)
