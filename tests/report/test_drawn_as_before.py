"""What every picture draws, number by number, as it was when somebody last looked at it.

After a change that is meant, look at the pictures, then write the numbers anew: KCAL_WRITE_DRAWN=1 and this file.
"""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_scenes import FIGURES
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import Collection
from matplotlib.colors import to_hex
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.quiver import Quiver
from matplotlib.text import Annotation, Text
from numpy.typing import ArrayLike

KEPT = Path(__file__).parent / "drawn.json"


def numbers(values: ArrayLike) -> list[float]:
    """Count of what is finite, first, last, mean and spread of each coordinate, and how neighbors go together."""
    flat = np.ma.filled(np.ma.asarray(values, float), np.nan)
    if not flat.size:
        return [0.0]
    flat = flat.reshape(len(flat), -1)
    flat = flat[np.isfinite(flat).all(1)]
    if not len(flat):
        return [0.0]
    order = np.arange(len(flat)) @ (flat - flat.mean(0)) / len(flat) ** 2
    return [float(len(flat)), *flat[0], *flat[-1], *flat.mean(0), *flat.std(0), *order]


def facts(artist: Artist) -> list[Any]:
    """Texts and numbers that say what an artist draws."""
    kind = type(artist).__name__
    match artist:
        case Text():
            beside = [*map(float, artist.xy), *map(float, artist.xyann)] if isinstance(artist, Annotation) else []
            at = [float(value) for value in artist.get_position()]
            style = [artist.get_ha(), artist.get_va(), to_hex(artist.get_color())]
            return [kind, artist.get_text(), *style, float(artist.get_fontsize()), *at, *beside]
        case Line2D():
            style = [artist.get_marker(), artist.get_linestyle(), to_hex(artist.get_color()), str(artist.get_label())]
            data = np.stack(np.broadcast_arrays(*artist.get_data()), -1) if len(artist.get_xdata()) else []
            return [kind, *map(str, style), artist.get_linewidth(), artist.get_markersize(), *numbers(data)]
        case Quiver():
            return [kind, *numbers(artist.XY), *numbers(np.stack([artist.U, artist.V], -1)), *colors(artist)]
        case AxesImage():
            values = artist.get_array()
            return [kind, *map(float, artist.get_clim()), *map(float, artist.get_extent()), *numbers(np.ravel(values))]
        case ContourSet():
            # Where contours run depends on the last bits of the values.
            return [kind, *map(float, artist.levels), artist.get_cmap().name, float(artist.get_alpha() or 0)]
        case Collection():
            paths = [path.vertices for path in artist.get_paths() if len(path.vertices)]
            sizes = numbers(artist.get_linewidths()) if len(artist.get_linewidths()) else []
            return [kind, *sizes, *numbers(np.concatenate(paths) if paths else [[]]), *colors(artist),
                    *numbers(artist.get_offsets())]  # fmt: skip
        case Patch():
            path = artist.get_path().vertices
            if hasattr(artist, "get_width"):
                path = np.array([artist.get_xy(), (artist.get_width(), artist.get_height())])
            style = to_hex(artist.get_facecolor()), to_hex(artist.get_edgecolor())
            return [kind, *style, float(artist.get_alpha() or 0), artist.get_linewidth(), *numbers(path)]
    return []


def colors(artist: Collection) -> list[Any]:
    values = artist.get_array()
    if values is not None and np.size(values):
        return [*map(float, artist.get_clim()), *numbers(np.ravel(values))]
    return [to_hex(color) for color in artist.get_facecolor()[:3]]


def drawn(figure: Figure) -> list[list[Any]]:
    found: list[list[Any]] = [["Figure", *map(float, figure.get_size_inches())]]
    found += [facts(text) for text in figure.texts]
    for axes in figure.findobj(Axes):
        ends = [*axes.get_xlim(), *axes.get_ylim()]
        scales = [axes.get_xscale(), axes.get_yscale(), axes.get_xlabel(), axes.get_ylabel()]
        titles = [axes.get_title(side) for side in ("left", "center", "right")]
        found.append(["Axes", *scales, *titles, *map(float, axes.get_position().bounds), *map(float, ends)])
        legend = axes.get_legend()
        found.append([text.get_text() for text in legend.get_texts()] if legend else [])
        found += [facts(artist) for artist in axes.get_children()]
    return [entry for entry in found if len(entry) > 1]


def same(one: object, other: object, size: float) -> bool:
    """Equal texts; numbers to a thousandth of the largest beside them."""
    if isinstance(one, float | int) and isinstance(other, float | int):
        return abs(one - other) <= 1e-3 * max(abs(other), 1e-3 * size, 1e-6)
    return one == other


@pytest.mark.slow
@pytest.mark.parametrize("name", FIGURES)
def test_as_before(name: str) -> None:
    found = drawn(FIGURES[name]())
    kept: dict[str, list[list[Any]]] = json.loads(KEPT.read_text()) if KEPT.exists() else {}
    if os.environ.get("KCAL_WRITE_DRAWN"):
        short = [[float(f"{value:.5g}") if isinstance(value, float) else value for value in entry] for entry in found]
        kept[name] = short
        lines = (f'"{key}": [\n' + ",\n".join(map(json.dumps, kept[key])) + "\n]" for key in sorted(kept))
        KEPT.write_text("{\n" + ",\n".join(lines) + "\n}\n")
    wanted = kept[name]
    assert [entry[0] for entry in found] == [entry[0] for entry in wanted]
    for entry, before in zip(found, wanted, strict=True):
        size = max((abs(value) for value in before if isinstance(value, float)), default=0.0)
        assert len(entry) == len(before)
        wrong = [(a, b) for a, b in zip(entry, before, strict=True) if not same(a, b, size)]
        assert not wrong, (before, wrong)
