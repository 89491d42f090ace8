"""Files of COLMAP with rigs, Basalt, multical and calib.io: values, poses, and what is refused."""

import json
import math
import sqlite3
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from kcal import Camera, FileError, Rig
from kcal.io.foreign import moved_by, quaternion_of
from kcal.lens import export_cameras, import_cameras, rotation_from_vector

SIZE, K = (640, 480), np.array([[500.0, 0, 330], [0, 505, 236], [0, 0, 1]])
D = [-0.2, 0.05, 0.001, -0.002, 0.01, 0.02, 0.01, -0.003]
TURNS = [[0.0, 0.0, 0.0], [0.1, -0.2, 0.3], [-0.3, 0.1, 0.05]]
PLACES = [[0.0, 0.0, 0.0], [-0.11, 0.02, 0.01], [0.3, -0.1, 0.2]]


def camera(index: int = 0) -> Camera:
    return Camera.build(
        focal=(500 + index, 505), center=(330, 236), size=SIZE, coefficients=D[:4], model="opencv4", skew=0.0
    )


def three() -> Rig:
    turns = torch.stack([rotation_from_vector(torch.tensor(turn).double()) for turn in TURNS])
    return Rig([camera(i) for i in range(3)], ["a", "b", "c"], turns, torch.tensor(PLACES).double())


def step(poses: Any, i: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The pose of camera i from the first."""
    moved = poses[i].after(poses[0].inverse())
    return moved.rotation, moved.translation


@pytest.mark.parametrize(
    ("form", "file"),
    [("colmap", "cameras.txt"), ("colmap", "cameras.bin"), ("basalt", "calibration.json"), ("kalibr", "chain.yaml"),
     ("multical", "calibration.json"), ("toml", "rig.toml")],
)  # fmt: skip
def test_a_rig_of_three_comes_back(tmp_path: Path, form: str, file: str) -> None:
    rig = three()
    assert "relative pose" not in export_cameras(rig, tmp_path / file, format=form).lost
    back = import_cameras(tmp_path / file)
    assert (back.format, len(back.cameras), len(back.poses)) == (form, 3, 3)
    for i in range(3):
        rotation, translation = step(back.poses, i)
        assert float((rotation - rig.rotation[i] @ rig.rotation[0].T).abs().max()) < 1e-12
        assert float((translation - rig.translation[i]).abs().max()) < 1e-12
        assert back.cameras[i].params[:4].tolist() == pytest.approx([500 + i, 505, 330, 236], abs=1e-12)


def test_quaternions_are_those_of_scipy() -> None:
    from scipy.spatial.transform import Rotation

    draw = np.random.default_rng(0)
    for rotation in (*Rotation.random(20, rng=draw), Rotation.from_rotvec([math.pi, 0, 0]), Rotation.identity()):
        x, y, z, w = rotation.as_quat()
        matrix = torch.from_numpy(rotation.as_matrix())
        assert float((moved_by([2 * w, 2 * x, 2 * y, 2 * z], [0, 0, 0]).rotation - matrix).abs().max()) < 1e-12
        assert abs(np.dot(quaternion_of(matrix), [w, x, y, z])) == pytest.approx(1, abs=1e-12)
    with pytest.raises(ValueError, match="a quaternion is zero"):
        moved_by([0, 0, 0, 0], [0, 0, 0])


# COLMAP.


def scene() -> Any:
    pycolmap = pytest.importorskip("pycolmap")
    found = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=5)
    for i in range(3):
        params = [500.0 + i, 505, 330.5, 236.5, *D[:4]]
        theirs = pycolmap.Camera(model="OPENCV", width=640, height=480, params=params, camera_id=i + 2)
        found.add_camera(theirs)
        if not i:
            rig.add_ref_sensor(theirs.sensor_id)
            continue
        rotation = pycolmap.Rotation3d(cv2.Rodrigues(np.array(TURNS[i]))[0])
        rig.add_sensor(theirs.sensor_id, pycolmap.Rigid3d(rotation, PLACES[i]))
    found.add_rig(rig)
    return found


def colmap_files(folder: Path) -> dict[str, Path]:
    pycolmap, found = pytest.importorskip("pycolmap"), scene()
    (folder / "text").mkdir()
    (folder / "binary").mkdir()
    found.write_text(str(folder / "text"))
    found.write_binary(str(folder / "binary"))
    base = pycolmap.Database.open(str(folder / "database.db"))
    for number, theirs in found.cameras.items():
        theirs.has_prior_focal_length = number != 3
        base.write_camera(theirs, True)
    for rig in found.rigs.values():
        base.write_rig(rig, True)
    base.close()
    return {"text": folder / "text/cameras.txt", "binary": folder / "binary/cameras.bin",
            "database": folder / "database.db"}  # fmt: skip


@pytest.mark.parametrize("kind", ["text", "binary", "database"])
def test_rigs_of_colmap_are_read(tmp_path: Path, kind: str) -> None:
    found = import_cameras(colmap_files(tmp_path)[kind], meters=2.0)
    assert (found.format, found.names) == ("colmap", ("2", "3", "4"))
    for i, (turn, place) in enumerate(zip(TURNS, PLACES, strict=True)):
        rotation, translation = found.poses[i]
        assert np.abs(rotation.numpy() - cv2.Rodrigues(np.array(turn))[0]).max() < 1e-12
        assert translation.tolist() == pytest.approx([2 * each for each in place], abs=1e-12)
        assert found.cameras[i].params.tolist() == pytest.approx([500 + i, 505, 330, 236, 0, *D[:4]])
    assert any("focal length is a guess" in note for note in found.notes) == (kind == "database")
    assert any("taken as meters (--unit)" in note for note in import_cameras(tmp_path / "text/cameras.txt").notes)


def test_a_colmap_rig_of_any_name_is_read_again(tmp_path: Path) -> None:
    export_cameras(three(), tmp_path / "site.txt", format="colmap")
    assert len(import_cameras(tmp_path / "site.txt", format="colmap").poses) == 3


def test_a_rig_that_lacks_a_camera_has_no_poses(tmp_path: Path) -> None:
    path = colmap_files(tmp_path)["text"]
    rigs = path.with_name("rigs.txt")
    words = rigs.read_text().splitlines()[-1].split()
    rigs.write_text(" ".join([words[0], "2", *words[2:14]]) + "\n")
    found = import_cameras(path)
    assert found.poses == ()
    assert any("no rig has all cameras" in note for note in found.notes)
    rigs.write_text("1 3 CAMERA 2 CAMERA 3 1 0.5\n")
    with pytest.raises(FileError, match=r"rigs\.txt: bad COLMAP rig file"):
        import_cameras(path)


def test_colmap_reads_the_rig_that_is_written(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    rig = three()
    export_cameras(rig, tmp_path / "rig_config.json", format="colmap")
    (config,) = pycolmap.read_rig_config(tmp_path / "rig_config.json")
    assert [one.image_prefix for one in config.cameras] == ["camera1/", "camera2/", "camera3/"]
    for i, one in enumerate(config.cameras):
        assert one.ref_sensor == (i == 0)
        if i:
            assert np.abs(one.cam_from_rig.rotation.matrix() - rig.rotation[i].numpy()).max() < 1e-12
            assert np.abs(one.cam_from_rig.translation - rig.translation[i].numpy()).max() < 1e-12
        assert one.camera.params.tolist() == pytest.approx([500 + i, 505, 330.5, 236.5, *D[:4]])
    for suffix in ("txt", "bin"):
        export_cameras(rig, tmp_path / f"cameras.{suffix}", format="colmap")
    for kind in ("images", "frames", "points3D"):
        (tmp_path / f"{kind}.txt").write_text("")
    for suffix in ("txt", "bin"):
        if suffix == "bin":
            for kind in ("images", "frames", "points3D"):
                (tmp_path / f"{kind}.bin").write_bytes(bytes(8))
        theirs = pycolmap.Reconstruction()
        (theirs.read_text if suffix == "txt" else theirs.read_binary)(str(tmp_path))
        moved = theirs.rigs[1].sensor_from_rig(theirs.cameras[2].sensor_id)
        assert np.abs(moved.rotation.matrix() - rig.rotation[1].numpy()).max() < 1e-12
        assert np.abs(moved.translation - rig.translation[1].numpy()).max() < 1e-12


def test_hostile_databases_are_refused(tmp_path: Path) -> None:
    empty, view = tmp_path / "empty.db", tmp_path / "view.db"
    with sqlite3.connect(empty) as base:
        base.execute("CREATE TABLE other (a)")
    with sqlite3.connect(view) as base:
        base.execute(
            "CREATE VIEW cameras AS WITH RECURSIVE a(b) AS (SELECT 1 UNION ALL SELECT b FROM a) SELECT b FROM a"
        )
    for path in (empty, view):
        with pytest.raises(FileError, match="no cameras"):
            import_cameras(path)
    cut = colmap_files(tmp_path)["database"]
    cut.write_bytes(cut.read_bytes()[:5000])
    with pytest.raises(FileError, match=r"database\.db: bad colmap file"):
        import_cameras(cut)


# Basalt.


def basalt(*lenses: tuple[str, dict[str, float]]) -> dict[str, Any]:
    core = {"fx": 300.0, "fy": 301.0, "cx": 322.0, "cy": 238.0}
    names = ("px", "py", "pz", "qx", "qy", "qz", "qw")
    poses = [
        dict(zip(names, (0.1 * i, 0.0, 0.0, 0.0, 0.0, math.sin(0.1 * i), math.cos(0.1 * i)), strict=True))
        for i in range(len(lenses))
    ]
    parts = [{"camera_type": kind, "intrinsics": core | more} for kind, more in lenses]
    return {"value0": {"T_imu_cam": poses, "intrinsics": parts, "resolution": [[640, 480]] * len(lenses),
                       "imu_update_rate": 200.0, "calib_accel_bias": [0.01] * 9}}  # fmt: skip


def test_basalt(tmp_path: Path) -> None:
    kb4, radtan8 = {f"k{i + 1}": value for i, value in enumerate([0.05, -0.01, 0.002, 0.001])}, dict(
        zip(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), D, strict=True))  # fmt: skip
    content = basalt(("kb4", kb4), ("pinhole-radtan8", radtan8 | {"rpmax": 2.7}), ("ds", {"xi": -0.2, "alpha": 0.55}),
                     ("ucm", {"alpha": 0.6}), ("pinhole", {}), ("cylinder", {}))  # fmt: skip
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(content))
    found = import_cameras(path)
    assert (found.format, found.names, list(found.unread)) == ("basalt", tuple(f"cam{i}" for i in range(5)), ["cam5"])
    assert found.cameras[4].params.tolist() == [300, 301, 322, 238, 0]
    # T_imu_cam leads from the camera to the IMU.
    assert found.poses[2].center.tolist() == pytest.approx([0.2, 0, 0])
    assert found.poses[2].rotation.T[0, 1].item() == pytest.approx(-math.sin(0.4))


def test_a_wide_lens_becomes_one_of_basalt(tmp_path: Path) -> None:
    wide = Camera.build(
        focal=(330, 330), center=(319.5, 239.5), size=SIZE, model="opencv8",
        coefficients=[0.4, 0.02, 0.001, 0.0, 0.01, 0.7, 0.08, 0.012],
    )  # fmt: skip
    done = export_cameras(wide, tmp_path / "a.json", format="basalt")
    (lens,) = json.loads((tmp_path / "a.json").read_text())["value0"]["intrinsics"]
    assert (done.misfits, lens["camera_type"]) == ((None,), "pinhole-radtan8")
    # All of the image is inside, and what is far outside is not projected.
    farthest = float(wide.normalize(wide.grid(2, 2))[0].norm(dim=-1).max())
    assert farthest < lens["intrinsics"]["rpmax"] < 1.1 * farthest
    named = export_cameras(wide, tmp_path / "b.json", format="basalt", model="eucm")
    assert (named.models, json.loads((tmp_path / "b.json").read_text())["value0"]["intrinsics"][0]["camera_type"]) == (
        ("eucm",), "eucm",
    )  # fmt: skip


def test_basalt_with_too_few_poses_is_refused(tmp_path: Path) -> None:
    content = basalt(("pinhole", {}), ("pinhole", {}))
    for key, words in (("T_imu_cam", "2 intrinsics and 1 T_imu_cam"), ("resolution", "2 intrinsics and 1 resolutions")):
        changed = {"value0": content["value0"] | {key: content["value0"][key][:1]}}
        (tmp_path / "a.json").write_text(json.dumps(changed))
        with pytest.raises(FileError, match=words):
            import_cameras(tmp_path / "a.json")


# multical and calib.io.


def multical(poses: dict[str, Any], **more: Any) -> dict[str, Any]:
    lens = {"model": "rational", "image_size": list(SIZE), "K": K.tolist(), "dist": [D]}
    return {"cameras": {name: lens | more for name in ("a", "b", "c")}, "camera_poses": poses,
            "image_sets": {"rgb": [{"a": "a/1.png"}]}}  # fmt: skip


@pytest.mark.parametrize("form", ["rig", "master", "chain"])
def test_multical(tmp_path: Path, form: str) -> None:
    rotations = [cv2.Rodrigues(np.array(turn))[0] for turn in TURNS]
    whole = [np.block([[R, np.array(t)[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
             for R, t in zip(rotations, PLACES, strict=True)]  # fmt: skip
    names = {"rig": ("a", "b", "c"), "master": ("a", "b_to_a", "c_to_a"), "chain": ("a", "b_to_a", "c_to_b")}[form]
    last = whole[2] @ np.linalg.inv(whole[1]) if form == "chain" else whole[2]
    poses = zip(names, (whole[0], whole[1], last), strict=True)
    path = tmp_path / "calibration.json"
    stated = {name: {"R": pose[:3, :3].tolist(), "T": pose[:3, 3].tolist()} for name, pose in poses}
    path.write_text(json.dumps(multical(stated)))
    found = import_cameras(path)
    assert (found.format, found.names) == ("multical", ("a", "b", "c"))
    for pose, R, t in zip(found.poses, rotations, PLACES, strict=True):
        assert np.abs(pose.rotation.numpy() - R).max() < 1e-12
        assert pose.translation.tolist() == pytest.approx(t, abs=1e-12)


def test_multical_without_a_pose_or_with_a_circle_says_so(tmp_path: Path) -> None:
    still = {"R": np.eye(3).tolist(), "T": [0.0, 0, 0]}
    path = tmp_path / "calibration.json"
    for poses in ({"a": still, "b": still}, {"a": still, "b_to_c": still, "c_to_b": still}):
        path.write_text(json.dumps(multical(poses)))
        found = import_cameras(path)
        assert found.poses == ()
        assert any(note.startswith("no pose of ") for note in found.notes)


def calibio(kind: str, size: dict[str, Any], **values: float) -> dict[str, Any]:
    parameters = {name: {"val": value, "state": 2} for name, value in values.items()}
    data = {"parameters": parameters, "CameraModelCRT": {"CameraModelBase": size}}
    model = {"polymorphic_id": 1, "polymorphic_name": kind, "ptr_wrapper": {"valid": 1, "data": data}}
    pose = {"rotation": {"rx": 0.0, "ry": 0.1, "rz": 0.0}, "translation": {"x": 0.1, "y": 0.0, "z": 0.0}}
    return {"Calibration": {"cameras": [{"model": model, "transform": pose}] * 2}}


CORE = {"f": 500.0, "ar": 1.01, "cx": 330.0, "cy": 236.0}
FOURTEEN = dict(zip(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY"),
                    [*D, 1e-3, -1e-3, 2e-3, 1e-3, 0.01, 0.02], strict=True))  # fmt: skip


def test_calibio(tmp_path: Path) -> None:
    path, points = tmp_path / "calib.json", np.array([[0.3, -0.2, 1.0], [-0.4, 0.3, 1.0]])
    size = {"imageSize": {"width": 640, "height": 480}}
    path.write_text(json.dumps(calibio("libCalib::CameraModelOpenCV", size, **CORE, **FOURTEEN)))
    found = import_cameras(path)
    pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(list(FOURTEEN.values())))[0][:, 0]
    assert np.abs(found.cameras[0].project(torch.from_numpy(points))[0].numpy() - pixels).max() < 1e-9
    assert (found.format, found.poses) == ("calibio", ())
    assert any("how the cameras stand to each other is not read" in note for note in found.notes)
    five = {name: FOURTEEN[name] for name in ("k1", "k2", "k3", "p1", "p2")}
    size = {"imageWidth": 640, "imageHeight": 480}
    path.write_text(json.dumps(calibio("libCalib::CameraModelMatlab", size, **CORE, **five, skew=2.0)))
    assert import_cameras(path).cameras[0].params.tolist() == [500, 505, 330, 236, 2, *D[:5]]
    for kind, more, words in (
        ("libCalib::CameraModelOmni", {}, "model libCalib::CameraModelOmni: kcal reads"),
        ("libCalib::CameraModelMatlab", {"k9": 0.1}, "k9: parameters that kcal does not know"),
    ):
        path.write_text(json.dumps(calibio(kind, size, **CORE, **more)))
        with pytest.raises(FileError, match=words):
            import_cameras(path)
