"""Slips of users get an `InputError` that names them: another type, another order, fields that do not fit."""

from __future__ import annotations  # slips are named where annotations are text, as in kcal

import pickle
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

import kcal
from kcal import Board, CalibrationOptions, Camera, InputError, KcalWarning, Localizer, Observations, Origin, Rig, View
from kcal.corners import refine_point
from kcal.doors import _is_kind, _naming_slips
from kcal.lens import camera_difference, pixel_covariance, rotation_from_vector, vector_from_rotation
from kcal.locate import Marks, enu_to_geodetic

CAMERA = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480))
BOARD = Board(columns=3, rows=3, square=0.1)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: camera_difference(CAMERA, None), "second: Camera is needed, got NoneType; .*load_camera"),
        (lambda: Localizer(CAMERA), r"rig: Rig is needed, got Camera; .*solve_rig\(...\).ster"),
        (lambda: kcal.save_camera("a.json", CAMERA), "save_camera: camera: Camera is needed, got str"),
        (lambda: kcal.calibrate_camera("a.obs.json"), "observations: Observations is needed, got str; kcal.detect or"),
        (lambda: kcal.solve_rig([CAMERA, CAMERA]), "solve_rig: data: RigData is needed, got list of Camera"),
        (lambda: Origin(lat="19", lon=72.0, height=0.0), "Origin: lat: float is needed, got str"),
        (lambda: Camera.build(focal=None, center=(1, 2), size=(3, 4)), r"build: focal: Sequence\[float\] .*got None"),
        (lambda: Camera.build(focal=("a", 2), center=(1, 2), size=(3, 4)), "focal: .* got tuple of str, int"),
        (lambda: Board(columns=1, rows=6, square=0.025), "Board: columns: .*greater than or equal to 2, got 1"),
        (lambda: Board(columns=9, rows=6, square="25mm"), "Board: square: .*valid number.*got '25mm'"),
        (lambda: View(name="a", pixels=[(1.0, np.inf)]), "View: pixels.0.1: .*finite.*got inf"),
        (lambda: View(name="a", pixels=np.zeros((4, 3))), "View: pixels.0: .*at most 2"),
        (lambda: Observations(board=BOARD, image_size=(9, 9), views=[View(name="a", pixels=[])]), "has 0 corners"),
    ],
)  # fmt: skip
def test_a_slip_is_named(call: Callable[[], Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        call()
    assert caught.value.__cause__ is not None


def test_what_is_no_slip_keeps_its_error() -> None:
    def ours(camera: Camera) -> None:
        raise KeyError("ours")

    with pytest.raises(KeyError, match="ours"):
        _naming_slips(ours)(CAMERA)
    with pytest.raises(InputError, match="ours: camera: Camera is needed, got int"):
        _naming_slips(ours)(3)
    with pytest.raises(TypeError, match="missing 1 required positional argument: 'second'"):
        camera_difference(CAMERA)  # type: ignore[call-arg]


def test_a_slip_in_options_is_named() -> None:
    def fit(options: CalibrationOptions) -> object:
        return options.reject.limit  # type: ignore[union-attr]

    with pytest.raises(InputError, match=r"CalibrationOptions: reject: OutlierRejection \| None is needed, got bool"):
        _naming_slips(fit)(CalibrationOptions(model="opencv5", reject=True))  # type: ignore[arg-type]


def test_functions_stay_what_they_are() -> None:
    from kcal.calibrate.camera.calibrate import calibrate_camera

    assert calibrate_camera is kcal.calibrate_camera
    assert pickle.loads(pickle.dumps(kcal.detect)) is kcal.detect
    turn = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    compiled = torch.compile(rotation_from_vector, fullgraph=True, backend="eager")
    assert torch.equal(compiled(turn), rotation_from_vector(turn))


@pytest.mark.parametrize(
    ("value", "hint", "fits"),
    [
        (None, None, True), (1, float, True), (np.float32(1), float, True), ("1", float, False), (True, bool, True),
        (1, int | None, True), (None, int | None, True), ("a", "a", True), ([1, 2.0], list[float], True),
        ([1, "a"], list[float], False), ((1, 2), tuple[int, int], True), ((1, 2, 3), tuple[int, int], False),
        ((1, 2, 3), tuple[int, ...], True), ({}, dict[str, int], True), ([], dict[str, int], False), (3, Any, True),
    ],
)  # fmt: skip
def test_annotations(value: Any, hint: Any, fits: bool) -> None:
    assert _is_kind(value, hint) == fits


def test_corners_of_opencv_are_views() -> None:
    corners = np.arange(18, dtype=np.float32).reshape(9, 1, 2)
    corners[4] = np.nan
    view = View(name="a", pixels=corners)
    assert view.pixels[:2] == ((0.0, 1.0), (2.0, 3.0))
    assert view.pixels[4] is None
    assert View(name="a", pixels=torch.from_numpy(corners)) == view
    seen = Observations(board=BOARD, image_size=(20, 20), views=[view])
    assert np.array_equal(seen.pixels()[0], corners[:, 0], equal_nan=True)


def test_squares_of_25_meters_are_doubted() -> None:
    with pytest.warns(KcalWarning, match="25 is in meters; give 25 mm as square=0.025") as caught:
        board = Board(columns=9, rows=6, square=25)
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Board.of(board.record)
        Board(columns=9, rows=6, square=1.0)


def painted(shift: int = 0) -> np.ndarray:
    y, x = np.mgrid[:120, :160]
    on = (x >= 20) & (x < 140) & (y >= 20) & (y < 100)
    return np.roll(np.where(on & ((x // 20 + y // 20) % 2 == 0), 40, 220).astype(np.uint8), shift, 1)


def test_images_to_detect_in(tmp_path: Path) -> None:
    board = Board(columns=5, rows=3, square=0.02)
    images = [painted(), painted(7)]
    for number, image in enumerate(images):
        cv2.imwrite(str(tmp_path / f"{number}.png"), image)
    files = sorted(tmp_path.iterdir())
    expected = kcal.detect(files, board).pixels()
    for given in (tmp_path, str(tmp_path), f"{tmp_path}/*.png", [tmp_path], images, np.stack(images)[:, None]):
        seen = kcal.detect(given, board)
        assert torch.equal(seen.pixels(), expected), given
        assert seen.names in (("0.png", "1.png"), ("image 0", "image 1"))
    for one in (files[0], str(files[0]), images[0], torch.from_numpy(images[0])):
        assert torch.equal(kcal.detect(one, board).pixels(), expected[:1])
    assert kcal.detect(images, board).views[0].image is None


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ([], "no images given"),
        ("nowhere", "nowhere: no such file or folder"),
        ("*.nothing", "no file matches"),
        ("film.mp4", "film.mp4: a video; kcal.corners.detect_video"),
        (["nowhere.png"], "no board in any of 1 images .*No such file"),
        ([np.zeros((120, 160, 3), np.uint8)], r"image 0: a color image \(120, 160, 3\); .*cv2.COLOR_BGR2GRAY"),
        (np.zeros((3, 120, 160), np.uint8), r"a batch \(B, 1, H, W\) or a list is needed, got \(3, 120, 160\)"),
        (BOARD, "detect: paths: .* is needed, got Board"),
    ],
)
def test_what_shows_no_images(given: Any, message: str) -> None:
    with pytest.raises(kcal.KcalError, match=message):
        kcal.detect(given, BOARD)


def test_a_number_is_no_path(tmp_path: Path) -> None:
    """It was taken for an open file, which was read and closed."""
    with (tmp_path / "mine").open("w") as file:
        with pytest.raises(InputError, match=r"detect: paths: .* is needed, got list of int"):
            kcal.detect([file.fileno()], BOARD)
        file.write("whole")


RIG = Rig.pair(CAMERA, CAMERA, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
LOOK = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).repeat(2, 1, 1)
STATIONS = Rig([CAMERA] * 2, ["a", "b"], LOOK, center=torch.tensor([[0.0, 0, 0], [1000.0, 0, 0]]))
LOCALIZE = Localizer(RIG.placed(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0))
PIXELS = torch.full((4, 2), 200.0)
NEXT = torch.tensor([[0.0, 0, 0, -1.0], [0, 0, 0, 0], [0, 0, 0, 0]])
# Each with the last dimension that it needs.
DOORS: dict[str, tuple[Callable[[Any], Any], int]] = {
    "project": (CAMERA.project, 3),
    "project_rays": (CAMERA.project_rays, 3),
    "ray_origins": (CAMERA.ray_origins, 3),
    "unproject": (CAMERA.unproject, 2),
    "normalize": (CAMERA.normalize, 2),
    "rig": (RIG, 3),
    "right_from_left": (RIG.right_from_left, 3),
    "stations": (STATIONS, 3),
    "localize": (lambda bad: LOCALIZE(bad, PIXELS), 2),
    "localize cov": (lambda bad: LOCALIZE(PIXELS, PIXELS, bad), 4),
    "sensitivity": (lambda bad: LOCALIZE.sensitivity(PIXELS, bad), 2),
    "marks": (lambda bad: Marks.of_pair(("a",) * 4, PIXELS, bad), 2),
    "multi": (Localizer(STATIONS), 2),
    "geodetic": (lambda bad: enu_to_geodetic(bad, LOCALIZE.origin), 3),
    "camera": (lambda bad: Camera(bad, size=(640, 480)), 10),
    "rotation": (lambda bad: Rig.pair(CAMERA, CAMERA, bad, torch.tensor([-1.0, 0, 0])), 3),
    "translation": (lambda bad: Rig.pair(CAMERA, CAMERA, torch.eye(3), bad), 3),
    "center": (lambda bad: Rig([CAMERA] * 2, ["a", "b"], LOOK, center=bad), 3),
    "refine": (lambda bad: refine_point(torch.rand(99, 99), bad), 2),
    "pixel_covariance": (lambda bad: pixel_covariance(CAMERA, bad), 2),
}
# What makes something new, on whatever device; and what works on the CPU alone.
ELSEWHERE = ("geodetic", "camera", "center", "refine", "pixel_covariance")
BAD: dict[str, Callable[[int], Any]] = {
    "integers": lambda last: torch.ones(4, last, dtype=torch.int64),
    "integer array": lambda last: np.ones((4, last), dtype=np.int32),
    "half": lambda last: torch.ones(4, last, dtype=torch.float16),
    "bfloat16": lambda last: torch.ones(4, last, dtype=torch.bfloat16),
    "complex": lambda last: torch.ones(4, last, dtype=torch.complex64),
    "bool": lambda last: torch.ones(4, last, dtype=torch.bool),
    "too wide": lambda last: torch.ones(4, last + 1),
    "transposed": lambda last: torch.ones(last, 5 * last),
    "flat": lambda last: torch.ones(7 * last + 1),
    "number": lambda last: torch.tensor(1.0),
    "nothing": lambda last: torch.ones(0),
    "objects": lambda last: np.ones((4, last), dtype=object),
    "words": lambda last: ["a"] * last,
    "None": lambda last: [None] * last,
    "ragged": lambda last: [[1.0] * last, [1.0]],
    "camera": lambda last: CAMERA,
    "elsewhere": lambda last: torch.ones(4, last, device="meta"),
}


@pytest.mark.parametrize("door", DOORS)
def test_no_other_error_reaches_a_user(door: str) -> None:
    call, last = DOORS[door]
    for bad, make in BAD.items():
        if bad == "elsewhere" and door in ELSEWHERE:
            continue
        with pytest.raises(InputError):
            call(make(last))


def test_shapes_that_would_mix_rows_are_refused() -> None:
    with pytest.raises(InputError, match=r"vector: shape \(..., 3\) is needed, got \(3, 2\)"):
        rotation_from_vector(torch.rand(3, 2))
    with pytest.raises(InputError, match=r"rotation: shape \(..., 3, 3\) is needed, got \(3, 9\)"):
        vector_from_rotation(torch.rand(3, 9))
    with pytest.raises(InputError, match=r"mask: a shape that broadcasts to \(4,\) is needed, got \(3,\)"):
        LOCALIZE(PIXELS, PIXELS, mask=torch.ones(3, dtype=torch.bool))
    batch = Camera(CAMERA.params.detach().repeat(3, 1), size=(640, 480))
    with pytest.raises(InputError, match=r"shape \(2, 4, 2\) does not fit a batch of \(3,\) cameras"):
        batch.unproject(torch.zeros(2, 4, 2))
