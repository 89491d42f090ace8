"""Error bars of other programs: their files, mrcal's covariance, and grids of splines."""

import base64
import io
import math
import subprocess
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from opencv_files import file_storage
from scipy.interpolate import BSpline
from scipy.io import savemat

from kcal import Camera, FileError, InputError
from kcal.io.format_mrcal import SplineGrid, fit_spline, project_spline, stereographic
from kcal.io.formats import import_cameras, recognized
from kcal.lens import rotation_from_vector

# Cameras of other programs with what these know of them, and lenses that no model of kcal is.


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
    scaled = import_cameras(write(tmp_path, "camera_array.toml", TOML.replace("[cam_", "[cameras.")), meters=1e-3)
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
    assert camera.project(torch.tensor([[x, y, 1.0]], dtype=torch.float64))[0][0].tolist() == pytest.approx(
        [2736 - 17.3 + across * 3241.2 + down * 0.5 - 0.5, 1824 + 51.6 + down * 3239.2 - 0.5], abs=1e-9
    )
    covariance = camera.calibration.covariance
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
    found = {"camera_matrix": k, "distortion_coefficients": d, "stdDeviationsIntrinsics": deviations}
    (camera,) = import_cameras(file_storage(tmp_path / "c.yml", image_width=640, image_height=480, **found)).cameras
    stated = sigmas(camera)
    del stated[4]
    assert stated == pytest.approx(deviations[:9, 0].tolist())


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
    matrix = np.array([[OMNI[1], 0, OMNI[3]], [0, OMNI[2], OMNI[4]], [0, 0, 1]])
    lens = {"camera_matrix": matrix, "distortion_coefficients": np.array(OMNI[5:]), "xi": OMNI[0]}
    other = file_storage(tmp_path / "o.yml", image_width=640, image_height=480, **lens)
    rays = np.concatenate([np.random.default_rng(1).uniform(-1.2, 1.2, (500, 2)), np.ones((500, 1))], 1)
    omnidir = cv2.omnidir.projectPoints(rays[None], np.zeros(3), np.zeros(3), matrix, OMNI[0], np.array([OMNI[5:]]))[0]
    pixels = omnidir.reshape(-1, 2)
    for path in (write(tmp_path, "chain.yaml", chain), other):
        found = import_cameras(path)
        (note,) = (note for note in found.notes if "omni-radtan lens became kcal's hybrid lens" in note)
        stated = float(note.split("at most ")[1].split(" px")[0])
        inside = (pixels > 0).all(1) & (pixels < [639, 479]).all(1)
        seen = found.cameras[0].project_rays(torch.from_numpy(rays[inside]))[0].numpy()
        assert inside.sum() > 200
        assert np.abs(seen - pixels[inside]).max() <= 1.5 * stated < 0.05


# The covariance of a camera from the corners in mrcal's file, as mrcal's own problem has it.


CAMERA = Camera.build(
    focal=(1000, 1001), center=(640, 360), size=(1280, 720), coefficients=[-0.1, 0.02, 1e-3, -5e-4], model="opencv4"
)

SPACING, NOISE = 0.05, 0.2

# mrcal's own derivatives at its solution, without its regularization; noise by degrees of freedom, as kcal has it.
BY_MRCAL = """
import sys, numpy as np, mrcal
model = mrcal.cameramodel(sys.argv[1])
inputs = model.optimization_inputs()
_, x, slopes, _ = mrcal.optimizer_callback(**inputs)
count = inputs["observations_board"].size // 3 * 2
slopes = slopes.toarray()[:count]
unpacked = np.eye(slopes.shape[1])
mrcal.unpack_state(unpacked, **inputs)
covariance = unpacked @ np.linalg.inv(slopes.T @ slopes) @ unpacked.T
number = mrcal.num_intrinsics_optimization_params(**inputs)
np.save(sys.argv[2], covariance[:number, :number] * np.square(x[:count]).sum() / (count - len(covariance)))
"""


def inputs(**changes: Any) -> dict[str, Any]:
    """What mrcal stores of twelve views, at the truth."""
    draw = np.random.default_rng(0)
    frames = np.concatenate(
        [draw.uniform(-0.4, 0.4, (12, 3)), draw.uniform([-0.5, -0.3, 0.8], [0.2, 0.0, 1.4], (12, 3))], 1
    )
    x, y = np.meshgrid(np.arange(7.0), np.arange(7.0))
    warp = np.array([1e-3, -5e-4])
    height = warp[0] * 4 * x / 6 * (1 - x / 6) + warp[1] * 4 * y / 6 * (1 - y / 6)
    board = torch.from_numpy(np.stack([SPACING * x, SPACING * y, height], -1))
    corners = np.ones((12, 7, 7, 3))
    for corner, frame in zip(corners, torch.from_numpy(frames), strict=True):
        seen, _ = CAMERA.project(board.reshape(-1, 3) @ rotation_from_vector(frame[:3]).T + frame[3:])
        corner[..., :2] = seen.reshape(7, 7, 2).numpy() + draw.normal(0, NOISE, (7, 7, 2))
    number = np.arange(12, dtype=np.int32)
    return {
        "intrinsics": np.concatenate([CAMERA.params[:4].numpy(), CAMERA.coefficients.numpy()])[None],
        "extrinsics_rt_fromref": np.zeros((0, 6)),
        "frames_rt_toref": frames,
        "points": "",
        "observations_board": corners,
        "indices_frame_camintrinsics_camextrinsics": np.stack([number, 0 * number, 0 * number - 1], 1).astype(np.int32),
        "observations_point": "",
        "indices_point_camintrinsics_camextrinsics": "",
        "lensmodel": "LENSMODEL_OPENCV4",
        "imagersizes": np.array([[1280, 720]], dtype=np.int32),
        "calobject_warp": warp,
        "do_optimize_intrinsics_core": True,
        "do_optimize_intrinsics_distortions": True,
        "do_optimize_extrinsics": True,
        "do_optimize_frames": True,
        "do_optimize_calobject_warp": True,
        "calibration_object_spacing": SPACING,
        "do_apply_regularization": True,
        "verbose": False,
    } | changes


def written(path: Path, **changes: Any) -> Path:
    return written_as(inputs(**changes), path)


def written_as(stored: dict[str, Any], path: Path) -> Path:
    data = io.BytesIO()
    np.savez_compressed(data, **stored)
    values = [*CAMERA.params[:4].tolist(), *CAMERA.coefficients.tolist()]
    content = {"lensmodel": "LENSMODEL_OPENCV4", "intrinsics": values, "extrinsics": [0.0] * 6,
               "imagersize": [1280, 720], "icam_intrinsics": 0,
               "optimization_inputs": base64.b85encode(data.getvalue())}  # fmt: skip
    path.write_text(repr(content))
    return path


def covariance_of(path: Path) -> np.ndarray:
    (camera,) = import_cameras(path).cameras
    free = [index for index, name in enumerate(camera.names) if name != "skew"]
    found: np.ndarray = camera.calibration.covariance[free][:, free].numpy()
    return found


def test_it_is_that_of_a_dense_problem(tmp_path: Path) -> None:
    """Against a Jacobian by automatic differentiation of everything at once, and noise as it was drawn."""
    stored = inputs()
    modes = torch.from_numpy(np.stack([4 * t / 6 * (1 - t / 6) for t in np.meshgrid(np.arange(7.0), np.arange(7.0))]))
    flat = torch.from_numpy(np.stack([SPACING * t for t in np.meshgrid(np.arange(7.0), np.arange(7.0))], -1))

    def residuals(state: torch.Tensor) -> torch.Tensor:
        values, warp, frames = state[:8], state[8:10], state[10:].reshape(12, 6)
        board = torch.cat([flat, (warp[:, None, None] * modes).sum(0)[..., None]], -1).reshape(-1, 3)
        seen = []
        for frame in frames:
            there = board @ rotation_from_vector(frame[:3]).T + frame[3:]
            x, y = (there[:, :2] / there[:, 2:]).unbind(1)
            r2 = x * x + y * y
            fx, fy, cx, cy, k1, k2, p1, p2 = values
            radial = 1 + k1 * r2 + k2 * r2 * r2
            seen += [fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + cx,
                     fy * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + cy]  # fmt: skip
        return torch.stack(seen).reshape(12, 2, 49)

    start = torch.from_numpy(
        np.concatenate([stored["intrinsics"][0], stored["calobject_warp"], stored["frames_rt_toref"].ravel()])
    )
    slopes = torch.func.jacfwd(residuals)(start).flatten(0, 2)
    corners = torch.from_numpy(stored["observations_board"][..., :2]).reshape(12, 49, 2).movedim(-1, 1)
    errors = residuals(start) - corners
    noise = float(errors.square().sum()) / (errors.numel() - len(start))
    wanted = noise * torch.linalg.inv(slopes.T @ slopes)[:8, :8].numpy()
    found = covariance_of(written(tmp_path / "a.cameramodel"))
    spread = np.sqrt(np.diag(wanted))
    assert np.abs((found - wanted) / (spread[:, None] * spread)).max() < 1e-6
    assert noise == pytest.approx(NOISE**2, rel=0.1)


def test_what_is_not_stored_is_mrcals_default_and_what_was_held_is_certain(tmp_path: Path) -> None:
    """Poses, center, focal lengths and lens are estimated unless the file says otherwise."""
    whole = covariance_of(written(tmp_path / "a.cameramodel"))
    stored = inputs()
    for key in ("do_optimize_frames", "do_optimize_intrinsics_core", "do_optimize_intrinsics_distortions"):
        del stored[key]
    assert np.allclose(covariance_of(written_as(stored, tmp_path / "b.cameramodel")), whole, rtol=1e-12)
    for held, lens in (("core", False), ("distortions", True)):
        found = covariance_of(written(tmp_path / "c.cameramodel", **{f"do_optimize_intrinsics_{held}": False}))
        zero = np.diag(found) == 0
        assert zero.tolist() == [not lens] * 4 + [lens] * 4
        # The others are known better than where all were estimated.
        assert bool((np.diag(found)[~zero] < np.diag(whole)[~zero]).all())
    both = {"do_optimize_intrinsics_core": False, "do_optimize_intrinsics_distortions": False}
    found = import_cameras(written(tmp_path / "d.cameramodel", **both))
    assert "the camera was held" in found.notes[0]


def test_it_is_mrcals_own(tmp_path: Path) -> None:
    if subprocess.run(["/usr/bin/python3", "-c", "import mrcal"], capture_output=True, check=False, env={}).returncode:
        pytest.skip("mrcal is not installed")
    path = written(tmp_path / "a.cameramodel")
    command = ["/usr/bin/python3", "-c", BY_MRCAL, str(path), str(tmp_path / "c.npy")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={})
    assert done.returncode == 0, done.stderr
    wanted = np.load(tmp_path / "c.npy")
    spread = np.sqrt(np.diag(wanted))
    assert np.abs((covariance_of(path) - wanted) / (spread[:, None] * spread)).max() < 1e-6


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"do_optimize_frames": False}, "poses of boards were held"),
        ({"intrinsics": np.full((1, 8), 3.0)}, "are of other intrinsics than the file"),
        ({"observations_board": np.zeros((0, 7, 7, 3))}, "without boards"),
        ({"frames_rt_toref": np.zeros((1, 6))}, "name boards that they do not have"),
    ],
)
def test_inputs_that_say_nothing_are_told(tmp_path: Path, changes: dict[str, Any], reason: str) -> None:
    found = import_cameras(written(tmp_path / "a.cameramodel", **changes))
    assert found.cameras[0].calibration.covariance is None
    assert found.notes[0].startswith("no error bars: ")
    assert reason in found.notes[0]


# mrcal's splined model: its basis, its grid, and fits to rays.


GRID = SplineGrid(11, 8, 100)


def test_grid() -> None:
    """Its columns but two cover the field of view, at equal distances of u = 2 tan(angle / 2)."""
    assert GRID.name == "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=11_Ny=8_fov_x_deg=100"
    assert GRID.per_unit * 2 * 2 * math.tan(math.radians(100) / 4) == pytest.approx(11 - 3)
    rays = np.array([[math.sin(a), 0.0, math.cos(a)] for a in (0.0, 0.5, -1.2)])
    np.testing.assert_allclose(stereographic(3.0 * rays)[:, 0], [2 * math.tan(a / 2) for a in (0.0, 0.5, -1.2)])


def test_weights_are_those_of_cubic_b_splines() -> None:
    u = np.random.default_rng(1).uniform(-0.8, 0.8, (50, 2)) * [1.0, 0.5]
    index, weight = GRID.weights(u)
    dense = np.zeros((len(u), GRID.rows, GRID.columns))
    np.put_along_axis(dense.reshape(len(u), -1), index, weight, 1)
    basis = []
    for values, count in ((u[:, 0], GRID.columns), (u[:, 1], GRID.rows)):
        place = values * GRID.per_unit + 0.5 * (count - 1)
        basis.append(
            np.stack(
                [BSpline.basis_element(np.arange(-2.0, 3.0) + k, extrapolate=False)(place) for k in range(count)], -1
            )
        )
    np.testing.assert_allclose(
        dense, np.nan_to_num(basis[1])[:, :, None] * np.nan_to_num(basis[0])[:, None], atol=1e-12
    )


def test_beyond_the_grid_the_last_piece_goes_on() -> None:
    for u in (np.array([[5.0, 0.0]]), np.array([[-5.0, 0.0]]), np.array([[0.0, 5.0]]), np.array([[0.0, -5.0]])):
        index, weight = GRID.weights(u)
        assert index.min() >= 0
        assert index.max() < GRID.rows * GRID.columns
        assert weight.sum() == pytest.approx(1.0)


def rays_and_pixels(reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Of an equidistant lens of 500 px per radian with another scale and a shift along y."""
    angle, around = (part.ravel() for part in np.meshgrid(np.linspace(0, reach, 40), np.linspace(0, 2 * np.pi, 60)))
    rays = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], -1)
    pixels = angle[:, None] * np.stack([500 * np.cos(around), 510 * np.sin(around)], -1) + [640.0, 400.0]
    return rays, pixels


def test_a_fit_is_exact_where_rays_are() -> None:
    rays, pixels = rays_and_pixels(1.2)
    grid, intrinsics = fit_spline(rays, pixels, (1280, 800))
    assert len(intrinsics) == 4 + 2 * grid.columns * grid.rows
    assert np.abs(project_spline(grid, intrinsics, rays) - pixels).max() < 1e-3
    # The field of view with a margin, and rows for as much of it as is used.
    assert grid.fov_deg == math.ceil(math.degrees(2.4) * 1.02)
    assert grid.columns == 30
    tallest = 2 * math.tan(1.2 / 2)
    assert (grid.rows - 3) / 2 / grid.per_unit >= tallest > (grid.rows - 5) / 2 / grid.per_unit
    # The core is the best line through the places; control points add to it.
    assert intrinsics[2:4] == pytest.approx([640, 400], abs=1.0)
    nothing = np.concatenate([intrinsics[:4], np.zeros(2 * grid.columns * grid.rows)])
    u = stereographic(rays)
    np.testing.assert_allclose(project_spline(grid, nothing, rays), u * intrinsics[:2] + intrinsics[2:4])
    for i in (0, 1):
        assert np.polyfit(u[:, i], pixels[:, i], 1) == pytest.approx(intrinsics[[i, 2 + i]])


def test_too_wide_a_lens() -> None:
    fit_spline(*rays_and_pixels(math.radians(340) / 2), (1280, 800))
    with pytest.raises(InputError, match="reaches to 350°"):
        fit_spline(*rays_and_pixels(math.radians(345) / 2), (1280, 800))
