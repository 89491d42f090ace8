"""The verdict on a rig: its ranges from the covariance of everything together, and whether its pairs agree."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.problem.views import Views, poses_under
from kcal.calibrate.rig.result import RigResult
from kcal.checks import as_points
from kcal.errors import DegenerateError, InputError
from kcal.finding import FAULTS, Finding
from kcal.lens.calibration import noise_of_marks
from kcal.lens.camera import Camera
from kcal.lens.pose import step_rows, vector_from_rotation
from kcal.lens.projection import project_components
from kcal.lens.rig import Rig
from kcal.locate.budget import RangeSigmas, range_sigmas, station_sigmas
from kcal.locate.views import fit_pairs
from kcal.report.judge_camera import stored_findings
from kcal.report.verdict import RangeAnswer, Requirement, Verdict, weighed_findings
from kcal.solve.lm import LMOptions
from kcal.texts import range_text
from kcal.threads import in_one_thread

# Tell whether both cameras of a rig saw each board in the same place: were they synchronous, and did neither move?

_POSES = LMOptions(max_iterations=60, tolerance=1e-12)
# Median of χ² with six degrees of freedom, over six.
_MEDIAN = 0.8914
# Pairs from which a delay can be told, and corners that a pose needs in each camera.
_FEWEST_PAIRS, _FEWEST_CORNERS = 8, 6


class Synchrony(NamedTuple):
    """How well pairs agree on the relative pose.

    Attributes:
        pairs: how many could be compared.
        ratio: typical disagreement over what noise of the corners explains; about 1 for synchronous cameras.
        shift: typical distance, across the line of sight, by which the board is elsewhere for the right camera, meters.
        delay: time by which the right camera was later, in steps from one view to the next, from displacements along
            the board's motion in the order of the views; None with few pairs.
        delay_sigma: its standard deviation.
    """

    pairs: int
    ratio: float
    shift: float
    delay: float | None = None
    delay_sigma: float | None = None


@torch.no_grad()
def synchrony(rig: Rig, board_points: Tensor, pixels: Tensor) -> Synchrony:
    """Compare the board's pose as each camera alone sees it, pair by pair.

    Args:
        rig: the solved rig.
        board_points: (N, 3) meters, as measured.
        pixels: (P, 2, N, 2) corners of each pair in the order in which they were taken; NaN where not seen.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480))
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-0.1, 0.0, 0.0]))
        >>> points = torch.cartesian_prod(torch.arange(5.0), torch.arange(4.0), torch.zeros(1)).double() * 0.05
        >>> places = points + torch.tensor([[[-0.1, -0.1, 1.0]], [[0.0, 0.0, 1.2]]], dtype=torch.float64)
        >>> moved = places + torch.tensor([0.0, 0.01, 0.0], dtype=torch.float64)  # 1 cm between both exposures
        >>> pixels = torch.stack([rig(places)[0][..., 0, :], rig(moved)[0][..., 1, :]], 1)
        >>> round(synchrony(rig, points, pixels).shift, 3)
        0.01
    """
    enough = (pixels.isfinite().all(-1).sum(-1) >= _FEWEST_CORNERS).all(-1)
    pixels = pixels[enough]
    if not len(pixels):
        return Synchrony(0, 1.0, 0.0)
    (turn, shift), left_spread, left_cost = _alone(rig.left, board_points, pixels[:, 0])
    (turn_right, shift_right), right_spread, right_cost = _alone(rig.right, board_points, pixels[:, 1])
    relative = rig.right_from_left_rotation
    predicted = relative @ turn, shift @ relative.T + rig.right_from_left_translation
    apart = torch.cat([vector_from_rotation(turn_right @ predicted[0].mT), shift_right - predicted[1]], -1)
    both = torch.block_diag(relative, relative)
    corners = pixels.isfinite().all(-1).sum(-1)
    noise = (left_cost + right_cost).sum() * 2.0 / (2 * corners - 6).sum()
    # Exact data: rounding must not count as a disagreement.
    spread = noise.clamp_min(1e-10) * (both @ left_spread @ both.T + right_spread)
    squares = (apart * torch.linalg.solve(spread, apart[..., None])[..., 0]).sum(-1) / 6.0
    middle = board_points.mean(0)
    center, center_left = (r @ middle + t for r, t in ((turn_right, shift_right), predicted))
    sight = torch.nn.functional.normalize(center, dim=-1)
    away = center - center_left
    away = away - (away * sight).sum(-1, keepdim=True) * sight
    ratio = math.sqrt(float(squares.median()) / _MEDIAN)
    found = Synchrony(len(pixels), ratio, float(away.norm(dim=-1).square().median().sqrt()))
    if len(pixels) < _FEWEST_PAIRS:
        return found
    velocity = torch.gradient(center, dim=0)[0]
    velocity = velocity - (velocity * sight).sum(-1, keepdim=True) * sight
    power = float(velocity.square().sum())
    if not power > 0:
        return found
    delay = float((velocity * away).sum()) / power
    rest = float((away - delay * velocity).square().mean())
    return found._replace(delay=delay, delay_sigma=math.sqrt(rest / power))


def _alone(camera: Camera, board_points: Tensor, pixels: Tensor) -> tuple[tuple[Tensor, Tensor], Tensor, Tensor]:
    """Poses (P, 3, 3) and (P, 3), their covariances (P, 6, 6) for corners of 1 px, and costs (P,)."""
    state, cost = poses_under(camera, Views(board_points=board_points, pixels=pixels), _POSES)
    spreads = []
    for rotation, translation, seen in zip(state.rotation, state.translation, pixels.isfinite().all(-1), strict=True):
        turned = board_points[seen] @ rotation.T
        found = project_components((turned + translation).T, camera.params.detach(), camera.model, ())
        rows = step_rows(found.by_point, turned.T).flatten(1)
        spreads.append(torch.linalg.inv(rows @ rows.T))
    return (state.rotation, state.translation), torch.stack(spreads), cost


# The verdict on a rig: its ranges from the covariance of everything together, and whether its pairs agree.

# Pairs disagree by this many times what noise explains: set on simulated pairs, where synchronous ones reach 1.5.
_APART = 2.5
_LATE_SIGMAS, _LATE = 5.0, 0.02
_MOST_LEFT_OUT = 0.2
_LOOK = {False: "both cameras look", True: "two cameras or more look"}
# Residuals of a whole rig in their sigmas: more, and something does not fit.
_MOST_VARIANCE = 9.0
_MEASURE_AGAIN = "measure again what contradicts, correct it or its sigma, and solve the rig again"


@in_one_thread
def rig_verdict(
    rig: Rig,
    requirements: Sequence[Requirement] = (),
    *,
    mark_sigma: float | None = None,
    result: RigResult | None = None,
    pairs: tuple[Tensor, Tensor] | None = None,
    unpaired: str = "",
    cameras: Sequence[Verdict] = (),
    subject: str = "rig",
) -> Verdict:
    """Judge a rig against a user's own requirements.

    It inherits what was found about its cameras and their boards. What a camera is wrong by beyond its error bars
    counts in the ranges.

    Args:
        rig: with its covariance; of two cameras, or of any number with its `root`: then ranges are those from each
            camera to objects that another one sees, where they are worst.
        requirements: ranges, and how well they must be known.
        mark_sigma: noise of a mark along each axis, px; if left out, as in `Localizer`.
        result: as it was solved, for its warnings and its pairs of boards.
        pairs: otherwise, corners of the board (N, 3) in meters, and pixels (P, 2, N, 2) of pairs of views.
        unpaired: why there are no pairs, where there should be.
        cameras: verdicts on its cameras, whose findings count; what the rig's file tells of them if left
            out.
        subject: its name.

    Example:
        >>> import torch
        >>> from kcal.rig import RigCovariance, planned_rig
        >>> rig = planned_rig()
        >>> rig.covariance = RigCovariance.of(rig, pose=torch.diag(torch.tensor([0, 1e-8, 0, 0, 0, 0]).double()))
        >>> verdict = rig_verdict(rig, Requirement.parse("1km:5%, 5km:5%"), mark_sigma=0.1)
        >>> [answer.ok for answer in verdict.answers], verdict.reason
        ([True, False], 'at 5 km the range is known to ±6.8 %; 5 % are required; most of it is from relative pose')
    """
    mark_sigma, _ = noise_of_marks(mark_sigma, rig.calibration)
    findings = [*_inherited(rig, cameras), *_own_findings(rig, result)]
    if rig.is_pair:
        compared = _pairs_compared(rig, result, pairs)
        if compared is not None and compared.pairs:
            findings.append(_synchrony_finding(compared))
        elif unpaired or (result is None and rig.calibration is not None and rig.calibration.pairs):
            why = unpaired or "no pairs of views were given"
            text = f"whether both cameras saw the board at the same moments could not be checked: {why}"
            action = "give the observations of the pairs (--observations LEFT RIGHT)"
            findings.append(Finding("synchronization", "doubt", text, action))
    beyond = [verdict.unexplained for verdict in cameras]
    worst_of = _worst_of_pair if rig.is_pair else station_sigmas
    worst = [worst_of(rig, requirement.distance, pixel_sigma=mark_sigma) for requirement in requirements]
    both = list(zip(requirements, worst, strict=True))
    findings += [_unseen_finding(requirement.distance) for requirement, one in both if one is None]
    answers = tuple(_rig_answer(requirement, one, rig.known, mark_sigma, beyond) for requirement, one in both)
    return Verdict(
        subject=subject,
        answers=answers,
        findings=weighed_findings(findings, answers),
        advice=tuple(f"{verdict.subject}: {text}" for verdict in cameras for text in verdict.advice),
        basis=f"from the rig's own covariance, where {_LOOK[not rig.is_pair]}, with marks to {mark_sigma:g} px",
        unexplained=max(beyond, default=0.0),
    )


def named_cameras(rig: Rig) -> list[tuple[str, Camera]]:
    """The cameras of a rig with their names."""
    return list(zip(rig.names, rig.each, strict=True))


def _inherited(rig: Rig, cameras: Sequence[Verdict]) -> list[Finding]:
    """Findings about the cameras, with their names; a finding that several cameras share is listed once."""
    told = [(verdict.subject, verdict.findings) for verdict in cameras]
    found: dict[Finding, list[str]] = {}
    for name, findings in told or [(word, (*stored_findings(camera),)) for word, camera in named_cameras(rig)]:
        for finding in findings:
            found.setdefault(finding, []).append(name)
    return [dataclasses.replace(one, cameras=tuple(names)) for one, names in found.items() if one.severity != "fine"]


def _rig_answer(
    requirement: Requirement, worst: RangeSigmas | None, known: bool, mark_sigma: float, beyond: Sequence[float]
) -> RangeAnswer:
    """How well a range is known where that is worst.

    Args:
        requirement: a range, and how well it must be known.
        worst: of several places that two cameras see; None where there is none.
        known: whether anything is known of the errors of lenses and pose.
        mark_sigma: noise of a mark along each axis, px.
        beyond: px by which each camera is wrong beyond its error bars.
    """
    if worst is None:
        return RangeAnswer(requirement=requirement, parts={"marks": math.inf, "lenses": 0.0, "relative pose": 0.0})
    lenses, pose = (float(worst.lenses), float(worst.pose)) if known else (math.inf, math.inf)
    parts = {"marks": float(worst.marks), "lenses": lenses, "relative pose": pose}
    if any(beyond):
        # Each camera's errors spoil a range as the noise of its marks does.
        parts[FAULTS] = float(worst.marks) / mark_sigma * math.hypot(*beyond) / math.sqrt(len(beyond))
    return RangeAnswer(requirement=requirement, parts=parts)


def _worst_of_pair(rig: Rig, distance: float, *, pixel_sigma: float) -> RangeSigmas:
    """The worst of several places along the middle row of the left image that both cameras see."""
    width, height = rig.left.size
    worst: RangeSigmas | None = None
    places = [None, *([0.5 * width + share * width, 0.5 * height] for share in (-0.3, 0.3))]
    for place in places:
        try:
            found = range_sigmas(rig, [distance], pixel_sigma=pixel_sigma, pixel=place)
        except InputError:
            if place is None:
                raise
            continue
        # What is not known is worse than anything.
        if worst is None or not (math.isnan(worst.total) or float(found.total) <= float(worst.total)):
            worst = found
    assert worst is not None
    return worst


def _own_findings(rig: Rig, result: RigResult | None) -> list[Finding]:
    """What the rig's own solution says, and what could not be checked."""
    found = []
    if not rig.known:
        text = "the rig has no error bars: nobody can say how wrong its ranges are"
        found.append(Finding("error-bars", "stop", text, "solve it with kcal rig from cameras that kcal calibrated"))
    record = rig.calibration
    if record is not None:
        out = sum(source.left_out for source in record.sources)
        share = out / max(out + sum(source.used for source in record.sources), 1)
        if share > _MOST_LEFT_OUT:
            text = (
                f"{100 * share:.0f} % of what was seen contradicts the rest and was left out: with so much "
                "of it nobody can tell which part is right"
            )
            action = "check that both images of each pair were taken at the same moment, and the survey"
            found.append(Finding("left-out", "stop", text, action))
    if exact := _exact_lenses(rig, result):
        text = f"the lenses of {' and '.join(exact)} were taken as exact: their errors are in no error bar"
        action = "solve the rig from cameras with error bars, with --intrinsics prior"
        found.append(Finding("exact-lenses", "doubt", text, action))
    solved = record if result is None else result
    known = [source.sigmas**2 for source in (solved.sources if solved else ()) if source.sigmas is not None]
    variance = max([1.0 if result is None else result.variance, *known])
    if variance > _MOST_VARIANCE:
        text = (
            f"residuals are {math.sqrt(variance):.1f} times as large as their sigmas say: cameras, "
            "survey and marks do not fit each other"
        )
        found.append(Finding("misfit", "stop", text, "look at the residuals by item, and correct what stands out"))
    if solved is None:
        text = "the rig's file does not tell how it was solved: residuals and what was left out could not be checked"
        found.append(Finding("record", "doubt", text))
    for one in solved.findings if solved is not None else ():
        # It is more than a warning that was printed.
        found.append(dataclasses.replace(one, action=_MEASURE_AGAIN) if one.severity == "stop" else one)
    return found


def _exact_lenses(rig: Rig, result: RigResult | None) -> tuple[str, ...]:
    """Names of the cameras whose parameters have no error in the rig's covariance."""
    if result is not None:
        return result.exact
    if rig.root is None or not rig.known:
        return ()
    parts = rig.root[:, : sum(rig.sizes)].split(rig.sizes, 1)
    return tuple(name for name, part in zip(rig.names, parts, strict=True) if not bool(part.any()))


def _pairs_compared(rig: Rig, result: RigResult | None, pairs: tuple[Tensor, Tensor] | None) -> Synchrony | None:
    if pairs is not None:
        return synchrony(rig, *pairs)
    boards = None if result is None else result.data.boards
    if result is None or boards is None or boards.pixels.shape[1] != 2:
        return None
    # Turned boards are in the data as they were turned; pairs that were left out count too.
    order = torch.tensor(sorted(range(len(boards.names)), key=lambda i: boards.names[i]), dtype=torch.long)
    return synchrony(rig, boards.points, boards.pixels[order])


def _unseen_finding(distance: float) -> Finding:
    text = (
        f"at {range_text(distance)} from a camera, along the middle rows of the images, no two cameras see one "
        "object: no range can be told"
    )
    action = "turn the cameras so that their views overlap, or add one (kcal sites says where)"
    return Finding("view", "stop", text, action)


def _synchrony_finding(found: Synchrony) -> Finding:
    delay, how = found.delay or 0.0, ""
    sigma = math.inf if found.delay_sigma is None else found.delay_sigma
    if abs(delay) > max(_LATE_SIGMAS * sigma, _LATE):
        which = "after" if delay > 0 else "before"
        how = f"; the right camera took its pictures {abs(delay):.2f} ± {sigma:.2f} steps {which} the left one"
    elif found.ratio <= _APART:
        text = (
            f"both cameras saw the board in the same place in {found.pairs} pairs "
            f"({found.ratio:.1f} times what noise explains)"
        )
        return Finding("synchronization", "fine", text)
    text = (
        f"the board moved between both exposures, or a camera did: it is {1e3 * found.shift:.2g} mm elsewhere for "
        f"the right camera, {found.ratio:.1f} times what noise explains{how}"
    )
    action = "trigger both cameras together, or hold the board still in each pose (a tripod), and take pairs again"
    return Finding("synchronization", "stop" if found.ratio > _APART else "doubt", text, action)


# A check anyone can understand: do the squares of the board come out as large as they are?


class Sides(NamedTuple):
    """Triangulated distances between neighboring corners, meters: their mean and standard deviation."""

    mean: float
    spread: float


def triangulated_sides(rig: Rig, columns: int, rows: int, pixels: Tensor, points: Tensor | None = None) -> Sides:
    """Triangulate every corner of boards seen by both cameras and measure the sides of the squares.

    Args:
        rig: the rig to check.
        columns: inner corners in a row.
        rows: inner corners in a column.
        pixels: (P, 2, columns * rows, 2) corners of P pairs, left and right, row by row; NaN where not seen.
        points: (columns * rows, 3) of a board whose sides differ, such as an AprilGrid: each side then counts as that
            of its first two points, if it has the right length. All sides are alike if not given.

    Returns:
        Mean and standard deviation over all sides whose two corners were seen by both cameras.

    Raises:
        InputError: a shape that does not fit.
        DegenerateError: no side could be triangulated.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
        >>> corners = torch.tensor([[0, 0, 5], [0.1, 0, 5], [0, 0.1, 5], [0.1, 0.1, 5]], dtype=torch.float64)
        >>> left, right = rig(corners)[0].unbind(-2)
        >>> round(triangulated_sides(rig, 2, 2, torch.stack([left, right])[None]).mean, 9)
        0.1
    """
    pixels = as_points("pixels", pixels, 2)
    if pixels.ndim != 4 or pixels.shape[1:3] != (2, columns * rows):
        raise InputError(f"pixels: shape (P, 2, {columns * rows}, 2) is needed, got {tuple(pixels.shape)}")
    known = None if points is None else as_points("points", points, 3)
    if known is not None and known.shape != (columns * rows, 3):
        raise InputError(f"points: shape ({columns * rows}, 3) is needed, got {tuple(known.shape)}")
    found = fit_pairs(rig, pixels[:, 0], pixels[:, 1])
    ahead = found.fitted & (found.fit.inverse > 0)
    points = torch.where(ahead[..., None], found.points(ahead), torch.nan)
    sides = _grid_sides(points, columns, rows)
    if known is not None:
        ordered = _grid_sides(known[None], columns, rows)
        sides = sides / ordered * ordered[:, :1]
    sides = sides[torch.isfinite(sides)]
    if len(sides) < 2:
        raise DegenerateError("no side of a square could be triangulated")
    return Sides(float(sides.mean()), float(sides.std()))


def _grid_sides(points: Tensor, columns: int, rows: int) -> Tensor:
    """Distances (P, S) of neighbors along rows, then along columns, of points (P, rows * columns, 3)."""
    grid = points.unflatten(1, (rows, columns))
    steps = [(grid[:, :, 1:] - grid[:, :, :-1]).flatten(1, 2), (grid[:, 1:] - grid[:, :-1]).flatten(1, 2)]
    return torch.linalg.vector_norm(torch.cat(steps, 1), dim=-1)
