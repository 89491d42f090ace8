"""Bags of ROS 1 (.bag) and ROS 2 (folder, .db3, .mcap): which topics they have, and their messages, by rosbags.

A topic is named behind the bag, `run.mcap:/left/image_raw`, wherever a folder or a video is taken. Its images are named
by their stamps, `run.mcap:/left/image_raw/1700000000.123456789.png`, as if they were the files of a folder.
"""

from __future__ import annotations

import bisect
import functools
import os
import re
import struct
import threading
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from kcal.errors import FileError, InputError, KcalWarning, with_extra
from kcal.file_kind import file_kind
from kcal.files import read_head

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
TF = "tf2_msgs/msg/TFMessage"
_STAMPED = re.compile(r"(?:^|[/\\])(\d+)\.(\d{9})\.png$")
# Images of two cameras that are farther apart are not of one moment: a board at arm's length moves by millimeters.
_APART_NS = 10_000_000
_CLOSED = "it was not closed, or is damaged: rosbag reindex (ROS 1), ros2 bag reindex or mcap recover repair it"


def bag_and_topic(source: str | Path) -> tuple[Path, str] | None:
    """A bag, and the topic that is named behind it (else empty); None for anything else."""
    if file_kind(source) == "bag":
        return Path(source), ""
    path, colon, topic = str(source).rpartition(":")
    return (Path(path), topic.replace("\\", "/")) if colon and topic[:1] in "/\\" and file_kind(path) == "bag" else None


def stamp_in(name: str | Path) -> int | None:
    """The nanoseconds in the name of an image of a bag; None in any other name.

    Example:
        >>> stamp_in("run.mcap:/left/image_raw/1700000000.123456789.png"), stamp_in("left01.png")
        (1700000000123456789, None)
    """
    found = _STAMPED.search(str(name))
    return None if found is None else int(found[1] + found[2])


def name_of(stamp: int) -> str:
    """The name of the image with a stamp, nanoseconds."""
    return f"{stamp // 10**9}.{stamp % 10**9:09d}.png"


def pair_stamps(first: Sequence[int], second: Sequence[int]) -> list[tuple[int, int]]:
    """Stamps of two cameras, nanoseconds in their order, that are each other's nearest, at most 10 ms apart.

    Raises:
        InputError: there are none.

    Example:
        >>> pair_stamps([0, 100_000_000, 200_000_000], [99_000_000, 205_000_000, 300_000_000])
        [(100000000, 99000000), (200000000, 205000000)]
    """

    def nearest(stamps: Sequence[int], to: int) -> int:
        place = bisect.bisect(stamps, to)
        return min(stamps[max(0, place - 1) : place + 1], key=lambda stamp: abs(stamp - to))

    pairs = [(one, other) for one in first for other in [nearest(second, one)] if nearest(first, other) == one]
    found = [(one, other) for one, other in pairs if abs(one - other) <= _APART_NS]
    if not found:
        apart = min(abs(one - other) for one, other in pairs)
        raise InputError(
            f"no images of both cameras within {_APART_NS / 1e6:g} ms of each other, the nearest are {apart / 1e6:g} "
            "ms apart: trigger the cameras together, or correct their clocks"
        )
    return found


def open_bag(path: str | Path) -> Bag:
    """A bag, which stays open for what else is read of it.

    Raises:
        FileError: it cannot be read.
        InputError: rosbags is missing.
    """
    about = os.stat(path)
    return _opened(os.path.realpath(path), str(path), about.st_mtime_ns, about.st_size)


def message_types(*, first: bool) -> Any:
    """The types of messages of ROS 1 or 2, by rosbags."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.LATEST)
    if TF not in store.types:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
    return store


class Bag:
    """Topics and messages of a bag; several threads may use it."""

    def __init__(self, path: str, shown: str) -> None:
        with with_extra("ros", "bags need"):
            from rosbags.rosbag1 import Reader as Reader1
            from rosbags.rosbag2 import Reader as Reader2
        self.path, self._lock = shown, threading.RLock()
        self._stamps: dict[str, dict[int, int]] = {}
        self._first = os.path.isfile(path) and read_head(path, 7) == b"#ROSBAG"
        self._types = message_types(first=self._first)
        try:
            self._reader: Any = Reader1(path) if self._first else Reader2(path)
            self._reader.open()
        except Exception as error:
            raise FileError(f"{shown}: cannot be read as a bag ({error}); {_CLOSED}") from error

    def topics(self, *kinds: str) -> dict[str, int]:
        """The topics with messages of these types, and how many each has."""
        found: dict[str, int] = {}
        for one in self._reader.connections:
            if one.msgtype in kinds and one.msgcount:
                found[one.topic] = found.get(one.topic, 0) + one.msgcount
        return dict(sorted(found.items()))

    def image_topic(self, asked: str) -> str:
        """The topic of images that was asked for, or the only one.

        Raises:
            InputError: no such topic, or several; the message names them.
        """
        found = self.topics(*IMAGES)
        if asked in found or (len(found) == 1 and not asked):
            return asked or next(iter(found))
        if not found:
            kinds = sorted({one.msgtype for one in self._reader.connections})
            raise InputError(f"{self.path}: no images in this bag; it has {', '.join(kinds) or 'no messages'}")
        what = f"no images of the topic {asked}" if asked else f"images of {len(found)} topics"
        listed = ", ".join(f"{self.path}:{topic} ({count})" for topic, count in found.items())
        raise InputError(f"{self.path}: {what}; name one of {listed}")

    def messages(self, topic: str, since: int | None = None, until: int | None = None) -> Iterator[tuple[int, bytes]]:
        """When each message was recorded, nanoseconds, and its bytes.

        Raises:
            FileError: the bag is damaged there.
        """
        connections = [one for one in self._reader.connections if one.topic == topic]
        with self._lock:
            try:
                for _, recorded, data in self._reader.messages(connections, since, until):
                    yield recorded, data
            except Exception as error:
                raise FileError(f"{self.path}: {topic} cannot be read further ({error}); {_CLOSED}") from error

    def decoded(self, data: bytes, kind: str) -> Any:
        """A message, with its fields.

        Raises:
            FileError: its bytes are none of that type.
        """
        try:
            return (self._types.deserialize_ros1 if self._first else self._types.deserialize_cdr)(data, kind)
        except Exception as error:
            raise FileError(f"{self.path}: a damaged message of {kind}: {error}") from error

    def stamps(self, topic: str) -> dict[int, int]:
        """The stamps of a topic's images, nanoseconds in their order, and when each was recorded.

        Of what is damaged, what can be read is kept; that is said, and where images have no stamp, too.
        """
        with self._lock:
            if topic not in self._stamps:
                self._stamps[topic] = self._listed(topic)
            return self._stamps[topic]

    def _listed(self, topic: str) -> dict[int, int]:
        found: dict[int, int] = {}
        bare = twice = 0
        try:
            for recorded, data in self.messages(topic):
                stamp = self._stamp(data)
                bare += not stamp
                twice += (stamp or recorded) in found
                found.setdefault(stamp or recorded, recorded)
        except FileError as error:
            if not found:
                raise
            _say(f"{error}; the {len(found)} images before that are used")
        if bare:
            _say(f"{self.path}: {bare} images of {topic} have no stamp; the times of recording are taken")
        if twice:
            _say(f"{self.path}: {twice} images of {topic} have the stamp of an earlier one and are left out")
        return dict(sorted(found.items()))

    def _stamp(self, data: bytes) -> int:
        # The header comes first: in ROS 1 behind its number, in ROS 2 behind four bytes that tell the order of bytes.
        if len(data) < 12:
            raise FileError(f"{self.path}: a message of {len(data)} bytes, which is no image")
        order = "<" if self._first or data[1] & 1 else ">"
        seconds, part = struct.unpack_from(f"{order}II", data, 4)
        return int(seconds) * 10**9 + int(part)

    def image(self, topic: str, stamp: int) -> Any:
        """The message of the image with this stamp.

        Raises:
            FileError: there is none, or it is damaged.
        """
        recorded = self.stamps(topic).get(stamp)
        if recorded is not None:
            kind = next(one.msgtype for one in self._reader.connections if one.topic == topic)
            for _, data in self.messages(topic, recorded, recorded + 1):
                if (self._stamp(data) or recorded) == stamp:
                    return self.decoded(data, kind)
        raise FileError(f"{self.path}: no image of {topic} with the stamp {stamp} ns")


@functools.lru_cache(maxsize=4)
def _opened(path: str, shown: str, *_changed: int) -> Bag:
    return Bag(path, shown)


def _say(text: str) -> None:
    warnings.warn(text, KcalWarning, stacklevel=2)
