"""Solving a rig: where the right camera stands from the left, by boards that both have seen."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.bundle.board_problem import BoardProblem, BoardState
from kcal.calibrate.bundle.closed_form import spread_out
from kcal.calibrate.bundle.covariance import uncertainty_of
from kcal.calibrate.bundle.views import free_parameters
from kcal.calibrate.bundle.weights import whitening
from kcal.calibrate.rig.board_consensus import MINIMUM_CORNERS, check_fit, consensus, pair_rms, pose_alone
from kcal.calibrate.rig.pair_checks import FEWEST, alone_squares, disagreement
from kcal.calibrate.rig.pairs import Pair
from kcal.corners.observations import Observations
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import nearest_rotation
from kcal.lens.rig import StereoRig
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.result import State, Status

# A pair this many times worse than the median pair, and worse than the floor in pixels, is left out: roughly aligned,
# and after the joint solve.
_ROUGH = (10.0, 10.0)
# One pair of eight that is 4 px off turns a rig by 0.4 degrees and is by then only 4 times worse than the median.
_FINE = (3.0, 0.5)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RigOptions:
    """Options of `calibrate_rig`.

    Args:
        refine_cameras: solve for intrinsics and lenses again, jointly with the rig, starting from the given cameras.
        board_warp: estimate how the board bends.
        weighted: let corners count by their covariances where all views have them.
        reject: leave out pairs that noise cannot explain; otherwise a warning names them.
        solver: options of the Levenberg-Marquardt solver.
    """

    refine_cameras: bool = False
    board_warp: bool = False
    weighted: bool = True
    reject: bool = False
    solver: LMOptions = dataclasses.field(default_factory=LMOptions)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RigCalibrationResult:
    """A solved rig and what it rests on.

    Args:
        rig: the rig, in the left camera's frame.
        rms: sqrt(mean ‖r‖²) over the corners of both cameras, pixels.
        rms_left: of the left camera alone.
        rms_right: of the right camera alone.
        pairs: the pairs used.
        per_pair_rms: (P,) over both cameras.
        flipped: pairs in which the right camera's corners had been read from the other end; they were turned.
        excluded: pairs left out, with the reason.
        sigma_rotation: (3,) radians, of right_from_left about the right camera's x (pitch), y (yaw) and z (roll).
        sigma_translation: (3,) meters, of right_from_left along the right camera's axes.
        covariance: of both cameras' parameters (zeros where they were held) and right_from_left together, in the order
            of `kcal.lens.rig.RigCovariance`.
        disagreement: (P,) of the pairs used: above 1, joining the cameras costs a pair more than noise explains; see
            `kcal.calibrate.rig.pair_checks`.
        pixels: (P, 2, N, 2) corners as used, turned where flipped; NaN where not seen.
        status: why the solver stopped.
        warnings: sentences about what the user should doubt.
    """

    rig: StereoRig
    rms: float
    rms_left: float
    rms_right: float
    pairs: tuple[Pair, ...]
    per_pair_rms: Tensor
    flipped: tuple[Pair, ...]
    excluded: tuple[tuple[Pair, str], ...]
    sigma_rotation: Tensor
    sigma_translation: Tensor
    covariance: Tensor
    disagreement: Tensor
    pixels: Tensor
    status: Status
    warnings: tuple[str, ...]


def calibrate_rig(
    left: Camera,
    right: Camera,
    left_observations: Observations,
    right_observations: Observations,
    pairs: Sequence[Pair],
    options: RigOptions | None = None,
) -> RigCalibrationResult:
    """Find the pose of the right camera in the left one's frame.

    Each camera's board poses are found alone; every pair then proposes a relative pose, in the corner order as read
    and with the right image's order turned by 180°. The proposal that the other pairs agree with best settles which
    pairs were read from the other end and which do not belong. All remaining pairs are refined jointly: one board pose
    a pair, one relative pose, the sum of squares over both images.

    Args:
        left: the left camera, calibrated.
        right: the right camera, calibrated.
        left_observations: views of the left camera.
        right_observations: views of the right camera.
        pairs: names of views taken at the same moment (see `kcal.calibrate.rig.pairs`).
        options: see `RigOptions`.

    Raises:
        InputError: boards or image sizes that differ, cameras that do not fit their observations.
        DegenerateError: no pair is left.

    Example:
        >>> from kcal.corners.board import Board
        >>> from kcal.corners.observations import View
        >>> from kcal.lens.pose import rotation_from_vector
        >>> board = Board(columns=7, rows=6, square=0.05)
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480))
        >>> truth = StereoRig(camera, camera, torch.eye(3), torch.tensor([-0.2, 0.0, 0.0]))
        >>> tilts = torch.tensor([[0.4, 0, 0], [-0.4, 0.1, 0], [0, 0.4, 0.2]], dtype=torch.float64)
        >>> sides = ([], [])
        >>> for i, rotation in enumerate(rotation_from_vector(tilts)):
        ...     points = board.points @ rotation.T + torch.tensor([-0.1, -0.1, 1.0], dtype=torch.float64)
        ...     for views, pixels in zip(sides, truth(points)[:2]):
        ...         views.append(View(name=f"{i}.png", pixels=pixels.tolist()))
        >>> left, right = (Observations(board=board, image_size=(640, 480), views=views) for views in sides)
        >>> pairs = [(name, name) for name in left.names]
        >>> result = calibrate_rig(camera, camera, left, right, pairs)
        >>> [round(value, 6) + 0.0 for value in result.rig.right_from_left_translation.tolist()]
        [-0.2, 0.0, 0.0]
    """
    options = options or RigOptions()
    pixels, names, covariances = _pixels(left, right, left_observations, right_observations, pairs)
    board = left_observations.board.points
    cameras = (left, right)
    lost = _drop_rayless(pixels, cameras, names)
    views, alone = zip(*(pose_alone(board, pixels[:, c], cameras[c], options.solver) for c in (0, 1)), strict=True)
    check_fit(board, pixels, cameras, alone, options.solver)

    relative, turned, error = consensus(board, pixels, cameras, views[0], views[1])
    # Before boards are turned: then a camera's own poses are no longer those of its corners.
    apart, variance = alone_squares(board, pixels, cameras, views)
    pixels[turned, 1] = pixels[turned, 1].flip(-2)
    if covariances is not None:
        covariances[turned, 1] = covariances[turned, 1].flip(-3)
    flipped = [names[i] for i in turned.nonzero()[:, 0].tolist()]
    excluded: list[tuple[Pair, str]] = []
    keep = ~_outliers(error, *_ROUGH)
    for i in (~keep).nonzero()[:, 0].tolist():
        excluded.append((names[i], f"its board is {float(error[i]):.0f} px away from where the other pairs put it"))

    start = BoardState(
        parameters=tuple(camera.params.detach() for camera in cameras),
        warp=torch.zeros(2, dtype=torch.float64),
        cam_from_first_rotation=relative.rotation[None],
        cam_from_first_translation=relative.translation[None],
        first_from_board_rotation=views[0].rotation,
        first_from_board_translation=views[0].translation,
    ).pack()
    free = [free_parameters(camera.model) if options.refine_cameras else [] for camera in cameras]
    models, fields = [camera.model for camera in cameras], [camera.field for camera in cameras]
    settled = False
    suspects: list[tuple[int, str]] = []
    while True:
        if not bool(keep.any()):
            raise DegenerateError("no pair is left: do the views of a pair show the same board at the same moment?")
        *shared, rotation, translation = start
        problem = BoardProblem(board, pixels[keep], models, free, free_warp=options.board_warp, fields=fields)
        result = minimize(problem, (*shared, rotation[keep], translation[keep]), options.solver)
        rms = pair_rms(problem, result.state, pixels[keep])
        joined = 2.0 * problem.view_cost(result.state)
        beyond = disagreement(joined, apart[keep], variance)
        if settled:
            break
        kept = keep.nonzero()[:, 0].tolist()
        # The worst alone: it has spoilt the others.
        worst = int(rms.argmax())
        if bool(_outliers(rms, *_FINE)[worst]):
            reason = f"RMS {float(rms[worst]):.2f} px against {float(rms.median()):.2f} px typically"
            excluded.append((names[kept[worst]], reason))
            keep[kept[worst]] = False
            continue
        worst = int(beyond.argmax())
        if len(rms) >= FEWEST and float(beyond[worst]) > 1.0:
            suspects.append((kept[worst], _disagrees(joined - apart[keep], worst)))
            keep[kept[worst]] = False
            continue
        if not suspects or options.reject:
            excluded += [(names[i], reason) for i, reason in suspects]
            break
        # Named, but used: once more with them.
        keep[[i for i, _ in suspects]] = settled = True
    if covariances is not None and options.weighted:
        # What the plain solution leaves tells how much there is beyond the corners' own noise.
        spread_left = 2.0 * float(result.cost) / problem.residual_count
        weights = whitening(covariances[keep], spread_left)
        problem = BoardProblem(
            board, pixels[keep], models, free, free_warp=options.board_warp, whitening=weights, fields=fields
        )  # fmt: skip
        result = minimize(problem, result.state, options.solver)
    used = [names[i] for i in keep.nonzero()[:, 0].tolist()]
    solved = _result(problem, problem.tidy(result.state), Status(int(result.status)), cameras, pixels[keep], used)
    if settled:
        lost += [f"pair {names[i][0]}, {names[i][1]}: {reason}; was it one moment?" for i, reason in suspects]
    return dataclasses.replace(
        solved,
        disagreement=beyond,
        flipped=tuple(pair for pair in flipped if pair in used),
        excluded=tuple(excluded),
        warnings=(*lost, *solved.warnings),
    )


def _drop_rayless(pixels: Tensor, cameras: tuple[Camera, Camera], names: list[Pair]) -> list[str]:
    """Turn corners at which a lens model has no ray into unseen ones, in place; returns warnings."""
    warnings = []
    for c, word in enumerate(("left", "right")):
        _, valid = cameras[c].normalize(pixels[:, c])
        seen = torch.isfinite(pixels[:, c]).all(-1)
        if not bool((seen & ~valid).any()):
            continue
        few = ((seen & valid).sum(-1) < MINIMUM_CORNERS).nonzero()[:, 0].tolist()
        if few:
            raise InputError(
                f"{names[few[0]][c]}: the {word} camera's lens model has no ray at most of its corners: it folds "
                "inside the image; calibrate with views nearer the image's border or with a smaller model"
            )
        warnings.append(f"{int((seen & ~valid).sum())} corners left out where the {word} lens model has no ray")
        pixels[:, c] = torch.where(valid[..., None], pixels[:, c], torch.nan)
    return warnings


def _disagrees(cost: Tensor, index: int) -> str:
    times = math.sqrt(float(cost[index].clamp_min(0.0)) / max(float(cost.clamp_min(0.0).median()), 1e-12))
    return f"its two views disagree about the rig {times:.1f} times as much as is typical"


def _outliers(error: Tensor, times: float, floor: float) -> Tensor:
    return error > max(times * float(error.median()), floor)


def _pixels(
    left: Camera, right: Camera, left_seen: Observations, right_seen: Observations, pairs: Sequence[Pair]
) -> tuple[Tensor, list[Pair], Tensor | None]:
    if left_seen.board != right_seen.board:
        raise InputError(f"the cameras saw different boards: {left_seen.board} and {right_seen.board}")
    for word, camera, seen in (("left", left, left_seen), ("right", right, right_seen)):
        if camera.size != tuple(seen.image_size):
            raise InputError(
                f"the {word} camera has images of {camera.size[0]}x{camera.size[1]}, its observations of "
                f"{seen.image_size[0]}x{seen.image_size[1]}: are the files mixed up?"
            )
    if not pairs:
        raise InputError("no pair of views")
    sides = [seen.subset([pair[c] for pair in pairs]) for c, seen in enumerate((left_seen, right_seen))]
    pixels = torch.stack([side.pixels() for side in sides], 1)
    spreads = [spread for side in sides if (spread := side.covariances()) is not None]
    seen_corners = torch.isfinite(pixels).all(-1).sum(-1)
    for pair, counts in zip(pairs, seen_corners.tolist(), strict=True):
        if min(counts) < MINIMUM_CORNERS:
            raise InputError(f"pair {pair[0]}, {pair[1]}: at least {MINIMUM_CORNERS} corners are needed in each view")
    board = left_seen.board.points
    for c in (0, 1):
        for i in (~spread_out(board, pixels[:, c])).nonzero()[:, 0].tolist():
            raise InputError(f"{pairs[i][c]}: all its corners, or all but one, lie on one line; leave the pair out")
    return pixels, list(pairs), torch.stack(spreads, 1) if len(spreads) == 2 else None


def _result(
    problem: BoardProblem,
    state: State,
    status: Status,
    cameras: tuple[Camera, Camera],
    pixels: Tensor,
    used: list[Pair],
) -> RigCalibrationResult:
    s = problem.unpack(state)
    solved = [camera.with_parameters(parameters) for parameters, camera in zip(s.parameters, cameras, strict=True)]
    rig = StereoRig(
        solved[0], solved[1], nearest_rotation(s.cam_from_first_rotation[0]), s.cam_from_first_translation[0]
    )
    # Plain pixels, also where corners were weighed.
    squared = problem.pixel_errors(state).pow(2).sum(-2)
    seen = torch.isfinite(pixels).all(-1)
    each = torch.sqrt(squared.sum((0, 2)) / seen.sum((0, 2)))
    uncertainty = uncertainty_of(
        problem.linearize(state), problem.residual_count, problem.shared_size + 6 * len(pixels)
    )
    pose = uncertainty.sigma[sum(len(f) for f in problem.free) :][:6]
    warnings = []
    if len(used) < 3:
        warnings.append(f"{len(used)} pair(s) only: a wrong one could not be noticed; 5 or more are good")
    if status not in (Status.CONVERGED, Status.EXACT):
        warnings.append(f"the solver {status.message}")
    rms = float(torch.sqrt(squared.sum() / seen.sum()))
    if rms > 1.0:
        warnings.append(f"RMS {rms:.2f} px is high: were both views of each pair taken at the same moment?")
    return RigCalibrationResult(
        rig=rig,
        rms=rms,
        rms_left=float(each[0]),
        rms_right=float(each[1]),
        pairs=tuple(used),
        per_pair_rms=torch.sqrt(squared.sum((1, 2)) / seen.sum((1, 2))),
        flipped=(),
        excluded=(),
        sigma_rotation=pose[:3],
        sigma_translation=pose[3:],
        covariance=_joint(uncertainty.covariance, problem),
        disagreement=torch.zeros(len(pixels), dtype=torch.float64),
        pixels=pixels,
        status=status,
        warnings=tuple(warnings),
    )


def _joint(shared: Tensor, problem: BoardProblem) -> Tensor:
    """The covariance of the shared unknowns as that of all parameters of both cameras and the relative pose."""
    sizes = [5 + model.size for model in problem.models]
    rows = torch.zeros(sum(sizes) + 6, len(shared), dtype=torch.float64)
    start = column = 0
    for size, free in zip(sizes, problem.free, strict=True):
        for index, slot in zip(free.indices, free.slots, strict=True):
            rows[start + index, column + slot] = 1.0
        start, column = start + size, column + len(free)
    rows[start:, column : column + 6] = torch.eye(6, dtype=torch.float64)
    matrix = rows @ shared @ rows.T
    return 0.5 * (matrix + matrix.T)
