"""Solve a rig from its sources, and from images of boards."""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import board_modes
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.parameters import FreeParameters
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import spread_out
from kcal.calibrate.rig.adjustment import LOSS, ROUGHLY, Adjustment, possible
from kcal.calibrate.rig.assess import rig_result
from kcal.calibrate.rig.contradictions import widen_sources
from kcal.calibrate.rig.explanations import (
    BEHIND,
    cost_of_features_behind,
    explained,
    one_camera_doubts,
    refuse_same_camera,
    without_behind,
)
from kcal.calibrate.rig.initial_poses import InitialPoses, around, first_poses, mirrored
from kcal.calibrate.rig.pairs import Pair, evenly, paired_boards, pose_alone
from kcal.calibrate.rig.result import Reasons, RigResult, records
from kcal.calibrate.rig.source import Start
from kcal.calibrate.rig.sources import MINIMUM_CORNERS, Boards, RigData
from kcal.calibrate.rig.unknowns import SharedUnknowns, board_deviation, free, gathered, held, joint_unknowns, less
from kcal.corners.observations import Observations
from kcal.errors import InputError
from kcal.finding import Finding
from kcal.gaussian import triangular
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation
from kcal.lens.rig import REFRACTION, REFRACTION_SIGMA, check_refraction
from kcal.lens.uncertainty import lens_changes
from kcal.solve.lm import LMOptions
from kcal.texts import brief
from kcal.threads import in_one_thread

# Leave out marks and corners at which a lens model has no ray.

# The share of pixels outside an image beyond which they are of an image of another size, not single slips.
_MOST_OUTSIDE = 0.1


def without_rayless(data: RigData) -> tuple[RigData, list[Finding]]:
    """The data with pixels at which a lens model has no ray taken as unseen, and doubts that count them.

    Raises:
        InputError: most corners of a board are such pixels; many pixels lie outside their image.
    """
    doubts, changed = list[Finding](), dict[str, Any]()
    for source in data.seen:
        kind = source.kind
        pixels = source.pixels.clone()
        for c, camera in enumerate(data.cameras):
            seen = torch.isfinite(pixels[:, c]).all(-1)
            outside, count = int((seen & ~camera.inside(pixels[:, c])).sum()), int(seen.sum())
            if outside > max(1.0, _MOST_OUTSIDE * count):
                width, height = camera.size
                raise InputError(
                    f"{kind}: {outside} of {count} pixels lie outside the image of {data.names[c]}, {width}x{height} "
                    "px: marked in images of another size? Those of the size at which it was calibrated are needed"
                )
            _, valid = camera.unproject(pixels[:, c])
            lost = seen & ~valid
            if not bool(lost.any()):
                continue
            if source.least > 1:
                few = (seen.sum(-1) >= source.least) & ((seen & valid).sum(-1) < source.least)
                for i in few.nonzero()[:, 0].tolist():
                    raise InputError(
                        f"{kind.removesuffix('s')} {source.names[i]}: the {data.names[c]} camera's lens model has no "
                        "ray at most of its corners: it folds inside the image; calibrate with views nearer the "
                        "image's border or with a smaller model"
                    )
            text = f"{int(lost.sum())} pixels of {kind} left out where {data.names[c]}'s lens has no ray"
            doubts.append(Finding("excluded", "doubt", text))
            pixels[:, c] = torch.where(lost[..., None], torch.nan, pixels[:, c])
        changed[kind] = dataclasses.replace(source, pixels=pixels)  # type: ignore[type-var]
    return dataclasses.replace(data, **changed), doubts


# The best robust solution of a rig from several initial poses.

# px: a corner's noise before the boards themselves tell it.
_CORNER_SIGMA = 0.2
# Times that each camera is moved at most.
_ROUNDS = 3
# Enough steps, and features, to tell which of several starts is best.
_SCREENING, _SCREENED = LMOptions(max_iterations=60, tolerance=1e-6, residual_floor=1e-8), 300


def robust_solution(initial: InitialPoses, mask: Tensor, unknowns: SharedUnknowns) -> Adjustment:
    """The best robust solution from all starts."""

    def best_of(starts: Sequence[Start], *others: _Screened) -> _Screened:
        screened = (_screened(initial, mask, unknowns, start) for start in starts)
        return min((*others, *screened), key=lambda one: one.cost)

    best, before = best_of(initial.starts), math.inf
    for _ in range(_ROUNDS):
        if best.cost == before:
            break
        before = best.cost
        for camera in initial.tried:
            # From where the best one came to: of steps that are slow, a wrong start may take the lead at first.
            reached = best.start._replace(rotation=best.work.state.rotation, center=best.work.state.center)
            moved = [*around(reached, camera), mirrored(reached)]
            best = best_of([initial.with_boards(start) for start in moved], best)
    work, here = best.work, possible(best.work, mask)
    work.unknowns = unknowns
    work.fit_corners(here, robust=True)
    work.solve(here, ROUGHLY, LOSS)
    return work


class _Screened(NamedTuple):
    """A start, and a few steps from there."""

    cost: float
    work: Adjustment
    start: Start


def _screened(initial: InitialPoses, mask: Tensor, unknowns: SharedUnknowns, start: Start) -> _Screened:
    boards = initial.data.boards
    sigma = _CORNER_SIGMA if boards is None or boards.sigma is None else boards.sigma
    work = Adjustment(initial.data, start, unknowns, sigma)
    some, features = mask.clone(), work.at("features")
    taken = mask[features].nonzero()[:, 0]
    some[features] = False
    some[features.start + taken[evenly(len(taken), _SCREENED)]] = True
    if unknowns.refine_lenses:
        # From poses that are far off, lenses would bend towards them, beyond their folds even.
        work.unknowns = unknowns.none()
    here = possible(work, some)
    work.fit_corners(here, robust=True)
    problem, result = work.solve(here, _SCREENING, LOSS)
    cost = float(result.cost) + cost_of_features_behind(problem, work.part(here)) + 1e6 * int((some & ~here).sum())
    return _Screened(cost, work, start)


# Take views of a rig out of what the cameras' calibrations know of them, so that no corner counts twice.

# A view of a calibration has the residuals that its record says, whatever corners were left out.
_SAME_RMS = 0.25


def without_repeated(
    known: CameraInformation, camera: Camera, boards: Boards, places: Sequence[int], solver: LMOptions
) -> CameraInformation:
    """What a calibration knows from other views than the rig's.

    Views are the same if name and residuals are.

    Args:
        known: what the calibration knows from all its views.
        camera: the camera, with its calibration.
        boards: of the rig, as they were read.
        places: numbers in the rig of this camera, one for each place where it stood.
        solver: options for poses.
    """
    record = None if camera.calibration is None else camera.calibration.record
    if record is None or record.noise is None or boards.views is None:
        return known
    enough = torch.isfinite(boards.pixels).all(-1).sum(-1) >= MINIMUM_CORNERS
    used = [
        (board, place)
        for place in places
        for board, name in enumerate(boards.views[place])
        if name in record.per_view_rms and bool(enough[board, place])
    ]
    if not used:
        return known
    at = tuple(torch.tensor(used).T)
    pixels, parameters = boards.pixels[at], camera.params.detach()
    sigma = record.noise * math.sqrt(record.tempering or 1.0)
    free = [i for i, slot in enumerate(known.slots) if slot >= 0]
    with_board = known.board_size > 0
    # Unknowns of the calibration: of the camera, and of the board as it was ordered.
    shapes = board_modes(boards.board.points).shapes if with_board else pixels.new_zeros(0, 3, pixels.shape[1])
    amplitudes, points = known.estimate[known.lens_size :], boards.points
    if with_board:
        # Single corners may be off their places beside the modes.
        smooth = torch.einsum("b,bcn->nc", amplitudes, shapes)
        found = board_deviation([camera], boards.board)
        points = boards.board.points + (0.0 if found is None else found - smooth)
    problem = BoardProblem(
        points,
        pixels,
        camera.model,
        FreeParameters(tuple(free), tuple(known.slots[i] for i in free)),
        shapes=shapes,
        free_board=with_board,
        weights=boards.whitening(sigma)[at],
    )
    seen = problem.board_points + torch.einsum("b,bcn->nc", amplitudes, problem.shapes)
    poses, _ = pose_alone(seen, pixels, camera, solver)
    state = BoardState.still(parameters, amplitudes, poses.rotation, poses.translation)
    rms = problem.corner_residuals(state).square().sum(-1).nanmean(-1).sqrt()
    then = torch.tensor([record.per_view_rms[boards.views[place][board]] for board, place in used])
    same = (rms - then).abs() <= _SAME_RMS * then
    if int(same.sum()) == record.views:
        # Only what was assumed is left.
        return dataclasses.replace(known, rows=known.rows[:0], residuals=known.residuals[:0])
    if not bool(same.any()):
        return known
    return less(known, triangular(problem.off_poses(state)[same].transpose(0, 1).flatten(1).T))


# Solve a rig in one joint adjustment of boards, landmarks, far features, baselines and measured positions.

# λ of a solve that begins at the robust solution.
_NEAR_DAMPING = 1e-9


@dataclasses.dataclass(frozen=True, kw_only=True)
class RigOptions:
    """Options of `solve_rig` and `calibrate_rig`.

    Args:
        intrinsics: "prior": solved together with everything else, held by what the cameras' calibrations know of
            lenses and board (a camera without a calibration is held: `RigResult.exact`); "fixed": cameras are taken as
            exact, and the covariance of the rig knows no error of theirs; "free": solved as if nothing were known of
            them.
        board_warp: estimate two parabolas by which the board bends, where no calibration knows its shape.
        weighted: let corners count by their covariances where all views have them.
        motion: boards may move while the rows of an image are read, if they or the cameras are held by hand; how much
            the boards tell. False: they stand still.
        reject: leave out what contradicts the rest; otherwise findings name it. Left out or not, it is listed.
        refraction: of light towards landmarks, as a share of the Earth's curvature; estimated from here. For
            simulations and other straight lines it and its sigma are 0.
        refraction_sigma: its standard deviation beforehand; 0 holds it.
        lens_change: standard deviation, in pixels at the image's corner, of the changes of each lens's scale and r³
            since its calibration (temperature, focus, transport). The rig's data may determine them better. A shift
            of the image is not among them: it is a turn of the camera.
        solver: options of the Levenberg-Marquardt solver; residuals are in sigmas.
    """

    __repr__ = brief

    intrinsics: Literal["prior", "fixed", "free"] = "prior"
    board_warp: bool = False
    weighted: bool = True
    motion: bool = True
    reject: bool = True
    refraction: float = REFRACTION
    refraction_sigma: float = REFRACTION_SIGMA
    lens_change: float = 0.0
    solver: LMOptions = dataclasses.field(default_factory=lambda: LMOptions(residual_floor=1e-8))

    def __post_init__(self) -> None:
        if self.intrinsics not in ("fixed", "prior", "free"):
            raise InputError(f"intrinsics must be fixed, prior or free, got {self.intrinsics!r}")
        check_refraction(self.refraction, self.refraction_sigma)
        if not 0 <= self.lens_change < math.inf:
            raise InputError(f"lens_change {self.lens_change}: pixels, not negative, are needed")
        if self.lens_change and self.intrinsics != "prior":
            raise InputError(f"lens_change {self.lens_change}: intrinsics 'prior' are needed, got {self.intrinsics!r}")


@in_one_thread
def solve_rig(
    data: RigData, options: RigOptions | None = None, progress: Callable[[str], None] = lambda _: None
) -> RigResult:
    """Solve for the poses of all cameras of a rig, and their parameters if asked, from all data together.

    Least squares of all residuals over their standard deviations; landmarks, far features and boards are unknowns too
    and are eliminated. A robust loss finds the solution that most of the data agree on; what contradicts it is left
    out and named; the rest is solved by plain least squares.

    One camera that is moved from place to place is a rig too: give it once for each place. Its lens is then the same
    unknown at all of them (`RigData.lenses`), and all that several places see must stand still in between.

    Args:
        data: see `RigData`.
        options: see `RigOptions`.
        progress: called with what is done next.

    Raises:
        InputError: data that contradict each other as a whole, or that have several explanations; a measured baseline
            or position that contradicts the rest; cameras that are swapped; the same view given as two places.
        DegenerateError: a camera that nothing connects with the others, or relative poses that the data do not
            determine, or determine exactly, so that nothing is left over to check them with, or that may as well be
            others; what could be anything, and what is missing, is named.

    Example:
        >>> from kcal import Camera, Landmarks
        >>> camera = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080), model="pinhole")
        >>> truth = torch.tensor([[0.0, 0, 0], [10.0, 0, 0]], dtype=torch.float64)  # both look north
        >>> look = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
        >>> points = torch.tensor([[-40.0, 120, 3], [30, 150, -8], [5, 300, 20], [60, 200, 9], [-80, 400, -9]]).double()
        >>> marks = torch.stack([camera.project((points - center) @ look.T)[0] for center in truth], 1)
        >>> survey = Landmarks(names=tuple("abcde"), points=points, sigma=torch.full((5, 3), 0.02).double(),
        ...                    pixels=marks, pixel_sigma=0.1)
        >>> straight = RigOptions(refraction=0.0, refraction_sigma=0.0)  # as these pixels were made
        >>> found = solve_rig(RigData(cameras=(camera, camera), names=("left", "right"), landmarks=survey), straight)
        >>> round(float(found.stereo().baseline), 6), found.left_out
        (10.0, ())
    """
    options = options or RigOptions()
    if not data.seen and not data.positions:
        raise InputError("a rig needs boards, landmarks or features; there is nothing to solve it from")
    if options.board_warp and data.boards is None:
        raise InputError("the board's warp cannot be estimated without boards")
    refuse_same_camera(data)
    if not options.weighted and data.boards is not None:
        data = dataclasses.replace(data, boards=dataclasses.replace(data.boards, covariance=None))
    data, findings = without_rayless(data)
    progress("what is known of cameras and board")
    data, unknowns, doubts = _what_may_change(data, options)
    findings += doubts
    progress("first poses")
    initial = first_poses(data, options.solver)
    mask, reasons = _first_mask(initial, reject=options.reject)
    progress("robust solution")
    work = robust_solution(initial, mask, unknowns)
    if options.motion:
        work.fit_motion(possible(work, mask))
    # With lenses among the unknowns digits are dear, and what is wrong shows without them.
    looking = ROUGHLY if unknowns.refine_lenses else options.solver
    progress("what contradicts the rest")
    if options.reject:
        kept, behind = without_behind(work, mask, explained(work, mask, looking), looking)
        reasons = {**reasons, **dict.fromkeys(behind.nonzero()[:, 0].tolist(), BEHIND)}
        mask = kept
    else:
        mask = possible(work, mask)
        kept, doubts = _suspicions(work, mask, reasons, looking)
        findings += doubts
    if options.motion:
        work.fit_motion(kept)
    progress("solution")
    # The robust solution is near, so that the first step may be the undamped one.
    near = dataclasses.replace(options.solver, initial_damping=_NEAR_DAMPING)
    _, found = work.solve(mask, near)
    for _ in range(3):
        change = max(work.fit_corners(mask), widen_sources(work, mask))
        if change > 0.0:
            _, found = work.solve(mask, near)
        if change < 1e-3:
            break
    progress("uncertainty")
    return rig_result(
        work, found, mask, reasons, initial, findings, refuse=options.reject, lens_change=options.lens_change
    )


def _first_mask(initial: InitialPoses, *, reject: bool) -> tuple[Tensor, Reasons]:
    """What can take part, and why not the others."""
    data, masks, reasons, count = initial.data, list[Tensor](), dict[int, str](), 0
    for source in data.seen:
        enough = source.enough(data.cameras)
        reasons.update(dict.fromkeys((count + (~enough).nonzero()[:, 0]).tolist(), source.few))
        foreign = initial.foreign if reject and source is data.boards else {}
        enough[list(foreign)] = False
        reasons.update({count + i: text for i, text in foreign.items()})
        masks.append(enough)
        count += len(enough)
    return torch.cat([torch.zeros(0, dtype=torch.bool), *masks]), reasons


def _what_may_change(data: RigData, options: RigOptions) -> tuple[RigData, SharedUnknowns, list[Finding]]:
    """What may change of cameras, board and air, the data with the board as it is expected, and doubts of it."""
    boards, doubts = data.boards, list[Finding]()
    # One camera at several places has one lens.
    lenses = data.lenses
    places = {lens: [c for c, own in enumerate(lenses) if own == lens] for lens in lenses}
    cameras = tuple(data.cameras[lens] for lens in places)
    if options.intrinsics == "prior":
        known = []
        for camera, at in zip(cameras, places.values(), strict=True):
            own = None if camera.calibration is None else camera.calibration.known(camera.params.detach())
            if own is not None and boards is not None:
                own = without_repeated(own, camera, boards, at, options.solver)
            if options.lens_change:
                change = lens_changes(camera, options.lens_change)
                exact = CameraInformation.from_covariance(camera.params.detach(), change @ change.T)
                own = exact if own is None else own.changed(change)
            known.append(own)
        if boards is None:
            unknowns = _lens_unknowns(cameras, tuple(camera.fingerprint for camera in cameras), tuple(known))
        else:
            parts, apart = gathered(cameras, known, boards.board)
            firsts = list(places)
            measured = boards.deviation is not None
            doubts = [
                Finding(
                    "board",
                    "doubt",
                    f"the calibrations of {data.names[firsts[one]]} and {data.names[firsts[other]]} contradict each "
                    f"other about their board ({boards.board}): two prints, or one that bent in between",
                    "calibrate both cameras from views of the board in the pairs",
                )
                for one, other in apart
            ]
            unknowns, deviation = joint_unknowns(cameras, parts, boards.board, measured=measured)
            if deviation is not None:
                data = dataclasses.replace(data, boards=dataclasses.replace(boards, deviation=deviation))
    else:
        names = [" and ".join(data.names[c] for c in at) for at in places.values()]
        unknowns = held(cameras) if options.intrinsics == "fixed" else free(cameras, names)
    # The same lens has the same unknowns at all places.
    each = tuple(unknowns.cameras[list(places).index(lens)] for lens in lenses)
    unknowns = dataclasses.replace(unknowns, cameras=each)
    if boards is not None:
        doubts += one_camera_doubts(data)
    if options.board_warp and boards is not None and not len(unknowns.shapes):
        unknowns = unknowns.and_warp(boards.points)
    if data.absolute:
        unknowns = unknowns.and_refraction(options.refraction, options.refraction_sigma)
    if data.effects:
        unknowns = unknowns.and_effects(*data.effects)
    return data, unknowns, doubts


@functools.lru_cache(maxsize=2)
def _lens_unknowns(
    cameras: tuple[Camera, ...], fingerprints: tuple[str, ...], known: tuple[CameraInformation | None, ...]
) -> SharedUnknowns:
    """Unknowns of cameras without boards. Whoever marks landmarks solves the same rig again and again."""
    return joint_unknowns(cameras, gathered(cameras, known, None)[0], None)[0]


def _suspicions(work: Adjustment, mask: Tensor, reasons: Reasons, solver: LMOptions) -> tuple[Tensor, list[Finding]]:
    """What agrees, and doubts that name what would be left out, were it not to be kept."""
    trial = copy.copy(work)
    try:
        kept = explained(trial, mask, solver)
    except InputError as error:
        return mask, [Finding("excluded", "doubt", str(error))]
    named = {work.labels[i] for i in reasons}
    return kept, [
        Finding("excluded", "doubt", f"{item.label}: {item.reason}; it was kept")
        for item in records(trial, kept, reasons).items
        if not item.used and item.label not in named
    ]


# Solve a stereo rig from boards that both cameras have seen.


@in_one_thread
def calibrate_rig(
    left: Camera,
    right: Camera,
    left_observations: Observations,
    right_observations: Observations,
    pairs: Sequence[Pair],
    options: RigOptions | None = None,
) -> RigResult:
    """Find the pose of the right camera in the left one's frame: `solve_rig` with boards alone.

    Each camera's board poses are found alone; every pair then proposes a relative pose, in the corner order as read
    and with the right image's order turned by 180°. The proposal that the other pairs agree with best tells which
    pairs were read from the other end and which do not belong. The others are refined jointly: one board pose for each
    pair, one relative pose, least squares over both images.

    Args:
        left: the left camera, calibrated.
        right: the right camera, calibrated.
        left_observations: views of the left camera.
        right_observations: views of the right camera.
        pairs: names of views taken at the same moment (see `kcal.calibrate.rig.pairs`).
        options: see `RigOptions`.

    Raises:
        InputError: boards or image sizes that differ, cameras that do not fit their observations, views with too few
            corners for a pose.
        DegenerateError: no pair is left.

    Example:
        >>> from kcal import Board, Rig, View
        >>> from kcal.lens import rotation_from_vector
        >>> board = Board(columns=7, rows=6, square=0.05)
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480))
        >>> truth = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-0.2, 0.0, 0.0]))
        >>> tilts = torch.tensor([[0.4, 0, 0], [-0.4, 0.1, 0], [0, 0.4, 0.2]], dtype=torch.float64)
        >>> sides = ([], [])
        >>> for i, rotation in enumerate(rotation_from_vector(tilts)):
        ...     points = board.points @ rotation.T + torch.tensor([-0.1, -0.1, 1.0], dtype=torch.float64)
        ...     for views, pixels in zip(sides, truth(points)[0].unbind(-2)):
        ...         views.append(View(name=f"{i}.png", pixels=pixels.tolist()))
        >>> left, right = (Observations(board=board, image_size=(640, 480), views=views) for views in sides)
        >>> pairs = [(name, name) for name in left.names]
        >>> result = calibrate_rig(camera, camera, left, right, pairs)
        >>> [round(value, 6) + 0.0 for value in result.stereo().right_from_left_translation.tolist()]
        [-0.2, 0.0, 0.0]
    """
    boards = paired_boards((left, right), (left_observations, right_observations), pairs)
    for pair, counts in zip(pairs, torch.isfinite(boards.pixels).all(-1).sum(-1).tolist(), strict=True):
        if min(counts) < MINIMUM_CORNERS:
            raise InputError(f"pair {pair[0]}, {pair[1]}: at least {MINIMUM_CORNERS} corners are needed in each view")
    for side in (0, 1):
        for i in (~spread_out(boards.points, boards.pixels[:, side])).nonzero()[:, 0].tolist():
            raise InputError(f"{pairs[i][side]}: all its corners, or all but one, lie on one line; leave the pair out")
    return solve_rig(RigData(cameras=(left, right), names=("left", "right"), boards=boards), options)
