"""`repr` of what users hold: a few lines, with what matters, however much is inside."""

from __future__ import annotations

import dataclasses
import inspect
from pathlib import Path
from typing import Any

import torch
from locate_rigs import located_pairs

import kcal
from kcal import Board, Camera, Localizer, Observations, Origin, Rig, View
from kcal.corners.detect import Detection
from kcal.lens import rotation_from_vector
from kcal.locate import Triangulate
from kcal.rig import RigCovariance
from kcal.texts import brief

ROOT = Path(__file__).parents[1]
CAMERA = Camera.build(focal=(1600, 1600.25), center=(959.5, 539.5), size=(1920, 1080), coefficients=[-0.1])
RIG = Rig.pair(CAMERA, CAMERA, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))


def calibrated() -> Any:
    board = Board(columns=7, rows=6, square=0.05)
    tilts = torch.tensor([[0.5, 0, 0], [-0.5, 0.1, 1.5], [0, 0.5, 0.2], [0.1, -0.5, 0], [0.4, 0.4, -1.4]]).double()
    noise = torch.Generator().manual_seed(4)
    views = []
    for number, turn in enumerate(rotation_from_vector(tilts)):
        points = (board.points - board.points.mean(0)) @ turn.T + torch.tensor([0, 0, 0.7]).double()
        pixels = CAMERA.project(points)[0]
        views.append(
            View(
                name=str(number), pixels=pixels + 0.05 * torch.randn(pixels.shape, generator=noise, dtype=pixels.dtype)
            )
        )
    seen = Observations(board=board, image_size=(1920, 1080), views=views)
    return kcal.calibrate_camera(seen, kcal.CalibrationOptions(model="opencv5"))


def check(value: Any, *told: str, lines: int = 3) -> str:
    text = repr(value)
    assert len(text.splitlines()) <= lines, text
    assert max(map(len, text.splitlines())) <= 260
    assert [word for word in told if word not in text] == [], text
    return text


def test_modules() -> None:
    check(CAMERA, "opencv5", "(1920, 1080)", "focal=(1600, 1600.25)", "whole image", lines=1)
    check(RIG, "left, right, baseline=10.0 m", "2 x Camera(", lines=6)
    assert "covariance" not in repr(RIG)
    known = Rig.pair(CAMERA, CAMERA, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
    known.covariance = RigCovariance.of(known)
    check(known, "baseline=10.0 m, covariance", lines=6)
    look = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    stations = Rig([CAMERA] * 9, list("abcdefghi"), look.repeat(9, 1, 1), center=torch.eye(9)[:, :3] * 3000.0)
    check(stations, "a, b, c", "up to 4240 m apart", "9 x Camera", lines=6)
    origin = Origin(lat=19.07, lon=72.87, height=14.0)
    localize = Localizer(RIG, origin=origin, heading_deg=35.0, pixel_sigma=0.1)
    check(localize, "lat=19.07", "heading=35°", "pixel_sigma=0.1, errors of marks", "10.0 m", lines=9)


def test_results() -> None:
    left = torch.full((7, 2), 500.0)
    right = left - torch.tensor([3.2, 0.0])
    right[5:] += 10.0
    check(Triangulate(RIG)(left, right), "Triangulation(5 OK, 2 PARALLEL, points=(7, 3), ", lines=2)
    localize = Localizer(RIG, origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=35.0)
    check(localize(left, right), "Localization(5 OK, 2 PARALLEL, enu=(7, 3)")
    located = located_pairs(RIG, left[:1], right[:1], origin=Origin(lat=1.0, lon=2.0, height=3.0), heading_deg=0.0)
    check(located, "Located(")
    found = calibrated()
    check(found, f"CameraCalibrationResult(rms={found.rms:.6g}, ", "camera=Camera(model=opencv5", "per_view_rms=(5,)")
    check(found.observations, "board=Board(columns=7, rows=6, square=0.05)", "(1920, 1080)", "5 View", lines=1)
    check(found.observations.views[0], "View(name='0', pixels=42 tuple)", lines=1)
    check(found.camera.calibration, "CameraCalibration(", "sigma=9 entries")
    check(found.camera.calibration.record, "views=5, points=210", "rms=")
    check(found.information, "CameraInformation(")
    assert check(Detection(None, "blurred"), lines=1) == "Detection(reason='blurred')"


def test_a_board_can_be_made_from_its_text() -> None:
    for board in (Board(columns=9, rows=6, square=0.025), Board.parse("charuco:9x6:5x5_100:15mm", "20mm")):
        assert eval(check(board, lines=1)) == board


def test_a_rig_file() -> None:
    rig = kcal.load_rig(ROOT / "assets" / "sample-rig.json")
    check(rig, "baseline=10.0", "covariance, mounting, calibration", lines=7)
    check(rig.covariance, "RigCovariance(half=(")
    check(rig.mounting, "Mounting(heading_deg=", "origin=Origin(lat=", "covariance=(7, 7)")
    check(rig.calibration, "RigCalibration(rms=")


def test_records_of_many_tensors_are_brief() -> None:
    doors = [kcal, *(value for value in (getattr(kcal, name) for name in kcal.__all__) if inspect.ismodule(value))]
    long = []
    for value in (getattr(door, name) for door in doors for name in door.__all__):
        if inspect.isclass(value) and (dataclasses.is_dataclass(value) or hasattr(value, "_fields")):
            tensors = sum("Tensor" in str(hint) for hint in value.__annotations__.values())
            if tensors > 4 and value.__repr__ is not brief and "brief" not in value.__repr__.__code__.co_names:
                long.append(value.__name__)
    assert long == []
