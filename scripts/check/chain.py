"""The whole chain, simulated: corners, cameras, a rig from landmarks, and ranges of targets up to 5 km.

Truth: two ray-traced surveillance lenses (`kcal.sim.raytrace`), f 1600 px, 1920 x 1080, each with errors of
assembly of its own, 10 m apart and nearly parallel. Their entrance pupils move by 0, 1 or 3 mm/rad²: with a focal
length of 6.163 mm the prescription itself has 3, and for less its movement is
scaled down, off-axis parts included (`wander` of `TruthLens`).

Cameras: each calibrated by itself from 60 views of one board of 6 x 7 corners, 5 cm apart, at 0.55 to 1.3 m, with
Gaussian noise of the corners. Boards are exact, or printed (`scripts.shared.captures.printed`: stretch 0.15 %, shear
0.02 %, bent along an oblique axis by 0.7 mm, smooth errors of 0.03 mm); each draw has its own board, which both cameras
see.

Rig: 12 landmarks 40 to 400 m away, surveyed to 2 cm along each axis, marked to 0.07 px, at other places in each draw.
Targets: 45 directions all over the image at 7 ranges, where both cameras see them, marked to 0.1 px.

Chains: kcal's camera (`default`) or kcal's parametric models, held as exact in the rig or with their calibrations as
priors; OpenCV's (`cv8`, `cv14`: cv2.calibrateCamera with 8 and 14 coefficients; `cvRO`: cv2.calibrateCameraRO with 8),
whose rig is solved by kcal too, with the cameras held, because OpenCV has no adjustment of landmarks with errors of a
survey; and the true lenses (`true`).

Seeds below 100 are for tuning.

A rig behind two traced lenses for `scripts.check.chain`: its landmarks, its targets, and what a solved rig is worth.

Errors are those of the inverse range, which is Gaussian at any distance, where the range is not.

How often the intervals of `kcal demo` contain the truth: the whole command, many seeds.

Every seed has its own poses, noise, survey and marks; lenses and board are those of the site. The intervals are those
that the command prints: 95 %. Seeds below 100 were looked at.
"""

from __future__ import annotations

import contextlib
import functools
import io
import itertools
import math
import re
import statistics
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple
from unittest import mock

import cv2
import torch
from torch import Tensor

from kcal import (
    CalibrationOptions,
    Camera,
    KcalError,
    Landmarks,
    Localizer,
    Observations,
    RigData,
    RigOptions,
    calibrate_camera,
    load_rig,
    locate_points,
    solve_rig,
)
from kcal.cli import rooms
from kcal.cli.demo import simulated_site
from kcal.locate import Marks, enu_from_cam
from kcal.locate.positions import position_errors
from kcal.rig import placed_rig
from kcal.sim.captures import TrueRig, drawn_rig
from kcal.sim.raytrace import SURVEILLANCE
from kcal.sim.scene import DemoScene
from scripts.shared.captures import BOARD, as_camera, capture, printed
from scripts.shared.long_range import ORIGIN, RANGES, landmarks_of, range_sigma, with_noise
from scripts.shared.page import NOT_KEPT, Kept, Line, Lines, Record, section, share, show, table
from scripts.shared.peer_lenses import opencv

How = Literal["held", "prior"]
LANDMARKS, NEAR, FAR = 12, 40.0, 400.0  # number, meters
SURVEY, LANDMARK_MARK, MARK = 0.02, 0.07, 0.1  # meters, px, px
EDGE = 40.0  # px between landmarks and the edges of the images
SUMS = ("count", "inside", "total", "share", "meters", "expected", "lost")
COLUMNS, ROWS = 9, 5  # of the left image's grid, at whose cells' centers there are targets
ENU_FROM_RIG = enu_from_cam(35.0)
# mm: with this focal length the entrance pupil of the surveillance lens moves by 3 mm/rad² as `TruthLens` traces it
# (`wander` 1). Seen in pixels the lens is the same at any size; a pixel is 3.9 µm.
FOCAL_MM, FULL_PUPIL = 6.163, 3.0


class Targets(NamedTuple):
    """Points at all ranges in all directions that both cameras see, T of them.

    Attributes:
        ring: (T,) which of `RANGES`.
        inverse: (T,) one over the distance from the left camera.
        pixels: (2, T, 2) where the left and the right camera truly see them.
        bound: (T,) standard deviation of the inverse range by marks of `MARK` px alone.
    """

    ring: Tensor
    inverse: Tensor
    pixels: Tensor
    bound: Tensor


def true_rig(draw: int, pupil: float) -> TrueRig:
    """Two lenses of one design, with errors of assembly of their own, 10 m apart and nearly parallel.

    Args:
        draw: seed of the lenses.
        pupil: movement of the entrance pupil, mm/rad².
    """
    return drawn_rig(SURVEILLANCE, 1.0, draw, focal_mm=FOCAL_MM, wander=pupil / FULL_PUPIL)


def targets(rig: TrueRig) -> Targets:
    """Targets of a rig: all directions of a grid of the left image at all ranges, where both cameras see them."""
    width, height = rig.left.size
    x, y = ((torch.arange(n).double() + 0.5) * size / n - 0.5 for n, size in ((COLUMNS, width), (ROWS, height)))
    rays = rig.left.unproject(torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2))[0]
    points = (torch.tensor(RANGES, dtype=torch.float64)[:, None, None] * rays).reshape(-1, 3)
    pixels, valid = rig(points)
    (left, right), valid = pixels.unbind(-2), valid.all(-1)
    seen = valid & rig.left.inside(left) & rig.right.inside(right)
    ring = torch.arange(len(RANGES)).repeat_interleave(len(rays))[seen]
    inverse = 1.0 / points[seen].norm(dim=-1)
    bound = range_sigma(rig, points[seen], MARK) * inverse.square()
    return Targets(ring, inverse, torch.stack([left[seen], right[seen]]), bound)


def landmarks(rig: TrueRig, generator: torch.Generator) -> tuple[Landmarks, Landmarks]:
    """Landmarks all over the common image: as surveyed and marked, and the same without any noise."""

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, dtype=torch.float64, generator=generator)

    size = torch.tensor(rig.left.size, dtype=torch.float64) - 1.0
    pixels = EDGE + uniform(20 * LANDMARKS, 2) * (size - 2 * EDGE)
    distance = NEAR * (FAR / NEAR) ** uniform(20 * LANDMARKS, 1)
    points = distance * rig.left.unproject(pixels)[0]
    pixels, valid = rig(points)
    right = pixels[:, 1]
    kept = (valid.all(-1) & ((right > EDGE) & (right < size - EDGE)).all(-1)).nonzero()[:LANDMARKS, 0]
    exact = landmarks_of(points[kept] @ ENU_FROM_RIG.T, pixels[kept], SURVEY, LANDMARK_MARK)
    return with_noise(exact, generator), exact


def localizer(cameras: tuple[Camera, Camera], seen: Landmarks, how: How) -> Localizer:
    """The rig solved from landmarks, with what it knows of itself.

    Args:
        cameras: left and right, calibrated.
        seen: the landmarks.
        how: the cameras are held as exact, or their calibrations are priors. This is the one place that decides it.

    Raises:
        KcalError: the rig cannot be solved, or says nothing about its errors.
    """
    data = RigData(cameras=cameras, names=("left", "right"), landmarks=seen)
    # The simulated light goes straight.
    options = RigOptions(intrinsics="prior" if how == "prior" else "fixed", refraction=0.0, refraction_sigma=0.0)
    rig = placed_rig(solve_rig(data, options), ORIGIN)
    if rig.covariance is None or rig.mounting is None:
        raise KcalError("the solved rig has no covariance or no mounting")
    return Localizer(rig, pixel_sigma=MARK)


def judge(
    cameras: tuple[Camera, Camera], how: How, rig: TrueRig, points: Targets, seed: int, marks: int, exact: int
) -> dict[str, Any]:
    """What two cameras are worth, over draws of landmarks and marks.

    Args:
        cameras: left and right.
        how: see `localizer`.
        rig: the truth.
        points: `targets` of it.
        seed: of the draws.
        marks: how many draws.
        exact: the first so many places of landmarks are also used without noise.

    Returns:
        sums: for each range, over draws and targets: their number ("count"), "inside" the 95 % interval, squared errors
            of the inverse range over the bound with noisy marks of the targets ("total") and with exact ones ("share";
            over the slope of the inverse range, m²: "meters"), and what the localizer expects of the first
            ("expected"). Targets without an answer are "lost" and not counted.
        lenses_m: for each exact draw, RMS over the targets at the largest range of the error of the inverse range, over
            its slope, in meters.
        failed: messages, and how many runs ended with each; runs: how many did not.
    """
    sums = {name: torch.zeros(len(RANGES), dtype=torch.float64) for name in SUMS}
    failed, lenses, runs = dict[str, int](), list[float](), 0
    far = points.ring == len(RANGES) - 1
    for number in range(marks):
        generator = torch.Generator().manual_seed(seed + number)
        noisy, noiseless = landmarks(rig, generator)
        marked = points.pixels + MARK * torch.randn(points.pixels.shape, dtype=torch.float64, generator=generator)
        try:
            solved = localizer(cameras, noisy, how)
            found, clean = solved(*marked), solved(*points.pixels)
            if number < exact:
                alone = localizer(cameras, noiseless, how)(*points.pixels[:, far])
                there = alone.inverse_range_sigma > 0
                error = (alone.inverse_range - points.inverse[far]) / points.inverse[far].square()
                lenses.append(float(error[there].square().mean().sqrt()))
        except (KcalError, RuntimeError) as error_found:
            message = f"{type(error_found).__name__}: {error_found}"
            failed[message] = failed.get(message, 0) + 1
            continue
        runs += 1
        there = (found.inverse_range_sigma > 0) & (clean.inverse_range_sigma > 0)
        true, bound = points.inverse, points.bound
        values = (
            torch.ones_like(true),
            (found.range_low <= 1.0 / true) & (1.0 / true <= found.range_high),
            ((found.inverse_range - true) / bound).square(),
            ((clean.inverse_range - true) / bound).square(),
            ((clean.inverse_range - true) / true.square()).square(),
            (found.inverse_range_sigma / bound).square(),
        )
        for name, value in zip(SUMS, values, strict=False):
            sums[name].index_add_(0, points.ring[there], value[there].double())
        sums["lost"].index_add_(0, points.ring[~there], torch.ones_like(true)[~there])
    return {"runs": runs, "failed": failed, "lenses_m": lenses, "sums": {n: v.tolist() for n, v in sums.items()}}


Records = Sequence[dict[str, Any]]


def pooled(records: Records, name: str, index: Sequence[int] = range(len(RANGES))) -> float:
    """Root of the mean over ranges of what a sum is for each target; all draws count by their targets."""
    means = []
    for i in index:
        count = sum(r["sums"]["count"][i] for r in records)
        means.append(sum(r["sums"][name][i] for r in records) / count)
    return statistics.fmean(means) ** 0.5


def inside(records: Records, i: int | None) -> str:
    """Coverage at a range or at all, percent, ± its standard error by draws of the cameras."""
    index = range(len(RANGES)) if i is None else [i]
    shares = [sum(r["sums"]["inside"][k] for k in index) / sum(r["sums"]["count"][k] for k in index) for r in records]
    return share(shares) if len(shares) > 1 else f"{100 * shares[0]:.1f}"


def tables(records: Records) -> list[Line]:
    """Errors and coverage of all chains, and what failed."""
    rows: list[list[str]] = []
    chains = _values(records, "chain", sort=False)
    keys = [_values(records, key) for key in ("board", "pupil", "noise")]
    for board, pupil, noise in itertools.product(*keys):
        for chain in chains:
            wanted = (board, pupil, noise, chain)
            own = [r for r in records if (r["board"], r["pupil"], r["noise"], r["chain"]) == wanted]
            if own:
                corners = [f"{noise:g}"] if len(keys[2]) > 1 else []
                rows.append([board, f"{pupil:g}", *corners, chain, *_cells(own)])
    heads = [
        "board", "pupil, mm/rad²", *(["corners, px"] if len(keys[2]) > 1 else []), "chain", "lenses alone, m",
        "calibration, m", "total / bound", "in 95 %, %", "at each range, %", "without ray", "failed",
    ]  # fmt: skip
    draws = "Draws of lenses, boards and corners, by seed: " + ", ".join(map(str, _values(records, "draw"))) + "."
    return [heads, *rows, draws]


def _cells(records: Records) -> list[str]:
    """Of one chain: errors, coverage, targets without a ray, runs that failed."""
    good = [r for r in records if r["runs"]]
    runs, failed = sum(r["runs"] for r in records), sum(sum(r["failed"].values()) for r in records)
    if not good:
        return [*["–"] * 6, f"{failed} of {failed}"]
    alone = [value**2 for r in good for value in r["lenses_m"]]
    lost, counted = (sum(sum(r["sums"][name]) for r in good) for name in ("lost", "count"))
    by_range = [float(inside(good, i).split(" ")[0]) for i in range(len(RANGES))]
    return [
        f"{statistics.fmean(alone) ** 0.5:.0f}" if alone else "–",
        f"{pooled(good, 'meters', (len(RANGES) - 1,)):.0f}",
        f"{pooled(good, 'total'):.2f}",
        inside(good, None),
        f"{min(by_range):.1f} to {max(by_range):.1f}",
        f"{100 * lost / (lost + counted):.1f} %",
        f"{failed} of {runs + failed}",
    ]


def failures(records: Records) -> list[str]:
    """A table of the messages of runs that failed."""
    rows = []
    for chain in _values(records, "chain", sort=False):
        found: dict[str, int] = {}
        own = [r for r in records if r["chain"] == chain]
        for record in own:
            for message, count in record["failed"].items():
                kind = re.sub(r"\d[\d.e+-]*", "#", message)
                found[kind] = found.get(kind, 0) + count
        total = sum(r["runs"] for r in own) + sum(found.values())
        rows += [[chain, f"{count} of {total}", message[:200]] for message, count in found.items()]
    if not rows:
        return ["No run failed."]
    return [*table(["chain", "runs", "message"], rows)]


def _values(records: Records, key: str, *, sort: bool = True) -> list[Any]:
    """What a key has for values, in order or as they come."""
    found = dict.fromkeys(r[key] for r in records)
    return sorted(found) if sort else list(found)


VIEWS = 60
# Shares of the image that put a board of 5 cm squares at 1.3 to 0.55 m before a lens of f 1600 px.
FILL = (0.40, 0.94)
FAILURES = (KcalError, RuntimeError, cv2.error)


def by_kcal(**options: Any) -> Callable[[Observations], Camera]:
    return lambda seen: calibrate_camera(seen, CalibrationOptions(**options)).camera


MODELS: dict[str, Callable[[Observations], Camera]] = {
    "default": by_kcal(),
    "opencv5": by_kcal(model="opencv5"),
    "opencv14": by_kcal(model="opencv14"),
    "opencv14-warp": by_kcal(model="opencv14", board_warp=True),
    "ext20": by_kcal(model="ext20"),
    "cv8": functools.partial(opencv, coefficients=8),
    "cv14": functools.partial(opencv, coefficients=14),
    "cvRO": functools.partial(opencv, coefficients=8, release=True),
}
HOWS: tuple[How, ...] = ("held", "prior")
# A chain's name: its model and what the rig does with its cameras.
CHAINS = {
    **{f"{m}-{h}": (m, h) for m in MODELS if not m.startswith("cv") for h in HOWS},
    **{m: (m, HOWS[0]) for m in ("cv8", "cv14", "cvRO", "true")},
}


def observed(rig: TrueRig, draw: int, board: str, noise: float) -> tuple[Observations, Observations]:
    """What both cameras saw of the board of this draw."""
    points = BOARD.points if board == "exact" else printed(BOARD.points, draw)
    left, right = (
        capture(lens, VIEWS, noise, 1000 + 2 * draw + side, points, FILL)
        for side, lens in enumerate((rig.left, rig.right))
    )
    return left, right


def calibrated(model: str, rig: TrueRig, seen: tuple[Observations, Observations]) -> tuple[Camera, Camera] | str:
    """Both cameras, or why there are none."""
    if model == "true":
        return as_camera(rig.left), as_camera(rig.right)
    try:
        return MODELS[model](seen[0]), MODELS[model](seen[1])
    except FAILURES as error:
        return f"{type(error).__name__}: {error}"


def cell(draw: int, board: str, pupil: float, noise: float, *, chains: Sequence[str], marks: int, exact: int) -> Record:
    """All chains on one draw of lenses, board and corners; each camera is calibrated once."""
    rig = true_rig(draw, pupil)
    seen = observed(rig, draw, board, noise)
    points, found = targets(rig), []
    for model, group in itertools.groupby(chains, lambda chain: CHAINS[chain][0]):
        cameras = calibrated(model, rig, seen)
        for chain in group:
            record: Record = {"draw": draw, "board": board, "pupil": pupil, "noise": noise, "chain": chain}
            if isinstance(cameras, str):
                record |= {"runs": 0, "failed": {cameras: marks}, "lenses_m": [], "sums": {}}
            else:
                record |= judge(cameras, CHAINS[chain][1], rig, points, 1_000_000 + 1000 * draw, marks, exact)
            found.append(record)
    return {"chains": found}


@section("chain.md", "chain", seeds=range(300, 301), boards=("exact",), pupils=(0.0,), chains=("true",), marks=1)
def whole_chain(
    kept: Kept = NOT_KEPT, seeds: range = range(300, 310), boards: tuple[str, ...] = ("exact", "printed"),
    pupils: tuple[float, ...] = (0.0, 1.0, 3.0), noise: tuple[float, ...] = (0.05,),
    chains: tuple[str, ...] = tuple(CHAINS), marks: int = 24, exact: int = 4,
) -> list[Line]:  # fmt: skip
    """So many draws of landmarks and marks for each; of these `exact` also without noise, for the lenses alone."""
    work = torch.no_grad()(functools.partial(cell, chains=chains, marks=marks, exact=exact))
    records = kept.records(itertools.product(seeds, boards, pupils, noise), work, lambda _: "done")
    found = [one for record in records for one in record["chains"]]
    show(failures(found))
    return tables(found)


def outcome(seed: int, views: int) -> dict[str, Any]:
    """What one run of the command says with so many views of each camera, beside the truth."""
    scene = DemoScene(seed=seed, near_views=views)
    site = mock.patch.object(rooms, "DemoScene", return_value=scene)
    with site, tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        simulated_site(Path(folder), seed)
        rig = load_rig(Path(folder, "rig.json"))
    marks, targets = scene.target_marks, scene.targets
    located = locate_points(
        Localizer(rig, pixel_sigma=scene.mark_sigma), Marks.of_pair(targets.names, marks.left, marks.right)
    )
    ranges = targets.enu.norm(dim=-1).tolist()
    found = []
    for name, true, miss in zip(targets.names, ranges, position_errors(located, targets.enu), strict=True):
        if miss is None:
            found.append({"name": name, "range": true, "located": False})
        else:
            across, along, inside = miss
            found.append({"name": name, "range": true, "located": True, "across": across, "along": along, "in": inside})
    return {"targets": found}


@section("chain.md", "demo", seeds=range(100, 101), views=4)
def demo(kept: Kept = NOT_KEPT, seeds: range = range(100, 140), views: int = 20) -> Lines:
    """Coverage and errors of each target over the seeds."""
    records = kept.records([(seed, views) for seed in seeds], outcome, lambda _: "done")
    yield ["target", "range of the first seed", "located", "median error of range", "in the interval"]
    every: list[bool] = []
    for i, first in enumerate(records[0]["targets"]):
        seen = [record["targets"][i] for record in records]
        good = [target for target in seen if target["located"]]
        every += [target["in"] for target in good]
        middle = statistics.median(abs(target["along"]) for target in good)
        inside = f"{sum(target['in'] for target in good)} of {len(good)}"
        yield [first["name"], f"{first['range']:.0f} m", f"{len(good)} of {len(seen)}", f"{middle:.2f} m", inside]
    share = sum(every) / len(every)
    # Targets of one seed share its rig: seeds, not targets, are independent.
    own = [
        statistics.fmean(t["in"] for t in record["targets"] if t["located"])
        for record in records
        if any(t["located"] for t in record["targets"])
    ]
    half = 1.96 * statistics.stdev(own) / len(own) ** 0.5 if len(own) > 1 else math.nan
    yield (
        f"{len(records)} seeds: the 95 % intervals contain the true range in {100 * share:.1f} ± {100 * half:.1f} % of "
        f"{len(every)} cases (± from the scatter of seeds)."
    )
