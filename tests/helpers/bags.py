"""Bags of ROS 1 and ROS 2 with images, written by rosbags."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

KINDS = ("ros1", "sqlite3", "mcap")
STORES = {kind: get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.LATEST) for kind in KINDS}
START = 1_700_000_000_123_456_789
# Topic, record time, nanoseconds, and a function from the store to the message.
Written = tuple[str, int, Any]


def header(store: Any, stamp: int, frame: str = "camera") -> Any:
    time = store.types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    number = {"seq": 0} if "seq" in dict(store.fielddefs["std_msgs/msg/Header"][1]) else {}
    return store.types["std_msgs/msg/Header"](stamp=time, frame_id=frame, **number)


def raw(store: Any, stamp: int, image: np.ndarray, encoding: str, *, padding: int = 0, big: bool = False) -> Any:
    """`sensor_msgs/Image`; `padding` bytes are added to each row."""
    stored = image.astype(image.dtype.newbyteorder(">" if big else "<"))
    rows = np.frombuffer(stored.tobytes(), np.uint8).reshape(len(image), -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
    return store.types["sensor_msgs/msg/Image"](
        header=header(store, stamp), height=image.shape[0], width=image.shape[1], encoding=encoding,
        is_bigendian=int(big), step=rows.shape[1], data=rows.ravel(),
    )  # fmt: skip


def compressed(store: Any, stamp: int, image: np.ndarray, suffix: str, words: str) -> Any:
    """`sensor_msgs/CompressedImage`."""
    data = cv2.imencode(suffix, image)[1].ravel()
    return store.types["sensor_msgs/msg/CompressedImage"](header=header(store, stamp), format=words, data=data)


def write_bag(path: Path, kind: str, messages: list[Written], **order: bool) -> Path:
    """A file for ROS 1, a folder for ROS 2; `little_endian=False` is the order of bytes of some machines of ROS 2."""
    store, connections = STORES[kind], {}
    plugin = {"sqlite3": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}
    writer: Any = Writer1(path) if kind == "ros1" else Writer2(path, version=8, storage_plugin=plugin[kind])
    with writer:
        for topic, recorded, make in messages:
            message = make(store)
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=store)
            encode = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
            writer.write(connections[topic], recorded, encode(message, message.__msgtype__, **order))
    return path
