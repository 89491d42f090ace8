"""Choose between models by their costs on held-out groups of views.

The model with the lowest sum is the best guess, but a sum over some tens of groups is noisy. So two models are compared
by paired differences: both are evaluated on the same groups, so that common errors cancel, and the scatter of the
differences gives the standard error of their sum (as the one-standard-error rule of Breiman et al. 1984 for unpaired
sums). A difference within two standard errors is no evidence. Then the preferred model is kept, as a rule the simpler
one, because a richer one has larger errors where there are no corners.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

from torch import Tensor

_SURE = 2.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Contender:
    """A model and what it costs.

    Args:
        name: of the model.
        costs: (G,) squared residuals of each group held out; infinite where a corner has no image under the model.
    """

    name: str
    costs: Tensor

    @property
    def total(self) -> float:
        """Over all groups."""
        return float(self.costs.sum())


def paired_difference(one: Contender, other: Contender) -> tuple[float, float]:
    """The cost of one minus that of another over all groups, and its standard error.

    Infinite with an error of zero where one of them fails in more groups than the other, which is no matter of chance.
    Otherwise groups in which either fails are ignored.

    Example:
        >>> import torch
        >>> a = Contender(name="a", costs=torch.tensor([1.0, 2.0, 3.0, 2.0]))
        >>> b = Contender(name="b", costs=torch.tensor([1.5, 2.0, 3.5, 3.0]))
        >>> [round(value, 3) for value in paired_difference(b, a)]
        [2.0, 0.816]
        >>> c = Contender(name="c", costs=torch.tensor([1.0, 2.0, 3.0, math.inf]))
        >>> paired_difference(c, a), paired_difference(a, c)
        ((inf, 0.0), (-inf, 0.0))
    """
    lost, won = int(one.costs.isinf().sum()), int(other.costs.isinf().sum())
    if lost != won:
        return math.copysign(math.inf, lost - won), 0.0
    difference = (one.costs - other.costs)[one.costs.isfinite() & other.costs.isfinite()]
    if len(difference) < 2:
        return float(difference.sum()), math.inf
    return float(difference.sum()), float(difference.std() * len(difference) ** 0.5)


def surely_worse(one: Contender, other: Contender, errors: float = _SURE) -> bool:
    """Whether one costs more than another by more than some standard errors."""
    more, error = paired_difference(one, other)
    return more > 0 and more > errors * error


def choose(contenders: Sequence[Contender]) -> Contender:
    """The first contender, in order of preference, that is not surely worse than the best one."""
    best = min(contenders, key=lambda one: (int(one.costs.isinf().sum()), float(one.costs[one.costs.isfinite()].sum())))
    return next(one for one in contenders if not surely_worse(one, best))
