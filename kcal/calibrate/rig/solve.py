"""Solve a rig in one joint adjustment of boards, landmarks, far features, baselines and measured positions."""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
from typing import Literal

import torch
from torch import Tensor

from kcal.calibrate.rig.adjustment import Adjustment
from kcal.calibrate.rig.blocks import KINDS, PerKind
from kcal.calibrate.rig.board_consensus import MINIMUM_CORNERS
from kcal.calibrate.rig.contradictions import CERTAIN, contradictions
from kcal.calibrate.rig.explanations import explained
from kcal.calibrate.rig.initial_poses import InitialPoses, first_poses
from kcal.calibrate.rig.mixups import refuse_same_camera, swap_warnings
from kcal.calibrate.rig.motion import moved_warnings
from kcal.calibrate.rig.other_places import refuse_several
from kcal.calibrate.rig.outliers import ROUGHLY, possible
from kcal.calibrate.rig.prior_information import gathered, joint_unknowns
from kcal.calibrate.rig.records import Reasons, item_records, places, source_records
from kcal.calibrate.rig.redundancy import refuse_exact
from kcal.calibrate.rig.repeated_views import without_repeated
from kcal.calibrate.rig.result import RigResult
from kcal.calibrate.rig.robust_start import robust_solution
from kcal.calibrate.rig.sources import RigData
from kcal.calibrate.rig.uncertainty import SharedCovariance, goodness_of_fit, parameter_rows, relative_rows
from kcal.calibrate.rig.unknowns import SharedUnknowns, free, held
from kcal.calibrate.rig.weak_geometry import check_places
from kcal.errors import DegenerateError, InputError
from kcal.io.camera_file import provenance
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation
from kcal.lens.mounting import REFRACTION, REFRACTION_SIGMA, check_refraction
from kcal.solve.lm import LMOptions
from kcal.solve.result import Result, SolverStatus

# λ of a solve that begins at the robust solution.
_NEAR_DAMPING = 1e-9
# Of fewer boards alone, a wrong one cannot be told from a good one.
_FEW_BOARDS = 3
# px: a higher RMS is not noise.
_HIGH_RMS = 1.0


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


def solve_rig(data: RigData, options: RigOptions | None = None) -> RigResult:
    """Solve for the poses of all cameras of a rig (and their parameters, if asked) from everything that is known.

    Least squares of all residuals over their standard deviations; landmarks, far features and boards are unknowns too
    and are eliminated. A robust loss finds the solution that most of the data agree on; what contradicts it is left
    out and named; the rest is solved by plain least squares.

    Args:
        data: see `RigData`.
        options: see `RigOptions`.

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
    data, warnings = _without_rayless(data)
    data, unknowns = _what_may_change(data, options)
    initial = first_poses(data, options.solver)
    masks, reasons = _first_masks(initial, reject=options.reject)
    work = robust_solution(initial, masks, unknowns)
    if options.motion:
        work.fit_motion(possible(work, masks))
    # With lenses among the unknowns digits are dear, and what is wrong shows without them.
    looking = ROUGHLY if unknowns.refine_lenses else options.solver
    if options.reject:
        masks = kept = explained(work, masks, looking)
    else:
        masks = possible(work, masks)
        kept, doubts = _suspicions(work, masks, reasons, looking)
        warnings += doubts
    if options.motion:
        work.fit_motion(kept)
    # The robust solution is near, so that the first step may be the undamped one.
    near = dataclasses.replace(options.solver, initial_damping=_NEAR_DAMPING)
    _, found = work.solve(masks, near)
    for _ in range(3):
        before = work.sigma_corner
        work.fit_corners(masks)
        if work.sigma_corner != before:
            _, found = work.solve(masks, near)
        if abs(work.sigma_corner / before - 1.0) < 1e-3:
            break
    return _rig_result(work, found, masks, reasons, initial, warnings, refuse=options.reject)


def _without_rayless(data: RigData) -> tuple[RigData, list[str]]:
    """The data with pixels at which a lens model has no ray taken as unseen."""
    warnings, changed = [], {}
    for kind in KINDS:
        source = getattr(data, kind)
        if source is None:
            continue
        pixels = source.pixels.clone()
        for c, camera in enumerate(data.cameras):
            seen = torch.isfinite(pixels[:, c]).all(-1)
            _, valid = camera.unproject(pixels[:, c])
            lost = seen & ~valid
            if not bool(lost.any()):
                continue
            if kind == "boards":
                few = (seen.sum(-1) >= MINIMUM_CORNERS) & ((seen & valid).sum(-1) < MINIMUM_CORNERS)
                for i in few.nonzero()[:, 0].tolist():
                    raise InputError(
                        f"board {source.names[i]}: the {data.names[c]} camera's lens model has no ray at most of its "
                        "corners: it folds inside the image; calibrate with views nearer the image's border or with a "
                        "smaller model"
                    )
            warnings.append(f"{int(lost.sum())} pixels of {kind} left out where {data.names[c]}'s lens has no ray")
            pixels[:, c] = torch.where(lost[..., None], torch.nan, pixels[:, c])
        changed[kind] = dataclasses.replace(source, pixels=pixels)
    return dataclasses.replace(data, **changed), warnings


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


def _what_may_change(data: RigData, options: RigOptions) -> tuple[RigData, SharedUnknowns]:
    """What may change of cameras, board and air, and the data with the board as it is expected."""
    boards = data.boards
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
            knowledge = gathered(data.cameras, known, boards.board)
            measured = boards.deviation is not None
            unknowns, deviation = joint_unknowns(data.cameras, knowledge, boards.board, measured=measured)
            if deviation is not None:
                data = dataclasses.replace(data, boards=dataclasses.replace(boards, deviation=deviation))
    else:
        unknowns = held(data.cameras) if options.intrinsics == "fixed" else free(data.cameras, data.names)
    if options.board_warp and boards is not None and not len(unknowns.shapes):
        unknowns = unknowns.and_warp(boards.points)
    if data.absolute:
        unknowns = unknowns.and_refraction(options.refraction, options.refraction_sigma)
    if data.stars is not None and data.stars.effects:
        unknowns = unknowns.and_effects(*(effect.name for effect in data.stars.effects))
    return data, unknowns


@functools.lru_cache(maxsize=2)
def _lens_unknowns(
    cameras: tuple[Camera, ...], fingerprints: tuple[str, ...], known: tuple[CameraInformation | None, ...]
) -> SharedUnknowns:
    """Unknowns of cameras without boards. Whoever marks landmarks solves the same rig again and again."""
    return joint_unknowns(cameras, gathered(cameras, known, None), None)[0]


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


def _refined(camera: Camera, parameters: Tensor, covariance: Tensor) -> Camera:
    """The camera as the rig found it, with new sigmas; all that is known of it together is the rig's covariance."""
    out, known = camera.with_parameters(parameters), camera.calibration
    spread = covariance.diagonal().sqrt()
    sigma = {
        name: float(value) if 0 < value < math.inf else None for name, value in zip(camera.names, spread, strict=True)
    }
    name, record = ("", None) if known is None else (known.name, known.record)
    out.calibration = CameraCalibration(name=name, sigma=sigma, record=record)
    return out


def _rig_result(
    work: Adjustment,
    found: Result,
    masks: PerKind,
    reasons: Reasons,
    initial: InitialPoses,
    warnings: list[str],
    *,
    refuse: bool,
) -> RigResult:
    data, state, problem = work.data, work.part(masks), work.problem(masks)
    fit = goodness_of_fit(problem, state)
    covariance = SharedCovariance(problem, state, fit.variance)
    undetermined = covariance.open_directions(data.names, absolute=data.absolute)
    for second in range(1, len(data.cameras)):
        if not bool(covariance.of(relative_rows(problem, state, 0, second))[1].all()):
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
    refuse_exact(problem, data.names, fit.freedom)
    refuse_several(work, masks)
    against = contradictions(work, problem, state)
    certain = [one for one in against if one.sigmas > CERTAIN]
    if refuse and certain and certain[0].stated:
        raise InputError(certain[0].text)
    widen, doubts = check_places(problem, state, covariance, data.names, refuse=refuse)
    if widen > 1.0:
        covariance = SharedCovariance(problem, state, widen**2 * fit.variance)
    squared, counts = torch.zeros(len(data.cameras)).double(), torch.zeros(len(data.cameras)).double()
    for block in problem.blocks:
        squared += block.errors(problem.posed(state), state).square().sum((0, 2, 3))
        counts += block.seen.sum((0, 2))
    rms, status = math.sqrt(float(squared.sum() / counts.sum())), SolverStatus(int(found.status))
    if fit.variance > 1.0:
        times = math.sqrt(fit.variance)
        warnings.append(f"residuals are {times:.1f} times as large as their sigmas say; the covariance was widened")
    warnings += [one.text for one in against]
    only_boards = len(problem.blocks) == 1 and problem.blocks[0].kind == "boards"
    if only_boards and (count := int(masks.boards.sum())) < _FEW_BOARDS:
        warnings.append(f"{count} pair(s) only: a wrong one could not be noticed; 5 or more are good")
    if only_boards and rms > _HIGH_RMS:
        warnings.append(f"RMS {rms:.2f} px is high: were both views of each pair taken at the same moment?")
    if status not in (SolverStatus.CONVERGED, SolverStatus.EXACT):
        warnings.append(f"the solver {status.message}")
    focal = [float(camera.params[0]) for camera in data.cameras]
    warnings += moved_warnings(data.names, focal, work.motion, work.sigma_corner)
    warnings += doubts
    warnings += [f"not determined by the data: {text}" for text in undetermined]
    whole = [parameter_rows(problem, c) for c in range(len(data.cameras))]
    if not bool(covariance.of(torch.cat(whole))[1].all()):
        warnings.append(
            "the data do not determine all parameters of the cameras: the rig has no covariance, and intervals know "
            "errors of the marks alone"
        )
    warnings += swap_warnings(data, problem, state, covariance)
    items = item_records(work, masks, reasons)
    cameras = data.cameras
    if any(bool(part.any()) for part in problem.unknowns.cameras):
        cameras = tuple(
            _refined(camera, problem.parameters(state)[c], covariance.of(parameter_rows(problem, c))[0])
            for c, camera in enumerate(data.cameras)
        )
    return RigResult(
        data=data,
        cameras=cameras,
        rotation=state.rotation,
        center=state.center,
        board_warp=state.board if len(problem.unknowns.shapes) == 2 else None,
        sources=source_records(work, masks, items),
        items=items,
        flipped=tuple(initial.flipped),
        rms=rms,
        rms_px=tuple((squared / counts).sqrt().tolist()),
        chi2=fit.chi2,
        freedom=fit.freedom,
        variance=widen**2 * fit.variance,
        sigma_corner=None if data.boards is None else work.sigma_corner,
        undetermined=undetermined,
        contradictions=tuple(one.text for one in certain),
        status=status,
        warnings=tuple(warnings),
        _problem=problem,
        _state=state,
        _covariance=covariance,
        _places=places(work),
        _provenance=provenance(),
    )
