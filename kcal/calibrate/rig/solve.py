"""Solve a rig in one joint adjustment of boards, landmarks, far features, baselines and measured positions."""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Callable
from typing import Literal

import torch

from kcal.calibrate.rig.adjustment import Adjustment
from kcal.calibrate.rig.assess import rig_result
from kcal.calibrate.rig.blocks import KINDS, PerKind
from kcal.calibrate.rig.explanations import explained
from kcal.calibrate.rig.initial_poses import InitialPoses, first_poses
from kcal.calibrate.rig.mixups import refuse_same_camera
from kcal.calibrate.rig.outliers import ROUGHLY, possible
from kcal.calibrate.rig.prior_information import gathered, joint_unknowns
from kcal.calibrate.rig.rayless import without_rayless
from kcal.calibrate.rig.records import Reasons, item_records
from kcal.calibrate.rig.repeated_views import without_repeated
from kcal.calibrate.rig.result import RigResult
from kcal.calibrate.rig.robust_start import robust_solution
from kcal.calibrate.rig.sources import RigData
from kcal.calibrate.rig.unknowns import SharedUnknowns, free, held
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation
from kcal.lens.mounting import REFRACTION, REFRACTION_SIGMA, check_refraction
from kcal.solve.lm import LMOptions
from kcal.threads import in_one_thread

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
        reject: leave out what contradicts the rest; otherwise warnings name it. Left out or not, it is listed.
        refraction: of light towards landmarks, as a share of the Earth's curvature; estimated from here. For
            simulations and other straight lines it and its sigma are 0.
        refraction_sigma: its standard deviation beforehand; 0 holds it.
        solver: options of the Levenberg-Marquardt solver; residuals are in sigmas.
    """

    intrinsics: Literal["prior", "fixed", "free"] = "prior"
    board_warp: bool = False
    weighted: bool = True
    motion: bool = True
    reject: bool = True
    refraction: float = REFRACTION
    refraction_sigma: float = REFRACTION_SIGMA
    solver: LMOptions = dataclasses.field(default_factory=lambda: LMOptions(residual_floor=1e-8))

    def __post_init__(self) -> None:
        if self.intrinsics not in ("fixed", "prior", "free"):
            raise InputError(f"intrinsics must be fixed, prior or free, got {self.intrinsics!r}")
        check_refraction(self.refraction, self.refraction_sigma)


@in_one_thread
def solve_rig(
    data: RigData, options: RigOptions | None = None, progress: Callable[[str], None] = lambda _: None
) -> RigResult:
    """Solve for the poses of all cameras of a rig (and their parameters, if asked) from everything that is known.

    Least squares of all residuals over their standard deviations; landmarks, far features and boards are unknowns too
    and are eliminated. A robust loss finds the solution that most of the data agree on; what contradicts it is left
    out and named; the rest is solved by plain least squares.

    Args:
        data: see `RigData`.
        options: see `RigOptions`.
        progress: called with what is done next.

    Raises:
        InputError: data that contradict each other as a whole, or that have several explanations; a measured baseline
            or position that contradicts the rest; cameras that are swapped or given twice.
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
    if not any((data.boards, data.landmarks, data.features, data.positions, data.stars)):
        raise InputError("a rig needs boards, landmarks or features; there is nothing to solve it from")
    if options.board_warp and data.boards is None:
        raise InputError("the board's warp cannot be estimated without boards")
    refuse_same_camera(data)
    if not options.weighted and data.boards is not None:
        data = dataclasses.replace(data, boards=dataclasses.replace(data.boards, covariance=None))
    data, warnings = without_rayless(data)
    progress("what is known of cameras and board")
    data, unknowns, doubts = _what_may_change(data, options)
    warnings += doubts
    progress("first poses")
    initial = first_poses(data, options.solver)
    masks, reasons = _first_masks(initial, reject=options.reject)
    progress("robust solution")
    work = robust_solution(initial, masks, unknowns)
    if options.motion:
        work.fit_motion(possible(work, masks))
    # With lenses among the unknowns digits are dear, and what is wrong shows without them.
    looking = ROUGHLY if unknowns.refine_lenses else options.solver
    progress("what contradicts the rest")
    if options.reject:
        masks = kept = explained(work, masks, looking)
    else:
        masks = possible(work, masks)
        kept, doubts = _suspicions(work, masks, reasons, looking)
        warnings += doubts
    if options.motion:
        work.fit_motion(kept)
    progress("solution")
    # The robust solution is near, so that the first step may be the undamped one.
    near = dataclasses.replace(options.solver, initial_damping=_NEAR_DAMPING)
    _, found = work.solve(masks, near)
    for _ in range(3):
        change = max(work.fit_corners(masks), work.fit_widened(masks))
        if change > 0.0:
            _, found = work.solve(masks, near)
        if change < 1e-3:
            break
    progress("uncertainty")
    return rig_result(work, found, masks, reasons, initial, warnings, refuse=options.reject)


def _first_masks(initial: InitialPoses, *, reject: bool) -> tuple[PerKind, Reasons]:
    """What can take part, and why not the others."""
    data = initial.data
    marks = [
        torch.zeros(0) if source is None else torch.isfinite(source.pixels).all(-1).sum(-1)
        for source in (data.landmarks, data.features, data.stars)
    ]
    boards = initial.usable.clone()
    foreign = initial.foreign if reject else {}
    boards[list(foreign)] = False
    # A star without a name tells only how two cameras are turned against each other.
    enough = marks[2] >= (2 if data.stars is None else 2 - data.stars.named.long())
    masks = PerKind(boards, marks[0] >= 1, marks[1] >= 2, enough)
    texts = (
        "fewer than two cameras see enough of it",
        "no camera has a mark of it",
        "fewer than two cameras have a mark of it",
        "fewer than two cameras have a mark of it",
    )
    reasons = {
        kind: dict.fromkeys((~mask).nonzero()[:, 0].tolist(), text)
        for kind, mask, text in zip(KINDS, masks, texts, strict=True)
    }
    reasons["boards"].update(foreign)
    return masks, reasons


def _what_may_change(data: RigData, options: RigOptions) -> tuple[RigData, SharedUnknowns, list[str]]:
    """What may change of cameras, board and air, the data with the board as it is expected, and warnings of it."""
    boards, doubts = data.boards, []
    if options.intrinsics == "prior":
        known = []
        for number, camera in enumerate(data.cameras):
            own = None if camera.calibration is None else camera.calibration.known(camera.params.detach())
            if own is not None and boards is not None:
                own = without_repeated(own, camera, boards, number, options.solver)
            known.append(own)
        if boards is None:
            unknowns = _lens_unknowns(data.cameras, tuple(camera.fingerprint for camera in data.cameras), tuple(known))
        else:
            parts, apart = gathered(data.cameras, known, boards.board)
            measured = boards.deviation is not None
            doubts = [
                f"the calibrations of {data.names[one]} and {data.names[other]} contradict each other about their "
                f"board ({boards.board}): two prints, or one that bent in between; calibrate both cameras from views "
                "of the board in the pairs"
                for one, other in apart
            ]
            unknowns, deviation = joint_unknowns(data.cameras, parts, boards.board, measured=measured)
            if deviation is not None:
                data = dataclasses.replace(data, boards=dataclasses.replace(boards, deviation=deviation))
    else:
        unknowns = held(data.cameras) if options.intrinsics == "fixed" else free(data.cameras, data.names)
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


def _suspicions(work: Adjustment, masks: PerKind, reasons: Reasons, solver: LMOptions) -> tuple[PerKind, list[str]]:
    """What agrees, and warnings that name what would be left out, were it not to be kept."""
    trial = copy.copy(work)
    try:
        kept = explained(trial, masks, solver)
    except InputError as error:
        return masks, [str(error)]
    named = {(kind, work.names(kind)[i]) for kind in KINDS for i in reasons[kind]}
    return kept, [
        f"{item.label}: {item.reason}; it was kept"
        for item in item_records(trial, kept, reasons)
        if not item.used and (item.source, item.name) not in named
    ]
