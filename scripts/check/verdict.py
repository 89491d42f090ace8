"""Does the verdict say yes only to captures that deserve it? Captures with one planted fault each, and clean ones.

Seeds below 200 were for setting the thresholds.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import random
import time
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from kcal import Board, Camera, KcalError, Observations, RigData, solve_rig
from kcal.calibrate import examine
from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.lens import rotation_from_vector
from kcal.lens.pose import Pose, rotation_between
from kcal.lens.uncertainty import image_sigma
from kcal.report import camera_verdict, rig_verdict
from kcal.report.verdict import Requirement, Verdict
from kcal.rig import pair_by_name, paired_boards
from kcal.sim.captures import PoseOptions, TrueRig, drawn_lens, drawn_rig, sample_board_poses
from kcal.sim.truth import TruthLens
from scripts.shared.captures import sample_pair_poses
from scripts.shared.page import Lines
from scripts.shared.prescriptions import PRESCRIPTIONS
from scripts.shared.sections import NOT_KEPT, Kept, Record, section
from scripts.shared.traced import as_observations, printed

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
