"""Describe a calibration board: its points, the size of its squares, its markers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import pydantic

from kcal.corners.board_text import DICTIONARIES, MOST, board_fields
from kcal.corners.kalibr_target import target_fields
from kcal.errors import FileError, InputError
from kcal.lens.calibration import BoardRecord
from kcal.native_file import Record

if TYPE_CHECKING:
    from torch import Tensor

Pattern = Literal["checkerboard", "circles", "asymmetric", "aprilgrid"]
TAGS = "apriltag_36h11"  # the dictionary of an AprilGrid
_TARGET_FILES = (".yaml", ".yml")


class Board(Record):
    """A checkerboard, a grid of circles or an AprilGrid, described by its points in rows and columns.

    Convention: x runs along a row, y down the columns, z into the board, away from a camera in front of it. Point
    `row * columns + column` lies

    * on a checkerboard at `(column * square, row * square, 0)` meters. The square diagonally outside corner 0 is dark
      (light on a ChArUco board of the old numbering, see `kcal.corners.charuco`);
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
    def _markers(self) -> Board:
        if (self.dictionary is None) != (self.marker is None):
            raise ValueError("a ChArUco board has a dictionary and a marker size, a checkerboard neither")
        if self.dictionary is not None and self.pattern != "checkerboard":
            raise ValueError("only a ChArUco board has a dictionary; the tags of an AprilGrid are 36h11")
        if self.dictionary is None or self.marker is None:
            return self
        if self.dictionary not in DICTIONARIES:
            raise ValueError(f"dictionary {self.dictionary!r}: choose one of {', '.join(DICTIONARIES)}")
        self._refuse_few(self.dictionary)
        if not self.marker < self.square:
            raise ValueError("a marker must be smaller than its square")
        return self

    @pydantic.model_validator(mode="after")
    def _fits_pattern(self) -> Board:
        if (self.gap is None) == (self.pattern == "aprilgrid"):
            raise ValueError("an AprilGrid has a gap between its tags, other boards have none")
        if self.gap is not None:
            if self.columns % 2 or self.rows % 2:
                raise ValueError("an AprilGrid has two points of each tag in a row and in a column")
            if not self.gap <= self.square:
                raise ValueError("the gap between tags must not exceed their side")
            self._refuse_few(TAGS)
        circles = self.pattern in ("circles", "asymmetric")
        if self.diameter is not None and not (circles and self.diameter < self.spacing):
            raise ValueError("only circles have a diameter, which is smaller than the distance of their centers")
        if self.first and not self.markers:
            raise ValueError("only a board with markers has a first number")
        return self

    def _refuse_few(self, dictionary: str) -> None:
        if self.first + self.markers > DICTIONARIES[dictionary]:
            since = f" from number {self.first} on" if self.first else ""
            raise ValueError(f"the board needs {self.markers} markers{since}, dictionary {dictionary} fewer")

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
                raise InputError(f"board {size!r}: give the side of its squares as well, for example --square 25mm")
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
        return cls.model_validate(
            {
                "columns": record.columns, "rows": record.rows, "square": record.square,
                "pattern": record.pattern, "gap": record.gap,
            }
        )  # fmt: skip

    def __str__(self) -> str:
        plain = str(self.record)
        if self.marker is not None:
            plain = f"{plain}, {self.marker * 1000:g} mm markers {self.dictionary}"
        if self.diameter is not None:
            plain = f"{plain}, {self.diameter * 1000:g} mm wide"
        return f"{plain} from number {self.first}" if self.first else plain
