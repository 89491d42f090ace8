"""Does the verdict say yes only to captures that deserve it? Captures with one planted fault each, and clean ones.

Seeds below 200 were for setting the thresholds.

Does `kcal check` judge right? Its verdict on calibrations whose truth is known.

Captures are those of `scripts.check.captures_that_move`: three traced lenses in turn, printed boards, noise of
0.08 px; 5, 8, 12 and 20 views in turn, every other one by hand. Each is calibrated with the default lens, whose
intervals should be true, and with opencv5, which describes neither lens nor board, so that they should not. A second
capture of the same lens and board, with as many views, is what `--against` gets. Truth: the share of the image in which
the true lens lies in the stated 95 % ellipses, at infinity after the best-fit rotation. Intervals count as true where
it is more than half: places of one calibration go together, so that true intervals have all of the image inside or,
seldom, little of it.

Is it said that pixels are not square, where they are and where they are not?

`--stretch 1.01`: rows longer or shorter by 1 %, in turn; 1 shows false alarms. Truth: traced lenses in turn and printed
boards, as in `scripts.check.captures_that_move`; 8 to 20 views, 0.05 to 0.2 px of noise; boards upright (within 2
degrees) in half of the captures, turned by up to 90 degrees in the others; a quarter of the captures by hand. A camera
is said to have pixels that are not square if a warning of its calibration contains "pixels are not square".
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import random
import statistics
import time
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from kcal import Board, CalibrationOptions, Camera, KcalError, Observations, RigData, calibrate_camera, solve_rig
from kcal.calibrate import examine
from kcal.calibrate.camera.trust import against_capture, interval_check, simulated_capture, simulated_refits
from kcal.lens import rotation_from_vector
from kcal.lens.pose import Pose, rotation_between
from kcal.lens.uncertainty import image_sigma, pixel_covariance, pixel_errors
from kcal.report import camera_verdict, rig_verdict
from kcal.report.judge_camera import fault_of_views
from kcal.report.verdict import Requirement, Verdict
from kcal.rig import pair_by_name, paired_boards
from kcal.sim.captures import PoseOptions, TrueRig, drawn_lens, drawn_rig, sample_board_poses
from kcal.sim.truth import TruthLens
from scripts.shared.captures import PRESCRIPTIONS, as_observations, error_at_infinity, printed, sample_pair_poses
from scripts.shared.page import NOT_KEPT, Kept, Lines, Record, section, table, timed
from scripts.shared.simulated import figures, simulated

FAULTS = ("model", "fronto-parallel", "warp", "blur", "unsynchronized", "pupil", "mirrored or mixed")
BOARD = Board(columns=9, rows=6, square=0.04)
_ROLLS = PoseOptions(max_roll=math.radians(90.0))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Planted:
    """A capture of one camera.

    Args:
        lens: the truth.
        observations: what kcal gets.
        options: as a user would give them.
        detail: what was planted.
    """

    lens: TruthLens
    observations: Observations
    options: CalibrationOptions
    detail: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlantedPair:
    """Captures of two cameras, each alone and of both together."""

    rig: TrueRig
    alone: tuple[Observations, Observations]
    pairs: tuple[Observations, Observations]
    detail: str


def observed(pixels: Tensor, size: tuple[int, int], spread: Tensor | None = None, board: Board = BOARD) -> Observations:
    """Corners (V, N, 2) as observations; `spread` (V,) is the stated noise of each view's corners, px."""
    eye = torch.eye(2, dtype=torch.float64)
    stated = None if spread is None else (spread.square()[:, None, None, None] * eye).expand(*pixels.shape, 2)
    return as_observations(pixels, size, board, covariance=stated)


def corners_of(lens: TruthLens, points: Tensor, poses: Sequence[tuple[Tensor, Tensor]], noise: Tensor) -> Tensor:
    """(V, N, 2) corners of a board whose corners truly are at `points`, with noise (V, N, 2); NaN outside the image."""
    seen = []
    for rotation, translation in poses:
        pixels, valid = lens.project(points @ rotation.T + translation)
        seen.append(torch.where(valid[:, None], pixels, torch.nan))
    noisy = torch.stack(seen) + noise
    return torch.where(lens.inside(noisy)[..., None], noisy, torch.nan)


def drawn(kind: str, seed: int) -> Planted | PlantedPair:
    """The capture of a seed: "clean", "clean pair", or one of the faults."""
    draw = random.Random(f"{kind} {seed}")
    generator = torch.Generator().manual_seed(seed)
    if kind in ("unsynchronized", "clean pair"):
        return _pair(kind, draw, seed, generator)
    views, sigma = draw.randint(18, 28), draw.uniform(0.05, 0.2)
    points, options = BOARD.points, CalibrationOptions()
    design, strength, wander, fill, tilt = "machine-vision", draw.uniform(0.5, 1.5), 0.3, (0.25, 0.8), 0.0
    detail = ""
    if kind == "clean":
        choice = draw.choice(["hybrid", "hybrid", "exact", "opencv8"])
        design = draw.choice(["machine-vision", "surveillance"]) if choice == "hybrid" else design
        if choice == "hybrid":
            points, wander = printed(points, seed), draw.uniform(0.1, 1.0)
        options = {"hybrid": options, "exact": CalibrationOptions(board="exact")}.get(
            choice, CalibrationOptions(model="opencv14")
        )
        wander = 0.0 if choice == "opencv8" else wander
        detail = f"{choice}, {design}"
    elif kind == "model":
        design = "webcam"
        options = CalibrationOptions(model=draw.choice(["opencv4", "opencv5"]))
        strength, wander, detail = draw.uniform(1.0, 3.0), 0.1, f"{design}, {options.model}"
    elif kind == "fronto-parallel":
        tilt = draw.uniform(0.5, 4.0)
        options = CalibrationOptions(model=draw.choice(["hybrid", "opencv5"]))
        detail = f"{tilt:.1f}°, {options.model}"
    elif kind == "warp":
        bend = draw.choice([-1.0, 1.0]) * draw.uniform(1.0, 4.0)
        points, about = _bent(points, 1e-3 * bend, draw.uniform(0.0, math.pi)), draw.choice(["exact", "opencv8"])
        options = CalibrationOptions(board="exact") if about == "exact" else CalibrationOptions(model="opencv8")
        detail = f"{bend:.1f} mm, {about}"
    elif kind == "pupil":
        design, wander, fill = "surveillance", 1.0, (0.4, 1.0)
        options = CalibrationOptions(model=draw.choice(["opencv8", "opencv14"]))
        detail = f"{options.model}"
    lens = drawn_lens(PRESCRIPTIONS[design], strength, seed, wander=wander)
    if kind == "pupil":
        # Lenses of large cameras: the pupil moves by millimeters, and the board is near.
        lens = drawn_lens(PRESCRIPTIONS[design], strength, seed, wander=wander, focal_mm=draw.uniform(4.0, 12.0))
    held = sample_board_poses(lens, BOARD, views, generator, fill=fill, options=_ROLLS)
    if kind == "fronto-parallel":
        held = [_parallel(pose, math.radians(tilt), generator) for pose in held]
    order = torch.randperm(views, generator=generator).tolist()
    held = [held[i] for i in order]
    noise = torch.randn(views, len(points), 2, dtype=torch.float64, generator=generator)
    spread = torch.full((views,), sigma, dtype=torch.float64)
    if kind == "blur":
        spread = torch.tensor([draw.uniform(0.8, 2.0) if draw.random() < 0.8 else sigma for _ in range(views)]).double()
        detail = f"σ {float(spread.median()):.2f} px"
    pixels = corners_of(lens, points, held, noise * spread[:, None, None])
    if kind == "mirrored or mixed":
        how = draw.choice(["mirrored", "some mirrored", "two boards"])
        detail = how
        grid = pixels.unflatten(1, (BOARD.rows, BOARD.columns))
        if how == "mirrored":
            grid = grid.flip(2)
        elif how == "some mirrored":
            some = torch.rand(views, generator=generator) < draw.uniform(0.2, 0.5)
            grid = torch.where(some[:, None, None, None], grid.flip(2), grid)
        else:
            stretch = draw.choice([-1.0, 1.0]) * draw.uniform(0.01, 0.03)
            other = points * torch.tensor([1.0 + stretch, 1.0, 1.0], dtype=torch.float64)
            some = torch.rand(views, generator=generator) < draw.uniform(0.3, 0.7)
            again = corners_of(lens, other, held, noise * spread[:, None, None])
            grid = torch.where(some[:, None, None], again, pixels).unflatten(1, (BOARD.rows, BOARD.columns))
            detail = f"two boards, {100 * stretch:.1f} %"
        pixels = grid.flatten(1, 2)
    stated = spread if kind == "blur" or draw.random() < 0.5 else None
    return Planted(lens=lens, observations=observed(pixels, lens.size, stated), options=options, detail=detail)


def _parallel(pose: Pose, tilt: float, generator: torch.Generator) -> Pose:
    """The board at its place, parallel to the image up to a tilt, rolled at random."""
    turn, towards = (math.pi * (2.0 * torch.rand(2, dtype=torch.float64, generator=generator) - 1.0)).tolist()
    axis = torch.tensor([tilt * math.cos(towards), tilt * math.sin(towards), 0.0], dtype=torch.float64)
    roll = torch.tensor([0.0, 0.0, 0.5 * turn], dtype=torch.float64)
    rotation = rotation_from_vector(axis) @ rotation_from_vector(roll)
    middle = BOARD.points.mean(0)
    return Pose(rotation, pose.rotation @ middle + pose.translation - rotation @ middle)


def _bent(points: Tensor, height: float, angle: float) -> Tensor:
    """The board bent to a cylinder whose middle is higher by `height` meters."""
    middle = points.mean(0)
    half = float((points - middle).norm(dim=-1).max())
    across = ((points - middle)[:, 0] * math.cos(angle) + (points - middle)[:, 1] * math.sin(angle)) / half
    return torch.cat([points[:, :2], height * (1.0 - across**2)[:, None]], 1)


def _pair(kind: str, draw: random.Random, seed: int, generator: torch.Generator) -> PlantedPair:
    """Both cameras calibrated alone; then pairs of a larger board, with or without motion between both exposures."""
    rig = drawn_rig(PRESCRIPTIONS["machine-vision"], 1.0, seed)
    sigma = draw.uniform(0.05, 0.15)
    alone = []
    for lens in (rig.left, rig.right):
        poses = sample_board_poses(lens, BOARD, 20, generator, fill=(0.25, 0.8), options=_ROLLS)
        noise = sigma * torch.randn(20, BOARD.corners, 2, dtype=torch.float64, generator=generator)
        alone.append(observed(corners_of(lens, printed(BOARD.points, seed), poses, noise), lens.size))
    large = BOARD.model_copy(update={"square": 0.3})
    poses = sample_pair_poses(rig, large, 16, generator, distance=(14.0, 25.0), options=PoseOptions())
    speed = draw.uniform(0.01, 0.05) if kind == "unsynchronized" else 0.0
    seen: list[list[Tensor]] = [[], []]
    for rotation, translation in poses:
        moved = speed * torch.randn(3, dtype=torch.float64, generator=generator)
        for c, lens in enumerate((rig.left, rig.right)):
            points = large.points @ rotation.T + translation + c * moved
            pixels, valid = lens.project(points if c == 0 else rig.right_from_left(points))
            noise = sigma * torch.randn(pixels.shape, dtype=torch.float64, generator=generator)
            noisy = pixels + noise
            seen[c].append(torch.where((valid & lens.inside(noisy))[:, None], noisy, torch.nan))
    pairs = [
        observed(torch.stack(side), lens.size, board=large)
        for side, lens in zip(seen, (rig.left, rig.right), strict=True)
    ]
    return PlantedPair(rig=rig, alone=(alone[0], alone[1]), pairs=(pairs[0], pairs[1]), detail=f"{1000 * speed:.0f} mm")


# What is required of a camera, in a rig with 10 m of baseline; of a rig, from boards alone.
CAMERA, RIG, MARK = "2km:10%", "500m:5%", 0.1
# Where nothing is required, a camera whose true error is more than so many times its error bars is wrong.
SIGMAS = 2.0
# Which finding names which fault.
NAMES = {
    "model": {"model"},
    "fronto-parallel": {"tilt"},
    "warp": {"board"},
    "blur": {"blur"},
    "unsynchronized": {"synchronization"},
    "pupil": {"pupil"},
    "mirrored or mixed": {"mirrored"},
}
# What the error says where kcal refuses the capture.
REFUSALS = {
    "fronto-parallel": ("parallel to the image", "determine the focal length only", "tilted alike"),
    "unsynchronized": ("taken at the same moment",),
}
CLEAN = ("clean", "clean", "clean", "clean pair")


def true_error(lens: TruthLens, camera: Camera) -> float:
    """Difference of lens and camera at infinity after the best-fit rotation, RMS over the image, px."""
    grid = camera.grid(33, 25).reshape(-1, 2)
    rays, _ = lens.unproject(grid)
    own, valid = camera.unproject(grid)
    turn = rotation_between(rays[valid], own[valid])
    seen, shown = camera.project(1e9 * rays @ turn.T)
    good = valid & shown
    return float((seen - grid)[good].square().sum(-1).mean().sqrt())


def judge_camera(planted: Planted) -> tuple[Verdict, float, float, Record]:
    """Verdict, true RMS error over the image in px, that of the range over what is required; the verdict without."""
    result = calibrate_camera(planted.observations, planted.options)
    need, found = Requirement.parse(CAMERA), examine(result, planted.options)
    verdict = camera_verdict(result, planted.options, need, mark_sigma=MARK, examination=found)
    bare = camera_verdict(result, planted.options, examination=found)
    off, sigma = true_error(planted.lens, result.camera), image_sigma(result.camera)
    stated = float(sigma[sigma.isfinite()].square().mean().sqrt())
    slope = math.sqrt(2.0) * need[0].distance ** 2 / (float(result.camera.focal[0]) * 10.0)
    more = {"bare": bare.usable, "sigmas": round(off / stated, 2)}
    return verdict, off, slope * math.hypot(off, MARK) / need[0].meters, more


def judge_pair(planted: PlantedPair) -> tuple[Verdict, float, float, Record]:
    """Verdict, true RMS error of ranges in meters, and over what is required."""
    left, right = (calibrate_camera(seen, CalibrationOptions()).camera for seen in planted.alone)
    both = left, right
    matched = pair_by_name(planted.pairs[0].names, planted.pairs[1].names)
    boards = paired_boards(both, planted.pairs, matched)
    result = solve_rig(RigData(cameras=both, names=("left", "right"), boards=boards))
    rig = result.stereo()
    need = Requirement.parse(RIG)[0]
    verdict = rig_verdict(rig, (need,), mark_sigma=MARK, result=result)
    shares = itertools.product((-0.3, 0.0, 0.3), (-0.2, 0.0, 0.2))
    places = [torch.tensor([0.5 + u, 0.5 + v]) * torch.tensor(planted.rig.left.size) for u, v in shares]
    rays = planted.rig.left.unproject(torch.stack(places).double())[0]
    pixels, seen_by_both = planted.rig(need.distance * rays)
    marks, seen_by_both = pixels.unbind(-2), seen_by_both.all(-1)
    from kcal.locate.stereo import sight_lines

    lines = sight_lines(rig, *marks)
    off = (lines.points.norm(dim=-1) - need.distance)[seen_by_both]
    error = float(off.square().mean().sqrt())
    return verdict, error, error / need.meters, {}


def judge(kind: str, seed: int) -> Record:
    """One line of the file."""
    clock = time.process_time()
    planted = drawn(kind, seed)
    line: Record = {"kind": kind, "detail": planted.detail}
    try:
        verdict, off, over, more = judge_pair(planted) if isinstance(planted, PlantedPair) else judge_camera(planted)
        line |= more | {
            "yes": verdict.usable,
            "off": round(off, 4),
            "over": round(over, 3),
            "stops": [finding.name for finding in verdict.stops],
            "doubts": [finding.name for finding in verdict.findings if finding.severity == "doubt"],
            "reason": verdict.reason,
        }
    except KcalError as error:
        line |= {"yes": False, "off": None, "over": None, "stops": ["refused"], "doubts": [], "reason": str(error)}
    return line | {"seconds": round(time.process_time() - clock, 2)}


def named(line: Record) -> bool:
    """Whether the planted fault was named."""
    refused = any(text in line["reason"] for text in REFUSALS.get(line["kind"], ()))
    return refused or bool(NAMES[line["kind"]] & {*line["stops"], *line["doubts"]})


def broken(line: Record, times: float) -> bool:
    """Whether the true error is so many times what is required, or more; a camera that was refused is broken."""
    return line["over"] is None or line["over"] > times


def wanted(first: int, planted: int, clean: int) -> Iterator[tuple[str, int]]:
    """Kinds and seeds, of all kinds from the beginning."""
    faulty = [(FAULTS[i % len(FAULTS)], first + i // len(FAULTS)) for i in range(planted)]
    good = [(CLEAN[i % len(CLEAN)], first + i) for i in range(clean)]
    groups = itertools.zip_longest(faulty[::2], faulty[1::2], good)
    return (job for jobs in groups for job in jobs if job is not None)


@section("ordinary.md", "verdict", planted=1, clean=1)
def verdicts(kept: Kept = NOT_KEPT, planted: int = 200, clean: int = 100, first: int = 200) -> Lines:
    """What happens to captures with a planted fault, and to good ones."""
    lines = kept.records(wanted(first, planted, clean), judge, lambda one: f"{one['yes']}, off {one['off']}")
    bad, fine = ([line for line in lines if (line["kind"] in FAULTS) is fault] for fault in (True, False))
    yield [
        "captures", "number", "yes", "yes, but off by more than required", "by twice that", "all that are off by more",
        "fault named", "nothing required: yes", f"of these, off by more than {SIGMAS:g} σ",
        f"no, though within {SIGMAS:g} σ",
    ]  # fmt: skip
    for kind in [*FAULTS, "all planted", "clean"]:
        here = fine if kind == "clean" else [line for line in bad if kind in ("all planted", line["kind"])]
        if not here:
            continue
        yes, alone = [line for line in here if line["yes"]], [line for line in here if "bare" in line]
        yield [
            kind, len(here), len(yes), sum(broken(line, 1.0) for line in yes), sum(broken(line, 2.0) for line in yes),
            sum(broken(line, 1.0) for line in here), "" if kind == "clean" else sum(map(named, here)),
            *([sum(line["bare"] for line in alone),
               sum(line["bare"] and line["sigmas"] > SIGMAS for line in alone),
               sum(not line["bare"] and line["sigmas"] <= SIGMAS for line in alone)] if alone else [""] * 3),
        ]  # fmt: skip
    good = [line for line in fine if not broken(line, 1.0)]
    refused = sum(not line["yes"] for line in good)
    yield f"Of the {len(good)} clean captures that are not off by more than required, {refused} got a no."


SIGMA, VIEWS, LENSES = 0.08, (5, 8, 12, 20), ("hybrid", "opencv5")
AT = [math.inf]
HALF = 0.5


def judged_intervals(model: str, seed: int, refits: int) -> Record:
    """One calibration, its truth, and the verdicts on it."""
    views, by_hand = VIEWS[seed // 2 % len(VIEWS)], bool(seed % 2)
    case, second = (simulated(seed, views, SIGMA, by_hand, take=take) for take in (0, 1))
    options = CalibrationOptions(model=model)
    try:
        result = calibrate_camera(case.seen, options)
        error = error_at_infinity(result.camera, case.lens)
        truth = figures(result.camera, case.seen, error.pixels, error.errors)
        check, spent = timed(lambda: interval_check(result, AT, simulated_refits(result, options, AT, range(refits))))
        fault = fault_of_views(result, options)
        found = against_capture(result, second.seen, options, AT)[0]
    except KcalError as refusal:
        return {"refused": str(refusal)}
    return {
        "views": views,
        "truth": truth["everywhere"],
        "share": check.shares[0][0],
        "factor": check.factors[0],
        "true": check.true,
        "fault": None if fault is None else fault.text,
        "same": found.same,
        "probability": found.probability,
        "cpu_s": spent,
    }


def interval_lines(records: list[Record]) -> Lines:
    """One row for each lens model."""
    yield [
        "lens", "calibrations", "truly true", "truth inside, of the image", "refits inside", "refits say true",
        "views say true", "second capture says true", "check agrees", "check with --against agrees",
        "CPU s, 100 refits",
    ]  # fmt: skip
    for model in LENSES:
        some = [one for one in records if one["key"][0] == model and "refused" not in one]
        if not some:
            continue
        true = [one["truth"] > HALF for one in some]
        alone = [one["true"] and one["fault"] is None for one in some]
        both = [ok and one["same"] for ok, one in zip(alone, some, strict=True)]
        agree = [sum(a == b for a, b in zip(said, true, strict=True)) for said in (alone, both)]
        yield [
            "default" if model == LENSES[0] else model,
            len(some),
            sum(true),
            f"{100 * statistics.fmean(one['truth'] for one in some):.0f} %",
            f"{100 * statistics.fmean(one['share'] for one in some):.1f} %",
            sum(one["true"] for one in some),
            sum(one["fault"] is None for one in some),
            sum(bool(one["same"]) for one in some),
            f"{agree[0]} of {len(some)}",
            f"{agree[1]} of {len(some)}",
            f"{statistics.median(one['cpu_s'] / one['key'][2] for one in some) * 100:.0f}",
        ]  # fmt: skip


@section("ordinary.md", "warm refits", count=1, seeds=range(1))
def cold_and_warm(count: int = 8, seeds: range = range(4)) -> Lines:
    """How far refits that begin at the found camera end from those that begin with nothing."""
    yield ["capture", "refits", "apart, σ (median)", "(largest)", "CPU s warm", "CPU s cold"]
    options = CalibrationOptions()
    for seed in [(0, 1, 5, 6)[i] for i in seeds]:
        views, by_hand = VIEWS[seed // 2 % len(VIEWS)], bool(seed % 2)
        result = calibrate_camera(simulated(seed, views, SIGMA, by_hand).seen, options)
        places = result.camera.grid(25, 17).reshape(-1, 2)
        sigma = pixel_covariance(result.camera, places).diagonal(dim1=-2, dim2=-1).sum(-1)
        apart, took = [], np.zeros(2)
        for number in range(count):
            drawn = simulated_capture(result, options, number)
            cameras, spent = zip(*(timed(drawn.calibrated, options, warm=warm) for warm in (True, False)), strict=True)
            took += spent
            apart.append(
                float((pixel_errors(cameras[0], cameras[1], places).square().sum(-1) / sigma).nanmean().sqrt())
            )
        kind = f"{views} views {'by hand' if by_hand else 'on a stand'}"
        yield [kind, count, f"{statistics.median(apart):.3f}", f"{max(apart):.3f}",
               *(f"{each / count:.2f}" for each in took)]  # fmt: skip


@section("ordinary.md", "intervals", seeds=range(1), refits=2)
def intervals(kept: Kept = NOT_KEPT, seeds: range = range(20), refits: int = 100) -> Lines:
    return interval_lines(kept.records(itertools.product(LENSES, seeds, [refits]), judged_intervals))


SAID = "pixels are not square"
FEWEST_AND_MOST, NOISES, UPRIGHT, ROLLED = (8, 20), (0.05, 0.2), math.radians(2.0), math.radians(90.0)


def judged_aspect(stretch: float, seed: int) -> Record:
    """One capture: what it was, and what was said."""
    draw = torch.rand(2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed + 40_000)).tolist()
    views = FEWEST_AND_MOST[0] + int(draw[0] * (FEWEST_AND_MOST[1] - FEWEST_AND_MOST[0] + 1))
    sigma = NOISES[0] * (NOISES[1] / NOISES[0]) ** draw[1]
    # Lenses and what is held go round with 3 and 6; 2 and 8 mix all with all.
    upright, by_hand = seed % 2 == 0, seed // 2 % 4 == 0
    factor = stretch if seed // 8 % 2 == 0 else 1.0 / stretch
    case = simulated(seed, views, sigma, by_hand, max_roll=UPRIGHT if upright else ROLLED, stretch=factor)
    record: Record = {"views": views, "sigma": sigma, "upright": upright, "hand": by_hand, "factor": factor}
    try:
        result, spent = timed(calibrate_camera, case.seen)
    except KcalError as refusal:
        return record | {"refused": str(refusal)}
    focal = result.camera.focal.tolist()
    said = [text for text in result.warnings if SAID in text]
    return record | {"said": said, "aspect": focal[1] / focal[0], "cpu_s": spent}


def aspect_lines(records: list[Record]) -> Iterator[str]:
    """A row for each stretch and kind of capture."""
    rows = []
    for stretch in sorted({record["key"][0] for record in records}):
        own = [record for record in records if record["key"][0] == stretch]
        kinds = {"by hand": [r for r in own if r["hand"]], "on a stand": [r for r in own if not r["hand"]]}
        for name, part in kinds.items():
            known = [record for record in part if "refused" not in record]
            said = [record for record in known if record["said"]]
            off = [abs(record["aspect"] / record["factor"] - 1.0) for record in said]
            share = f"{100 * len(said) / len(known):.1f} %" if known else "–"
            rows.append([f"{stretch:g}", name, len(part), len(said), share, f"{max(off):.4f}" if off else "–"])
    return table(["stretch", "captures", "number", "said not to be square", "share", "largest error of f_y/f_x"], rows)


@section("ordinary.md", "aspect", seeds=range(1))
def of_pixels(kept: Kept = NOT_KEPT, seeds: range = range(1000), stretch: float = 1.0) -> Lines:
    return aspect_lines(kept.records([(stretch, seed) for seed in seeds], judged_aspect))
