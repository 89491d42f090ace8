"""Files of devices and data sets, each in its program's published form, against the published formula written out here.

Sources of forms and formulas: depthai-core; Azure-Kinect-Sensor-SDK (intrinsic_transformation.c,
mode_specific_calibration.c); librealsense (rsutil.h); Stereolabs' stereo calibration; the EuRoC and KITTI data sets;
Open3D; nuscenes-devkit; DJI's Matrice 4 manual and Mavic 3M image processing guide.
"""

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from command_line import Command
from PIL import Image

from kcal import Camera, FileError
from kcal.io.foreign_lenses import ForeignCamera
from kcal.io.formats import import_cameras, recognized

POINTS = np.array([[x, y, 1.0] for x in (-0.5, -0.1, 0.4) for y in (-0.3, 0.2)])
FOURTEEN = [0.3, -0.06, -4e-5, 8e-5, -0.002, 0.65, -0.04, -0.01, 1e-3, -2e-4, 5e-4, 1e-4, 2e-3, -1e-3]
NONE = [0.0] * 5
D = [-0.2, 0.05, 0.001, -0.002, 0.01]
TURN = cv2.Rodrigues(np.array([0.01, -0.02, 0.03]))[0]


def seen(camera: Camera, points: np.ndarray = POINTS) -> np.ndarray:
    return camera.project(torch.from_numpy(points))[0].numpy()


def opencv(matrix: Any, lens: Any, points: np.ndarray = POINTS) -> np.ndarray:
    none, matrix, lens = np.zeros(3), np.array(matrix, float), np.array(lens, float)
    return cv2.projectPoints(points, none, none, matrix, lens)[0][:, 0]


def off(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.abs(one - other).max())


def plain(fx: float, fy: float, cx: float, cy: float) -> list[list[float]]:
    return [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]


def moved(found: Any, to: int, origin: int, point: np.ndarray) -> np.ndarray:
    """A point of one camera's frame in another's."""
    pose = found.poses[to].after(found.poses[origin].inverse())
    return (pose.rotation.numpy() @ point) + pose.translation.numpy()


def written(folder: Path, name: str, content: Any) -> Path:
    path = folder / name
    path.parent.mkdir(exist_ok=True, parents=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


K = plain(800.0, 801, 640.5, 401.25)


def socket(
    to: int, shift: tuple[float, float, float], kind: int = 0, lens: Any = FOURTEEN, **more: Any
) -> dict[str, Any]:
    place = {"rotationMatrix": TURN.tolist(), "translation": dict(zip("xyz", shift, strict=True)),
             "specTranslation": {"x": -7.5, "y": 0.0, "z": 0.0}, "toCameraSocket": to}  # fmt: skip
    return {"cameraType": kind, "distortionCoeff": list(lens), "extrinsics": place, "height": 800, "width": 1280,
            "intrinsicMatrix": K, "lensPosition": 0, "specHfovDeg": 71.86} | more  # fmt: skip


def eeprom(*cameras: tuple[int, dict[str, Any]]) -> dict[str, Any]:
    return {"batchName": "", "boardName": "DM9098", "cameraData": [list(one) for one in cameras], "version": 7,
            "imuExtrinsics": {"rotationMatrix": [[0.0] * 3] * 3, "toCameraSocket": -1},
            "stereoRectificationData": {"leftCameraSocket": 1, "rightCameraSocket": 2}}  # fmt: skip


class TestDepthai:
    def test_each_socket_stands_where_its_chain_leads(self, tmp_path: Path, command: Command) -> None:
        """A socket's extrinsics map its points to those of `toCameraSocket`: p' = R p + t, t in centimeters."""
        data = eeprom((0, socket(-1, (0, 0, 0))), (1, socket(2, (-7.5, 0.1, 0.2))), (2, socket(0, (3.75, 0, 0.1))))
        found = import_cameras(written(tmp_path, "oak.json", data))
        assert (found.format, found.names) == ("depthai", ("CAM_A", "CAM_B", "CAM_C"))
        assert off(seen(found.cameras[1]), opencv(K, FOURTEEN)) < 1e-9
        point = np.array([0.3, -0.2, 2.0])
        right = TURN @ point + [-0.075, 0.001, 0.002]
        assert moved(found, 2, 1, point) == pytest.approx(right, abs=1e-12)
        assert moved(found, 0, 1, point) == pytest.approx(TURN @ right + [0.0375, 0, 0.001], abs=1e-12)
        assert "CAM_A, CAM_B, CAM_C" in command("import", tmp_path / "oak.json", "-o", tmp_path / "rig.json").out

    def test_sockets_that_lead_in_a_circle_have_no_poses(self, tmp_path: Path) -> None:
        data = eeprom((0, socket(-1, (0, 0, 0))), (1, socket(2, (1, 0, 0))), (2, socket(1, (1, 0, 0))))
        found = import_cameras(written(tmp_path, "oak.json", data))
        assert (len(found.cameras), found.poses) == (3, ())

    def test_fisheyes_and_cameras_that_are_none(self, tmp_path: Path) -> None:
        four = [0.05, -0.01, 0.003, -0.001]
        wide = socket(-1, (0, 0, 0), kind=1, lens=[*four, *[0.0] * 10])
        empty = socket(-1, (0, 0, 0), intrinsicMatrix=[[0.0] * 3] * 3)
        other = socket(-1, (0, 0, 0), kind=3)
        found = import_cameras(written(tmp_path, "oak.json", eeprom((1, wide), (2, empty), (3, other))))
        assert found.names == ("CAM_B",)
        wanted = cv2.fisheye.projectPoints(POINTS[:, None], np.zeros(3), np.zeros(3), np.array(K), np.array(four))[0]
        assert off(seen(found.cameras[0]), wanted[:, 0]) < 1e-9
        assert "CAM_C is not calibrated" in found.notes
        assert "radial division" in found.unread["CAM_D"]


def kinect(location: str, size: tuple[int, int], kind: str = "BrownConrady") -> tuple[dict[str, Any], np.ndarray]:
    """A camera and its parameters, by the name of each as the SDK has it: cx cy fx fy k1..k6 codx cody p2 p1."""
    given = np.array([0.51, 0.49, 0.48, 0.64, 0.4, -2.5, 1.5, 0.3, -2.3, 1.4, 0, 0, -3e-4, 4e-4])
    lens = {"ModelParameterCount": 14, "ModelParameters": given.tolist(),
            "ModelType": f"CALIBRATION_LensDistortionModel{kind}"}  # fmt: skip
    place = {"Rotation": np.eye(3).ravel().tolist(), "Translation": [0.0, 0.0, 0.0]}
    if location == "PV0":
        place = {"Rotation": TURN.ravel().tolist(), "Translation": [-0.032, -0.002, 0.004]}
    return {"Intrinsics": lens, "Location": f"CALIBRATION_CameraLocation{location}", "MetricRadius": 1.7, "Rt": place,
            "Purpose": "x", "SensorWidth": size[0], "SensorHeight": size[1]}, given  # fmt: skip


def k4a(given: np.ndarray, binned: tuple[int, int], crop: tuple[int, int]) -> np.ndarray:
    """The SDK's projection for a mode; the SDK's pixels have (0, 0) in the center of the first one."""
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = given
    x, y = POINTS[:, 0], POINTS[:, 1]
    rs = x * x + y * y
    d = (1 + k1 * rs + k2 * rs**2 + k3 * rs**3) / (1 + k4 * rs + k5 * rs**2 + k6 * rs**3)
    xd = x * d + (rs + 2 * x * x) * p2 + 2 * x * y * p1
    yd = y * d + (rs + 2 * y * y) * p1 + 2 * x * y * p2
    return np.stack([xd * fx * binned[0] + cx * binned[0] - crop[0] - 0.5,
                     yd * fy * binned[1] + cy * binned[1] - crop[1] - 0.5], 1)  # fmt: skip


class TestAzureKinect:
    @pytest.mark.parametrize(
        ("size", "camera", "binned", "crop"),
        [
            (None, 0, (1024, 1024), (0, 0)),
            ((640, 576), 0, (1024, 1024), (192, 180)),
            ((320, 288), 0, (512, 512), (96, 90)),
            (None, 1, (4096, 3072), (0, 0)),
            ((1920, 1080), 1, (1920, 1440), (0, 180)),
            ((1280, 720), 1, (1280, 960), (0, 120)),
        ],
    )
    def test_modes(self, tmp_path: Path, size: Any, camera: int, binned: Any, crop: Any) -> None:
        (depth, given), (color, _) = kinect("D0", (1024, 1024)), kinect("PV0", (4096, 3072))
        path = written(tmp_path, "calibration.json", {"CalibrationInformation": {"Cameras": [depth, color]}})
        found = import_cameras(path, size=size)
        assert (found.format, found.names) == ("Azure Kinect", ("depth", "color"))
        assert off(seen(found.cameras[camera]), k4a(given, binned, crop)) < 1e-9
        assert found.cameras[camera].size == (size or binned)
        point = np.array([0.3, -0.2, 2.0])
        assert moved(found, 1, 0, point) == pytest.approx(TURN @ point + [-0.032, -0.002, 0.004], abs=1e-12)
        assert any("--size 1920x1080" in note for note in found.notes) == (size is None)

    def test_color_of_a_sensor_of_16_to_9_is_that_of_4_to_3(self, tmp_path: Path) -> None:
        color, given = kinect("PV0", (4096, 2304))
        path = written(tmp_path, "calibration.json", {"CalibrationInformation": {"Cameras": [color]}})
        # The same rows of the sensor, of which 4:3 has 384 more above.
        assert off(seen(import_cameras(path).cameras[0]), k4a(given, (4096, 2304), (0, -384))) < 1e-9

    def test_other_lenses_and_sizes_are_refused(self, tmp_path: Path) -> None:
        (old, _), (depth, _) = kinect("D0", (1024, 1024), "Rational6KT"), kinect("D0", (1024, 1024))
        path = written(tmp_path, "calibration.json", {"CalibrationInformation": {"Cameras": [old]}})
        with pytest.raises(FileError, match="Rational6KT"):
            import_cameras(path)
        path = written(tmp_path, "calibration.json", {"CalibrationInformation": {"Cameras": [depth]}})
        with pytest.raises(FileError, match="no mode has images of"):
            import_cameras(path, size=(800, 600))


RS = (-0.055, 0.066, 7e-4, -9e-4, -0.021)


def forward(kind: str, c: tuple[float, ...] = RS) -> np.ndarray:
    """librealsense's rs2_project_point_to_pixel with f = (640, 641) and p = (635, 356)."""
    x, y = POINTS[:, 0], POINTS[:, 1]
    if kind == "ftheta":
        r = np.hypot(x, y)
        scale = np.arctan(2 * r * math.tan(c[0] / 2)) / c[0] / r
        return np.stack([x * scale * 640 + 635, y * scale * 641 + 356], 1)
    if kind == "kannala_brandt4":
        r = np.hypot(x, y)
        t = np.arctan(r)
        scale = t * (1 + t**2 * (c[0] + t**2 * (c[1] + t**2 * (c[2] + t**2 * c[3])))) / r
        return np.stack([x * scale * 640 + 635, y * scale * 641 + 356], 1)
    r2 = x * x + y * y
    f = 1 + c[0] * r2 + c[1] * r2**2 + c[4] * r2**3
    a, b = (x * f, y * f) if kind == "modified_brown_conrady" else (x, y)
    xd = x * f + 2 * c[2] * a * b + c[3] * (r2 + 2 * a * a)
    yd = y * f + 2 * c[3] * a * b + c[2] * (r2 + 2 * b * b)
    return np.stack([xd * 640 + 635, yd * 641 + 356], 1)


def rs2(model: str, coeffs: tuple[float, ...] = RS) -> dict[str, Any]:
    return {"width": 1280, "height": 720, "ppx": 635.0, "ppy": 356.0, "fx": 640.0, "fy": 641.0, "model": model,
            "coeffs": list(coeffs)}  # fmt: skip


class TestRealSense:
    @pytest.mark.parametrize(
        ("kind", "coeffs", "most"),
        [
            ("brown_conrady", RS, 1e-9),
            ("kannala_brandt4", (0.05, -0.01, 0.003, -0.001, 0.0), 1e-9),
            ("modified_brown_conrady", RS, 1e-4),
            ("ftheta", (0.9, 0.0, 0.0, 0.0, 0.0), 1e-5),
        ],
    )
    @pytest.mark.parametrize("name", ["distortion.{}", "RS2_DISTORTION_{}"])
    def test_models(self, tmp_path: Path, kind: str, coeffs: Any, most: float, name: str) -> None:
        text = name.format(kind if name.islower() else kind.upper())
        found = import_cameras(written(tmp_path, "color.json", rs2(text, coeffs)))
        assert off(seen(found.cameras[0]), forward(kind, coeffs)) < most
        assert found.cameras[0].size == (1280, 720)
        assert any("RMS" in note for note in found.notes) == (most > 1e-8)

    def test_the_inverse_one_is_read_in_its_direction(self, tmp_path: Path) -> None:
        """The ray of a pixel is the polynomial of the pixel's place, and not the other way."""
        found = import_cameras(written(tmp_path, "color.json", rs2("distortion.inverse_brown_conrady")))
        pixels = np.array([[100.0, 80], [640, 360], [1200, 650], [300, 500]])
        x, y = (pixels[:, 0] - 635) / 640, (pixels[:, 1] - 356) / 641
        r2, c = x * x + y * y, RS
        f = 1 + c[0] * r2 + c[1] * r2**2 + c[4] * r2**3
        rays = np.stack([x * f + 2 * c[2] * x * y + c[3] * (r2 + 2 * x * x),
                         y * f + 2 * c[3] * x * y + c[2] * (r2 + 2 * y * y), np.ones(4)], 1)  # fmt: skip
        assert off(seen(found.cameras[0], rays), pixels) < 1e-4
        assert np.abs(seen(found.cameras[0], rays) - opencv(plain(640, 641, 635, 356), RS, rays)).max() > 5
        assert any("px away" in note and "modified_brown_conrady" in note for note in found.notes)

    @pytest.mark.parametrize("kind", ["modified_brown_conrady", "inverse_brown_conrady", "ftheta", "brown_conrady"])
    def test_without_coefficients_all_are_a_pinhole(self, tmp_path: Path, kind: str) -> None:
        found = import_cameras(written(tmp_path, "color.json", rs2(f"distortion.{kind}", (0.0,) * 5)))
        assert off(seen(found.cameras[0]), forward("brown_conrady", (0.0,) * 5)) < 1e-9

    def test_another_ftheta_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(FileError, match="ftheta with more than one coefficient"):
            import_cameras(written(tmp_path, "color.json", rs2("ftheta", (0.9, 0.1, 0.0, 0.0, 0.0))))

    def test_the_text_of_rs_enumerate_devices(self, tmp_path: Path) -> None:
        def intrinsic(stream: str, size: str, lens: str, coeffs: Any) -> str:
            width, height = size.split("x")
            return (f' Intrinsic of "{stream}" / {size} / {{YUYV}}\n  Width: \t{width}\n  Height:     \t{height}\n'
                    f"  PPX:        \t635\n  PPY:        \t356\n  Fx:         \t640\n  Fy:         \t641\n"
                    f"  Distortion: \t{lens}\n  Coeffs:     \t{'  '.join(map(str, coeffs))}  \n"
                    "  FOV (deg):  \t90.1 x 58.7\n\n")  # fmt: skip

        text = "Device info: \n    Name                          : \tIntel RealSense D455\n\nStream Profiles\n\n"
        text += intrinsic("Color", "1280x720", "Brown Conrady", RS) + intrinsic(
            "Depth", "640x480", "Brown Conrady", [0] * 5
        )
        text += 'Extrinsic from "Depth"\t  To\t  "Color" :\n Rotation Matrix:\n   1 0 0\n   0 1 0\n   0 0 1\n'
        path = written(tmp_path, "d455.txt", text)
        found = import_cameras(path)
        assert (found.format, found.names) == ("RealSense", ("Color 1280x720", "Depth 640x480"))
        assert off(seen(found.cameras[0]), forward("brown_conrady")) < 1e-9
        assert import_cameras(path, size=(640, 480)).names == ("Depth 640x480",)
        with pytest.raises(FileError, match="no camera of these images"):
            import_cameras(path, size=(848, 480))


def zed(lens: str = "k1=-0.17\nk2=0.025\np1=1e-4\np2=-2e-4\nk3=0.003\n", disto: str = "") -> str:
    names = {"2K": 1400, "FHD": 1400, "HD": 700, "VGA": 350}
    text = "".join(f"[{side}_CAM_{name}]\nfx={f}\nfy={f + 1}\ncx={f * 0.8}\ncy={f * 0.46}\n{lens}\n"
                   for name, f in names.items() for side in ("LEFT", "RIGHT"))  # fmt: skip
    turns = "".join(
        f"{key}_{name}={value}\n" for key, value in (("CV", -0.02), ("RX", 0.01), ("RZ", 0.03)) for name in names
    )
    return text + disto + f"[STEREO]\nBaseline=119.9\nTY=0.05\nTZ=-0.3\n{turns}"


class TestZed:
    def test_a_pair(self, tmp_path: Path, command: Command) -> None:
        path = written(tmp_path, "SN1234.conf", zed())
        found = import_cameras(path, size=(1280, 720))
        assert (found.format, found.names) == ("ZED", ("left", "right"))
        wanted = opencv(plain(700, 701, 560, 322), [-0.17, 0.025, 1e-4, -2e-4, 0.003])
        assert off(seen(found.cameras[0]), wanted) < 1e-9
        point = np.array([0.3, -0.2, 2.0])
        assert moved(found, 1, 0, point) == pytest.approx(TURN @ point + [-0.1199, 5e-5, -3e-4], abs=1e-12)
        assert any("TY and TZ" in note for note in found.notes)
        every = import_cameras(path)
        assert len(every.cameras) == 8
        assert "--size 2208x1242" in every.notes[0]
        with pytest.raises(FileError, match=r"no camera of \(800, 600\)"):
            import_cameras(path, size=(800, 600))
        assert "baseline 0.1199 m" in command("import", path, "--size 1280x720 -o", tmp_path / "rig.json").out

    def test_coefficients_for_all_resolutions(self, tmp_path: Path) -> None:
        eight = dict(zip(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), FOURTEEN, strict=False))
        rows = "".join(f"{key} = {value}\n" for key, value in eight.items())
        text = zed("", f"[LEFT_DISTO]\n{rows}[RIGHT_DISTO]\n{rows}")
        camera = import_cameras(written(tmp_path, "SN.conf", text), size=(1280, 720)).cameras[1]
        assert off(seen(camera), opencv(plain(700, 701, 560, 322), FOURTEEN[:8])) < 1e-9
        four = "".join(f"k{i + 1} = {value}\n" for i, value in enumerate((0.05, -0.01, 0.003, -0.001)))
        text = zed("", f"[LEFT_DISTO]\n{four}[RIGHT_DISTO]\n{four}")
        assert str(import_cameras(written(tmp_path, "SN.conf", text), size=(1280, 720)).cameras[0].model) == "fisheye4"


def test_two_files_of_euroc_are_a_rig(tmp_path: Path, command: Command) -> None:
    """T_BS maps points of the sensor to those of the body."""
    first, second = np.eye(4), np.eye(4)
    first[:3, :3], first[:3, 3] = TURN, [0.01, 0.02, 0.03]
    second[:3, :3], second[:3, 3] = TURN.T, [0.12, 0.02, 0.03]
    paths = []
    for name, whole in (("cam0", first), ("cam1", second)):
        text = ("# General sensor definitions.\nsensor_type: camera\ncomment: VI-Sensor cam0 (MT9M034)\n\n"
                f"T_BS:\n  cols: 4\n  rows: 4\n  data: {whole.ravel().tolist()}\n\nrate_hz: 20\n"
                "resolution: [752, 480]\ncamera_model: pinhole\n"
                "intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv\n"
                f"distortion_model: radial-tangential\ndistortion_coefficients: {D[:4]}\n")  # fmt: skip
        paths.append(written(tmp_path, f"{name}/sensor.yaml", text))
    found = import_cameras(*paths)
    assert (found.format, found.names) == ("EuRoC", ("cam0", "cam1"))
    assert np.abs(seen(found.cameras[0]) - opencv(plain(458.654, 457.296, 367.215, 248.375), D[:4])).max() < 1e-9
    point = np.array([0.3, -0.2, 2.0, 1.0])
    assert moved(found, 1, 0, point[:3]) == pytest.approx((np.linalg.inv(second) @ first @ point)[:3], abs=1e-12)
    command("import", *paths, "-o", tmp_path / "rig.json")


def numbers(values: Any) -> str:
    return " ".join(f"{value:.12e}" for value in np.ravel(values))


class TestKitti:
    def test_projections_of_rectified_images(self, tmp_path: Path) -> None:
        left = np.array([[721.5, 0, 609.6, 0], [0, 721.5, 172.9, 0], [0, 0, 1, 0]])
        right = left + np.array([[0, 0, 0, -387.6], [0, 0, 0, 2.1], [0, 0, 0, 0.003]])
        text = f"P0: {numbers(left)}\nP1: {numbers(right)}\nTr: {numbers(np.eye(4)[:3])}\n"
        path = written(tmp_path, "calib.txt", text)
        found = import_cameras(path, size=(1242, 375))
        assert (found.format, found.names) == ("KITTI", ("camera_0", "camera_1"))
        pose = found.poses[1]
        for point in np.array([[0.3, -0.2, 2.0], [-4, 1, 30]]):
            there = right @ [*point, 1]
            pixel = seen(found.cameras[1], (pose.rotation.numpy() @ point + pose.translation.numpy())[None])[0]
            assert pixel == pytest.approx(there[:2] / there[2], abs=1e-9)
        with pytest.raises(FileError, match="image size is not in the file"):
            import_cameras(path)

    def test_raw_and_rectified_cameras(self, tmp_path: Path) -> None:
        matrix, shift = plain(984.2, 980.8, 690, 233), [-0.537, 0.006, -0.013]
        text = "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.950000e-02\n"
        for one in ("00", "01"):
            turn, place = (np.eye(3), np.zeros(3)) if one == "00" else (TURN, shift)
            rect = np.array([[721.5, 0, 609.6, 0 if one == "00" else -387.6], [0, 721.5, 172.9, 0], [0, 0, 1, 0]])
            text += (f"S_{one}: {numbers([1392, 512])}\nK_{one}: {numbers(matrix)}\nD_{one}: {numbers(D)}\n"
                     f"R_{one}: {numbers(turn)}\nT_{one}: {numbers(place)}\nS_rect_{one}: {numbers([1242, 375])}\n"
                     f"R_rect_{one}: {numbers(np.eye(3))}\nP_rect_{one}: {numbers(rect)}\n")  # fmt: skip
        path = written(tmp_path, "calib_cam_to_cam.txt", text)
        found = import_cameras(path)
        assert found.names == ("camera_00", "camera_01")
        assert off(seen(found.cameras[1]), opencv(matrix, D)) < 1e-6
        point = np.array([0.3, -0.2, 2.0])
        assert moved(found, 1, 0, point) == pytest.approx(TURN @ point + shift, abs=1e-9)
        assert "--size 1242x375" in found.notes[0]
        rectified = import_cameras(path, size=(1242, 375))
        assert np.abs(seen(rectified.cameras[1]) - opencv(plain(721.5, 721.5, 609.6, 172.9), NONE)).max() < 1e-6
        assert float(rectified.rig().baseline) == pytest.approx(387.6 / 721.5)
        with pytest.raises(FileError, match="no camera of"):
            import_cameras(path, size=(640, 480))


class TestOpen3d:
    def test_columns(self, tmp_path: Path) -> None:
        flat = [525.0, 0.0, 0.0, 0.0, 526.0, 0.0, 319.5, 239.5, 1.0]
        own = {"width": 640, "height": 480, "intrinsic_matrix": flat}
        whole = np.eye(4)
        whole[:3, :3], whole[:3, 3] = TURN, [0.1, 0.2, 0.3]
        item = {"class_name": "PinholeCameraParameters", "extrinsic": whole.T.ravel().tolist(), "intrinsic": own,
                "version_major": 1, "version_minor": 0}  # fmt: skip
        for content in (own, item, {"class_name": "PinholeCameraTrajectory", "parameters": [item, item]}):
            found = import_cameras(written(tmp_path, "intrinsic.json", content))
            assert found.format == "Open3D"
            (camera,) = found.cameras
            assert np.abs(seen(camera) - opencv(plain(525, 526, 319.5, 239.5), NONE)).max() < 1e-9
        (pose,) = import_cameras(written(tmp_path, "camera.json", item)).poses
        assert off(pose.rotation.numpy(), TURN) < 1e-12
        assert pose.translation.tolist() == pytest.approx([0.1, 0.2, 0.3])

    def test_rows_are_not_turned(self, tmp_path: Path) -> None:
        own = {"width": 640, "height": 480, "intrinsic_matrix": [525.0, 0, 319.5, 0, 526, 239.5, 0, 0, 1]}
        assert import_cameras(written(tmp_path, "camera.json", own)).format == "opencv"


def test_cameras_of_nuscenes_stand_on_the_vehicle(tmp_path: Path) -> None:
    """A quaternion (w, x, y, z) and a translation lead from the camera to the vehicle."""
    half = 0.5 * 1.7
    record = {"token": "a", "sensor_token": "s", "translation": [1.7, 0.02, 1.51],
              "rotation": [math.cos(half), math.sin(half), 0.0, 0.0],
              "camera_intrinsic": [[1266.4, 0.0, 816.3], [0.0, 1266.4, 491.5], [0.0, 0.0, 1.0]]}  # fmt: skip
    lidar = record | {"token": "l", "sensor_token": "t", "camera_intrinsic": []}
    second = record | {"token": "b", "sensor_token": "u", "translation": [1.5, 0.5, 1.5]}
    path = written(tmp_path, "calibrated_sensor.json", [record, lidar, second])
    found = import_cameras(path, size=(1600, 900))
    assert (found.format, found.names) == ("nuScenes", ("a", "b"))
    assert off(seen(found.cameras[0]), opencv(record["camera_intrinsic"], NONE)) < 1e-9
    turn = cv2.Rodrigues(np.array([1.7, 0, 0]))[0]
    point = np.array([0.3, -0.2, 2.0])
    pose = found.poses[0].inverse()
    assert pose.rotation.numpy() @ point + pose.translation.numpy() == pytest.approx(
        turn @ point + record["translation"]
    )
    again = import_cameras(
        written(tmp_path, "calibrated_sensor.json", [record, record | {"token": "c"}]), size=(1600, 900)
    )
    assert (again.names, again.poses) == (("a", "c"), ())
    with pytest.raises(FileError, match="image size is not in the file"):
        import_cameras(path)


XMP = ('<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
       '<rdf:Description rdf:about="DJI Meta Data" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {}/></rdf:RDF>'
       "</x:xmpmeta>")  # fmt: skip
DEWARP = ('drone-dji:DewarpData="2018-03-13;3659.780000000000,3653.170000000000,-7.710000000000,45.900000000000,'
          '-0.269478000000,0.115681000000,-0.000087561900,-0.000306177000,-0.035762800000"')  # fmt: skip
DESIGN = ('drone-dji:CalibratedFocalLength="3666.666504" drone-dji:CalibratedOpticalCenterX="2432.0" '
          'drone-dji:CalibratedOpticalCenterY="1824.0"')  # fmt: skip


def photo(path: Path, xmp: str, size: tuple[int, int] = (4864, 3648)) -> Path:
    Image.new("L", size, 128).save(path, xmp=XMP.format(xmp).encode() if xmp else b"", quality=10)
    return path


class TestDji:
    def test_dewarp_data(self, tmp_path: Path, command: Command) -> None:
        found = import_cameras(photo(tmp_path / "DJI_0001.JPG", DEWARP))
        matrix = [[3659.78, 0, 2432 - 7.71], [0, 3653.17, 1824 + 45.9], [0, 0, 1]]
        lens = [-0.269478, 0.115681, -0.0000875619, -0.000306177, -0.0357628]
        assert (found.format, found.names, found.notes) == ("DJI", ("DJI_0001",), ())
        assert off(seen(found.cameras[0]), opencv(matrix, lens)) < 1e-9
        command("import", tmp_path / "DJI_0001.JPG", "-o", tmp_path / "m.camera.json")

    def test_eight_coefficients(self, tmp_path: Path) -> None:
        values = "2025-01-01;3700,3701,1,2,0.1,0.2,0.001,0.002,0.3,0.4,0.5,0.6"
        more = f'drone-dji:DewarpFlag="0" drone-dji:DewarpDataK6="{values}"'
        camera = import_cameras(photo(tmp_path / "a.jpg", more)).cameras[0]
        assert np.abs(seen(camera) - opencv(plain(3700, 3701, 2433, 1826),
                                            [0.1, 0.2, 0.001, 0.002, 0.3, 0.4, 0.5, 0.6])).max() < 1e-9  # fmt: skip

    def test_the_design_of_the_camera_is_said_to_be_one(self, tmp_path: Path) -> None:
        found = import_cameras(photo(tmp_path / "a.jpg", DESIGN))
        assert np.abs(seen(found.cameras[0]) - opencv(plain(3666.666504, 3666.666504, 2432, 1824), NONE)).max() < 1e-9
        assert any("not a calibration" in note for note in found.notes)

    @pytest.mark.parametrize(
        ("xmp", "words"),
        [
            (DEWARP + ' drone-dji:DewarpFlag="1"', "removed the distortion"),
            ("", "an image without its camera"),
            ('drone-dji:DewarpData="2018-03-13;3659,3653,1"', "DewarpData has 3 numbers"),
        ],
    )
    def test_refused(self, tmp_path: Path, xmp: str, words: str) -> None:
        with pytest.raises(FileError, match=words):
            import_cameras(photo(tmp_path / "a.jpg", xmp, (640, 480)))


def test_photonvision(tmp_path: Path) -> None:
    """Matrices as OpenCV's Java binding has them, a size of floats, and what was seen of the board."""

    def matrix(rows: int, cols: int, data: list[float]) -> dict[str, Any]:
        return {"rows": rows, "cols": cols, "type": 6, "data": data}

    content = {"resolution": {"width": 1280.0, "height": 720.0}, "cameraIntrinsics": matrix(3, 3, np.ravel(K).tolist()),
               "distCoeffs": matrix(1, 8, FOURTEEN[:8]), "calobjectWarp": [1e-4, -2e-4],
               "calobjectSize": {"width": 8.0, "height": 8.0},
               "calobjectSpacing": 0.0254, "lensmodel": "LENSMODEL_OPENCV",
               "observations": [{"locationInObjectSpace": [{"x": 0.0, "y": 0.0, "z": 0.0}], "name": "a"}]}  # fmt: skip
    camera = import_cameras(written(tmp_path, "camera.json", content)).cameras[0]
    assert camera.size == (1280, 720)
    assert off(seen(camera), opencv(K, FOURTEEN[:8])) < 1e-9


INFO = """header:
  seq: 12
  stamp:
    secs: 1700000000
    nsecs: 5
  frame_id: "{frame}"
height: 720
width: 1280
distortion_model: "plumb_bob"
{D}: {lens}
{K}: {k}
{R}: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
{P}: [800.0, 0.0, 640.5, 0.0, 0.0, 801.0, 401.25, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 0
roi:
  x_offset: 0
  y_offset: 0
  height: 0
  width: 0
  do_rectify: False
---
"""


def message(frame: str = "camera", lens: list[float] = D, old: bool = False) -> str:
    names = {key: key if old else key.lower() for key in "DKRP"}
    # ROS 2 prints a list as a block.
    values = (lens, np.ravel(K).tolist())
    shown = values if old else ["\n" + "\n".join(f"- {value}" for value in one) for one in values]
    return INFO.format(frame=frame, lens=shown[0], k=shown[1], **names)


class TestEchoed:
    @pytest.mark.parametrize("old", [False, True])
    @pytest.mark.parametrize("count", [1, 3])
    def test_messages_of_one_camera(self, tmp_path: Path, old: bool, count: int) -> None:
        text = "".join(message(old=old).replace("1700000000", f"17000000{i}") for i in range(count))
        found = import_cameras(written(tmp_path, "info.yaml", text))
        (camera,) = found.cameras
        assert (found.format, found.names) == ("ros", ("info",))
        assert off(seen(camera), opencv(K, D)) < 1e-9

    def test_of_two_cameras(self, tmp_path: Path) -> None:
        text = message("left") + message("right", [0.1, 0.0, 0.0, 0.0, 0.0])
        found = import_cameras(written(tmp_path, "info.txt", text))
        assert found.names == ("left", "right")
        assert off(seen(found.cameras[1]), opencv(K, [0.1, 0, 0, 0, 0])) < 1e-9

    def test_of_one_camera_that_differ_are_refused(self, tmp_path: Path) -> None:
        text = message("left") + message("left", [0.1, 0.0, 0.0, 0.0, 0.0])
        with pytest.raises(FileError, match="messages of left differ"):
            import_cameras(written(tmp_path, "info.yaml", text))

    def test_the_ini_of_the_calibrator(self, tmp_path: Path) -> None:
        rows = "\n".join(" ".join(map(str, row)) for row in K)
        text = (f"# oST version 5.0 parameters\n\n\n[image]\n\nwidth\n1280\n\nheight\n720\n\n"
                f"[narrow]\n\ncamera matrix\n{rows}\n\ndistortion\n{' '.join(map(str, D))}\n\n"
                "rectification\n1 0 0\n0 1 0\n0 0 1\n\nprojection\n800 0 640 0\n0 801 401 0\n0 0 1 0\n")  # fmt: skip
        found = import_cameras(written(tmp_path, "ost.ini", text))
        assert (found.format, found.names) == ("ros", ("narrow",))
        assert off(seen(found.cameras[0]), opencv(K, D)) < 1e-9


@pytest.mark.parametrize("names", [("camera_matrix", "distortion_coefficients"), ("cameraMatrix", "dist_coeffs")])
def test_error_bars_of_opencvs_interactive_calibration(tmp_path: Path, names: tuple[str, str]) -> None:
    """One focal length is stated once: the other one's is 0."""
    matrix, lens = names
    content = {"cameraResolution": [1280, 720], matrix: plain(905.5, 905.5, 654.3, 398.5),
               f"{matrix}_std_dev": [0.0, 6.2, 1.9, 1.7], lens: [0.0, -0.1, 0.0, 0.0, 0.06],
               f"{lens}_std_dev": [0.0, 0.013, 0.0, 0.0, 0.027]}  # fmt: skip
    (camera,) = import_cameras(written(tmp_path, "c.json", content)).cameras
    assert camera.calibration is not None
    sigma = camera.calibration.sigma
    assert [sigma[name] for name in ("fx", "fy", "cx", "cy")] == [6.2, 6.2, 1.9, 1.7]
    assert [sigma[name] for name in ("k1", "k2", "k3")] == [None, 0.013, 0.027]


def test_xi_and_alpha_are_a_double_sphere(tmp_path: Path) -> None:
    own = {"fx": 340.0, "fy": 341.0, "cx": 640.0, "cy": 480.0, "alpha": 0.558, "Xi": -3.5e-3}
    found = import_cameras(written(tmp_path, "c.json", {"resolution": [1280, 960], "params_ds": own}))
    assert "its ds lens" in found.notes[0]
    camera = found.cameras[0]
    truth = ForeignCamera("ds", (340.0, 341.0, 640.0, 480.0, 0.0, -3.5e-3, 0.558), (1280, 960), "")
    rays, valid = camera.unproject(camera.grid(9, 7).reshape(-1, 2))
    assert float((truth.project(rays[valid])[0] - camera.grid(9, 7).reshape(-1, 2)[valid]).abs().max()) < 0.05


@pytest.mark.parametrize(
    ("name", "content", "program"),
    [
        ("a.json", {"views": [], "intrinsics": []}, "Meshroom"),
        ("a.json", {"sfm_data_version": "0.3", "views": [], "intrinsics": []}, "OpenMVG"),
        ("calib_results.txt", "#polynomial coefficients for the DIRECT mapping function.\n5\n", "OCamCalib"),
        ("bundle.out", "# Bundle file v0.3\n1 2\n", "Bundler"),
        ("a.nvm", "NVM_V3\n\n2\n", "VisualSFM"),
        ("p.pto", "# hugin project file\np f2 w3000\n", "Hugin"),
        ("a.cam", "Pix4D camera calibration file 0\n#Focal Length mm\nF 8.8\n", "Pix4D"),
        ("camera.txt", "FOV 0.5 0.6 0.5 0.5 0.9\n640 480\ncrop\n640 480\n", "DSO"),
        ("a.xmp", '<x:xmpmeta><rdf:Description xcr:FocalLength35mm="24"/></x:xmpmeta>', "RealityCapture"),
    ],
)  # fmt: skip
def test_a_program_that_is_known_and_not_read_is_named(tmp_path: Path, name: str, content: Any, program: str) -> None:
    with pytest.raises(FileError, match=program):
        recognized(written(tmp_path, name, content))
