"""Read marks of any number of cameras: long tables with one line for each thing that each camera saw."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.rig.sources import Features, Landmarks
from kcal.errors import FileError, InputError
from kcal.locate.marks import read_marks
from kcal.locate.survey import MarkedLandmarks, Survey, inverse_range_of
from kcal.locate.tables import TableRow, header_of, read_chunks

_LONG = ("name", "camera", "u", "v")
_HEADER = ",".join(_LONG)
_KNOWN = (*_LONG, "time", "sigma", "note")
_RANGES = ("range", "range_sigma", "beyond")


class ViewMarks(NamedTuple):
    """What several cameras saw.

    Attributes:
        names: one for each row; with the moment where a thing was seen at several.
        pixels: (N, C, 2) float64; NaN where a camera has no mark.
        sigma: (N, C) px as the table states it; NaN where it does not.
        extras: `time`, where the table has it, and other columns, as in the first line of each.
    """

    names: tuple[str, ...]
    pixels: Tensor
    sigma: Tensor
    extras: dict[str, list[str]]

    def sigmas(self, default: float) -> Tensor:
        """(N, C) px, `default` where none is stated."""
        return torch.where(self.sigma.isfinite(), self.sigma, default)


def is_long(path: str | Path) -> bool:
    """Whether a table has a column `camera`."""
    return "camera" in header_of(path)


def read_views(path: str | Path, cameras: Sequence[str], *, ranges: bool = False, others: bool = False) -> ViewMarks:
    r"""Read `name,camera,u,v` and, if they are there, `time` (seconds or text), `sigma` (px) and `note`.

    Lines of one name, and one time, belong together; a camera is named once for each. The table of pairs
    (`name,left_u,left_v,right_u,right_v`) is read too, where there are two cameras.

    Args:
        path: of the file.
        cameras: their names, in the order of the result.
        ranges: accept the columns range, range_sigma and beyond, and no others; otherwise any are kept.
        others: skip marks of other cameras, where they are otherwise an error.

    Raises:
        FileError: a camera that is not there, two marks of one thing in one camera; the line is named.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "marks.csv")
        ...     _ = path.write_text("name,camera,u,v\nmast,a,10,20\nmill,b,5,6\nmast,c,30,40\n")
        ...     views = read_views(path, ("a", "b", "c"))
        >>> views.names, views.pixels[0, :, 0].tolist()
        (('mast', 'mill'), [10.0, nan, 30.0])
    """
    if not is_long(path):
        if len(cameras) != 2:
            raise FileError(f"{path}: marks of {len(cameras)} cameras need the columns {_HEADER}, one line each")
        pairs = read_marks(path, single=True)
        return ViewMarks(pairs.names, pairs.pixels, pairs.sigmas(math.nan), {})
    number: Mapping[str, int] = {name: c for c, name in enumerate(cameras)}
    rows: dict[tuple[str, str], int] = {}
    placed: dict[tuple[int, int], tuple[float, float, float]] = {}
    first: list[TableRow] = []
    more: list[str] = []
    known = (*_KNOWN, *(_RANGES if ranges else ()))
    for chunk in read_chunks(path, _HEADER, known, _LONG, extras=not ranges, unique=False):
        more = [column for column in chunk.columns if column not in _KNOWN]
        for row in chunk.rows():
            camera = row.cells["camera"]
            if camera not in number and others:
                continue
            if camera not in number:
                raise FileError(f"{row.where}: no camera is named {camera!r}; they are {', '.join(cameras)}")
            key = row.name, row.cells.get("time", "")
            place = rows.setdefault(key, len(rows)), number[camera]
            if place[0] == len(first):
                first.append(row)
            if place in placed:
                raise FileError(f"{row.where}: {row.name!r} was marked in {camera} before; one mark each is needed")
            sigma = row.positive("sigma") or math.nan
            placed[place] = row.number("u", "a pixel coordinate"), row.number("v", "a pixel coordinate"), sigma
    if not rows:
        raise FileError(f"{path}: no mark of {', '.join(cameras)}; the column camera needs its file's name")
    table = torch.full((len(rows), len(cameras), 3), math.nan, dtype=torch.float64)
    for (i, c), values in placed.items():
        table[i, c] = torch.tensor(values, dtype=torch.float64)
    times = [time for _, time in rows]
    names = [name for name, _ in rows]
    several = {name for name in names if names.count(name) > 1} if any(times) else set()
    extras = {column: [row.cells[column] for row in first] for column in more}
    if any(times):
        extras = {"time": times, **extras}
    return ViewMarks(
        tuple(f"{name} {time}" if name in several else name for name, time in rows), table[..., :2], table[..., 2],
        extras,
    )  # fmt: skip


def match_views(survey: Survey, views: ViewMarks, pixel_sigma: float) -> MarkedLandmarks:
    """Match surveyed places and marks by name; see `kcal.rig.match_landmarks`.

    Raises:
        InputError: no name is in both.
    """
    index = {name: i for i, name in enumerate(views.names)}
    places = [i for i, name in enumerate(survey.names) if name in index]
    if not places:
        raise InputError(
            f"no surveyed place ({', '.join(survey.names[:3])} ...) has a mark ({', '.join(views.names[:3])} ...): "
            "the names must be the same in both files"
        )
    rows = [index[survey.names[i]] for i in places]
    landmarks = Landmarks(
        names=tuple(survey.names[i] for i in places),
        points=survey.points[places],
        sigma=survey.sigma[places],
        pixels=views.pixels[rows],
        pixel_sigma=views.sigmas(pixel_sigma)[rows],
    )
    named = set(survey.names)
    return MarkedLandmarks(
        landmarks,
        tuple(name for name in survey.names if name not in index),
        tuple(name for name in views.names if name not in named),
    )


def read_feature_views(path: str | Path, cameras: Sequence[str], pixel_sigma: float) -> Features:
    """Things of unknown position, seen by any two or more cameras; their ranges as in `kcal.rig.read_features`.

    Raises:
        FileError: see `read_views`.
    """
    views = read_views(path, cameras, ranges=True)
    count = len(views.names)
    cells = {column: views.extras.get(column, [""] * count) for column in _RANGES}
    rows = [
        TableRow(f"{path}: {name}", name, {column: cells[column][i] for column in _RANGES})
        for i, name in enumerate(views.names)
    ]
    known = torch.tensor([inverse_range_of(row) for row in rows], dtype=torch.float64).reshape(-1, 2)
    return Features(
        names=views.names,
        pixels=views.pixels,
        inverse_range=known[:, 0],
        inverse_range_sigma=known[:, 1],
        pixel_sigma=pixel_sigma,
    )
