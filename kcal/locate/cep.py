"""Circular error probable of positions whose error ellipse is long, and skewed along the line of sight.

At 5 km an ellipse of a stereo rig is a thousand times longer than wide, so that the usual formulas for circles miss;
and along the line of sight the error of the inverse range is Gaussian, not that of the range. So the errors of the
vector X / |X|², which is linear in the marks at any distance, are sampled and carried over.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.errors import InputError

# A quasi-random set of this size knows the radius to some 0.1 %.
_DRAWS = 8192
# Points at once, so that memory stays below 200 MB.
_AT_ONCE = 256


def circular_error(enu: Tensor, covariance: Tensor, shares: tuple[float, ...] = (0.5, 0.95)) -> Tensor:
    """Radii of the horizontal circles about an estimate that contain the true position with the given probabilities.

    Args:
        enu: (..., 3) estimates, meters from the camera that ranges are measured from.
        covariance: (..., 3, 3) to first order, as `Localization.covariance`.
        shares: probabilities: CEP50 and CEP95.

    Returns:
        (..., K) meters; infinite where the covariance is not finite or so large a share may lie at infinity.

    Raises:
        InputError: wrong shapes, or a share that is no probability.

    Example:
        >>> enu = torch.tensor([0.0, 1000.0, 0.0], dtype=torch.float64)
        >>> thin = torch.diag(torch.tensor([0.01, 5.0, 0.01], dtype=torch.float64) ** 2)
        >>> [round(radius, 2) for radius in circular_error(enu, thin).tolist()]  # 0.674 and 1.96 sigma, not 1.18, 2.45
        [3.37, 9.8]
    """
    enu = as_points("enu", enu, 3).detach()
    covariance = as_points("covariance", covariance, 3).detach()
    if covariance.shape != (*enu.shape, 3):
        raise InputError(f"covariance: shape {(*enu.shape, 3)} is needed, got {tuple(covariance.shape)}")
    if not shares or not all(0 < share < 1 for share in shares):
        raise InputError(f"shares {shares}: probabilities between 0 and 1 are needed")
    points, matrices = enu.reshape(-1, 3), covariance.reshape(-1, 3, 3)
    pieces = zip(points.split(_AT_ONCE), matrices.split(_AT_ONCE), strict=True)
    radii = [_radii(point, matrix, shares) for point, matrix in pieces]
    return torch.cat(radii).reshape(*enu.shape[:-1], len(shares))


def _radii(enu: Tensor, covariance: Tensor, shares: tuple[float, ...]) -> Tensor:
    squared = (enu * enu).sum(-1)
    known = torch.isfinite(covariance).all(-1).all(-1) & (squared > 0) & torch.isfinite(squared)
    enu = torch.where(known[:, None], enu, enu.new_tensor([0.0, 1.0, 0.0]))
    squared = torch.where(known, squared, 1.0)
    still = torch.eye(3, dtype=enu.dtype, device=enu.device)
    covariance = torch.where(known[:, None, None], covariance, still)
    # The derivative of X / |X|² by X: a reflection along X, over |X|².
    direction = enu / squared.sqrt()[:, None]
    slope = (still - 2.0 * direction[:, :, None] * direction[:, None, :]) / squared[:, None, None]
    values, vectors = torch.linalg.eigh(slope @ covariance @ slope.mT)
    factor = vectors * values.clamp_min(0.0).sqrt()[:, None, :]
    inverted = enu / squared[:, None]
    samples = inverted[:, None, :] + _standard_normal(enu.device) @ factor.mT
    ahead = (samples * direction[:, None, :]).sum(-1) > 0
    points = samples / (samples * samples).sum(-1, keepdim=True).clamp_min(1e-300)
    distance = torch.linalg.vector_norm((points - enu[:, None, :])[..., :2], dim=-1)
    ordered = torch.where(ahead, distance, torch.inf).sort(-1).values
    places = [min(_DRAWS - 1, round(share * _DRAWS)) for share in shares]
    return torch.where(known[:, None], ordered[:, places], torch.inf)


@functools.lru_cache(maxsize=2)
def _standard_normal(device: torch.device) -> Tensor:
    """(S, 3) standard normal points, the same ones every time."""
    uniform = torch.quasirandom.SobolEngine(3, scramble=True, seed=1).draw(_DRAWS, dtype=torch.float64)
    # Never 0 or 1, where the inverse is infinite.
    half = 0.5 / _DRAWS
    return torch.special.ndtri(uniform.clamp(half, 1.0 - half)).to(device)
