"""Tables of located points as rows of cells, the heads first: for the screen and for pages."""

from __future__ import annotations

import math

from torch import Tensor

from kcal.corners.board import Board
from kcal.locate.positions import Located, Position
from kcal.locate.range_sigmas import RangeSigmas
from kcal.locate.truth import position_errors

_WORDS = {1: "one", 2: "two", 3: "three", 4: "four"}


def position_rows(located: Located, off: list[tuple[float, float, bool] | None] | None = None) -> list[list[str]]:
    """Name, place, range, interval and status of each point.

    Args:
        located: the points.
        off: from `kcal.locate.truth.position_errors`, for three more columns.
    """
    rows = [["name", "lat °", "lon °", "height m", "range m", "interval m", "status"]]
    rows += [_position_row(position) for position in located.positions]
    if off is not None:
        rows[0][-1:-1] = ["off level m", "off in range m", "in interval"]
        for row, miss in zip(rows[1:], off, strict=True):
            row[-1:-1] = (
                ["", "", ""] if miss is None else [_meters(miss[0]), f"{miss[1]:+.1f}", "yes" if miss[2] else "no"]
            )
    return rows


def _position_row(position: Position) -> list[str]:
    low, high = position.range_low_m, position.range_high_m
    numbers = ["", "", "", ""]
    if position.lat is not None and position.lon is not None and position.height is not None:
        place = [f"{position.lat:.7f}", f"{position.lon:.7f}", f"{position.height:.1f}"]
        numbers = [*place, _meters(position.range_m or 0)]
    interval = "" if low is None or high is None else f"{_meters(low)} – {_meters(high)}"
    status = position.status.name.lower().replace("_", " ")
    return [position.name, *numbers, interval, f"{status} *" if position.reason else status]


def _meters(value: float) -> str:
    return "∞" if math.isinf(value) else f"{value:.1f}" if value < 1000 else f"{value:.0f}"


def truth_rows(located: Located, noiseless: Located, truth: Tensor) -> list[list[str]]:
    """Range, interval and error of each point, along and across the true line of sight, and whether it is in between.

    Args:
        located: the points.
        noiseless: the same points, located from marks without noise: the last column is their error, which the
            calibration alone has caused.
        truth: (N, 3) true east, north, up, meters.
    """
    rows = [
        ["target", "true m", "estimate m", "95 % interval m", "truth is", "error m", "%", "across m", "calibration m"]
    ]
    for position, exact, true, miss in zip(
        located.positions, noiseless.positions, truth, position_errors(located, truth), strict=True
    ):
        distance = float(true.norm())
        if position.enu is None or position.range_m is None or miss is None:
            rows.append([position.name, f"{distance:.1f}", "-", "-", "-", "-", "-", "-", position.reason])
            continue
        along, across = _along_and_across(position, true)
        low, high = position.range_low_m or 0.0, position.range_high_m or 0.0
        estimate, interval = f"{position.range_m:.1f}", f"{low:.1f} – {high:.1f}"
        error = [f"{along:+.2f}", f"{100 * along / distance:+.2f}", f"{across:.2f}"]
        share = "-" if exact.enu is None else f"{_along_and_across(exact, true)[0]:+.2f}"
        where = "inside" if miss[2] else "outside"
        rows.append([position.name, f"{distance:.1f}", estimate, interval, where, *error, share])
    return rows


def chance_text(located: Located, truth: Tensor) -> str:
    """How many 95 % intervals contain the true range, and how many misses chance explains.

    Example:
        >>> from kcal import Origin, locate_points
        >>> from kcal.rig import planned_rig
        >>> import torch
        >>> points = torch.tensor([[0.0, 0.0, 1000.0]] * 7, dtype=torch.float64)
        >>> left, right, _ = planned_rig()(points)
        >>> found = locate_points(planned_rig(), left, right, origin=Origin(lat=19.0, lon=72.9, height=0.0),
        ...                       heading_deg=0.0)
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


def range_sigma_rows(found: RangeSigmas) -> list[list[str]]:
    """Standard deviations of ranges by their sources, meters; empty where a range cannot be told."""
    rows = [["at m", "σ of range", "marks", "lenses", "relative pose", "mounting, sideways"]]
    for distance, marks, lenses, pose, total, ranged, sideways in zip(*(part.tolist() for part in found), strict=True):
        parts = [total, marks, lenses, pose] if ranged else []
        cells = [_short(part) for part in parts] or ["bearing only", "", "", ""]
        rows.append([f"{distance:g}", *cells, _short(sideways)])
    return rows


def _short(value: float) -> str:
    if value == 0:
        return "0"
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 1 else f"{value:.3f}"


def diagonal_rows(located: Located, board: Board) -> list[list[str]]:
    """The board's diagonal, known and located, for each pair of points named "NAME first" and "NAME last"."""
    true = math.dist(board.points[0].tolist(), board.points[-1].tolist())
    rows = [["pair", "range m", "true mm", "estimated mm", "error mm"]]
    ends = {position.name: position for position in located.positions}
    for name in sorted({name.rsplit(" ", 1)[0] for name in ends}):
        first, last = ends.get(f"{name} first"), ends.get(f"{name} last")
        if first is None or last is None or first.enu is None or last.enu is None:
            continue
        length = math.dist(first.enu, last.enu)
        error = f"{1e3 * (length - true):+.2f}"
        rows.append([name, f"{first.range_m:.3f}", f"{1e3 * true:.2f}", f"{1e3 * length:.2f}", error])
    return rows
