"""Pictures of sites: how well an area is seen and located, and a sketch of what to mark."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from kcal.locate.geodesy import geodetic_to_enu
from kcal.locate.siting import Area, RankedSite, Site, SitingMap, siting_map
from kcal.locate.tabulate import middle_row_ends
from kcal.report.figures import ACCENT, HALO, WARN, new_figure, round_levels, save_picture
from kcal.texts import length_text

# A picture of sites: how well an area is seen and located today, and with the candidates that are worth most.

# From good to poor; blind and single are told apart by the blind eye too.
_RAMP = LinearSegmentedColormap.from_list("sigma", ["#0b5d4f", "#3aa17e", "#a6d69b", "#f3e79b", "#e9a857", "#c8553d"])
_HIDDEN, _SINGLE, _NEW = "#2f2b3a", "#b9b4c7", "#f8d568"


def siting_figure(
    area: Area, sites: Sequence[Site], ranked: Sequence[RankedSite] = (), weights: torch.Tensor | None = None
) -> Figure:
    """Draw standard deviations of level positions, what is hidden, the sites and the ranked candidates.

    Args:
        area: from `kcal.locate.area_of`.
        sites: that stand.
        ranked: from `kcal.locate.rank_sites`; a second map shows the area with those that have an order.
        weights: (rows, columns), as for `rank_sites`; counted in the titles.

    Example:
        >>> from kcal.lens.rig import Origin
        >>> from kcal.locate.ground import level_ground
        >>> from kcal.locate.siting import area_of
        >>> towers = [Site(name=name, origin=Origin(lat=45.0, lon=lon, height=99.0)) for name, lon in
        ...           (("mill", 5.9), ("mast", 6.1))]
        >>> area = area_of((45.05, 5.95, 45.15, 6.05), level_ground(0.0), towers, cells=10)
        >>> len(siting_figure(area, towers).axes)
        2
    """
    built = [one for one in ranked if one.order is not None]
    maps = [("Today", siting_map(area, sites, weights))]
    if built:
        names = ", ".join(one.site.name for one in built)
        maps.append((f"With {names}", siting_map(area, [*sites, *(one.site for one in built)], weights)))
    levels = _sigma_levels([found for _, found in maps])
    figure = new_figure(6.4 * len(maps) + 1.0, 7.4)
    panels = figure.subplots(1, len(maps), squeeze=False)[0]
    for number, (axes, (title, found)) in enumerate(zip(panels, maps, strict=True)):
        colored = _siting_area(axes, area, found, levels)
        later = [] if number else list(ranked)
        _siting_marks(axes, area, sites, [one.site for one in built if number], later)
        axes.set_title(
            f"{title}\n{100 * found.covered:.0f} % of the area seen by two or more, "
            f"median σ there {_median_sigma(found)}",
            fontsize=10.5, loc="left",
        )  # fmt: skip
    figure.subplots_adjust(left=0.07, right=0.9, bottom=0.17, top=0.91, wspace=0.14)
    bar = figure.colorbar(colored, cax=figure.add_axes((0.915, 0.17, 0.016, 0.74)), ticks=levels)
    bar.ax.set_yticklabels([length_text(level, digits=2) for level in levels])
    bar.set_label("standard deviation of a position on the map", fontsize=9)
    patches = [Patch(color=_SINGLE, label="one site sees it: a bearing only"), Patch(color=_HIDDEN, label="hidden")]
    marks = [axes.plot([], [], "^", color="white", markeredgecolor="black", markersize=9, label="site")[0]]
    if ranked:
        marks.append(
            axes.plot([], [], "o", color=_NEW, markeredgecolor="black", label="candidate, by rank; new site")[0]
        )
    figure.legend(handles=[*patches, *marks], loc="lower left", bbox_to_anchor=(0.06, 0.045), ncols=4, frameon=False,
                  fontsize=9)  # fmt: skip
    figure.text(0.07, 0.02, _siting_footer(maps[0][1], ranked), fontsize=9, color="#374151")
    return figure


def save_siting_picture(
    path: str | Path, area: Area, sites: Sequence[Site], ranked: Sequence[RankedSite] = (),
    weights: torch.Tensor | None = None,
) -> Path:  # fmt: skip
    """Write the picture of `siting_figure` to a .png or .svg file.

    Raises:
        InputError: another suffix.
        FileError: the file cannot be written.

    Example:
        >>> import tempfile
        >>> from kcal.lens.rig import Origin
        >>> from kcal.locate.ground import level_ground
        >>> from kcal.locate.siting import area_of
        >>> mill = Site(name="mill", origin=Origin(lat=45.0, lon=6.0, height=99.0))
        >>> area = area_of((45.05, 5.95, 45.15, 6.05), level_ground(0.0), [mill], cells=10)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_siting_picture(Path(folder, "sites.png"), area, [mill]).name
        'sites.png'
    """
    return save_picture(path, siting_figure(area, sites, ranked, weights))


def _map_sigma(found: SitingMap) -> NDArray[np.float64]:
    """(rows, columns) standard deviations where two sites or more see a thing."""
    return np.where((found.seen_by > 1).numpy(), found.sigma.numpy(), np.nan)


def _median_sigma(found: SitingMap) -> str:
    there = _map_sigma(found)
    there = there[np.isfinite(there)]
    return length_text(float(np.median(there)), digits=2) if len(there) else "nowhere known"


def _sigma_levels(maps: Sequence[SitingMap]) -> list[float]:
    """Steps of 1, 2, 5 from what the best twentieth of the area has to what the worst twentieth has."""
    values = np.concatenate([_map_sigma(found).ravel() for found in maps])
    values = values[np.isfinite(values)]
    low, high = np.quantile(values, [0.02, 0.95]) if len(values) else (1.0, 10.0)
    return round_levels(max(float(low), 1e-3), float(high), least=2)


def _map_grid(area: Area) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    lats, lons = torch.meshgrid(area.lat, (area.lon + 180.0) % 360.0 - 180.0, indexing="ij")
    east, north, _ = geodetic_to_enu(torch.stack([lats, lons, torch.zeros_like(lats)], -1), area.origin).unbind(-1)
    return east.numpy() / 1e3, north.numpy() / 1e3


def _siting_area(axes: Axes, area: Area, found: SitingMap, levels: Sequence[float]) -> Any:
    east, north = _map_grid(area)
    count = np.where(area.known.numpy(), found.seen_by.numpy(), np.nan).astype(float)
    blind = np.where(count == 0, 0.0, np.where(count == 1, 1.0, np.nan))
    axes.pcolormesh(east, north, blind, cmap=ListedColormap([_HIDDEN, _SINGLE]), vmin=0, vmax=1, rasterized=True)
    norm, sigma = BoundaryNorm(levels, 256, extend="both"), _map_sigma(found)
    colored = axes.pcolormesh(east, north, sigma, cmap=_RAMP, norm=norm, rasterized=True)
    if np.isfinite(sigma).any():
        lines = axes.contour(east, north, sigma, levels=levels, colors="white", linewidths=0.7, alpha=0.8)
        axes.clabel(lines, fmt=lambda level: length_text(level, digits=2), fontsize=7.5, colors="black")
    # Light from the northwest, so that ridges and valleys are seen.
    heights = area.ground.numpy()
    if np.nanmax(heights) - np.nanmin(heights) > 1.0:
        step = 1e3 * float(east[0, 1] - east[0, 0]), 1e3 * float(north[1, 0] - north[0, 0])
        rise, across = np.gradient(heights, step[1], step[0])
        shade = (across - rise) / max(3.0 * float(np.nanstd(across - rise)), 1e-9)
        axes.pcolormesh(
            east, north, np.clip(shade, -1, 1), cmap="gray", vmin=-1, vmax=1, alpha=0.22, linewidth=0, rasterized=True
        )
    axes.set(aspect="equal", xlabel="km east", ylabel="km north", facecolor="#e5e7eb")
    return colored


def _siting_marks(
    axes: Axes, area: Area, sites: Sequence[Site], new: Sequence[Site], ranked: Sequence[RankedSite]
) -> None:
    for number, site in enumerate([*sites, *new]):
        x, y = _site_field(axes, area, site)
        color = "white" if number < len(sites) else _NEW
        axes.plot([x], [y], "^", color=color, markeredgecolor="black", markersize=9, zorder=5)
        axes.annotate(site.name, (x, y), (7, 6), textcoords="offset points", fontsize=9, path_effects=HALO, zorder=6)
    for rank, one in enumerate(ranked, start=1):
        x, y = _site_place(area, one.site)
        axes.plot([x], [y], "o", color=_NEW, markeredgecolor="black", markersize=13, zorder=5)
        axes.text(x, y, str(rank), ha="center", va="center", fontsize=8, zorder=6)
        axes.annotate(
            one.site.name, (x, y), (9, -10), textcoords="offset points", fontsize=8, path_effects=HALO, zorder=6
        )


def _site_place(area: Area, site: Site) -> tuple[float, float]:
    east, north, _ = (geodetic_to_enu(site.origin.geodetic, area.origin) / 1e3).tolist()
    return east, north


def _site_field(axes: Axes, area: Area, site: Site) -> tuple[float, float]:
    """A short wedge where a site does not look all around."""
    x, y = _site_place(area, site)
    if site.heading_deg is not None and (site.field_deg < 360.0 or site.camera is not None):
        half = 0.5 * site.field_deg
        if site.camera is not None:
            # The angle between its rays through the left and right ends of the middle row.
            rays = middle_row_ends(site.camera)
            if rays is None:
                return x, y
            half = math.degrees(0.5 * math.acos(max(-1.0, min(1.0, float(rays[0] @ rays[1])))))
        turn = np.radians(np.linspace(site.heading_deg - half, site.heading_deg + half, 40))
        reach = 0.07 * (axes.get_xlim()[1] - axes.get_xlim()[0])
        axes.fill([x, *(x + reach * np.sin(turn))], [y, *(y + reach * np.cos(turn))], color="white", alpha=0.55,
                  linewidth=0, zorder=4)  # fmt: skip
    return x, y


def _siting_footer(today: SitingMap, ranked: Sequence[RankedSite]) -> str:
    if not ranked:
        return ""
    built = sorted((one for one in ranked if one.after is not None), key=lambda one: one.order or 0)[:5]
    steps = [f"{length_text(one.after or 0.0, digits=3)} with {one.site.name}" for one in built]
    return "standard deviation over the whole area, where what nobody sees may be anywhere in it: " + ", then ".join(
        [f"{length_text(today.mean_sigma, digits=3)} today", *steps]
    )


# A surveyor's sketch: the picture of a site with the names of what to mark.

Named = tuple[list[str], NDArray[np.float64]]


def save_site_sketch(path: str | Path, image: NDArray[np.uint8], landmarks: Named, targets: Named) -> Path:
    """Write a picture with named landmarks and targets.

    Args:
        path: of the .png or .svg file.
        image: (H, W, 3) of the site.
        landmarks: names, and pixels (N, 2).
        targets: the same of what is to be located.
    """
    height, width = image.shape[:2]
    figure = new_figure(width / 160, height / 160, 100)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.imshow(image)
    axes.set_axis_off()
    for (names, pixels), color in ((landmarks, ACCENT), (targets, WARN)):
        for name, (u, v) in zip(names, pixels, strict=True):
            axes.plot(u, v, "o", mfc="none", mec=color, ms=9)
            axes.annotate(
                name, (u, v), (4, 14), textcoords="offset points", color=color, fontsize=11, path_effects=HALO,
                rotation=55, arrowprops={"arrowstyle": "-", "color": color, "lw": 0.8},
            )  # fmt: skip
    where = 0.01 * width, 0.97 * height
    axes.text(*where, "blue: surveyed landmarks    red: targets to locate", fontsize=12, path_effects=HALO)
    return save_picture(path, figure)
