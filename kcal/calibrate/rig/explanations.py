"""Look for other explanations of a contradiction: measurements, and with few landmarks any of these.

Of many landmarks the wrong ones are in the minority and stand out. Of five, one that is wrong may make two good ones
look worse, and three that are left fit anything. So every choice of landmarks and measurements to leave out is tried,
fewest first, as long as something is left over to check the rest with.
"""

from __future__ import annotations

import copy
import itertools
import math
from typing import NamedTuple

import torch

from kcal.calibrate.rig.adjustment import Adjustment
from kcal.calibrate.rig.blocks import KINDS, Kind, PerKind, RigState
from kcal.calibrate.rig.contradictions import still_determined
from kcal.calibrate.rig.outliers import LOSS, MOST_WRONG, ROUGHLY, without_wrong
from kcal.calibrate.rig.redundancy import least_redundancy
from kcal.calibrate.rig.resection import consensus_pose
from kcal.calibrate.rig.uncertainty import goodness_of_fit
from kcal.errors import InputError
from kcal.solve.lm import LMOptions

# Up to so many landmarks every explanation is tried, if there are not more of them than this.
_FEW, _MOST_TRIED = 9, 64
# By how much less χ² one explanation must have than another to be the likelier one beyond reasonable doubt: a thousand
# to one.
AS_GOOD = 2.0 * math.log(1000.0)
TRIAL = LMOptions(max_iterations=40, tolerance=1e-7, residual_floor=1e-8)


class _Explanation(NamedTuple):
    """What is left out, by masks and by indices of terms, what that is called, and the χ² of the rest."""

    masks: PerKind
    terms: frozenset[int]
    names: tuple[str, ...]
    chi2: float


def explained(work: Adjustment, masks: PerKind, solver: LMOptions) -> PerKind:
    """As `kcal.calibrate.rig.outliers.without_wrong`, but other explanations are compared.

    A measurement that is wrong can make good items look worse; so it is asked whether fewer are wrong without it. Where
    few landmarks decide, all explanations are compared.

    Raises:
        InputError: not a few items are wrong; several explanations are equally good, or none leaves anything to check
            it with; they are named.
    """
    failure: InputError | None = None
    kept, robust = masks, work.state
    try:
        kept = without_wrong(work, masks, solver)
    except InputError as error:
        failure = error
    few = decided_by_few(work, masks)
    gone = _count(masks) - _count(kept)
    if not few and (failure is not None or gone):
        _refuse_terms(work, masks, None if failure is not None else kept, robust, solver)
    if failure is not None and not few:
        raise failure
    if not few or (failure is None and not gone and _agree(work, masks)):
        return kept
    marks = int(masks.landmarks.sum())
    # Nothing stands out, and yet it does not fit: one may be wrong that bends the others towards itself.
    most = max(1, int(MOST_WRONG * marks)) if failure is not None or gone else 1
    found = _explanations(work, masks, kept, robust, most)
    if not found:
        if failure is not None:
            raise failure
        if not gone:
            return kept
        raise InputError(
            "the landmarks contradict each other, and whichever are left out, the rest does not agree, or too few are "
            f"left to check it with ({marks} landmarks; worst: {_worst_names(work, masks, kept)}): check names, "
            "coordinates and marks, and add landmarks"
        )
    if len(found) > 1:
        ways = "; or ".join(f"{' and '.join(one.names)} (χ² {one.chi2:.3g})" for one in found[:3])
        raise InputError(
            f"something is wrong, and the data do not tell what: all the rest agrees without {ways}. Check these, or "
            "add landmarks"
        )
    (best,) = found
    if best.terms:
        raise InputError(_blamed(best.names, best.chi2))
    work.state = robust
    work.solve(best.masks, solver)
    work.fit_corners(best.masks)
    return best.masks


def _count(masks: PerKind) -> int:
    return sum(int(mask.sum()) for mask in masks)


def _agree(work: Adjustment, masks: PerKind) -> bool:
    """Whether χ² is no larger than chance explains."""
    return goodness_of_fit(work.problem(masks), work.part(masks)).variance == 1.0


def _blamed(names: tuple[str, ...], chi2: float) -> str:
    return (
        f"{' and '.join(names)} contradict{'s' if len(names) == 1 else ''} the rest, which agrees otherwise (χ² "
        f"{chi2:.3g}): measure again, correct the value or its sigma, or leave it out"
    )


def _refuse_terms(work: Adjustment, masks: PerKind, kept: PerKind | None, robust: RigState, solver: LMOptions) -> None:
    """Raise `InputError` if a baseline or position is as likely to be wrong as items that were left out.

    Args:
        work: at the solution of what was kept.
        masks: items that may take part.
        kept: those that agree; None if not a few of them are wrong.
        robust: state to begin with.
        solver: options of the solver.
    """
    ways: list[_Way] = []
    if kept is not None:
        names = tuple(name for kind in KINDS for name in _gone(work, masks, kept, kind))
        ways.append(_way(work, kept, names, len(names)))
    some = masks if kept is None else kept
    for term, determined in enumerate(still_determined(work.problem(some), work.part(some))):
        if not determined:
            continue
        trial = copy.copy(work)
        trial.state, trial.without = robust, frozenset([term])
        # What it bent towards itself is bent back.
        trial.solve(masks, ROUGHLY, LOSS)
        try:
            others = without_wrong(trial, masks, solver)
        except InputError:
            continue
        ways.append(_way(trial, others, (work.term_labels[term],), 1 + _count(masks) - _count(others)))
    fewest = min((way.size for way in ways), default=0)
    ways = sorted((way for way in ways if way.size == fewest), key=lambda way: way.chi2 - way.freedom)
    if not ways:
        return
    ways = [way for way in ways if way.chi2 - way.freedom < ways[0].chi2 - ways[0].freedom + AS_GOOD]
    stated = [way for way in ways if not way.items]
    if len(ways) == 1 and stated:
        raise InputError(_blamed(stated[0].names, stated[0].chi2))
    if stated:
        told = "; or ".join(
            f"{' and '.join(way.names)} (χ² {way.chi2:.3g}, {way.freedom} degrees of freedom)" for way in ways
        )
        raise InputError(
            f"something is wrong, and the data do not tell what: all the rest agrees without {told}. Check these, or "
            "add landmarks"
        )


class _Way(NamedTuple):
    """An explanation: what is left out, how many things, whether they are items, and how well the rest agrees."""

    names: tuple[str, ...]
    size: int
    items: bool
    chi2: float
    freedom: int


def _way(work: Adjustment, kept: PerKind, names: tuple[str, ...], size: int) -> _Way:
    fit = goodness_of_fit(work.problem(kept), work.part(kept))
    return _Way(names, size, not work.without, fit.chi2, fit.freedom)


def _gone(work: Adjustment, masks: PerKind, kept: PerKind, kind: Kind) -> list[str]:
    """Names of the items of a kind that were left out."""
    names = work.names(kind)
    return [
        f"{kind.removesuffix('s')} {names[i]}" for i in (getattr(masks, kind) & ~getattr(kept, kind)).nonzero()[:, 0]
    ]


def _worst_names(work: Adjustment, masks: PerKind, kept: PerKind) -> str:
    return ", ".join(_gone(work, masks, kept, "landmarks")) or "all of them"


def decided_by_few(work: Adjustment, masks: PerKind) -> bool:
    """Whether a camera depends on landmarks, and these are few."""
    count = int(masks.landmarks.sum())
    if not 0 < count <= _FEW:
        return False
    rest = work.problem(masks._replace(landmarks=torch.zeros_like(masks.landmarks)))
    return not rest.blocks or least_redundancy(rest) <= 0


def _explanations(work: Adjustment, masks: PerKind, kept: PerKind, robust: RigState, most: int) -> list[_Explanation]:
    """All explanations that are as good as the best, of those that leave out the fewest."""
    marks = masks.landmarks.nonzero()[:, 0].tolist()
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
            some = kept._replace(landmarks=masks.landmarks.clone())
            some.landmarks[[i for landmark, i in chosen if landmark]] = False
            if least_redundancy(trial.problem(some)) <= 0:
                continue
            fit = _solved(trial, some)
            if fit is None:
                continue
            names = tuple(f"landmark {work.names('landmarks')[i]}" if landmark else labels[i] for landmark, i in chosen)
            found.append(_Explanation(some, trial.without, names, fit))
        if found:
            best = min(one.chi2 for one in found)
            return sorted((one for one in found if one.chi2 < best + AS_GOOD), key=lambda one: one.chi2)
    return []


def _solved(trial: Adjustment, masks: PerKind) -> float | None:
    """The χ² of the best solution from here, or from where landmarks alone put the cameras; None if it is too large."""
    for state in (trial.state, _resected(trial, masks)):
        if state is None:
            continue
        trial.state = state
        problem, _ = trial.solve(masks, TRIAL)
        fit = goodness_of_fit(problem, trial.part(masks))
        if fit.freedom > 0 and fit.variance == 1.0:
            return fit.chi2
    return None


def _resected(work: Adjustment, masks: PerKind) -> RigState | None:
    """The state with the cameras where most of the landmarks in the masks put them; None if these do not suffice."""
    marks, state = work.data.landmarks, work.state
    assert marks is not None
    rotation, center = state.rotation.clone(), state.center.clone()
    for c, camera in enumerate(work.data.cameras):
        rays, valid = camera.unproject(marks.pixels[:, c])
        found = consensus_pose(rays[valid & masks.landmarks], marks.points[valid & masks.landmarks])
        if found is None:
            return None
        rotation[c], center[c] = found[0], found[1]
    return state._replace(rotation=rotation, center=center, points=marks.points)
