"""Describe a calibration board: its points, squares and markers, also from short texts and Kalibr's target files."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import pydantic

from kcal.errors import FileError, InputError
from kcal.files import read_text
from kcal.lens.calibration import BoardRecord
from kcal.native_file import Record
from kcal.strict_formats import MOST_YAML, read_yaml
from kcal.values import length

if TYPE_CHECKING:
    from torch import Tensor


# Read what a board is from short texts, such as `charuco:9x6:5x5_100:15mm` and `25mm`.

# Markers in OpenCV's dictionaries, by name.
DICTIONARIES = {
    **{f"{bits}x{bits}_{count}": count for bits in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    "aruco_original": 1024,
    "aruco_mip_36h12": 250,
    "apriltag_16h5": 30,
    "apriltag_25h9": 35,
    "apriltag_36h10": 2320,
    "apriltag_36h11": 587,
}  # fmt: skip
_DEFAULT_DICTIONARY, _MARKER_SHARE = "4x4_50", 0.7
_SPACING = 0.3  # of the tag's side: that of the boards that Kalibr offers for download
MOST = 500  # points in a row or a column
_FORMS = {
    "": "COLUMNSxROWS",
    "charuco": "charuco:COLUMNSxROWS[:DICTIONARY][:MARKER][:idFIRST]",
    "circles": "circles:COLUMNSxROWS[:DIAMETER]",
    "asymmetric": "asymmetric:COLUMNSxROWS[:DIAMETER]",
    "aprilgrid": "aprilgrid:TAGSxTAGS[:SPACING][:idFIRST]",
}


def board_fields(text: str, square: str) -> dict[str, Any]:
    """The fields of `Board` that two texts describe; see `Board.parse`.

    Raises:
        InputError: a text that cannot be read.

    Example:
        >>> board_fields("9x6", "25mm")
        {'columns': 9, 'rows': 6, 'square': 0.025}
    """
    kind, _, rest = text.strip().rpartition(":") if ":" not in text else text.strip().partition(":")
    if kind not in _FORMS:
        kinds = ", ".join(name for name in _FORMS if name)
        raise InputError(f"board {text!r}: {kind!r} is no kind of board; choose one of {kinds}")
    size, *more = rest.split(":")
    form = f"board {text!r}: write {_FORMS[kind]}"
    match = re.fullmatch(r"\s*(\d+)\s*[xX×]\s*(\d+)\s*", size)
    if not match:
        counted = "inner corners as " if kind in ("", "charuco") else ""
        raise InputError(f"board {text!r}: write {counted}{_FORMS[kind]}, for example {kind and kind + ':'}9x6")
    columns, rows = int(match.group(1)), int(match.group(2))
    each = 2 if kind == "aprilgrid" else 1
    if not (2 <= each * columns <= MOST and 2 <= each * rows <= MOST):
        what = "tags" if kind == "aprilgrid" else "circles" if kind in ("circles", "asymmetric") else "inner corners"
        raise InputError(f"board {text!r}: {2 // each} to {MOST // each} {what} each way are needed")
    side = length(square, "square")
    fields: dict[str, Any] = {"columns": each * columns, "rows": each * rows, "square": side}
    given: dict[str, Any] = {}
    for part in more:
        name, value = _said(kind, part, side, given)
        if not name or name in given:
            raise InputError(form)
        given[name] = value
    usual: dict[str, Any] = {"pattern": kind} if kind not in ("", "charuco") else {}
    if kind == "charuco":
        usual = {"dictionary": _DEFAULT_DICTIONARY, "marker": _MARKER_SHARE * side}
    elif kind == "aprilgrid":
        usual["gap"] = _SPACING * side
    return fields | usual | given


def _said(kind: str, part: str, side: float, given: Mapping[str, Any]) -> tuple[str, Any]:
    """Which field a part of a text says, and its value; no name where a board of this kind has no such part."""
    name = part.strip().lower().removeprefix("dict_")
    if kind in ("charuco", "aprilgrid") and (first := re.fullmatch(r"id(\d{1,6})", name)):
        return "first", int(first[1])
    if kind == "charuco" and (name in DICTIONARIES or (not given and not re.match(r"[\d.]+\s*[a-z]+$", name))):
        return "dictionary", name
    if kind == "aprilgrid" and re.fullmatch(r"\d*\.?\d+", name):
        return "gap", float(name) * side
    field = {"": "", "charuco": "marker", "aprilgrid": "gap"}.get(kind, "diameter")
    if not field or field in given:
        return "", None
    return field, length(part, "spacing" if field == "gap" else field)


# Read the target files of Kalibr (https://github.com/ethz-asl/kalibr, wiki page "Calibration targets").


def target_fields(path: str | Path) -> dict[str, Any]:
    r"""The fields of `Board` that a target file of Kalibr describes.

    `aprilgrid` (`tagCols`, `tagRows`, `tagSize`, `tagSpacing`), `checkerboard` (`targetCols`, `targetRows`,
    `rowSpacingMeters`, `colSpacingMeters`) and `circlegrid` (`targetCols`, `targetRows`, `spacingMeters`,
    `asymmetricGrid`). `tagSpacing` is a share of `tagSize`.

    Raises:
        FileError: it cannot be read, or a field is missing or wrong.

    Example:
        >>> import tempfile
        >>> text = "target_type: aprilgrid\ntagCols: 6\ntagRows: 4\ntagSize: 0.08\ntagSpacing: 0.25"
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "april.yaml")
        ...     _ = path.write_text(text)
        ...     target_fields(path)
        {'pattern': 'aprilgrid', 'columns': 12, 'rows': 8, 'square': 0.08, 'gap': 0.02}
    """
    content = read_yaml(read_text(path, MOST_YAML), str(path))
    if "target_type" not in content:
        raise FileError(f"{path}: not a target file of Kalibr: target_type is missing")
    kind = content["target_type"]

    def stated(name: str, what: str, kinds: Any, fits: Callable[[Any], bool]) -> Any:
        value: Any = content.get(name)
        if isinstance(value, bool) or not isinstance(value, kinds) or not fits(value):
            raise FileError(f"{path}: {name} must be {what}, it is {value!r:.40}")
        return value

    def number(name: str) -> float:
        return float(stated(name, "a positive number", (int, float), lambda value: 0 < value < 1e3))

    def count(name: str) -> int:
        return int(stated(name, "a whole number from 1 to 500", int, lambda value: 1 <= value <= 500))

    if kind == "aprilgrid":
        size, columns, rows = number("tagSize"), 2 * count("tagCols"), 2 * count("tagRows")
        gap = number("tagSpacing") * size
        return {"pattern": "aprilgrid", "columns": columns, "rows": rows, "square": size, "gap": gap}
    if kind not in ("checkerboard", "circlegrid"):
        raise FileError(f"{path}: target_type {kind!r:.40}: kcal reads aprilgrid, checkerboard and circlegrid")
    grid = {"columns": count("targetCols"), "rows": count("targetRows")}
    if kind == "checkerboard":
        across, down = number("colSpacingMeters"), number("rowSpacingMeters")
        if abs(across - down) > 1e-9:
            raise FileError(f"{path}: rowSpacingMeters {down:g} and colSpacingMeters {across:g}: squares are needed")
        return grid | {"square": across}
    asymmetric = content.get("asymmetricGrid")
    if not isinstance(asymmetric, bool):
        raise FileError(f"{path}: asymmetricGrid must be true or false, it is {asymmetric!r:.40}")
    return {"pattern": "asymmetric" if asymmetric else "circles"} | grid | {"square": number("spacingMeters")}


# Describe a calibration board: its points, the size of its squares, its markers.

# Meters: the longer side of an A0 sheet, and a board so small that it is seldom printed; and what is usual.
_SHEETS, _LIKELY = (0.02, 1.19), 0.08

Pattern = Literal["checkerboard", "circles", "asymmetric", "aprilgrid"]
TAGS = "apriltag_36h11"  # the dictionary of an AprilGrid
_TARGET_FILES = (".yaml", ".yml")


def square_of(text: str) -> str:
    """What `--square` is of a board with this text."""
    lengths = {"circles": "the distance of its circles", "asymmetric": "the distance of its rows of circles"}
    return {"aprilgrid": "the side of its tags", **lengths}.get(text.partition(":")[0], "the side of its squares")


class Board(Record):
    """A checkerboard, a grid of circles or an AprilGrid, described by its points in rows and columns.

    Convention: x runs along a row, y down the columns, z into the board, away from a camera in front of it. Point
    `row * columns + column` lies

    * on a checkerboard at `(column * square, row * square, 0)` meters. The square diagonally outside corner 0 is dark
      (light on a ChArUco board of the old numbering, see `kcal.corners.marker_boards`);
    * of `circles` likewise, the points being centers;
    * of `asymmetric` circles at `((2 * column + row % 2) * square, row * square, 0)`, as OpenCV counts them;
    * of an `aprilgrid` where Kalibr puts it, in Kalibr's order: rows count upward from the lower left corner of the
      first tag, which is the origin, so that y is negative above it. Each tag has four points.

    Args:
        columns: points in a row: inner corners (one less than the squares), circles, or twice the tags.
        rows: points in a column.
        square: meters: side of a square or of a tag; distance of circles in a row, of `asymmetric` ones half of it.
        dictionary: of a ChArUco board, the name of OpenCV's dictionary (`4x4_50`) whose markers lie in the light
            squares, numbered row by row; None for other boards.
        marker: side of a marker in meters, of a ChArUco board.
        pattern: what is printed.
        gap: meters from tag to tag, of an AprilGrid.
        diameter: of circles, meters; None: it is measured in each image.
        first: lowest number of the markers or tags, so that two boards in one image are told apart.

    Example:
        >>> Board(columns=9, rows=6, square=0.025).points.shape
        torch.Size([54, 3])
        >>> Board.parse("aprilgrid:6x6:0.3", "88mm").points[2].tolist()
        [0.1144, 0.0, 0.0]
    """

    _LATER: ClassVar[Mapping[str, Any]] = {"pattern": "checkerboard", "gap": None, "diameter": None, "first": 0}

    columns: int = pydantic.Field(ge=2, le=MOST)
    rows: int = pydantic.Field(ge=2, le=MOST)
    square: float = pydantic.Field(gt=0)
    dictionary: str | None = None
    marker: float | None = pydantic.Field(default=None, gt=0)
    pattern: Pattern = "checkerboard"
    gap: float | None = pydantic.Field(default=None, gt=0)
    diameter: float | None = pydantic.Field(default=None, gt=0)
    first: int = pydantic.Field(default=0, ge=0)

    @pydantic.model_validator(mode="after")
    def _fits_pattern(self) -> Board:
        if (self.dictionary is None) != (self.marker is None):
            raise ValueError("a ChArUco board has a dictionary and a marker size, a checkerboard neither")
        if self.dictionary is not None and self.pattern != "checkerboard":
            raise ValueError("only a ChArUco board has a dictionary; the tags of an AprilGrid are 36h11")
        if self.dictionary not in (None, *DICTIONARIES):
            raise ValueError(f"dictionary {self.dictionary!r}: choose one of {', '.join(DICTIONARIES)}")
        if self.marker is not None and not self.marker < self.square:
            raise ValueError("a marker must be smaller than its square")
        if (self.gap is None) == (self.pattern == "aprilgrid"):
            raise ValueError("an AprilGrid has a gap between its tags, other boards have none")
        if self.gap is not None:
            if self.columns % 2 or self.rows % 2:
                raise ValueError("an AprilGrid has two points of each tag in a row and in a column")
            if not self.gap <= self.square:
                raise ValueError("the gap between tags must not exceed their side")
        if self.markers and self.first + self.markers > DICTIONARIES[dictionary := self.dictionary or TAGS]:
            since = f" from number {self.first} on" if self.first else ""
            raise ValueError(f"the board needs {self.markers} markers{since}, dictionary {dictionary} fewer")
        circles = self.pattern in ("circles", "asymmetric")
        if self.diameter is not None and not (circles and self.diameter < self.spacing):
            raise ValueError("only circles have a diameter, which is smaller than the distance of their centers")
        if self.first and not self.markers:
            raise ValueError("only a board with markers has a first number")
        return self

    def _doubt(self) -> str:
        # Boards for drones have squares of a meter.
        return f"Board: {self.square:g} is in meters; give 25 mm as square=0.025" if self.square >= 5.0 else ""

    @classmethod
    def parse(cls, size: str, square: str | None = None) -> Board:
        """Read `"9x6"` (inner corners, columns by rows) and `"25mm"` (units: mm, cm, m, in).

        * `charuco:9x6` is a ChArUco board. `charuco:9x6:5x5_100` names a dictionary other than 4x4_50,
          `charuco:9x6:5x5_100:15mm` markers other than 0.7 of the square, and `:id40` the first marker.
        * `circles:7x6` are circles in rows and columns, `square` their distance; `circles:7x6:12mm` their diameter.
        * `asymmetric:4x11` are 11 rows of 4 circles, every other row shifted by half a distance. As in OpenCV, `square`
          is the distance of the rows, which is half the distance of circles in a row.
        * `aprilgrid:6x6` is Kalibr's grid of 6 by 6 tags of family 36h11 with number 0 at the lower left, `square`
          their side. `aprilgrid:6x6:0.25` (a share of the tag) or `:22mm` names a gap other than 0.3, and `:id36` the
          first tag.
        * `april.yaml` is a target file of Kalibr, which has all sizes.

        Raises:
            InputError: a size or a length that cannot be read, or a length without its unit.
            FileError: a target file that cannot be read.

        Example:
            >>> Board.parse("9x6", "25mm").square
            0.025
            >>> Board.parse("charuco:9x6:5x5_100:15mm", "20mm").marker
            0.015
        """
        if is_file := Path(size).suffix.lower() in _TARGET_FILES:
            if square:
                raise InputError(f"board {size}: the file has all sizes; leave --square {square} out")
            fields = target_fields(size)
        else:
            if not square:
                raise InputError(f"board {size!r}: give {square_of(size)} as well, for example --square 25mm")
            fields = board_fields(size, square)
        try:
            return cls(**fields)
        except InputError as error:
            why = str(error).removeprefix("Board: ")
            raise FileError(f"{size}: {why}") if is_file else InputError(f"board {size!r}: {why}") from error

    @property
    def corners(self) -> int:
        """Number of inner corners."""
        return self.columns * self.rows

    @property
    def markers(self) -> int:
        """Number of markers or tags; 0 for boards without."""
        if self.pattern == "aprilgrid":
            return self.corners // 4
        return 0 if self.dictionary is None else (self.columns + 1) * (self.rows + 1) // 2

    @property
    def spacing(self) -> float:
        """Least distance of two points, meters; of an AprilGrid the gap, for tags are larger."""
        if self.pattern == "asymmetric":
            return self.square * 2.0**0.5
        return self.square if self.gap is None else self.gap

    @property
    def points(self) -> Tensor:
        """Positions of the points on the flat board, (corners, 3) float64 meters, row by row."""
        import torch

        rows, columns = (torch.arange(count, dtype=torch.float64) for count in (self.rows, self.columns))
        y, x = torch.cartesian_prod(rows, columns).unbind(-1)
        if self.pattern == "asymmetric":
            x = 2.0 * x + y % 2
        if self.gap is not None:
            share = self.gap / self.square
            x, y = ((t % 2) + (t // 2) * (1.0 + share) for t in (x, y))
            y = 0.0 - y
        return torch.stack([x, y, torch.zeros_like(x)], -1) * self.square

    @property
    def extent(self) -> tuple[float, float]:
        """Width and height of the points, meters."""
        width, height, _ = (self.points.amax(0) - self.points.amin(0)).tolist()
        return width, height

    @property
    def quarter_turns(self) -> tuple[int, ...]:
        """The quarter turns after which the pattern looks as before, beginning with none."""
        if self.dictionary is not None or self.pattern == "aprilgrid":
            return (0,)
        if self.pattern == "asymmetric":
            return (0,) if self.rows % 2 else (0, 2)
        if self.pattern == "checkerboard" and (self.columns + self.rows) % 2 == 1:
            return (0,)
        square = self.columns == self.rows and (self.pattern == "circles" or self.rows % 2 == 0)
        return (0, 1, 2, 3) if square else (0, 2)

    @property
    def likelier_square(self) -> float | None:
        """The side of a square with which the board has the size of a sheet of paper; None if it has about that now.

        Meters. Nothing in images tells a unit that was mistyped: a board ten times as large is ten times as far away.

        Example:
            >>> Board.parse("9x6", "25.4cm").likelier_square, Board.parse("9x6", "25.4mm").likelier_square
            (0.0254, None)
        """
        longest = max(self.extent)
        if _SHEETS[0] <= longest <= _SHEETS[1]:
            return None
        sizes = (self.square * 10.0**power for power in (-1, -2, -3, 1, 2, 3))
        return next((round(size, 9) for size in sizes if _LIKELY <= longest * size / self.square <= _SHEETS[1]), None)

    @property
    def unambiguous(self) -> bool:
        """Whether the board differs from itself turned by 180°, as stereo needs it.

        It does if it has markers, if one count of a checkerboard is odd and one even, and if asymmetric circles have an
        odd number of rows. Circles in rows and columns never do.
        """
        return self.quarter_turns == (0,)

    @property
    def stereo_advice(self) -> str:
        """Which board to take for stereo instead of one that looks the same turned by 180°; empty for others."""
        if self.unambiguous:
            return ""
        if self.pattern == "circles":
            return "use asymmetric circles with an odd number of rows"
        return "use an odd number of rows" if self.pattern == "asymmetric" else "use one odd and one even number"

    @property
    def record(self) -> BoardRecord:
        """What a calibration keeps of the board: where its points are."""
        return BoardRecord(columns=self.columns, rows=self.rows, square=self.square, pattern=self.pattern, gap=self.gap)

    @classmethod
    def of(cls, record: BoardRecord) -> Board:
        """The board that a calibration was made with, as far as its record tells: without markers."""
        return cls.model_validate(dataclasses.asdict(record))

    def __str__(self) -> str:
        plain = str(self.record)
        if self.marker is not None:
            plain = f"{plain}, {self.marker * 1000:g} mm markers {self.dictionary}"
        if self.diameter is not None:
            plain = f"{plain}, {self.diameter * 1000:g} mm wide"
        return f"{plain} from number {self.first}" if self.first else plain
