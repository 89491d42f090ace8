"""Captures by hand, with a stabilizer, of boards that bend, and pairs that are not simultaneous: do error bars hold?

Truth: three traced lenses in turn, decentered, whose entrance pupils move; printed boards (7 x 6 corners, 5 cm), noise
of 0.08 px. By hand (`scripts.shared.simulated`): the camera or the board is held, in turn; a rolling shutter with
a readout of 10 to 30 ms; rates of 0.1 to 1 rad/s and 0.05 to 0.3 m/s (standard deviation along each axis, drawn for
each capture), half of their variance tremor of 2 to 10 Hz; exposures of 5 to 20 ms, pictures with more than 12 px of
blur taken again; noise grows along the blur, as the views' covariances say. Optical stabilizer: the image of each view
is shifted as a whole (standard deviation along each axis); electronic: so too, by hand. Measure: as in
`scripts.bench.traced_lenses`, where the camera sees infinitely distant points, all over the image, after the best
turn; of the camera without a shift, and of those of six other frames, each with a shift of its own.

Rigs: two cameras of 1280 x 960 pixels, 25 cm apart, which see twelve boards (9 x 6 corners, 5 cm); noise of 0.1 px;
hands for each camera its own. The cameras are exact, or calibrated from their sides of the pairs where these have a
stabilizer or bend. *Apart*: the board moves on, at rates as by hand, until the right camera exposes. Measure: the
error of the relative pose (six numbers) in units of its covariance, squared and divided by six, which is one on the
average, and the errors themselves, of exact cameras; and whether the range of a point 30 m away, marked exactly
in the middle of one frame of each, lies in its 95 % interval: the relative yaw decides it.

Guided photography of a board against views at random: how many views give the same camera.

Each seed has a lens with five coefficients of its own, 1280 x 720, and a board of 9 x 6 corners 25 mm apart. Frames are
rendered, with noise and a little blur, and corners are detected in them. *Random*: 20 views drawn by
`kcal.sim.captures.sample_board_poses`: over the whole image, near and far, tilted and rolled. *Guided*: the first four
views and each next one as `kcal capture` asks for them, held by a person: off by 5 % of the distance across and by 10 %
along, by 8 degrees of tilt and 10 degrees of roll. A view that is not seen whole is held again.

Guided capture goes on until its σ is that of the 20 random views (points at infinity, RMS over the image; both as kcal
predicts it), or to 20 views. True errors are those of points at infinity after the best-fit rotation. Seeds below 100
are for tuning.
"""

from __future__ import annotations

import itertools
import math
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal import (
    Board,
    CalibrationOptions,
    Camera,
    KcalError,
    Localizer,
    Observations,
    RigOptions,
    View,
    calibrate_camera,
    calibrate_rig,
)
from kcal.calibrate.camera.advice import NextView, far_sigma
from kcal.capture.session import CaptureOptions, CaptureSession
from kcal.corners.detect import detect_board, view_of
from kcal.lens import rotation_from_vector, vector_from_rotation
from kcal.lens.pose import Pose
from kcal.sim.captures import BoardSize, sample_board_poses
from kcal.sim.scene import RenderOptions, render_board
from scripts.shared.captures import as_observations
from scripts.shared.page import NOT_KEPT, Kept, Lines, Record, merged, rms, section, share, timed
from scripts.shared.simulated import Hands, MovingCapture, against_truth, bends, draw_motion, moving_capture, simulated

SIGMA, FRAMES = 0.08, 6


class Kind(NamedTuple):
    """What moves while views are taken.

    Attributes:
        by_hand: the camera or the board is held by hand, before a rolling shutter.
        bent: meters by which the board bends (standard deviation).
        share: of the views in which it does.
        shift: pixels by which each image is shifted along each axis (standard deviation).
        apart: seconds between the exposures of a rig's cameras.
    """

    by_hand: bool = False
    bent: float = 0.0
    share: float = 1.0
    shift: float = 0.0
    apart: float = 0.0


KINDS = {
    "hand": Kind(True),
    "stand": Kind(),
    "bent": Kind(bent=1e-3),
    "few bent": Kind(bent=3e-3, share=0.2),
    "bent, hand": Kind(True, bent=1e-3),
    "bent by 0.1 mm": Kind(bent=1e-4),
    "bent by 0.5 mm": Kind(bent=5e-4),
    "paper, bent by 2 mm, hand": Kind(True, bent=2e-3),
    **{f"optical stabilizer, {px} px": Kind(shift=px) for px in (2, 5, 15)},
    **{f"electronic stabilizer, {px} px": Kind(True, shift=px) for px in (2, 5, 15)},
    **{f"{apart:g} s apart, hand": Kind(True, apart=apart) for apart in (0.01, 0.03, 0.1)},
}
# Of a table of its own, each with the cause to be named.
MOVING = {
    name: "lens" if kind.shift else "bending" if kind.bent else "moment" if kind.apart else ""
    for name, kind in KINDS.items()
    if name not in ("bent", "few bent", "bent, hand")
}
FITS = {
    "default": CalibrationOptions(),
    "still": CalibrationOptions(motion=False),
    "stiff": CalibrationOptions(bending=False),
}
# Of rigs.
RIG_BOARD, RIG_SIZE = Board(columns=9, rows=6, square=0.05), BoardSize(9, 6, 0.05)
CAMERA = Camera.build(focal=(1100, 1100), center=(639.5, 479.5), size=(1280, 960), coefficients=[-0.1])
TURN = rotation_from_vector(torch.tensor([0.0, -0.15, 0.0], dtype=torch.float64))
SHIFT = torch.tensor([-0.25, 0.0, 0.0], dtype=torch.float64)
BOARDS, RIG_SIGMA, FEWEST = 12, 0.1, 12
FAR = torch.tensor([[0.0, 0.0, 30.0]], dtype=torch.float64)  # m
# Squared distance that a normal vector of six components exceeds once in twenty times.
CHI2_OF_SIX = 12.592


def shifts(kind: Kind, count: int, seed: int) -> Tensor:
    """(count, 2) pixels by which images are shifted."""
    generator = torch.Generator().manual_seed(70_000 + seed)
    return kind.shift * torch.randn((count, 2), dtype=torch.float64, generator=generator)


def captured(kind: str, views: int, seed: int, fit: str) -> Record:
    """One capture and its calibration."""
    what = KINDS[kind]
    by_view = shifts(what, views + FRAMES, seed) if what.shift else None
    case = simulated(seed, views, SIGMA, what.by_hand, bent=what.bent, share=what.share, shifts=by_view)
    found, spent = timed(against_truth, case, FITS[fit], () if by_view is None else by_view[views:])
    moved = {name: getattr(case.truth, name) for name in ("readout", "exposure", "turning", "speed")}
    return found | moved | {"cpu_s": spent, "blur": float(case.truth.blur.norm(dim=-1).square().nanmean().sqrt())}


def rig(kind: str, seed: int, fit: str) -> Record:
    """One rig, from the pairs of its two cameras."""
    what, generator = KINDS[kind], torch.Generator().manual_seed(seed)
    poses = sample_board_poses(CAMERA, RIG_SIZE, BOARDS, generator, fill=(0.25, 0.5))
    there = [later(pose, what.apart, generator) for pose in poses] if what.apart else poses
    other = [Pose(TURN @ pose.rotation, TURN @ pose.translation + SHIFT) for pose in there]
    hands = Hands() if what.by_hand else None
    heights = bends(BOARDS, what.bent, what.share, generator, RIG_BOARD) if what.bent else None
    sides = [
        moving_capture(CAMERA, own, sigma=RIG_SIGMA, seed=2 * seed + k, hands=hands, board=RIG_SIZE, heights=heights)
        for k, own in enumerate((poses, other))
    ]
    by_view = [shifts(what, BOARDS + 1, 2 * seed + k)[:, None] for k in range(2)]
    shown = [side.pixels + own[:-1] for side, own in zip(sides, by_view, strict=True)]
    seen = [CAMERA.inside(pixels) & pixels.isfinite().all(-1) for pixels in shown]
    kept = (torch.stack(seen).sum(-1) >= FEWEST).all(0).nonzero()[:, 0].tolist()
    both = [observed(*one, kept) for one in zip(shown, sides, seen, strict=True)]
    pairs = [(str(i), str(i)) for i in kept]
    try:
        left, right = (calibrate_camera(one).camera if what.shift or what.bent else CAMERA for one in both)
        result = calibrate_rig(left, right, both[0], both[1], pairs, RigOptions(motion=fit != "still"))
        found = result.stereo()
        marks = [
            CAMERA.project(points)[0] + own[-1]
            for points, own in zip((FAR, FAR @ TURN.T + SHIFT), by_view, strict=True)
        ]
        place = Localizer(found, pixel_sigma=1e-3)(*marks)
    except KcalError as refusal:
        return {"refused": str(refusal)}
    turn = vector_from_rotation(found.right_from_left_rotation @ TURN.T)
    shift = found.right_from_left_translation - SHIFT
    error, length = torch.cat([turn, shift]), float(FAR.norm())
    square = float(error @ torch.linalg.solve(result.relative_covariance(), error))
    inside = bool((place.range_low <= length) & ~(place.range_high < length))
    said = {
        "names": [finding.name for finding in result.findings],
        "low": float(place.range_low),
        "high": float(place.range_high),
    }
    return {"chi2": square, "mrad": 1e3 * float(turn.norm()), "mm": 1e3 * float(shift.norm()), "yaw": inside} | said


def later(pose: Pose, seconds: float, generator: torch.Generator) -> Pose:
    """A board that moves by hand about its middle, after so many seconds."""
    hands = Hands()
    low, high = torch.tensor([hands.turning, hands.speed], dtype=torch.float64).log().T
    turning, speed = (low + (high - low) * torch.rand(2, dtype=torch.float64, generator=generator)).exp().tolist()
    step = draw_motion(turning, speed, hands.tremor, generator).at(torch.tensor(seconds, dtype=torch.float64))
    turn, middle = rotation_from_vector(step[:3]), pose.rotation @ RIG_BOARD.points.mean(0) + pose.translation
    return Pose(turn @ pose.rotation, turn @ (pose.translation - middle) + middle + step[3:])


def observed(pixels: Tensor, side: MovingCapture, inside: Tensor, kept: list[int]) -> Observations:
    """What one camera saw of the boards that both saw, with the corners' covariances."""
    pixels = torch.where(inside[..., None], pixels, torch.nan)[kept]
    names = list(map(str, kept))
    return as_observations(pixels, CAMERA.size, RIG_BOARD, covariance=side.covariance[kept], names=names)


def lines(name: str, records: list[Record], *terms: str) -> Lines:
    """One row for each number of views, kind and fit, and how often these terms were found; other rows stay."""
    cells: dict[tuple[int, str, str], list[Record]] = {}
    for record in records:
        kind, views, _, fit = record["key"]
        cells.setdefault((views, kind, fit), []).append(record)
    rows = []
    for (views, kind, fit), own in sorted(cells.items()):
        known = [record for record in own if "refused" not in record]
        refused = f"{100 * (1 - len(known) / len(own)):.1f} %"
        if not known:
            rows.append([views, kind, fit, len(own), refused, *["–"] * (4 + len(terms))])
            continue
        true, stated = [r["rms"] for r in known], [r["predicted"] for r in known]
        rows.append(
            [
                views, kind, fit, len(own), refused, share(r["everywhere"] for r in known),
                f"{statistics.median(true):.3f}", f"{rms(true):.3f}", f"{rms(stated):.3f}",
                *(f"{100 * statistics.fmean(term in r.get('terms', ()) for r in known):.0f} %" for term in terms),
            ]
        )  # fmt: skip
    head = [
        "views", "held by", "fit", "captures", "refused", "in 95 %, whole image", "median error, px",
        "RMS error", "RMS stated", *(f"{term} found" for term in terms),
    ]  # fmt: skip
    return merged("ordinary.md", name, head, rows, keys=3)


def moving_lines(records: list[Record]) -> Lines:
    """One row for each kind: what was named, and what error bars contain; what has no record stays."""
    rows = []
    for kind in MOVING:
        own = [r for r in records if r["key"][0] == kind and r["key"][-1] == "default"]
        views, pairs = ([r for r in own if len(r["key"]) == size] for size in (4, 3))
        if not own:
            continue
        known, rigs = ([r for r in part if "refused" not in r] for part in (views, pairs))
        named = [
            f"{100 * statistics.fmean(cause in r['causes'] for r in known):.0f} %" if known else None
            for cause in ("lens", "bending", "motion", "views")
        ]
        moment, lens = (
            f"{100 * statistics.fmean(name in r['names'] for r in rigs):.0f} %" if rigs else None
            for name in ("synchronization", "moving-lens")
        )
        yaw = f"{100 * statistics.fmean(r['yaw'] for r in rigs):.0f} %" if rigs else None
        inside = [share(r[which] for r in known if which in r) if known else None for which in ("everywhere", "frame")]
        counts = [f"{len(views)} / {len(pairs)}", f"{len(views) - len(known)} / {len(pairs) - len(rigs)}"]
        # Of pairs at other moments there are rigs alone.
        rows.append([kind, *(counts if views or KINDS[kind].apart else [None] * 2), *named, lens, moment, *inside, yaw])
    head = [
        "what moves", "captures / rigs", "refused", "lens named", "bending", "motion", "other views",
        "lens named by a rig", "other moments", "mean camera in 95 %", "another frame's", "range of a rig in 95 %",
    ]  # fmt: skip
    return merged("ordinary.md", "moving", head, rows)


def rig_lines(records: list[Record]) -> Lines:
    """One row for boards by hand and on a stand, with and without motion."""
    yield ["held by", "fit", "rigs", "refused", "χ²/6", "in 95 %", "RMS error of rotation, mrad", "of position, mm"]
    for held_by, fit in itertools.product(("hand", "stand"), ("default", "still")):
        own = [record for record in records if (record["key"][0], record["key"][2]) == (held_by, fit)]
        known = [record for record in own if "refused" not in record]
        if known:
            inside = 100.0 * statistics.fmean(record["chi2"] < CHI2_OF_SIX for record in known)
            mean = statistics.fmean(record["chi2"] / 6 for record in known)
            errors = [rms([record[key] for record in known]) for key in ("mrad", "mm")]
            refused = len(own) - len(known)
            yield [held_by, fit, len(own), refused, f"{mean:.2f}", f"{inside:.0f} %", *(f"{e:.3f}" for e in errors)]


def captures_of(
    kept: Kept, seeds: range, views: tuple[int, ...], kinds: tuple[str, ...], fits: tuple[str, ...] = ("default",)
) -> list[Record]:
    keys = [(kind, count, seed, fit) for seed, count, kind, fit in itertools.product(seeds, views, kinds, fits)]
    return [one for one in kept.records(keys, captured) if len(one["key"]) == 4 and one["key"][0] in kinds]


def rigs_of(kept: Kept, seeds: range, kinds: tuple[str, ...], fits: tuple[str, ...]) -> list[Record]:
    keys = [(kind, seed, fit) for seed, kind, fit in itertools.product(seeds, kinds, fits)]
    return [one for one in kept.records(keys, rig) if len(one["key"]) == 3 and one["key"][0] in kinds]


def _registered(name: str, little: int, kinds: tuple[str, ...], *terms: str) -> None:
    @section("ordinary.md", name, seeds=range(little))
    def captures(
        kept: Kept = NOT_KEPT, seeds: range = range(100), views: tuple[int, ...] = (8,),
        fits: tuple[str, ...] = ("default",),
    ) -> Lines:  # fmt: skip
        """`still`: without the terms for motion; `stiff`: without the term for bending."""
        return lines(name, captures_of(kept, seeds, views, kinds, fits), *terms)


_registered("handheld", 2, ("hand", "stand"))
_registered("bent", 1, ("bent", "few bent", "bent, hand"), "motion", "bending")


@section("ordinary.md", "moving", seeds=range(1), rigs=range(1), kinds=("stand", "0.01 s apart, hand"))
def moving(
    kept: Kept = NOT_KEPT, seeds: range = range(17), rigs: range = range(3), kinds: tuple[str, ...] = tuple(MOVING)
) -> Lines:
    """Captures of 16 views, and rigs, of seeds of their own."""
    still = tuple(kind for kind in kinds if not KINDS[kind].apart)
    return moving_lines([*captures_of(kept, seeds, (16,), still), *rigs_of(kept, rigs, kinds, ("default",))])


@section("ordinary.md", "rigs", seeds=range(1))
def rigs(kept: Kept = NOT_KEPT, seeds: range = range(100), fits: tuple[str, ...] = ("default", "still")) -> Lines:
    return rig_lines(rigs_of(kept, seeds, ("hand", "stand"), fits))


BOARD = Board(columns=9, rows=6, square=0.025)
PRINT = BoardSize(BOARD.columns, BOARD.rows, BOARD.square)
SIZE, RANDOM = (1280, 720), 20
ACROSS, ALONG, TILT, ROLL = 0.05, 0.10, math.radians(8.0), math.radians(10.0)


def lens(seed: int) -> Camera:
    """A webcam of no particular make."""
    u = torch.randn(7, generator=torch.Generator().manual_seed(9000 + seed)).tolist()
    return Camera.build(
        focal=(950 + 60 * u[0],) * 2,
        center=(639.5 + 10 * u[1], 359.5 + 10 * u[2]),
        size=SIZE,
        coefficients=[-0.15 + 0.05 * u[3], 0.05 + 0.02 * u[4], 4e-4 * u[5], 4e-4 * u[6], 0.0],
        model="opencv5",
    )


def held(wanted: NextView, generator: torch.Generator) -> Pose:
    """The view as a person holds the board."""
    u = torch.randn(6, generator=generator, dtype=torch.float64)
    turn = rotation_from_vector(torch.tensor([TILT, TILT, ROLL], dtype=torch.float64) * u[:3])
    middle = 0.5 * (BOARD.points.amin(0) + BOARD.points.amax(0))
    center = wanted.rotation @ middle + wanted.translation
    distance = float(center.norm())
    center = center * (1.0 + ALONG * float(u[3])) + ACROSS * distance * torch.cat([u[4:], u.new_zeros(1)])
    rotation = turn @ wanted.rotation
    return Pose(rotation, center - rotation @ middle)


def true_error(found: Camera, truth: Camera) -> float:
    """RMS error of points at infinity over the image along an axis, after the best-fit rotation, pixels."""
    pixels = truth.grid(33, 19).reshape(-1, 2)
    there, here = truth.unproject(pixels)[0], found.unproject(pixels)[0]
    u, _, vh = torch.linalg.svd(there.T @ here)
    return float(((found.project(there @ (u @ vh))[0] - pixels).square().sum(-1).mean() / 2).sqrt())


def at_random(truth: Camera, seed: int) -> tuple[float, float]:
    """σ and true error of 20 random views."""
    generator = torch.Generator().manual_seed(100 + seed)
    views: list[View] = []
    for i, pose in enumerate(sample_board_poses(truth, PRINT, RANDOM, generator)):
        found = detect_board(frame(truth, pose, generator), BOARD)
        if found.pixels is not None:
            views.append(view_of(found, str(i)))
    camera = calibrate_camera(Observations(board=BOARD, image_size=SIZE, views=tuple(views))).camera
    return far_sigma(camera), true_error(camera, truth)


def frame(truth: Camera, pose: Pose, generator: torch.Generator) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """A rendered frame."""
    return np.asarray(render_board(truth, pose, PRINT, RenderOptions(), generator).numpy(), np.uint8)


def guided(truth: Camera, goal: float, seed: int) -> list[dict[str, float]]:
    """σ and true error after each calibration, until the goal."""
    generator = torch.Generator().manual_seed(200 + seed)
    out: list[dict[str, float]] = []
    with tempfile.TemporaryDirectory() as folder:
        session = CaptureSession(Path(folder) / "x.obs.json", BOARD, CaptureOptions(until=goal, most=RANDOM))
        # The first suggestion needs a frame, to know the image's size.
        session.offer(np.full((SIZE[1], SIZE[0]), 90, np.uint8), "dark", moving=False)
        attempt = 0
        while not session.finished:
            session.think()
            if session.result is not None and (not out or out[-1]["views"] < session.views):
                error = true_error(session.result.camera, truth)
                out.append({"views": session.views, "sigma": session.sigma, "error": error})
                continue
            if session.suggestion is None or attempt > 3 * RANDOM:
                break
            attempt += 1
            pose = held(session.suggestion, generator)
            if seen_whole(truth, pose):
                session.offer(frame(truth, pose, generator), f"{attempt}.png", moving=False)
    return out


def seen_whole(truth: Camera, pose: Pose) -> bool:
    """All corners are inside the image, with a margin for the outer squares."""
    pixels, valid = truth.project(BOARD.points @ pose.rotation.T + pose.translation)
    inside: Tensor = (pixels > 25) & (pixels < torch.tensor(SIZE) - 26)
    return bool((inside.all(-1) & valid).all())


def both(seed: int) -> Record:
    """σ and true error at random and guided."""
    truth, start = lens(seed), time.process_time()
    random = at_random(truth, seed)
    return {"random": random, "guided": guided(truth, random[0], seed), "cpu_s": time.process_time() - start}


@section("ordinary.md", "capture", seeds=range(300, 301))
def guidance(kept: Kept = NOT_KEPT, seeds: range = range(300, 308)) -> Lines:
    """One row for each seed, and the means."""
    records = kept.records([(seed,) for seed in seeds], both)
    yield ["seed", "σ of 20 random views, px", "true error, px", "guided views to this σ", "true error then, px"]
    views, ratios = [], []
    for record in sorted(records, key=lambda r: r["key"]):
        last, (sigma, error) = record["guided"][-1], record["random"]
        reached = last["sigma"] <= sigma
        views.append(last["views"])
        ratios.append(last["error"] / error)
        count = f"{last['views']:.0f}" if reached else f"not in {last['views']:.0f} ({last['sigma']:.3f} px)"
        yield [record["key"][0], f"{sigma:.4f}", f"{error:.4f}", count, f"{last['error']:.4f}"]
    ratio = math.exp(sum(map(math.log, ratios)) / len(ratios))
    median = sorted(views)[len(views) // 2]
    yield ["all", "", "", f"median {median:.0f}", f"{ratio:.2f} of random (geometric mean)"]
