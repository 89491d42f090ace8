"""Problems of several cameras as one batch, and its result taken apart again."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.bundle.board_problem import BoardProblem
from kcal.calibrate.bundle.compressed_problem import CompressedProblem
from kcal.calibrate.bundle.priors import Term
from kcal.solve.result import Result, State


def join_boards(
    problems: Sequence[BoardProblem], starts: Sequence[State], device: torch.device
) -> tuple[BoardProblem, State]:
    """One element for each state of each problem, views padded with some in which no corner is seen.

    Such a view has no rows: its pose never moves, and nothing follows from it.
    """
    first, longest = problems[0], max(problem.seen.shape[-3] for problem in problems)
    counts = [problem.elements for problem in problems]
    whitening = None
    if first.whitening is not None:
        parts = [p.whitening.movedim(-1, -3) for p in problems if p.whitening is not None]
        whitening = _stacked(parts, problems, longest, 0.0, 5).to(device)
    joined = BoardProblem(
        first.board_points.to(device),
        _stacked([problem.pixels for problem in problems], problems, longest, math.nan, 4).to(device),
        first.models,
        first.free,
        free_warp=first.free_warp,
        whitening=whitening,
        loss=first.loss,
        fields=first.fields,
        terms=[term.to(device) for term in _terms([problem.terms for problem in problems], counts, (sum(counts),))],
        batch=(sum(counts),),
    )
    flat = [
        tuple(tensor if problem.batch else tensor[None] for tensor in start)
        for problem, start in zip(problems, starts, strict=True)
    ]
    shared = [torch.cat(parts).to(device) for parts in zip(*(state[:-2] for state in flat), strict=True)]
    poses = [
        torch.cat([_longer(tensor, longest) for tensor in parts]).to(device)
        for parts in zip(*(state[-2:] for state in flat), strict=True)
    ]
    return joined, (*shared, *poses)


def split_boards(result: Result, problems: Sequence[BoardProblem]) -> list[Result]:
    """What `minimize` found for `join_boards`, problem by problem, on the CPU."""
    out, begin = [], 0
    for problem in problems:
        part: slice | int = slice(begin, begin + problem.elements) if problem.batch else begin
        one = _part(result, part)
        views = problem.seen.shape[-3]
        *shared, rotation, translation = one.state
        state = (*shared, rotation[..., :views, :, :].clone(), translation[..., :views, :].clone())
        out.append(dataclasses.replace(one, state=state))
        begin += problem.elements
    return out


def join_compressed(
    problems: Sequence[CompressedProblem], starts: Sequence[State], device: torch.device
) -> tuple[CompressedProblem, State]:
    """A batch (cameras, starts); a camera of fewer starts has its last one several times."""
    first, most = problems[0], max(problem.elements for problem in problems)
    shape = (len(problems), 1)

    def of_all(tensors: Sequence[Tensor]) -> Tensor:
        return torch.stack(list(tensors)).to(device)

    folds = [problem.folded for problem in problems]
    folded = dataclasses.replace(
        first.folded,
        warp=of_all([fold.warp for fold in folds])[:, None],
        points=of_all([fold.points for fold in folds])[:, None],
        pixels=of_all([fold.pixels for fold in folds])[:, None],
        matrix=of_all([fold.matrix for fold in folds]),
        offset=of_all([fold.offset for fold in folds])[:, None],
    )
    terms = [term.to(device) for term in _terms([problem.terms for problem in problems], [1] * len(problems), shape)]
    joined = CompressedProblem(folded, first.model, first.free, terms, (len(problems), most))
    states = tuple(of_all([_longer(t, most, 0) for t in tensors]) for tensors in zip(*starts, strict=True))
    return joined, states


def split_compressed(result: Result, problems: Sequence[CompressedProblem]) -> list[Result]:
    """What `minimize` found for `join_compressed`, problem by problem, on the CPU."""
    out = []
    for i, problem in enumerate(problems):
        one, few = _part(result, i), slice(0, problem.elements)
        out.append(
            Result(
                state=tuple(tensor[few] for tensor in one.state),
                cost=one.cost[few],
                status=one.status[few],
                iterations=one.iterations[few],
                history=one.history[:, few],
            )
        )
    return out


def _part(result: Result, part: slice | int) -> Result:
    return Result(
        state=tuple(tensor[part].cpu() for tensor in result.state),
        cost=result.cost[part].cpu(),
        status=result.status[part].cpu(),
        iterations=result.iterations[part].cpu(),
        history=result.history[:, part].cpu(),
    )


def _terms(terms: Sequence[tuple[Term, ...]], counts: Sequence[int], shape: tuple[int, ...]) -> list[Term]:
    """Term by term those of all elements; a problem's own count once for each of its elements."""
    return [
        alike[0].joined([term for term, count in zip(alike, counts, strict=True) for _ in range(count)], shape)
        for alike in zip(*terms, strict=True)
    ]


def _stacked(
    tensors: Sequence[Tensor], problems: Sequence[BoardProblem], longest: int, fill: float, tail: int
) -> Tensor:
    """Tensors whose last `tail` dimensions begin with the views: one element after the other, `longest` views each."""
    out = []
    for tensor, problem in zip(tensors, problems, strict=True):
        each = tensor.expand(*problem.batch, *tensor.shape[-tail:]).reshape(problem.elements, *tensor.shape[-tail:])
        missing = each.new_full((len(each), longest - each.shape[1], *each.shape[2:]), fill)
        out.append(torch.cat([each, missing], 1))
    return torch.cat(out)


def _longer(tensor: Tensor, count: int, dim: int = 1) -> Tensor:
    """The last entry along a dimension repeated until there are `count`."""
    have = tensor.shape[dim]
    last = tensor.narrow(dim, have - 1, 1)
    return torch.cat([tensor, last.expand(*tensor.shape[:dim], count - have, *tensor.shape[dim + 1 :])], dim)
