"""Adjust a rig: minimize all blocks together, leave out what is beyond its limit, widen what parts of it contradict."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.rig.motion import BoardMotion, RigRows, WithoutMotion, board_motion
from kcal.calibrate.rig.problem import RigProblem
from kcal.calibrate.rig.source import OWN, Context, Effects, ItemFit, ItemSource, RigState, Start, typical_ratio
from kcal.calibrate.rig.sources import BoardBlock, RigData
from kcal.calibrate.rig.unknowns import SharedUnknowns
from kcal.errors import ContradictionError
from kcal.solve.lm import LMOptions, Result, RobustLoss, minimize

# Adjust a rig: minimize all blocks together, and leave out what is beyond its limit.

# Probability that any good item at all is taken for a wrong one.
FALSE_ALARM = 1e-3
# The state of a joint adjustment in which some items take part and others do not, and how well each item fits.

# px, of a corner: noise-free corners would otherwise weigh infinitely much.
_LEAST_SIGMA = 1e-3
# A board whose mean squared residual exceeds the typical one by this factor is wrong, and is not asked for motion.
_WRONG = 9.0
# How often the motions are estimated camera by camera; after the second round they hardly change.
_TURNS = 2


class Adjustment:
    """Data, and the state of everything in it. A mask (V,) says which of the items of all sources take part.

    Args:
        data: what is known.
        start: poses to begin with.
        unknowns: what may change of lenses and board.
        sigma_corner: of a board's corner along an axis, px.
        turning: which cameras' rotations are unknown; left out: all, but the one that is the frame.
        moving: which cameras' centers are unknown; left out: all, but the one that is the frame.

    Attributes:
        sources: those with items, and the places of these among all items.
        labels: of all items, as `landmark post 4`.
        terms: what was measured of the cameras.
    """

    def __init__(
        self,
        data: RigData,
        start: Start,
        unknowns: SharedUnknowns,
        sigma_corner: float,
        *,
        turning: Sequence[bool] | None = None,
        moving: Sequence[bool] | None = None,
    ) -> None:
        self.data, self.sigma_corner, self.unknowns = data, sigma_corner, unknowns
        loose = [data.absolute or c > 0 for c in range(len(data.cameras))]
        self._turning, self._moving = turning or loose, moving or loose
        self.anchor = start.center.mean(0)
        self.sources: list[tuple[ItemSource, slice]] = []
        self.labels: list[str] = []
        for source in data.seen:
            count = len(self.labels)
            self.labels += [f"{source.kind.removesuffix('s')} {name}" for name in source.names]
            self.sources.append((source, slice(count, len(self.labels))))
        self.terms = data.measured
        # Of `terms`, those that are left out, by their indices.
        self.without: frozenset[int] = frozenset()
        # By how much the sigmas of a kind's items are multiplied, because these fit themselves worse than stated.
        self.widened: dict[str, float] = {source.kind: 1.0 for source in data.seen}
        self.motion: list[BoardMotion | None] = [None] * len(data.cameras)
        self.state = RigState(
            parameters=torch.cat([camera.params.detach() for camera in data.cameras]),
            unknown=unknowns.begin,
            refraction=torch.tensor(unknowns.refraction, dtype=torch.float64),
            rotation=start.rotation,
            center=start.center,
            board=torch.zeros(len(unknowns.shapes), dtype=torch.float64),
            items=torch.cat(
                [torch.zeros(0, OWN).double(), *(source.begin(data.cameras, start) for source in data.seen)]
            ),
        )

    def at(self, kind: str) -> slice:
        """The places of a kind's items among all items."""
        return next((at for source, at in self.sources if source.kind == kind), slice(0, 0))

    def problem(self, mask: Tensor, loss: RobustLoss | None = None, *, held: bool = False) -> RigProblem:
        """The problem of the items in the mask; `held`: of these alone, with cameras and board as they are."""
        cameras = self.data.cameras
        unknowns = self.unknowns.none() if held else self.unknowns
        turning, moving = ([not held and one for one in each] for each in (self._turning, self._moving))
        blocks = [
            source.block(mask[at], self._context(source, at, unknowns))
            for source, at in self.sources
            if bool(mask[at].any())
        ]
        terms = [] if held else [term for i, term in enumerate(self.terms) if i not in self.without]
        return RigProblem(cameras, blocks, terms, unknowns, turning, moving, loss)

    def _context(self, source: ItemSource, at: slice, unknowns: SharedUnknowns) -> Context:
        """What a source needs to know to give its rows in a problem with these unknowns."""
        effects, whole = None, self.unknowns.by_effects
        if whole is not None and source.effects:
            begin = sum(len(one.effects) for one, place in self.sources if place.start < at.start)
            part = slice(begin, begin + len(source.effects))
            effects = Effects(
                source.shifts(), whole[part], None if unknowns.by_effects is None else unknowns.by_effects[part]
            )
        return Context(
            cameras=self.data.cameras,
            state=self.state._replace(items=self.state.items[at]),
            unknowns=unknowns,
            anchor=self.anchor,
            times=self.widened[source.kind],
            effects=effects,
            sigma_corner=self.widened.get("boards", 1.0) * self.sigma_corner,
            motion=self.motion,
        )

    @property
    def term_labels(self) -> list[str]:
        """A name for each of `terms`."""
        return [term.label(self.data.names) for term in self.terms]

    def none(self) -> Tensor:
        """A mask without any item."""
        return torch.zeros(len(self.labels), dtype=torch.bool)

    def at_survey(self, state: RigState) -> RigState:
        """A state of all items, with these where they are known to be beforehand."""
        parts = [source.as_given(state.items[at]) for source, at in self.sources]
        return state._replace(items=torch.cat([state.items[:0], *parts]))

    def part(self, mask: Tensor) -> RigState:
        """The state of the cameras and of the items in the mask."""
        return self.state._replace(items=self.state.items[mask])

    def put(self, state: RigState, mask: Tensor) -> None:
        """Keep a part's new state."""
        self.state = state._replace(items=self.state.items.index_put((mask,), state.items))

    def solve(
        self, mask: Tensor, solver: LMOptions, loss: RobustLoss | None = None, *, held: bool = False
    ) -> tuple[RigProblem, Result]:
        """Minimize from the present state, and keep the result."""
        problem = self.problem(mask, loss, held=held)
        result = minimize(problem, self.part(mask), solver)
        self.put(problem.tidy(result.state), mask)
        return problem, result

    def squares(self, mask: Tensor) -> Tensor:
        """(V,) χ² of every item at the present state; NaN outside the mask, infinite for what cannot be seen."""
        return self._of_all(mask, self.problem(mask).item_squares(self.part(mask)))

    def deletions(self, mask: Tensor) -> Tensor:
        """(V,) by how much χ² would fall without each item (`RigProblem.deletions`); NaN outside the mask."""
        return self._of_all(mask, self.problem(mask).deletions(self.part(mask)))

    def _of_all(self, mask: Tensor, values: Sequence[Tensor]) -> Tensor:
        """Values of the items in the mask put among all: NaN for the others, infinite where one is not finite."""
        found = torch.full(mask.shape, math.nan, dtype=torch.float64)
        found[mask] = torch.cat([found[:0], *values]).nan_to_num(math.inf, math.inf)
        return found

    def freedom(self, mask: Tensor) -> Tensor:
        """(V,) degrees of freedom of every item beyond its own unknowns; 0 outside the mask."""
        found = torch.zeros(mask.shape, dtype=torch.int64)
        found[mask] = torch.cat([found[:0], *(block.freedom for block in self.problem(mask).blocks)])
        return found

    def squares_px(self, mask: Tensor, state: RigState) -> tuple[Tensor, Tensor]:
        """(V, C) squared distances of marks in a state of all items, px², and how many; zero outside the mask."""
        squared, count = (torch.zeros(len(mask), len(self.data.cameras), dtype=torch.float64) for _ in range(2))
        found = self.problem(mask).squares_px(state._replace(items=state.items[mask]))
        squared[mask] = torch.cat([squared[:0], *(one for one, _ in found)])
        count[mask] = torch.cat([count[:0], *(many for _, many in found)])
        return squared, count

    def over_limit(self, mask: Tensor, value: Tensor, probability: float | None = None) -> Tensor:
        """(V,) χ² of every item over the largest that noise and lenses explain; 0 outside the mask.

        Args:
            mask: the items.
            value: their χ², or by how much it would fall without them.
            probability: that a good item stays below 1, judged by the sigmas as they are. Left out: all items together
                nearly always do, and where a kind as a whole fits worse than stated, its items are judged by that.
        """
        square, freedom = self.squares(mask), self.freedom(mask)
        level = probability or 1.0 - FALSE_ALARM / max(int((freedom > 0).sum()), 1)
        found = torch.zeros_like(square)
        for source, at in self.sources:
            fit, given = ItemFit(mask[at], value[at], square[at], freedom[at]), self._context(source, at, self.unknowns)
            found[at] = source.over_limit(fit, level, given, certain=probability is not None)
        return found

    def fit_motion(self, mask: Tensor) -> None:
        """Find how boards move while the cameras' rows are read, from residuals at the present state.

        Motion while rows are read is not estimated for calibrated cameras of parametric models: errors of such a model
        would be taken for motion.
        """
        self.motion, at = [None] * len(self.data.cameras), self.at("boards")
        if not bool(mask[at].any()):
            return
        everything = mask.clone()
        everything[at] = True
        # Boards that are off by far are wrong, not moved.
        square = self.squares(mask)[at] / self.freedom(mask)[at].clamp_min(1)
        good = mask[at] & (square <= _WRONG * square[mask[at]].median())
        problem = self.problem(everything)
        parts = problem.parts(self.part(everything))
        block, state = next((one, own) for one, own in parts if isinstance(one, BoardBlock))
        posed = problem.posed(state)
        rig = RigRows(block.camera_rows(posed, state), good, problem.shared_size)
        # Rows of each camera before its own motions were integrated out, and the others' motions at that time.
        before: dict[int, Tensor] = {}
        others: dict[int, list[BoardMotion | None]] = {}
        for c in [*range(len(posed))] * _TURNS:
            beside = [one for k, one in enumerate(self.motion) if k != c]
            if c in others and all(a is b for a, b in zip(beside, others[c], strict=True)):
                continue
            others[c] = beside
            if c in before:
                rig.put(c, before.pop(c))
            camera = self.data.cameras[c]
            reads = camera.model.hybrid or camera.calibration is None
            columns, reach = block.motion_columns(c, posed[c], state, reads=reads)
            weighted, focal = functools.partial(block.weighted, c), float(camera.params[0])
            apart = any(one and any(one.apart) for one in beside)
            found = self.motion[c] = board_motion(columns, weighted, focal, reach, rig, c, apart=apart)
            if found is not None:
                before[c] = rig.parts[c].rows
                rig.put(c, WithoutMotion(weighted(found.columns))(before[c]))

    def fit_corners(self, mask: Tensor, *, robust: bool = False) -> float:
        """Set the corners' sigma from the boards' residuals, unless it was given.

        Args:
            mask: the items that take part.
            robust: by the median board, so that some wrong ones do not matter.

        Returns:
            its relative change.
        """
        boards, before, at = self.data.boards, self.sigma_corner, self.at("boards")
        if boards is None or boards.sigma is not None or not bool(mask[at].any()):
            return 0.0
        squares, freedom = self.squares(mask)[at][mask[at]], self.freedom(mask)[at][mask[at]]
        dof = int(freedom.sum())
        if dof <= 0:
            return 0.0
        if robust:
            ratio = typical_ratio(squares, freedom)
        else:
            problem = self.problem(mask)
            # Where there is nothing but boards, they determine the shared unknowns too.
            alone = len(problem.blocks) == 1 and not self.terms
            free = problem.shared_size - int(self.unknowns.known.sum())
            ratio = self.widened["boards"] ** 2 * float(squares.sum()) / max(dof - alone * free, 1)
        if 0 < ratio < math.inf:
            self.sigma_corner = max(self.sigma_corner * math.sqrt(ratio), _LEAST_SIGMA)
        return abs(self.sigma_corner / before - 1.0)


# Find what contradicts the rest of a joint adjustment: worst first, and back in what does not after all.

# Loss of the root mean squared residual of an item, in sigmas: at 3, an item has half its weight.
LOSS = RobustLoss(kind="cauchy", scale=3.0)
# A robust solution is only used to find what is wrong, so a rough one suffices.
ROUGHLY = LMOptions(max_iterations=100, tolerance=1e-6, residual_floor=1e-8)
# If more than this share of its items is wrong, the source as a whole is.
MOST_WRONG = 0.4
# A source whose typical item is off by so many times its sigma is wrong as a whole.
WRONG_AS_A_WHOLE = 20.0
_ROUNDS = 30


def without_wrong(work: Adjustment, mask: Tensor, solver: LMOptions) -> Tensor:
    """Solve without the items that contradict the rest: the worst is left out first; what fits after all returns.

    Args:
        work: at a robust solution; it is left at the solution without the wrong items.
        mask: items that may take part.
        solver: options of the solver.

    Returns:
        mask of the items that agree.

    Raises:
        InputError: not a few items are wrong but a source as a whole.
    """
    squares, freedom = work.squares(mask), work.freedom(mask)
    for source, at in work.sources:
        if (times := math.sqrt(typical_ratio(squares[at], freedom[at]))) > WRONG_AS_A_WHOLE:
            raise ContradictionError(
                f"the {source.kind} contradict each other or the rest: typically they are {times:.0f} times as far off "
                f"as their sigmas say; {source.checks}",
                source.kind,
            )
    kept = mask & ~(work.over_limit(mask, squares) > 1.0)
    _refuse_many(work, kept, mask)
    returned: set[int] = set()
    for _ in range(_ROUNDS):
        work.solve(kept, solver)
        work.fit_corners(kept)
        # Each item by the fall of χ² without it, which sees leverage, but against what is typical of the plain χ².
        over = work.over_limit(kept, work.deletions(kept))
        if len(worst := next_out(over, int(kept.sum()))):
            kept[worst] = False
            _refuse_many(work, kept, mask)
            continue
        # With the cameras held where they are now, try again what was left out.
        outside = mask & ~kept
        work.solve(outside, solver, held=True)
        fits = outside & (work.over_limit(outside, work.squares(outside), 0.999) < 1.0)
        again = set(fits.nonzero()[:, 0].tolist()) - returned
        if not again:
            break
        kept[list(again)] = True
        returned |= again
    return kept


def next_out(over: Tensor, count: int) -> Tensor:
    """Which items (V,), over their limit by so many times, to leave out next of `count` that take part.

    One at a time, because it may have bent the solution against the others; of thousands the worst thousandth.
    """
    most, which = over.nan_to_num(0.0).topk(min(len(over), 1 + count // 1000))
    return which[most > 1.0]


def possible(work: Adjustment, mask: Tensor) -> Tensor:
    """The mask without what has no projection at the present state: behind a camera, or beyond what its lens shows."""
    return mask & torch.isfinite(work.squares(mask))


def _refuse_many(work: Adjustment, kept: Tensor, mask: Tensor) -> None:
    for source, at in work.sources:
        wrong, total = (mask & ~kept)[at].nonzero()[:, 0].tolist(), int(mask[at].sum())
        gone = len(wrong)
        if gone > max(1, MOST_WRONG * total):
            names = ", ".join(source.names[i] for i in wrong[:6])
            raise ContradictionError(
                f"{gone} of {total} {source.kind} contradict the rest ({names}{' ...' if gone > 6 else ''}): these are "
                f"not a few wrong ones; {source.checks}",
                source.kind,
            )
