"""Stars: real images, identification of random points, and simulated rigs, as `docs/howto/stars.md` states them.

Real images are those of `KCAL_DATA/stars` (six of one camera; esa/tetra3), compared with cedar-solve or tetra3 where
one of them is installed; elsewhere its cells stay as the page has them. *rigs*: draws of noise, survey, tape (± 2 mm),
clock (± 20 ms) and air (± 3 K), over 8 pairs of traced surveillance lenses (f 1600 px, level, 10 m apart), each
calibrated by 30 views of a printed board; stars of 0.1 px to magnitude 6 (1 pair) and 5 (20 pairs over 8 h), matches of
unknown range of 0.1 px; targets in 9 bearings along the horizon. σ and errors are of the rig alone, with exact marks.
*lens*: traced lenses with errors of assembly (webcam, machine vision, surveillance in turn), each calibrated by 20
views of a printed board (corners of 0.1 px), by 20 night images over 8 h (stars to magnitude 5 of 0.1 px), and by both.
"""

from __future__ import annotations

import dataclasses
import datetime
import functools
import itertools
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal import Baseline, Camera, Localizer, MeasuredPosition, RigData, calibrate_camera
from kcal.calibrate.rig.marks import StarSource
from kcal.calibrate.rig.result import RigResult
from kcal.calibrate.rig.solve import RigOptions, solve_rig
from kcal.lens.projection import FAR
from kcal.lens.rig import Origin
from kcal.sim.captures import TrueRig
from kcal.stars import star_source
from kcal.stars.detect import DetectedStars, detect_stars, read_night, time_of
from kcal.stars.lens import StarCamera, calibrate_by_stars
from kcal.stars.night import Attitude, NamedStars, SkyView, fit_attitude, name_stars
from kcal.stars.sky import Air, StarCatalog, celestial_directions, identify, observed_directions, turn_between
from scripts.check.chain_rig import ENU_FROM_RIG, Targets, landmarks, targets, true_rig
from scripts.shared.long_range import ORIGIN, RANGES, matches_of
from scripts.shared.night_scenes import PLACE, TIME, lens_trials, masts, scattered, star_images
from scripts.shared.page import Lines, merged, table
from scripts.shared.real_captures import data_folder
from scripts.shared.sections import NOT_KEPT, Kept, section
from scripts.shared.timing import rms
from scripts.shared.traced import BOARD, capture, printed

CLOCK_SIGMA, AIR_SIGMA, STAR, MARK = 0.02, 3.0, 0.1, 0.1  # s, K, px, px
TAPE, MAST, MATCHES = 0.002, 0.01, 12  # m, m
PAIRS_OF_LENSES = 8
AT = (1000.0, 2000.0, 5000.0)
# Shares of the image that boards fill, and views.
_FILL, _VIEWS = (0.40, 0.94), 30
_HORIZON = 40.0  # px
_LOWEST = math.sin(math.radians(6.0))
STRAIGHT = RigOptions(refraction=0.0, refraction_sigma=0.0)


class Case(NamedTuple):
    """What a rig is solved from: surveyed landmarks, or pairs of night images with named stars or without names."""

    landmarks: bool = False
    pairs: int = 0
    named: bool = False
    lenses: str = "boards"


CASES = {
    "12 landmarks ± 2 cm": Case(landmarks=True),
    "1 pair, unnamed, 12 matches": Case(pairs=1),
    "1 pair, named, masts ± 1 cm": Case(pairs=1, named=True),
    "20 pairs, unnamed, 12 matches": Case(pairs=20),
    "20 pairs, named, masts ± 1 cm": Case(pairs=20, named=True),
    "the same, lenses by boards and 20 images tilted by 30°": Case(pairs=20, named=True, lenses="stars"),
}


class Lenses(NamedTuple):
    """Two traced lenses, their calibrations by boards, and targets at `AT`."""

    rig: TrueRig
    cameras: tuple[Camera, Camera]
    targets: Targets


@functools.cache
def lenses(number: int, by: str = "boards") -> Lenses:
    """The lenses of a draw, each calibrated by views of one printed board, or by these and stars."""
    rig = true_rig(number, 1.0)
    board = printed(BOARD.points, number)
    cameras = []
    for side, lens in enumerate((rig.left, rig.right)):
        found = calibrate_camera(capture(lens, _VIEWS, 0.1, 1000 + 2 * number + side, board, _FILL))
        if by == "stars":
            stars = star_images(30.0, 20, 1000 + 2 * number + side, lens=lens)
            joint = calibrate_by_stars(*stars, lens.size, boards=found).joint
            assert joint is not None
            found = joint
        cameras.append(found.camera)
    seen = targets(rig)
    kept = torch.isin(seen.ring, torch.tensor([RANGES.index(distance) for distance in AT]))
    # Where targets so far away are: along the horizon.
    kept &= (seen.pixels[0, :, 1] - 0.5 * (rig.left.size[1] - 1)).abs() < _HORIZON
    some = Targets(seen.ring[kept], seen.inverse[kept], seen.pixels[:, kept], seen.bound[kept])
    return Lenses(rig, (cameras[0], cameras[1]), some)


def _poses(rig: TrueRig) -> tuple[Tensor, Tensor]:
    """(2, 3, 3) cameras from east, north, up, and (2, 3) their centers."""
    right = rig.right_from_left_rotation
    rotation = torch.stack([ENU_FROM_RIG.T, right @ ENU_FROM_RIG.T])
    return rotation, torch.stack([torch.zeros(3).double(), -rig.right_from_left_translation @ rotation[1]])


def night(rig: TrueRig, cameras: tuple[Camera, Camera], case: Case, draw: np.random.Generator) -> StarSource:
    """Stars of a night; the right clock and the air are drawn from what is stated of them."""
    catalog, late = StarCatalog.bundled(), float(draw.normal(0, CLOCK_SIGMA))
    there = Air.at_height(PLACE.height, celsius=10.0 + draw.normal(0, AIR_SIGMA))
    stated = Air.at_height(PLACE.height, celsius_sigma=AIR_SIGMA, hectopascal_sigma=1.0)
    bright = StarCatalog(**{
        field.name: getattr(catalog, field.name)[catalog.magnitude < (6.0 if case.pairs == 1 else 5.0)]
        for field in dataclasses.fields(catalog)
    })  # fmt: skip
    rotation, _ = _poses(rig)
    moments = []
    for number in range(case.pairs):
        time = TIME + datetime.timedelta(minutes=25 * number)
        if case.named:
            view = SkyView(time=time, origin=PLACE, air=stated, dut1=0.0, time_sigma=0.1)
            known = view.directions(bright)
        else:
            view = SkyView(time=time)
            known = celestial_directions(bright, time)
        moment = {}
        for side, lens in enumerate((rig.left, rig.right)):
            moved = time + datetime.timedelta(seconds=late * side)
            seen = observed_directions(bright, moved, PLACE, there)
            rays = torch.from_numpy(seen) @ rotation[side].T
            up = np.flatnonzero((seen[:, 2] > _LOWEST) & (rays[:, 2] > 0.3).numpy())
            at, valid = lens.project(FAR * rays[up])
            inside = (valid & lens.inside(at)).numpy()
            index = up[inside]
            pixels = at.numpy()[inside] + draw.normal(0, STAR, (len(index), 2))
            # Of stars without names, the frame is that of the catalog.
            own = np.eye(3) if case.named else turn_between(known[index], seen[index])
            moment[side] = NamedStars(
                detected=DetectedStars(pixels, np.full(len(index), STAR), np.ones(len(index)), 0.02, {}),
                view=view,
                attitude=Attitude(
                    rotation=rotation[side] @ torch.from_numpy(own), covariance=torch.zeros(3, 3).double(), star=index,
                    residual=np.zeros((len(index), 2)), rms_px=STAR, widened=1.0,
                ),
                directions=known,
                on_earth=case.named,
                covariance=torch.zeros(3, 3).double(),
                warnings=(),
            )  # fmt: skip
        moments.append(moment)
    return star_source(moments, cameras, clock_sigma=CLOCK_SIGMA, origin=PLACE if case.named else None, catalog=bright)


def data_of(made: Lenses, case: Case, seed: int) -> RigData:
    """What the rig is solved from: the case's source, and a taped baseline."""
    rig, cameras, _ = made
    draw, generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    _, center = _poses(rig)
    length = float(rig.baseline) + draw.normal(0, TAPE)
    data = RigData(
        cameras=cameras, names=("left", "right"),
        baselines=(Baseline(first=0, second=1, length=length, sigma=TAPE),),
        landmarks=landmarks(rig, generator)[0] if case.landmarks else None,
    )  # fmt: skip
    if case.landmarks:
        return data
    features = None
    positions: tuple[MeasuredPosition, ...] = ()
    if case.named:
        positions = masts(center, MAST, draw)
    else:
        left, right = rig(scattered(MATCHES, draw))[0].unbind(-2)
        marks = torch.stack([left, right], 1)
        features = matches_of(marks + torch.from_numpy(draw.normal(0, MARK, marks.shape)), pixel_sigma=MARK)
    return dataclasses.replace(data, stars=night(rig, cameras, case, draw), features=features, positions=positions)


def trial(number: int, case: Case, seed: int) -> np.ndarray:
    """Solve a rig and judge its ranges.

    Returns:
        (3, 4): for each of `AT` the mean squares of σ and of errors as shares of the range, both of the rig alone, and
            the shares of targets in the 95 % interval, of the rig alone and with marks of 0.1 px.
    """
    made = lenses(number, case.lenses)
    return judged(solve_rig(data_of(made, case, seed), STRAIGHT), made.targets, seed)


def judged(found: RigResult, there: Targets, seed: int) -> np.ndarray:
    """See `trial`."""
    pair = found.stereo()
    generator = torch.Generator().manual_seed(seed)
    columns = []
    for sigma in (1e-4, MARK):
        marks = there.pixels
        if sigma == MARK:
            marks = marks + MARK * torch.randn(marks.shape, dtype=torch.float64, generator=generator)
        answer = Localizer(pair.placed(origin=ORIGIN, heading_deg=35.0), pixel_sigma=sigma)(*marks)
        inside = (answer.range_low <= 1 / there.inverse) & (1 / there.inverse <= answer.range_high)
        if sigma != MARK:
            columns += [
                (answer.inverse_range_sigma / there.inverse).square(),
                (answer.inverse_range / there.inverse - 1.0).square(),
            ]
        columns.append(inside.double())
    table = torch.stack(columns, -1)
    return torch.stack([table[there.ring == RANGES.index(distance)].mean(0) for distance in AT]).numpy()


DELFT = Origin(lat=52.0, lon=4.37, height=0.0)
SIZES = {(1600.0, (1920, 1080)), (5110.0, (1024, 768)), (900.0, (1280, 800))}


@section("stars.md", "real", images=2)
def real(images: int = 6) -> Lines:
    """So many real images: names, times, one lens, residuals by magnitude, and each image predicted by the others."""
    files = sorted((data_folder() / "stars").glob("*.png"))[:images]
    views = [SkyView(time=time_of("name:Z", path), origin=DELFT) for path in files]
    detected, seconds = [], []
    for path in files:
        image = read_night(path)
        begin = time.process_time()
        detected.append(detect_stars(image))
        seconds.append(time.process_time() - begin)
    size = (1024, 768)
    begin = time.process_time()
    whole = calibrate_by_stars(detected, views, size)
    spent_on_lens, lens = time.process_time() - begin, whole.lens
    theirs = peer(files)
    rows, said = [], []
    for path, view in zip(files, views, strict=True):
        image = read_night(path)
        begin = time.process_time()
        found = name_stars(image, lens.camera, view)
        spent = time.process_time() - begin
        stars = found.attitude
        told = theirs.get(path, [None, None, None])
        name = path.stem.split("_", 1)[-1]
        rows.append([name, len(found.detected.pixels), stars.count, f"{stars.rms_px:.3f}", f"{spent:.2f}", *told])
        said += [f"{path.stem}: {text}" for text in found.warnings]
    heads = ["image", "stars", "named", "RMS px", "detect and name, CPU s", "cedar-solve: stars", "its RMSE", "CPU s"]
    yield from merged("stars.md", "real", heads, rows)
    yield from ["", *said, ""]
    yield from table(["magnitude", "stars", "RMS along an axis, px"], by_magnitude(whole))
    yield from ["", f"detection {np.mean(seconds):.2f} CPU s an image; lens and names {spent_on_lens:.0f}"]
    focal = float(lens.camera.params[0])
    yield (
        f"{len(whole.images)} of {len(files)} images, {sum(int(u.sum()) for u in lens.used)} stars, "
        f"{sum(int((~u).sum()) for u in lens.used)} left out, RMS along an axis {lens.rms_px:.4f} px, "
        f"{lens.effective:.1f} effective unknowns, f {focal:.2f} px"
    )
    yield held_out(detected, views, size, focal)


def by_magnitude(whole: StarCamera) -> Iterator[list[str]]:
    """RMS residual of the stars of each magnitude."""
    magnitude = np.concatenate([StarCatalog.bundled().magnitude[star] for star in whole.stars])
    error = torch.cat(whole.lens.residuals).numpy()
    for low, high in ((-2, 4), (4, 5), (5, 6), (6, 8)):
        some = (magnitude >= low) & (magnitude < high)
        if some.any():
            yield [f"{low} to {high}", f"{some.sum()}", f"{rms(error[some]):.3f}"]


def held_out(images: list, views: list, size: tuple[int, int], focal: float) -> str:
    """One lens of five images predicts the sixth: its attitude by every other star, residuals of the others."""
    catalog, errors = StarCatalog.bundled(), []
    for out in range(len(images)):
        rest = [k for k in range(len(images)) if k != out]
        camera = calibrate_by_stars([images[k] for k in rest], [views[k] for k in rest], size, focal=focal).lens.camera
        named = name_stars(images[out], camera, views[out])
        use = np.flatnonzero(named.attitude.star >= 0)
        directions = named.directions
        for half in (0, 1):
            ours, theirs = use[half::2], use[1 - half :: 2]
            best = fit_attitude(
                images[out].pixels[ours], images[out].sigma[ours], directions, catalog.magnitude, camera,
                named.attitude.rotation.numpy(),
            )  # fmt: skip
            if best is None:
                continue
            at, _ = camera.project(1e9 * torch.from_numpy(directions[named.attitude.star[theirs]]) @ best.rotation.T)
            errors.append(at.numpy() - images[out].pixels[theirs])
    error = np.concatenate(errors)
    middle = np.median(np.linalg.norm(error, axis=1))
    return (
        f"held out: {len(error)} stars of {len(images)} images, RMS along an axis {rms(error):.3f} px, median distance "
        f"{middle:.3f} px"
    )


def peer(files: list[Path]) -> dict[Path, list[str]]:
    """Cells of the table: cedar-solve or tetra3 on the same images; nothing where neither is installed."""
    try:
        import tetra3  # type: ignore[import-not-found, unused-ignore]
    except ImportError:
        return {}
    from PIL import Image

    np.math = math  # type: ignore[attr-defined]  # cedar-solve 0.5 uses what numpy 2 does not have
    solver, told = tetra3.Tetra3(), {}
    for path in files:
        begin = time.process_time()
        found = solver.solve_from_image(Image.open(path), fov_estimate=11.4, fov_max_error=1.0)
        spent = time.process_time() - begin
        rmse = found.get("RMSE")
        told[path] = [str(found.get("Matches")), "" if rmse is None else f"{rmse:.1f}″", f"{spent:.2f}"]
    return told


@section("stars.md", "random", count=2)
def random_points(count: int = 10_000) -> Lines:
    """False names of random points: of 4 to 20 points each, seen by three cameras in turn."""
    generator, wrong, begin = np.random.default_rng(34), 0, time.process_time()
    cameras = sorted(SIZES)
    for number in range(count):
        focal, size = cameras[number % len(cameras)]
        pixels = generator.random((int(generator.integers(4, 21)), 2)) * size
        rays = np.c_[(pixels - np.array(size) / 2) / focal, np.ones(len(pixels))]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        field = 2 * math.atan(math.hypot(*size) / 2 / focal)
        wrong += identify(rays, 2.5 / focal, field=field) is not None
    spent = (time.process_time() - begin) / count
    yield f"{count} fields of 4 to 20 random points: {wrong} with names; {spent:.2f} CPU s each"


def rig_trial(case: str, seed: int) -> dict[str, Any]:
    return {"squares": trial(200 + seed % PAIRS_OF_LENSES, CASES[case], seed).tolist()}


@section("stars.md", "rigs", seeds=range(1), cases=tuple(CASES)[1:2])
def rigs(kept: Kept = NOT_KEPT, seeds: range = range(30), cases: tuple[str, ...] = tuple(CASES)) -> Lines:
    """Ranges of rigs behind traced lenses that boards calibrated: errors, and coverage of their 95 % intervals."""
    records = kept.records(itertools.product(cases, seeds), rig_trial, lambda _: "done")
    yield [
        "rig from a taped baseline and", "σ, % of range at 1, 2, 5 km", "RMS error", "error over σ",
        "truth in the rig's 95 %", "with marks by day ± 0.1 px",
    ]  # fmt: skip
    for name in cases:
        mean = np.mean([one["squares"] for one in records if one["key"][0] == name], axis=0)
        parts = (
            (np.sqrt(mean[:, 0]), 100, 2), (np.sqrt(mean[:, 1]), 100, 2), (np.sqrt(mean[:, 1] / mean[:, 0]), 1, 2),
            (mean[:, 2], 100, 0), (mean[:, 3], 100, 0),
        )  # fmt: skip
        cells = [" / ".join(f"{factor * v:.{digits}f}" for v in values) for values, factor, digits in parts]
        yield [name, *cells]


def lens_trial(_: str, *of: int) -> dict[str, Any]:
    return {name: list(trial) for name, trial in lens_trials(*of).items()}


@section("stars.md", "lens", seeds=range(2, 3), boards=5, images=2)
def lens(kept: Kept = NOT_KEPT, seeds: range = range(6), boards: int = 20, images: int = 20) -> Lines:
    """A lens from boards, stars, and both, against the traced one at infinity; level and tilted by 30°."""
    records = kept.records([("lens", seed, boards, images) for seed in seeds], lens_trial, lambda _: "done")
    yield [
        "from", "error at infinity, px: median of the RMS", "largest RMS", "largest anywhere", "inside 95 %",
        "χ² of boards against stars, over its freedom", "contradictions",
    ]  # fmt: skip
    for name in [name for name in records[0] if name != "key"]:
        trials = [one[name] for one in records if name in one]
        error, largest, inside, chi2, contradiction = (np.array(column) for column in zip(*trials, strict=True))
        told = [f"{chi2.mean():.2f}", contradiction.sum()] if np.isfinite(chi2).all() else ["", ""]
        shown = [f"{np.median(error):.4f}", f"{error.max():.4f}", f"{largest.max():.3f}"]
        yield [name, *shown, f"{100 * inside.mean():.1f} %", *told]
