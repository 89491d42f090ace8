"""Cameras in bags of ROS: `sensor_msgs/CameraInfo` of each, and `/tf_static`, how they stand to each other.

A camera's frame is ROS's optical frame (REP 103): x right, y down, z forward, as everywhere in kcal. `rig` is the frame
of a rig's file: east, north, up where it has a place on the Earth.
"""

from __future__ import annotations

import dataclasses
import re
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from kcal.bag import TF, Bag, message_types, open_bag
from kcal.errors import InputError, with_extra
from kcal.files import write_atomic
from kcal.io.foreign import Hints, ImportedCameras, camera_name, moved_by, plain, poses_from_root, quaternion_of
from kcal.io.format_opencv import ros_camera, ros_values
from kcal.lens.camera import Camera
from kcal.lens.pose import Pose

# Which bag a file will be: of ROS 1, or of ROS 2.
SUFFIXES = (".bag", ".mcap", ".db3")
_INFO = "sensor_msgs/msg/CameraInfo"
# Of a message, by lowercase names: ROS 1 has D, K, R, P; and what a file calls them.
_NAMES = {
    "width": "image_width", "height": "image_height", "distortion_model": "distortion_model",
    "d": "distortion_coefficients", "k": "camera_matrix", "r": "rectification_matrix", "p": "projection_matrix",
    "binning_x": "binning_x", "binning_y": "binning_y",
}  # fmt: skip
_FOLDED = ("x_offset", "y_offset", "width", "height")


def read_bag(path: Path, hints: Hints) -> ImportedCameras:
    """Read the camera of each topic with CameraInfo, named by the topic, and their poses.

    Poses are those of `/tf_static`, where each camera has a frame of its own there; else, of a pair, how its images are
    rectified.

    Raises:
        ValueError: no camera that is calibrated.
    """
    bag = open_bag(path)
    parts: dict[str, ImportedCameras] = {}
    frames, unread, notes = list[str](), dict[str, str](), list[str]()
    for topic in bag.topics(_INFO):
        name = topic.removesuffix("camera_info").strip("/").replace("/", "_") or "camera"
        messages = [bag.decoded(data, _INFO) for _, data in bag.messages(topic)]
        contents = [_as_in_a_file(message) for message in messages]
        if not any(contents[0]["camera_matrix"]):
            unread[name] = f"K of {topic} is zero: the driver had no calibration"
            continue
        if others := sum(content != contents[0] for content in contents):
            notes.append(f"{topic} changes: {others} of {len(contents)} messages are not as the first, which is read")
        try:
            parts[name] = ros_camera(contents[0], name, hints)
        except ValueError as error:
            unread[name] = str(error)
        else:
            frames.append(messages[0].header.frame_id.strip("/"))
    if not parts:
        raise ValueError("; ".join(unread.values()) or "no messages of sensor_msgs/CameraInfo in this bag")
    poses, rectified = _tf_poses(bag, frames), [pose for part in parts.values() for pose in part.poses]
    # Without rectification all would stand at one place.
    if not poses and len(rectified) == len(parts) == 2 and any(float(one.translation.norm()) for one in rectified):
        poses = tuple(rectified)
    cameras = tuple(camera for part in parts.values() for camera in part.cameras)
    notes += [note for part in parts.values() for note in part.notes]
    return ImportedCameras(format="bag", cameras=cameras, poses=poses, notes=tuple(notes), unread=unread)


def _as_in_a_file(message: Any) -> dict[str, Any]:
    """The values as a file of ROS has them."""
    values = {field.name.lower(): getattr(message, field.name) for field in dataclasses.fields(message)}
    content = {name: getattr(values[key], "tolist", lambda key=key: values[key])() for key, name in _NAMES.items()}
    return content | {"roi": {key: getattr(message.roi, key) for key in _FOLDED}}


def _tf_poses(bag: Bag, frames: Sequence[str]) -> tuple[Pose, ...]:
    """Each camera's pose from the frame that all hang on; empty if that is not said."""
    above: dict[str, tuple[str, Pose]] = {}
    for topic in bag.topics(TF):
        for _, data in bag.messages(topic) if topic.endswith("tf_static") else ():
            for one in bag.decoded(data, TF).transforms:
                turn, shift = one.transform.rotation, one.transform.translation
                pose = moved_by([turn.w, turn.x, turn.y, turn.z], [shift.x, shift.y, shift.z])
                above[one.child_frame_id.strip("/")] = (one.header.frame_id.strip("/"), pose)
    return poses_from_root(above, frames)


def write_bag(cameras: Sequence[Camera], poses: Sequence[Pose], path: Path) -> list[Path]:
    """Write `/NAME/camera_info` of each camera, and with poses `/tf_static`: `rig` → `NAME_optical_frame`.

    A `.bag` is one of ROS 1, `.mcap` and `.db3` are of ROS 2. Late subscribers get all of it, as from a driver.

    Raises:
        InputError: another suffix, or rosbags is not installed.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: the suffix says which bag it will be: .bag (ROS 1), .mcap or .db3 (ROS 2)")
    with with_extra("ros", "bags need"):
        from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2
    first = path.suffix.lower() == ".bag"
    store = message_types(first=first)
    now = time.time_ns()
    names = [re.sub(r"\W+", "_", camera_name(camera, ""), flags=re.ASCII).strip("_") for camera in cameras]
    # Names of ROS begin with a letter.
    if len({*names}) < len(names) or not all(re.match("[A-Za-z]", name) for name in names):
        names = ["left", "right"] if len(names) == 2 else [f"camera{i}" for i in range(len(names))]
    frames = [f"{name}_optical_frame" for name in names]

    def header(frame: str) -> dict[str, Any]:
        return {"stamp": {"sec": now // 10**9, "nanosec": now % 10**9}, "frame_id": frame}

    messages: list[tuple[str, str, dict[str, Any]]] = []
    for name, frame, (size, kind, matrices) in zip(names, frames, ros_values(cameras, poses), strict=True):
        values: dict[str, Any] = dict(zip("kdrp", (one.ravel() for one in matrices), strict=True))
        values |= {"header": header(frame), "width": size[0], "height": size[1], "distortion_model": kind}
        messages.append((f"/{name}/camera_info", _INFO, values))
    links = []
    for frame, pose in zip(frames, poses, strict=False):
        w, *turn = quaternion_of(pose.rotation.mT)
        move = {"translation": dict(zip("xyz", plain(pose.center), strict=True)),
                "rotation": dict(zip("xyzw", [*turn, w], strict=True))}  # fmt: skip
        links.append({"header": header("rig"), "child_frame_id": frame, "transform": move})
    if links:
        messages.append(("/tf_static", TF, {"transforms": links}))
    never = QosTime(0, 0)
    kept = Qos(QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, never, never,
               QosLiveliness.AUTOMATIC, never, False)  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder, path.name)
        plugin = StoragePlugin.MCAP if path.suffix.lower() == ".mcap" else StoragePlugin.SQLITE3
        # Version 8 of the metadata is read by what came before and after it.
        with Writer1(target) if first else Writer2(target, version=8, storage_plugin=plugin) as writer:
            more: dict[str, Any] = {"latching": 1} if first else {"offered_qos_profiles": [kept]}
            for topic, kind, values in messages:
                connection = writer.add_connection(topic, kind, typestore=store, **more)
                encode = store.serialize_ros1 if first else store.serialize_cdr
                writer.write(connection, now, bytes(encode(_filled(store, kind, values), kind)))
        written = target if first else next(one for one in target.iterdir() if one.suffix == path.suffix.lower())
        return [write_atomic(path, written.read_bytes())]


def _filled(store: Any, kind: str, values: Mapping[str, Any]) -> Any:
    """A message with these values, by the lowercase names of its fields; what is not named is zero, or empty."""
    from rosbags.interfaces import Nodetype

    made = {}
    for name, (node, about) in store.fielddefs[kind][1]:
        value = values.get(name.lower())
        if node == Nodetype.NAME:
            value = _filled(store, about, value or {})
        elif node == Nodetype.SEQUENCE and about[0][0] == Nodetype.NAME:
            value = [_filled(store, about[0][1], one) for one in value or ()]
        elif value is None:
            value = "" if about[0] == "string" else 0
        made[name] = value
    return store.types[kind](**made)
