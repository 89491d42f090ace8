"""Results as Arrow tables, which pandas, polars, DuckDB and other libraries of tables take as they are."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from kcal.errors import with_extra

# Columns of well-known binary.
WKB = ("geometry", "region")


class ArrowRows:
    """What has rows: `pandas.DataFrame.from_arrow`, `polars.DataFrame` and `pyarrow.table` take it.

    Through the PyCapsule interface of Arrow. It needs the extra `tables`.
    """

    def to_arrow(self) -> Any:
        """A `pyarrow.Table`, one row each; null where a number is unknown.

        Raises:
            InputError: pyarrow is not installed.
        """
        raise NotImplementedError

    def __arrow_c_stream__(self, requested_schema: object = None) -> object:
        return self.to_arrow().__arrow_c_stream__(requested_schema)


def arrow_table(columns: Mapping[str, Any], about: Mapping[str, Mapping[str, Any]] | None = None) -> Any:
    """A `pyarrow.Table` of columns by name; NaN becomes null.

    Args:
        columns: numbers as an array of NumPy; texts, or geometries of `wkb_points` and `wkb_polygon`, as a list.
        about: metadata of the table: JSON by name.

    Raises:
        InputError: pyarrow is not installed.
    """
    with with_extra("tables", "Arrow tables need"):
        import pyarrow

    made = {}
    for name, values in columns.items():
        # Stated, for a column in which all is unknown has no type of its own.
        kind = None if isinstance(values, np.ndarray) else pyarrow.string() if name not in WKB else pyarrow.binary()
        made[name] = pyarrow.array(values, kind, from_pandas=True)
    return pyarrow.table(made).replace_schema_metadata({key: json.dumps(value) for key, value in (about or {}).items()})


def wkb_points(coordinates: np.ndarray) -> list[bytes | None]:
    """Places (N, 3) x, y, z as points in well-known binary (OGC 06-103r4); None where x is NaN."""
    packed = np.zeros(len(coordinates), np.dtype([("order", "u1"), ("kind", "<u4"), ("place", "<f8", 3)]))
    packed["order"], packed["kind"], packed["place"] = 1, 1001, coordinates
    data, size = packed.tobytes(), packed.dtype.itemsize
    there = np.isfinite(coordinates[:, 0]).tolist()
    return [data[i * size : (i + 1) * size] if one else None for i, one in enumerate(there)]


def wkb_polygon(rings: list[np.ndarray]) -> bytes:
    """One polygon for each closed ring (M, 2) of x, y, together in well-known binary."""
    head = np.dtype([("order", "u1"), ("kind", "<u4"), ("count", "<u4")])
    polygons = [
        np.array((1, 3, 1), head).tobytes() + np.array(len(ring), "<u4").tobytes() + ring.astype("<f8").tobytes()
        for ring in rings
    ]
    return np.array((1, 6, len(rings)), head).tobytes() + b"".join(polygons)
