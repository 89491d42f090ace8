"""Lay out boards on pages, to print at true scale as SVG or PDF."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import escape

import numpy as np
import numpy.typing as npt

from kcal.corners.board import TAGS, Board
from kcal.corners.markers import marker_cells, opencv_dictionary
from kcal.errors import InputError
from kcal.files import write_atomic
from kcal.opencv import cv2

# Write black shapes and short texts as SVG or PDF at true scale.
#
# The files contain no dates or tool names, so that the same board always gives the same bytes.

_POINT = 72 / 25.4  # PDF points in a millimeter
_BEZIER = 0.5522847498  # 4 (√2 - 1) / 3: a cubic with this handle is closest to a quarter of a unit circle
_FONTS = "Helvetica, Arial, sans-serif"


class Rectangle(NamedTuple):
    """A filled black rectangle; millimeters from the page's top left corner."""

    x: float
    y: float
    width: float
    height: float


class Circle(NamedTuple):
    """A filled black circle; its center in millimeters from the page's top left corner."""

    x: float
    y: float
    diameter: float


class Text(NamedTuple):
    """A line of text whose baseline begins at (x, y) millimeters from the top left corner."""

    x: float
    y: float
    size: float
    text: str


class Drawing(NamedTuple):
    """A page and what is on it, in millimeters."""

    width: float
    height: float
    title: str
    rectangles: tuple[Rectangle, ...]
    texts: tuple[Text, ...] = ()
    circles: tuple[Circle, ...] = ()


def to_svg(drawing: Drawing) -> str:
    """The drawing as SVG 1.1, one user unit a millimeter.

    Example:
        >>> page = Drawing(width=10, height=5, title="t", rectangles=(Rectangle(x=1, y=1, width=2.5, height=3),))
        >>> "M1 1h2.5v3h-2.5z" in to_svg(page)
        True
    """
    width, height = _decimal(drawing.width), _decimal(drawing.height)
    path = "".join(
        f"M{_decimal(r.x)} {_decimal(r.y)}h{_decimal(r.width)}v{_decimal(r.height)}h{_decimal(-r.width)}z"
        for r in drawing.rectangles
    )
    path += "".join(
        f"M{_decimal(c.x - c.diameter / 2)} {_decimal(c.y)}"
        + f"a{_decimal(c.diameter / 2)} {_decimal(c.diameter / 2)} 0 1 0 {_decimal(c.diameter)} 0"
        + f"a{_decimal(c.diameter / 2)} {_decimal(c.diameter / 2)} 0 1 0 {_decimal(-c.diameter)} 0z"
        for c in drawing.circles
    )
    texts = "".join(
        f'<text x="{_decimal(t.x)}" y="{_decimal(t.y)}" font-size="{_decimal(t.size)}">{escape(t.text)}</text>\n'
        for t in drawing.texts
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<svg xmlns="http://www.w3.org/2000/svg" version="1.1" width="{width}mm" height="{height}mm" '
        f'viewBox="0 0 {width} {height}" font-family="{_FONTS}">\n'
        f"<title>{escape(drawing.title)}</title>\n"
        f'<rect width="{width}" height="{height}" fill="#fff"/>\n'
        f'<path d="{path}" fill="#000"/>\n'
        f"{texts}</svg>\n"
    )


def to_pdf(drawing: Drawing) -> bytes:
    """The drawing as a PDF 1.4 of one page; texts in the built-in Helvetica (Latin-1 characters only).

    Viewers are told not to scale it when printing (`/PrintScaling /None`).

    Raises:
        InputError: a character that Latin-1 does not have.

    Example:
        >>> to_pdf(Drawing(width=25.4, height=50.8, title="t", rectangles=()))[:8]
        b'%PDF-1.4'
    """

    def flip(y: float) -> str:
        return _decimal((drawing.height - y) * _POINT)

    content = ["0 g"]
    for r in drawing.rectangles:
        corner = f"{_decimal(r.x * _POINT)} {flip(r.y + r.height)}"
        content.append(f"{corner} {_decimal(r.width * _POINT)} {_decimal(r.height * _POINT)} re")
    content += [
        _pdf_circle(c.x * _POINT, (drawing.height - c.y) * _POINT, c.diameter * _POINT) for c in drawing.circles
    ]
    content.append("f" if drawing.rectangles or drawing.circles else "")
    for t in drawing.texts:
        content.append(
            f"BT /F1 {_decimal(t.size * _POINT)} Tf {_decimal(t.x * _POINT)} {flip(t.y)} Td ({_literal(t.text)}) Tj ET"
        )
    stream = _latin("\n".join(content))
    box = f"[0 0 {_decimal(drawing.width * _POINT)} {_decimal(drawing.height * _POINT)}]"
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(stream), stream),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
        b"<< /Title (%s) >>" % _latin(_literal(drawing.title)),
    ]
    data = b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n"
    offsets = []
    for number, body in enumerate(objects, 1):
        offsets.append(len(data))
        data += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    table = b"".join(b"%010d 00000 n \n" % offset for offset in offsets)
    count = len(objects) + 1
    return data + (
        b"xref\n0 %d\n0000000000 65535 f \n%strailer\n<< /Size %d /Root 1 0 R /Info 6 0 R >>\nstartxref\n%d\n%%%%EOF\n"
        % (count, table, count, len(data))
    )


def _pdf_circle(x: float, y: float, diameter: float) -> str:
    """Four cubic curves, which differ from the circle by 0.03 % of its radius."""
    r, k = diameter / 2, _BEZIER * diameter / 2
    ends = [(r, 0.0), (0.0, r), (-r, 0.0), (0.0, -r), (r, 0.0)]
    parts = [f"{_decimal(x + r)} {_decimal(y)} m"]
    for (a, b), (c, d) in itertools.pairwise(ends):
        # Along the tangent of each end: a point (a, b) of the circle has the tangent (-b, a).
        first, second = (a - b * k / r, b + a * k / r), (c + d * k / r, d - c * k / r)
        parts.append(" ".join(f"{_decimal(x + u)} {_decimal(y + v)}" for u, v in (first, second, (c, d))) + " c")
    return " ".join(parts)


def _decimal(value: float) -> str:
    """A number to 0.1 micrometer, without a needless fraction."""
    return f"{value:.4f}".rstrip("0").rstrip(".")


def _literal(text: str) -> str:
    return text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")


def _latin(text: str) -> bytes:
    try:
        return text.encode("latin-1")
    except UnicodeEncodeError as error:
        raise InputError(f"{text!r}: a PDF text can contain Latin-1 characters only") from error


# The black shapes of a board's pattern, in millimeters.

CIRCLE_SHARE = 0.5  # of the least distance of two centers: the diameter of circles that are printed without one
TAG_BORDER = 2  # cells: Kalibr draws tags with a border of two cells, other makers of tags one


class PatternShapes(NamedTuple):
    """A pattern from its left upper end on.

    Args:
        width, height: millimeters.
        margin: white that detectors need around it, millimeters.
        origin: where the origin of `Board.points` lies, millimeters.
        rectangles, circles: what is black.
    """

    width: float
    height: float
    margin: float
    origin: tuple[float, float]
    rectangles: tuple[Rectangle, ...] = ()
    circles: tuple[Circle, ...] = ()


def pattern_shapes(board: Board) -> PatternShapes:
    """The pattern of a board, as it is printed.

    Example:
        >>> shapes = pattern_shapes(Board.parse("circles:7x6:10mm", "20mm"))
        >>> shapes.width, shapes.origin, len(shapes.circles)
        (130.0, (5.0, 5.0), 42)
    """
    if board.pattern == "aprilgrid":
        return _april_shapes(board)
    return _square_shapes(board) if board.pattern == "checkerboard" else _circle_shapes(board)


def _square_shapes(board: Board) -> PatternShapes:
    square = board.square * 1000
    shapes = [
        Rectangle(x=column * square, y=row * square, width=square, height=square)
        for row in range(board.rows + 1)
        for column in range(board.columns + 1)
        if (row + column) % 2 == 0
    ]
    if board.marker is not None:
        side = board.marker * 1000
        inset = (square - side) / 2
        light = [(r, c) for r in range(board.rows + 1) for c in range(board.columns + 1) if (r + c) % 2 == 1]
        for (row, column), cells in zip(light, marker_cells(board), strict=True):
            shapes += _marker_shapes(column * square + inset, row * square + inset, side, cells)
    width, height = (board.columns + 1) * square, (board.rows + 1) * square
    return PatternShapes(width, height, square, (square, square), tuple(shapes))


def _circle_shapes(board: Board) -> PatternShapes:
    diameter = 1000 * (board.diameter or CIRCLE_SHARE * board.spacing)
    width, height = (1000 * side + diameter for side in board.extent)
    places = (1000 * board.points[:, :2] + diameter / 2).tolist()
    circles = tuple(Circle(x=x, y=y, diameter=diameter) for x, y in places)
    margin = max(1000 * board.spacing - diameter / 2, diameter / 2)
    return PatternShapes(width, height, margin, (diameter / 2, diameter / 2), circles=circles)


def _april_shapes(board: Board) -> PatternShapes:
    """Tags, and squares as wide as the gap that touch their corners, so that four quadrants meet there."""
    assert board.gap is not None
    side, gap = 1000 * board.square, 1000 * board.gap
    across, down = board.columns // 2, board.rows // 2
    width, height = across * (side + gap) + gap, down * (side + gap) + gap
    pitch = side + gap
    shapes = [
        Rectangle(x=column * pitch, y=row * pitch, width=gap, height=gap)
        for row in range(down + 1)
        for column in range(across + 1)
    ]
    for number in range(board.markers):
        row, column = divmod(number, across)  # rows of tags count upward
        cells = tag_cells(board.first + number)
        shapes += _marker_shapes(gap + column * pitch, gap + (down - 1 - row) * pitch, side, cells)
    return PatternShapes(width, height, gap, (gap, height - gap), tuple(shapes))


def tag_cells(number: int) -> npt.NDArray[np.bool_]:
    """Which cells of a tag of family 36h11 are black, (10, 10) with Kalibr's border of two cells.

    OpenCV's dictionary has the tags turned by half a turn against those of the AprilTag library and of Kalibr.
    """
    count = int(math.sqrt(36)) + 2 * TAG_BORDER
    dictionary = opencv_dictionary(TAGS)
    upright = cv2.rotate(dictionary.generateImageMarker(number, count, borderBits=TAG_BORDER), cv2.ROTATE_180)
    return np.asarray(upright == 0)


def _marker_shapes(x: float, y: float, side: float, cells: npt.NDArray[np.bool_]) -> list[Rectangle]:
    """The black cells of a marker, each run along a row as one rectangle."""
    cell = side / len(cells)
    shapes = []
    for i, line in enumerate(cells.tolist()):
        begin = 0
        for black, run in itertools.groupby(line):
            length = len(list(run))
            if black:
                shapes.append(Rectangle(x=x + begin * cell, y=y + i * cell, width=length * cell, height=cell))
            begin += length
    return shapes


# Lay out boards on pages, to print at true scale.

# Millimeters, upright; ISO 216 and the North American sizes.
PAGES: dict[str, tuple[float, float]] = {
    "A5": (148.0, 210.0),
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
    "legal": (215.9, 355.6),
    "tabloid": (279.4, 431.8),
}
EDGE = 5.0  # mm at each edge that printers leave white
RULER = 100.0  # mm
_STROKE = 0.2  # mm
_CAPTION_GAP = 4.0  # mm between ruler and caption
_LINE_SPACING = 3.6  # mm from one line of text to the next
_TEXT_HEIGHT = 2.5  # mm, height of the caption's letters
_LETTER_WIDTH = 0.6  # mean width of a letter in text heights


class Sheet(NamedTuple):
    """A board on a page.

    Args:
        drawing: the page.
        page: its name.
        quiet: the narrowest white margin around the board as a share of what detectors need, which is one square of a
            checkerboard.
        margin: what they need, millimeters.
        origin: where the origin of `Board.points` lies, millimeters from the page's left upper corner.
    """

    drawing: Drawing
    page: str
    quiet: float
    margin: float
    origin: tuple[float, float]


def board_sheet(board: Board, page: str = "auto") -> Sheet:
    """Lay a board out on a page, in the board's order: corner 0 at the top left, its outer square black.

    Below the board are a ruler of 100 mm, to measure after printing, and a caption with the board's size. The page is
    upright or across, whichever leaves a wider margin. Detectors work best with a margin of one square.

    Args:
        board: the board.
        page: a name in `PAGES`, in upper or lower case, or `auto` for the smallest page with a margin of one square.

    Raises:
        InputError: an unknown page, or one that is too small; the message names the smallest that is large enough.

    Example:
        >>> sheet = board_sheet(Board(columns=9, rows=6, square=0.025), "A4")
        >>> sheet.drawing.width, sheet.drawing.height, len(sheet.drawing.rectangles) > 35
        (297.0, 210.0, True)
    """
    pattern = pattern_shapes(board)
    name, (page_wide, page_high) = _page(board, pattern, page)
    left, top = _margins(board, pattern, page_wide, page_high)
    ruler, texts = _foot(board, page_wide, page_high)
    drawing = Drawing(
        width=page_wide,
        height=page_high,
        title=f"Board {board}",
        rectangles=tuple(r._replace(x=left + r.x, y=top + r.y) for r in pattern.rectangles) + ruler,
        circles=tuple(c._replace(x=left + c.x, y=top + c.y) for c in pattern.circles),
        texts=texts,
    )
    origin = (left + pattern.origin[0], top + pattern.origin[1])
    return Sheet(drawing, name, min(left, top) / pattern.margin, pattern.margin, origin)


def _page(board: Board, pattern: PatternShapes, page: str) -> tuple[str, tuple[float, float]]:
    wide, high = pattern.width, pattern.height
    if page.lower() == "auto":
        margin = max(pattern.margin, EDGE)
        page_wide = max(wide + 2 * margin, RULER + 2 * EDGE)
        return "auto", (page_wide, high + 2 * margin + _foot_height(board, page_wide))
    names = {name.lower(): name for name in PAGES}
    if page.lower() not in names:
        raise InputError(f"page {page!r}: choose one of auto, {', '.join(PAGES)}")
    name = names[page.lower()]
    size = _better_way(board, pattern, PAGES[name])
    if size is None:
        fitting = [other for other, paper in PAGES.items() if _better_way(board, pattern, paper) is not None]
        smallest = min(fitting, key=lambda other: PAGES[other][0] * PAGES[other][1], default=None)
        advice = f"{smallest} would do" if smallest else "use auto or smaller squares"
        width, height = PAGES[name]
        raise InputError(
            f"a board of {_size_text(board)} is {wide:g}x{high:g} mm and "
            f"does not fit {name} ({width:g}x{height:g} mm) with its margins and ruler; {advice}"
        )
    return name, size


def _margins(board: Board, pattern: PatternShapes, page_wide: float, page_high: float) -> tuple[float, float]:
    """White left and right of the board, and above it as well as between it and the foot."""
    left = (page_wide - pattern.width) / 2
    return left, (page_high - _foot_height(board, page_wide) - pattern.height) / 2


def _better_way(board: Board, pattern: PatternShapes, paper: tuple[float, float]) -> tuple[float, float] | None:
    """The page upright or across, whichever leaves more white, or None where the board fits neither way."""
    ways = [
        (min(_margins(board, pattern, *size)), size) for size in (paper, paper[::-1]) if size[0] >= RULER + 2 * EDGE
    ]
    best, size = max(ways)
    return size if best >= EDGE else None


def _size_text(board: Board) -> str:
    if board.pattern == "checkerboard":
        return f"{board.columns + 1}x{board.rows + 1} squares of {board.square * 1000:g} mm"
    return str(board.record)


def _captions(board: Board) -> tuple[str, str]:
    turned = "" if board.unambiguous else " Looks the same turned by 180 degrees: not for stereo."
    length = f"{board.square * 1000:g} mm"
    counts = f"{board.columns}x{board.rows}"
    first = f":id{board.first}" if board.first else ""
    if board.gap is not None:
        size = f"aprilgrid:{board.columns // 2}x{board.rows // 2}:{board.gap * 1000:g}mm{first}, {length} tags."
    elif board.pattern != "checkerboard":
        diameter = 1000 * (board.diameter or CIRCLE_SHARE * board.spacing)
        what = "rows " if board.pattern == "asymmetric" else ""
        size = f"{board.pattern}:{counts}:{diameter:.4g}mm, {what}{length} apart."
    elif board.marker is not None:
        size = f"charuco:{counts}:{board.dictionary}:{board.marker * 1000:g}mm{first}, {length} squares."
    else:
        size = f"{counts} (inner corners), {length} squares."
    return "Print at 100 %; the ruler is 100 mm long.", f"kcal board {size}{turned}"


def _caption_beside_ruler(board: Board, page_wide: float) -> bool:
    """Whether the caption fits to the right of the ruler."""
    longest = max(len(text) for text in _captions(board)) * _TEXT_HEIGHT * _LETTER_WIDTH
    return 2 * EDGE + RULER + _CAPTION_GAP + longest <= page_wide


def _foot_height(board: Board, page_wide: float) -> float:
    return EDGE + (2 if _caption_beside_ruler(board, page_wide) else 4) * _LINE_SPACING


def _foot(board: Board, page_wide: float, page_high: float) -> tuple[tuple[Rectangle, ...], tuple[Text, ...]]:
    """The ruler with its ticks, and to its right, or above it on a narrow page, the caption."""
    base = page_high - EDGE
    ticks = [
        Rectangle(x=EDGE + along - _STROKE / 2, y=base - height, width=_STROKE, height=height)
        for along in range(0, int(RULER) + 1, 10)
        for height in (3.0 if along % 50 == 0 else 1.8,)
    ]
    line = Rectangle(x=EDGE, y=base - _STROKE, width=RULER, height=_STROKE)
    x, lowest = (EDGE + RULER + _CAPTION_GAP, 0) if _caption_beside_ruler(board, page_wide) else (EDGE, 1)
    texts = tuple(
        Text(x=x, y=base - (lowest + row) * _LINE_SPACING - (0.6 if lowest else 0), size=_TEXT_HEIGHT, text=text)
        for row, text in zip((1, 0), _captions(board), strict=True)
    )
    return (line, *ticks), texts


def save_board(path: str | Path, board: Board, page: str = "auto") -> Path:
    """Write a board to print, as a .svg or .pdf file.

    For the page see `board_sheet`.

    Raises:
        InputError: another suffix, or a page as for `board_sheet`.
        FileError: the file cannot be written.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_board(Path(folder, "board.pdf"), Board(columns=9, rows=6, square=0.025), "A4").read_bytes()[:4]
        b'%PDF'
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (".svg", ".pdf"):
        raise InputError(f"{path}: give a file name that ends in .svg or .pdf")
    drawing = board_sheet(board, page).drawing
    return write_atomic(path, to_svg(drawing) if suffix == ".svg" else to_pdf(drawing))
