"""What `kcal locate` prints and draws of positions."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kcal.cli.console import err, out, print_table, print_wrote
from kcal.cli.cures import mark_again, with_command
from kcal.errors import DegenerateError
from kcal.texts import one_line

if TYPE_CHECKING:
    from torch import Tensor

    from kcal.locate.positions import Located
    from kcal.locate.sample import PositionSample


def draw_positions(
    located: Located, true: Tensor | None, picture: Path | None, web_map: Path | None, **background: Any
) -> None:
    """Write the picture and the map, where they were asked for."""
    if picture is not None:
        from kcal.report.positions import save_positions_picture
        from kcal.report.stations import save_stations_picture

        (save_positions_picture if located.feet is None else save_stations_picture)(picture, located, true)
    if web_map is not None:
        from kcal.report.map_page import save_map

        save_map(web_map, located, true, **background)


def tell_located(
    rig: Path,
    points: Path,
    located: Located,
    true: Tensor | None,
    sample: PositionSample,
    written: Sequence[Path],
    *,
    as_json: bool,
    streamed: bool,
    stated: bool,
    doubts: Sequence[str],
) -> None:
    """Print what was found.

    Raises:
        DegenerateError: nothing could be located.
    """
    if as_json:
        summary = {
            "table": str(points),
            "rows": sample.count,
            "statuses": sample.statuses,
            "warnings": list(doubts),
            "pixel_sigma": located.pixel_sigma,
            "interval": located.interval_note,
            "geoid": located.geoid,
            "written": list(map(str, written)),
        }
        print(json.dumps(summary, indent=1))
    elif streamed:
        err.print(counts_text(sample.count, sample.statuses), markup=False)
    else:
        _print_positions(located, true, sample.statuses, stated=stated)
        print_wrote(*written)
    if "ok" not in sample.statuses:
        rows = "pairs" if located.feet is None else "points"
        text = f"{points}: none of the {sample.count} {rows} could be located; see the table"
        raise DegenerateError(with_command(text, mark_again(None, None, rig=rig)))


def counts_text(rows: int, statuses: dict[str, int]) -> str:
    """How many rows have each status."""
    return f"{rows:,} rows: " + ", ".join(f"{count:,} {name.replace('_', ' ')}" for name, count in statuses.items())


def _print_positions(located: Located, true: Tensor | None, statuses: dict[str, int], *, stated: bool) -> None:
    """Print the table with the reasons below it; of a long one the counts, and the rows that have a true position."""
    from kcal.locate.truth import position_errors
    from kcal.report.tables import position_rows

    errors = None if true is None else position_errors(located, true)
    rows = position_rows(located, errors)
    shown: Sequence[int] = range(len(located.positions))
    if located.rows is not None:
        out.print(counts_text(located.rows, statuses), markup=False)
        shown = [] if true is None else true.isfinite().all(-1).nonzero()[:, 0].tolist()
        out.print(f"Pictures and maps show {len(located.positions):,} of them.", markup=False)
    if shown:
        print_table([rows[0], *(rows[i + 1] for i in shown)], left=(0, len(rows[0]) - 1))
    for position in (located.positions[i] for i in shown):
        if position.reason:
            out.print(f"* {one_line(position.name)}: {position.reason}", markup=False)
    noise = "the noise that the CSV states" if stated else f"{located.pixel_sigma:g} px of noise"
    out.print(f"Interval: {located.interval_note}; marks have {noise}.")
    out.print(f"Heights are ellipsoidal; geoid: {located.geoid or 'none found'}.")
