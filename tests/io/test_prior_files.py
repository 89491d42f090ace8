"""Priors for other programs: parameters as each program counts them, and the information about exactly these."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from kcal.errors import FileError
from kcal.io.foreign import Hints
from kcal.io.format_prior import Parameter, arranged, prior_of, read_prior, write_priors
from kcal.io.formats import FORMATS, held_exactly, import_cameras
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera

LENS = {"opencv4": (-0.1, 0.02, 1e-3, -5e-4), "opencv5": (-0.1, 0.02, 1e-3, -5e-4, 3e-3), "pinhole": ()}
LENS["fisheye4"] = (0.02, -0.003, 0.004, -0.0005)


def known(model: str, size: tuple[int, int] = (640, 480)) -> Camera:
    """A camera with a full covariance of all but the skew."""
    camera = Camera.build(focal=(800, 805), center=(321, 238), size=size, coefficients=LENS[model], model=model)
    count = len(camera.params)
    draw = torch.randn(count, count, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    scale = torch.tensor([0.5] * 4 + [0.0] + [1e-3] * (count - 5), dtype=torch.float64)
    half = (torch.eye(count) + 0.3 * draw) * scale
    camera.calibration = CameraCalibration(name="north", covariance=half.T @ half)
    return camera


# Names and values of fx, fy, cx, cy as each program's documentation has them: where its first pixel's center is, and in
# what units it counts.
HALF = (800, 805, 321.5, 238.5)
EXPECTED = [
    ("colmap", "opencv4", "OPENCV", "fx fy cx cy k1 k2 p1 p2", HALF),
    ("colmap", "fisheye4", "OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4", HALF),
    ("nerfstudio", "opencv4", "OPENCV", "fl_x fl_y cx cy k1 k2 p1 p2", HALF),
    ("nerfstudio", "fisheye4", "OPENCV_FISHEYE", "fl_x fl_y cx cy k1 k2 k3 k4", HALF),
    ("kalibr", "opencv4", "pinhole-radtan", "fu fv pu pv k1 k2 r1 r2", (800, 805, 321, 238)),
    ("kalibr", "fisheye4", "pinhole-equi", "fu fv pu pv k1 k2 k3 k4", (800, 805, 321, 238)),
    ("gtsam", "pinhole", "Cal3_S2", "fx fy s u0 v0", (800, 805, 0, 321)),
    ("gtsam", "opencv4", "Cal3DS2", "fx fy s u0 v0 k1 k2 p1 p2", (800, 805, 0, 321)),
    ("opensfm", "opencv5", "brown", "focal_x focal_y c_x c_y k1 k2 p1 p2 k3",
     (800 / 640, 805 / 640, (321 - 319.5) / 640, (238 - 239.5) / 640)),
    ("opensfm", "fisheye4", "fisheye_opencv", "focal_x focal_y c_x c_y k1 k2 k3 k4",
     (800 / 640, 805 / 640, (321 - 319.5) / 640, (238 - 239.5) / 640)),
    ("matlab", "opencv5", "cameraIntrinsics",
     "FocalLength(1) FocalLength(2) PrincipalPoint(1) PrincipalPoint(2) Skew RadialDistortion(1) RadialDistortion(2) "
     "TangentialDistortion(1) TangentialDistortion(2) RadialDistortion(3)", (800, 805, 322, 239)),
    ("mrcal", "opencv4", "LENSMODEL_OPENCV4", "fx fy cx cy k1 k2 p1 p2", (800, 805, 321, 238)),
    ("mrcal", "pinhole", "LENSMODEL_PINHOLE", "fx fy cx cy", (800, 805, 321, 238)),
]  # fmt: skip


@pytest.mark.parametrize(("program", "model", "kind", "names", "first"), EXPECTED, ids=lambda value: str(value)[:12])
def test_parameters_are_those_of_the_program(
    program: str, model: str, kind: str, names: str, first: tuple[float, ...]
) -> None:
    camera = known(model)
    prior = prior_of(program, camera)
    assert (prior["model"], prior["parameters"], prior["size"]) == (kind, names.split(), [640, 480])
    assert prior["mean"][:4] == pytest.approx(first, rel=1e-14, abs=1e-15)
    scale = [parameter.scale for parameter in arranged(program, camera)[1]]
    chosen = [camera.names.index(parameter.kcal) for parameter in arranged(program, camera)[1]]
    lens = list(LENS[model])
    assert prior["mean"][len(chosen) - len(lens) :] == pytest.approx(lens)
    root = np.array(prior["sqrt_information"])
    assert np.array_equal(root, np.triu(root))
    assert bool((np.diag(root) > 0).all())
    assert camera.calibration is not None
    covariance = camera.calibration.covariance
    assert covariance is not None
    wanted = covariance[chosen][:, chosen].numpy() * np.outer(scale, scale)
    spread = np.sqrt(np.diag(wanted))
    free = spread > 0
    unit = np.outer(spread[free], spread[free])
    found = np.linalg.inv(root.T @ root)[free][:, free]
    assert np.abs((found - wanted[free][:, free]) / unit).max() < 1e-7


def test_an_upright_image_is_counted_by_its_height() -> None:
    _, order = arranged("opensfm", known("opencv5", (480, 640)))
    assert order[0] == Parameter("focal_x", "fx", 1.0 / 640)
    assert order[2] == Parameter("c_x", "cx", 1.0 / 640, -239.5 / 640)
    assert order[3] == Parameter("c_y", "cy", 1.0 / 640, -319.5 / 640)


@pytest.mark.parametrize("suffix", [".json", ".npz"])
@pytest.mark.parametrize("program", ["matlab", "opensfm", "colmap"])
def test_a_camera_comes_back(program: str, suffix: str, tmp_path: Path) -> None:
    """Parameters, covariance, name, size, and what fit it is: whatever units and offsets the program has."""
    model = "opencv4" if program == "colmap" else "opencv5"
    cameras = [known(model), known(model, (800, 600))]
    priors = [prior_of(program, cameras[0], (0.01, 0.25)), prior_of(program, cameras[1])]
    path = write_priors(program, priors, tmp_path / f"a{suffix}")
    found = read_prior(path, Hints())
    assert found.format == program
    assert found.notes == ("north: a fit to another lens, RMS 0.01 px",)
    for back, camera in zip(found.cameras, cameras, strict=True):
        assert back.size == camera.size
        assert back.calibration is not None
        assert camera.calibration is not None
        assert back.calibration.name == "north"
        torch.testing.assert_close(back.params, camera.params, rtol=1e-13, atol=1e-13)
        spread = camera.calibration.covariance.diagonal().sqrt() + 1e-30
        away = (back.calibration.covariance - camera.calibration.covariance) / (spread * spread[:, None])
        assert float(away.abs().max()) < 1e-7


def changed(tmp_path: Path, **changes: Any) -> Path:
    path = write_priors("colmap", [prior_of("colmap", known("opencv4"))], tmp_path / "a.json")
    content = json.loads(path.read_text())
    content["cameras"][0] |= changes
    path.write_text(json.dumps(content))
    return path


def order(*names: str) -> dict[str, Any]:
    return {"model": "opencv4", "parameters": [[name, 1.0, 0.0] for name in names]}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kcal": order("fx", "fx"), "mean": [1.0, 2.0]}, "twice"),
        ({"kcal": order(*map(str, range(65))), "mean": [0.0] * 65}, "too many"),
        ({"kcal": order("fx", "fy", "cx", "cy", "k9"), "mean": [800.0, 800.0, 320.0, 240.0, 0.1]}, "no parameter k9"),
        ({"mean": [800.0]}, "mean"),
        ({"sqrt_information": [[1.0]]}, "sqrt_information"),
    ],
)
def test_a_prior_that_fits_nothing_is_refused(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(FileError, match=message):
        import_cameras(changed(tmp_path, **changes))


def test_a_prior_without_information_is_a_camera(tmp_path: Path) -> None:
    (camera,) = read_prior(changed(tmp_path, sqrt_information=None), Hints()).cameras
    assert camera.calibration is None or camera.calibration.covariance is None
    (camera,) = read_prior(changed(tmp_path, held=["k1", "cx"]), Hints()).cameras
    assert camera.calibration is not None
    variance = dict(zip(camera.names, camera.calibration.covariance.diagonal().tolist(), strict=True))
    assert {name for name, value in variance.items() if value == 0.0} == {"k1", "cx", "skew"}


def test_the_first_model_that_contains_a_lens() -> None:
    """A parameter of zero needs no place; error bars do not go along, the name does."""
    camera = known("opencv5")
    assert held_exactly(camera, ("pinhole", "opencv4")) is None
    camera = camera.with_parameters(torch.cat([camera.params[:-1], torch.zeros(1).double()]))
    camera.calibration = CameraCalibration(name="north", covariance=torch.eye(10).double())
    found = held_exactly(camera, ("pinhole", "fisheye4", "opencv4", "opencv8"))
    assert found is not None
    assert str(found.model) == "opencv4"
    assert torch.equal(found.params, camera.params[:-1])
    assert found.calibration is not None
    assert (found.calibration.name, found.calibration.covariance) == ("north", None)
    camera.params.data[4] = 0.5
    assert held_exactly(camera, ("opencv8",)) is None
    skewed = held_exactly(camera, ("opencv8",), skew=True)
    assert skewed is not None
    assert skewed.params[[4, 5]].tolist() == camera.params[[4, 5]].tolist()
    # A lens of a pinhole by its numbers is one, a fisheye's is none.
    fisheye = Camera.build(focal=(8, 8), center=(3, 2), size=(6, 4), coefficients=[0.0] * 4, model="fisheye4")
    assert held_exactly(fisheye, ("pinhole", "opencv4")) is None
    assert str(held_exactly(fisheye, ("pinhole", "fisheye4")).model) == "fisheye4"  # type: ignore[union-attr]


def test_only_gtsam_has_a_skew() -> None:
    assert {name for name, kind in FORMATS.items() if kind.prior and kind.skew} == {"gtsam"}
