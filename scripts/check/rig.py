"""Rigs solved from a survey, repeated by simulation: coverage, the price of calibration, wrong landmarks, drift.

Everything is drawn anew in each repetition: where landmarks and features stand, the survey's errors, the marks' noise.
*misstated*: twelve surveyed landmarks are marked with some times the error that is stated; 300 matches of unknown range
and a tape of ± 5 mm are as stated. In the last rows the tape is wrong instead, which must be named whatever the marks
are. Seeds are fixed; nothing here depends on the machine.

Rigs with errors that no model of theirs contains, repeated by simulation: found, and coverage before and after.

Errors are planted that neighbors share: a smooth field of the lens, a bias of matches by place, boards that bend. Each
rig is judged_kind without and with the widening of `kcal.calibrate.rig.contradictions`. Seeds are fixed.

Refraction of light: heights at 5 km when the coefficient is not what was assumed, with and without far landmarks.

Truth: light bends with a coefficient of 0.13 + 0.2, 0.13 - 0.2, or one drawn from 0.13 ± 0.1. A rig of known lenses
(scripts/shared/long_range.py) is solved from 12 landmarks, surveyed to 2 cm and marked to 0.07 px: near (40 to 400 m),
or so that half of them stand 4 to 5 km away. Targets stand 5 km away all over the image. Their height is found with the
rig's own coefficient.

Error without noise: neither survey nor marks have any, so that only the coefficient is wrong.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple
from unittest import mock

import torch
from torch import Tensor

from kcal import (
    Baseline,
    Board,
    Camera,
    Features,
    InputError,
    Landmarks,
    Localizer,
    MeasuredPosition,
    Rig,
    RigData,
    RigOptions,
    solve_rig,
)
from kcal.calibrate.rig import assess
from kcal.calibrate.rig.contradictions import widen_for_fields
from kcal.calibrate.rig.problem import RigSolution
from kcal.calibrate.rig.result import RigResult
from kcal.finding import Finding
from kcal.lens import rotation_from_vector, vector_from_rotation
from kcal.lens.rig import REFRACTION, REFRACTION_SIGMA
from kcal.locate import enu_from_cam
from kcal.locate.geodesy import mean_radius
from kcal.report import rig_figure, save_picture
from kcal.rig import RigCovariance, paired_boards, placed_rig
from kcal.watch.turned import Drift, drift_of_turns, measure_drift
from scripts.shared.captures import as_observations
from scripts.shared.long_range import ORIGIN, RANGES, landmarks_of, matches_of, rig, with_noise
from scripts.shared.page import DOCS, Lines, rms, section, share, table

HEADING = 35.0
MARK, SURVEY = 0.1, 0.02
TRUTH = rig()
LOOK = enu_from_cam(HEADING).T
ROTATION = torch.stack([LOOK, TRUTH.right_from_left_rotation @ LOOK])
CENTER = torch.stack([torch.zeros(3).double(), -TRUTH.right_from_left_translation @ ROTATION[1]])
BASELINE, TAPE = float(TRUTH.baseline), 0.005
NAMES = ("left", "right")
# The simulated light goes straight.
STRAIGHT = RigOptions(refraction=0.0, refraction_sigma=0.0)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def seen(points: Tensor, turns: Tensor | None = None) -> Tensor:
    """(N, 2, 2) exact pixels of ENU points; cameras turned by rotation vectors (2, 3) if given."""
    sides = []
    for c, camera in enumerate((TRUTH.left, TRUTH.right)):
        rotation = ROTATION[c] if turns is None else rotation_from_vector(turns[c]) @ ROTATION[c]
        sides.append(camera.project((points - CENTER[c]) @ rotation.T)[0])
    return torch.stack(sides, 1)


def spread(count: int, near: float, far: float, draw: torch.Generator) -> Tensor:
    """ENU points in the common view, log-uniform in range."""
    uniform = torch.rand(count, 3, dtype=torch.float64, generator=draw)
    distance = near * (far / near) ** uniform[:, :1]
    across, up = 0.9 * (uniform[:, 1:2] - 0.5), 0.4 * (uniform[:, 2:] - 0.5)
    return distance * torch.cat([across, -up, torch.ones_like(across)], -1) @ LOOK


def normal(shape: tuple[int, ...], draw: torch.Generator) -> Tensor:
    return torch.randn(shape, dtype=torch.float64, generator=draw)


def landmarks(draw: torch.Generator, count: int = 12) -> Landmarks:
    points = spread(count, 100.0, 2600.0, draw)
    return with_noise(landmarks_of(points, seen(points), SURVEY, MARK), draw)


def summits(draw: torch.Generator, count: int = 20) -> Features:
    points = spread(count, 8000.0, 40_000.0, draw)
    inverse = 1.0 / torch.linalg.vector_norm(points - CENTER.mean(0), dim=-1)
    sigma = 0.1 * inverse
    return Features(
        names=tuple(f"summit {i}" for i in range(1, count + 1)),
        pixels=seen(points) + MARK * normal((count, 2, 2), draw),
        inverse_range=inverse + sigma * normal((count,), draw),
        inverse_range_sigma=sigma,
        pixel_sigma=MARK,
    )


def tape(draw: torch.Generator, times: float = 1.0) -> Baseline:
    """The baseline, measured by a tape that is right, or wrong by a factor."""
    length = BASELINE * times + TAPE * float(normal((1,), draw))
    return Baseline(first=0, second=1, length=length, sigma=TAPE)


def data(kind: str, draw: torch.Generator) -> RigData:
    """A survey with more or less besides."""
    marks = landmarks(draw)
    baselines: tuple[Baseline, ...] = ()
    positions: tuple[MeasuredPosition, ...] = ()
    features = None
    if "baseline" in kind:
        baselines = (tape(draw),)
    if "positions" in kind:
        sigma = torch.tensor([0.02, 0.02, 0.04], dtype=torch.float64)
        positions = tuple(
            MeasuredPosition(camera=c, point=CENTER[c] + sigma * normal((3,), draw), sigma=sigma) for c in (0, 1)
        )
    if "summits" in kind:
        features = summits(draw)
    return RigData(
        cameras=(TRUTH.left, TRUTH.right),
        names=NAMES,
        landmarks=marks,
        features=features,
        baselines=baselines,
        positions=positions,
    )


def yaw_error(found: RigResult) -> float:
    """Degrees by which the relative yaw is wrong."""
    relative = found.rotation[1] @ found.rotation[0].T @ TRUTH.right_from_left_rotation.T
    return math.degrees(float(vector_from_rotation(relative)[1]))


@section("rig.md", "coverage", draws=2)
@torch.no_grad()
def coverage(draws: int = 100, marks: int = 50) -> Lines:
    """Rigs solved anew, and targets marked with them."""
    angles = torch.tensor([-0.3 + 0.1 * i for i in range(len(RANGES))], dtype=torch.float64)
    far = torch.tensor(RANGES, dtype=torch.float64)
    ahead = torch.stack([angles.sin(), 0.02 * torch.arange(len(RANGES)) - 0.06, angles.cos()], -1)
    targets = far[:, None] * ahead / torch.linalg.vector_norm(ahead, dim=-1, keepdim=True) @ LOOK
    exact = seen(targets)
    best = Localizer(TRUTH.placed(origin=ORIGIN, heading_deg=HEADING), pixel_sigma=MARK)(exact[:, 0], exact[:, 1])
    bound = best.inverse_range_sigma
    yield [
        f"from {len(landmarks(generator(0)).names)} landmarks and", "σ of yaw", "its error / σ",
        *(f"{distance:g} m" for distance in RANGES),
    ]  # fmt: skip
    for kind in (
        "nothing else",
        "a baseline ± 5 mm",
        "positions ± 2 cm",
        "baseline and positions",
        "20 summits ± 10 %",
    ):
        inside, squares, yaws, sigmas = [], [], [], []
        for seed in range(draws):
            draw = generator(10_000 + seed)
            found = solve_rig(data(kind.replace("20 summits", "summits"), draw), STRAIGHT)
            pair = found.stereo()
            pair.covariance = RigCovariance.of(pair, joint=found.joint_covariance())
            localize = Localizer(pair.placed(origin=ORIGIN, heading_deg=HEADING), pixel_sigma=MARK)
            noisy = exact + MARK * normal((marks, *exact.shape), draw)
            answer = localize(noisy[..., 0, :], noisy[..., 1, :])
            inside.append(((answer.range_low <= far) & (far <= answer.range_high)).double().mean(0))
            squares.append((answer.inverse_range - 1.0 / far).square().mean(0))
            yaws.append(yaw_error(found))
            sigmas.append(math.degrees(float(found.relative_covariance()[1, 1].sqrt())))
        ratio = torch.stack(squares).mean(0).sqrt() / bound
        scatter = rms([y / s for y, s in zip(yaws, sigmas, strict=True)])
        cells = [
            f"{share(each, ' %')}; {float(price):.2f}"
            for each, price in zip(torch.stack(inside).T.tolist(), ratio, strict=True)
        ]
        yield [kind, f"{sum(sigmas) / draws:.5f}°", f"{scatter:.2f}", *cells]


@section("rig.md", "wrong landmark", draws=1)
@torch.no_grad()
def wrong(draws: int = 50) -> Lines:
    """One landmark of twelve is wrong."""
    yield [
        "wrong by", "named and left out", "good ones left out, a rig", "RMS error of yaw, all kept",
        "wrong one left out", "never wrong",
    ]  # fmt: skip
    for kind, size in (("mark", 0.5), ("mark", 1.0), ("mark", 2.0), ("mark", 5.0), ("height", 1.0), ("height", 5.0)):
        named, false = 0, 0
        errors: list[list[float]] = [[], [], []]
        for seed in range(draws):
            good = data("nothing else", generator(50_000 + seed))
            bad = data("nothing else", generator(50_000 + seed))
            assert bad.landmarks is not None
            which = seed % len(bad.landmarks.names)
            if kind == "mark":
                bad.landmarks.pixels[which, 1] += size * torch.tensor([math.cos(seed), math.sin(seed)]).double()
            else:
                bad.landmarks.points[which, 2] += size
            found = solve_rig(bad, STRAIGHT)
            out = {item.name for item in found.left_out}
            named += bad.landmarks.names[which] in out
            false += len(out - {bad.landmarks.names[which]})
            errors[0].append(yaw_error(solve_rig(bad, dataclasses.replace(STRAIGHT, reject=False))))
            errors[1].append(yaw_error(found))
            errors[2].append(yaw_error(solve_rig(good, STRAIGHT)))
        label = f"{size:g} px in one image" if kind == "mark" else f"{size:g} m of height"
        cells = [f"{rms(each):.5f}°" for each in errors]
        yield [label, f"{100 * named / draws:.0f} %", f"{false / draws:.3f}", *cells]


@torch.no_grad()
def found_at_5_km(old: Rig, new: Rig) -> float:
    """The range, in meters, that the old rig finds of a target at 5 km from the new one."""
    still = drift_of_turns(old, torch.zeros(6, dtype=torch.float64), torch.eye(6, dtype=torch.float64))
    return float(dataclasses.replace(still, rig=new).effect((5000.0,)).found[0])


@section("rig.md", "turned", draws=2)
def drift(draws: int = 50) -> Lines:
    """The right camera turns by 0.01°; points that do not move, then and now, or landmarks."""
    yield [
        "seen", "RMS error of the yaw", "mean σ", "within 0.001°", "called significant", "the same without drift",
        "5 km with the old rig", "RMS at 5 km, corrected",
    ]  # fmt: skip
    yaw = math.radians(0.01)
    still = torch.zeros(2, 3, dtype=torch.float64)
    turned = torch.tensor([[0.0, 0.0, 0.0], [0.0, yaw, 0.0]], dtype=torch.float64)
    now = rotation_from_vector(turned[1])
    later = Rig.pair(
        TRUTH.left, TRUTH.right, now @ TRUTH.right_from_left_rotation, now @ TRUTH.right_from_left_translation
    )
    before = found_at_5_km(TRUTH, later) - 5000.0

    def check(count: int, turns: Tensor, seed: int, images: int) -> Drift:
        draw = generator(90_000 + seed)
        if images == 0:
            features = summits(draw, count)
            after = seen(spread(count, 8000.0, 40_000.0, generator(90_000 + seed)), turns)
            after = after + MARK * normal((count, 2, 2), draw)
            unseen = torch.full_like(after, math.nan)
            return measure_drift(TRUTH, features=dataclasses.replace(features, pixels=torch.cat([unseen, after], 1)))
        points = spread(count, 300.0, 8000.0, draw)
        then = seen(points) + MARK / images**0.5 * normal((count, 2, 2), draw)
        after = seen(points, turns) + MARK / images**0.5 * normal((count, 2, 2), draw)
        features = matches_of(torch.cat([then, after], 1), pixel_sigma=MARK / images**0.5)
        return measure_drift(TRUTH, features=features)

    for label, count, images in (
        ("10 features", 10, 1),
        ("40 features", 40, 1),
        ("40 features, 4 images then and now", 40, 4),
        ("160 features", 160, 1),
        ("40 summits 8 to 40 km ± 10 %, now only", 40, 0),
    ):
        errors, sigmas, significant, false, after = [], [], 0, 0, []
        for seed in range(draws):
            found = check(count, turned, seed, images)
            errors.append(math.degrees(float(found.relative[1]) - yaw))
            sigmas.append(math.degrees(float(found.relative_covariance[1, 1].sqrt())))
            significant += found.significant
            after.append(found_at_5_km(found.rig, later) - 5000.0)
            false += check(count, still, seed + draws, images).significant
        within = sum(abs(e) < 0.001 for e in errors) / draws
        yield [
            label, f"{rms(errors):.5f}°", f"{sum(sigmas) / draws:.5f}°", f"{100 * within:.0f} %",
            f"{100 * significant / draws:.0f} %", f"{100 * false / draws:.1f} %", f"{before:+.0f} m",
            f"{rms(after):.0f} m",
        ]  # fmt: skip


@section("rig.md", "picture")
def example(write: bool = False) -> None:
    """A picture of a rig with a wrong landmark and a wrong match."""
    draw = generator(4)
    sources = data("baseline and positions and summits", draw)
    assert sources.landmarks is not None
    assert sources.features is not None
    sources.landmarks.points[4, 2] += 2.0
    sources.features.pixels[7, 1, 1] += 2.0
    if write:
        save_picture(DOCS / "rig.png", rig_figure(solve_rig(sources, STRAIGHT)))


MATCHES = 300


def misstated_data(times: float, length: float, seed: int) -> RigData:
    """The sources of one rig: marks worse by a factor, a tape that is wrong by another."""
    draw = generator(seed)
    marked = landmarks(draw)
    points = spread(MATCHES, 300.0, 8000.0, draw)
    matches = matches_of(seen(points) + MARK * normal((MATCHES, 2, 2), draw), pixel_sigma=MARK)
    measured = tape(draw, length)
    worse = marked.pixels + math.sqrt(times**2 - 1.0) * MARK * normal((len(marked.names), 2, 2), draw)
    return RigData(
        cameras=(TRUTH.left, TRUTH.right),
        names=NAMES,
        landmarks=dataclasses.replace(marked, pixels=worse),
        features=matches,
        baselines=(measured,),
    )


def errors(found: RigResult) -> torch.Tensor:
    """(3,) errors of the left camera's attitude on the Earth in standard deviations."""
    error = vector_from_rotation(found.rotation[0] @ ROTATION[0].T)
    return error / found._solution.variances(found._solution.turn_rows(0)).sqrt()


@torch.no_grad()
def judged(times: float, tape: float, draws: int) -> list[str]:
    """One row."""
    off, told, refused, blamed = [], [], 0, 0
    for seed in range(draws):
        try:
            found = solve_rig(misstated_data(times, tape, 70_000 + seed), STRAIGHT)
        except InputError as error:
            refused += 1
            blamed += "baseline" in str(error)
            continue
        blamed += any("the baseline" in text and "contradicts" in text for text in found.warnings)
        off.append(errors(found))
        told.append(next(one.sigmas or math.nan for one in found.sources if one.name == "landmarks"))
    what = [f"{times:g}", "right" if tape == 1.0 else f"wrong by {100 * (tape - 1.0):.0f} %"]
    if not off:
        return [*what, str(draws), str(refused), str(blamed), "–", "–", "–"]
    each = torch.stack(off)
    inside = 100 * float((each.abs() < 1.96).double().mean())
    off_by, factor = rms(each), rms(told)
    return [*what, str(draws), str(refused), str(blamed), f"{factor:.2f}", f"{off_by:.2f}", f"{inside:.0f} %"]


@section("rig.md", "misstated", draws=1)
def misstated(draws: int = 40) -> Lines:
    heads = [
        "marks worse than stated, times", "tape", "rigs", "refused", "the tape blamed", "the landmarks' residuals / σ",
        "error of attitude / σ", "inside 95 %",
    ]  # fmt: skip
    cases = [(1.0, 1.0), (2.0, 1.0), (3.0, 1.0), (5.0, 1.0), (1.0, 1.02), (3.0, 1.02), (3.0, 1.1)]
    return table(heads, (judged(times, tape, draws) for times, tape in cases))


FIELD = 0.1
CLOSE = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480))
NEAR = Rig.pair(CLOSE, CLOSE, torch.eye(3), torch.tensor([-0.2, 0.0, 0.0]))


def field(draw: torch.Generator, size: tuple[int, int]) -> Callable[[Tensor], Tensor]:
    """A smooth displacement (N, 2) of pixels (N, 2) with an RMS of `FIELD` px along each axis."""
    waves = (torch.rand(6, 2, generator=draw, dtype=torch.float64) - 0.5) * 4.0 * math.pi
    phase = 2.0 * math.pi * torch.rand(6, 2, generator=draw, dtype=torch.float64)
    extent = torch.tensor(size, dtype=torch.float64)
    return lambda pixels: FIELD * math.sqrt(2.0 / 6.0) * ((pixels / extent @ waves.T)[..., None] + phase).sin().sum(-2)


def radial(draw: torch.Generator, size: tuple[int, int]) -> Callable[[Tensor], Tensor]:
    """The same, as r³ changes it, in or out."""
    middle = torch.tensor(size, dtype=torch.float64) / 2.0
    sign = 1.0 - 2.0 * float(torch.rand((), generator=draw) < 0.5)
    sides = [torch.linspace(-float(side), float(side), 25, dtype=torch.float64) for side in middle]
    cubic = torch.cartesian_prod(*sides)
    scale = sign * FIELD / float((cubic * cubic.square().sum(-1, keepdim=True)).square().mean().sqrt())
    return lambda pixels: scale * (pixels - middle) * (pixels - middle).square().sum(-1, keepdim=True)


def surveyed(kind: str, seed: int) -> RigData:
    """Landmarks, 200 matches of unknown range and a tape."""
    draw = generator(seed)
    marked = landmarks(draw, 30 if "30" in kind else 12)
    points = spread(200, 300.0, 8000.0, draw)
    pixels = seen(points) + MARK * normal((200, 2, 2), draw)
    lenses = [(radial if "radial" in kind else field)(draw, TRUTH.left.size) for _ in NAMES]
    if "lens" in kind:
        pixels, marks = (torch.stack([x[:, c] + lens(x[:, c]) for c, lens in enumerate(lenses)], 1)
                         for x in (pixels, marked.pixels))  # fmt: skip
        marked = dataclasses.replace(marked, pixels=marks)
    if "bias" in kind:
        side = pixels[:, :1, 0] < TRUTH.left.size[0] / 2
        pixels[:, 1] += FIELD * side if "half" in kind else lenses[1](pixels[:, 1])
    matches = matches_of(pixels, pixel_sigma=MARK)
    return RigData(cameras=(TRUTH.left, TRUTH.right), names=NAMES, landmarks=marked,
                   features=None if "30" in kind else matches, baselines=(tape(draw),))  # fmt: skip


def boards(kind: str, seed: int) -> RigData:
    """Fifteen boards that two cameras 0.2 m apart saw."""
    draw, board = generator(seed), Board(columns=9, rows=6, square=0.03)
    middle = board.points.mean(0)
    across = (board.points - middle)[:, :2] / (board.points - middle)[:, :2].abs().max()
    shapes = torch.stack([across[:, 0] ** 2, across[:, 1] ** 2, across.prod(-1)], -1)
    lenses = [field(draw, NEAR.left.size) for _ in NAMES]
    sides: tuple[list[Tensor], list[Tensor]] = ([], [])
    for _ in range(15):
        points = board.points - middle
        points[:, 2] += (0.002 if "flex" in kind else 0.0) * shapes @ normal((3,), draw)
        turn = rotation_from_vector(0.35 * normal((3,), draw))
        place = torch.tensor([0.0, -0.1, 1.0]) + 0.2 * torch.rand(3, generator=draw, dtype=torch.float64)
        pixels = NEAR(points @ turn.T + place)[0]
        for c, views in enumerate(sides):
            own = pixels[:, c] + (lenses[c](pixels[:, c]) if "lens" in kind else 0.0) + MARK * normal((54, 2), draw)
            views.append(own)
    left, right = (as_observations(torch.stack(views), NEAR.left.size, board) for views in sides)
    pairs = paired_boards((NEAR.left, NEAR.right), (left, right), list(zip(left.names, right.names, strict=True)))
    return RigData(cameras=(NEAR.left, NEAR.right), names=NAMES, boards=pairs)


@torch.no_grad()
def judged_kind(kind: str, draws: int) -> list[str]:
    """One row."""
    make, truth = (boards, NEAR) if "boards" in kind else (surveyed, TRUTH)
    before, errors, told, wider = list[Tensor](), list[Tensor](), 0, 0.0

    def kept(solution: RigSolution, names: Sequence[str]) -> list[Finding]:
        before.append(solution.root)
        return widen_for_fields(solution, names)

    for seed in range(draws):
        given = make(kind, 90_000 + seed)
        with mock.patch.object(assess, "widen_for_fields", kept):
            found = solve_rig(given, dataclasses.replace(STRAIGHT, reject=False))
        told += any("disagrees with the rest" in text for text in found.warnings)
        relative = found.rotation[1] @ found.rotation[0].T @ truth.right_from_left_rotation.T
        rows = found._solution.relative_rows(0, 1)[:3]
        ways = torch.stack([(rows @ root).norm(dim=1) for root in (before[-1], found._solution.root)])
        errors.append(vector_from_rotation(relative).abs() / ways)
        wider += float((ways[1, 1] / ways[0, 1]) ** 2) / draws
    each = torch.stack(errors)
    inside, rms = (each < 1.96).double().mean(0), each.square().mean(0).sqrt()
    cells = [kind, str(draws), f"{100 * told / draws:.0f} %", f"{math.sqrt(wider):.2f}"]
    cells += [f"{100 * float(inside[way, axis]):.0f} %" for axis in (1, 0, 2) for way in (0, 1)]
    return [*cells, *(f"{float(one):.2f}" for one in rms[:, 1])]


KINDS = (
    "12 landmarks and 200 matches", "30 landmarks", "15 boards", "12 landmarks and 200 matches, lens",
    "12 landmarks and 200 matches, radial lens", "12 landmarks and 200 matches, bias of matches",
    "12 landmarks and 200 matches, bias of half the matches", "30 landmarks, lens",
    "15 boards, lens", "15 boards, flex",
)  # fmt: skip


@section("rig.md", "contradictions", draws=1, kinds=KINDS[1:2])
def contradictions(draws: int = 50, kinds: tuple[str, ...] = KINDS) -> Lines:
    """The table: found, and coverage without and with what is widened."""
    heads = [
        "rig, and what is planted", "rigs", "told", "σ of yaw, times", "yaw inside 95 %", "widened",
        "pitch inside 95 %", "widened", "roll inside 95 %", "widened", "error of yaw / σ", "widened",
    ]  # fmt: skip
    yield from table(heads, (judged_kind(kind, draws) for kind in kinds))


LANDMARKS, LANDMARK_SURVEY, LANDMARK_MARK = 12, 0.02, 0.07  # landmarks; meters, px
TARGET_RANGE = 5000.0
CLOSE_BY, FAR_OFF = (40.0, 400.0), (4000.0, 5000.0)  # meters
ENU_FROM_CAM = enu_from_cam(35.0)


class Site(NamedTuple):
    """Landmarks (L, 3) and targets (T, 3) in east, north, up, and their pixels (L or T, 2, 2)."""

    landmarks: Tensor
    landmark_marks: Tensor
    targets: Tensor
    target_marks: Tensor


def site(refraction: float, far: bool, generator: torch.Generator) -> Site:
    """Things as they stand, and where both cameras see them in light that bends."""
    world = rig()

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, dtype=torch.float64, generator=generator)

    def seen(enu: Tensor) -> tuple[Tensor, Tensor]:
        lift = 0.5 * refraction / mean_radius(ORIGIN.lat) * enu[:, :2].square().sum(-1)
        above = enu + lift[:, None] * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        pixels, valid = world(above @ ENU_FROM_CAM)
        return pixels, valid.all(-1)

    def places(count: int, low: float, high: float) -> Tensor:
        pixels = 60.0 + uniform(8 * count, 2) * torch.tensor([1800.0, 960.0], dtype=torch.float64)
        points = low * (high / low) ** uniform(8 * count, 1) * world.left.unproject(pixels)[0] @ ENU_FROM_CAM.T
        marks, valid = seen(points)
        good = valid & ((marks > 20) & (marks < torch.tensor([1900.0, 1060.0]).double())).all(-1).all(-1)
        return points[good][:count]

    here = torch.cat([places(LANDMARKS // 2, *CLOSE_BY), places(LANDMARKS // 2, *(FAR_OFF if far else CLOSE_BY))])
    there = places(40, TARGET_RANGE, TARGET_RANGE)
    return Site(here, seen(here)[0], there, seen(there)[0])


def heights(place: Site, generator: torch.Generator, noise: float) -> tuple[Tensor, Tensor, float]:
    """Errors (T,) of the targets' heights, their sigmas (T,), and the coefficient that was found."""
    exact = landmarks_of(place.landmarks, place.landmark_marks, LANDMARK_SURVEY, LANDMARK_MARK)
    noisy = with_noise(exact, generator)
    world = rig()
    data = RigData(cameras=(world.left, world.right), names=("left", "right"), landmarks=noisy if noise else exact)
    solved = solve_rig(data, RigOptions(intrinsics="fixed", refraction_sigma=REFRACTION_SIGMA))
    localize = Localizer(placed_rig(solved, ORIGIN), pixel_sigma=LANDMARK_MARK)
    error = noise * torch.randn(place.target_marks.shape, dtype=torch.float64, generator=generator)
    marks = place.target_marks + LANDMARK_MARK * error
    found = localize(marks[:, 0], marks[:, 1])
    # Across the line of sight, upward: errors of the range are not those of light.
    sight = torch.nn.functional.normalize(place.targets, dim=-1)
    level = torch.nn.functional.normalize(sight[:, :2], dim=-1)
    upward = torch.cat([-sight[:, 2:] * level, (sight[:, :2] * level).sum(-1, keepdim=True)], -1)
    ratio = place.targets.norm(dim=-1) / found.enu.norm(dim=-1)
    error = ((found.enu * ratio[:, None] - place.targets) * upward).sum(-1)
    spread = torch.einsum("ni,nij,nj->n", upward, found.covariance, upward).sqrt() * ratio
    return error, spread, solved.refraction


def rows(draws: int) -> Iterator[list[str]]:
    """One row for each truth and place of the landmarks."""
    truths = {"0.33": 0.33, "-0.07": -0.07, "0.13 ± 0.1": None}
    for (name, truth), far in itertools.product(truths.items(), (False, True)):
        bias, errors, inside, found = [], [], [], []
        for draw in range(draws):
            generator = torch.Generator().manual_seed(7000 + draw)
            own = torch.randn((), dtype=torch.float64, generator=generator)
            k = REFRACTION + REFRACTION_SIGMA * float(own) if truth is None else truth
            place = site(k, far, generator)
            error, _, _ = heights(place, generator, 0.0)
            bias.append(error.square().mean())
            error, sigma, estimate = heights(place, generator, 1.0)
            errors.append(error.square().mean())
            inside.append((error.abs() <= 1.96 * sigma).double().mean())
            found.append(estimate - k)
        rms, noisy, share = (torch.stack(values).mean() for values in (bias, errors, inside))
        off = torch.tensor(found).square().mean().sqrt()
        yield [
            name, "half at 4 to 5 km" if far else "at 40 to 400 m", f"± {float(off):.3f}",
            f"{float(rms.sqrt()):.3f}", f"{float(noisy.sqrt()):.3f}", f"{100 * float(share):.1f}",
        ]  # fmt: skip


@section("rig.md", "refraction", draws=1)
def refraction(draws: int = 40) -> Iterator[str]:
    heads = ["true coefficient", "landmarks", "found", "height error at 5 km without noise, m"]
    return table([*heads, "with noise, m", "inside the 95 % interval, %"], rows(draws))
