"""How well the data determine the shared parameters: standard deviations, and the directions nobody measured."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcal.solve.schur import SchurLinearisation

# Eigenvalues of the scaled information below this share of the largest are rounding, not information.
_RANK_TOLERANCE = 1e-13


class Spread(NamedTuple):
    """Standard deviations of the shared parameters (S,), infinite where the data do not determine one."""

    sigma: Tensor
    determined: Tensor


def spread(linear: SchurLinearisation, residual_count: int, parameter_count: int) -> Spread:
    """Standard deviations from the information at a minimum, all other parameters free.

    σ² = diag((JᵀJ)⁻¹) ‖r‖² / (residuals - parameters), as `cv2.calibrateCameraExtended` reports them: the noise is
    estimated from the residuals themselves and assumed independent and equal.

    Args:
        linear: the linearisation at the minimum, not a batch.
        residual_count: scalar residuals.
        parameter_count: all parameters that were free, poses included.

    Returns:
        σ of each shared parameter in its own units, and whether it is determined at all.
    """
    information, scale = linear.information()
    eigenvalues, vectors = torch.linalg.eigh(information)
    kept = eigenvalues > _RANK_TOLERANCE * eigenvalues[-1]
    inverse = torch.where(kept, 1.0 / torch.where(kept, eigenvalues, 1.0), 0.0)
    variance = (vectors**2 * inverse).sum(-1)
    # A parameter with a part in a lost direction is not determined, however small the rest of its variance is.
    determined = (vectors[:, ~kept] ** 2).sum(-1) < 1e-6
    noise = 2.0 * linear.cost / max(residual_count - parameter_count, 1)
    sigma = torch.sqrt(variance * noise) * scale
    return Spread(torch.where(determined, sigma, torch.inf), determined)
