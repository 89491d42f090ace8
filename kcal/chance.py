"""How large a sum of squared residuals may be by chance: the χ² distribution, by SciPy."""

from __future__ import annotations

import torch
from torch import Tensor

# A χ² that is less probable is no chance: one in a thousand good data sets is above it.
_LIKELY = 0.999


def chi2_quantile(freedom: Tensor | float, probability: float) -> Tensor:
    """Quantile of the χ² distribution; 0 without freedom.

    Args:
        freedom: degrees of freedom, of any shape; they need not be whole numbers.
        probability: that χ² is smaller.

    Example:
        >>> round(float(chi2_quantile(10, 0.999)), 2)
        29.59
    """
    # Not at the top: commands that never ask start faster.
    from scipy.special import chdtri

    given = torch.as_tensor(freedom, dtype=torch.float64)
    found = torch.as_tensor(chdtri(given.clamp_min(1e-9).numpy(), 1.0 - probability))
    return torch.where(given > 0, found, 0.0)


def beyond_chance(chi2: float, freedom: float) -> bool:
    """Whether a χ² is larger than chance makes it once in a thousand times; never without freedom.

    Example:
        >>> beyond_chance(10.8, 1), beyond_chance(10.9, 1)
        (False, True)
    """
    return freedom > 0 and chi2 > float(chi2_quantile(freedom, _LIKELY))


def variance_factor(chi2: float, freedom: float) -> float:
    """By how much stated variances must be multiplied, because residuals are larger than chance explains; 1 at least.

    The variance of unit weight of an adjustment, where a χ² test at one in a thousand rejects that it is 1.

    Example:
        >>> variance_factor(12.0, 10), variance_factor(40.0, 10)
        (1.0, 4.0)
    """
    return chi2 / freedom if beyond_chance(chi2, freedom) else 1.0
