"""Which items of a rig contradict the others, and what explains it: mix-ups, wrong places, too little redundancy."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.rig.adjustment import LOSS, MOST_WRONG, ROUGHLY, Adjustment, next_out, without_wrong
from kcal.calibrate.rig.contradictions import parts_of
from kcal.calibrate.rig.marks import FeatureBlock
from kcal.calibrate.rig.problem import GoodnessOfFit, RigProblem, RigSolution, goodness_of_fit, least
from kcal.calibrate.rig.resection import consensus_pose
from kcal.calibrate.rig.source import RigState
from kcal.calibrate.rig.sources import RigData
from kcal.errors import ContradictionError, DegenerateError, InputError
from kcal.finding import Finding
from kcal.solve.lm import LMOptions
from kcal.texts import length_text, measured_length

# Recognize cameras that were mixed up: the same one given twice, or left and right swapped throughout.
#
# A swap of cameras against their data contradicts itself (`kcal.calibrate.rig.pairs.check_cameras`). A swap
# of everything does not: the rig is solved as well as any, with the right camera on the left side. Only the names tell.

# The right camera is on the wrong side if it is to the left by more than this share of the baseline: cameras above each
# other have no left and right.
_SIDEWAYS = 0.5
# A feature is behind the cameras if its inverse range is negative by so many of its standard deviations.
_BEHIND_SIGMAS = 4.0
BEHIND = "its marks have negative parallax, as if it were behind the cameras: not the same point"
# A single wrong match counts no more than an item that is three times worse than its sigmas.
_MOST_BEHIND = 9.0
# Meters: masts of a pair are 10 to 500 m apart, and landmarks that can be surveyed and marked stand before the horizon.
_FAR_APART, _FAR_LANDMARKS = 1e3, 5e4
# Fewer equal pixels may be equal by chance.
_EQUAL_PIXELS = 4
# χ² of three degrees of freedom that chance exceeds once in 1000 times.
_AT_ONE_PLACE = 16.27


def refuse_same_camera(data: RigData) -> None:
    """Raise `InputError` if two cameras have the same pixels of everything that both saw."""
    for one in range(len(data.cameras)):
        for other in range(one):
            pairs = [source.pixels[:, [other, one]].movedim(1, -2).flatten(0, -3) for source in data.seen]
            # Skylines and measured positions have no pixels in common.
            if not pairs:
                continue
            both = torch.cat([pair[torch.isfinite(pair).all(-1).all(-1)] for pair in pairs])
            if len(both) >= _EQUAL_PIXELS and torch.equal(both[:, 0], both[:, 1]):
                raise InputError(
                    f"{data.names[other]} and {data.names[one]} have the same pixels everywhere: this is the same "
                    "camera twice; give the observations and marks of two cameras, or of one camera at two places"
                )


def refuse_one_place(data: RigData, solution: RigSolution) -> None:
    """Raise `InputError` if one camera was given at two places, and its images come from one and the same."""
    state, lenses = solution.state, data.lenses
    for second, lens in enumerate(lenses):
        for first in (c for c in range(second) if lenses[c] == lens):
            rows = solution.relative_rows(first, second)[3:]
            shift = state.rotation[second] @ (state.center[first] - state.center[second])
            known, determined = solution.of(rows)
            if bool(determined.all()) and float(shift @ torch.linalg.pinv(known) @ shift) < _AT_ONE_PLACE:
                apart, sigma = float(shift.norm()), float(known.diagonal().sum().sqrt())
                raise InputError(
                    f"{data.names[first]} and {data.names[second]} are one camera at one place: they stand "
                    f"{measured_length(apart, sigma)} apart, which is no baseline. The images show the same view, or "
                    "the camera was only turned; give images from two places, or the files of two cameras"
                )


def one_camera_doubts(data: RigData) -> list[Finding]:
    """Doubt boards seen by one camera from two places, which it cannot have seen at the same moment."""
    assert data.boards is not None
    seen, lenses = torch.isfinite(data.boards.pixels).all(-1).any(-1), data.lenses
    return [
        Finding(
            "synchronization",
            "doubt",
            f"{data.names[first]} and {data.names[second]} are one camera at two places, and {count} boards were seen "
            "from both: this is right only if no board moved while the camera was moved",
            "otherwise leave --pairs out",
        )
        for second, lens in enumerate(lenses)
        for first in range(second)
        if lenses[first] == lens and (count := int(seen[:, [first, second]].all(-1).sum()))
    ]


def swap_findings(data: RigData, solution: RigSolution) -> list[Finding]:
    """Tell if left and right are swapped: by the side on which the right camera is, and by features behind both.

    Args:
        data: only cameras named `left` and `right` have sides.
        solution: of these.
    """
    found, state = [], solution.state
    if {"left", "right"} <= set(data.names):
        left, right = data.names.index("left"), data.names.index("right")
        shift = state.center[right] - state.center[left]
        side = float(shift @ _rightward(data, state, left, right))
        length = float(torch.linalg.vector_norm(shift))
        if side < -_SIDEWAYS * length:
            # Without a vertical, right is where the left camera has it.
            otherwise = "" if data.absolute else " (or both cameras hang upside down)"
            text = f"the right camera is {-side:.3g} m to the left of the left camera: left and right are swapped"
            action = "exchange their cameras, observations and marks"
            found.append(Finding("swapped", "doubt", f"{text}{otherwise}", action))
    over = _over_limit_behind(solution)
    behind, seen = int((over > 1.0).sum()), len(over)
    if behind > seen / 2:
        text = (
            f"{behind} of {seen} features have negative parallax, as if they were behind the cameras: left and right "
            "marks are swapped, or are not of the same points"
        )
        found.append(Finding("swapped", "doubt", text))
    return found


def survey_unit_findings(data: RigData, solution: RigSolution) -> list[Finding]:
    """Ask for the survey's unit if cameras or landmarks are farther apart than is common, and no other length tells."""
    if data.landmarks is None or data.boards is not None or data.baselines:
        return []
    centers = solution.state.center
    apart = float(torch.cdist(centers, centers).max()) if {"left", "right"} == set(data.names) else 0.0
    far = float(torch.cdist(data.landmarks.points, centers).median())
    if apart <= _FAR_APART and far <= _FAR_LANDMARKS:
        return []
    cameras = f", and the cameras {length_text(apart)} apart" if apart else ""
    text = f"landmarks are {length_text(far)} away (median){cameras}, as if the survey were not in meters"
    return [Finding("units", "doubt", text, "convert it to meters; a measured baseline would settle it")]


def cost_of_features_behind(problem: RigProblem, state: RigState) -> float:
    """Half the squares, in sigmas, of how far marks of features behind the cameras are from those at infinity.

    A rig and its mirror image, in which the baseline is reversed and inverse ranges are negative, fit features of
    unknown range alike. This cost tells them apart.
    """
    posed, cost = problem.posed(state), 0.0
    for block, own in problem.parts(state):
        if isinstance(block, FeatureBlock):
            by_inverse_range = block.rows(posed, own, problem.shared_size)[:, block.size - 1]
            squares = (own.items[:, 3:4].clamp_max(0.0) * by_inverse_range).square().sum(-1)
            cost += 0.5 * float(squares.clamp_max(_MOST_BEHIND).sum())
    return cost


def _rightward(data: RigData, state: RigState, left: int, right: int) -> Tensor:
    """To the right of where both cameras look, level where the frame knows what is up."""
    if not data.absolute:
        return state.rotation[left, 0]
    ahead = state.rotation[[left, right], 2].mean(0)
    # Ahead × up.
    across = torch.stack([ahead[1], -ahead[0], torch.zeros_like(ahead[0])])
    return across / torch.linalg.vector_norm(across)


def _over_limit_behind(solution: RigSolution) -> Tensor:
    """(F,) how far features are behind the cameras, over the farthest that chance explains."""
    problem, state = solution.problem, solution.state
    for block, own in problem.parts(state):
        if isinstance(block, FeatureBlock):
            # The last local unknown is the inverse range; what the cameras' errors make of it is added.
            follow, alone = (value[:, -1] for value in problem.response(state, block))
            variance = solution.variances(follow) + alone[:, -1]
            return -own.items[:, 3] / (_BEHIND_SIGMAS * variance.sqrt())
    return torch.zeros(0, dtype=torch.float64)


def without_behind(work: Adjustment, mask: Tensor, kept: Tensor, solver: LMOptions) -> tuple[Tensor, Tensor]:
    """Leave out features behind the cameras as well: nothing is there, and a wrong match on its line has no residual.

    The worst is left out first, because it may put others behind; of thousands, the worst thousandth. Most of them are
    behind where left and right are swapped, which `swap_findings` tells.

    Args:
        work: at the solution of what was kept.
        mask: items that may take part.
        kept: those that agree.
        solver: options of the solver.

    Returns:
        mask of the items that agree then, and of those behind.
    """
    behind, at = torch.zeros_like(mask), work.at("features")
    while bool(kept[at].any()):
        over = _over_limit_behind(RigSolution(work.problem(kept), work.part(kept)))
        if not 0 < int((over > 1.0).sum()) <= len(over) / 2:
            break
        worst, before = at.start + kept[at].nonzero()[next_out(over, len(over)), 0], work.state
        behind[worst] = True
        try:
            kept = explained(work, mask & ~behind, solver)
        except InputError:
            # The rest contradicts itself without it: sigmas tell that better than a refusal.
            behind[worst], work.state = False, before
            break
    return kept, behind


# Count what is left over to check where each camera of a rig stands.


def redundancy(problem: RigProblem) -> list[int | None]:
    """How many residuals more than unknowns each camera adds to the others; None for one that stands still.

    With 0 a camera is determined exactly, and no residual would tell that it stands elsewhere.
    """
    added = torch.zeros(len(problem.cameras), dtype=torch.long)
    for block in problem.blocks:
        added += block.added
    for term in problem.terms:
        added[list(term.about)] += term.count
    slots = zip(problem.turn, problem.shift, strict=True)
    unknown = [3 * (turn is not None) + 3 * (shift is not None) for turn, shift in slots]
    return [count - own if own else None for count, own in zip(added.tolist(), unknown, strict=True)]


def least_redundancy(problem: RigProblem) -> int:
    """The smallest `redundancy` of a camera."""
    return min(count for count in redundancy(problem) if count is not None)


def refuse_exact(problem: RigProblem, names: Sequence[str], freedom: int) -> None:
    """Raise `DegenerateError` where nothing is left over to check a camera with.

    Args:
        problem: of what agrees.
        names: of the cameras.
        freedom: degrees of freedom of all of it.
    """
    exact = [name for name, count in zip(names, redundancy(problem), strict=True) if count is not None and count <= 0]
    if not exact and freedom > 0:
        return
    marks = [block.seen.any(-1).sum(0).tolist() for block in problem.blocks if block.surveyed]
    counted = [f"{marks[0][c]} landmarks" for c, name in enumerate(names) if marks and name in exact]
    who = " and ".join(exact) or "the cameras"
    why = f" ({', '.join(counted)}; three fit up to four places)" if counted else ""
    raise DegenerateError(
        f"the data determine where {who} stand{'s' if len(exact) == 1 else ''} exactly{why}: nothing is left over to "
        "check it with, and a wrong measurement, or another place that fits as well, could not be noticed. Mark at "
        "least one more surveyed landmark in both images (six or more are good), or add boards or features seen by "
        "both, a measured baseline or measured positions"
    )


# Look for other explanations of a contradiction: measurements, and with few landmarks any of these.
#
# Of many landmarks the wrong ones are in the minority and stand out. Of five, one that is wrong may make two good ones
# look worse, and three that are left fit anything. So every choice of landmarks and measurements to leave out is tried,
# fewest first, as long as something is left over to check the rest with.

# Up to so many landmarks every explanation is tried, if there are not more of them than this.
_FEW, _MOST_TRIED = 9, 64
# By how much less χ² one explanation must have than another to be the likelier one beyond reasonable doubt: a thousand
# to one.
AS_GOOD = 2.0 * math.log(1000.0)
TRIAL = LMOptions(max_iterations=40, tolerance=1e-7, residual_floor=1e-8)


class _Explanation(NamedTuple):
    """One way to explain a contradiction.

    Attributes:
        names: what is left out is called.
        mask: the items that take part.
        terms: numbers of the measurements that do not.
        fit: of the rest.
        size: how many points are left out.
    """

    names: tuple[str, ...]
    mask: Tensor
    terms: frozenset[int]
    fit: GoodnessOfFit
    size: int

    @classmethod
    def of(cls, work: Adjustment, mask: Tensor, names: tuple[str, ...], size: int) -> _Explanation:
        """What an adjustment to the items in the mask says."""
        return cls(names, mask, work.without, goodness_of_fit(work.problem(mask), work.part(mask)), size)


def explained(work: Adjustment, mask: Tensor, solver: LMOptions) -> Tensor:
    """Leave out what is wrong (`kcal.calibrate.rig.adjustment.without_wrong`), and compare other explanations.

    A wrong measurement can make good items look wrong. So each measurement is left out in turn, to see whether fewer
    items are wrong without it. Where few landmarks decide, all explanations are compared.

    Raises:
        InputError: not a few items are wrong; several explanations are equally good, or none leaves anything to check
            it with; they are named.
    """
    failure: InputError | None = None
    kept, robust = mask, work.state
    try:
        kept = without_wrong(work, mask, solver)
    except InputError as error:
        failure = error
    few = int(mask[work.at("landmarks")].sum()) <= _FEW and decided_by_landmarks(work, mask)
    gone = int((mask & ~kept).sum())
    if not few and (failure is not None or gone):
        _refuse_terms(work, mask, None if failure is not None else kept, robust, solver)
    if failure is not None and not few:
        raise failure
    if not few or (not failure and not gone and goodness_of_fit(work.problem(mask), work.part(mask)).variance == 1.0):
        return kept
    marks = int(mask[work.at("landmarks")].sum())
    # Nothing stands out, yet χ² is too large: a wrong item may have bent the solution towards itself.
    most = max(1, int(MOST_WRONG * marks)) if failure is not None or gone else 1
    found = _explanations(work, mask, kept, robust, most)
    if not found:
        if failure is not None:
            raise failure
        if not gone:
            return kept
        wrong, at = work.none(), work.at("landmarks")
        wrong[at] = (mask & ~kept)[at]
        raise InputError(
            "the landmarks contradict each other, and whichever are left out, the rest does not agree, or too few are "
            f"left to check it with ({marks} landmarks; worst: {', '.join(_gone(work, wrong)) or 'all of them'}): "
            "check names, coordinates and marks, and add landmarks"
        )
    if len(found) > 1:
        raise _several_ways([f"{' and '.join(one.names)} (χ² {one.fit.chi2:.3g})" for one in found[:3]])
    (best,) = found
    if best.terms:
        raise _blamed(best)
    work.state = robust
    work.solve(best.mask, solver)
    work.fit_corners(best.mask)
    return best.mask


def _excess(found: _Explanation) -> float:
    """By how much χ² is above what it should be."""
    return found.fit.chi2 - found.fit.freedom


def _blamed(found: _Explanation) -> ContradictionError:
    one = "s" if len(found.names) == 1 else ""
    return ContradictionError(
        f"{' and '.join(found.names)} contradict{one} the rest, which agrees otherwise (χ² {found.fit.chi2:.3g}): "
        "measure again, correct the value or its sigma, or leave it out"
    )


def _several_ways(ways: Sequence[str]) -> InputError:
    return InputError(
        f"something is wrong, and the data do not tell what: all the rest agrees without {'; or '.join(ways)}. Check "
        "these, or add landmarks"
    )


def _refuse_terms(work: Adjustment, mask: Tensor, kept: Tensor | None, robust: RigState, solver: LMOptions) -> None:
    """Raise `InputError` if a baseline or position is as likely to be wrong as items that were left out.

    Args:
        work: at the solution of what was kept.
        mask: items that may take part.
        kept: those that agree; None if not a few of them are wrong.
        robust: state to begin with.
        solver: options of the solver.
    """
    ways: list[_Explanation] = []
    if kept is not None:
        names = tuple(_gone(work, mask & ~kept))
        ways.append(_Explanation.of(work, kept, names, len(names)))
    some = mask if kept is None else kept
    parts = parts_of(work, work.problem(some), work.part(some))
    whole = torch.stack([part.gram for part in parts]).sum(0)
    for part in parts:
        # The others must determine as much without it.
        if part.term is None or least(whole - part.gram).rank != least(whole).rank:
            continue
        trial = copy.copy(work)
        trial.state, trial.without = robust, frozenset([part.term])
        # Without the measurement, the robust solution is found anew.
        trial.solve(mask, ROUGHLY, LOSS)
        try:
            others = without_wrong(trial, mask, solver)
        except InputError:
            continue
        ways.append(_Explanation.of(trial, others, (part.name,), 1 + int((mask & ~others).sum())))
    fewest = min((way.size for way in ways), default=0)
    ways = sorted((way for way in ways if way.size == fewest), key=_excess)
    ways = [way for way in ways if _excess(way) < _excess(ways[0]) + AS_GOOD]
    stated = [way for way in ways if way.terms]
    if len(ways) == 1 and stated:
        raise _blamed(stated[0])
    if stated:
        raise _several_ways([
            f"{' and '.join(way.names)} (χ² {way.fit.chi2:.3g}, {way.fit.freedom} degrees of freedom)" for way in ways
        ])  # fmt: skip


def _gone(work: Adjustment, mask: Tensor) -> list[str]:
    """What the items in the mask are called."""
    return [work.labels[i] for i in mask.nonzero()[:, 0].tolist()]


def decided_by_landmarks(work: Adjustment, mask: Tensor) -> bool:
    """Whether a camera depends on landmarks."""
    others, at = mask.clone(), work.at("landmarks")
    if not bool(mask[at].any()):
        return False
    others[at] = False
    rest = work.problem(others)
    return not rest.blocks or least_redundancy(rest) <= 0


def _explanations(work: Adjustment, mask: Tensor, kept: Tensor, robust: RigState, most: int) -> list[_Explanation]:
    """All explanations that are as good as the best, of those that leave out the fewest."""
    at = work.at("landmarks")
    marks = (at.start + mask[at].nonzero()[:, 0]).tolist()
    things: list[tuple[bool, int]] = [(True, i) for i in marks] + [(False, i) for i in range(len(work.terms))]
    labels = work.term_labels
    for size in range(1, most + 1):
        if math.comb(len(things), size) > _MOST_TRIED:
            break
        found: list[_Explanation] = []
        for chosen in itertools.combinations(things, size):
            trial = copy.copy(work)
            trial.state = robust
            trial.without = frozenset(i for landmark, i in chosen if not landmark)
            some = kept.clone()
            some[at] = mask[at]
            some[[i for landmark, i in chosen if landmark]] = False
            if least_redundancy(trial.problem(some)) <= 0 or not _solved(trial, some):
                continue
            names = tuple(work.labels[i] if landmark else labels[i] for landmark, i in chosen)
            found.append(_Explanation.of(trial, some, names, size))
        if found:
            best = min(one.fit.chi2 for one in found)
            return sorted((one for one in found if one.fit.chi2 < best + AS_GOOD), key=lambda one: one.fit.chi2)
    return []


def _solved(trial: Adjustment, mask: Tensor) -> bool:
    """Whether χ² is small enough at the solution from here, or from where landmarks alone put the cameras."""
    for state in filter(None, (trial.state, _resected(trial, mask))):
        trial.state = state
        problem, _ = trial.solve(mask, TRIAL)
        fit = goodness_of_fit(problem, trial.part(mask))
        if fit.freedom > 0 and fit.variance == 1.0:
            return True
    return False


def _resected(work: Adjustment, mask: Tensor) -> RigState | None:
    """The state with the cameras where most of the landmarks in the mask put them; None if these do not suffice."""
    marks, state, at = work.data.landmarks, work.state, work.at("landmarks")
    assert marks is not None
    rotation, center = state.rotation.clone(), state.center.clone()
    for c, camera in enumerate(work.data.cameras):
        rays, valid = camera.unproject(marks.pixels[:, c])
        found = consensus_pose(rays[valid & mask[at]], marks.points[valid & mask[at]])
        if found is None:
            return None
        rotation[c], center[c] = found[0], found[1]
    return work.at_survey(state._replace(rotation=rotation, center=center))
