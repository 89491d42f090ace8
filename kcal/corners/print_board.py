"""Lay out boards on pages, to print at true scale."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import NamedTuple

from kcal.corners.board import Board
from kcal.corners.drawing import Drawing, Rectangle, Text, to_pdf, to_svg
from kcal.corners.pattern_shapes import CIRCLE_SHARE, PatternShapes, pattern_shapes
from kcal.errors import InputError
from kcal.files import write_atomic

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
        rectangles=tuple(dataclasses.replace(r, x=left + r.x, y=top + r.y) for r in pattern.rectangles) + ruler,
        circles=tuple(dataclasses.replace(c, x=left + c.x, y=top + c.y) for c in pattern.circles),
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
