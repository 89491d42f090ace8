"""Adjust a rig: minimize all blocks together, and leave out what is beyond its limit."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.rig.blocks import (
    KINDS,
    LOCAL_SIZE,
    Block,
    BoardBlock,
    Effects,
    FeatureBlock,
    Kind,
    LandmarkBlock,
    PerKind,
    RigState,
    StarBlock,
)
from kcal.calibrate.rig.initial_poses import Start
from kcal.calibrate.rig.motion import BoardMotion, RigRows, WithoutMotion, board_motion
from kcal.calibrate.rig.problem import (
    DistanceTerm,
    PlaceTerm,
    RigProblem,
    SharedTerm,
    SharedUnknowns,
    SkylineTerm,
    held,
    own_fits,
)
from kcal.calibrate.rig.problem import held as nothing
from kcal.calibrate.rig.sources import Features, Landmarks, RigData, StarSource, shifts_of, star_turns, with_effects
from kcal.checks import beyond_chance, chi2_quantile
from kcal.errors import InputError
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.problem import Result, RobustLoss

# The state of a joint adjustment in which some items take part and others do not, and how well each item fits.

# px, of a corner: noise-free corners would otherwise weigh infinitely much.
_LEAST_SIGMA = 1e-3
# Boards whose mean square is this many times the typical one do not tell how others move.
_WRONG = 9.0
# How often each camera's motions are found, those of the others being known: the second time changes little.
_TURNS = 2


class Adjustment:
    """Data, and the state of everything in it; masks say which boards, landmarks and features take part.

    Args:
        data: what is known.
        start: poses to begin with.
        unknowns: what may change of lenses and board.
        sigma_corner: of a board's corner along an axis, px.
        turning: which cameras' rotations are unknown; left out: all, but the one that is the frame.
        moving: likewise their centers.
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
        self.terms: list[SharedTerm] = [DistanceTerm(b.first, b.second, b.length, b.sigma) for b in data.baselines]
        self.terms += [PlaceTerm(p.camera, p.point, p.sigma) for p in data.positions]
        self.terms += [] if data.skyline is None else [SkylineTerm(data.skyline)]
        # Of `terms`, those that are left out, by their indices.
        self.without: frozenset[int] = frozenset()
        # By how much the sigmas of a kind's items are multiplied, because these fit themselves worse than stated.
        self.widened: dict[Kind, float] = dict.fromkeys(KINDS, 1.0)
        self.motion: list[BoardMotion | None] = [None] * len(data.cameras)
        direction, inverse_range = _feature_start(data, start, self.anchor)
        self.state = RigState(
            parameters=torch.cat([camera.params.detach() for camera in data.cameras]),
            unknown=unknowns.begin,
            refraction=torch.tensor(unknowns.refraction, dtype=torch.float64),
            rotation=start.rotation,
            center=start.center,
            board=torch.zeros(len(unknowns.shapes), dtype=torch.float64),
            board_rotation=start.board_rotation,
            board_translation=start.board_translation,
            points=data.landmarks.points if data.landmarks else torch.empty(0, 3, dtype=torch.float64),
            direction=direction,
            inverse_range=inverse_range,
            star=_star_start(data, start),
        )

    def problem(self, masks: PerKind, loss: RobustLoss | None = None, *, held: bool = False) -> RigProblem:
        """The problem of the items in the masks; `held`: of these alone, with cameras and board as they are."""
        cameras = self.data.cameras
        unknowns = nothing(cameras) if held else self.unknowns
        turning, moving = ([not held and one for one in each] for each in (self._turning, self._moving))
        blocks = self._blocks(masks, unknowns)
        terms = [] if held else [term for i, term in enumerate(self.terms) if i not in self.without]
        return RigProblem(cameras, blocks, terms, unknowns, turning, moving, loss)

    def _blocks(self, masks: PerKind, unknowns: SharedUnknowns) -> list[Block]:
        """A block of each kind that has items in the masks."""
        data, found = self.data, list[Block]()
        if data.boards and masks.boards.any():
            pixels, white = (value[masks.boards] for value in (data.boards.pixels, self.corner_whitening()))
            shapes, by_unknown = self.unknowns.shapes, unknowns.board
            motion = [one and one.columns[masks.boards] for one in self.motion]
            found.append(BoardBlock(pixels, white, data.boards.points, shapes, by_unknown, motion))
        if data.landmarks and masks.landmarks.any():
            times = self.widened["landmarks"]
            surveyed = data.landmarks.points[masks.landmarks], times * data.landmarks.sigma[masks.landmarks]
            marks = _weighted(data.landmarks, masks.landmarks, times)
            effects = self._effects(data.landmarks, unknowns)
            shifts = shifts_of(data.landmarks.effects, (*data.landmarks.pixels.shape[:2], 3))[:, masks.landmarks]
            found.append(LandmarkBlock(*marks, *surveyed, unknowns.by_refraction, effects, shifts))
        if data.features and masks.features.any():
            times, some = self.widened["features"], masks.features
            known = data.features.inverse_range[some], times * data.features.inverse_range_sigma[some]
            shifts = shifts_of(data.features.effects, data.features.pixels.shape)[:, some]
            shared = self._effects(data.features, unknowns), shifts
            found.append(FeatureBlock(*_weighted(data.features, some, times), *known, self.anchor, *shared))
        if data.stars and masks.stars.any():
            found.append(self._star_block(masks.stars, unknowns))
        return found

    def _star_block(self, mask: Tensor, unknowns: SharedUnknowns) -> StarBlock:
        stars = self.data.stars
        assert stars is not None
        times = self.widened["stars"]
        white = torch.eye(2, dtype=torch.float64) / (times * stars.pixel_sigma[mask][..., None, None])
        known = stars.direction[mask], times * stars.direction_sigma[mask]
        count, cameras = stars.pixels.shape[:2]
        turns = star_turns(stars.effects, count, cameras)[:, :, mask]
        moves = turns, shifts_of(stars.effects, (count, cameras, 3))[:, mask]
        effects = self._effects(stars, unknowns)
        return StarBlock(stars.pixels[mask], white, *known, *moves, effects)

    def _effects(self, source: StarSource | Landmarks | Features, unknowns: SharedUnknowns) -> Effects | None:
        """What shifts a source's items, of all unknowns in the state and of those of a step; None: nothing does."""
        whole = self.unknowns.by_effects
        if whole is None or not source.effects:
            return None
        order = with_effects(self.data)
        begin = sum(len(one.effects) for one in order[: order.index(source)])
        part = slice(begin, begin + len(source.effects))
        return Effects(whole[part], None if unknowns.by_effects is None else unknowns.by_effects[part])

    @property
    def term_labels(self) -> list[str]:
        """A name for each of `terms`."""
        data = self.data
        found = [f"the baseline {data.names[b.first]} to {data.names[b.second]}" for b in data.baselines]
        found += [f"the position of {data.names[p.camera]}" for p in data.positions]
        return found + ([] if data.skyline is None else ["the skyline"])

    def names(self, kind: Kind) -> tuple[str, ...]:
        """Names of all items of a kind."""
        source = getattr(self.data, kind)
        return () if source is None else source.names

    def corner_whitening(self) -> Tensor:
        """(V, C, N, 2, 2) of all boards, at the present sigma of a corner."""
        assert self.data.boards is not None
        return self.data.boards.whitening(self.sigma_corner)

    def none(self) -> PerKind:
        """Masks without any item."""
        state = self.state
        counts = (len(state.board_rotation), len(state.points), len(state.direction), len(state.star))
        return PerKind(*(torch.zeros(count, dtype=torch.bool) for count in counts))

    def part(self, masks: PerKind) -> RigState:
        """The state of the cameras and of the items in the masks."""
        index = _masks_of_fields(masks)
        return RigState(*(t if mask is None else t[mask] for t, mask in zip(self.state, index, strict=True)))

    def put(self, state: RigState, masks: PerKind) -> None:
        """Keep a part's new state."""
        index = _masks_of_fields(masks)
        self.state = RigState(*(
            new if mask is None else old.index_put((mask,), new)
            for old, new, mask in zip(self.state, state, index, strict=True)
        ))  # fmt: skip

    def solve(
        self, masks: PerKind, solver: LMOptions, loss: RobustLoss | None = None, *, held: bool = False
    ) -> tuple[RigProblem, Result]:
        """Minimize from the present state, and keep the result."""
        problem = self.problem(masks, loss, held=held)
        result = minimize(problem, self.part(masks), solver)
        self.put(problem.tidy(result.state), masks)
        return problem, result

    def squares(self, masks: PerKind) -> PerKind:
        """χ² of every item at the present state; NaN outside the masks, infinite for what cannot be seen."""
        problem = self.problem(masks)
        return _of_all(masks, problem, problem.item_squares(self.part(masks)))

    def deletions(self, masks: PerKind) -> PerKind:
        """By how much χ² would fall without each item (`RigProblem.deletions`); NaN outside the masks."""
        problem = self.problem(masks)
        return _of_all(masks, problem, problem.deletions(self.part(masks)))

    def freedom(self, masks: PerKind) -> PerKind:
        """Degrees of freedom of every item beyond its own unknowns; 0 outside the masks."""
        found = PerKind(*(torch.zeros(mask.shape, dtype=torch.int64) for mask in masks))
        for block in self.problem(masks).blocks:
            getattr(found, block.kind)[getattr(masks, block.kind)] = block.counts - block.size
        return found

    def fit_motion(self, masks: PerKind) -> None:
        """Find how boards move while the cameras' rows are read, from residuals at the present state.

        While rows are read, not before cameras of parametric models: what these cannot show would be taken for motion.
        """
        boards, state = self.data.boards, self.state
        self.motion = [None] * len(self.data.cameras)
        if boards is None or not bool(masks.boards.any()):
            return
        everything = masks._replace(boards=torch.ones_like(masks.boards))
        # Boards that are off by far are wrong, not moved.
        square = self.squares(masks).boards / self.freedom(masks).boards.clamp_min(1)
        good = masks.boards & (square <= _WRONG * square[masks.boards].median())
        problem = self.problem(everything)
        block = next(block for block in problem.blocks if isinstance(block, BoardBlock))
        posed = problem.posed(state)
        rig = RigRows(block.camera_rows(posed, state), good, problem.shared_size)
        # Rows of cameras whose motions are taken out, as they were before; what the others' motions were at that time.
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
            columns, reach = block.motion_columns(posed[c], state, c, reads=reads)
            found = self.motion[c] = board_motion(columns, block.whitening[:, c], reach, rig, c)
            if found is not None:
                before[c] = rig.parts[c].rows
                rig.put(c, WithoutMotion(found.columns, block.whitening[:, c])(before[c]))

    def fit_widened(self, masks: PerKind) -> float:
        """Multiply the sigmas of landmarks, features and stars by what each kind's fit to itself tells, never below 1.

        Returns:
            the largest relative change.
        """
        change = 0.0
        for kind, fit in own_fits(self.problem(masks), self.part(masks)).items():
            before = self.widened[kind]
            if before > 1.0 or beyond_chance(fit.chi2, fit.freedom):
                after = max(1.0, before * math.sqrt(fit.chi2 / fit.freedom))
                self.widened = {**self.widened, kind: after}
                change = max(change, abs(after / before - 1.0))
        return change

    def fit_corners(self, masks: PerKind, *, robust: bool = False) -> float:
        """Set the corners' sigma from the boards' residuals, unless it was given.

        Args:
            masks: the items that take part.
            robust: by the median board, so that some wrong ones do not matter.

        Returns:
            its relative change.
        """
        boards, before = self.data.boards, self.sigma_corner
        if boards is None or boards.sigma is not None or not bool(masks.boards.any()):
            return 0.0
        squares, freedom = self.squares(masks).boards[masks.boards], self.freedom(masks).boards[masks.boards]
        dof = int(freedom.sum())
        if dof <= 0:
            return 0.0
        if robust:
            ratio = typical_ratio(squares, freedom)
        else:
            problem = self.problem(masks)
            # Where there is nothing but boards, they determine the shared unknowns too.
            alone = len(problem.blocks) == 1 and not self.terms
            free = problem.shared_size - int(self.unknowns.known.sum())
            ratio = float(squares.sum()) / max(dof - alone * free, 1)
        if 0 < ratio < math.inf:
            self.sigma_corner = max(self.sigma_corner * math.sqrt(ratio), _LEAST_SIGMA)
        return abs(self.sigma_corner / before - 1.0)


def _masks_of_fields(masks: PerKind) -> RigState:
    """For each tensor of a state the mask of its items; None for what all items share."""
    boards, landmarks, features, stars = masks
    return RigState(None, None, None, None, None, None, boards, boards, landmarks, features, features, stars)  # type: ignore[arg-type]


def _weighted(source: Landmarks | Features, mask: Tensor, times: float) -> tuple[Tensor, Tensor]:
    """Pixels and whitening of marks, their sigmas multiplied."""
    if isinstance(source, Features) and source.covariance is not None:
        # Where a mark is missing, its covariance may be anything.
        known = source.covariance[mask].nan_to_num(1.0)
        return source.pixels[mask], torch.linalg.inv(torch.linalg.cholesky_ex(known)[0]) / times
    pixels, sigma = source.pixels[mask], source.pixel_sigma
    each = sigma[mask] if isinstance(sigma, Tensor) else torch.tensor(sigma, dtype=torch.float64)
    return pixels, (torch.eye(2, dtype=torch.float64) / (times * each[..., None, None])).expand(*pixels.shape, 2)


def _of_all(masks: PerKind, problem: RigProblem, values: Sequence[Tensor]) -> PerKind:
    """Values of each block's items put among all items: NaN for the others, infinite where a value is not finite."""
    found = PerKind(*(torch.full(mask.shape, math.nan, dtype=torch.float64) for mask in masks))
    for block, part in zip(problem.blocks, values, strict=True):
        getattr(found, block.kind)[getattr(masks, block.kind)] = part.nan_to_num(math.inf, math.inf)
    return found


def typical_ratio(squares: Tensor, freedom: Tensor) -> float:
    """Median of χ² over what its median should be; 1 for fewer than four items."""
    known = (freedom > 0) & torch.isfinite(squares)
    if int(known.sum()) < 4:
        return 1.0
    return float((squares[known] / chi2_quantile(freedom[known], 0.5)).median())


def _star_start(data: RigData, start: Start) -> Tensor:
    """Directions (S, 3) of the catalogue; without a name, along the ray of the first camera that has one."""
    stars = data.stars
    if stars is None:
        return torch.empty(0, 3, dtype=torch.float64)
    seen = _first_rays(data, start, stars.pixels, torch.zeros(len(stars.names), dtype=torch.float64), start.center[0])
    direction = torch.where(stars.named[:, None], stars.direction, seen)
    return direction / torch.linalg.vector_norm(direction, dim=-1, keepdim=True)


def _first_rays(data: RigData, start: Start, pixels: Tensor, inverse: Tensor, anchor: Tensor) -> Tensor:
    """(F, 3) from the anchor along the ray of the first camera that has one, at inverse ranges (F,); else up."""
    direction = torch.zeros(len(pixels), 3, dtype=torch.float64)
    direction[:, 2] = 1.0
    for c in reversed(range(len(data.cameras))):
        rays, valid = data.cameras[c].unproject(pixels[:, c])
        towards = rays @ start.rotation[c] - inverse[:, None] * (anchor - start.center[c])
        direction = torch.where(valid[:, None], towards, direction)
    return direction


def _feature_start(data: RigData, start: Start, anchor: Tensor) -> tuple[Tensor, Tensor]:
    """Directions and inverse ranges: along the ray of the first camera that has one, at the range that is expected."""
    features = data.features
    if features is None:
        return torch.empty(0, 3, dtype=torch.float64), torch.empty(0, dtype=torch.float64)
    inverse = torch.where(torch.isfinite(features.inverse_range_sigma), features.inverse_range, 0.0)
    direction = _first_rays(data, start, features.pixels, inverse, anchor)
    return direction / torch.linalg.vector_norm(direction, dim=-1, keepdim=True), inverse


# Tell which items of a joint adjustment do not belong: compare their χ² with what noise, and lenses, explain.
#
# A board's χ² has two parts. What each camera alone leaves over, with a board pose of its own, is due to corners and
# lens: a lens that is not quite its model fits one board worse than another, which no noise explains and no rig can
# mend. The rest, six degrees of freedom for every further camera, is what the board says about the rig. Only that part
# tells of a board that moved between two exposures.

# Probability that any good item at all is taken for a wrong one.
FALSE_ALARM = 1e-3
# px along an axis, RMS of a board, that lenses which are not quite their models may add to each of the two parts.
# Measured: five coefficients on simulated ray-traced wide lenses, ordinarily put together, add 0.04 and 0.017.
_LENS, _BETWEEN = 0.1, 0.02
# With fewer boards nobody can say what is typical: one does not belong if its residuals are so many times as large as
# their noise.
_FEW_BOARDS, _WORSE_BOARD = 4, 3.0
# A board pose needs that many corners.
_CORNERS = 4
_POSES = LMOptions(max_iterations=30, tolerance=1e-8, residual_floor=1e-8)


def over_limit(work: Adjustment, masks: PerKind, values: PerKind, probability: float | None = None) -> PerKind:
    """χ² of every item over the largest that noise and lenses explain; 0 outside the masks.

    Args:
        work: the adjustment as it stands.
        masks: the items.
        values: their χ², or by how much it would fall without them.
        probability: that a good item stays below 1, judged by the sigmas as they are. Left out: all items together
            nearly always do, and where a kind as a whole fits worse than stated, its items are judged by that.
    """
    squares, freedom = work.squares(masks), work.freedom(masks)
    level = probability or 1.0 - FALSE_ALARM / max(sum(int((dof > 0).sum()) for dof in freedom), 1)
    boards = _boards_over_limit(work, masks.boards, values.boards, squares.boards, freedom.boards, level, probability)
    found = [boards]
    for mask, value, square, dof in list(zip(masks, values, squares, freedom, strict=True))[1:]:
        scale = 1.0 if probability else max(1.0, typical_ratio(square, dof))
        found.append(torch.where(mask, value / (scale * chi2_quantile(dof, level)), 0.0))
    return PerKind(*found)


def _boards_over_limit(
    work: Adjustment, mask: Tensor, value: Tensor, square: Tensor, dof: Tensor, level: float, probability: float | None
) -> Tensor:
    """Each board by the part of its χ² that is farther over its limit."""
    if not bool(mask.any()):
        return torch.zeros(mask.shape, dtype=torch.float64)
    alone, further = _each_camera_alone(work, mask)
    lens, between = (share**2 * dof / work.sigma_corner**2 for share in (_LENS, _BETWEEN))
    own = (dof - further).clamp_min(0)
    scales = (1.0, 1.0) if probability else (typical_ratio(alone, own), typical_ratio(square - alone, further))
    first = max(1.0, scales[0]) * chi2_quantile(own, level) + lens
    second = max(1.0, scales[1]) * chi2_quantile(further, level) + between
    if int((dof > 0).sum()) < _FEW_BOARDS:
        first, second = (torch.maximum(limit, _WORSE_BOARD**2 * dof) for limit in (first, second))
    return torch.where(mask, torch.maximum(alone / first, (value - alone) / second), 0.0)


def _each_camera_alone(work: Adjustment, mask: Tensor) -> tuple[Tensor, Tensor]:
    """χ² of every board with a pose of its own for each camera, and how many degrees of freedom that costs."""
    boards, cameras = work.data.boards, work.data.cameras
    assert boards is not None
    squares = torch.full(mask.shape, torch.nan, dtype=torch.float64)
    squares[mask] = 0.0
    further = torch.zeros(mask.shape, dtype=torch.int64)
    whitening, still = work.corner_whitening(), [False] * len(cameras)
    for c in range(len(cameras)):
        some = mask & (torch.isfinite(boards.pixels[:, c]).all(-1).sum(-1) >= _CORNERS)
        if not bool(some.any()):
            continue
        pixels = torch.full_like(boards.pixels[some], torch.nan)
        pixels[:, c] = boards.pixels[some, c]
        block = BoardBlock(pixels, whitening[some], boards.points, work.unknowns.shapes)
        problem = RigProblem(cameras, [block], (), held(cameras), still, still)
        start = work.part(work.none()._replace(boards=some))
        found = RigState(*minimize(problem, start, _POSES).state)
        squares[some] += problem.item_squares(found)[0]
        further[some] += LOCAL_SIZE
    return squares, (further - LOCAL_SIZE).clamp_min(0)


# Find what contradicts the rest of a joint adjustment: worst first, and back in what does not after all.

# Of the root of an item's mean square: an item three times worse than stated counts half.
LOSS = RobustLoss(kind="cauchy", scale=3.0)
# Robust solutions only tell what is wrong; they need no digits.
ROUGHLY = LMOptions(max_iterations=100, tolerance=1e-6, residual_floor=1e-8)
# If more than this share of a source is wrong, it is not a few items that are.
MOST_WRONG = 0.4
# A source whose typical item is off by so many times its sigma is wrong as a whole.
WRONG_AS_A_WHOLE = 20.0
_ROUNDS = 30


def without_wrong(work: Adjustment, masks: PerKind, solver: LMOptions) -> PerKind:
    """Solve without the items that contradict the rest: the worst is left out first; what fits after all returns.

    Args:
        work: at a robust solution; it is left at the solution without the wrong items.
        masks: items that may take part.
        solver: options of the solver.

    Returns:
        masks of the items that agree.

    Raises:
        InputError: not a few items are wrong but a source as a whole.
    """
    squares, freedom = work.squares(masks), work.freedom(masks)
    for kind, square, dof in zip(KINDS, squares, freedom, strict=True):
        if (times := math.sqrt(typical_ratio(square, dof))) > WRONG_AS_A_WHOLE:
            raise InputError(
                f"the {kind} contradict each other or the rest: typically they are {times:.0f} times as far off as "
                f"their sigmas say; {_to_check(kind)}"
            )
    over = over_limit(work, masks, squares)
    kept = PerKind(*(mask & ~(ratio > 1.0) for mask, ratio in zip(masks, over, strict=True)))
    _refuse_many(work, kept, masks)
    returned: set[tuple[int, int]] = set()
    for _ in range(_ROUNDS):
        work.solve(kept, solver)
        work.fit_corners(kept)
        # Each item by the fall of χ² without it, which sees leverage, but against what is typical of the plain χ².
        found = over_limit(work, kept, work.deletions(kept))
        worst = max(range(len(found)), key=lambda k: float(found[k].max()) if len(found[k]) else 0.0)
        if len(found[worst]) and float(found[worst].max()) > 1.0:
            kept[worst][int(found[worst].argmax())] = False
            _refuse_many(work, kept, masks)
            continue
        # With the cameras held where they are now, try again what was left out.
        outside = PerKind(*(before & ~after for before, after in zip(masks, kept, strict=True)))
        work.solve(outside, solver, held=True)
        again = False
        for k, ratio in enumerate(over_limit(work, outside, work.squares(outside), 0.999)):
            for i in (outside[k] & (ratio < 1.0)).nonzero()[:, 0].tolist():
                if (k, i) not in returned:
                    returned.add((k, i))
                    kept[k][i] = again = True
        if not again:
            break
    return kept


def possible(work: Adjustment, masks: PerKind) -> PerKind:
    """Masks without what has no projection at the present state: behind a camera, or beyond what its lens shows."""
    return PerKind(*(mask & torch.isfinite(square) for mask, square in zip(masks, work.squares(masks), strict=True)))


def _refuse_many(work: Adjustment, kept: PerKind, masks: PerKind) -> None:
    for kind, after, before in zip(KINDS, kept, masks, strict=True):
        gone, total = int((before & ~after).sum()), int(before.sum())
        if gone > max(1, MOST_WRONG * total):
            names: Sequence[str] = [work.names(kind)[i] for i in (before & ~after).nonzero()[:, 0].tolist()]
            raise InputError(
                f"{gone} of {total} {kind} contradict the rest ({', '.join(names[:6])}{' ...' if gone > 6 else ''}): "
                f"these are not a few wrong ones; {_to_check(kind)}"
            )


def _to_check(kind: Kind) -> str:
    """What may be wrong with a source as a whole."""
    if kind == "boards":
        return "were both views of each pair taken at the same moment, of one board, and by these cameras?"
    more = ", and time, zone and place of the night images" if kind == "stars" else ""
    return f"check names, units, heights, sigmas and that the cameras are these{more}"
