"""Which view of the left camera was taken together with which view of the right one."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Sequence
from pathlib import Path

from kcal.errors import FileError, InputError

Pair = tuple[str, str]
_SIDE = re.compile(r"(?<![a-z])(left|right|l|r|cam(?:era)?[ _-]?[0-9]+)(?![a-z])", re.IGNORECASE)


def pair_by_name(left: Sequence[str], right: Sequence[str]) -> list[Pair]:
    """Pair views whose names differ only in the camera's word, or whose last number is the same.

    Three rules are tried, and the first that pairs anything without a doubt is used for all: equal names without
    folder and suffix; equal after removing `left`, `right`, `l`, `r`, `cam0`, `camera1` and the like; equal last
    number.

    Args:
        left: names of the left camera's views.
        right: names of the right camera's views.

    Returns:
        pairs in the order of `left`. Views without a partner are left out.

    Raises:
        InputError: no rule pairs the names, or one name has two possible partners.

    Example:
        >>> pair_by_name(["left01.jpg", "left02.jpg"], ["right02.jpg", "right03.jpg"])
        [('left02.jpg', 'right02.jpg')]
    """
    doubt = None
    for key in (_stem, _without_side, _last_number):
        lefts, rights = _by_key(left, key), _by_key(right, key)
        common = [k for k in lefts if k and k in rights]
        if not common:
            continue
        twice = [k for k in common if len(lefts[k]) > 1 or len(rights[k]) > 1]
        if twice:
            doubt = doubt or (lefts[twice[0]] + rights[twice[0]])
            continue
        return [(lefts[k][0], rights[k][0]) for k in common]
    if doubt:
        raise InputError(f"views cannot be paired by name: {', '.join(doubt)} look alike; give a CSV of pairs")
    raise InputError(
        f"no view of the left camera ({left[0] if left else 'none'}, ...) has a partner by name among the right "
        f"camera's ({right[0] if right else 'none'}, ...); give a CSV of pairs"
    )


def _by_key(names: Sequence[str], key: Callable[[str], str]) -> dict[str, list[str]]:
    table: dict[str, list[str]] = {}
    for name in names:
        table.setdefault(key(name), []).append(name)
    return table


def _stem(name: str) -> str:
    return Path(name).stem


def _without_side(name: str) -> str:
    return re.sub(r"[ _-]+", "_", _SIDE.sub("", Path(name).stem)).strip("_")


def _last_number(name: str) -> str:
    numbers = re.findall(r"\d+", Path(name).stem)
    return str(int(numbers[-1])) if numbers else ""


def read_pairs(path: str | Path, left: Sequence[str], right: Sequence[str]) -> list[Pair]:
    """Read pairs from a CSV with the columns `left` and `right`, which hold view names.

    Raises:
        FileError: the file cannot be read, has another header, or has no row.
        InputError: a name that is not among the views, or that is used twice; the line is named.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
        rows = list(csv.reader(io.StringIO(text)))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileError(f"{path}: cannot read: {error}") from error
    if not rows or [cell.strip() for cell in rows[0]] != ["left", "right"]:
        header = ",".join(rows[0]) if rows else "nothing"
        raise FileError(f"{path}: the header must be left,right; it is {header}")
    pairs: list[Pair] = []
    for number, row in enumerate(rows[1:], start=2):
        if not row:
            continue
        cells = [cell.strip() for cell in row]
        if len(cells) != 2:
            raise FileError(f"{path}: line {number} has {len(cells)} fields, two are needed")
        for side, (cell, names) in enumerate(zip(cells, (left, right), strict=True)):
            word = ("left", "right")[side]
            if cell not in names:
                raise InputError(f"{path}: line {number}: no view of the {word} camera is named {cell!r}")
            if any(pair[side] == cell for pair in pairs):
                raise InputError(f"{path}: line {number}: {cell!r} is paired twice")
        pairs.append((cells[0], cells[1]))
    if not pairs:
        raise FileError(f"{path}: no pair below the header")
    return pairs
