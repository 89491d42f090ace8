"""A simulated lens under the stars: the error of a lens that was fitted to them."""

from __future__ import annotations

import datetime

import numpy as np
import torch

from kcal.lens.camera import Camera
from kcal.locate.geodesy import enu_from_cam
from kcal.stars.attitude import FAR
from kcal.stars.catalog import StarCatalog
from kcal.stars.detect import DetectedStars
from kcal.stars.lens import StarCamera, calibrate_by_stars
from kcal.stars.night import SkyView
from kcal.stars.sky import observed_directions
from scripts.shared.night_scenes import PLACE, TIME

SIZE = (1280, 800)


def true_lens() -> Camera:
    """A lens of 61° across with barrel distortion: 19 px at the corner."""
    camera = Camera.build(focal=(1080, 1080), center=(633.0, 405.0), size=SIZE, model="opencv5")
    parameters = camera.params.detach().clone()
    parameters[list(camera.names).index("k1")] = -0.08
    parameters[list(camera.names).index("k2")] = 0.02
    return camera.with_parameters(parameters)


def star_images(
    tilt: float, images: int, seed: int, sigma: float = 0.1, faintest: float = 5.0
) -> tuple[list[DetectedStars], list[SkyView]]:
    """Stars of images of one fixed camera over a night, with noise, and five points that are no stars in each."""
    draw, camera, catalog = np.random.default_rng(seed), true_lens(), StarCatalog.bundled()
    found, views = [], []
    for number in range(images):
        time = TIME + datetime.timedelta(minutes=25 * number)
        there = observed_directions(catalog, time, PLACE)
        index = np.flatnonzero((catalog.magnitude < faintest) & (there[:, 2] > 0.1))
        index = index[np.argsort(catalog.magnitude[index])]
        at, valid = camera.project(FAR * torch.from_numpy(there[index]) @ enu_from_cam(130.0, tilt, 1.0))
        good = (valid & camera.inside(at)).numpy()
        pixels = at.numpy()[good] + draw.normal(0, sigma, (int(good.sum()), 2))
        flux = 10 ** (-0.4 * catalog.magnitude[index[good]])
        none = draw.uniform(0, 1, (5, 2)) * SIZE
        pixels, flux = np.concatenate([pixels, none]), np.concatenate([flux, np.full(5, flux.min())])
        found.append(DetectedStars(pixels, np.full(len(pixels), sigma), flux, 0.02, {}))
        views.append(SkyView(time=time, origin=PLACE))
    return found, views


def lens_difference(found: StarCamera) -> np.ndarray:
    """(N,) distances in px between the found and the true lens over the image, after the best common turn."""
    truth, camera = true_lens(), found.lens.camera
    grid = truth.grid(17, 11).reshape(-1, 2)
    rays = truth.unproject(grid)[0]
    mine = camera.unproject(grid)[0]
    rays, mine = (one / one.norm(dim=-1, keepdim=True) for one in (rays, mine))
    u, _, vt = torch.linalg.svd(mine.T @ rays)
    turn = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.linalg.det(u @ vt))]).double()) @ vt
    at, _ = camera.project(FAR * rays @ turn.T)
    return (at - grid).norm(dim=-1).numpy()


def lens_error(tilt: float, seed: int) -> str:
    """What a lens from twenty images differs by from the truth."""
    found = calibrate_by_stars(*star_images(tilt, 20, seed), SIZE)
    error = lens_difference(found)
    count = sum(int(use.sum()) for use in found.lens.used)
    rms, largest = np.sqrt((error**2).mean()), error.max()
    return f"{count} stars, RMS {rms:.3f} px at infinity over the image, largest {largest:.2f}"
