"""Read what a board is from short texts, such as `charuco:9x6:5x5_100:15mm` and `25mm`."""

from __future__ import annotations

import re
from typing import Any

from kcal.errors import InputError

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
_UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
MOST = 500  # points in a row or a column
_FORMS = {
    "": "COLUMNSxROWS",
    "charuco": "charuco:COLUMNSxROWS[:DICTIONARY][:MARKER][:idFIRST]",
    "circles": "circles:COLUMNSxROWS[:DIAMETER]",
    "asymmetric": "asymmetric:COLUMNSxROWS[:DIAMETER]",
    "aprilgrid": "aprilgrid:TAGSxTAGS[:SPACING][:idFIRST]",
}


def board_fields(text: str, square: str) -> dict[str, Any]:
    """The fields of `kcal.corners.board.Board` that two texts describe; see `Board.parse`.

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
    side = parse_length("square", square)
    fields: dict[str, Any] = {"columns": each * columns, "rows": each * rows, "square": side}
    if kind == "":
        if more:
            raise InputError(form)
    elif kind == "charuco":
        fields |= _charuco_fields(more, side, form)
    elif kind == "aprilgrid":
        fields |= {"pattern": "aprilgrid"} | _april_fields(more, side, form)
    else:
        if len(more) > 1:
            raise InputError(form)
        fields |= {"pattern": kind} | ({"diameter": parse_length("diameter", more[0])} if more else {})
    return fields


def _charuco_fields(parts: list[str], side: float, form: str) -> dict[str, Any]:
    fields: dict[str, Any] = {}
    for part in parts:
        name = part.strip().lower().removeprefix("dict_")
        if (first := _first_id(part)) is not None:
            new: dict[str, Any] = {"first": first}
        elif name in DICTIONARIES or (not fields and not re.match(r"[\d.]+\s*[a-z]+$", name)):
            new = {"dictionary": name}
        elif "marker" in fields:
            raise InputError(form)
        else:
            new = {"marker": parse_length("marker", part)}
        if new.keys() & fields.keys():
            raise InputError(form)
        fields |= new
    return {"dictionary": _DEFAULT_DICTIONARY, "marker": _MARKER_SHARE * side} | fields


def _april_fields(parts: list[str], side: float, form: str) -> dict[str, Any]:
    fields: dict[str, Any] = {}
    for part in parts:
        if (first := _first_id(part)) is not None:
            new: dict[str, Any] = {"first": first}
        elif re.fullmatch(r"\s*\d*\.?\d+\s*", part):
            new = {"gap": float(part) * side}
        else:
            new = {"gap": parse_length("spacing", part)}
        if new.keys() & fields.keys():
            raise InputError(form)
        fields |= new
    return {"gap": _SPACING * side} | fields


def _first_id(text: str) -> int | None:
    match = re.fullmatch(r"\s*id(\d{1,6})\s*", text, re.IGNORECASE)
    return int(match.group(1)) if match else None


def parse_length(name: str, text: str) -> float:
    """A text such as `25mm` in meters.

    Raises:
        InputError: no positive number with a unit.

    Example:
        >>> parse_length("square", "2.5cm")
        0.025
    """
    length = re.fullmatch(r"\s*([0-9.]+(?:[eE][-+]?\d+)?)\s*([a-z]*)\s*", text)
    try:
        value = float(length.group(1)) if length else float("nan")
    except ValueError:
        value = float("nan")
    if length is None or not value > 0 or length.group(2) not in _UNITS:
        raise InputError(f"{name} {text!r}: write a length with its unit (mm, cm, m, in), for example 25mm")
    # Division by the exact inverse keeps 25 mm at 0.025 to the last bit.
    unit = _UNITS[length.group(2)]
    return value / round(1 / unit) if unit in (1e-3, 1e-2) else value * unit
