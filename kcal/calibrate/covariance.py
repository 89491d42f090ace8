"""How well the data determine the shared parameters: standard deviations, and the directions nobody measured."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcal.solve.schur import SchurLinearisation

# Eigenvalues of the scaled information below this share of the largest are rounding, not information.
_RANK_TOLERANCE = 1e-13
# A parameter whose square has this share in a lost direction is lost with it.
_LOST_SHARE = 1e-2


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
    floor = _RANK_TOLERANCE * eigenvalues[-1]
    lost = (vectors[:, eigenvalues <= floor] ** 2).sum(-1)
    # What rounding hides is at least as uncertain as the floor says.
    variance = (vectors**2 / eigenvalues.clamp_min(floor)).sum(-1)
    noise = 2.0 * linear.cost / max(residual_count - parameter_count, 1)
    sigma = torch.sqrt(variance * noise) * scale
    determined = lost < _LOST_SHARE
    return Spread(torch.where(determined, sigma, torch.inf), determined)
