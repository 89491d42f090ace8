"""Locate a table of marks of any length, one chunk ahead of whoever writes the positions."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from kcal.locate.columns import PositionColumns
from kcal.locate.locator import Locator
from kcal.locate.marks import MarkChunk, filled, read_mark_chunks


def located_chunks(locate: Locator, path: str | Path) -> Iterator[tuple[MarkChunk, PositionColumns]]:
    r"""Read and locate a table some rows at a time; the next ones meanwhile, in another thread.

    Args:
        locate: the rig and where it stands; its `pixel_sigma` counts where the table states no noise.
        path: of a table as `read_marks` reads it; other columns go with the positions.

    Raises:
        FileError: as `read_marks`, after the rows before the fault.

    Example:
        >>> import tempfile
        >>> from kcal.lens.mounting import Origin
        >>> from kcal.locate.budget import planned_rig
        >>> locate = Locator(planned_rig(), origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "points.csv")
        ...     _ = path.write_text("name,left_u,left_v,right_u,right_v\nmast,959.5,539.5,943.5,539.5\n")
        ...     [round(float(columns.column("range_m")[0])) for _, columns in located_chunks(locate, path)]
        [1000]
    """

    def located() -> Iterator[tuple[MarkChunk, PositionColumns]]:
        for chunk in read_mark_chunks(path):
            cov = filled(chunk.covariance, locate.localize.pixel_sigma)
            yield chunk, locate(chunk.names, chunk.pixels, cov, chunk.extras)

    source = located()
    with ThreadPoolExecutor(1) as pool:
        coming = pool.submit(next, source, None)
        while (found := coming.result()) is not None:
            coming = pool.submit(next, source, None)
            yield found
