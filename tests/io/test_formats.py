"""Camera files of other programs: values, pixel origins and poses, as their own documentation and readers have them."""

import json
import struct
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from opencv_files import file_storage
from scipy.io import savemat

from kcal.errors import FileError, InputError
from kcal.io.foreign import flat
from kcal.io.formats import FORMATS, import_cameras, recognized

ROS = """image_width: 640
image_height: 480
camera_name: narrow
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320, 0, 510, 240, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.2, 0.05, 0.001, -0.002, 0.01]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [400, 0, 320, BASE, 0, 400, 240, 0, 0, 0, 1, 0]}
"""
# The file that Kalibr's repository has for its tests of a fisheye.
KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.005908650672531068, 0.01587953759563821, -0.024196671184075886, 0.015501252412920248]
  distortion_model: equidistant
  intrinsics: [277.95596230891084, 278.4167467580337, 315.5269754313737, 244.46893770533453]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1: [[0, -1, 0, -0.1], [1, 0, 0, 0.02], [0, 0, 1, 0.03], [0, 0, 0, 1]]
  camera_model: pinhole
  distortion_coeffs: [0.1, 0.01, 0.001, 0.002]
  distortion_model: radtan
  intrinsics: [277, 278, 315, 244]
  resolution: [640, 480]
"""
# As mrcal's documentation shows a file.
MRCAL = """# comment
{
    'lensmodel':  'LENSMODEL_OPENCV5',
    'intrinsics': [ 1000.1, 1001.2, 320.5, 240.25, -0.1, 0.02, 0.001, -0.002, 0.003,],
    'extrinsics': [ 0.0, 0.0, 1.5707963267948966, 1.0, 2.0, 3.0,],
    'imagersize': [ 640, 480,],
}
"""


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


class TestValues:
    def test_ros(self, tmp_path: Path) -> None:
        found = import_cameras(write(tmp_path, "a.yaml", ROS.replace("BASE", "0")))
        assert (found.format, found.names, found.is_rig()) == ("ros", ("narrow",), False)
        assert found.cameras[0].params.tolist() == [500, 510, 320, 240, 0, -0.2, 0.05, 0.001, -0.002, 0.01]
        assert found.cameras[0].size == (640, 480)

    def test_a_pair_of_ros(self, tmp_path: Path) -> None:
        """Tx = -fx B: the right camera is B to the right."""
        paths = [
            write(tmp_path, f"{name}.yaml", ROS.replace("BASE", base)) for name, base in (("l", "0"), ("r", "-48"))
        ]
        rig = import_cameras(*paths).rig()
        assert rig.right_from_left_translation.tolist() == pytest.approx([-0.12, 0, 0])
        # One above the other: Ty = -fy B.
        above = ROS.replace("BASE", "0").replace("0, 400, 240, 0,", "0, 400, 240, -20,")
        rig = import_cameras(paths[0], write(tmp_path, "above.yaml", above)).rig()
        assert rig.right_from_left_translation.tolist() == pytest.approx([0, -0.05, 0])

    def test_kalibr(self, tmp_path: Path) -> None:
        found = import_cameras(write(tmp_path, "chain.yaml", KALIBR))
        assert [str(camera.model) for camera in found.cameras] == ["fisheye4", "opencv4"]
        assert found.cameras[0].center.tolist() == [315.5269754313737, 244.46893770533453]
        assert [camera.size for camera in found.cameras] == [(640, 480)] * 2
        rig = found.rig()
        assert rig.right_from_left_translation.tolist() == [-0.1, 0.02, 0.03]
        assert rig.right_from_left(torch.tensor([[1.0, 0.0, 0.0]])).tolist() == [[-0.1, 1.02, 0.03]]

    def test_mrcal(self, tmp_path: Path) -> None:
        found = import_cameras(write(tmp_path, "left.cameramodel", MRCAL))
        assert found.cameras[0].params.tolist() == [1000.1, 1001.2, 320.5, 240.25, 0, -0.1, 0.02, 0.001, -0.002, 0.003]
        assert found.cameras[0].size == (640, 480)
        rotation, translation = found.poses[0]
        assert (rotation @ torch.tensor([1.0, 0, 0]).double()).tolist() == pytest.approx([0, 1, 0])
        assert translation.tolist() == [1, 2, 3]
        newer = MRCAL.replace("extrinsics", "rt_cam_ref")
        assert import_cameras(write(tmp_path, "new.cameramodel", newer)).poses[0].translation.tolist() == [1, 2, 3]

    def test_opencv_stereo_in_two_files(self, tmp_path: Path) -> None:
        """As OpenCV's sample stereo_calib writes it: without an image size, in units of the board."""
        matrix, lens = np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]]), np.array([[-0.2, 0.05, 0, 0, 0.01]])
        inside = file_storage(tmp_path / "intrinsics.yml", M1=matrix, D1=lens, M2=matrix, D2=lens)
        outside = file_storage(tmp_path / "extrinsics.yml", R=np.eye(3), T=np.array([[-120.0], [0.0], [1.0]]))
        found = import_cameras(inside, outside, size=(640, 480), meters=1e-3)
        assert found.rig().right_from_left_translation.tolist() == pytest.approx([-0.12, 0, 0.001])
        assert found.cameras[1].params.tolist() == [500, 510, 320, 240, 0, -0.2, 0.05, 0, 0, 0.01]
        assert found.cameras[1].size == (640, 480)
        assert "taken as meters" in import_cameras(inside, outside, size=(640, 480)).notes[0]
        with pytest.raises(FileError, match="image size is not in the file"):
            import_cameras(inside)
        with pytest.raises(InputError, match="without its cameras"):
            import_cameras(outside)

    @pytest.mark.parametrize("names", [("image_size",), ("imageSize",), ("image_Width", "image_Height")])
    def test_sizes_of_opencv_are_width_and_height(self, tmp_path: Path, names: tuple[str, ...]) -> None:
        path = tmp_path / "camera.yml"
        file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        if len(names) == 1:
            file.startWriteStruct(names[0], cv2.FILE_NODE_SEQ + cv2.FILE_NODE_FLOW)
        for name, value in zip(names if len(names) == 2 else ("", ""), (640, 480), strict=True):
            file.write(name, value)
        if len(names) == 1:
            file.endWriteStruct()
        file.write("camera_matrix", np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]]))
        file.write("distortion_coefficients", np.zeros((1, 5)))
        file.release()
        assert import_cameras(path).cameras[0].size == (640, 480)

    def test_four_coefficients_of_opencv_are_told(self, tmp_path: Path) -> None:
        four = {"camera_matrix": np.eye(3), "distortion_coefficients": np.array([[0.1, 0.2, 0.3, 0.4]])}
        path = file_storage(tmp_path / "four.xml", image_width=640, image_height=480, **four)
        found = import_cameras(path)
        assert str(found.cameras[0].model) == "opencv4"
        assert "--fisheye" in found.notes[0]
        assert str(import_cameras(path, fisheye=True).cameras[0].model) == "fisheye4"

    @pytest.mark.parametrize(
        ("line", "model", "params"),
        [
            ("SIMPLE_RADIAL 640 480 500 320 240 -0.1", "opencv4", [500, 500, 319.5, 239.5, 0, -0.1, 0, 0, 0]),
            ("OPENCV 640 480 500 510 320 240 1 2 3 4", "opencv4", [500, 510, 319.5, 239.5, 0, 1, 2, 3, 4]),
            ("RADIAL_FISHEYE 640 480 500 320 240 1 2", "fisheye4", [500, 500, 319.5, 239.5, 0, 1, 2, 0, 0]),
        ],
    )
    def test_colmap(self, tmp_path: Path, line: str, model: str, params: list[float]) -> None:
        camera = import_cameras(write(tmp_path, "cameras.txt", f"# comment\n7 {line}\n")).cameras[0]
        assert (str(camera.model), camera.params.tolist()) == (model, params)
        assert camera.size == (640, 480)

    def test_colmap_binary(self, tmp_path: Path) -> None:
        path = tmp_path / "cameras.bin"
        path.write_bytes(struct.pack("<QIiQQ3d", 1, 3, 0, 640, 480, 500.0, 320.0, 240.0))
        found = import_cameras(path)
        assert found.names == ("3",)
        assert found.cameras[0].params.tolist() == [500, 500, 319.5, 239.5, 0]
        assert found.cameras[0].size == (640, 480)
        path.write_bytes(path.read_bytes()[:-1])
        with pytest.raises(FileError, match="ends too early"):
            import_cameras(path)

    def test_nerfstudio(self, tmp_path: Path) -> None:
        content = {"w": 640, "h": 480, "fl_x": 500, "fl_y": 510, "cx": 320, "cy": 240, "camera_model": "OPENCV"}
        content |= {"k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4, "frames": [{"file_path": "a", "transform_matrix": []}]}
        found = import_cameras(write(tmp_path, "transforms.json", json.dumps(content)))
        assert found.cameras[0].params.tolist() == [500, 510, 319.5, 239.5, 0, 0.1, 0.2, 0.3, 0.4]
        assert found.cameras[0].size == (640, 480)
        assert found.notes == ("the poses of the frames are not kept",)
        assert import_cameras(write(tmp_path, "t.json", json.dumps(content | {"frames": []}))).notes == ()

    @pytest.mark.parametrize("old", [False, True])
    @pytest.mark.parametrize("pose", ["rows", "matrix", "object"])
    def test_matlab(self, tmp_path: Path, old: bool, pose: str) -> None:
        matrix = np.array([[500, 0.5, 321], [0, 510, 241], [0, 0, 1]])
        one = {"ImageSize": [480, 640], "RadialDistortion": [-0.2, 0.05], "TangentialDistortion": [0.001, 0.002]}
        one |= {"IntrinsicMatrix": matrix.T} if old else {"K": matrix}
        turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
        whole = np.block([[turn, np.array([[-120.0], [0.0], [1.0]])], [np.zeros((1, 3)), np.ones((1, 1))]])
        second = {
            "rows": {"RotationOfCamera2": turn.T, "TranslationOfCamera2": [-120.0, 0, 1]},
            "matrix": {"PoseCamera2": whole},
            "object": {"PoseCamera2": {"A": whole}},
        }[pose]
        savemat(tmp_path / "s.mat", {"s": {"CameraParameters1": one, "CameraParameters2": one, **second}})
        found = import_cameras(tmp_path / "s.mat")
        assert "taken as millimeters" in found.notes[0]
        rig = found.rig()
        assert rig.left.params.tolist() == [500, 510, 320, 240, 0.5, -0.2, 0.05, 0.001, 0.002]
        assert rig.left.size == (640, 480)
        assert rig.right_from_left_rotation.tolist() == turn.tolist()
        assert rig.right_from_left_translation.tolist() == pytest.approx([-0.12, 0, 0.001])

    def test_opensfm(self, tmp_path: Path) -> None:
        camera = {"projection_type": "brown", "width": 640, "height": 480, "focal_x": 0.8, "focal_y": 0.9, "c_x": 0.01,
                  "c_y": 0.0, "k1": 0.1, "k2": 0.2, "k3": 0.5, "p1": 0.3, "p2": 0.4}  # fmt: skip
        found = import_cameras(write(tmp_path, "camera_models.json", json.dumps({"v2 x": camera})))
        assert found.names == ("v2 x",)
        assert found.cameras[0].params.tolist() == [512, 576, 325.9, 239.5, 0, 0.1, 0.2, 0.3, 0.4, 0.5]
        assert found.cameras[0].size == (640, 480)


class TestRefusals:
    @pytest.mark.parametrize(
        ("name", "text", "what"),
        [
            ("a.yaml", ROS.replace("BASE", "0").replace("plumb_bob", "double_sphere"), "distortion_model"),
            ("a.yaml", ROS.replace("BASE", "0").replace("[-0.2, 0.05,", "["), "3 numbers; 4 or 5 or"),
            ("a.yaml", KALIBR.replace("pinhole", "omni"), "omni"),
            ("a.yaml", ROS.replace("BASE", "0").replace("data: [400, 0, 320", "data: [0, 0, 320"), "no focal length"),
            ("a.yaml", ROS.replace("BASE", "0").replace("0, 400, 240", "0, 0, 240"), "no focal length"),
            ("a.yaml", KALIBR.replace("[0, -1, 0, -0.1]", "[2, -1, 0, -0.1]"), "no rotation matrix"),
            ("a.cameramodel", MRCAL.replace("OPENCV5", "CAHVOR"), "LENSMODEL_CAHVOR"),
            ("a.cameramodel", MRCAL.replace("640, 480", "640.5, 480"), "positive whole numbers"),
            ("a.cameramodel", "__import__('os').system('true')", "malformed node"),
            ("cameras.txt", "1 FOV3 640 480 500 500 320 240 1", "camera model FOV3"),
            ("cameras.txt", "1 PINHOLE 640 480 500 500 320", "line 1"),
            ("cameras.txt", "1 PINHOLE 640 480 nan 500 320 240", "finite"),
            ("a.json", "{}", "no camera that kcal knows"),
            ("a.yaml", "hello: 1", "name its format"),
            ("a.yaml", "%YAML:1.0\n---\nother: 1\n", "no camera"),
            ("a.mat", "no mat", "not a .mat file"),
        ],
    )
    def test_one_error_that_names_the_file(self, tmp_path: Path, name: str, text: str, what: str) -> None:
        with pytest.raises(FileError, match=what) as error:
            import_cameras(write(tmp_path, name, text))
        assert str(tmp_path / name) in str(error.value)

    def test_missing_file_and_unknown_format(self, tmp_path: Path) -> None:
        with pytest.raises(FileError, match="cannot read"):
            import_cameras(tmp_path / "no.yaml")
        with pytest.raises(InputError, match="unknown format"):
            import_cameras(tmp_path / "no.yaml", format="zip")

    def test_two_cameras_in_one_place_are_no_rig(self, tmp_path: Path) -> None:
        path = write(tmp_path, "a.cameramodel", MRCAL)
        found = import_cameras(path, path)
        assert not found.is_rig()
        with pytest.raises(InputError, match="relative pose"):
            found.rig()


def test_every_format_is_recognized_without_its_name(tmp_path: Path) -> None:
    for name, text in (("ros", ROS), ("kalibr", KALIBR), ("mrcal", MRCAL)):
        assert recognized(write(tmp_path, f"{name}.dat", text)) == name
    assert set(FORMATS) == {"opencv", "ros", "kalibr", "mrcal", "colmap", "nerfstudio", "matlab", "opensfm", "toml",
                            "qualisys", "agisoft", "bag", "device", "gtsam", "ceres", "numpy", "basalt", "multical",
                            "calibio"}  # fmt: skip


def test_maps_in_a_file_cost_little_time() -> None:
    start = time.process_time()
    assert flat(np.ones((1080, 1920))) == [1.0] * (1080 * 1920)
    assert flat(np.ones((1080, 1920), bool)) is None
    assert time.process_time() - start < 0.7
