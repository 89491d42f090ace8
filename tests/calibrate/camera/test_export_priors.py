"""Priors for other programs: the square-root information means what it says, in the other program itself."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lenses import hybrid_camera

from kcal import Camera, InputError
from kcal.io.formats import FORMATS, import_cameras
from kcal.lens import CameraCalibration, ceres_prior, export_cameras
from kcal.lens.uncertainty import carried_covariance, pixel_slopes, square_root_information

PAGE = Path(__file__).parents[3] / "docs" / "howto" / "bundle-adjustment.md"
COLMAP, GTSAM = re.findall(r"^```py\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def known(camera: Camera, relative: float = 1e-4, seed: int = 0) -> Camera:
    """The camera with a covariance in which everything but the skew is correlated."""
    count = len(camera.params)
    draw = torch.randn(count, count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    scale = torch.full((count,), relative, dtype=torch.float64)
    scale[:4], scale[4] = 0.5, 0.0
    half = (torch.eye(count) + 0.3 * draw) * scale
    camera.calibration = CameraCalibration(name="north", covariance=half.T @ half)
    return camera


def camera(model: str = "opencv4", *lens: float) -> Camera:
    lens = lens or (-0.1, 0.02, 1e-3, -5e-4)
    return Camera.build(focal=(800, 805), center=(321, 238), size=(640, 480), coefficients=lens, model=model)


def covariance_of(prior: dict[str, Any]) -> np.ndarray:
    half = np.linalg.inv(np.array(prior["sqrt_information"]))
    return np.asarray(half @ half.T)


@pytest.mark.parametrize("name", [name for name in FORMATS if "opencv4" in FORMATS[name].models])
def test_the_covariance_comes_back_from_every_program(tmp_path: Path, name: str) -> None:
    subject = known(camera())
    done = export_cameras(subject, tmp_path / {"numpy": "a.npz", "bag": "a.mcap"}.get(name, "a.json"), format=name)
    assert "error bars" not in done.lost
    (back,) = import_cameras(done.paths[-1]).cameras
    assert back.calibration.name == "north"
    assert torch.allclose(back.params, subject.params, rtol=1e-12, atol=1e-12)
    stated, wanted = back.calibration.covariance, subject.calibration.covariance
    assert stated is not None
    spread = wanted.diagonal().sqrt()
    assert float(((stated - wanted) / (spread[:, None] * spread + 1e-30)).abs().max()) < 1e-8


def test_parameters_that_were_held_are_held(tmp_path: Path) -> None:
    subject = camera()
    subject.calibration = CameraCalibration(
        covariance=torch.diag(torch.tensor([1.0, 1, 0, 0, 0, 1e-6, 1e-6, 0, 0])).double()
    )
    (path,) = export_cameras(subject, tmp_path / "g.json", format="gtsam").paths
    (prior,) = json.loads(path.read_text())["cameras"]
    assert prior["held"] == ["s", "u0", "v0", "p1", "p2"]
    sigma = np.sqrt(np.diag(covariance_of(prior)))
    assert sigma[0] == pytest.approx(1.0)
    # Ten thousandths of a pixel.
    assert sigma[3] == pytest.approx(1e-4)


def test_parameters_that_are_equal_stay_so() -> None:
    subject = camera()
    both = torch.zeros(9, 9, dtype=torch.float64)
    both[:2, :2] = 4.0
    subject.calibration = CameraCalibration(covariance=both)
    half = torch.linalg.inv(square_root_information(subject, [0, 1])[0])
    assert (half @ half.T).flatten().tolist() == pytest.approx([4.0] * 4, rel=1e-5)
    assert float((half[0] - half[1]).norm()) < 1e-5


def test_a_misfit_is_in_the_covariance() -> None:
    """The image's mean variance is the calibration's and the squared misfit, wherever the truth of a fitted lens is."""
    from kcal.calibrate.camera.export import refit_camera

    subject = hybrid_camera("webcam")
    spread = torch.zeros(len(subject.params), dtype=torch.float64)
    spread[2:4] = 0.05
    subject.calibration = CameraCalibration(covariance=torch.diag(spread.square()))
    fitted = refit_camera(subject, "opencv5")
    found = carried_covariance(subject, fitted.camera, misfit=fitted.rms, width=fitted.width)
    assert found is not None
    places = subject.grid(33, 25).reshape(-1, 2)
    slopes, _, good = pixel_slopes(fitted.camera, places, torch.inf, list(range(len(found))))
    variance = (slopes @ found @ slopes.mT)[good].diagonal(dim1=-2, dim2=-1).sum(-1).mean()
    assert float(variance) == pytest.approx(2 * 0.05**2 + fitted.rms**2, rel=0.02)


def test_two_cameras_have_one_file(tmp_path: Path) -> None:
    done = export_cameras([known(camera()), known(camera(), seed=1)], tmp_path / "cameras.txt")
    assert [path.name for path in done.paths] == ["cameras.txt", "cameras.prior.json"]
    first, second = json.loads(done.paths[1].read_text())["cameras"]
    assert first["mean"] == second["mean"]
    assert first["sqrt_information"] != second["sqrt_information"]


def test_gtsam_takes_it(tmp_path: Path) -> None:
    gtsam = pytest.importorskip("gtsam")
    for subject in (known(camera()), known(camera("fisheye4", 0.02, -0.01, 0.002, -0.001))):
        (path,) = export_cameras(subject, tmp_path / "g.json", format="gtsam").paths
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        names: dict[str, Any] = {"graph": graph, "values": values, "key": 7}
        exec(GTSAM.replace("left.gtsam.json", str(path)), names)
        kind = names["prior"]["model"]
        # GTSAM's lens sees what kcal's does, and its marginal is the camera's covariance.
        ray = torch.tensor([[0.2, -0.15, 1.0]], dtype=torch.float64)
        there = getattr(gtsam, f"PinholeCamera{kind}")(gtsam.Pose3(), names["lens"]).project(ray[0].numpy())
        assert there == pytest.approx(subject.project(ray)[0][0].numpy(), abs=1e-9)
        marginal = gtsam.Marginals(graph, values).marginalCovariance(7)
        assert np.allclose(marginal, covariance_of(names["prior"]), rtol=1e-6, atol=1e-14)
        assert marginal[:2, :2] == pytest.approx(subject.calibration.covariance[:2, :2].numpy(), rel=1e-6)


def test_colmap_takes_it(tmp_path: Path) -> None:
    """An image that sees hardly anything of the lens leaves it where the prior has it, within its σ."""
    pycolmap, _ = pytest.importorskip("pycolmap"), pytest.importorskip("pyceres")
    subject = known(camera())
    cameras, prior = export_cameras(subject, tmp_path / "cameras.txt").paths
    reconstruction = pycolmap.Reconstruction()
    _, model, _, _, *values = cameras.read_text().splitlines()[-1].split()
    lens = pycolmap.Camera(model=model, width=640, height=480, params=list(map(float, values)), camera_id=1)
    mean = lens.params.copy()
    ray = torch.tensor([[0.2, -0.15, 1.0]], dtype=torch.float64)
    assert lens.img_from_cam(ray.numpy())[0] - 0.5 == pytest.approx(subject.project(ray)[0][0].numpy(), abs=1e-9)
    lens.params = mean + np.array([20.0, -10, 5, 5, 0.01, 0.01, 1e-3, 1e-3])
    reconstruction.add_camera_with_trivial_rig(lens)
    points = np.random.default_rng(0).uniform(-2.0, 2.0, (30, 3)) + np.array([0.0, 0.0, 10.0])
    for number, center in enumerate(np.stack([np.linspace(-1.0, 1.0, 4), np.zeros(4), np.zeros(4)], 1), 1):
        seen = subject.project(torch.from_numpy(points - center))[0].numpy() + 0.5
        image = pycolmap.Image(
            f"{number}", pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in seen]), 1, number
        )
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(), -center))
    for index, point in enumerate(points):
        track = pycolmap.Track()
        for number in range(1, 5):
            track.add_element(number, index)
        reconstruction.add_point3D(point, track)
    config = pycolmap.BundleAdjustmentConfig()
    for number in range(1, 5):
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, print_summary=False)
    names = {"options": options, "config": config, "reconstruction": reconstruction}
    exec(COLMAP.replace("cameras.prior.json", str(prior)), names)
    sigma = np.sqrt(np.diag(covariance_of(json.loads(prior.read_text())["cameras"][0])))
    other = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[800, 805, 320, 240])
    with pytest.raises(InputError, match=r"is of OPENCV \(640, 480\) with its error bars; the camera is \('PINHOLE'"):
        ceres_prior(prior, other, pixel_sigma=0.5)
    assert (np.abs(reconstruction.cameras[1].params - mean) < 0.1 * sigma).all()
