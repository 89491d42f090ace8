"""Simulated lenses under the stars: the error of a lens that was fitted to them, to boards, or to both."""

from __future__ import annotations

import datetime
import math
from typing import NamedTuple

import numpy as np
import torch

from kcal import Camera, calibrate_camera
from kcal.lens import pixel_covariance
from kcal.lens.projection import FAR
from kcal.locate import enu_from_cam
from kcal.sim.captures import LensLike, drawn_lens
from kcal.sim.truth import TruthLens
from kcal.stars import SkyView
from kcal.stars.detect import DetectedStars
from kcal.stars.lens import Agreement, StarCamera, calibrate_by_stars
from kcal.stars.sky import StarCatalog, observed_directions
from scripts.shared.infinity import error_at_infinity
from scripts.shared.night_scenes import PLACE, TIME
from scripts.shared.prescriptions import PRESCRIPTIONS
from scripts.shared.simulated import CHI2, LENSES
from scripts.shared.traced import BOARD, capture, printed

SIZE, STAR = (1280, 800), 0.1  # px
LENSES_FROM = ["boards", *(f"{what}, {where}" for where in ("level", "tilted 30°")
                           for what in ("stars", "boards and stars"))]  # fmt: skip
# Shares of the image that boards fill.
FILL = (0.40, 0.94)


def true_lens() -> Camera:
    """A lens of 61° across with barrel distortion: 19 px at the corner."""
    camera = Camera.build(focal=(1080, 1080), center=(633.0, 405.0), size=SIZE, model="opencv5")
    parameters = camera.params.detach().clone()
    parameters[list(camera.names).index("k1")] = -0.08
    parameters[list(camera.names).index("k2")] = 0.02
    return camera.with_parameters(parameters)


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
    return (
        error_at_infinity(found.lens.camera, true_lens(), columns=17, rows=11)
        .errors.reshape(-1, 2)
        .norm(dim=-1)
        .numpy()
    )


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
    off, at = error.errors.reshape(-1, 2), error.pixels.reshape(-1, 2)
    covariance = pixel_covariance(camera, at)
    good = off.isfinite().all(-1) & covariance.isfinite().all(-1).all(-1)
    square = (off[good] * torch.linalg.solve(covariance[good], off[good])).sum(-1)
    return LensTrial(
        rms=error.rms,
        largest=error.maximum,
        inside=float((square < CHI2).double().mean()),
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
