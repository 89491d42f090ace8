"""A plan of stations: towers with what they see, positions with their 95 % ellipses, bearings of single cameras."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from kcal.locate.map_places import field_azimuths
from kcal.locate.positions import Located
from kcal.locate.region import region_outline
from kcal.locate.stereo import PositionStatus
from kcal.report.figures import new_figure, save_picture

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Of the larger side of what is shown: how far fields of view and bearings are drawn.
_REACH = 0.9


def stations_figure(located: Located, truth: Tensor | None = None) -> Figure:
    """Draw a plan, kilometers east and north of the origin.

    Args:
        located: from `kcal.locate.station_positions.locate_views`.
        truth: (N, 3) true east, north, up in meters, NaN where unknown.
    """
    figure = new_figure(8.0, 7.0)
    axes = figure.add_subplot()
    towers = torch.tensor([camera.enu[:2] for camera in located.cameras], dtype=torch.float64)
    found = located.enu[located.enu.isfinite().all(-1)]
    shown = torch.cat([towers, found[:, :2]])
    reach = _REACH * max(float((shown.amax(0) - shown.amin(0)).amax()), 1.0)
    for number, camera in enumerate(located.cameras):
        x, y = (value / 1e3 for value in camera.enu[:2])
        sweep = field_azimuths(camera)
        if sweep is not None:
            angle = torch.deg2rad(sweep)
            east, north = x + reach / 1e3 * angle.sin(), y + reach / 1e3 * angle.cos()
            axes.fill([x, *east.tolist()], [y, *north.tolist()], color=f"C{number % 10}", alpha=0.10, linewidth=0)
        axes.plot([x], [y], "^", color=f"C{number % 10}", markersize=9)
        axes.annotate(camera.name, (x, y), xytext=(6, 6), textcoords="offset points")
    feet = torch.zeros(len(located.positions), 3) if located.feet is None else located.feet
    for position, foot in zip(located.positions, feet.tolist(), strict=True):
        if position.enu is not None and position.covariance is not None:
            center, spread = torch.tensor(position.enu).double(), torch.tensor(position.covariance).double()
            ring = region_outline(center, spread, plain=True) / 1e3
            axes.fill(ring[:, 0], ring[:, 1], facecolor="none", edgecolor="black", linewidth=1.2)
            axes.plot([position.enu[0] / 1e3], [position.enu[1] / 1e3], "k.", markersize=4)
            axes.annotate(
                position.name, (position.enu[0] / 1e3, position.enu[1] / 1e3), xytext=(5, -11),
                textcoords="offset points", fontsize="small",
            )  # fmt: skip
        elif position.azimuth_deg is not None and position.status == PositionStatus.BEARING_ONLY:
            way = math.radians(position.azimuth_deg)
            ends = [foot[0], foot[0] + reach * math.sin(way)], [foot[1], foot[1] + reach * math.cos(way)]
            axes.plot(*([value / 1e3 for value in end] for end in ends), "--", color="gray", linewidth=1)
    if truth is not None:
        known = truth[truth.isfinite().all(-1)] / 1e3
        axes.plot(known[:, 0], known[:, 1], "r+", markersize=8)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("km east")
    axes.set_ylabel("km north")
    axes.set_title(f"{located.count_note}; outlines: 95 % regions", fontsize="medium")
    return figure


def save_stations_picture(path: str | Path, located: Located, truth: Tensor | None = None) -> Path:
    """Write the plan to a .png or .svg file.

    Raises:
        InputError: another suffix.
        FileError: the file cannot be written.
    """
    return save_picture(path, stations_figure(located, truth))
