"""Where few landmarks tie a rig: look for other places of its cameras that fit as well, and refuse to choose.

Three landmarks put a camera in up to four places, and with noise a fourth or fifth does not always tell which.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Iterator

import torch
from torch import Tensor

from kcal.calibrate.rig.adjustment import Adjustment
from kcal.calibrate.rig.blocks import PerKind, RigState
from kcal.calibrate.rig.explanations import AS_GOOD, TRIAL, decided_by_few
from kcal.calibrate.rig.problem import RigProblem
from kcal.calibrate.rig.resection import distinct_poses
from kcal.calibrate.rig.uncertainty import goodness_of_fit
from kcal.calibrate.rig.unknowns import held
from kcal.errors import DegenerateError
from kcal.lens.pose import vector_from_rotation
from kcal.solve.lm import LMOptions

# Marks of one camera up to which other places are tried, how many of each camera's, and of all together.
_FEW_MARKS, _PLACES, _MOST = 6, 4, 64
# Times the noise that a ray may be off where three others place a camera: an adjustment spreads that over all.
_AWRY = 50.0
# Squared distance of two solutions, in standard deviations, beyond which they are not the same.
_OTHER = 100.0
# A few steps tell which places are hopeless: those with so many times too large a χ².
_GLANCE, _FAR = LMOptions(max_iterations=10, tolerance=1e-4, residual_floor=1e-8), 100.0


def refuse_several(work: Adjustment, masks: PerKind) -> None:
    """Raise `DegenerateError` if the cameras could as well stand elsewhere, with few landmarks.

    Args:
        work: at its solution; it stays there.
        masks: what agrees.
    """
    if not decided_by_few(work, masks):
        return
    here = copy.copy(work)
    here.unknowns = held(work.data.cameras)
    problem, _ = here.solve(masks, TRIAL)
    own = goodness_of_fit(problem, here.part(masks))
    matrix, scale = problem.linearize(here.part(masks)).information()
    for state in _other_places(here, masks):
        there = copy.copy(here)
        there.state = state
        if not _as_good(there, masks, own.chi2, own.variance):
            continue
        away = _step(problem, here.state, there.state) / scale
        if float(away @ matrix @ away) < _OTHER:
            continue
        names = work.data.names
        moved = (there.state.center - here.state.center).norm(dim=-1)
        which = int(moved.argmax())
        if len(names) == 2:
            apart = [float((one.state.center[1] - one.state.center[0]).norm()) for one in (here, there)]
            what = f"{names[1]} may be {apart[0]:.3g} m or {apart[1]:.3g} m from {names[0]}"
        else:
            what = f"{names[which]} may stand in two places {float(moved[which]):.3g} m apart"
        raise DegenerateError(
            f"the landmarks do not tell where the cameras stand: {what}, which fit alike ({own.freedom} degrees of "
            "freedom). Mark more surveyed landmarks in the images, or add a measured baseline or measured positions"
        )


def _as_good(work: Adjustment, masks: PerKind, chi2: float, variance: float) -> bool:
    """Whether the solution from here is as good; one that is far from it after a few steps is not followed."""
    for effort, times in ((_GLANCE, _FAR), (TRIAL, 1.0)):
        problem, _ = work.solve(masks, effort)
        if not 2.0 * float(problem.cost(work.part(masks))) < chi2 + times * AS_GOOD * variance:
            return False
    return True


def _step(problem: RigProblem, old: RigState, new: RigState) -> Tensor:
    """(S,) turns and shifts of the cameras from one state to another."""
    step = torch.zeros(problem.shared_size, dtype=torch.float64)
    turned = vector_from_rotation(new.rotation @ old.rotation.transpose(-1, -2))
    for c, (turn, shift) in enumerate(zip(problem.turn, problem.shift, strict=True)):
        if turn is not None:
            step[turn] = turned[c]
        if shift is not None:
            step[shift] = new.center[c] - old.center[c]
    return step


def _one_at_a_time(choices: list[list[tuple[Tensor, Tensor]]]) -> Iterator[tuple[tuple[Tensor, Tensor], ...]]:
    """The first of all choices, then each of the others beside the first ones."""
    first = tuple(own[0] for own in choices)
    yield first
    for c, own in enumerate(choices):
        for other in own[1:]:
            yield (*first[:c], other, *first[c + 1 :])


def _other_places(work: Adjustment, masks: PerKind) -> Iterator[RigState]:
    """States in which one camera, or all of them, stand where three of the landmarks would put them as well."""
    marks, state = work.data.landmarks, work.state
    assert marks is not None
    places: list[list[tuple[Tensor, Tensor]]] = []
    for c, camera in enumerate(work.data.cameras):
        rays, valid = camera.unproject(marks.pixels[:, c])
        use = valid & masks.landmarks
        few = 3 <= int(use.sum()) <= _FEW_MARKS
        distance = (marks.points[use] - state.center[c]).norm(dim=-1).min() if few else torch.ones(())
        mark = torch.as_tensor(marks.pixel_sigma).expand(marks.pixels.shape[:2])[use, c]
        pixel = float(mark.max()) / float(camera.focal[0].detach()) if few else 0.0
        noise = pixel + float(marks.sigma.max()) / float(distance)
        most = noise * _AWRY if int(use.sum()) > 3 else math.inf
        own = distinct_poses(rays[use], marks.points[use], state.center[c], _PLACES, most) if few else []
        places.append(own)
    here = [[(state.rotation[c], state.center[c]), *own] for c, own in enumerate(places)]
    # The first choice is the present one. Without measurements, cameras do not depend on each other.
    together = itertools.product(*here) if work.terms else _one_at_a_time(here)
    for chosen in itertools.islice(together, 1, _MOST):
        rotation, center = (torch.stack(parts) for parts in zip(*chosen, strict=True))
        yield state._replace(rotation=rotation, center=center, points=marks.points)
    # All cameras together, as they stand to each other.
    for c, own in enumerate(places):
        for rotation, center in own:
            turn = rotation.T @ state.rotation[c]
            yield state._replace(
                rotation=state.rotation @ turn.T,
                center=(state.center - state.center[c]) @ turn.T + center,
                points=marks.points,
            )
