"""Pair the views of two cameras that were taken at the same moment."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from kcal.calibrate.rig.sources import Boards
from kcal.corners.board import Board
from kcal.corners.observations import Observations
from kcal.errors import FileError, InputError
from kcal.files import read_bytes
from kcal.lens.camera import Camera
from kcal.strict_json import MOST_BYTES

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


def names_by_side(names: Sequence[str]) -> dict[str, dict[str, str]]:
    """Names by the camera's word in them, and by what else is in them; names without such a word are left out.

    Example:
        >>> names_by_side(["left01.jpg", "right01.jpg", "left02.jpg", "far.jpg"])
        {'left': {'01': 'left01.jpg', '02': 'left02.jpg'}, 'right': {'01': 'right01.jpg'}}
    """
    found: dict[str, dict[str, str]] = {}
    for name in names:
        if side := _SIDE.search(Path(name).stem):
            found.setdefault(side.group().lower(), {})[_without_side(name)] = name
    return found


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
    try:
        rows = list(csv.reader(io.StringIO(read_bytes(path, MOST_BYTES).decode("utf-8-sig"))))
    except (UnicodeDecodeError, csv.Error) as error:
        raise FileError(f"{path}: cannot read: {error}") from error
    if not rows or [cell.strip() for cell in rows[0]] != ["left", "right"]:
        header = ",".join(rows[0])[:200] if rows else "nothing"
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


def _deviation(cameras: Sequence[Camera], board: Board) -> Tensor | None:
    """(N, 3) meters by which the corners lie elsewhere than ordered, as the calibrations of the cameras found.

    The mean of what the cameras found. A board that looks alike after half a turn may have been read from either end:
    what follows the first camera's deviation better counts.
    """
    found: list[Tensor] = []
    for camera in cameras:
        record = None if camera.calibration is None else camera.calibration.record
        if record is None or record.board_deviation is None or record.board != board.record:
            continue
        own = torch.tensor(record.board_deviation, dtype=torch.float64)
        turned = own.flip(0) * torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)
        if found and not board.unambiguous and (turned - found[0]).norm() < (own - found[0]).norm():
            own = turned
        found.append(own)
    return torch.stack(found).mean(0) if found else None


def paired_boards(
    cameras: tuple[Camera, Camera], observations: tuple[Observations, Observations], pairs: Sequence[Pair]
) -> Boards:
    """Boards seen by the left and the right camera at the same moments, each named after its two views.

    Raises:
        InputError: boards or image sizes that differ, a name that is not among the views, no pair.
    """
    boards = [seen.board for seen in observations]
    if boards[0] != boards[1]:
        raise InputError(f"the cameras saw different boards: {boards[0]} and {boards[1]}")
    for word, camera, seen in zip(("left", "right"), cameras, observations, strict=True):
        if camera.size != tuple(seen.image_size):
            raise InputError(
                f"the {word} camera has images of {camera.size[0]}x{camera.size[1]}, its observations of "
                f"{seen.image_size[0]}x{seen.image_size[1]}: are the files mixed up?"
            )
    if not pairs:
        raise InputError("no pair of views")
    sides = [seen.subset([pair[side] for pair in pairs]) for side, seen in enumerate(observations)]
    known = [covariance for side in sides if (covariance := side.covariances()) is not None]
    return Boards(
        board=boards[0],
        pixels=torch.stack([side.pixels() for side in sides], 1),
        names=tuple(" ".join(dict.fromkeys(pair)) for pair in pairs),
        deviation=_deviation(cameras, boards[0]),
        views=tuple(tuple(pair[side] for pair in pairs) for side in (0, 1)),
        covariance=torch.stack(known, 1) if len(known) == 2 else None,
    )


def boards_of_several(
    cameras: Sequence[Camera], names: Sequence[str], observations: Mapping[int, Observations]
) -> Boards:
    """Boards seen by any two or more of several cameras at the same moments.

    Views belong together whose names are equal without the camera's name, the folder and the suffix.

    Args:
        cameras: C of them.
        names: of the cameras.
        observations: of some of the cameras, by number.

    Raises:
        InputError: boards or image sizes that differ, two views of one moment, no moment that two cameras saw.
    """
    boards = {number: seen.board for number, seen in observations.items()}
    first = next(iter(boards))
    moments: dict[str, dict[int, str]] = {}
    for number, seen in observations.items():
        if seen.board != boards[first]:
            raise InputError(f"{names[first]} and {names[number]} saw different boards: {boards[first]}, {seen.board}")
        if cameras[number].size != tuple(seen.image_size):
            raise InputError(f"{names[number]}: images of {cameras[number].size}, observations of {seen.image_size}")
        for name in seen.names:
            key = re.sub(r"[ _-]+", "_", _stem(name).replace(names[number], "")).strip("_")
            if number in moments.setdefault(key, {}):
                raise InputError(f"{names[number]}: {moments[key][number]} and {name} are of one moment by their names")
            moments[key][number] = name
    shared = {key: own for key, own in moments.items() if len(own) > 1}
    if not shared:
        raise InputError("no moment at which two cameras saw the board: the names of views must be alike")
    pixels = torch.full((len(shared), len(cameras), boards[first].corners, 2), math.nan, dtype=torch.float64)
    for number, seen in observations.items():
        rows = [i for i, own in enumerate(shared.values()) if number in own]
        pixels[rows, number] = seen.subset([own[number] for own in shared.values() if number in own]).pixels()
    return Boards(
        board=boards[first],
        pixels=pixels,
        names=tuple(key or str(i) for i, key in enumerate(shared)),
        deviation=_deviation([cameras[number] for number in observations], boards[first]),
        views=tuple(tuple(own.get(c, "") for own in shared.values()) for c in range(len(cameras))),
    )
