"""Write black shapes and short texts as SVG or PDF at true scale.

The files contain no dates or tool names, so that the same board always gives the same bytes.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from xml.sax.saxutils import escape

from kcal.errors import InputError

_POINT = 72 / 25.4  # PDF points in a millimeter
_BEZIER = 0.5522847498  # 4 (√2 - 1) / 3: a cubic with this handle is closest to a quarter of a unit circle
_FONTS = "Helvetica, Arial, sans-serif"


@dataclass(frozen=True, kw_only=True)
class Rectangle:
    """A filled black rectangle; millimeters from the page's top left corner."""

    x: float
    y: float
    width: float
    height: float


@dataclass(frozen=True, kw_only=True)
class Circle:
    """A filled black circle; its center in millimeters from the page's top left corner."""

    x: float
    y: float
    diameter: float


@dataclass(frozen=True, kw_only=True)
class Text:
    """A line of text whose baseline begins at (x, y) millimeters from the top left corner."""

    x: float
    y: float
    size: float
    text: str


@dataclass(frozen=True, kw_only=True)
class Drawing:
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
