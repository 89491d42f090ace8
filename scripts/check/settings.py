"""Cameras between settings of zoom and focus, against ray-traced lenses.

The lens is `machine-vision` with errors of assembly, 1920 x 1080. *zoom*: a gap between its groups changes, so that it
has 1340 to 1980 px of focal length and another distortion everywhere, and the sensor follows its focus. *focus*: the
same lens at 25 mm moves away from the sensor by up to 2.7 % of its focal length. At five settings it sees 8 views of
one printed board each, with corners of 0.1 px. At a setting between them, drawn at random, cameras are compared with
the truth on 9 x 7 places of the image: points at infinity, after the best-fit rotation. Interpolated from all
five, and from the first, the middle and the last one; beside them the nearest calibration, and what is done elsewhere:
`cv2.calibrateCamera` with five coefficients at each setting, of which each parameter is interpolated linearly.
The last rows are cameras that were calibrated at their setting.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kcal import Camera, Observations, calibrate_camera
from kcal.calibrate.camera.at_setting import camera_at_setting
from kcal.lens import LensSetting
from kcal.lens.uncertainty import pixel_covariance, pixel_errors
from kcal.sim.raytrace import Misalignment, focal_length, system_matrix
from kcal.sim.truth import TruthLens
from scripts.shared.captures import BOARD, MACHINE_VISION, captures, printed
from scripts.shared.page import NOT_KEPT, Kept, Lines, Record, section, timed
from scripts.shared.peer_lenses import calibrated

LENS = MACHINE_VISION
SETTINGS = (0.0, 0.25, 0.5, 0.75, 1.0)
VIEWS, NOISE = 8, 0.1
# The surface behind which the gap changes with zoom, and by how much of the prescription's unit at each end.
GAP, ZOOM = 3, 0.3
# Distance that the sensor moves with focus, in that unit.
FOCUS = 0.054
# Ways to a camera, and what they are called.
WAYS = {
    "five": "interpolated from five",
    "three": "interpolated from three",
    "nearest": "nearest of five",
    "opencv": "OpenCV-5, parameters linear",
    "calibrated": "calibrated at its setting",
    "opencv there": "OpenCV-5 at its setting",
}


def lens_at(kind: str, setting: float, seed: int) -> TruthLens:
    """The lens with its zoom or focus at a setting from 0 to 1."""
    surfaces = list(LENS.surfaces)
    if kind == "zoom":
        moved = surfaces[GAP].thickness + ZOOM * (2.0 * setting - 1.0)
        surfaces[GAP] = dataclasses.replace(surfaces[GAP], thickness=moved)
    a, _, c, _ = system_matrix(dataclasses.replace(LENS, surfaces=tuple(surfaces)))
    behind = -a / c + (FOCUS * setting if kind == "focus" else 0.0)
    surfaces[-1] = dataclasses.replace(surfaces[-1], thickness=behind)
    lens = dataclasses.replace(LENS, surfaces=tuple(surfaces))
    random = torch.Generator().manual_seed(seed)
    misalignment = Misalignment.draw(lens, 1.0, random)
    tilt, shift = torch.randn((2, 2), dtype=torch.float64, generator=random).tolist()
    grown = focal_length(lens) / focal_length(LENS)
    return TruthLens(
        lens,
        focal=LENS.focal * grown,
        focal_mm=(25.0 if kind == "focus" else 2.8) * grown,
        misalignment=misalignment,
        center=(959.5 + 8.0 * shift[0], 539.5 + 8.0 * shift[1]),
        sensor_tilt=(math.radians(0.2) * tilt[0], math.radians(0.2) * tilt[1]),
    )


def opencv(seen: Observations) -> Tensor:
    """Focal lengths, principal point, and five coefficients."""
    _, matrix, coefficients = calibrated(seen, 5)
    return torch.tensor([*matrix[[0, 1, 0, 1], [0, 1, 2, 2]], 0.0, *coefficients], dtype=torch.float64)


def between(parameters: list[Tensor], setting: float) -> Camera:
    """Each parameter on the straight line between the two settings beside it."""
    after = min(max(int(np.searchsorted(SETTINGS, setting)), 1), len(SETTINGS) - 1)
    low, high = SETTINGS[after - 1 : after + 1]
    share = (setting - low) / (high - low)
    return Camera(torch.lerp(parameters[after - 1], parameters[after], share), size=(1920, 1080), model="opencv5")


def judged(camera: Camera, truth: TruthLens) -> dict[str, float]:
    """Errors in the image, and which share of them is within 95 %."""
    places = camera.grid(9, 7).reshape(-1, 2)
    error = pixel_errors(camera, truth, places)  # type: ignore[arg-type]
    found = {"square": float(error.square().sum(-1).nanmean())}
    if camera.calibration is not None:
        covariance = pixel_covariance(camera, places)
        score = error.abs() / covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        found["inside"] = float((score < 1.96).double()[error.isfinite()].mean())
        found["variance"] = float(covariance.diagonal(dim1=-2, dim2=-1).sum(-1).nanmean())
    return found


def interpolated(cameras: list[Camera], setting: float, truth: TruthLens) -> dict[str, float]:
    """One that `camera_at_setting` made."""
    found, used = timed(camera_at_setting, cameras, {"setting": setting})
    return judged(found.camera, truth) | {"cpu": used, "curve": found.interpolation_px}


def work(kind: str, seed: int, noises: int) -> Record:
    """One lens: `noises` draws of corners, and a setting of each."""
    random = np.random.default_rng(seed)
    points = printed(BOARD.points, seed)
    lenses = [lens_at(kind, setting, seed) for setting in SETTINGS]
    seen = [captures(lens, VIEWS, [NOISE] * noises, 100 * seed + i, points) for i, lens in enumerate(lenses)]
    draws: list[dict[str, Any]] = []
    for k in range(noises):
        cameras, parameters = [], []
        for setting, one in zip(SETTINGS, seen, strict=True):
            camera = calibrate_camera(one[k]).camera
            assert camera.calibration is not None
            stated = LensSetting(values={"setting": setting})
            camera.calibration = dataclasses.replace(camera.calibration, setting=stated)
            cameras.append(camera)
            parameters.append(opencv(one[k]))
        for setting in random.uniform(0.0, 1.0, 1).tolist():
            truth = lens_at(kind, setting, seed)
            nearest = min(range(len(SETTINGS)), key=lambda i: abs(SETTINGS[i] - setting))
            draws.append(
                {
                    "setting": setting,
                    "five": interpolated(cameras, setting, truth),
                    "three": interpolated(cameras[::2], setting, truth),
                    "nearest": judged(cameras[nearest], truth),
                    "opencv": judged(between(parameters, setting), truth),
                    "calibrated": judged(cameras[nearest], lenses[nearest]),
                    "opencv there": judged(between(parameters, SETTINGS[nearest]), lenses[nearest]),
                }
            )
    return {"draws": draws}


def shown(record: Record) -> str:
    """For the screen."""
    return "  ".join(f"{way} {_root(record['draws'], way, 'square'):.3f}" for way in WAYS)


def _root(draws: list[dict[str, Any]], way: str, what: str) -> float:
    return math.sqrt(np.mean([draw[way][what] for draw in draws]))


def lines(records: list[Record], noises: int) -> Lines:
    """The table of the page."""
    yield ["", "camera", "error px, RMS", "σ px", "in 95 %", "σ of the curve px, median", "CPU s", "lenses x noises"]
    for kind in dict.fromkeys(record["key"][0] for record in records):
        own = [record for record in records if record["key"][0] == kind]
        draws = [draw for record in own for draw in record["draws"]]
        for way, name in WAYS.items():
            stated = "inside" in draws[0][way]
            curve = "cpu" in draws[0][way]
            yield [
                kind, name, f"{_root(draws, way, 'square'):.2f}",
                f"{_root(draws, way, 'variance'):.2f}" if stated else "–",
                f"{100 * np.mean([draw[way]['inside'] for draw in draws]):.1f} %" if stated else "–",
                f"{np.median([draw[way]['curve'] for draw in draws]):.3f}" if curve else "–",
                f"{np.median([draw[way]['cpu'] for draw in draws]):.1f}" if curve else "–", f"{len(own)} x {noises}",
            ]  # fmt: skip


@section("settings.md", "settings", lenses=1, noises=1, kinds=("zoom",))
def settings(
    kept: Kept = NOT_KEPT, kinds: tuple[str, ...] = ("zoom", "focus"), lenses: int = 10, noises: int = 3
) -> Lines:
    found = kept.records([(kind, seed, noises) for kind in kinds for seed in range(lenses)], work, shown)
    return lines([record for record in found if record["key"][2] == noises], noises)
