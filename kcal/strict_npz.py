"""Read numpy archives of unknown origin: no objects, no more than was allowed once unpacked."""

from __future__ import annotations

import io
import zipfile

import numpy as np

from kcal.errors import FileError


def read_npz(data: bytes, source: str, most: int, what: str) -> dict[str, np.ndarray]:
    """The arrays of an .npz file by their names.

    Args:
        data: its bytes.
        source: names the file in errors.
        most: bytes that it may unpack to.
        what: it should contain, for errors.

    Raises:
        FileError: no archive, a damaged one, or one that unpacks to more.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > most:
            raise FileError(
                f"{source}: unpacks to {size / 2**20:.0f} MiB; no {what} is larger than {most // 2**20} MiB"
            )
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            return {name: np.asarray(file[name]) for name in file.files}
    except FileError:
        raise
    except Exception as error:
        # Damaged archives and headers raise errors of a dozen kinds, from zlib.error to MemoryError.
        raise FileError(f"{source}: not an .npz file with a {what}, or a damaged one") from error
