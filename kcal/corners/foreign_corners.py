"""Read corners that other programs have found: mrcal's `corners.vnl`, CSV, OpenCV's and MATLAB's exports.

A weight w becomes a covariance of (1 / w)² px² along both axes: only ratios of weights count in a calibration whose
residuals are below a pixel. Corners with a weight of zero or below were not seen.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kcal.corners.board import Board
from kcal.corners.observations import Observations, View
from kcal.errors import FileError, InputError
from kcal.files import read_bytes, read_text
from kcal.strict_formats import read_mat, read_storage
from kcal.strict_json import MOST_BYTES

# (u, v, weight) of a corner; NaN where it was not seen.
Corner = tuple[float, float, float]
_UNSEEN = (math.nan, math.nan, math.nan)
# Of how much rows of corners bend, squared: those of columns that are taken for rows bend a hundred times as much.
_STRAIGHTER = 0.05


def import_corners(path: str | Path, board: Board, image_size: tuple[int, int] | None = None) -> Observations:
    r"""Read the corners of one camera from a file of another program.

    * `.vnl`: mrcal's corners, `filename x y level` or `filename x y weight`; a level is a weight of 2^-level.
    * `.csv`: `image,u,v` and, if need be, `weight` and the corner as `corner` or as `column,row`, from 0.
    * `.yml`, `.yaml`, `.xml`: `image_points` of OpenCV's calibration sample, `imagePoints` of its omnidir.
    * `.mat`: MATLAB's `imagePoints` with `worldPoints`, or in the order of its detector, down the columns first.

    Pixels are converted to kcal's convention: (0, 0) is the center of the first pixel.

    Args:
        path: of the file.
        board: the board; corners come row by row unless the file numbers them.
        image_size: (width, height) in pixels, where the file has none.

    Raises:
        FileError: it cannot be read, has a wrong number of corners, or a bad line, which is named.
        InputError: an unknown suffix, or no image size.

    Example:
        >>> import tempfile
        >>> text = "# filename x y level" + "".join(f"\na.png {i} {i} 0" for i in range(4))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "corners.vnl")
        ...     _ = path.write_text(text)
        ...     seen = import_corners(path, Board(columns=2, rows=2, square=0.1), (640, 480))
        >>> seen.names, seen.views[0].pixels[3]
        (('a.png',), (3.0, 3.0))
    """
    path = Path(path)
    if board.pattern != "checkerboard" and path.suffix.lower() == ".mat":
        raise InputError(
            f"{path}: points of {board} are not read from MATLAB's files; give a .csv with image,corner,u,v"
        )
    readers: dict[str, Callable[[Path, Board], tuple[dict[str, list[Corner]], tuple[int, int] | None]]] = {
        ".vnl": _from_vnl, ".csv": _from_csv, ".yml": _from_opencv, ".yaml": _from_opencv, ".xml": _from_opencv,
        ".mat": _from_matlab,
    }  # fmt: skip
    if path.suffix.lower() not in readers:
        raise InputError(f"{path}: corners are read from {', '.join(readers)} files")
    try:
        views, size = readers[path.suffix.lower()](path, board)
    except (FileError, InputError):
        raise
    except (ValueError, csv.Error) as error:
        raise FileError(f"{path}: bad corners file: {error}") from error
    except Exception as error:
        # Whatever a parser makes of what is in a file: the file is bad.
        raise FileError(f"{path}: bad corners file: {type(error).__name__}: {error!s:.200}") from error
    size = image_size or size
    if size is None:
        raise InputError(f"{path}: the image size is not in the file; give it (--size WIDTHxHEIGHT)")
    for name, corners in views.items():
        if len(corners) != board.corners:
            raise FileError(f"{path}: {name} has {len(corners)} corners, the board {board.corners}")
    # Arrays (N, 3), as `View` takes them.
    shown: dict[str, Any] = {
        name: array for name, corners in views.items() if np.isfinite(array := np.array(corners)).any()
    }
    weighted = any((array[np.isfinite(array[:, 2]), 2] != 1.0).any() for array in shown.values())
    try:
        found = [
            View(name=name, pixels=array[:, :2], covariance=array[:, 2:] ** -2.0 * (1, 0, 1) if weighted else None)
            for name, array in shown.items()
        ]
        if not found:
            raise FileError(f"{path}: no view with corners")
        _refuse_exchanged(board, [array[:, :2] for array in shown.values()])
        return Observations(board=board, image_size=size, refinement="none", views=tuple(found))
    except InputError as error:
        raise FileError(f"{path}: bad corners file: {error}") from error


def _refuse_exchanged(board: Board, views: Sequence[np.ndarray]) -> None:
    """Refuse corners whose rows are as long as the board's columns: where they go straight on, unlike the board's."""
    if board.pattern != "checkerboard" or board.columns == board.rows or min(board.columns, board.rows) < 3:
        return
    bends = [[np.square(np.diff(view.reshape(-1, length, 2), 2, axis=1)).sum(-1) for view in views]
             for length in (board.columns, board.rows)]  # fmt: skip
    own, exchanged = (np.median([np.nanmean(one) for one in each if np.isfinite(one).any()] or [0.0]) for each in bends)
    if exchanged < _STRAIGHTER * own:
        raise InputError(
            f"corners are in rows of {board.rows}, not of {board.columns}: the board seems to be "
            f"{board.rows}x{board.columns}"
        )


def _corner_of_weight(u: str, v: str, weight: float, where: str) -> Corner:
    if u in ("", "-") or v in ("", "-") or not weight > 0:
        return _UNSEEN
    values = float(u), float(v), weight
    if not all(map(math.isfinite, values)):
        raise ValueError(f"{where}: {u}, {v}, {weight} are no finite numbers")
    return values


def _from_vnl(path: Path, board: Board) -> tuple[dict[str, list[Corner]], None]:
    views: dict[str, list[Corner]] = {}
    header: list[str] = []
    for number, line in enumerate(read_text(path, MOST_BYTES).splitlines(), 1):
        where = f"line {number}"
        if line.startswith("##") or not line.strip():
            continue
        if line.startswith("#"):
            header = header or line.lstrip("#!").split()
            continue
        fields = line.split()
        if header[:3] != ["filename", "x", "y"] or header[3:] not in ([], ["level"], ["weight"]):
            raise ValueError(f"the header is {' '.join(header)!r}; '# filename x y level' or weight is needed")
        if len(fields) != len(header) and fields[1:] != ["-", "-"]:
            raise ValueError(f"{where}: {len(fields)} fields, the header has {len(header)}")
        corners = views.setdefault(fields[0], [])
        if fields[1] == "-":
            # An image without a board has a single line.
            corners.append(_UNSEEN)
            continue
        last = fields[3] if len(fields) > 3 else "-"
        weight = 1.0 if last == "-" else float(last)
        if header[3:] == ["level"] and last != "-":
            weight = 0.0 if weight < 0 else 0.5**weight
        corners.append(_corner_of_weight(fields[1], fields[2], weight, where))
    return {name: corners for name, corners in views.items() if corners != [_UNSEEN]}, None


def _from_csv(path: Path, board: Board) -> tuple[dict[str, list[Corner]], None]:
    table = csv.DictReader(io.StringIO(read_text(path, MOST_BYTES), newline=""), skipinitialspace=True)
    names = table.fieldnames or []
    needed, allowed = {"image", "u", "v"}, {"image", "u", "v", "weight", "corner", "column", "row"}
    if not needed <= set(names) <= allowed or ("column" in names) != ("row" in names):
        raise ValueError(f"the header is {','.join(names)!r}; image,u,v and weight, corner or column,row are needed")
    views: dict[str, list[Corner]] = {}
    filled: dict[str, set[int]] = {}
    numbered = "corner" in names or "column" in names
    for row in table:
        where = f"line {table.line_num}"
        if None in row or None in row.values():
            raise ValueError(f"{where}: a wrong number of fields")
        corner = _corner_of_weight(row["u"], row["v"], float(row.get("weight") or 1.0), where)
        corners = views.setdefault(row["image"], [_UNSEEN] * board.corners if numbered else [])
        if not numbered:
            corners.append(corner)
            continue
        place = int(row["corner"]) if "corner" in names else _place(int(row["column"]), int(row["row"]), board, where)
        if not 0 <= place < board.corners:
            raise ValueError(f"{where}: corner {place} is not on the board, which has {board.corners}")
        if place in filled.setdefault(row["image"], set()):
            raise ValueError(f"{where}: corner {place} of {row['image']} occurs twice")
        filled[row["image"]].add(place)
        corners[place] = corner
    return views, None


def _place(column: int, row: int, board: Board, where: str) -> int:
    if not (0 <= column < board.columns and 0 <= row < board.rows):
        raise ValueError(f"{where}: column {column}, row {row} are not on the board of {board.columns}x{board.rows}")
    return row * board.columns + column


def _from_opencv(path: Path, board: Board) -> tuple[dict[str, list[Corner]], tuple[int, int] | None]:
    stored = read_storage(read_bytes(path, MOST_BYTES), str(path))
    # A matrix of views by corners, or a matrix of each view, as cv::omnidir's data have them.
    points = stored.get("image_points", stored.get("imagePoints"))
    views = [np.asarray(view, float) for view in points] if isinstance(points, list | np.ndarray) else []
    if not views or any(view.shape[-1:] != (2,) for view in views):
        raise ValueError("image_points of OpenCV's calibration sample, or imagePoints of its omnidir, are needed")
    size = stored.get("imageSize", [stored.get(name) for name in ("image_width", "image_height")])
    return _unweighted(view.reshape(-1, 2) for view in views), None if None in size else _whole_size(size)


def _whole_size(sides: Any) -> tuple[int, int]:
    """Width and height, if they are whole numbers."""
    width, height = (float(side) for side in np.asarray(sides, dtype=float).ravel()[:2])
    if not all(1 <= side < math.inf and side == int(side) for side in (width, height)):
        raise ValueError(f"the image size is {width:g} x {height:g}; positive whole numbers are needed")
    return int(width), int(height)


def _unweighted(points: Iterable[np.ndarray]) -> dict[str, list[Corner]]:
    """Views named by their numbers; NaN where a corner was not seen."""
    return {
        f"{number:03d}": [(float(u), float(v), 1.0) if np.isfinite(u + v) else _UNSEEN for u, v in view]
        for number, view in enumerate(points, 1)
    }


def _from_matlab(path: Path, board: Board) -> tuple[dict[str, list[Corner]], tuple[int, int] | None]:
    content = read_mat(read_bytes(path, MOST_BYTES), str(path))
    points = np.asarray(content["imagePoints"], dtype=float)
    points = points[..., None] if points.ndim == 2 else points
    if points.ndim != 3 or points.shape[:2] != (board.corners, 2):
        raise ValueError(f"imagePoints has the shape {points.shape}; ({board.corners}, 2, views) is needed")
    # MATLAB's first pixel is (1, 1), and its detector goes down the columns first.
    views = np.moveaxis(points, -1, 0) - 1.0
    rows, columns = np.meshgrid(np.arange(board.rows), np.arange(board.columns))
    if "worldPoints" in content:
        world = np.asarray(content["worldPoints"], dtype=float)[:, :2]
        steps = np.diff(np.unique(np.round(world.ravel(), 9)))
        places = np.round((world - world.min(0)) / steps.min()).astype(int)
        columns, rows = places[:, 0], places[:, 1]
        if columns.max() >= board.columns or rows.max() >= board.rows:
            raise ValueError("worldPoints are not those of the board")
    order = rows.ravel() * board.columns + columns.ravel()
    if sorted(order) != list(range(board.corners)):
        raise ValueError("worldPoints are not those of the board")
    sorted_views = np.empty_like(views)
    sorted_views[:, order] = views
    size = content.get("imageSize")
    return _unweighted(sorted_views), None if size is None else _whole_size(np.ravel(size)[:2][::-1])
