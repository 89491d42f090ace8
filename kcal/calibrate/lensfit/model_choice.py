"""Which of several models to keep, by what each costs on groups of views that it was not fitted to.

The lowest sum is the best guess, but a sum over some tens of groups is noisy. Two models are compared by paired
differences: both are judged on the same groups, so that what these have in common cancels, and the differences say how
sure their sum is (as the one-standard-error rule of Breiman et al. 1984 does for unpaired sums). A difference within
two standard errors is no evidence: then the model that one would rather have is kept, which is the simpler of two lens
models as a rule, as the richer one errs more where no view has looked.
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
        costs: (G,) squared residuals of each group held out; infinite where the model could not show a corner.
    """

    name: str
    costs: Tensor

    @property
    def total(self) -> float:
        """Over all groups."""
        return float(self.costs.sum())


def excess(one: Contender, other: Contender) -> tuple[float, float]:
    """By how much one costs more than another over all groups, and the standard error of that.

    Infinite with an error of zero where one of them fails to show corners in more groups than the other: that is no
    matter of chance. Otherwise groups that either cannot show count for nothing.

    Example:
        >>> import torch
        >>> a = Contender(name="a", costs=torch.tensor([1.0, 2.0, 3.0, 2.0]))
        >>> b = Contender(name="b", costs=torch.tensor([1.5, 2.0, 3.5, 3.0]))
        >>> [round(value, 3) for value in excess(b, a)]
        [2.0, 0.816]
        >>> c = Contender(name="c", costs=torch.tensor([1.0, 2.0, 3.0, math.inf]))
        >>> excess(c, a), excess(a, c)
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
    more, error = excess(one, other)
    return more > 0 and more > errors * error


def choose(contenders: Sequence[Contender]) -> Contender:
    """The first contender, in order of preference, that is not surely worse than the best one."""
    best = min(contenders, key=lambda one: (int(one.costs.isinf().sum()), float(one.costs[one.costs.isfinite()].sum())))
    return next(one for one in contenders if not surely_worse(one, best))
