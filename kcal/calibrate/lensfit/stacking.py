"""Average fits under many priors, with weights for the lowest cost on held-out views.

A prior's strength decides how much detail a field has. Some tens of groups of views determine the best strength only
roughly, and a single choice discards what the other fits contain. So the fits under all candidates are averaged, with
the weights that minimize the held-out cost of the average (stacking: Wolpert 1992; Breiman 1996). As fits are steps in
the same unknowns, their average is a fit again.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.lensfit.quadratic_forms import QuadraticForms
from kcal.lens.residual import FieldGrid

# A unit's precision is strength · (reference / width)^(2 · smoothness). Above 1e5 hundreds of corners could not
# distinguish it from zero, and it is left out.
_REFERENCE, _OFF = 0.8, 1e5
_SMOOTHNESS = (1, 6)
_STRENGTHS = (0.003, 0.03, 0.3, 3.0, 30.0, 300.0)
_INNER = 5
_STEPS, _OPTIMAL = 4000, 1e-9
_HOPELESS = 4.0


@dataclasses.dataclass(frozen=True)
class FieldPrior:
    """A Gaussian prior of a field's weights, independent and zero in the mean.

    Args:
        strength: precision of units as wide as 0.8 half widths of the image, in units of 1 / noise²; infinite: no
            field at all.
        smoothness: the precision of narrower units grows as width^(-2 · smoothness).
    """

    strength: float
    smoothness: float = 1.0

    def precision(self, grid: FieldGrid, half: float) -> Tensor:
        """(2 K,) of all weights, infinite where they are zero; `half` is half the image's width in grid units."""
        values = [self.strength * (_REFERENCE * half / s.width) ** (2 * self.smoothness) for s in grid.scales]
        each = [
            torch.full((s.count,), value if value < _OFF else math.inf, dtype=torch.float64)
            for s, value in zip(grid.scales, values, strict=True)
        ]
        return torch.cat([*each, *each])


# From no field at all to one that only the data limit, for rough and for smooth lenses.
CANDIDATES = (FieldPrior(math.inf), *(FieldPrior(a, b) for b in _SMOOTHNESS for a in _STRENGTHS))


def deal(count: int, parts: int) -> list[Tensor]:
    """Indices 0 ... count - 1, shuffled with a fixed seed and divided into parts."""
    order = torch.randperm(count, generator=torch.Generator().manual_seed(0))
    return [order[i::parts] for i in range(min(parts, count))]


def stack_weights(forms: QuadraticForms, chosen: Tensor, precisions: Sequence[Tensor]) -> Tensor:
    """The weights (C,) with which fits under candidate priors are averaged, from some groups (G,) of the forms.

    The groups are held out in five parts, and then the corners of all groups next to the border. The held-out cost of
    the average is quadratic in the weights, which are not negative and sum to one.
    """
    inside = chosen.nonzero()[:, 0]
    cost = torch.zeros(len(precisions), len(precisions), dtype=forms.groups.dtype)
    for part in deal(len(inside), _INNER):
        out = torch.zeros_like(chosen)
        out[inside[part]] = True
        # A sum, not a difference of sums: next to a pole one corner can outweigh all others.
        left, held = forms.total(chosen & ~out), forms.total(out)
        fits = torch.stack([forms.fit(left, precision) for precision in precisions])
        cost += fits @ held @ fits.T
    left = forms.inside(chosen)
    beyond = forms.total(chosen) - left
    if bool(beyond.any()):
        fits = torch.stack([forms.fit(left, precision) for precision in precisions])
        cost += fits @ beyond @ fits.T
    own = cost.diagonal().nan_to_num(nan=math.inf)
    weights = torch.zeros_like(own)
    if bool(own.isinf().all()):
        weights[0] = 1.0
        return weights
    # Candidates that are far worse on their own get no weight; they would only slow down the minimization.
    near = own <= _HOPELESS * own.min()
    weights[near] = simplex_minimum(cost[near][:, near])
    return weights


def simplex_minimum(matrix: Tensor) -> Tensor:
    """The w ≥ 0 with sum 1 that minimizes wᵀ M w, by accelerated projected gradients (Beck and Teboulle 2009).

    Example:
        >>> matrix = torch.tensor([[1.0, 0.0, 2.0], [0.0, 3.0, 2.0], [2.0, 2.0, 9.0]], dtype=torch.float64)
        >>> [round(value, 6) + 0.0 for value in simplex_minimum(matrix).tolist()]
        [0.75, 0.25, 0.0]
    """
    values = (matrix / matrix.diagonal().min()).numpy()
    # Only steps within the simplex count, where common parts of all candidates do not change.
    curved = values - values.mean(0) - values.mean(1, keepdims=True) + values.mean()
    # A single candidate, or equal ones, have no curvature.
    rate = 1.0 / max(float(np.linalg.eigvalsh(0.5 * (curved + curved.T))[-1]), 1e-9)
    weights = np.full(len(values), 1.0 / len(values))
    ahead, momentum = weights, 1.0
    for trial in range(_STEPS):
        new = _to_simplex(ahead - rate * (values @ ahead))
        following = 0.5 * (1.0 + (1.0 + 4.0 * momentum**2) ** 0.5)
        ahead = new + ((momentum - 1.0) / following) * (new - weights)
        weights, momentum = new, following
        if trial % 50 == 49:
            slope = values @ weights
            if slope.min() >= (weights @ slope) * (1.0 - _OPTIMAL):
                break
    return torch.from_numpy(weights)


def _to_simplex(values: np.ndarray) -> np.ndarray:
    """The nearest point of the simplex (Duchi et al. 2008)."""
    ordered = np.sort(values)[::-1]
    shift = (ordered.cumsum() - 1.0) / np.arange(1, len(values) + 1)
    last = int((ordered > shift).nonzero()[0][-1])
    return np.maximum(values - shift[last], 0.0)


def average_fit(forms: QuadraticForms, form: Tensor, precisions: Sequence[Tensor], weights: Tensor) -> Tensor:
    """The weighted average (S + 1,) of the fits under candidate priors to the views of a form of `forms`."""
    used = [(weight, precision) for weight, precision in zip(weights.tolist(), precisions, strict=True) if weight > 0]
    return torch.stack([weight * forms.fit(form, precision) for weight, precision in used]).sum(0)
