"""Live sources of images: which texts name them, and their names without passwords."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import urlsplit

_STREAM = re.compile(r"(rtsps?|rtmps?|https?|udp|tcp|srt)://|camera:\d+$", re.IGNORECASE)


def is_stream(source: str | Path) -> bool:
    """Whether a source is live: an address such as `rtsp://...`, or `camera:0`, a device of this machine.

    Example:
        >>> is_stream("rtsp://10.0.0.7/main"), is_stream("camera:0"), is_stream("shots.mp4")
        (True, True, False)
    """
    return _STREAM.match(str(source)) is not None


def source_name(source: str | Path) -> str:
    """The name of a source in its views: the file's name, the device, or the stream's host without any password.

    Example:
        >>> source_name("rtsp://user:secret@10.0.0.7:554/main?token=1"), source_name("camera:0")
        ('10.0.0.7', 'camera:0')
    """
    text = str(source)
    if "://" in text and is_stream(source):
        return urlsplit(text).hostname or "stream"
    return text if is_stream(source) else Path(source).name
