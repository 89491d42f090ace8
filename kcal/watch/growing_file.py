"""Lines of a text file that another process writes, as they become whole."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from kcal.errors import FileError


class GrowingFile:
    """Read what has been added since the last time.

    Args:
        path: of the file.
    """

    def __init__(self, path: str | Path) -> None:
        self.path, self.number, self._offset = path, 0, 0

    def lines(self) -> Iterator[str]:
        """The whole lines that have come, without their ends; `number` is that of the line, from 1.

        Raises:
            FileError: the file cannot be read.
        """
        try:
            with open(self.path, "rb") as file:
                file.seek(self._offset)
                for line in file:
                    # One that is still being written is left out.
                    if not line.endswith(b"\n"):
                        break
                    self._offset += len(line)
                    self.number += 1
                    yield line.decode("utf-8-sig" if self.number == 1 else "utf-8", "replace").rstrip("\r\n")
        except OSError as error:
            raise FileError(f"{self.path}: cannot read: {error.strerror or error}") from error
