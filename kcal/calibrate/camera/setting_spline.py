"""How values between settings follow from values at settings: the smoothest curve through them, with its error.

The prior is a straight line (in several settings a plane) of any slope, plus a Gaussian process of the generalized
covariance |h|³ / 12. In one setting that is a Wiener process as second derivative, and the curve is the natural cubic
spline (Wahba, Spline Models for Observational Data, 1990, section 1.4; Cressie, Statistics for Spatial Data, 1993,
section 5.4, for generalized covariances). The curve does not depend on the size of the process, but its error does.
"""

from __future__ import annotations

import torch
from scipy.optimize import nnls
from scipy.special import ndtri, stdtrit
from torch import Tensor

# Quantile up to which a normal distribution of the stated standard deviation is as wide as Student's: that of the
# 95 % intervals.
_QUANTILE = 0.975
# In widths of the settings: rounding.
_SAME = 1e-9


class SettingSpline:
    """Weights of settings (n, D) at any place between them; each axis is scaled to its range.

    Attributes:
        degrees: of freedom that tell the size of the process: settings beyond those that a plane goes through.

    Example:
        >>> spline = SettingSpline(torch.tensor([[0.0], [1.0], [2.0], [4.0]]).double())
        >>> [round(value, 3) for value in spline.weights(torch.tensor([1.5]).double()).tolist()]
        [-0.082, 0.614, 0.492, -0.024]
        >>> spline.inside(torch.tensor([4.1]).double()), spline.degrees
        (False, 2)
    """

    def __init__(self, settings: Tensor) -> None:
        self._low, self._width = settings.amin(0), settings.amax(0) - settings.amin(0)
        self._places = (settings - self._low) / self._width
        count, self._plane = len(settings), torch.cat([torch.ones_like(settings[:, :1]), self._places], 1)
        self.degrees = count - self._plane.shape[1]
        process, plane = _process(self._places, self._places), self._plane
        corner = plane.new_zeros(plane.shape[1], plane.shape[1])
        self._system = torch.cat([torch.cat([process, plane], 1), torch.cat([plane.T, corner], 1)])
        open_ways = torch.linalg.qr(plane, mode="complete")[0][:, plane.shape[1] :]
        root = torch.linalg.cholesky(open_ways.T @ process @ open_ways)
        # (m, n): unit normal under the prior, whatever the plane is.
        self._contrasts = torch.linalg.solve_triangular(root, open_ways.T, upper=False)

    @staticmethod
    def flat(settings: Tensor) -> bool:
        """Whether all settings (n, D) lie in a space of fewer dimensions, or are fewer than D + 2."""
        count, axes = settings.shape
        scaled = (settings - settings.mean(0)) / (settings.amax(0) - settings.amin(0))
        return count < axes + 2 or int(torch.linalg.matrix_rank(scaled, atol=_SAME)) < axes

    def inside(self, at: Tensor) -> bool:
        """Whether a setting (D,) lies between the others: in their convex hull."""
        place = torch.cat([at.new_ones(1), (at - self._low) / self._width])
        return bool(nnls(self._plane.T.numpy(), place.numpy())[1] < _SAME)

    def _solved(self, at: Tensor) -> tuple[Tensor, Tensor]:
        place = (at - self._low) / self._width
        right = torch.cat([_process(self._places, place[None])[:, 0], at.new_ones(1), place])
        return torch.linalg.solve(self._system, right), right

    def weights(self, at: Tensor) -> Tensor:
        """(n,) of the values at the settings, whose sum is the value there."""
        return self._solved(at)[0][: len(self._places)]

    def slopes(self, at: Tensor) -> Tensor:
        """(n, D) derivatives of the weights by the setting."""
        apart = (at - self._low) / self._width - self._places
        rates = apart.norm(dim=1, keepdim=True) * apart / 4.0
        plane = torch.cat([torch.zeros_like(apart[:1]), torch.eye(len(at), dtype=at.dtype)])
        return torch.linalg.solve(self._system, torch.cat([rates, plane]))[: len(apart)] / self._width

    def errors(self, at: Tensor) -> Tensor:
        """(m, n) of the values at the settings: independent errors of the value there, one sigma each.

        The size of the process is what the m contrasts of the values show, for each value by itself. As it is only
        estimated, errors have Student's distribution of m degrees of freedom; they are stated as normal ones that
        are as wide at 95 %.
        """
        solution, right = self._solved(at)
        widen = float(stdtrit(self.degrees, _QUANTILE) / ndtri(_QUANTILE))
        variance = (-(solution @ right)).clamp_min(0.0) / self.degrees
        return widen * variance.sqrt() * self._contrasts


def _process(one: Tensor, other: Tensor) -> Tensor:
    distance = (one[:, None] - other).square().sum(-1).clamp_min(1e-300).sqrt()
    return distance**3 / 12.0
