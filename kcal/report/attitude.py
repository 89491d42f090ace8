"""Draw the attitude of a watched rig over time, with its 95 % bands."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from kcal.report.colors import ACCENT, INK, WARN
from kcal.report.figures import new_figure

_ANGLES = ("pitch", "yaw", "roll")
_SPANS = ((86400.0 * 3, 86400.0, "days"), (7200.0, 3600.0, "hours"), (0.0, 60.0, "minutes"))


def attitude_figure(
    time: NDArray[np.float64],
    angle: NDArray[np.float64],
    sigma: NDArray[np.float64],
    seen: NDArray[np.bool_],
    limit: float,
    title: str = "",
) -> Figure:
    """Draw pitch, yaw and roll of the right camera against the left one, each in its own axes.

    Args:
        time: (T,) seconds.
        angle: (T, 3) degrees.
        sigma: (T, 3) degrees.
        seen: (T,) looks at which both cameras saw something.
        limit: degrees of the alarm.
        title: the line above.
    """
    span = float(time[-1] - time[0]) if len(time) else 0.0
    unit, word = next((unit, word) for least, unit, word in _SPANS if span >= least)
    along = (time - (time[0] if len(time) else 0.0)) / unit
    figure = new_figure(9.0, 6.5)
    for k, name in enumerate(_ANGLES):
        axes = figure.add_axes((0.1, 0.7 - 0.3 * k, 0.88, 0.24))
        middle, wide = angle[:, k], 1.96 * sigma[:, k]
        axes.fill_between(along, middle - wide, middle + wide, color=ACCENT, alpha=0.25, linewidth=0, label="95 %")
        axes.plot(along, middle, color=ACCENT, linewidth=1.0)
        for sign in (-1.0, 1.0):
            axes.axhline(sign * limit, color=WARN, linewidth=0.8, linestyle="--", label="limit" if sign > 0 else None)
        if not seen.all():
            low = axes.get_ylim()[0]
            axes.plot(along[~seen], np.full(int((~seen).sum()), low), "|", color=INK, markersize=6, label="not seen")
            axes.set_ylim(bottom=low)
        axes.set_ylabel(f"{name}, degrees", color=INK, fontsize=9)
        axes.tick_params(labelsize=8, colors=INK)
        if k == 0:
            axes.set_title(title, fontsize=9, color=INK, loc="left")
            axes.legend(loc="upper right", fontsize=8, ncols=3)
        if k == 2:
            axes.set_xlabel(word, color=INK, fontsize=9)
    return figure
