"""CameraInfo and tf in bags of ROS: written for rosbags, and read as drivers write them."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from bags import KINDS, START, STORES, header, write_bag
from command_line import Command
from rosbags.interfaces import ConnectionExtRosbag1, QosDurability
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2

from kcal import Camera, FileError, InputError, Rig, load_camera, load_rig, save_rig
from kcal.bag import message_types
from kcal.lens import CameraCalibration, export_cameras, import_cameras, rotation_from_vector

SUFFIXES = (".bag", ".mcap", ".db3")
K = [500.0, 0, 319.5, 0, 510.0, 239.5, 0, 0, 1]
# Of the definition: https://docs.ros.org/en/noetic/api/sensor_msgs/html/msg/CameraInfo.html and tf2_msgs/TFMessage.
MD5 = {"sensor_msgs/msg/CameraInfo": "c9a58c1b0b154e0e6da7578cb991d214",
       "tf2_msgs/msg/TFMessage": "94810edda583a504dfda3829e70d7eec"}  # fmt: skip
FIELDS = [
    ("header", "std_msgs/msg/Header"), ("height", "uint32"), ("width", "uint32"), ("distortion_model", "string"),
    ("d", "float64[]"), ("k", "float64[9]"), ("r", "float64[9]"), ("p", "float64[12]"), ("binning_x", "uint32"),
    ("binning_y", "uint32"), ("roi", "sensor_msgs/msg/RegionOfInterest"),
]  # fmt: skip


def camera(name: str, focal: float, model: str = "opencv5") -> Camera:
    lens = [-0.2, 0.05, 1e-3, -2e-3, 0.01] if model == "opencv5" else [0.05, -0.01, 0.003, -0.001]
    made = Camera.build(
        focal=(focal, focal + 3), center=(321.0, 238.0), size=(640, 480), coefficients=lens, model=model
    )
    made.calibration = CameraCalibration(name=name)
    return made


def pose(*numbers: float) -> tuple[torch.Tensor, torch.Tensor]:
    given = torch.tensor(numbers, dtype=torch.float64)
    return rotation_from_vector(given[:3]), given[3:]


def rig(count: int) -> Rig:
    """Cameras whose poses are all general, and whose frame is that of none."""
    each = [pose(0.1, -0.2, 0.3, 1, 2, 3), pose(0.11, -0.1, 0.32, -0.5, 2.1, 3.2), pose(0, 1.9, 0.1, 0.4, 0, 1)][:count]
    names = ("left", "right", "mast head")[:count]
    cameras = [camera(name, 500.0 + 20 * i) for i, name in enumerate(names)]
    return Rig(cameras, names, torch.stack([one[0] for one in each]), torch.stack([one[1] for one in each]))


def contents(path: Path) -> dict[str, Any]:
    """The messages of a bag by their topics, read by rosbags, with its own types; all are latched."""
    first = path.suffix == ".bag"
    reader: Any = Reader1(path) if first else Reader2(path)
    store = message_types(first=first)
    with reader:
        for one in reader.connections:
            if first:
                assert isinstance(one.ext, ConnectionExtRosbag1)
                assert one.ext.latching == 1
                assert one.digest == MD5[one.msgtype]
            else:
                assert one.ext.offered_qos_profiles[0].durability == QosDurability.TRANSIENT_LOCAL
        decode = store.deserialize_ros1 if first else store.deserialize_cdr
        return {one.topic: decode(data, one.msgtype) for one, _, data in reader.messages()}


def fields_of(message: Any) -> dict[str, Any]:
    """By lowercase names: those of ROS 1 are D, K, R, P."""
    return {key.lower(): getattr(message, key) for key in message.__dataclass_fields__}


@pytest.mark.parametrize("kind", KINDS)
def test_the_message_is_that_of_its_definition(kind: str) -> None:
    fields = STORES[kind].fielddefs["sensor_msgs/msg/CameraInfo"][1]
    shown = []
    for name, (node, about) in fields:
        inner = about if isinstance(about, str) else about[0] if isinstance(about[0], str) else about[0][1][0]
        length = {"ARRAY": f"[{about[1]}]", "SEQUENCE": "[]"}.get(node.name, "")
        shown.append((name.lower(), f"{inner}{length}"))
    assert shown == FIELDS


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("count", [1, 2, 3])
def test_rosbags_reads_what_was_written(tmp_path: Path, suffix: str, count: int) -> None:
    known = rig(count)
    done = export_cameras(known if count > 1 else known.each[0], tmp_path / f"c{suffix}", format="ros")
    assert done.format == "bag"
    found = contents(done.paths[0])
    names = ("left", "right", "mast_head")[:count]
    assert set(found) == {f"/{name}/camera_info" for name in names} | ({"/tf_static"} if count > 1 else set())
    for name, one in zip(names, known.each, strict=True):
        info = found[f"/{name}/camera_info"]
        values = fields_of(info)
        assert (info.width, info.height, info.distortion_model) == (640, 480, "plumb_bob")
        assert np.array_equal(values["k"].reshape(3, 3), one.matrix.numpy())
        assert np.array_equal(values["d"], one.coefficients.numpy())
        assert info.header.frame_id == f"{name}_optical_frame"
        assert (info.binning_x, info.roi.width, info.roi.do_rectify) == (0, 0, False)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_point_goes_through_tf_and_camera_info_to_the_pixels_of_both(tmp_path: Path, suffix: str) -> None:
    """The chain of a node of ROS: tf from one optical frame into the other, then OpenCV with K and D."""
    known = rig(2)
    found = contents(export_cameras(known, tmp_path / f"c{suffix}").paths[0])
    rig_from = {}
    for one in found["/tf_static"].transforms:
        assert one.header.frame_id == "rig"
        q, t = one.transform.rotation, one.transform.translation
        # The quaternion's own formula, as in REP 103's and tf2's order x, y, z, w.
        x, y, z, w = q.x, q.y, q.z, q.w
        turn = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
        rig_from[one.child_frame_id] = (turn, np.array([t.x, t.y, t.z]))
    in_left = np.array([[0.3, -0.2, 6.0], [-1.0, 0.5, 9.0]])
    turn, shift = rig_from["left_optical_frame"]
    in_rig = in_left @ turn.T + shift
    back, center = rig_from["right_optical_frame"]
    in_right = (in_rig - center) @ back
    pixels, _ = known(torch.from_numpy(in_rig))
    for side, points, seen in (("left", in_left, pixels[:, 0]), ("right", in_right, pixels[:, 1])):
        values = fields_of(found[f"/{side}/camera_info"])
        shown = cv2.projectPoints(points, np.zeros(3), np.zeros(3), values["k"].reshape(3, 3), values["d"])[0][:, 0]
        assert np.abs(shown - seen.numpy()).max() < 1e-9
    # Rectified, both see a point in one row; the baseline is in P of the right camera, in the left one's frame.
    shown = []
    for side, points in (("left", in_left), ("right", in_right)):
        values = fields_of(found[f"/{side}/camera_info"])
        shown.append(points @ values["r"].reshape(3, 3).T @ values["p"].reshape(3, 4)[:, :3].T)
    in_frame = in_left @ fields_of(found["/left/camera_info"])["r"].reshape(3, 3).T
    by_p = np.c_[in_frame, np.ones(2)] @ values["p"].reshape(3, 4).T
    one, other, third = (each[:, :2] / each[:, 2:] for each in (*shown, by_p))
    assert np.abs(one[:, 1] - other[:, 1]).max() < 1e-9
    assert np.abs(third - other).max() < 1e-9


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("count", [2, 3])
def test_a_rig_comes_back(tmp_path: Path, suffix: str, count: int) -> None:
    known = rig(count)
    found = import_cameras(export_cameras(known, tmp_path / f"c{suffix}").paths[0])
    back = found.camera_rig()
    order = [0, 1] if count == 2 else [0, 2, 1]
    assert found.names == tuple(("left", "right", "mast_head")[i] for i in order)
    assert [one.params.tolist() for one in back.each] == [known.each[i].params.tolist() for i in order]
    assert torch.allclose(back.rotation, known.rotation[order], rtol=0, atol=1e-14)
    assert torch.allclose(back.translation, known.translation[order], rtol=0, atol=1e-14)


@pytest.mark.slow
def test_a_fisheye_and_a_lens_that_is_refitted(tmp_path: Path) -> None:
    wide = camera("wide", 300.0, "fisheye4")
    path = export_cameras(wide, tmp_path / "w.mcap").paths[0]
    assert contents(path)["/wide/camera_info"].distortion_model == "equidistant"
    assert torch.equal(import_cameras(path).cameras[0].params, wide.params)
    hybrid = load_rig(Path(__file__).parents[2] / "assets" / "sample-rig.json").left
    done = export_cameras(hybrid, tmp_path / "h.mcap")
    assert done.misfits[0] is not None
    assert done.misfits[0].rms < 0.1
    assert done.models == ("opencv8",)


def info(store: Any, k: list[float] = K, frame: str = "camera", **more: Any) -> Any:
    old = "K" in dict(store.fielddefs["sensor_msgs/msg/CameraInfo"][1])
    roi = store.types["sensor_msgs/msg/RegionOfInterest"](
        **({"x_offset": 0, "y_offset": 0, "height": 0, "width": 0} | more.pop("roi", {})), do_rectify=False
    )
    values = {"d": np.array([-0.1, 0.02, 0, 0, 0]), "k": np.array(k, float), "r": np.eye(3).ravel(),
              "p": np.c_[np.array(k, float).reshape(3, 3), np.zeros(3)].ravel()} | more.pop("values", {})  # fmt: skip
    given = {name.upper() if old else name: value for name, value in values.items()}
    sized = {"height": 480, "width": 640, "distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0} | more
    return store.types["sensor_msgs/msg/CameraInfo"](header=header(store, START, frame), roi=roi, **sized, **given)


@pytest.mark.parametrize("kind", KINDS)
def test_cameras_of_drivers(tmp_path: Path, kind: str) -> None:
    """Binning and window are those of the images; one frame for all is no rig; what is not calibrated is named."""
    window = {"x_offset": 0, "y_offset": 80, "width": 640, "height": 400}
    bag = write_bag(tmp_path / "run.bag", kind, [
        ("/left/camera_info", START, lambda s: info(s)),
        ("/left/camera_info", START + 1, lambda s: info(s, [501.0, *K[1:]])),
        ("/stereo/half/camera_info", START, lambda s: info(s, binning_x=2, binning_y=2, roi=window)),
        ("/raw/camera_info", START, lambda s: info(s, [0.0] * 9)),
    ])  # fmt: skip
    found = import_cameras(bag)
    assert found.names == ("left", "stereo_half")
    assert found.poses == ()
    assert found.unread == {"raw": "K of /raw/camera_info is zero: the driver had no calibration"}
    assert "/left/camera_info changes: 1 of 2 messages are not as the first, which is read" in found.notes
    left, half = found.cameras
    assert left.params[:4].tolist() == [500, 510, 319.5, 239.5]
    assert half.size == (320, 200)
    # Two pixels in one: their middle, with the first pixel's center at zero.
    assert half.params[:4].tolist() == [250, 255, (319.5 + 0.5) / 2 - 0.5, (239.5 - 80 + 0.5) / 2 - 0.5]


def test_a_rectified_pair_without_tf(tmp_path: Path) -> None:
    right = np.c_[np.array(K).reshape(3, 3), [-500.0 * 0.25, 0, 0]].ravel()
    bag = write_bag(tmp_path / "run", "mcap", [
        ("/left/camera_info", START, lambda s: info(s)),
        ("/right/camera_info", START, lambda s: info(s, values={"p": right})),
    ])  # fmt: skip
    assert import_cameras(bag).rig().right_from_left_translation.tolist() == [-0.25, 0, 0]


@pytest.mark.slow
def test_commands(tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    save_rig(rig(2), tmp_path / "rig.json")
    bag = tmp_path / "calibration.mcap"
    said = command("export", tmp_path / "rig.json", "--format ros -o", bag)
    assert "left: opencv5, exact" in said.out
    said = command("import", bag, "-o", tmp_path / "back.json")
    assert "rig from bag: baseline" in said.out
    for topic in ("/right/camera_info", "/right/image_raw/compressed"):
        command("import", bag, "--topic", topic, "-o", tmp_path / "right.camera.json")
        assert load_camera(tmp_path / "right.camera.json").params[0] == 520
    command("import", f"{bag}:/left/camera_info", "-o", tmp_path / "left.camera.json")
    assert load_camera(tmp_path / "left.camera.json").params[0] == 500
    assert "no camera '/middle/camera_info'; name one of 'left', 'right'" in command.refuses(
        "import", bag, "--topic /middle/camera_info -o x.json"
    )


def test_refusals(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run", "mcap", [("/raw/camera_info", START, lambda s: info(s, [0.0] * 9))])
    with pytest.raises(FileError, match="K of /raw/camera_info is zero"):
        import_cameras(bag)
    text = write_bag(tmp_path / "t", "mcap", [("/t", START, lambda s: s.types["std_msgs/msg/String"](data="x"))])
    with pytest.raises(FileError, match=r"no messages of sensor_msgs/CameraInfo"):
        import_cameras(text)
    with pytest.raises(InputError, match="opencv14"):
        export_cameras(rig(1).each[0], tmp_path / "x.bag", model="opencv14")
    with pytest.raises(InputError, match=r"x\.json: the suffix says which bag"):
        export_cameras(rig(1).each[0], tmp_path / "x.json", format="bag")
