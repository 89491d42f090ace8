"""What to think of a solved rig: residuals, weak geometry, and other places that fit as well."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

import kcal.calibrate.rig.explanations as explanations
from kcal.calibrate.rig.adjustment import Adjustment
from kcal.calibrate.rig.contradictions import contradicting_source, sigmas_findings, widen_for_fields
from kcal.calibrate.rig.initial_poses import InitialPoses
from kcal.calibrate.rig.marks import Features
from kcal.calibrate.rig.motion import moved_findings, scatter_findings
from kcal.calibrate.rig.problem import RigProblem, RigSolution, goodness_of_fit
from kcal.calibrate.rig.resection import distinct_poses
from kcal.calibrate.rig.result import Reasons, RigResult, places, records
from kcal.calibrate.rig.source import Context, RigState, as_items
from kcal.errors import DegenerateError, InputError
from kcal.finding import Finding
from kcal.io.camera_file import provenance
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.pose import vector_from_rotation
from kcal.solve.lm import LMOptions, Result, SolverStatus
from kcal.texts import counted_text, length_text, number_text

# Refuse rigs whose baseline is so open that intervals of ranges are wrong; widen intervals where that helps.
#
# Marks fix directions and the baseline turns them into ranges: an inverse range is linear in everything but the place
# of the second camera. So intervals are tried on rigs that are two standard deviations off the solution in that place.
# Each has targets with exact marks; the solved rig gives ranges and intervals for these marks. Were everything linear,
# no error could exceed two of its standard deviations.

# Measured on simulated landmarks (scripts/check/weak_geometry.py): up to the first ratio first-order intervals contain
# the truth as often as they should; above it, once they are widened by the ratio's square, at most three times. Hardly
# any set above the second ratio gave useful ranges, nor one whose baseline across the line of sight is open by half.
_LINEAR, _HOPELESS, _OPEN = 1.15, 3.0, 0.5
_WIDEST = 3.0
# Extents across over extents along from which landmarks are no longer in a line or plane, and an extent over the
# distance from which they are no longer in one place: only words depend on these.
_LINE, _PLANE, _CLUSTER = 0.15, 0.1, 0.1
# px: the least noise of a target's mark. Distances of targets in baselines: 250 m, 1 km and 5 km for 10 m.
_MARK, _DISTANCES = 0.1, (25.0, 100.0, 500.0)
_COLUMNS, _ROWS = 5, 3
_SIGMAS = 2.0
_UNDAMPED = torch.tensor(1e-12, dtype=torch.float64)
# From the middle of a cube to its corners, edges and faces.
_DIRECTIONS = torch.nn.functional.normalize(
    torch.tensor([way for way in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(way)], dtype=torch.float64)
)


def check_places(solution: RigSolution, names: Sequence[str], *, refuse: bool = True) -> tuple[float, list[Finding]]:
    """By how much the standard deviations of a rig must be multiplied for its intervals to be right, and doubts.

    Args:
        solution: the rig.
        names: of the cameras.
        refuse: raise an error where no range is known; otherwise a doubt tells.

    Raises:
        DegenerateError: a camera whose place is so open that no range is known; what to add is told.
    """
    widen, doubts, center = 1.0, list[Finding](), solution.state.center
    for second in range(1, len(names)):
        found = open_place(solution, 0, second)
        if found is None or (found.ratio <= _LINEAR and found.share <= _OPEN):
            continue
        hopeless = not (found.ratio <= _HOPELESS and found.share <= _OPEN)
        baseline = float((center[second] - center[0]).norm())
        word = ("sideways", "up and down", "along its view")[int(found.direction.abs().argmax())]
        text = (
            f"the data {'do not' if hopeless else 'hardly'} determine where {names[second]} stands: "
            f"± {found.sigma:.2g} m ({word} as {names[0]} sees it) with a baseline of {baseline:.3g} m; "
        )
        advice = _advice(solution.problem, solution.state)
        if hopeless and refuse:
            raise DegenerateError(f"{text}ranges could be anything. {advice}")
        factor = min(max(found.ratio, 1.0) ** 2, _WIDEST)
        widen = max(widen, factor)
        effect = "ranges could be anything" if hopeless else f"intervals were widened {factor:.1f} times for that"
        doubts.append(Finding("place", "doubt", f"{text}{effect}", advice))
    return widen, doubts


# What landmarks tell of a camera is linear in its pose only nearby. So the pose is moved by two standard deviations in
# the directions in which it is most open, and one step of the solver leads back: were all linear, to where it was. What
# is missing, in standard deviations, grows with the square of an error. Its second moment is added to the covariance,
# and above the limit, one standard deviation of any part of the pose, the pose is refused.
_MOST_BENT, _DIRECTIONS_TRIED = 1.0, 2


def check_poses(
    solution: RigSolution, names: Sequence[str], *, refuse: bool = True, because: Sequence[Finding] = ()
) -> list[Finding]:
    """Widen the covariance where landmarks leave a camera's pose so open that it is not linear; return doubts.

    Args:
        solution: the rig; its root grows.
        names: of the cameras.
        refuse: raise an error where the pose could be anything; otherwise a doubt tells.
        because: what has widened the covariance before; it is the reason then, not where the landmarks are.

    Raises:
        DegenerateError: a camera whose pose is so open; what to add is told.
    """
    doubts, missing = list[Finding](), list[Tensor]()
    problem, state = solution.problem, solution.state
    points = _surveyed(problem, state)
    if points is None or not solution.complete:
        return doubts
    still, at_rest = problem.linearize(state).step(_UNDAMPED)[0]
    for c, name in enumerate(names):
        pose = solution.mounting_rows(c)[:6]
        half = solution.half_of(pose)
        if half is None or not bool(half.any()):
            continue
        distance = float((points - state.center[c]).norm(dim=-1).median())
        ways = torch.linalg.svd(half / half.new_tensor([distance] * 3 + [1.0] * 3), full_matrices=False).U
        sigma, bent = half.square().sum(0).sqrt(), 0.0
        for way in ways.T[:_DIRECTIONS_TRIED]:
            step = _SIGMAS * solution.root @ way
            ends = []
            for moved in (step, -step):
                there = problem.retract(state, (moved, torch.zeros_like(at_rest)))
                back = problem.linearize(there).step(_UNDAMPED)[0][0]
                off = (moved + back - still).nan_to_num(math.inf)
                ends.append(off)
                bent = max(bent, float(((pose @ off).abs() / sigma).nan_to_num(math.inf).max()))
            missing.append(math.sqrt(3.0) / _SIGMAS**2 * 0.5 * (ends[0] + ends[1]))
        if bent > _MOST_BENT:
            place, turn = length_text(float(sigma[:3].max()), digits=2), min(float(sigma[3:].max()), math.pi)
            text = f"the landmarks do not determine where {name} stands: ± {place}, ± {math.degrees(turn):.0f}° turned"
            if refuse and because:
                raise DegenerateError(f"{because[0].text}; so {text}. {because[0].action.capitalize()}")
            doubt = Finding("place", "doubt", text, _advice(problem, state))
            if refuse:
                raise DegenerateError(doubt.sentence)
            doubts.append(doubt)
    if missing and not doubts:
        solution.root = torch.cat([solution.root, torch.stack(missing, 1)], 1)
    return doubts


def _advice(problem: RigProblem, state: RigState) -> str:
    """What the landmarks have in common, and what to add."""
    several = len(problem.cameras) > 1
    measure = f"or measure the position{'s of the cameras' if several else ' of the camera'}"
    rig = "the rig" if several else "the camera"
    points = _surveyed(problem, state)
    if points is None:
        return f"Add surveyed landmarks, {measure}"
    middle = points.mean(0)
    extent = torch.linalg.svdvals(points - middle) / math.sqrt(len(points))
    long, wide, thick = (*extent.tolist(), 0.0, 0.0)[:3]
    if wide < _LINE * long:
        return (
            f"The landmarks lie nearly in one line: turning {rig} about that line is not determined; add a landmark "
            f"well off the line, {measure}"
        )
    if long < _CLUSTER * float((state.center[0] - middle).norm()):
        return (
            f"The landmarks are close together as the cameras see them: turning {rig} about that place is not "
            f"determined; add landmarks far to the side of it and nearer ones, {measure}"
        )
    if thick < _PLANE * wide:
        return (
            "The landmarks lie nearly in one plane: their common distance stands for a turn of the cameras; add "
            f"landmarks well before or behind that plane, {measure}"
        )
    return f"Add surveyed landmarks that are nearer and spread over the image, mark them more precisely, {measure}"


def _surveyed(problem: RigProblem, state: RigState) -> Tensor | None:
    """(L, 3) where surveyed points are, meters; None without any."""
    return next((own.items[:, :3] for block, own in problem.parts(state) if block.surveyed), None)


class OpenPlace(NamedTuple):
    """How well a rig knows where its second camera stands.

    Attributes:
        share: standard deviation of the baseline across the line of sight, over its length across it; median over the
            first camera's image.
        ratio: of errors to what first-order intervals allow for, where it is largest; 1 or less if they are right.
        direction: (3,) unit vector along the first camera's axes in which the place is most open.
        sigma: its standard deviation in that direction, meters.
    """

    share: float
    ratio: float
    direction: Tensor
    sigma: float


class _Targets(NamedTuple):
    """Ray `rays[t]` of the first camera at inverse ranges, and what is known of an inverse range there.

    Attributes:
        rays: (T, 3) in the first camera's frame.
        near: the largest inverse range.
        half: (3, T, K) how an inverse range follows K independent standard normal errors of the rig, at infinity, at
            half of `near` and at `near`; a parabola in between.
        own: (T,) variance of an inverse range by its marks alone.
    """

    rays: Tensor
    near: float
    half: Tensor
    own: Tensor

    def at(self, inverse_range: Tensor) -> Tensor:
        """`half` (..., T, K) at inverse ranges (..., T)."""
        share = (inverse_range / self.near)[..., None]
        weights = (1.0 - share) * (1.0 - 2.0 * share), 4.0 * share * (1.0 - share), share * (2.0 * share - 1.0)
        return sum((weight * node for weight, node in zip(weights, self.half, strict=True)), torch.zeros(()))


def open_place(solution: RigSolution, first: int, second: int) -> OpenPlace | None:
    """Tell how open the place of the second camera is; None where the data do not determine all of the rig."""
    problem, state = solution.problem, solution.state
    rotation = state.rotation[second] @ state.rotation[first].T
    center = state.rotation[first] @ (state.center[second] - state.center[first])
    half = solution.half_of(solution.relative_rows(first, second))
    inverse = 1.0 / (torch.tensor(_DISTANCES, dtype=torch.float64) * center.norm())
    targets = _targets(solution, first, second, float(inverse[0]))
    if half is None or targets is None:
        return None
    turns, moves = half[:, :3], half[:, 3:]
    # The second center in the first frame is -Rᵀ t.
    places = -(moves + torch.linalg.cross((rotation @ center).expand_as(turns), turns)) @ rotation
    axes, sigmas, ways = torch.linalg.svd(places.T, full_matrices=False)
    across = torch.eye(3, dtype=torch.float64) - targets.rays[:, :, None] * targets.rays[:, None, :]
    share = torch.linalg.matrix_norm(across @ places.T, 2) / (across @ center).norm(dim=-1)
    steps = _SIGMAS * _DIRECTIONS @ ways
    true = inverse[:, None, None]

    def seen_from(moved: Tensor) -> tuple[Tensor, Tensor]:
        """Inverse ranges (D, W, T) that are found for targets at D distances seen from W places, and their rays."""
        there = targets.rays - true[..., None] * (center + moved)[:, None]
        sight = torch.nn.functional.normalize(there, dim=-1)
        base = center - (sight @ center)[..., None] * sight
        return (base * targets.rays).sum(-1) / base.square().sum(-1), there

    # Turns and lenses, which trade with each other by far more than both together are off, count to first order.
    found, seen = seen_from(steps @ places)
    by_place = _first_order(targets.rays, true, center, steps @ places)
    found = found - by_place - (targets.at(true.expand_as(found)) @ steps[:, :, None])[..., 0]
    variance = targets.own + targets.at(found).square().sum(-1)
    errors = (found - true).square() / variance
    # What the second camera sees, too.
    pixels, valid = problem.cameras[second].project(seen @ rotation.T)
    common = valid & problem.cameras[second].inside(pixels)
    mean = torch.where(common, errors.nan_to_num(math.inf), 0.0).sum(-1) / common.sum(-1).clamp_min(1)
    return OpenPlace(float(share.median()), math.sqrt(float(mean.max())) / _SIGMAS, axes[:, 0], float(sigmas[0]))


def _first_order(rays: Tensor, true: Tensor, center: Tensor, moved: Tensor) -> Tensor:
    """(D, W, T) change of the inverse ranges of targets by W moves (W, 3) of the second center, to first order.

    With s the unit vector from that center c to a target and r the ray, the inverse range is found as
    (c r - (s c)(s r)) / (c c - (s c)²), where c is not known to have moved.
    """
    there = rays - true[..., None] * center
    length = there.norm(dim=-1, keepdim=True)
    sight = there / length
    turned = -true[..., None] * moved[:, None] / length
    turned = turned - (turned * sight).sum(-1, keepdim=True) * sight
    p, q = sight @ center, (sight * rays).sum(-1)
    dp, dq = turned @ center, (turned * rays).sum(-1)
    square = center @ center - p * p
    found = (rays @ center - p * q) / square
    return (2.0 * found * p * dp - dp * q - p * dq) / square


def _targets(solution: RigSolution, first: int, second: int, near: float) -> _Targets | None:
    """Targets all over the first camera's image."""
    problem, state = solution.problem, solution.state
    camera = problem.cameras[first]
    across, down = (
        (torch.arange(count).double() + 0.5) * size / count - 0.5
        for count, size in zip((_COLUMNS, _ROWS), camera.size, strict=True)
    )
    rays, valid = camera.unproject(torch.stack(torch.meshgrid(across, down, indexing="xy"), -1).reshape(-1, 2))
    rays = rays[valid]
    direction, count = (rays @ state.rotation[first]).repeat(3, 1), 3 * len(rays)
    inverse = torch.tensor([0.0, 0.5 * near, near], dtype=torch.float64).repeat_interleave(len(rays))
    pixels = torch.full((count, len(problem.cameras), 2), torch.nan, dtype=torch.float64)
    pixels[:, [first, second]] = 0.0
    anywhere = Features(
        names=tuple(map(str, range(count))),
        pixels=pixels,
        inverse_range=torch.zeros(count, dtype=torch.float64),
        inverse_range_sigma=torch.full((count,), torch.inf, dtype=torch.float64),
        pixel_sigma=_MARK,
    )
    given = Context(problem.cameras, state, problem.unknowns, state.center[first])
    block = anywhere.block(torch.ones(count, dtype=torch.bool), given)
    turning, moving = ([slot is not None for slot in slots] for slots in (problem.turn, problem.shift))
    alone = RigProblem(problem.cameras, [block], (), problem.unknowns, turning, moving)
    follow, own = alone.response(state._replace(items=as_items(direction, inverse[:, None])), block)
    rows = follow[:, -1].clone()
    slot = problem.shift[first]
    if slot is not None:
        # The range is from where the first camera stands, not from where it was found.
        rows[:, slot] += inverse.square()[:, None] * direction
    half = solution.half_of(rows)
    if half is None or not len(rays):
        return None
    own = own.unflatten(0, (3, -1))[0, :, -1, -1]
    return _Targets(rays, near, half.T.unflatten(0, (3, -1)), own)


# Where landmarks tie a rig: look for other places of its cameras that fit as well, and refuse to choose.
#
# Three landmarks put a camera in up to four places, and with noise a fourth or fifth does not always tell which. Any
# number of them in a plane looks nearly the same with the plane's tilt reversed, as a cube that is drawn does.

# How many other places are tried of each camera, and of all together.
_PLACES, _MOST = 4, 64
# Times the noise that a ray may be off where three others place a camera: an adjustment spreads that over all.
_AWRY = 50.0
# Squared distance of two solutions, in standard deviations, beyond which they are not the same.
_OTHER = 100.0
# A few steps tell which places are hopeless: those with so many times too large a χ².
_GLANCE, _FAR = LMOptions(max_iterations=10, tolerance=1e-4, residual_floor=1e-8), 100.0


def refuse_several(work: Adjustment, mask: Tensor) -> None:
    """Raise `DegenerateError` if the cameras could as well stand elsewhere, as far as landmarks tell.

    Args:
        work: at its solution; it stays there.
        mask: what agrees.
    """
    if not explanations.decided_by_landmarks(work, mask):
        return
    here = copy.copy(work)
    here.unknowns = work.unknowns.none()
    problem, _ = here.solve(mask, explanations.TRIAL)
    own = goodness_of_fit(problem, here.part(mask))
    matrix, scale = problem.linearize(here.part(mask)).information()
    found = [here.state]
    for state in _other_places(here, mask):
        there = copy.copy(here)
        there.state = state
        if not _as_good(there, mask, own.chi2, own.variance):
            continue
        steps = [_step(problem, other, there.state) / scale for other in found]
        if min(float(step @ matrix @ step) for step in steps) >= _OTHER:
            found.append(there.state)
        if len(found) > _PLACES:
            break
    if len(found) == 1:
        return
    names = work.data.names
    moved = torch.stack([(other.center - found[0].center).norm(dim=-1) for other in found])
    which = int(moved.amax(0).argmax())
    if len(names) == 2:
        apart = " or ".join(f"{float((other.center[1] - other.center[0]).norm()):.3g} m" for other in found)
        what = f"{names[1]} may be {apart} from {names[0]}"
    else:
        what = f"{names[which]} may stand in {len(found)} places up to {float(moved[:, which].max()):.3g} m apart"
    raise DegenerateError(
        f"the landmarks do not tell where the cameras stand: {what}, which fit alike ({own.freedom} degrees of "
        f"freedom). {_advice(problem, here.part(mask))}"
    )


def _as_good(work: Adjustment, mask: Tensor, chi2: float, variance: float) -> bool:
    """Whether the solution from here is as good; one that is far from it after a few steps is not followed."""
    for effort, times in ((_GLANCE, _FAR), (explanations.TRIAL, 1.0)):
        problem, _ = work.solve(mask, effort)
        if not 2.0 * float(problem.cost(work.part(mask))) < chi2 + times * explanations.AS_GOOD * variance:
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


def _reversed(rotation: Tensor, center: Tensor, points: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Poses from which points in a plane look nearly the same: the tilt of the plane is reversed, not its middle."""
    middle = points.mean(0)
    sight = torch.nn.functional.normalize(rotation @ (middle - center), dim=0)
    still, found = torch.eye(3, dtype=torch.float64), []
    for normal in torch.linalg.svd(points - middle).Vh[1:].flip(0):
        turned = (still - 2.0 * torch.outer(sight, sight)) @ rotation @ (still - 2.0 * torch.outer(normal, normal))
        found.append((turned, middle - turned.T @ (rotation @ (middle - center))))
    return found


def _other_places(work: Adjustment, mask: Tensor) -> Iterator[RigState]:
    """States in which one camera, or all of them, stand where three of the landmarks would put them as well."""
    marks, state = work.data.landmarks, work.at_survey(work.state)
    assert marks is not None
    chosen_marks = mask[work.at("landmarks")]
    places: list[list[tuple[Tensor, Tensor]]] = []
    for c, camera in enumerate(work.data.cameras):
        rays, valid = camera.unproject(marks.pixels[:, c])
        use = valid & chosen_marks
        if int(use.sum()) < 3:
            places.append([])
            continue
        distance = (marks.points[use] - state.center[c]).norm(dim=-1).min()
        mark = torch.as_tensor(marks.pixel_sigma).expand(marks.pixels.shape[:2])[use, c]
        noise = float(mark.max()) / float(camera.focal[0].detach()) + float(marks.sigma.max()) / float(distance)
        most = noise * _AWRY if int(use.sum()) > 3 else math.inf
        own = distinct_poses(rays[use], marks.points[use], state.center[c], _PLACES, most)
        places.append(own + _reversed(state.rotation[c], state.center[c], marks.points[use]))
    here = [[(state.rotation[c], state.center[c]), *own] for c, own in enumerate(places)]
    # The first choice is the present one. Without measurements, cameras do not depend on each other.
    together = itertools.product(*here) if work.terms else _one_at_a_time(here)
    for chosen in itertools.islice(together, 1, _MOST):
        rotation, center = (torch.stack(parts) for parts in zip(*chosen, strict=True))
        yield state._replace(rotation=rotation, center=center)
    # All cameras together, as they stand to each other.
    for c, own in enumerate(places):
        for rotation, center in own:
            turn = rotation.T @ state.rotation[c]
            yield state._replace(
                rotation=state.rotation @ turn.T, center=(state.center - state.center[c]) @ turn.T + center
            )


# Assess the solution of a rig: refuse what is not determined or contradicts itself, say what to doubt, and record.

# Of fewer boards alone, a wrong one cannot be told from a good one.
_FEW_BOARDS = 3
# Boards alone that must be left: fewer fit one another whatever is wrong with one of them, and another one is blamed.
_ENOUGH_BOARDS = 5
# px: a higher RMS is not noise.
_HIGH_RMS = 1.0


def rig_result(
    work: Adjustment,
    found: Result,
    mask: Tensor,
    reasons: Reasons,
    initial: InitialPoses,
    findings: list[Finding],
    *,
    refuse: bool,
    lens_change: float,
) -> RigResult:
    """The result of a rig from its solution.

    Args:
        work: with the solution of what the mask name.
        found: what the solver said.
        mask: what took part.
        reasons: why the rest did not.
        initial: from where it began.
        findings: that there are already.
        refuse: raise errors where measurements contradict each other or leave ranges open; otherwise doubts tell.
        lens_change: as in `RigOptions`, for the record.

    Raises:
        InputError: a measured baseline or position that contradicts the rest, or several explanations.
        DegenerateError: relative poses that are not determined, or exactly, or so that no range is known.
    """
    data, state, problem = work.data, work.part(mask), work.problem(mask)
    fit = goodness_of_fit(problem, state)
    solution = RigSolution(problem, state, fit.variance)
    undetermined = solution.open_directions(data.names, absolute=data.absolute)
    for second in range(1, len(data.cameras)):
        if not bool(solution.of(solution.relative_rows(0, second))[1].all()):
            what = "; ".join(undetermined[:3]) + (" and more" if len(undetermined) > 3 else "")
            cure = (
                "add boards seen by both, surveyed landmarks, far features of known range, a measured baseline or "
                "measured positions"
            )
            if data.stars is not None:
                cure = (
                    "stars and a baseline tell nothing of the baseline's direction: add matches of unknown range "
                    "(features), or the measured positions of both cameras (GNSS)"
                )
            raise DegenerateError(
                f"the data do not determine how {data.names[second]} stands from {data.names[0]}: {what} could be "
                f"anything; {cure}"
            )
    explanations.refuse_exact(problem, data.names, fit.freedom)
    explanations.refuse_one_place(data, solution)
    widen, doubts = check_places(solution, data.names, refuse=refuse)
    if widen > 1.0:
        solution = RigSolution(problem, state, widen**2 * fit.variance)
    apart = widen_for_fields(solution, data.names)
    more = check_poses(solution, data.names, refuse=refuse, because=apart)
    doubts += [] if doubts else more
    refuse_several(work, mask)
    against = contradicting_source(work, solution, refuse=refuse)
    moving = widen_for_lenses(work, solution)
    told = records(work, mask, reasons)
    rms = math.sqrt(float(told.squared.sum() / told.counts.sum()))
    status = SolverStatus(int(found.status))
    findings += [*sigmas_findings(work, fit), *apart, *against, *moving]

    def doubt(name: str, text: str, action: str = "") -> None:
        findings.append(Finding(name, "doubt", text, action))

    only_boards, count = len(problem.blocks) == 1 and problem.blocks[0].many, int(mask.sum())
    if only_boards and count < _FEW_BOARDS:
        doubt("pairs", f"{counted_text(count, 'pair')} only: a wrong one could not be noticed", "5 or more are good")
    against_them = [name for i, name in enumerate(work.labels) if not mask[i] and i not in reasons]
    if only_boards and refuse and against_them and len(data.cameras) == 2 and count < _ENOUGH_BOARDS:
        raise InputError(
            f"{' and '.join(against_them)} and the other {count} contradict each other, and of so few nobody can "
            f"tell which is wrong: photograph the board more often, so that {_ENOUGH_BOARDS} or more agree"
        )
    focal = [float(camera.params[0]) for camera in data.cameras]
    scattered = scatter_findings(focal, work.motion, work.sigma_corner)
    if refuse and scattered and explanations.one_camera_doubts(data):
        raise InputError(
            f"{scattered[0].text.split(':')[0]}, and one camera saw the boards from two places: boards moved while the "
            "camera was moved, or these are views of two cameras. Use boards that stand still, leave --pairs out, or "
            "give the file of each camera"
        )
    findings[:0] = scattered
    if only_boards and rms > _HIGH_RMS and not any(work.motion):
        doubt("synchronization", f"RMS {rms:.2f} px is high: were both views of each pair taken at the same moment?")
    if status not in (SolverStatus.CONVERGED, SolverStatus.EXACT):
        doubt("solver", f"the solver {status.message}")
    findings += moved_findings(data.names, focal, work.motion, work.sigma_corner)
    findings += doubts
    for text in undetermined:
        doubt("place", f"not determined by the data: {text}")
    lenses = [solution.parameter_rows(c) for c in range(len(data.cameras))]
    if not bool(solution.of(torch.cat(lenses))[1].all()):
        doubt(
            "place",
            "the data do not determine all parameters of the cameras: the rig has no covariance, and intervals know "
            "errors of the marks alone",
        )
    findings += explanations.swap_findings(data, solution) + explanations.survey_unit_findings(data, solution)
    cameras = data.cameras
    if any(bool(part.any()) for part in problem.unknowns.cameras):
        cameras = tuple(
            _refined(camera, parameters, solution.of(rows)[0])
            for camera, parameters, rows in zip(data.cameras, problem.parameters(state), lenses, strict=True)
        )
    return RigResult(
        data=data,
        cameras=cameras,
        rotation=state.rotation,
        center=state.center,
        board_warp=state.board if len(problem.unknowns.shapes) == 2 else None,
        sources=told.sources,
        items=told.items,
        flipped=tuple(initial.flipped),
        rms=rms,
        rms_px=tuple((told.squared / told.counts).sqrt().tolist()),
        chi2=fit.chi2,
        freedom=fit.freedom,
        variance=solution.variance,
        sigma_corner=None if data.boards is None else work.sigma_corner,
        undetermined=undetermined,
        status=status,
        findings=tuple(findings),
        _solution=solution,
        _places=places(work),
        _provenance={**provenance(), "lens_change": lens_change},
    )


def widen_for_lenses(work: Adjustment, solution: RigSolution) -> list[Finding]:
    """Widen the covariance for lenses that move from view to view: later frames are others than those of the rig.

    Their calibrations tell by how much, or pairs of boards. An image that is shifted is one of a camera that turned.
    """
    told, rotation = list[Finding](), solution.state.rotation
    for c, (name, camera, motion) in enumerate(zip(work.data.names, work.data.cameras, work.motion, strict=True)):
        record, image = camera.calibration and camera.calibration.record, motion.image if motion else 0.0
        scale, *center = record.moves if record and record.moves else (0.0, 0.0, 0.0)
        if not any((scale, *center, image)):
            continue
        focal = camera.params[:2].detach()
        right, down = (max(each, image) / length for each, length in zip(center, focal.tolist(), strict=True))
        turns = rotation.new_tensor([[0.0, down], [right, 0.0], [0.0, 0.0]])
        # The frame of a rig may be that of the camera: the others turn, then.
        turning = [c] if solution.problem.turn[c] is not None else range(len(rotation))
        shifts = torch.stack([solution.turn_rows(k).T @ (rotation[k] @ rotation[c].T @ turns) for k in turning]).sum(0)
        longer = torch.linalg.pinv(solution.parameter_rows(c))[:, :2] @ (scale * focal[:, None])
        solution.root = torch.cat([solution.root, shifts, longer], 1)
        how = f"by some {number_text(image, digits=2)} px as pairs show" if image else "as its calibration found"
        text = f"the lens of {name} moves from view to view, {how}: error bars contain the movement of later frames"
        action = "for smaller ones switch the image stabilizer off, lock focus and zoom, and photograph again"
        told.append(Finding("moving-lens", "doubt", text, action))
    return told


def _refined(camera: Camera, parameters: Tensor, covariance: Tensor) -> Camera:
    """The camera as the rig found it, with new sigmas; all that is known of it together is the rig's covariance."""
    out, known = camera.with_parameters(parameters), camera.calibration
    spread = covariance.diagonal().sqrt()
    sigma = {
        name: float(value) if 0 < value < math.inf else None for name, value in zip(camera.names, spread, strict=True)
    }
    known = CameraCalibration() if known is None else known
    out.calibration = CameraCalibration(name=known.name, sigma=sigma, record=known.record, setting=known.setting)
    return out
