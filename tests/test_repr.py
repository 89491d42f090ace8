"""`repr` of what users hold: a few lines, with what matters, however much is inside."""

import copy
import dataclasses
import inspect
import re
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from calibrate_scenes import motions, observe, pixels_of
from locate_rigs import located_pairs

import kcal
from kcal import Board, Camera, Localizer, Observations, Origin, Rig, View
from kcal.corners.detect import Detection
from kcal.rig import RigCovariance

ROOT = Path(__file__).parents[1]
CAMERA = Camera.build(focal=(1600, 1600.25), center=(959.5, 539.5), size=(1920, 1080), coefficients=[-0.1])
RIG = Rig.pair(CAMERA, CAMERA, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))


def calibrated() -> Any:
    seen = observe(pixels_of(CAMERA, motions(CAMERA, 5, 4), noise=0.05), size=CAMERA.size, names="01234")
    return kcal.calibrate_camera(seen, kcal.CalibrationOptions(model="opencv5"))


def check(value: Any, *told: str, lines: int = 3) -> str:
    text = repr(value)
    assert len(text.splitlines()) <= lines, text
    assert len(text) <= 300, text
    assert " at 0x" not in text
    assert [word for word in told if word not in text] == [], text
    return text


def test_modules() -> None:
    check(CAMERA, "opencv5", "(1920, 1080)", "focal=(1600, 1600.25)", "whole image", lines=1)
    check(RIG, "left, right, baseline=10.0 m", "2 x Camera(")
    assert "covariance" not in repr(RIG)
    known = Rig.pair(CAMERA, CAMERA, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
    known.covariance = RigCovariance.of(known, pose=1e-8 * torch.eye(6).double())
    check(known, "baseline=10.0 m, covariance")
    look = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    stations = Rig([CAMERA] * 9, list("abcdefghi"), look.repeat(9, 1, 1), center=torch.eye(9)[:, :3] * 3000.0)
    check(stations, "a, b, c", "up to 4240 m apart", "9 x Camera")
    origin = Origin(lat=19.07, lon=72.87, height=14.0)
    localize = Localizer(RIG.placed(origin=origin, heading_deg=35.0), pixel_sigma=0.1)
    check(localize, "lat=19.07", "heading=35°", "pixel_sigma=0.1, errors of marks", "10.0 m")


def test_results() -> None:
    left = torch.full((7, 2), 500.0)
    right = left - torch.tensor([3.2, 0.0])
    right[5:] += 10.0
    localize = Localizer(RIG.placed(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=35.0))
    check(localize(left, right), "Localization(5 OK, 2 PARALLEL, enu=(7, 3)")
    located = located_pairs(RIG, left[:1], right[:1], origin=Origin(lat=1.0, lon=2.0, height=3.0), heading_deg=0.0)
    check(located, "Located(")
    found = calibrated()
    check(found, f"CameraCalibrationResult(rms={found.rms:.6g}, ", "camera=Camera(model=opencv5", "per_view_rms=(5,)")
    check(found.observations, "board=Board(columns=7, rows=6, square=0.05)", "(1920, 1080)", "5 View")
    assert str(found.observations) == repr(found.observations)
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
    check(rig, "baseline=10.0", "covariance, mounting, calibration")
    check(rig.covariance, "RigCovariance(half=(")
    check(rig.mounting, "Mounting(heading_deg=", "origin=Origin(lat=", "covariance=(7, 7)")
    check(rig.calibration, "RigCalibration(rms=")


DOORS = [kcal, *(value for value in (getattr(kcal, name) for name in kcal.__all__) if inspect.ismodule(value))]
PUBLIC = {name: getattr(door, name) for door in DOORS for name in door.__all__}


def public_records() -> set[type]:
    """Dataclasses and named tuples that have a public name, or that public functions and methods return."""
    functions = [value for value in PUBLIC.values() if inspect.isfunction(value)]
    classes = {value for value in PUBLIC.values() if inspect.isclass(value)}
    for kind in classes:
        members = [getattr(member, "__func__", member) for each in kind.__mro__ for member in vars(each).values()]
        functions += [getattr(member, "fget", member) for member in members]
    for function in map(inspect.unwrap, filter(inspect.isfunction, functions)):
        words = re.findall(r"\w+", str(function.__annotations__.get("return")))
        classes |= {one for one in map(function.__globals__.get, words) if inspect.isclass(one)}
    return {one for one in classes if one.__module__.startswith("kcal.") and is_record(one)}


def is_record(kind: Any) -> bool:
    return dataclasses.is_dataclass(kind) or hasattr(kind, "_fields")


def filled(kind: type) -> Any:
    """One whose every field is large."""
    fields = [field.name for field in dataclasses.fields(kind)] if dataclasses.is_dataclass(kind) else kind._fields
    hints = {name: str(hint) for each in reversed(kind.__mro__) for name, hint in inspect.get_annotations(each).items()}
    known = {name: one for name, one in vars(sys.modules[kind.__module__]).items() if one is not kind}
    values = [torch.zeros(700) if name == "status" else large(hints[name], known) for name in fields]
    if not dataclasses.is_dataclass(kind):
        return tuple.__new__(kind, values)
    made = object.__new__(kind)
    for name, value in zip(fields, values, strict=True):
        object.__setattr__(made, name, value)
    return made


def large(hint: str, known: dict[str, Any]) -> Any:
    words = re.findall(r"\w+", hint)
    if "Tensor" in hint or "Array" in hint:
        return torch.rand(700, 3).double()
    if "tuple" in hint or "Sequence" in hint or "list" in hint:
        pair = [123 if word == "int" else 1234.56789012 for word in words if word in ("int", "float")]
        return ("north tower/20260501T120000Z.png",) * 60 if "..." in hint or not pair else tuple(pair)
    if "dict" in hint or "Mapping" in hint:
        return {f"view {number}": 1.23456789012 for number in range(60)}
    usual = {"str": "a name of usual length", "Literal": "one of some", "int": 123456, "float": 1234.56789012}
    for word, value in usual.items():
        if word in words:
            return value
    records = [one for one in map(known.get, words) if is_record(one)]
    return filled(records[0]) if records else True if "bool" in words else CAMERA


RECORDS = public_records()


@pytest.mark.parametrize("kind", sorted(RECORDS, key=lambda kind: kind.__name__), ids=lambda kind: kind.__name__)
def test_a_large_record_is_told_in_three_lines(kind: type) -> None:
    check(filled(kind), kind.__name__, lines=3)


def test_many_records_are_walked() -> None:
    names = {kind.__name__ for kind in RECORDS}
    assert len(names) > 90
    assert {"CalibrationOptions", "CameraCalibrationResult", "Localization", "Tracks", "Drift", "Verdict"} <= names


def test_every_other_public_class_is_told_in_three_lines() -> None:
    localize = Localizer(RIG.placed(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=35.0))
    board = Board(columns=7, rows=6, square=0.05)
    made = [
        CAMERA, RIG, localize, board, View(name="a", pixels=((0.0, 0.0),) * 42),
        Observations(board=board, image_size=(9, 9), views=()),
        kcal.lens.CameraRays(CAMERA), kcal.lens.ExtendedDistortion(CAMERA.coefficients, "opencv5"),
        kcal.lens.StereoRectification(RIG), kcal.lens.Undistort(CAMERA), kcal.lens.UndistortImage(CAMERA),
        kcal.lens.Unproject(CAMERA), kcal.corners.RefineCorners(),
        kcal.locate.DisparityRanges(kcal.lens.StereoRectification(RIG)), kcal.track.ObjectDisparity(RIG),
        kcal.track.PairBoxes(RIG), kcal.track.Tracker(localize), kcal.rig.Watched(RIG), kcal.nets.InverseNet(CAMERA),
        kcal.nets.ResidualNet(CAMERA),
        kcal.nets.NetworkModes(torch.nn.Sequential(torch.nn.Linear(2, 8), torch.nn.Tanh(), torch.nn.Linear(8, 9))),
        kcal.calibrate.CalibrationLayer(CAMERA.size), kcal.solve.LevenbergMarquardt(torch.sin),
        kcal.corners.CornerStatus(0), kcal.PositionStatus(0), kcal.corners.MatchStatus(0), kcal.solve.SolverStatus(0),
    ]  # fmt: skip
    for value in made:
        check(value, type(value).__name__)
    # Without numbers, as models are that get theirs later.
    assert repr(copy.deepcopy(RIG).to("meta")) == "Rig(on the meta device)"
    told = {type(value) for value in made} | RECORDS
    others = {kind.__name__ for kind in PUBLIC.values() if inspect.isclass(kind) and kind not in told}
    errors = {name for name in others if issubclass(PUBLIC[name], BaseException)}
    assert others - errors == {"CameraLike"}  # a protocol
