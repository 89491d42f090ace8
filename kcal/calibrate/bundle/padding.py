"""What joining the problems of several cameras into one batch needs, and taking its result apart."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.bundle.priors import Term
from kcal.solve.result import Result, S, map_state


def lengthened(tensor: Tensor, count: int, dim: int = 1) -> Tensor:
    """Repeat the last entry along a dimension until there are `count`."""
    return tensor.index_select(dim, torch.arange(count).clamp_max(tensor.shape[dim] - 1))


def joined_terms(terms: Sequence[tuple[Term, ...]], counts: Sequence[int], shape: tuple[int, ...]) -> list[Term]:
    """The terms of a batch, from those of each problem and the number of its elements."""
    return [
        alike[0].joined([term for term, count in zip(alike, counts, strict=True) for _ in range(count)], shape)
        for alike in zip(*terms, strict=True)
    ]


def part_of(result: Result[S], part: slice | int) -> Result[S]:
    """Some elements of a batch, on the CPU."""
    return Result(
        state=map_state(lambda tensor: tensor[part].cpu(), result.state),
        cost=result.cost[part].cpu(),
        status=result.status[part].cpu(),
        iterations=result.iterations[part].cpu(),
        history=result.history[:, part].cpu(),
    )
