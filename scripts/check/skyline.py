"""Attitude from skylines in simulation: errors over their σ, coverage, what trees and wrong statements do."""

from __future__ import annotations

import functools
import math
import time
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from kcal import Camera, KcalError, MeasuredPosition, Origin, RigData, calibrate_camera, solve_rig
from kcal.calibrate.rig.result import RigResult
from kcal.lens.pose import step_rows
from kcal.lens.projection import project_components
from kcal.rig import RasterError, SkylineImage, skyline_attitude, skyline_source
from scripts.shared.page import Lines
from scripts.shared.sections import NOT_KEPT, Kept, section
from scripts.shared.skyline_scenes import (
    HERE,
    Ground,
    Site,
    angle_errors,
    exact_camera,
    lens_of,
    measured_place,
    picture,
    raster_of,
    site_of,
    true_directions,
)
from scripts.shared.traced import capture

Floats = NDArray[np.float64]
NATIONAL = RasterError(sigma=1.0, correlation=150.0, offset=0.5)
GROUNDS = {
    "20 m cells, 1 m RMS": Ground(cell=20.0, error=NATIONAL),
    "30 m cells, 2 m RMS (the default)": Ground(cell=30.0, error=RasterError()),
    "20 m, 1 m; place ± 3 m": Ground(cell=20.0, error=NATIONAL, place=3.0),
    "20 m, 1 m; woods of 12 m on a third, not in the raster": Ground(cell=20.0, error=NATIONAL, trees=12.0),
}
LENSES, FOCAL = 3, 800.0
_FAR = 1e9


def alone(_: str, seed: int, *, grounds: tuple[str, ...]) -> dict[str, Any]:
    """Errors and sigmas of heading, pitch, roll of one image before each raster; what was said where it was refused."""
    found: dict[str, Any] = {}
    number = seed % LENSES
    pictures = {}
    for name in grounds:
        ground = GROUNDS[name]
        site = site_of(seed, ground.trees)
        if ground.trees not in pictures:
            pictures[ground.trees] = picture(site, lens_of(number)).image
        raster = raster_of(site.hills, ground, seed)
        place = measured_place(site, ground, seed)
        begin = time.process_time()
        try:
            seen = skyline_attitude(
                pictures[ground.trees], exact_camera(number), place, raster,
                place_sigma=tuple(ground.place_sigma.tolist()), error=ground.error,
            )  # fmt: skip
        except KcalError as error:
            found[name] = str(error)
            continue
        spent = time.process_time() - begin
        off = angle_errors((seen.heading_deg, seen.pitch_deg, seen.roll_deg), site)
        raster_share = [float(value) for value in seen.shares["raster"]]
        found[name] = [*off.tolist(), *seen.sigma_deg.tolist(), *raster_share, spent, float(seen.used.mean())]
    return found


CASES = ("left", "right against left")


def rigs(kind: str, seed: int, views: int) -> dict[str, Any]:
    """Errors and sigmas of where calibrated cameras look, in pixels: (across, up) at three pixels of the skyline."""
    ground = Ground(cell=20.0, error=NATIONAL, place=0.02)
    site = site_of(seed)
    numbers = 2 * (seed % 2), 2 * (seed % 2) + 1
    cameras = _calibrated(numbers[0], views), _calibrated(numbers[1], views)
    heading = math.radians(site.angles[0])
    aside = 10.0 * np.array([math.cos(heading), -math.sin(heading), 0.0])
    sites = site, site._replace(eye=site.eye + aside, angles=(site.angles[0] + 0.3, *site.angles[1:]))
    raster = raster_of(site.hills, ground, seed)
    sigma = torch.from_numpy(np.stack([ground.place_sigma] * 2))
    off = torch.from_numpy(np.random.default_rng([seed, 31]).standard_normal((2, 3)))
    centers = torch.from_numpy(np.stack([np.zeros(3), aside])) + sigma * off
    images = [
        SkylineImage(name=CASES[side], camera=side, image=picture(sites[side], lens_of(number), side).image)
        for side, number in enumerate(numbers)
    ]
    places = tuple(MeasuredPosition(camera=c, point=centers[c], sigma=sigma[c]) for c in (0, 1))
    origin = Origin(lat=HERE[0], lon=HERE[1], height=float(site.eye[2]))
    try:
        source, _ = skyline_source(images, cameras, raster, origin, centers, sigma, error=ground.error)
        result = solve_rig(RigData(cameras=cameras, names=("left", "right"), positions=places, skyline=source))
    except KcalError as error:
        return dict.fromkeys(CASES, str(error))
    (left, off_left), (right, off_right) = (_pointing(result, c, sites[c], numbers[c]) for c in (0, 1))
    return {
        CASES[0]: [*off_left.tolist(), *_sigmas(result, left).tolist()],
        CASES[1]: [*(off_right - off_left).tolist(), *_sigmas(result, right - left).tolist()],
    }


@functools.cache
def _calibrated(number: int, views: int) -> Camera:
    """A lens calibrated by views of a printed board with corners of 0.1 px."""
    return calibrate_camera(capture(lens_of(number), views, 0.1, number)).camera


def _pointing(result: RigResult, c: int, site: Site, number: int) -> tuple[torch.Tensor, Floats]:
    """(6, S) and (6,) px: where a camera sees the true directions of three pixels, across and down, less these."""
    problem, state = result._solution.problem, result._solution.state
    posed = problem.posed(state)[c]
    width, height = posed.camera.size
    pixels = torch.tensor([[share * width, 0.45 * height] for share in (0.15, 0.5, 0.85)]).double()
    toward = true_directions(site, lens_of(number), pixels)
    turned = _FAR * posed.rotation @ toward.T
    wanted = range(len(posed.parameters))
    seen = project_components(turned, posed.parameters, posed.camera.model, wanted)
    rows = torch.zeros(6, problem.shared_size).double()
    rows[:, : posed.by_unknown.shape[1]] = seen.by_camera.flatten(1).T @ posed.by_unknown
    assert posed.turn is not None
    rows[:, posed.turn] += step_rows(seen.by_point, turned)[:3].flatten(1).T
    return rows, (seen.pixels - pixels.T).flatten().numpy()


def _sigmas(result: RigResult, rows: torch.Tensor) -> Floats:
    found: Floats = result._solution.variances(rows).sqrt().numpy()
    return found


@section("skyline.md", "alone", seeds=range(1), grounds=tuple(GROUNDS)[1:2])
def told_alone(kept: Kept = NOT_KEPT, seeds: range = range(30), grounds: tuple[str, ...] = tuple(GROUNDS)) -> Lines:
    work = functools.partial(alone, grounds=grounds)
    records = kept.records([("alone", seed) for seed in seeds], work, lambda _: "done")
    yield [
        "raster", "RMS error of heading / pitch / roll, °", "median σ", "error over σ", "truth in the 95 %",
        "of the heading's variance the raster's", "columns used", "refused", "CPU s",
    ]  # fmt: skip
    for name in grounds:
        trials = [one[name] for one in records if one["key"][0] == "alone"]
        good = np.array([trial for trial in trials if not isinstance(trial, str)])
        error, sigma = good[:, :3], good[:, 3:6]
        ratio = error / sigma
        yield [
            name, _three(np.sqrt((error**2).mean(0)), 4), _three(np.median(sigma, 0), 4),
            _three(np.sqrt((ratio**2).mean(0)), 2), _three(100 * (np.abs(ratio) < 1.96).mean(0), 0) + " %",
            f"{100 * good[:, 6].mean():.0f} %", f"{100 * good[:, 10].mean():.0f} %", len(trials) - len(good),
            f"{np.median(good[:, 9]):.1f}",
        ]  # fmt: skip


@section("skyline.md", "rigs", seeds=range(1), views=8)
def told_rigs(kept: Kept = NOT_KEPT, seeds: range = range(30), views: int = 30) -> Lines:
    records = kept.records([("rigs", seed, views) for seed in seeds], rigs, lambda _: "done")
    yield ["which way", "RMS error across / up, °", "RMS σ", "error over σ", "truth in the 95 %", "refused"]
    degree = math.degrees(1.0 / FOCAL)
    for name in CASES:
        trials = [one[name] for one in records if one["key"][0] == "rigs"]
        good = np.array([trial for trial in trials if not isinstance(trial, str)]).reshape(-1, 2, 2, 3)
        error, sigma = good[:, 0].transpose(1, 0, 2).reshape(2, -1), good[:, 1].transpose(1, 0, 2).reshape(2, -1)
        ratio = error / sigma
        yield [
            name, _three(degree * np.sqrt((error**2).mean(1)), 4), _three(degree * np.sqrt((sigma**2).mean(1)), 4),
            _three(np.sqrt((ratio**2).mean(1)), 2), _three(100 * (np.abs(ratio) < 1.96).mean(1), 0) + " %",
            len(trials) - len(good),
        ]  # fmt: skip


def _three(values: Floats, digits: int) -> str:
    return " / ".join(f"{value:.{digits}f}" for value in values)
