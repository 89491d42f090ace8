"""What a file says of its camera and rig at a glance: the numbers are those of the camera and its covariance."""

import dataclasses
import math

import pytest
import torch

from kcal import Camera, Rig
from kcal.io.file_summary import CameraSummary, RigSummary, sigma_of, sigma_over_image, take_joint_errors
from kcal.lens import CameraCalibration, rotation_from_vector
from kcal.lens.uncertainty import image_sigma
from kcal.native_file import digest
from kcal.rig import RigCovariance


def camera(covariance: torch.Tensor | None = None, **known: object) -> Camera:
    made = Camera.build(
        focal=(800, 810), center=(320, 240), size=(640, 480), coefficients=[-0.2, 0.03, 1e-3, -1e-3, 0], model="opencv5"
    )
    made.calibration = CameraCalibration(covariance=covariance, **known)  # type: ignore[arg-type]
    return made


def spread(seed: int) -> torch.Tensor:
    half = torch.randn(10, 10, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    half = half * torch.tensor([1.0, 1.0, 0.5, 0.5, 1e-9, 1e-3, 1e-3, 1e-4, 1e-4, 1e-3])
    half[:, 4] = 0.0  # the skew is held
    return half


def test_sigmas_are_roots_of_variances_with_six_digits() -> None:
    half = spread(1)
    found = sigma_of(camera(half.T @ half))
    assert list(found) == ["fx", "fy", "cx", "cy", "skew", "k1", "k2", "p1", "p2", "k3"]
    assert found["skew"] is None
    for name, sigma in zip(found, half.norm(dim=0).tolist(), strict=True):
        if name != "skew":
            assert found[name] == float(f"{sigma:.6g}")
    # Those that are stored count, where they are; nothing is known without.
    assert sigma_of(camera(half.T @ half, sigma={"fx": 2.0, "k1": None})) == {**dict.fromkeys(found), "fx": 2.0}
    assert sigma_of(camera()) == dict.fromkeys(found)
    bare = camera()
    bare.calibration = None
    assert sigma_of(bare) == dict.fromkeys(found)


def test_sigma_over_the_image() -> None:
    assert sigma_over_image(camera()) is None
    half = spread(2)
    made = camera(half.T @ half)
    median, largest = sigma_over_image(made) or (0.0, 0.0)
    wanted = image_sigma(made)
    assert median == pytest.approx(float(wanted.median()), rel=1e-5)
    assert largest == pytest.approx(float(wanted.max()), rel=1e-5)
    assert 0 < median < largest


def test_a_camera_at_a_glance() -> None:
    half = spread(3)
    content = {"a": 1}
    found = CameraSummary.made(camera(half.T @ half), content)
    assert found is not None
    assert (found.of, found.model, found.board, found.covers_image) == (digest(content), "opencv5", None, True)
    assert found.focal_length.startswith("800.0 ± 3.2 px along rows, 810.0 ± 1.9 px")
    assert found.sigma["fx"] is not None
    assert found.sigma_px is not None


def rig(covariance: bool) -> Rig:
    turn = rotation_from_vector(torch.tensor([0.01, -0.02, 0.03]).double())
    half = torch.randn(30, 26, generator=torch.Generator().manual_seed(4), dtype=torch.float64) * 1e-3
    half[:, -6:-3] *= 0.1
    made = Rig.pair(camera(), camera(), turn, torch.tensor([-10.0, 0.1, 0.2]).double())
    if covariance:
        made.covariance = RigCovariance(half=half)
    return made


def test_a_rig_at_a_glance() -> None:
    made = rig(True)
    found = RigSummary.made(made, {"cameras": [{"x": 1}, {"x": 2}], "more": 3})
    assert found.of == digest({"more": 3})
    left, right = found.cameras
    assert left is not None
    assert right is not None
    assert (left.of, right.of) == (digest({"x": 1}), digest({"x": 2}))
    assert found.baseline_m == pytest.approx(math.sqrt(100.05), rel=1e-5)
    assert found.rotation_vector_deg == pytest.approx([math.degrees(v) for v in (0.01, -0.02, 0.03)], rel=1e-5)
    assert made.covariance is not None
    sigma = made.covariance.half.norm(dim=0)
    assert found.sigma_deg == pytest.approx([math.degrees(v) for v in sigma[-6:-3].tolist()], rel=1e-5)
    assert found.sigma_m == pytest.approx(sigma[-3:].tolist(), rel=1e-5)
    # Each camera has the error bars that the rig has of it; the rig itself keeps its own.
    assert list(left.sigma.values()) == pytest.approx(sigma[:10].tolist(), rel=1e-5)
    assert list(right.sigma.values()) == pytest.approx(sigma[10:20].tolist(), rel=1e-5)
    assert made.left.calibration is not None
    assert made.left.calibration.covariance is None


def test_a_rig_of_which_nothing_is_known() -> None:
    made = rig(False)
    made.left.calibration = dataclasses.replace(made.left.calibration, sigma={"fx": 2.0})  # type: ignore[type-var]
    found = RigSummary.made(made, {})
    assert (found.sigma_m, found.sigma_deg) == (None, None)
    take_joint_errors(made)
    assert made.left.calibration is not None
    assert made.left.calibration.sigma == {"fx": 2.0}


def test_cameras_that_are_exact_have_no_error_bars() -> None:
    made = rig(True)
    assert made.covariance is not None
    half = made.covariance.half.clone()
    half[:, :20] = 0.0
    made.covariance = RigCovariance(half=half)
    for own in RigSummary.made(made, {}).cameras:
        assert own is not None
        assert (own.sigma_px, "±" in own.focal_length) == (None, False)
