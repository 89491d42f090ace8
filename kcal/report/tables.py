"""Tables of located points as rows of cells, the heads first: for the screen and for pages."""

from __future__ import annotations

import math

from torch import Tensor

from kcal.corners.board import Board
from kcal.locate.budget import RangeSigmas
from kcal.locate.positions import Located, Position, position_errors
from kcal.locate.stereo import QUANTILE
from kcal.texts import M, Unit, length_text, length_unit, number_text, range_text

_WORDS = {1: "one", 2: "two", 3: "three", 4: "four"}


def position_rows(located: Located, off: list[tuple[float, float, bool] | None] | None = None) -> list[list[str]]:
    """Name, place, range, interval and status of each point.

    Args:
        located: the points.
        off: from `kcal.locate.positions.position_errors`, for three more columns.
    """
    unit = range_unit(located)
    where = ["lat °", "lon °", "height m"] if located.origin else ["x m", "y m", "z m"]
    rows = [["name", *where, f"range {unit.name}", f"interval {unit.name}", "status"]]
    rows += [_position_row(position, unit) for position in located.positions]
    if off is not None:
        rows[0][-1:-1] = [f"off level {unit.name}", f"off in range {unit.name}", "in interval"]
        for row, position, miss in zip(rows[1:], located.positions, off, strict=True):
            sigma = range_sigma(position)
            row[-1:-1] = ["", "", ""]
            if miss is not None:
                level, along = unit.number(miss[0], sigma), unit.number(miss[1], sigma, sign=True)
                row[-4:-1] = [level, along, "yes" if miss[2] else "no"]
    return rows


def range_unit(located: Located) -> Unit:
    """The unit that fits the ranges of all points."""
    return length_unit(p.range_low_m if p.range_m is None else p.range_m for p in located.positions)


def range_sigma(position: Position) -> float | None:
    """Standard deviation of a range as its interval tells, meters; None where it has none.

    Where the interval is open, its lower half counts.
    """
    low, high = position.range_low_m, position.range_high_m
    if low is None or high is None:
        return None
    if math.isfinite(high):
        return (high - low) / (2.0 * QUANTILE)
    return None if position.range_m is None else (position.range_m - low) / QUANTILE


def interval_text(position: Position, unit: Unit) -> str:
    """The interval of a range, without the unit's name; empty where there is none."""
    low, high, sigma = position.range_low_m, position.range_high_m, range_sigma(position)
    return "" if low is None or high is None else f"{unit.number(low, sigma)} – {unit.number(high, sigma)}"


def _position_row(position: Position, unit: Unit) -> list[str]:
    place: list[str] = []
    if position.lat is not None and position.lon is not None and position.height is not None:
        # 1e-7° are 11 mm.
        degrees = 9 if unit.meters < M.meters else 7
        up = None if position.covariance is None else math.sqrt(position.covariance[2][2])
        place = [f"{position.lat:.{degrees}f}", f"{position.lon:.{degrees}f}", number_text(position.height, up)]
    elif position.enu is not None and position.covariance is not None:
        sigmas = [math.sqrt(row[axis]) for axis, row in enumerate(position.covariance)]
        place = [number_text(value, sigma) for value, sigma in zip(position.enu, sigmas, strict=True)]
    numbers = [*place, unit.number(position.range_m or 0.0, range_sigma(position))] if place else [""] * 4
    status = position.status.name.lower().replace("_", " ")
    return [position.name, *numbers, interval_text(position, unit), f"{status} *" if position.reason else status]


def truth_rows(located: Located, noiseless: Located, truth: Tensor) -> list[list[str]]:
    """Range, interval and error of each point, along and across the true line of sight, and whether it is in between.

    Args:
        located: the points.
        noiseless: the same points, located from marks without noise: the last column is their error, which the
            calibration alone has caused.
        truth: (N, 3) true east, north, up, meters.
    """
    unit = range_unit(located)
    first, last = (
        [f"{word} {unit.name}" for word in words]
        for words in (("true", "estimate", "95 % interval"), ("across", "calibration"))
    )
    rows = [["target", *first, "truth is", f"error {unit.name}", "%", *last]]
    misses = position_errors(located, truth)
    for position, exact, true, miss in zip(located.positions, noiseless.positions, truth, misses, strict=True):
        distance, sigma = float(true.norm()), range_sigma(position)
        if position.enu is None or position.range_m is None or miss is None:
            rows.append([position.name, unit.number(distance, sigma), *["-"] * 6, position.reason])
            continue
        along, across = _along_and_across(position, true)
        share = None if sigma is None else 100.0 * sigma / distance
        ranges = [unit.number(distance, sigma), unit.number(position.range_m, sigma), interval_text(position, unit)]
        errors = [unit.number(along, sigma, sign=True), number_text(100.0 * along / distance, share, sign=True)]
        errors.append(unit.number(across, digits=2))
        alone = "-" if exact.enu is None else unit.number(_along_and_across(exact, true)[0], sigma, sign=True)
        rows.append([position.name, *ranges, "inside" if miss[2] else "outside", *errors, alone])
    return rows


def chance_text(located: Located, truth: Tensor) -> str:
    """How many 95 % intervals contain the true range, and how many misses chance explains.

    Example:
        >>> from kcal import Localizer, Origin, locate_points
        >>> from kcal.locate import Marks
        >>> from kcal.rig import planned_rig
        >>> import torch
        >>> points = torch.tensor([[0.0, 0.0, 1000.0]] * 7, dtype=torch.float64)
        >>> localize = Localizer(planned_rig().placed(origin=Origin(lat=19.0, lon=72.9, height=0.0), heading_deg=0.0))
        >>> found = locate_points(localize, Marks(tuple("abcdefg"), planned_rig()(points)[0]))
        >>> chance_text(found, points[:, [0, 2, 1]])
        'The true range is inside 7 of 7 intervals. Of 7 intervals of 95 %, one or more miss in 30 % of all runs.'
    """
    found = [miss[2] for miss in position_errors(located, truth) if miss is not None]
    count, outside = len(found), found.count(False)
    text = f"The true range is inside {count - outside} of {count} intervals."
    most = max(outside, 1)
    if not count:
        return text
    fewer = sum(math.comb(count, k) * 0.05**k * 0.95 ** (count - k) for k in range(most))
    share = f"{100 * (1 - fewer):.2g} %"
    text += f" Of {count} intervals of 95 %, {_WORDS.get(most, most)} or more miss in {share} of all runs."
    if outside and 1 - fewer < 0.01:
        text += (
            " Chance hardly explains that, but all targets share the errors of the rig, so several can miss together."
        )
    return text


def _along_and_across(position: Position, true: Tensor) -> tuple[float, float]:
    """Signed error along the line of sight, and error across it, meters."""
    error = true.new_tensor(position.enu) - true
    sight = true / true.norm()
    along = float(error @ sight)
    return along, float((error - along * sight).norm())


def range_sigma_rows(found: RangeSigmas, known: bool = True) -> list[list[str]]:
    """Standard deviations of ranges by their sources; where a range cannot be told, that only the bearing is known.

    Args:
        found: from `kcal.locate.budget.range_sigmas`.
        known: whether the rig has a covariance: else nothing is known of lenses and pose, and so of the sum.
    """
    rows = [["at", "σ of range", "marks", "lenses", "relative pose", "mounting, sideways"]]
    for distance, marks, lenses, pose, total, ranged, sideways in zip(*(part.tolist() for part in found), strict=True):
        cells = [length_text(part, digits=2) for part in (total, marks, lenses, pose)]
        if not ranged:
            cells = ["bearing only", "", "", ""]
        elif not known:
            cells = ["not known", cells[1], "not known", "not known"]
        rows.append([range_text(distance), *cells, length_text(sideways, digits=2)])
    return rows


def diagonal_rows(located: Located, board: Board) -> list[list[str]]:
    """The board's diagonal, known and located, for each pair of points named "NAME first" and "NAME last"."""
    true = math.dist(board.points[0].tolist(), board.points[-1].tolist())
    rows = [["pair", "range", "true", "estimated", "error"]]
    ends = {position.name: position for position in located.positions}
    for name in sorted({name.rsplit(" ", 1)[0] for name in ends}):
        first, last = ends.get(f"{name} first"), ends.get(f"{name} last")
        if first is None or last is None or first.enu is None or last.enu is None:
            continue
        length = math.dist(first.enu, last.enu)
        far, unit = first.range_m or 0.0, length_unit([true])
        known = length_text(true, unit=unit, digits=5)
        estimated, error = length_text(length, unit=unit, digits=5), length_text(length - true, digits=2, sign=True)
        rows.append([name, length_text(far, range_sigma(first)), known, estimated, error])
    return rows
