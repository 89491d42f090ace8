"""One small figure of each kind, and what can be asked of all of them."""

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from calibrate_scenes import BOARD, camera, motions
from locate_rigs import located_pairs, pinhole_rig, tensor
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from kcal import Board, Camera, Landmarks, Observations, Origin, RigData, RigOptions, View, solve_rig
from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.calibrate.camera.trust import IntervalCheck
from kcal.calibrate.hybrid.measured_board import MeasuredBoard
from kcal.calibrate.rig.result import RigResult
from kcal.lens.difference import camera_difference, difference_text
from kcal.locate import enu_from_cam, level_ground
from kcal.locate.budget import RangeError
from kcal.locate.positions import Located
from kcal.locate.siting import Area, RankedSite, Site, area_of, rank_sites
from kcal.report.calibration import (
    board_figure,
    calibration_figure,
    coverage_figure,
    difference_figure,
    gallery_figure,
    interval_figure,
)
from kcal.report.positions import budget_figure, positions_figure, siting_figure, stations_figure
from kcal.report.rig import attitude_figure, rig_figure, stars_figure

PLACES = tensor([20.0, 0.0, 100.0], [-300.0, 5.0, 1000.0], [900.0, 0.0, 5000.0], [0.0, 0.0, 60_000.0])
PLACE = Origin(lat=10.0, lon=20.0, height=0.0)


@functools.cache
def located(heading: float = 300.0, mast: str = "mast", origin: Origin = PLACE) -> tuple[Located, torch.Tensor]:
    """Four things, the last too far for a range, and their true places."""
    left, right = pinhole_rig()(PLACES)[0].unbind(-2)
    names = ["gate", mast, "ship", "cloud"]
    found = located_pairs(
        pinhole_rig(), left, right + tensor([0.3, 0.0]), origin=origin, heading_deg=heading, names=names
    )
    return found, PLACES @ enu_from_cam(heading).T


@functools.cache
def landmarks_rig(wide: bool = False, wrong: bool = True) -> RigResult:
    """Two cameras east and west of each other that look north, and eight landmarks, of which one is wrong."""
    # All landmarks are inside.
    size = (16000, 1080) if wide else (1920, 1080)
    center = 0.5 * (size[0] - 1), 0.5 * (size[1] - 1)
    lens = Camera.build(focal=(1600, 1600), center=center, size=size, model="pinhole")
    turn = enu_from_cam(0.0).T
    places = tensor(
        [-20, 80, 1], [15, 90, 5], [-60, 200, 3], [55, 240, -9], [-120, 420, 12], [150, 520, 8], [-9, 610, 20],
        [210, 700, 2], [60, 330, 6], [-80, 560, -4],
    )  # fmt: skip
    if wide:
        places = places * tensor(0.6, 0.2, 1.0)
    centers = tensor([0.0, 0.0, 0.0], [60.0 if wide else 10.0, 0.0, 0.0])
    pixels = torch.stack([lens.project((places - center) @ turn.T)[0] for center in centers], 1)
    noise = torch.randn(pixels.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    pixels = pixels + 0.1 * noise
    if wrong:
        pixels[3, 1] += tensor(9.0, -4.0)
    seen = Landmarks(names=tuple("abcdefghij"), points=places, sigma=torch.full_like(places, 0.02), pixels=pixels,
                     pixel_sigma=0.1)  # fmt: skip
    data = RigData(cameras=(lens, lens), names=("left", "right"), landmarks=seen)
    return solve_rig(data, RigOptions(refraction=0.0, refraction_sigma=0.0))


@functools.cache
def calibrated() -> CameraCalibrationResult:
    """Eight views by a lens of four coefficients."""
    truth = camera("opencv4")
    rotation, translation = motions(truth, 8, 3)
    pixels, _ = truth.project(BOARD.points @ rotation.transpose(-1, -2) + translation[:, None])
    noise = 0.05 * torch.randn(pixels.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    views = [
        View(name=f"{i:02}.png", pixels=tuple(map(tuple, view))) for i, view in enumerate((pixels + noise).tolist())
    ]
    seen = Observations(board=BOARD, image_size=(640, 480), views=tuple(views))
    return calibrate_camera(seen, CalibrationOptions(model="opencv4"))


def stations() -> Located:
    """Things seen by three towers, one of them by one tower alone."""
    from kcal.lens.rig import Rig
    from kcal.locate.marks import Marks
    from kcal.locate.points import locate_points

    lens = Camera.build(focal=(900, 900), center=(959.5, 539.5), size=(1920, 1080), model="pinhole")
    centers = tensor([0.0, 0.0, 30.0], [3000.0, 200.0, 40.0], [1500.0, -900.0, 35.0])
    turns = torch.stack([enu_from_cam(heading).T for heading in (20.0, -30.0, 0.0)])
    rig = Rig((lens,) * 3, ("mill", "mast", "roof"), turns, center=centers, origin=PLACE, refraction=0.0)
    things = tensor([1200.0, 4000.0, 10.0], [2000.0, 3000.0, 10.0], [-800.0, 2500.0, 10.0])
    pixels = torch.stack([lens.project((things - c) @ turn.T)[0] for c, turn in zip(centers, turns, strict=True)], 1)
    pixels[2, 1:] = math.nan
    return locate_points(rig, Marks(("fire", "smoke", "light"), pixels))


@functools.cache
def sites() -> tuple[Area, list[Site], list[RankedSite]]:
    """Two towers, one of which looks only northeast, and two candidates."""
    towers = [
        Site(name="mill", origin=Origin(lat=45.0, lon=5.95, height=99.0)),
        Site(name="mast", origin=Origin(lat=45.0, lon=6.05, height=99.0), heading_deg=45.0, field_deg=90.0),
    ]
    new = [
        Site(name=name, origin=Origin(lat=45.1, lon=lon, height=99.0)) for name, lon in (("hill", 5.97), ("tor", 6.2))
    ]
    area = area_of((45.02, 5.9, 45.12, 6.1), level_ground(0.0), [*towers, *new], cells=24)
    return area, towers, rank_sites(area, towers, new, build=1)


def night() -> dict[str, Any]:
    """A sky that is brighter to the right and below, with six stars of which four have names."""
    rows, columns = np.mgrid[0:320, 0:480].astype(float)
    image = 200.0 + 0.2 * columns + 0.1 * rows + np.random.default_rng(0).normal(0, 4.0, rows.shape)
    pixels = np.array([[100.0, 80.0], [470.0, 200.0], [240.0, 160.0], [50.0, 300.0], [300.0, 40.0], [350.0, 250.0]])
    for u, v in pixels:
        image += 300.0 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / 3.0)
    names = ["Vega", "Deneb", "", "Altair", "", "Sadr"]
    residual = np.array([[0.1, 0.0], [0.0, -0.2], [math.nan] * 2, [0.3, 0.4], [math.nan] * 2, [-0.1, 0.1]])
    return {"image": image, "pixels": pixels, "names": names, "residual": residual, "title": "night"}


def watched(seconds: float) -> dict[str, Any]:
    """Ninety looks at an attitude that swings; at ten of them nothing was seen."""
    time = 1e9 + np.linspace(0.0, seconds, 90)
    swing = 0.01 * np.sin(np.linspace(0.0, 6.0, 90))
    angle = np.stack([swing, 2 * swing, -swing], 1)
    seen = np.ones(90, bool)
    seen[40:50] = False
    return {
        "time": time,
        "angle": angle,
        "sigma": np.full((90, 3), 0.002),
        "seen": seen,
        "limit": 0.05,
        "title": "mast",
    }


def checked(repeats: int = 20) -> IntervalCheck:
    """Refits whose errors are as large as stated in the left half of the image, and twice so in the right one."""
    pixels = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480)).grid(25, 17)
    errors = torch.randn(repeats, 2, 17, 25, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    errors[..., 13:, :] *= 4.0
    stated = torch.eye(2).double().expand(2, 17, 25, 2, 2)
    return IntervalCheck(pixels=pixels, ranges=(10.0, math.inf), stated=stated, errors=errors, failed=0)


def bent(scale: float = 2e-4) -> MeasuredBoard:
    amplitudes = torch.zeros(28, dtype=torch.float64)
    amplitudes[1], amplitudes[12] = scale, scale
    board = Board(columns=6, rows=9, square=0.02)
    return MeasuredBoard(name="plate", board=board, amplitudes=amplitudes, half=1e-5 * torch.eye(28).double(),
                         log_evidence=0.0)  # fmt: skip


def shifted() -> Figure:
    left = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480))
    found = camera_difference(left, Camera.build(focal=(810, 800), center=(321, 240), size=(640, 480)))
    return difference_figure(found, "june and december", difference_text(found))


def budget() -> Figure:
    errors = RangeError(*tensor([-1.0, -15.0, -90.0], [1.0, 20.0, 200.0], [1.0, 18.0, 120.0]))
    return budget_figure(tensor(100.0, 700.0, 5000.0), {"yaw": errors}, {"yaw": "yaw ± 0.01°"})


FIGURES: dict[str, Callable[[], Figure]] = {
    "positions": lambda: positions_figure(*located()),
    "rig": lambda: rig_figure(landmarks_rig()),
    "wide rig": lambda: rig_figure(landmarks_rig(wide=True)),
    "stations": lambda: stations_figure(stations()),
    "sites": lambda: siting_figure(*sites()),
    "stars": lambda: stars_figure(**night()),
    "attitude": lambda: attitude_figure(**watched(9000.0)),
    "intervals": lambda: interval_figure(checked(), calibrated().observations, "left"),
    "board": lambda: board_figure(bent()),
    "calibration": lambda: calibration_figure(calibrated(), "left"),
    "gallery": lambda: gallery_figure(calibrated().observations),
    "coverage": lambda: coverage_figure(calibrated().observations),
    "difference": shifted,
    "budget": budget,
}


def boxes(figure: Figure) -> tuple[list[tuple[str, Any]], list[Any]]:
    """Texts that are drawn with their boxes, and the boxes of axes, in pixels of the canvas."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    every = figure.findobj(Axes)
    hidden = {id(text) for axes in every for text in _not_drawn(axes)}
    texts = [
        (text.get_text(), text.get_window_extent(renderer))
        for text in figure.findobj(Text)
        if text.get_visible() and text.get_text().strip() and id(text) not in hidden
    ]
    return texts, [axes.get_window_extent(renderer) for axes in every]


def _not_drawn(axes: Axes) -> list[Text]:
    """Labels of axes that are off, and of ticks beyond their ends."""
    found = []
    for axis in (axes.xaxis, axes.yaxis):
        if not axes.axison:
            found += axis.findobj(Text)
            continue
        low, high = sorted(axis.get_view_interval())
        slack = 1e-9 * (high - low)
        for tick in [*axis.get_major_ticks(), *axis.get_minor_ticks()]:
            if not low - slack <= tick.get_loc() <= high + slack:
                found += [tick.label1, tick.label2]
    return found
