"""Rows of a table that are located by a watched rig, each as the rig stood at its time."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from kcal.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from kcal.lens.rig import StereoRig
    from kcal.locate.columns import PositionColumns
    from kcal.locate.tabulate import Locator

    Locate = Callable[[Sequence[str], Tensor, Tensor | None, dict[str, list[str]] | None], PositionColumns]


def located_at(history: Path, rig: StereoRig, locator: Callable[[StereoRig], Locator]) -> Locate:
    """What locates rows with a column `time`: by the rig of that second.

    Args:
        history: of `kcal watch`.
        rig: as it was solved and watched.
        locator: makes what locates by a rig.
    """
    from kcal.locate.columns import PositionColumns
    from kcal.watch.temperature import seconds_of
    from kcal.watch.watched import Watched

    watched: Watched | None = None

    def locate(
        names: Sequence[str], pixels: Tensor, cov: Tensor | None, extras: dict[str, list[str]] | None
    ) -> PositionColumns:
        nonlocal watched
        texts = (extras or {}).get("time")
        if texts is None:
            raise InputError("--watch: the table needs a column time (Unix seconds, or like 2026-05-01T12:00:00Z)")
        times = []
        for name, text in zip(names, texts, strict=True):
            try:
                times.append(round(seconds_of(text)))
            except InputError as error:
                raise InputError(f"{name}: {error}") from None
        if not times:
            return locator(rig)(names, pixels, cov, extras)
        if watched is None or min(times) < watched.since or max(times) > watched.until:
            watched = Watched.read(history, rig, since=min(times), until=max(times))
        parts = []
        for time, group in itertools.groupby(range(len(times)), times.__getitem__):
            rows = list(group)
            part = slice(rows[0], rows[-1] + 1)
            own = {name: cells[part] for name, cells in (extras or {}).items()}
            standing = locator(watched.rig_at(float(time)))
            parts.append(standing(names[part], pixels[part], None if cov is None else cov[part], own))
        return PositionColumns.joined(parts)

    return locate
