"""Stars: real images, identification of random points, and simulated rigs, as `docs/howto/stars.md` states them.

Real images are those of `KCAL_DATA/stars` (six of one camera; esa/tetra3), compared with cedar-solve or tetra3 where
one of them is installed; elsewhere its cells stay as the page has them. *rigs*: draws of noise, survey, tape (± 2 mm),
clock (± 20 ms) and air (± 3 K), over 8 pairs of traced surveillance lenses (f 1600 px, level, 10 m apart), each
calibrated by 30 views of a printed board; stars of 0.1 px to magnitude 6 (1 pair) and 5 (20 pairs over 8 h), matches of
unknown range of 0.1 px; targets in 9 bearings along the horizon. σ and errors are of the rig alone, with exact marks.
*lens*: traced lenses with errors of assembly (webcam, machine vision, surveillance in turn), each calibrated by 20
views of a printed board (corners of 0.1 px), by 20 night images over 8 h (stars to magnitude 5 of 0.1 px), and by both.

Simulated nights: rendered images of catalog stars and what is no star; lenses and rigs under the stars.

Lenses were fitted to stars, to boards, or to both. Rigs are two cameras 10 m apart, with marks of stars, matches of
unknown range and a baseline.
"""

from __future__ import annotations

import dataclasses
import datetime
import functools
import itertools
import math
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal import Baseline, Camera, Localizer, MeasuredPosition, Origin, RigData, RigOptions, calibrate_camera, solve_rig
from kcal.calibrate.rig.marks import StarSource
from kcal.calibrate.rig.result import RigResult
from kcal.lens.projection import FAR
from kcal.locate import enu_from_cam
from kcal.rig import Effect
from kcal.sim.captures import LensLike, TrueRig, drawn_lens
from kcal.sim.truth import TruthLens
from kcal.stars import SkyView, star_source
from kcal.stars.detect import DetectedStars, detect_stars, read_night, time_of
from kcal.stars.lens import Agreement, StarCamera, calibrate_by_stars
from kcal.stars.night import Attitude, NamedStars, fit_attitude, name_stars
from kcal.stars.sky import (
    EARTH_RATE,
    Air,
    StarCatalog,
    celestial_directions,
    identify,
    observed_directions,
    pole_in_enu,
    turn_between,
)
from scripts.check.chain import ENU_FROM_RIG, Targets, landmarks, targets, true_rig
from scripts.shared.captures import BOARD, PRESCRIPTIONS, capture, error_at_infinity, printed
from scripts.shared.long_range import ORIGIN, RANGES, matches_of
from scripts.shared.page import NOT_KEPT, Kept, Lines, merged, rms, section, table, timed
from scripts.shared.real_captures import data_folder
from scripts.shared.simulated import LENSES, figures

TIME = datetime.datetime(2026, 11, 24, 4, 0, tzinfo=datetime.UTC)
PLACE = Origin(lat=40.762, lon=-113.896, height=1282.0)


def night_camera(focal: float = 900.0, size: tuple[int, int] = (960, 600)) -> Camera:
    """A pinhole camera of 56° by 37°."""
    center = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    return Camera.build(focal=(focal, focal), center=center, size=size, model="pinhole")


def star_pixels(
    camera: Camera,
    attitude: tuple[float, float, float],
    time: datetime.datetime = TIME,
    faintest: float = 5.0,
    place: Origin = PLACE,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Pixels (N, 2) and indices (N,) in the catalog of the stars in view, the brightest first."""
    catalog = StarCatalog.bundled()
    there = observed_directions(catalog, time, place)
    up = np.flatnonzero((catalog.magnitude <= faintest) & (there[:, 2] > 0.02))
    up = up[np.argsort(catalog.magnitude[up])]
    rays = torch.from_numpy(there[up]) @ enu_from_cam(*attitude)
    pixels, valid = camera.project(FAR * rays)
    seen = (valid & camera.inside(pixels)).numpy()
    return pixels.numpy()[seen], up[seen]


def rendered(
    camera: Camera, pixels: NDArray[np.float64], magnitude: NDArray[np.float64], *, seed: int = 0, full: int = 65535
) -> NDArray[np.uint16]:
    """(H, W) gray levels with stars of 1.1 px on a noisy sky; magnitude 5 is 18 times the noise of a pixel."""
    width, height = camera.size
    generator = np.random.default_rng(seed)
    image = generator.normal(600.0, 20.0, (height, width))
    around = np.arange(-8, 9)
    for (u, v), m in zip(pixels, magnitude, strict=True):
        column, row = round(u), round(v)
        if not (8 <= column < width - 8 and 8 <= row < height - 8):
            continue
        spot = np.exp(-((around[:, None] + row - v) ** 2 + (around + column - u) ** 2) / (2 * 1.1**2))
        image[row - 8 : row + 9, column - 8 : column + 9] += 360.0 * 10 ** (-0.4 * (m - 5.0)) * spot
    return np.clip(np.rint(image), 0, full).astype(np.uint16)


SIZE, STAR_PX = (1280, 800), 0.1  # px
# Shares of the image that boards fill.
FILL = (0.40, 0.94)


def true_lens() -> Camera:
    """A lens of 61° across with barrel distortion: 19 px at the corner."""
    return Camera.build(focal=(1080, 1080), center=(633.0, 405.0), size=SIZE, coefficients=[-0.08, 0.02])


def star_images(
    tilt: float, images: int, seed: int, faintest: float = 5.0, lens: LensLike | None = None
) -> tuple[list[DetectedStars], list[SkyView]]:
    """Stars of images of one fixed camera over a night, with noise, and five points that are no stars in each.

    Args:
        tilt: degrees above the horizon of the middle of the image.
        images: how many, 25 minutes apart.
        seed: of the noise.
        faintest: magnitude.
        lens: that of `true_lens` if left out.
    """
    draw, camera, catalog = np.random.default_rng(seed), lens or true_lens(), StarCatalog.bundled()
    found, views = [], []
    for number in range(images):
        time = TIME + datetime.timedelta(minutes=25 * number)
        there = observed_directions(catalog, time, PLACE)
        index = np.flatnonzero((catalog.magnitude < faintest) & (there[:, 2] > 0.1))
        index = index[np.argsort(catalog.magnitude[index])]
        rays = torch.from_numpy(there[index]) @ enu_from_cam(130.0, tilt, 1.0)
        ahead = (rays[:, 2] > 0.2).numpy()
        index, rays = index[ahead], rays[ahead]
        at, valid = camera.project(FAR * rays)
        good = (valid & camera.inside(at)).numpy()
        pixels = at.numpy()[good] + draw.normal(0, STAR_PX, (int(good.sum()), 2))
        flux = 10 ** (-0.4 * catalog.magnitude[index[good]])
        none = draw.uniform(0, 1, (5, 2)) * camera.size
        pixels, flux = np.concatenate([pixels, none]), np.concatenate([flux, np.full(5, flux.min())])
        found.append(DetectedStars(pixels, np.full(len(pixels), STAR_PX), flux, 0.02, {}))
        views.append(SkyView(time=time, origin=PLACE))
    return found, views


def lens_difference(found: StarCamera) -> np.ndarray:
    """(N,) distances in px between the found and the true lens over the image, after the best common turn."""
    error = error_at_infinity(found.lens.camera, true_lens(), columns=17, rows=11)
    return error.errors.reshape(-1, 2).norm(dim=-1).numpy()


class LensTrial(NamedTuple):
    """A calibrated lens against the traced one, at infinity over the whole image.

    Attributes:
        rms: px, after the best-fit rotation.
        largest: px.
        inside: share of the image in which the truth lies in the stated 95 % ellipse.
        chi2: of the agreement of boards and stars over its freedom; NaN where only one of them was used.
        contradiction: whether it was stated.
    """

    rms: float
    largest: float
    inside: float
    chi2: float = math.nan
    contradiction: bool = False


def compared(camera: Camera, lens: TruthLens, agreement: Agreement | None = None) -> LensTrial:
    """How far a camera is from the traced lens."""
    error = error_at_infinity(camera, lens, columns=33, rows=19)
    return LensTrial(
        rms=error.rms,
        largest=error.maximum,
        inside=figures(camera, None, error.pixels, error.errors)["everywhere"],
        chi2=math.nan if agreement is None else agreement.chi2 / max(agreement.freedom, 1),
        contradiction=agreement is not None and agreement.contradiction is not None,
    )


def lens_trials(seed: int, boards: int, images: int) -> dict[str, LensTrial]:
    """One traced lens calibrated by boards, by stars, and by both, level and tilted up by 30°."""
    lens = drawn_lens(PRESCRIPTIONS[LENSES[seed % len(LENSES)]], 1.0, seed, wander=1.0)
    seen = capture(lens, boards, 0.1, seed, printed(BOARD.points, seed), FILL)
    known = calibrate_camera(seen)
    out = {"boards": compared(known.camera, lens)}
    for tilt in (0.0, 30.0):
        stars = star_images(tilt, images, seed, lens=lens)
        name = "level" if tilt == 0.0 else f"tilted {tilt:g}°"
        alone = calibrate_by_stars(*stars, lens.size, focal=float(known.camera.params[0]))
        out[f"stars, {name}"] = compared(alone.lens.camera, lens)
        both = calibrate_by_stars(*stars, lens.size, boards=known)
        out[f"boards and stars, {name}"] = compared(both.lens.camera, lens, both.agreement)
    return out


BASELINE = 10.0  # m
LOOKS = ((40.0, 12.0, 1.0), (41.5, 12.5, -0.5))


def masts(center: Tensor, sigma: float, draw: np.random.Generator) -> tuple[MeasuredPosition, ...]:
    """The measured positions of cameras whose centers (C, 3) are known."""
    spread = torch.full((3,), sigma).double()
    return tuple(
        MeasuredPosition(camera=c, point=at + torch.from_numpy(draw.normal(0, sigma, 3)), sigma=spread)
        for c, at in enumerate(center)
    )


def scattered(count: int, draw: np.random.Generator) -> Tensor:
    """Points (N, 3) 100 to 1500 m ahead of a camera."""
    way = draw.uniform((-0.4, -0.2), (0.4, 0.2), (count, 2))
    rays = torch.nn.functional.pad(torch.from_numpy(way), (0, 1), value=1.0)
    return torch.from_numpy(draw.uniform(100, 1500, (count, 1))) * rays


def star_rig(
    camera: Camera,
    *,
    seed: int,
    named: bool,
    moments: int = 1,
    clock: float = 0.0,
    clock_sigma: float = 0.02,
    drift: float = 0.0,
    drift_sigma: float = 0.0,
    faintest: float = 5.0,
    positions: bool = True,
    matches: int = 12,
) -> tuple[RigData, Tensor, Tensor]:
    """Data of a rig, and the true rotations (2, 3, 3) and centers (2, 3) in east, north, up.

    Args:
        camera: both.
        seed: of all noise.
        named: stars with directions, or without.
        moments: pairs of images, 25 minutes apart.
        clock: seconds by which the second camera's images are late.
        clock_sigma: as stated.
        drift: seconds an hour by which it is later and later.
        drift_sigma: as stated.
        faintest: magnitude.
        positions: whether the cameras' positions are measured, to 1 cm.
        matches: features of unknown range.
    """
    draw = np.random.default_rng(seed)
    rotation = torch.stack([enu_from_cam(*look).T for look in LOOKS])
    center = torch.stack([torch.zeros(3).double(), BASELINE * enu_from_cam(*LOOKS[0])[:, 0]])
    catalog, names, pixels, direction = StarCatalog.bundled(), [], [], []
    for moment in range(moments):
        time = TIME + datetime.timedelta(minutes=25 * moment)
        late = (0.0, clock + drift * moment * 25 / 60)
        seen = [observed_directions(catalog, time + datetime.timedelta(seconds=s), PLACE) for s in late]
        index = np.flatnonzero((catalog.magnitude < faintest) & (seen[0][:, 2] > math.sin(math.radians(6.0))))
        marks = [
            camera.project(FAR * torch.from_numpy(one[index]) @ turn.T)
            for one, turn in zip(seen, rotation, strict=True)
        ]
        good = torch.stack([valid & camera.inside(at) for at, valid in marks]).all(0)
        pixels.append(torch.stack([at[good] for at, _ in marks], 1))
        direction.append(torch.from_numpy(seen[0][index])[good])
        names += [f"HR {catalog.number[i]} at {moment}" for i in index[good.numpy()]]
    clean, known = torch.cat(pixels), torch.cat(direction)
    turn = -EARTH_RATE * clock_sigma * torch.from_numpy(pole_in_enu(PLACE.lat))
    effects = [Effect(name="the clock of the second camera", turn=torch.stack([torch.zeros_like(turn), turn]))]
    if drift_sigma:
        hours = torch.tensor([int(name.split()[-1]) * 25 / 60 for name in names]).double()
        each = effects[0].turn
        assert each is not None
        effects.append(Effect(name="its drift", turn=each * drift_sigma / clock_sigma, factor=hours))
    stars = StarSource(
        names=tuple(names),
        pixels=clean + torch.from_numpy(draw.normal(0, STAR_PX, clean.shape)),
        pixel_sigma=torch.full(clean.shape[:2], STAR_PX).double(),
        direction=known if named else torch.full_like(known, torch.nan),
        direction_sigma=torch.full((len(names),), 5e-6 if named else math.inf).double(),
        effects=tuple(effects),
    )
    features = None
    if matches:
        points = scattered(matches, draw) @ rotation[0]
        at = torch.stack([camera.project((points - c) @ r.T)[0] for r, c in zip(rotation, center, strict=True)], 1)
        features = matches_of(at + torch.from_numpy(draw.normal(0, 0.1, at.shape)), pixel_sigma=0.1)
    places = masts(center, 0.01, draw)
    data = RigData(
        cameras=(camera, camera),
        names=("left", "right"),
        stars=stars,
        features=features,
        baselines=(Baseline(first=0, second=1, length=BASELINE + draw.normal(0, 0.002), sigma=0.002),),
        positions=places if positions else (),
    )
    return data, rotation, center


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
    detected, seconds = map(list, zip(*(timed(detect_stars, read_night(path)) for path in files), strict=True))
    size = (1024, 768)
    whole, spent_on_lens = timed(calibrate_by_stars, detected, views, size)
    lens = whole.lens
    theirs = peer(files)
    rows, said = [], []
    for path, view in zip(files, views, strict=True):
        found, spent = timed(name_stars, read_night(path), lens.camera, view)
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


def by_magnitude(whole: StarCamera) -> Lines:
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
        found, spent = timed(solver.solve_from_image, Image.open(path), fov_estimate=11.4, fov_max_error=1.0)
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
