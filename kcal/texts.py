"""Texts of quantities and lists, for people."""

from __future__ import annotations

import base64
import dataclasses
import datetime
import hashlib
import html
import json
import math
import re
import textwrap
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, TypeVar

# The one way by which a text reaches a page, a table, an XML file or a terminal, where some characters would act.
#
# Names of points, cameras and files come from other people's files. Each function takes any text and returns one that
# is shown there, and does nothing else. Pictures have their own way: `kcal.report.figures.new_figure` draws no text as
# mathematics.

# Control characters but tab and line feed (an escape sequence begins with U+001B or U+009B), separators of lines,
# overrides of the direction of text, halves of surrogate pairs, and the noncharacters of Unicode. What XML 1.0 forbids
# is among them.
_ACTING = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufdd0-\ufdef"
    + "".join(f"{chr(plane + 0xFFFE)}{chr(plane + 0xFFFF)}" for plane in range(0, 0x110000, 0x10000))
    + "]"
)
_T = TypeVar("_T")
_NUMBER = re.compile(r"[+-]?[0-9]+(\.[0-9]+)?")
# Spreadsheets read a cell that begins with one of these as a formula; in Japanese settings, the wide ones too.
_FORMULA = tuple("=+-@＝＋－＠")


def visible(text: str) -> str:
    r"""Write characters that act instead of being shown as escapes; tabs and line feeds stay.

    This is enough for a terminal and for XML: escape sequences, and characters that XML 1.0 forbids, are gone.

    Example:
        >>> visible("gate\x1b[2J \ufffe 5°")
        'gate\\x1b[2J \\ufffe 5°'
    """
    return _ACTING.sub(lambda found: ascii(found.group())[1:-1], text)


def one_line(text: str) -> str:
    r"""The same, with tabs and line feeds as escapes too.

    Example:
        >>> one_line("gate\n2")
        'gate\\n2'
    """
    return visible(text).replace("\t", r"\t").replace("\n", r"\n")


def unix_seconds(text: str) -> float:
    """Seconds of a number, or since 1970 of an ISO time with its zone; NaN or infinity where a text is neither.

    A time that names no zone is none: whose hour it is would be a guess.

    Example:
        >>> unix_seconds("12.5"), unix_seconds("1970-01-01T00:01:00Z"), unix_seconds("1970-01-01T00:01:00")
        (12.5, 60.0, nan)
    """
    try:
        # Python also reads "1_000", which is more likely a slip than a number.
        return math.nan if "_" in text else float(text)
    except ValueError:
        pass
    try:
        moment = datetime.datetime.fromisoformat(text.strip())
    except ValueError:
        return math.nan
    return math.nan if moment.tzinfo is None else moment.timestamp()


def csv_line(cells: Iterable[Any]) -> str:
    r"""One line of a comma-separated table, with its line feed; None is empty, floats keep every digit.

    A text that a spreadsheet would take for a formula gets an apostrophe in front. Texts with commas, semicolons
    (separators in some countries), quotation marks or line breaks are quoted.

    Example:
        >>> print(csv_line(["=1+1", -1.5, None, "gate; north"]), end="")
        '=1+1,-1.5,,"gate; north"
    """
    return ",".join(_cell(value) for value in cells) + "\n"


def _cell(value: Any) -> str:
    if not isinstance(value, str):
        return "" if value is None else repr(value) if isinstance(value, float) else str(value)
    text = visible(value)
    if text.lstrip().startswith(_FORMULA) and not _NUMBER.fullmatch(text):
        text = f"'{text}"
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',;"\t\n') else text


def page_text(text: str) -> str:
    """A text in HTML, between tags or in an attribute with quotation marks.

    Example:
        >>> page_text("<b> & co")
        '&lt;b&gt; &amp; co'
    """
    return html.escape(visible(text))


def page_data(value: Any) -> str:
    r"""JSON inside a `<script type="application/json">`: no text in it can end the element or open a comment.

    Example:
        >>> page_data({"name": "<!--<script>"})
        '{"name": "\\u003c!--\\u003cscript\\u003e"}'
    """
    text = json.dumps(value, allow_nan=False)
    return text.replace("<", r"\u003c").replace(">", r"\u003e").replace("&", r"\u0026")


def page_policy(*, scripts: Iterable[str] = (), styles: Iterable[str] = (), images: str = "data:") -> str:
    """A Content-Security-Policy that allows these texts of `script` and `style` elements and these sources of images.

    Nothing else runs or is loaded: no handler in an attribute, no other script, no request.

    Example:
        >>> page_policy(styles=["b { color: red; }"])[:47]
        "default-src 'none'; base-uri 'none'; form-actio"
    """

    def hashes(texts: Iterable[str]) -> str:
        digests = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in texts]
        return " ".join(f"'sha256-{digest}'" for digest in digests) or "'none'"

    return (
        "default-src 'none'; base-uri 'none'; form-action 'none'; "
        f"script-src {hashes(scripts)}; style-src {hashes(styles)}; img-src {images}"
    )


def brief(record: Any, **said: str) -> str:
    """The `repr` of a record in three lines at most: numbers and words first, then shapes of tensors and counts.

    Args:
        record: a dataclass, a named tuple, a pydantic model or a module of torch. Fields that are None, empty or as by
            default are left out.
        said: words in place of fields.

    Example:
        >>> import numpy as np
        >>> from kcal.corners.detect import Detection
        >>> brief(Detection(np.zeros((54, 2)), reason="blurred"))
        "Detection(reason='blurred', pixels=(54, 2))"
    """
    kind = type(record)
    if hasattr(record, "named_children"):
        if any(part.is_meta for part in (*record.parameters(), *record.buffers())):
            return f"{kind.__name__}(on the meta device)"
        children = (f"{name}={_brief_module(child)}" for name, child in record.named_children())
        return _in_lines(kind, [one for one in (record.extra_repr(), *children) if one])
    if dataclasses.is_dataclass(record):
        defaults = {field.name: field.default for field in dataclasses.fields(record) if field.repr}
    else:
        fields = getattr(kind, "model_fields", None) or dict.fromkeys(record._fields)
        defaults = {name: getattr(field, "default", None) for name, field in fields.items()}
    plain: list[str] = []
    rest: list[str] = []
    for name, default in defaults.items():
        value = getattr(record, name)
        is_plain = isinstance(value, str | int | float)
        text = said.get(name) or f"{name}={_brief_value(value)}"
        usual = value is None or value is default or (is_plain and value == default)
        if not (usual or name.startswith("_") or text.endswith("=")):
            (plain if is_plain or name in said else rest).append(text)
    return _in_lines(kind, [*plain, *rest])


def briefly(kind: type[_T]) -> type[_T]:
    """Give a class, of which mypy takes no `__repr__ = brief`, that `repr`: a named tuple."""
    kind.__repr__ = brief  # type: ignore[method-assign]
    return kind


def _in_lines(kind: type, parts: list[str]) -> str:
    text = f"{kind.__name__}({', '.join(parts)})"
    return "\n".join(textwrap.wrap(text, 99, subsequent_indent="  ", max_lines=3, placeholder=" ...)"))


def _brief_module(module: Any) -> str:
    """One of kcal by its own words, several that are alike once, another by its class."""
    if type(module).__repr__ is brief:
        return " ".join(repr(module).split())
    inside = [_brief_module(child) for child in module._modules.values()]
    kinds = {type(child).__name__ for child in module._modules.values()}
    alike = set(inside) if len(set(inside)) == 1 else kinds
    return f"{len(inside)} x {alike.pop()}" if len(alike) == 1 else type(module).__name__


def _brief_value(value: Any) -> str:
    if (shape := getattr(value, "shape", None)) is not None:
        return _brief_value(value.tolist()) if shape in ((), (2,), (3,), (4,)) else f"{tuple(shape)}"
    if isinstance(value, float) or hasattr(value, "name"):
        return f"{value:.6g}" if isinstance(value, float) else str(value.name)
    if isinstance(value, list | tuple) and not hasattr(value, "_fields"):
        if len(value) <= 4 and all(isinstance(one, str | int | float | None) for one in value):
            return f"({', '.join(map(_brief_value, value))})" if value else ""
        return f"{len(value)} {type(value[0]).__name__}"
    if isinstance(value, Mapping):
        return f"{len(value)} entries" if value else ""
    text = repr(value)
    return text if len(text) <= 100 else f"{type(value).__name__}(...)"


# The one way in which numbers become texts: two digits of their standard deviation, in a unit that fits the range.
#
# Reports, pictures, tables and maps use these functions. Files for programs keep every digit, in meters.

# With more decimals, and below this power of ten, a number is written with an exponent.
_MOST_DECIMALS, _LEAST_POWER = 5, -4


class Unit(NamedTuple):
    """A unit of length.

    Attributes:
        name: as it is written.
        meters: its length.
    """

    name: str
    meters: float

    def number(self, meters: float, sigma: float | None = None, *, digits: int = 3, sign: bool = False) -> str:
        """A length in this unit, without its name; arguments as in `number_text`."""
        return number_text(
            meters / self.meters, None if sigma is None else sigma / self.meters, digits=digits, sign=sign
        )


MM, M, KM = Unit("mm", 1e-3), Unit("m", 1.0), Unit("km", 1e3)


def length_unit(lengths: Iterable[float | None]) -> Unit:
    """The unit for lengths that stand together: mm on a bench, m on a site, km at sea.

    Args:
        lengths: meters; the largest that is finite decides; m if it is 0.

    Example:
        >>> length_unit([0.28, 0.43]).name, length_unit([0.0, math.inf]).name, length_unit([800.0, 21e3]).name
        ('mm', 'm', 'km')
    """
    largest = max((abs(one) for one in lengths if one is not None and math.isfinite(one)), default=1.0)
    return MM if 0.0 < largest < 1.0 else M if largest < 1e4 else KM


def number_text(value: float, sigma: float | None = None, *, digits: int = 3, sign: bool = False) -> str:
    """A number, rounded to two digits of its standard deviation.

    Args:
        value: the number.
        sigma: its standard deviation; where that is not known or 0, the number has `digits` digits.
        digits: see there.
        sign: write a plus too.

    Example:
        >>> number_text(83.21683, 0.0217), number_text(1983.4, 586.0), number_text(0.0217, 0.0217), number_text(2 / 3)
        ('83.217', '1980', '0.022', '0.667')
        >>> number_text(-2.1e-8, 3.4e-7), number_text(float("inf"))
        ('-2e-08', '∞')
    """
    if not math.isfinite(value):
        return "–" if math.isnan(value) else "∞" if value > 0 else "-∞"
    known = sigma is not None and 0.0 < sigma < math.inf
    if not known and value == 0.0:
        return "0"
    places = _decimals(sigma, 2) if known and sigma is not None else _decimals(value, digits)
    plus = "+" if sign else ""
    first = math.floor(math.log10(abs(value))) if value else 0
    if places > _MOST_DECIMALS and first < _LEAST_POWER:
        return f"{value:{plus}.{max(first + places, 0)}e}"
    return f"{round(value, places):{plus}z.{max(places, 0)}f}"


def _decimals(value: float, digits: int) -> int:
    """Decimals that show so many digits of a number; negative where these end before the point."""
    first = math.floor(math.log10(abs(value)))
    places = digits - 1 - first
    # 0.0996 is 0.10, not 0.100.
    return places - 1 if round(abs(value), places) >= 10.0 ** (first + 1) else places


def measured_text(value: float, sigma: float | None, unit: str = "", *, sign: bool = False) -> str:
    """A number with its standard deviation, and a unit.

    Example:
        >>> measured_text(533.6391, 0.6764, "px"), measured_text(1.1, None, "mm"), measured_text(10.0, 0.0)
        ('533.64 ± 0.68 px', '1.10 mm', '10.0 ± 0')
    """
    known = sigma is not None and math.isfinite(sigma)
    spread = f" ± {number_text(sigma, sigma)}" if known and sigma is not None else ""
    return f"{number_text(value, sigma, sign=sign)}{spread} {unit}".rstrip()


def length_text(
    meters: float, sigma: float | None = None, *, unit: Unit | None = None, digits: int = 3, sign: bool = False
) -> str:
    """A length, rounded to two digits of its standard deviation, with its unit.

    Args:
        meters: the length.
        sigma: its standard deviation, meters.
        unit: the one that fits the length, if not given.
        digits: of a length without a standard deviation.
        sign: write a plus too.

    Example:
        >>> length_text(0.4012, 0.0004), length_text(812.37, 4.1), length_text(0.0217, digits=2), length_text(21000.0)
        ('401.20 mm', '812.4 m', '22 mm', '21.0 km')
    """
    unit = unit or length_unit([meters])
    number = unit.number(meters, sigma, digits=digits, sign=sign)
    return number if number in ("0", "∞", "-∞", "–") else f"{number} {unit.name}"


def measured_length(meters: float, sigma: float | None) -> str:
    """A length with its standard deviation and its unit.

    Example:
        >>> measured_length(0.083217, 2.2e-5), measured_length(10.02131, 0.0012)
        ('83.217 ± 0.022 mm', '10.0213 ± 0.0012 m')
    """
    unit = length_unit([meters])
    return measured_text(meters / unit.meters, None if sigma is None else sigma / unit.meters, unit.name)


def counted_text(count: int, what: str) -> str:
    """So many of something.

    Example:
        >>> counted_text(1, "view"), counted_text(12, "view")
        ('1 view', '12 views')
    """
    return f"{count:,} {what}{'' if count == 1 else 's'}"


def percent_text(share: float) -> str:
    """A share in percent, without a sign; what is not zero is not written as zero.

    Example:
        >>> percent_text(0.274), percent_text(0.0004), percent_text(0.0), percent_text(0.9996)
        ('27 %', 'less than 1 %', '0 %', 'more than 99 %')
    """
    if 0.0 < share < 0.01 or 0.99 < share < 1.0:
        return "less than 1 %" if share < 0.5 else "more than 99 %"
    return f"{100.0 * share:.0f} %"


def range_text(meters: float) -> str:
    """A length that is exact, such as a requirement or a ring of a map, with its unit: 250 m, 5 km.

    Example:
        >>> range_text(0.25), range_text(250.0), range_text(5000.0)
        ('250 mm', '250 m', '5 km')
    """
    unit = MM if meters < 1.0 else M if meters < 1e3 else KM
    return f"{meters / unit.meters:g} {unit.name}"


def setting_text(values: Mapping[str, float]) -> str:
    """Where zoom and focus stand: names with their numbers, as precise as anyone states them.

    Example:
        >>> setting_text({"zoom": 12.5, "focus": 100000.5})
        'zoom=12.5 focus=100000.5'
    """
    return " ".join(f"{name}={value:.12g}" for name, value in values.items())
