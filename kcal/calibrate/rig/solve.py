"""`solve_rig`: one joint adjustment of a rig from boards, landmarks, far features, baselines and measured positions."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.rig.adjustment import KINDS, Adjustment, Intrinsics, chi2_quantile
from kcal.calibrate.rig.initial_poses import InitialPoses, first_poses
from kcal.calibrate.rig.outliers import LOSS, ROUGHLY, reject_wrong
from kcal.calibrate.rig.problem import RigProblem
from kcal.calibrate.rig.records import item_records, places, source_records
from kcal.calibrate.rig.result import RigSolution, check_determined
from kcal.calibrate.rig.sources import RigData
from kcal.calibrate.rig.uncertainty import SharedSpread
from kcal.errors import InputError
from kcal.solve.lm import LMOptions
from kcal.solve.result import Result, SolverStatus

# Guess of a corner's noise before the boards themselves tell it, px.
_CORNER_SIGMA = 0.2
# Rival starts are told apart after some steps.
_SCREENING = LMOptions(max_iterations=25, tolerance=1e-6, residual_floor=1e-8)


@dataclasses.dataclass(frozen=True, kw_only=True)
class JointOptions:
    """Options of `solve_rig`.

    Args:
        intrinsics: "fixed": as the cameras have them; "prior": solved, held by the covariances of `RigData`; "free".
        reject: leave out what contradicts the rest (it is listed); otherwise it is only warned of.
        solver: options of the Levenberg-Marquardt solver; residuals are in sigmas.
    """

    intrinsics: Intrinsics = "fixed"
    reject: bool = True
    solver: LMOptions = dataclasses.field(default_factory=lambda: LMOptions(residual_floor=1e-8))

    def __post_init__(self) -> None:
        if self.intrinsics not in ("fixed", "prior", "free"):
            raise InputError(f"intrinsics must be fixed, prior or free, got {self.intrinsics!r}")


def solve_rig(data: RigData, options: JointOptions | None = None) -> RigSolution:
    """Solve for the poses of all cameras of a rig (and their parameters, if asked) from everything that is known.

    Least squares of all residuals over their standard deviations; landmarks, far features and boards are unknowns too
    and are eliminated. A robust loss finds the solution that most of the data agree on; what contradicts it is left
    out and named; the rest is solved by plain least squares.

    Args:
        data: see `RigData`.
        options: see `JointOptions`.

    Raises:
        InputError: data that contradict each other as a whole.
        DegenerateError: a camera that nothing ties to the others, or relative poses that the data do not determine;
            what could be anything is named.

    Example:
        >>> from kcal.calibrate.rig.sources import Landmarks
        >>> from kcal.lens.camera import Camera
        >>> camera = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080), model="pinhole")
        >>> truth = torch.tensor([[0.0, 0, 0], [10.0, 0, 0]], dtype=torch.float64)  # both look north
        >>> look = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
        >>> points = torch.tensor([[-40.0, 120, 3], [30, 150, -8], [5, 300, 20], [60, 200, 9], [-80, 400, -9]]).double()
        >>> marks = torch.stack([camera.project((points - center) @ look.T)[0] for center in truth], 1)
        >>> survey = Landmarks(names=tuple("abcde"), points=points, sigma=torch.full((5, 3), 0.02).double(),
        ...                    pixels=marks, pixel_sigma=0.1)
        >>> found = solve_rig(RigData(cameras=(camera, camera), names=("left", "right"), landmarks=survey))
        >>> round(float(found.stereo().baseline), 6), found.left_out
        (10.0, ())
    """
    options = options or JointOptions()
    _check(data)
    data, warnings = _without_rayless(data)
    begun = first_poses(data, options.solver)
    data = begun.data
    masks = _first_masks(begun)
    reasons = _initial_reasons(begun, masks)
    work = _robust(begun, masks, options)
    if options.reject:
        reject_wrong(work, masks, reasons, options.solver)
    for _ in range(3):
        problem, result = work.solve(masks, options.solver)
        before = work.sigma_corner
        work.fit_corners(masks)
        if abs(work.sigma_corner / before - 1.0) < 1e-3:
            break
    problem, result = work.solve(masks, options.solver)
    return _solution(work, problem, result, masks, reasons, begun, warnings)


def _check(data: RigData) -> None:
    sources = (data.boards, data.landmarks, data.features)
    if not any(sources) and not data.positions:
        raise InputError("a rig needs boards, landmarks or features; there is nothing to solve it from")


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
            if bool(lost.any()):
                warnings.append(f"{int(lost.sum())} of the {kind} left out where {data.names[c]}'s lens has no ray")
                pixels[:, c] = torch.where(lost[..., None], torch.nan, pixels[:, c])
        changed[kind] = dataclasses.replace(source, pixels=pixels)
    return dataclasses.replace(data, **changed), warnings


def _first_masks(begun: InitialPoses) -> list[Tensor]:
    data = begun.data
    none = torch.zeros(0, dtype=torch.bool)
    boards = begun.usable.clone()
    boards[list(begun.foreign)] = False
    seen = [
        none if source is None else torch.isfinite(source.pixels).all(-1).sum(-1)
        for source in (data.landmarks, data.features)
    ]
    return [boards, seen[0] >= 1, seen[1] >= 2]


def _initial_reasons(begun: InitialPoses, masks: Sequence[Tensor]) -> list[dict[int, str]]:
    plain = (
        "fewer than two cameras see enough of it",
        "no camera has a mark of it",
        "fewer than two cameras have a mark of it",
    )
    reasons = [dict.fromkeys((~mask).nonzero()[:, 0].tolist(), text) for mask, text in zip(masks, plain, strict=True)]
    reasons[0].update(begun.foreign)
    return reasons


def _robust(begun: InitialPoses, masks: list[Tensor], options: JointOptions) -> Adjustment:
    """The best robust solution of all starts."""
    boards = begun.data.boards
    sigma = _CORNER_SIGMA if boards is None or boards.sigma is None else boards.sigma
    best: tuple[float, Adjustment, list[Tensor]] | None = None
    for start in begun.starts:
        work = Adjustment(begun.data, start, options.intrinsics, sigma)
        here = [mask.clone() for mask in masks]
        for mask, squares in zip(here, work.squares(here), strict=True):
            # Behind a camera, or beyond what its lens shows: no number says how wrong it is.
            mask &= torch.isfinite(squares)
        work.fit_corners(here, robust=True)
        _, result = work.solve(here, _SCREENING, LOSS)
        cost = float(result.cost) + 1e6 * sum(int((a & ~b).sum()) for a, b in zip(masks, here, strict=True))
        if best is None or cost < best[0]:
            best = (cost, work, here)
    assert best is not None
    work, here = best[1:]
    work.fit_corners(here, robust=True)
    work.solve(here, ROUGHLY, LOSS)
    return work


def _solution(
    work: Adjustment,
    problem: RigProblem,
    result: Result,
    masks: list[Tensor],
    reasons: list[dict[int, str]],
    begun: InitialPoses,
    warnings: list[str],
) -> RigSolution:
    data, state = work.data, work.part(masks)
    terms = problem.term_rows(state)
    chi2 = 2.0 * float(problem.cost(state))
    unknowns = problem.shared_size + sum(len(group) * group.size for group in problem.groups)
    freedom = problem.residual_count - 1 + terms.shape[1] - unknowns
    variance = 1.0
    if freedom > 0 and chi2 > float(chi2_quantile(torch.tensor(float(freedom)), 0.999)):
        variance = chi2 / freedom
        warnings.append(
            f"residuals are {math.sqrt(variance):.1f} times as large as their sigmas say; the covariance was widened"
        )
    if freedom <= 0:
        warnings.append("nothing is left over to check the solution with: a wrong measurement could not be noticed")
    status = SolverStatus(int(result.status))
    if status not in (SolverStatus.CONVERGED, SolverStatus.EXACT):
        warnings.append(f"the solver {status.message}")
    spread = SharedSpread(problem, state, variance)
    undetermined = spread.open_directions(data.names, absolute=data.absolute)
    check_determined(spread, problem, state, data.names, undetermined)
    warnings += [f"not determined by the data: {text}" for text in undetermined]
    items = item_records(work, masks, reasons)
    solved = problem.cameras(state)
    kept = all(not len(free) for free in work.free)
    cameras = data.cameras if kept else tuple(
        camera.with_parameters(values)
        for values, camera in zip(solved.parameters, data.cameras, strict=True)
    )  # fmt: skip
    squared, counts = torch.zeros(len(cameras)).double(), torch.zeros(len(cameras)).double()
    sights = problem.sights(state)
    for group, local in zip(problem.groups, problem.locals(state), strict=True):
        squared += group.errors(sights, local).square().sum((0, 2, 3))
        counts += group.seen.sum((0, 2))
    return RigSolution(
        cameras=cameras,
        names=data.names,
        rotation=solved.rotation,
        center=solved.center,
        absolute=data.absolute,
        sources=source_records(work, masks, items),
        items=items,
        flipped=tuple(begun.flipped),
        rms_px=tuple((squared / counts).sqrt().tolist()),
        chi2=chi2,
        freedom=freedom,
        variance=variance,
        sigma_corner=None if data.boards is None else work.sigma_corner,
        undetermined=undetermined,
        status=status,
        warnings=tuple(warnings),
        _problem=problem,
        _state=state,
        _spread=spread,
        _places=places(work),
    )
