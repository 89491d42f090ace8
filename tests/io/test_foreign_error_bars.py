"""Cameras of other programs with what these know of them, and lenses that no model of kcal is."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.io import savemat

from kcal.errors import FileError
from kcal.io.format_kalibr import project_omni
from kcal.io.formats import import_cameras, recognized
from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector

TOML = """[cam_0]
name = "north"
size = [ 640, 480,]
matrix = [ [ 500.0, 0.0, 320.0,], [ 0.0, 501.0, 240.0,], [ 0.0, 0.0, 1.0,],]
distortions = [ -0.1, 0.02, 0.001, -0.002, 0.003,]
rotation = [ 0.1, -0.2, 0.3,]
translation = [ 1.0, 2.0, 3.0,]

[cam_1]
size = [ 640, 480,]
matrix = [ [ 300.0, 0.0, 320.0,], [ 0.0, 301.0, 240.0,], [ 0.0, 0.0, 1.0,],]
distortions = [ 0.1, 0.02, 0.001, -0.002,]
rotation = [ 0.0, 0.0, 0.0,]
translation = [ 0.0, 0.0, 0.0,]
fisheye = true

[metadata]
error = 0.4
"""
QUALISYS = """<?xml version="1.0"?>
<calibration><cameras><camera active="1" calibrated="true" serial="26580" model="Miqus Video" viewrotation="0">
<fov_video left="10" top="20" right="1919" bottom="1087"/>
<transform x="1000" y="2000" z="3000" r11="0" r12="1" r13="0" r21="0" r22="0" r23="1" r31="1" r32="0" r33="0"/>
<intrinsic sensorMaxU="122879" sensorMaxV="69631" focalLengthU="107872" focalLengthV="107880" centerPointU="60827.5"
 centerPointV="32671.5" skew="0" radialDistortion1="-0.045" radialDistortion2="0.139" radialDistortion3="0.01"
 tangentalDistortion1="0.0006" tangentalDistortion2="-0.0004"/>
</camera></cameras></calibration>"""
AGISOFT = """<?xml version="1.0"?>
<document version="1.5"><chunk><sensors next_id="1"><sensor id="0" label="FC6310" type="frame">
<resolution width="5472" height="3648"/>
<calibration type="frame" class="initial"><resolution width="5472" height="3648"/><f>3200</f></calibration>
<calibration type="frame" class="adjusted"><resolution width="5472" height="3648"/><f>3239.2</f><cx>-17.3</cx>
<cy>51.6</cy><b1>2</b1><b2>0.5</b2><k1>-0.006</k1><k2>0.0085</k2><k3>-0.006</k3><p1>0.0039</p1><p2>0.0004</p2>
</calibration><covariance><params>f b1 p1</params><coeffs>4 1 0.001 1 9 0 0.001 0 1e-6</coeffs></covariance>
</sensor></sensors></chunk></document>"""
RESULTS = """Calibration results
====================
Camera-system parameters:
cam0 (/cam0/image_raw):
     type: <class 'aslam_cv.libaslam_cv_python.DistortedPinholeCameraGeometry'>
     distortion: [-0.28  0.07  0.0002  1.8e-05] +- [0.0003 0.0002 2e-05 3e-05]
     projection: [458.6 457.2 367.2 248.3] +- [0.21 0.2 0.3 0.25]
     reprojection error: [-0.000001, 0.000001] +- [0.16, 0.15]
"""


def write(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


def sigmas(camera: Camera) -> list[float]:
    assert camera.calibration is not None
    assert camera.calibration.covariance is not None
    found: list[float] = camera.calibration.covariance.diagonal().sqrt().tolist()
    return found


def test_toml(tmp_path: Path) -> None:
    found = import_cameras(write(tmp_path, "calibration.toml", TOML))
    assert found.names == ("north", "cam_1")
    assert [str(camera.model) for camera in found.cameras] == ["opencv5", "fisheye4"]
    assert found.cameras[0].params.tolist() == [500, 501, 320, 240, 0, -0.1, 0.02, 0.001, -0.002, 0.003]
    turn = rotation_from_vector(torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64))
    assert torch.allclose(found.poses[0].rotation, turn, rtol=0, atol=1e-12)
    assert found.poses[0].translation.tolist() == [1, 2, 3]
    assert "taken as meters" in found.notes[0]
    inside = TOML.replace("[cam_", "[cameras.")
    scaled = import_cameras(write(tmp_path, "camera_array.toml", inside), meters=1e-3)
    assert (len(scaled.cameras), scaled.notes) == (2, ())
    assert scaled.poses[0].translation.tolist() == [0.001, 0.002, 0.003]


def test_qualisys(tmp_path: Path) -> None:
    path = write(tmp_path, "calib.qca.txt", QUALISYS)
    assert recognized(path) == "qualisys"
    found = import_cameras(path)
    (camera,) = found.cameras
    assert camera.size == (1910, 1068)
    # 60827.5 - 31.5 and 32671.5 - 31.5 of 64ths, less the 10 and 20 pixels that are not in the video.
    wanted = [1685.5, 1685.625, 940.25 - 0.3125 + 0.0, 490.0, 0.0, -0.045, 0.139, 0.0006, -0.0004, 0.01]
    assert camera.params.tolist() == pytest.approx(wanted, abs=1e-9)
    # The camera is at (1, 2, 3) m; its x axis is the world's y, and it looks along the world's -x.
    (pose,) = found.poses
    center = -pose.rotation.T @ pose.translation
    assert center.tolist() == pytest.approx([1, 2, 3])
    assert pose.rotation[0].tolist() == [0, 1, 0]
    assert pose.rotation[2].tolist() == [-1, 0, 0]


def test_agisoft_with_its_covariance(tmp_path: Path) -> None:
    path = write(tmp_path, "cameras.xml", AGISOFT)
    assert recognized(path) == "agisoft"
    (camera,) = import_cameras(path).cameras
    x, y = 0.2, -0.1
    r2 = x * x + y * y
    radial = 1 - 0.006 * r2 + 0.0085 * r2**2 - 0.006 * r2**3
    across = x * radial + 0.0039 * (r2 + 2 * x * x) + 2 * 0.0004 * x * y
    down = y * radial + 0.0004 * (r2 + 2 * y * y) + 2 * 0.0039 * x * y
    # The manual's formulas, with the first pixel's center at (0.5, 0.5).
    wanted = [2736 - 17.3 + across * 3241.2 + down * 0.5 - 0.5, 1824 + 51.6 + down * 3239.2 - 0.5]
    assert camera.project(torch.tensor([[x, y, 1.0]], dtype=torch.float64))[0][0].tolist() == pytest.approx(
        wanted, abs=1e-9
    )
    assert camera.calibration is not None
    covariance = camera.calibration.covariance
    assert covariance is not None
    place = camera.names.index
    # fx = f + b1, fy = f, and OpenCV's p2 is Metashape's p1.
    assert covariance[place("fx"), place("fx")] == pytest.approx(4 + 9 + 2 * 1)
    assert covariance[place("fx"), place("fy")] == pytest.approx(5)
    assert covariance[place("fy"), place("p2")] == pytest.approx(1e-3)
    assert covariance[place("p1"), place("p1")] == 0


def test_kalibr_results(tmp_path: Path) -> None:
    path = write(tmp_path, "results-cam.txt", RESULTS)
    with pytest.raises(FileError, match="--size"):
        import_cameras(path)
    found = import_cameras(path, size=(752, 480))
    (camera,) = found.cameras
    assert camera.params.tolist() == [458.6, 457.2, 367.2, 248.3, 0, -0.28, 0.07, 0.0002, 1.8e-05]
    assert sigmas(camera) == pytest.approx([0.21, 0.2, 0.3, 0.25, 0, 0.0003, 0.0002, 2e-05, 3e-05])
    assert any("independent" in note for note in found.notes)


def test_opencv_standard_deviations(tmp_path: Path) -> None:
    draw = np.random.default_rng(0)
    board = np.float32(np.stack([*np.meshgrid(np.arange(7.0), np.arange(6.0)), np.zeros((6, 7))], -1).reshape(-1, 3))
    matrix = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    turns = [draw.uniform(-0.4, 0.4, 3) for _ in range(8)]
    views = [cv2.projectPoints(board, turn, np.array([-3.0, -2.5, 12]), matrix, np.zeros(5))[0] for turn in turns]
    noisy = [np.float32(view + draw.normal(0, 0.1, view.shape)) for view in views]
    _, k, d, _, _, deviations, _, _ = cv2.calibrateCameraExtended([board] * 8, noisy, (640, 480), None, None)
    file = cv2.FileStorage(str(tmp_path / "c.yml"), cv2.FILE_STORAGE_WRITE)
    for name, value in (("image_width", 640), ("image_height", 480), ("camera_matrix", k),
                        ("distortion_coefficients", d), ("stdDeviationsIntrinsics", deviations)):  # fmt: skip
        file.write(name, value)
    file.release()
    (camera,) = import_cameras(tmp_path / "c.yml").cameras
    found = sigmas(camera)
    del found[4]
    assert found == pytest.approx(deviations[:9, 0].tolist())


def test_matlab_errors(tmp_path: Path) -> None:
    errors = {"FocalLengthError": [[0.5, 0.6]], "PrincipalPointError": [[0.7, 0.8]], "SkewError": 0.0,
              "RadialDistortionError": [[1e-3, 2e-3]], "TangentialDistortionError": [[3e-4, 4e-4]]}  # fmt: skip
    lens = {"FocalLength": [[800.0, 801.0]], "PrincipalPoint": [[321.0, 241.0]], "ImageSize": [[480.0, 640.0]],
            "RadialDistortion": [[-0.1, 0.01]], "TangentialDistortion": [[0.0, 0.0]]}  # fmt: skip
    savemat(tmp_path / "m.mat", {"cameraParams": lens, "estimationErrors": {"IntrinsicsErrors": errors}})
    (camera,) = import_cameras(tmp_path / "m.mat").cameras
    assert sigmas(camera) == pytest.approx([0.5, 0.6, 0.7, 0.8, 0, 1e-3, 2e-3, 3e-4, 4e-4])


OMNI = [0.9, 400.0, 402.0, 322.0, 236.0, -0.1, 0.02, 1e-3, -5e-4]


def test_an_omni_lens_is_never_another_silently(tmp_path: Path) -> None:
    """Kalibr's and OpenCV's omni lens becomes a hybrid one, with the distance stated."""
    chain = (f"cam0: {{camera_model: omni, distortion_model: radtan, intrinsics: {OMNI[:5]}, "
             f"distortion_coeffs: {OMNI[5:]}, resolution: [640, 480]}}\n")  # fmt: skip
    file = cv2.FileStorage(str(tmp_path / "o.yml"), cv2.FILE_STORAGE_WRITE)
    matrix = np.array([[OMNI[1], 0, OMNI[3]], [0, OMNI[2], OMNI[4]], [0, 0, 1]])
    for name, value in (("image_width", 640), ("image_height", 480), ("camera_matrix", matrix),
                        ("distortion_coefficients", np.array(OMNI[5:])), ("xi", OMNI[0])):  # fmt: skip
        file.write(name, value)
    file.release()
    draw = np.random.default_rng(1)
    rays = np.concatenate([draw.uniform(-1.2, 1.2, (500, 2)), np.ones((500, 1))], 1)
    kalibr = project_omni(np.array(OMNI), rays)[0]
    omnidir = cv2.omnidir.projectPoints(rays[None], np.zeros(3), np.zeros(3), matrix, OMNI[0], np.array([OMNI[5:]]))[0]
    for path, pixels in ((write(tmp_path, "chain.yaml", chain), kalibr), (tmp_path / "o.yml", omnidir.reshape(-1, 2))):
        found = import_cameras(path)
        (note,) = (note for note in found.notes if "omni-radtan became kcal's hybrid lens" in note)
        stated = float(note.split("at most ")[1].split(" px")[0])
        inside = (pixels > 0).all(1) & (pixels < [639, 479]).all(1)
        seen = found.cameras[0].project_rays(torch.from_numpy(rays[inside]))[0].numpy()
        assert inside.sum() > 200
        assert np.abs(seen - pixels[inside]).max() <= 1.5 * stated < 0.05
