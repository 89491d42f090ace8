"""Tables of located points, and a page that explains what was done and what came out."""

from __future__ import annotations

import base64
import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from kcal.corners.board import Board
from kcal.errors import InputError
from kcal.files import read_bytes, write_atomic
from kcal.locate.budget import RangeSigmas
from kcal.locate.positions import Located, Position, position_errors
from kcal.locate.stereo import QUANTILE
from kcal.texts import M, Unit, length_text, length_unit, number_text, page_policy, page_text, range_text

# Tables of located points as rows of cells, the heads first: for the screen and for pages.

_WORDS = {1: "one", 2: "two", 3: "three", 4: "four"}


def position_rows(located: Located, off: list[tuple[float, float, bool] | None] | None = None) -> list[list[str]]:
    """Name, place, range, interval and status of each point.

    Args:
        located: the points.
        off: from `kcal.locate.positions.position_errors`, for three more columns.
    """
    unit = range_unit(located)
    rows = [["name", "lat °", "lon °", "height m", f"range {unit.name}", f"interval {unit.name}", "status"]]
    rows += [_position_row(position, unit) for position in located.positions]
    if off is not None:
        rows[0][-1:-1] = [f"off level {unit.name}", f"off in range {unit.name}", "in interval"]
        for row, position, miss in zip(rows[1:], located.positions, off, strict=True):
            sigma = range_sigma(position)
            row[-1:-1] = (
                ["", "", ""]
                if miss is None
                else [unit.number(miss[0], sigma), unit.number(miss[1], sigma, sign=True), "yes" if miss[2] else "no"]
            )
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
    numbers = ["", "", "", ""]
    if position.lat is not None and position.lon is not None and position.height is not None:
        # 1e-7° are 11 mm.
        degrees = 9 if unit.meters < M.meters else 7
        up = None if position.covariance is None else math.sqrt(position.covariance[2][2])
        place = [f"{position.lat:.{degrees}f}", f"{position.lon:.{degrees}f}", number_text(position.height, up)]
        numbers = [*place, unit.number(position.range_m or 0.0, range_sigma(position))]
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
    lengths = (
        f"{word} {unit.name}" for word in ("true", "estimate", "95 % interval", "error", "across", "calibration")
    )
    true_head, estimate_head, interval_head, error_head, across_head, calibration_head = lengths
    rows = [
        ["target", true_head, estimate_head, interval_head, "truth is", error_head, "%", across_head, calibration_head]
    ]
    for position, exact, true, miss in zip(
        located.positions, noiseless.positions, truth, position_errors(located, truth), strict=True
    ):
        distance, sigma = float(true.norm()), range_sigma(position)
        if position.enu is None or position.range_m is None or miss is None:
            rows.append([position.name, unit.number(distance, sigma), *["-"] * 6, position.reason])
            continue
        along, across = _along_and_across(position, true)
        share = None if sigma is None else 100.0 * sigma / distance
        rows.append(
            [
                position.name,
                unit.number(distance, sigma),
                unit.number(position.range_m, sigma),
                interval_text(position, unit),
                "inside" if miss[2] else "outside",
                unit.number(along, sigma, sign=True),
                number_text(100.0 * along / distance, share, sign=True),
                unit.number(across, digits=2),
                "-" if exact.enu is None else unit.number(_along_and_across(exact, true)[0], sigma, sign=True),
            ]
        )
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


def range_sigma_rows(found: RangeSigmas, known: bool = True) -> list[list[str]]:
    """Standard deviations of ranges by their sources; where a range cannot be told, that only the bearing is known.

    Args:
        found: from `kcal.locate.budget.range_sigmas`.
        known: whether the rig has a covariance: else nothing is known of lenses and pose, and so of the sum.
    """
    rows = [["at", "σ of range", "marks", "lenses", "relative pose", "mounting, sideways"]]
    for distance, marks, lenses, pose, total, ranged, sideways in zip(*(part.tolist() for part in found), strict=True):
        cells = [length_text(part, digits=2) for part in (total, marks, lenses, pose)]
        if not known:
            cells = ["not known", cells[1], "not known", "not known"]
        rows.append(
            [
                range_text(distance),
                *(cells if ranged else ["bearing only", "", "", ""]),
                length_text(sideways, digits=2),
            ]
        )
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


# Write one HTML page that explains what was done and what came out; its pictures are embedded.

_PAGE_STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.55 system-ui, sans-serif; color: #111827; background: #f3f4f6; margin: 0; }
main { max-width: 62rem; margin: 0 auto; padding: 2rem 1.2rem 4rem; }
h1 { font-size: 1.7rem; margin: 0 0 .4rem; }
h2 { font-size: 1.15rem; margin: 0 0 .5rem; }
section { background: #fff; border: 1px solid #e5e7eb; border-radius: 8px; padding: 1.1rem 1.3rem; margin: 1.2rem 0; }
p { margin: .3rem 0 .8rem; max-width: 52rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .92rem; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .7rem; text-align: right; border-bottom: 1px solid #e5e7eb; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
th { color: #4b5563; font-weight: 600; }
figure { margin: .6rem 0; }
figcaption { color: #4b5563; font-size: .88rem; }
img { max-width: 100%; height: auto; }
pre { background: #f3f4f6; padding: .7rem .9rem; white-space: pre-wrap; overflow-wrap: anywhere; font-size: .85rem; }
.row { display: flex; gap: 1rem; flex-wrap: wrap; }
.row figure { flex: 1 1 100%; }
@media (max-width: 44rem) { main { padding: 1rem .6rem; } section { padding: 1rem .8rem; } th, td { padding: .3rem; }
  figure { overflow-x: auto; } figure img { max-width: none; width: 40rem; } }
"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Part:
    """A part of the page: a heading, sentences, and what belongs to them.

    Args:
        heading: its heading.
        text: its paragraphs.
        table: rows of cells, the first row with the heads; empty for no table.
        pictures: PNG or JPEG files with their captions, side by side where there is room.
        code: a command to copy, or "".
    """

    heading: str
    text: tuple[str, ...] = ()
    table: tuple[tuple[str, ...], ...] = ()
    pictures: tuple[tuple[str | Path, str], ...] = ()
    code: str = ""


def summary_page(title: str, lead: str, parts: Sequence[Part]) -> str:
    """Make the page as HTML.

    Args:
        title: its title.
        lead: one paragraph under the title.
        parts: the parts, in order.

    Raises:
        FileError: a picture cannot be read.
        InputError: a picture that is neither PNG nor JPEG, or a table whose rows differ in length.

    Example:
        >>> part = Part(heading="Found", table=(("name", "m"), ("gate", "100")))
        >>> page = summary_page("A rig", "Two cameras.", [part])
        >>> "<td>gate</td><td>100</td>" in page, "http" in page
        (True, False)
    """
    body = "\n".join(_section(part) for part in parts)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<meta HTTP-EQUIV="Content-Security-Policy" content="{page_policy(styles=[_PAGE_STYLE])}">\n'
        f"<title>{page_text(title)}</title>\n<style>{_PAGE_STYLE}</style>\n</head>\n<body>\n<main>\n"
        f"<h1>{page_text(title)}</h1>\n<p>{page_text(lead)}</p>\n{body}\n</main>\n</body>\n</html>\n"
    )


def save_summary(path: str | Path, title: str, lead: str, parts: Sequence[Part]) -> Path:
    """Write the page of `summary_page`, atomically.

    Raises:
        FileError: the file cannot be written, or see `summary_page`.
        InputError: see `summary_page`.
    """
    return write_atomic(path, summary_page(title, lead, parts))


def _section(part: Part) -> str:
    lines = ["<section>", f"<h2>{page_text(part.heading)}</h2>"]
    lines += [f"<p>{page_text(text)}</p>" for text in part.text]
    if part.table:
        lines.append(_html_table(part))
    if part.pictures:
        figures = "\n".join(_figure(path, caption) for path, caption in part.pictures)
        lines.append(f'<div class="row">\n{figures}\n</div>')
    if part.code:
        lines.append(f"<pre>{page_text(part.code)}</pre>")
    return "\n".join([*lines, "</section>"])


def _html_table(part: Part) -> str:
    if len({len(row) for row in part.table}) > 1:
        raise InputError(f"the table of {part.heading!r}: rows of different lengths")
    head, *rows = part.table
    lines = ["<tr>" + "".join(f'<th scope="col">{page_text(cell)}</th>' for cell in head) + "</tr>"]
    lines += ["<tr>" + "".join(f"<td>{page_text(cell)}</td>" for cell in row) + "</tr>" for row in rows]
    return '<div class="scroll" tabindex="0"><table>\n' + "\n".join(lines) + "\n</table></div>"


def _figure(path: str | Path, caption: str) -> str:
    data = read_bytes(path)
    kinds = {b"\x89PNG": "png", b"\xff\xd8\xff": "jpeg"}
    kind = next((name for start, name in kinds.items() if data.startswith(start)), None)
    if kind is None:
        raise InputError(f"{path}: neither a PNG nor a JPEG picture")
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
    text = page_text(caption)
    return f'<figure tabindex="0"><img src="{source}" alt="{text}"><figcaption>{text}</figcaption></figure>'
