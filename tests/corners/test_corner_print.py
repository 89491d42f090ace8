import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kcal.corners.board import Board
from kcal.corners.detect import detect_board
from kcal.corners.print_board import EDGE, PAGES, Drawing, Rectangle, Text, board_sheet, to_pdf, to_svg
from kcal.errors import InputError

A4 = Board(columns=9, rows=6, square=0.025)


def raster(drawing, per_mm=4):
    """The drawing's rectangles as an image."""
    image = np.full((round(drawing.height * per_mm), round(drawing.width * per_mm)), 255, np.uint8)
    for r in drawing.rectangles:
        rows = slice(round(r.y * per_mm), round((r.y + r.height) * per_mm))
        image[rows, round(r.x * per_mm) : round((r.x + r.width) * per_mm)] = 0
    return image


def svg_rectangles(text):
    found = re.findall(r"M([-\d.]+) ([-\d.]+)h([-\d.]+)v([-\d.]+)h-[\d.]+z", text)
    return np.array(found, dtype=float)


def pdf_rectangles(data, height):
    """Rectangles in millimeters from the top left, read back from the page's content."""
    found = np.array(re.findall(rb"([-\d.]+) ([-\d.]+) ([-\d.]+) ([-\d.]+) re", data), dtype=float) * 25.4 / 72
    found[:, 1] = height - found[:, 1] - found[:, 3]
    return found


def test_a4_board_has_its_true_size_in_both_formats():
    drawing = board_sheet(A4, "A4").drawing
    svg, pdf = to_svg(drawing), to_pdf(drawing)
    assert 'width="297mm" height="210mm" viewBox="0 0 297 210"' in svg
    assert b"/MediaBox [0 0 841.8898 595.2756]" in pdf
    one, two = svg_rectangles(svg), pdf_rectangles(pdf, 210)
    np.testing.assert_allclose(one, two, rtol=0, atol=1e-4)  # four decimals are written
    squares = one[one[:, 2] == 25]
    assert len(squares) == 35
    assert (squares[:, 3] == 25).all()
    assert squares[:, 0].max() + 25 - squares[:, 0].min() == pytest.approx(250, abs=1e-9)
    assert squares[:, 1].max() + 25 - squares[:, 1].min() == pytest.approx(175, abs=1e-9)
    ruler = one[one[:, 2] == 100]
    assert len(ruler) == 1


def test_what_is_printed_is_what_is_detected():
    drawing = board_sheet(A4).drawing
    found = detect_board(raster(drawing), A4)
    corner = drawing.rectangles[0]
    # Corner 0 is the inner corner of the black square at the top left; a pixel's center lies half a pixel in.
    expected = np.array([corner.x + 25, corner.y + 25]) * 4 - 0.5
    np.testing.assert_allclose(found.pixels[0].numpy(), expected, rtol=0, atol=1e-3)
    np.testing.assert_allclose(found.pixels[9].numpy(), expected + np.array([0, 100]), rtol=0, atol=1e-3)


@settings(max_examples=60, deadline=None)
@given(
    st.integers(2, 14), st.integers(2, 14), st.floats(0.004, 0.06), st.sampled_from(["auto", *PAGES, "LETTER", "a3"])
)
def test_everything_lies_on_the_page(columns, rows, square, page):
    board = Board(columns=columns, rows=rows, square=square)
    try:
        sheet = board_sheet(board, page)
    except InputError as error:
        better = re.search(r"does not fit .*; (\w+) would do", str(error))
        if better:
            assert board_sheet(board, better.group(1)).page == better.group(1)
        return
    drawing = sheet.drawing
    squares = drawing.rectangles[: ((columns + 1) * (rows + 1) + 1) // 2]
    others = drawing.rectangles[len(squares) :]
    slack = 1e-9
    for r in drawing.rectangles:
        assert min(r.x, r.y) >= EDGE - 0.1 - slack
        assert r.x + r.width <= drawing.width - EDGE + 0.1 + slack
        assert r.y + r.height <= drawing.height - EDGE + slack
    foot = min(r.y for r in others)
    bottom = max(r.y + r.height for r in squares)
    letters = min(text.y - text.size for text in drawing.texts)
    assert min(foot, letters) - bottom >= sheet.quiet * square * 1000 - 0.5  # the caption stays out of the white
    for text in drawing.texts:
        assert text.x + len(text.text) * 0.6 * text.size <= drawing.width or drawing.width < 160
    if page == "auto":
        assert sheet.quiet >= 1 - slack


def test_pages_are_those_of_the_standards():
    """ISO 216: A0 is a square meter with sides as 1 to the root of 2, and each next page half of it, cut to mm."""
    width, height = 841.0, 1189.0
    assert width * height == pytest.approx(1e6, rel=1e-4)
    assert height / width == pytest.approx(2**0.5, rel=1e-3)
    for name in ("A0", "A1", "A2", "A3", "A4", "A5"):
        assert PAGES[name] == (width, height), name
        width, height = height // 2, width
    inches = {"letter": (8.5, 11.0), "legal": (8.5, 14.0), "tabloid": (11.0, 17.0)}
    for name, (across, up) in inches.items():
        assert PAGES[name] == pytest.approx((25.4 * across, 25.4 * up), rel=1e-12), name


def test_page_choice():
    assert board_sheet(A4, "a4").page == "A4"
    tall = board_sheet(Board(columns=6, rows=9, square=0.02), "A4").drawing
    assert (tall.width, tall.height) == (210, 297)
    with pytest.raises(InputError, match=r"400x280 mm and does not fit A4 .*; A2 would do"):
        board_sheet(Board(columns=9, rows=6, square=0.04), "A4")
    with pytest.raises(InputError, match="use auto or smaller squares"):
        board_sheet(Board(columns=9, rows=6, square=0.4), "A4")
    with pytest.raises(InputError, match="choose one of auto, A5"):
        board_sheet(A4, "B5")


def test_ambiguous_board_says_so():
    texts = " ".join(text.text for text in board_sheet(Board(columns=8, rows=6, square=0.02)).drawing.texts)
    assert "not for stereo" in texts
    assert "not for stereo" not in " ".join(text.text for text in board_sheet(A4).drawing.texts)


def test_pdf_table_of_objects_is_right():
    data = to_pdf(board_sheet(A4, "A4").drawing)
    start = int(data.rsplit(b"startxref\n", 1)[1].split()[0])
    assert data[start:].startswith(b"xref\n0 7\n")
    for number, offset in enumerate(re.findall(rb"(\d{10}) 00000 n ", data), 1):
        assert data[int(offset) :].startswith(b"%d 0 obj\n" % number)
    length = int(re.search(rb"/Length (\d+)", data).group(1))
    content = data.split(b"stream\n", 1)[1]
    assert content[length:].startswith(b"\nendstream")


def test_texts_are_escaped():
    drawing = Drawing(
        width=50,
        height=20,
        title="<a> (b)",
        rectangles=(Rectangle(x=1, y=1, width=1, height=1),),
        texts=(Text(x=1, y=5, size=2, text="5 < 6 & (7)"),),
    )
    assert "5 &lt; 6 &amp; (7)</text>" in to_svg(drawing)
    assert rb"(5 < 6 & \(7\)) Tj" in to_pdf(drawing)
    with pytest.raises(InputError, match="Latin-1"):
        to_pdf(Drawing(width=5, height=5, title="Ω", rectangles=()))
