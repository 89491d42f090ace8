"""Simulated nights: rendered images of catalog stars and what is no star; lenses and rigs under the stars.

Lenses were fitted to stars, to boards, or to both. Rigs are two cameras 10 m apart, with marks of stars, matches of
unknown range and a baseline.
"""

from __future__ import annotations

import datetime
import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal import Baseline, Camera, MeasuredPosition, Origin, RigData, calibrate_camera
from kcal.calibrate.rig.marks import StarSource
from kcal.lens.projection import FAR
from kcal.locate import enu_from_cam
from kcal.rig import Effect
from kcal.sim.captures import LensLike, drawn_lens
from kcal.sim.truth import TruthLens
from kcal.stars import SkyView
from kcal.stars.detect import DetectedStars
from kcal.stars.lens import Agreement, StarCamera, calibrate_by_stars
from kcal.stars.sky import EARTH_RATE, StarCatalog, observed_directions, pole_in_enu
from scripts.shared.infinity import error_at_infinity
from scripts.shared.long_range import matches_of
from scripts.shared.prescriptions import PRESCRIPTIONS
from scripts.shared.simulated import LENSES, figures
from scripts.shared.traced import BOARD, capture, printed

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


SIZE, STAR = (1280, 800), 0.1  # px
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
        pixels = at.numpy()[good] + draw.normal(0, STAR, (int(good.sum()), 2))
        flux = 10 ** (-0.4 * catalog.magnitude[index[good]])
        none = draw.uniform(0, 1, (5, 2)) * camera.size
        pixels, flux = np.concatenate([pixels, none]), np.concatenate([flux, np.full(5, flux.min())])
        found.append(DetectedStars(pixels, np.full(len(pixels), STAR), flux, 0.02, {}))
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
        pixels=clean + torch.from_numpy(draw.normal(0, STAR, clean.shape)),
        pixel_sigma=torch.full(clean.shape[:2], STAR).double(),
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
