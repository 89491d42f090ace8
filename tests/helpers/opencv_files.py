"""Files of OpenCV's FileStorage."""

from pathlib import Path
from typing import Any

import cv2


def file_storage(path: Path, **values: Any) -> Path:
    """A file of these values, in their order."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        file.write(name, value)
    file.release()
    return path
