"""Shared parts of all pictures: colors, axes of an image, magnified arrows, and files written whole."""

from __future__ import annotations

import io
import math
import textwrap
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import patheffects, rc_context
from matplotlib.axes import Axes
from matplotlib.backend_bases import RendererBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter
from numpy.typing import ArrayLike, NDArray

from kcal.files import check_picture, write_atomic
from kcal.texts import visible

INK, GRAY, FAINT, ACCENT, WARN = "#111827", "#4b5563", "#9aa3af", "#2b6cb0", "#c02a6b"
CAMERA_COLORS = ("#2b6cb0", "#dd7a1f", "#0f766e", "#7c3aed")


# Shared parts of all pictures: colors, axes of an image, magnified arrows, and files written whole.

# White around text that lies on lines.
HALO = [patheffects.withStroke(linewidth=2.5, foreground="white")]


class PlainFigure(Figure):
    """A figure whose texts are drawn as they are: matplotlib would read what stands between two `$` as mathematics.

    Names come from other people's files, and one that is no valid mathematics would stop the drawing.
    """

    def draw(self, renderer: RendererBase) -> None:
        """Draw everything; called by the canvas."""
        for axes in self.findobj(Axes):
            for axis in (axes.xaxis, axes.yaxis):
                # Names at ticks are written anew at each drawing, by a function.
                names = axis.get_major_formatter()
                if isinstance(names, FuncFormatter):
                    axis.set_major_formatter(partial(_shown_tick, names.func))
                # This makes the labels of ticks, which otherwise appear only while they are drawn.
                axis.get_ticklabels(which="both")
        for text in self.findobj(Text):
            text.set_parse_math(False)
            text.set_text(_shown(text.get_text()))
        with warnings.catch_warnings():
            # A character that the font does not have is drawn as a box.
            warnings.filterwarnings("ignore", r"Glyph \d+ .* missing from font")
            super().draw(renderer)


def _shown_tick(names: Callable[[float, int | None], str], at: float, place: int | None) -> str:
    return _shown(names(at, place))


def _shown(text: str) -> str:
    # No picture has room for more, and a text's pixels are all made before they are cut.
    return visible(text)[:2000]


def new_figure(width: float, height: float, dpi: int = 130, layout: Any = None) -> PlainFigure:
    """Make a figure of that many inches that belongs to no window and no global state."""
    figure = PlainFigure(figsize=(width, height), dpi=dpi, facecolor="white", layout=layout)
    FigureCanvasAgg(figure)
    return figure


def shortened(text: str, most: int) -> str:
    """A name of at most so many characters; of a longer one its end, which tells files apart.

    Example:
        >>> shortened("a/long/path/of/left.camera.json", 18)
        '…/left.camera.json'
    """
    return text if len(text) <= most else "…" + text[1 - most :]


def wrapped(text: str, inches: float, size: float) -> list[str]:
    """Lines of a text that fit into a width, at a font size in points; words longer than a line are divided.

    Example:
        >>> wrapped("RMS 0.19 px, largest 1.3 px, over the image", 2.0, 9.0)
        ['RMS 0.19 px, largest 1.3', 'px, over the image']
    """
    # A character is about 0.6 of the font's size wide.
    return textwrap.wrap(text, max(8, int(72.0 * inches / (0.6 * size)))) or [""]


def plain_number(value: float, _: object = None) -> str:
    """Write a tick of a logarithmic axis without mathematics: 0.01, 10, 1000."""
    return f"{value:g}"


def frame_image(axes: Axes, size: tuple[int, int], margin: float = 0.0) -> None:
    """Show an image's pixels (width, height), v down, with a margin of that share of its size."""
    (width, height), (across, down) = size, (margin * size[0], margin * size[1])
    axes.set(xlim=(-0.5 - across, width - 0.5 + across), ylim=(height - 0.5 + down, -0.5 - down))
    axes.set(aspect="equal", xlabel="u, pixels", ylabel="v, pixels")


def draw_arrows(
    axes: Axes,
    places: NDArray[np.float64],
    arrows: NDArray[np.float64],
    wanted: float,
    *colors: ArrayLike,
    **style: Any,
) -> float:
    """Draw arrows (..., 2) at pixels (..., 2), magnified by the round factor at or below `wanted`; return it."""
    power = 10.0 ** math.floor(math.log10(wanted))
    scale = power * max(step for step in (1, 2, 5) if step * power <= wanted)
    across, down = np.moveaxis(scale * arrows, -1, 0)
    axes.quiver(places[..., 0], places[..., 1], across, down, *colors, angles="xy", scale_units="xy", scale=1, **style)
    return scale


def round_levels(low: float, high: float, least: int = 1) -> list[float]:
    """Values 1, 2, 5, 10, 20, ... from at or below one number to at or above another; `least` steps at least.

    Example:
        >>> round_levels(0.03, 0.3)
        [0.02, 0.05, 0.1, 0.2, 0.5]
    """
    steps = [step * 10.0**power for power in range(-7, 7) for step in (1, 2, 5)]
    first = max((i for i, step in enumerate(steps) if step <= low), default=0)
    last = next((i for i, step in enumerate(steps) if step >= high), len(steps) - 1)
    return steps[first : max(last, first + least) + 1]


def field_outline(
    foot: NDArray[np.float64], first: float, last: float, reach: float, count: int = 120
) -> NDArray[np.float64]:
    """(M, 2) outline of what a camera sees on a plan, from one azimuth clockwise to another (radians).

    Its straight sides have many points, because those of a camera beside the middle are curved on a logarithmic plan.
    """
    fan = np.linspace(first, first + (last - first) % (2.0 * math.pi), count)
    rim = foot + reach * np.stack([np.sin(fan), np.cos(fan)], -1)
    steps = np.concatenate([[0.0], np.geomspace(1e-4, 1.0, 60)])[:, None]
    return np.concatenate([foot + steps * (rim[0] - foot), rim, (foot + steps * (rim[-1] - foot))[::-1]])


def draw_north(axes: Axes, x: float) -> None:
    """Draw the arrow to the north, up, at a share of the width of axes."""
    arrow = {"arrowstyle": "-|>", "color": "#374151", "linewidth": 1.4}
    axes.annotate("", (x, 1.0), (x, 0.89), xycoords="axes fraction", arrowprops=arrow)
    axes.text(x, 0.88, "N", transform=axes.transAxes, ha="center", va="top", fontsize=11, color="#374151")


def save_picture(path: str | Path, figure: Figure) -> Path:
    """Write a figure as PNG, SVG or PDF, as the suffix says, atomically.

    Raises:
        InputError: a suffix other than .png, .svg and .pdf.
        FileError: the file cannot be written.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_picture(Path(folder, "empty.svg"), new_figure(1.0, 1.0)).name
        'empty.svg'
    """
    check_picture(path)
    return write_atomic(path, picture_bytes(figure, Path(path).suffix.lower()[1:]))


def picture_bytes(figure: Figure, kind: str = "png") -> bytes:
    """A figure as PNG, SVG or PDF."""
    data = io.BytesIO()
    # The same figure makes the same bytes: no file has a date, and an SVG no random names.
    with rc_context({"svg.hashsalt": "kcal"}):
        figure.savefig(data, format=kind, metadata={"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind))
    return data.getvalue()
