"""Shared parts of all pictures: colors, axes of an image, magnified arrows, and files written whole."""

from __future__ import annotations

import dataclasses
import io
import math
import textwrap
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib import patheffects, rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backend_bases import RendererBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import BoundaryNorm, Colormap
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure, SubFigure
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from kcal.files import check_picture, write_atomic
from kcal.texts import visible

INK, GRAY, FAINT, ACCENT, WARN = "#111827", "#4b5563", "#9aa3af", "#2b6cb0", "#c02a6b"
CAMERA_COLORS = ("#2b6cb0", "#dd7a1f", "#0f766e", "#7c3aed")

# White around text that lies on lines.
HALO = [patheffects.withStroke(linewidth=2.5, foreground="white")]


class PlainFigure(Figure):
    """A figure whose texts are drawn as they are: matplotlib would read what stands between two `$` as mathematics.

    Names come from other people's files, and one that is no valid mathematics would stop the drawing.
    """

    def _repr_png_(self) -> bytes:
        return picture_bytes(self)

    def draw(self, renderer: RendererBase) -> None:
        """Draw everything; called by the canvas."""
        _make_plain(self)
        with warnings.catch_warnings():
            # A character that the font does not have is drawn as a box.
            warnings.filterwarnings("ignore", r"Glyph \d+ .* missing from font")
            super().draw(renderer)


def finished(axes: Axes) -> Figure:
    """Let the texts of a panel be drawn as they are, also in a figure of the caller's; the figure around it."""
    _make_plain(axes)
    return whole(axes.figure)


def whole(figure: Figure | SubFigure) -> Figure:
    """The figure that a part belongs to."""
    root = figure.figure
    assert isinstance(root, Figure)
    return root


def _make_plain(parts: Artist) -> None:
    for part in parts.findobj(lambda each: isinstance(each, Text | Axis)):
        if isinstance(part, Text):
            part.set_parse_math(False)
            part.set_text(_shown(part.get_text()))
        # Names at ticks are written anew at each drawing, by a function.
        elif (
            isinstance(part, Axis)
            and isinstance(names := part.get_major_formatter(), FuncFormatter)
            and getattr(names.func, "func", None) is not _shown_tick
        ):
            part.set_major_formatter(partial(_shown_tick, names.func))


def _shown_tick(names: Callable[[float, int | None], str], at: float, place: int | None) -> str:
    return _shown(names(at, place))


def _shown(text: str) -> str:
    # No picture has room for more, and a text's pixels are all made before they are cut.
    return visible(text)[:2000]


def new_figure(width: float, height: float, dpi: int = 130) -> PlainFigure:
    """Make a figure of that many inches that belongs to no window and no global state."""
    figure = PlainFigure(figsize=(width, height), dpi=dpi, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def framed_figure(
    width: float, height: float, title: str = "", notes: Sequence[str] = (), dpi: int = 130, into: Any = None
) -> Any:
    """Make a figure with a title above and notes below, whose axes, labels and color bars share the room between.

    Args:
        width: inches.
        height: inches of the axes with their labels; title and notes add to it.
        title: broken into lines where it is too long.
        notes: sentences, likewise.
        dpi: pixels of an inch.
        into: a figure or subfigure of the caller's to draw into instead, which keeps its size and layout.
    """
    head = wrapped(title, width - 0.3, 13.0) if title else []
    foot = [line for note in notes for line in wrapped(note, width - 0.3, 9.0)]
    figure = into
    if into is None:
        figure = new_figure(width, height + 0.26 * len(head) + 0.18 * len(foot), dpi)
        figure.set_layout_engine("constrained", w_pad=0.08, h_pad=0.08)
    if head:
        figure.suptitle("\n".join(head), x=0.1 / width, ha="left", fontsize=13, color=INK)
    if foot:
        figure.supxlabel("\n".join(foot), x=0.1 / width, ha="left", fontsize=9, color=GRAY)
    return figure


def one_panel(ax: Axes | None, width: float, height: float, title: str = "", notes: Sequence[str] = ()) -> Axes:
    """Make a framed figure with one panel; or take the caller's panel, which gets the title, and no notes."""
    if ax is None:
        return framed_figure(width, height, title, notes).add_subplot()
    lines = wrapped(title, 0.8 * ax.get_window_extent().width / ax.figure.dpi, 10.0)
    ax.set_title("\n".join(lines), fontsize=10, loc="left")
    return ax


def image_panel(ax: Axes | None, size: tuple[int, int], title: str = "", notes: Sequence[str] = ()) -> Axes:
    """The same for a panel of the shape of an image."""
    if ax is None:
        return image_figure(size, 1, title, notes)[1][0]
    frame_image(one_panel(ax, 0.0, 0.0, title), size)
    return ax


def image_figure(
    size: tuple[int, int], count: int = 1, title: str = "", notes: Sequence[str] = (), narrow: bool = False
) -> tuple[PlainFigure, list[Axes]]:
    """Make a figure with axes of the shape of an image, side by side.

    Args:
        size: width and height of the image, pixels.
        count: of axes.
        title: above all.
        notes: below all.
        narrow: for a phone; axes stand one below the other, and letters are larger.
    """
    wide = 2.9 if narrow else 5.2 if count > 1 else 7.4
    tall = min(wide * size[1] / size[0], 8.0)
    wide = tall * size[0] / size[1]
    across, down = (1, count) if narrow else (count, 1)
    least = max(wide, 2.6 if narrow else 4.2)
    figure = framed_figure((least + 0.75) * across + 0.75, (tall + 0.9) * down, title, notes, 160 if narrow else 130)
    panels = list(figure.subplots(down, across, squeeze=False).flat)
    for axes in panels:
        frame_image(axes, size)
    return figure, panels


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


def frame_image(axes: Axes, size: tuple[int, int]) -> None:
    """Show an image's pixels (width, height), v down."""
    axes.set(xlim=(-0.5, size[0] - 0.5), ylim=(size[1] - 0.5, -0.5))
    axes.set(aspect="equal", xlabel="u, pixels", ylabel="v, pixels")


def draw_arrows(
    axes: Axes,
    places: NDArray[np.float64],
    arrows: NDArray[np.float64],
    scale: float,
    unit: str = "px",
    *colors: ArrayLike,
    **style: Any,
) -> None:
    """Draw magnified arrows (..., 2) at places (..., 2), and a scale bar above the axes, whose ends must be set."""
    style = style if colors else {"color": INK} | style
    moved = (scale * arrows).reshape(-1, 2).T
    drawn = axes.quiver(*places.reshape(-1, 2).T, *moved, *colors, angles="xy", scale_units="xy", scale=1, **style)
    left, right = axes.get_xlim()
    room = 0.12 * abs(right - left) / scale
    power = 10.0 ** math.floor(math.log10(room))
    length = power * max(step for step in (1, 2, 5) if step * power <= room)
    key = {"labelpos": "W", "color": INK, "labelcolor": INK, "fontproperties": {"size": 9}}
    axes.quiverkey(drawn, 0.87, 1.04, scale * length, f"{length:g} {unit}", **key)


def draw_values(
    axes: Axes,
    places: NDArray[np.float64],
    values: NDArray[np.float64],
    levels: Sequence[float],
    cmap: str | Colormap = "viridis_r",
    extend: Literal["neither", "both", "min", "max"] = "neither",
) -> ContourSet:
    """Draw values (R, C) at places (R, C, 2) as steps of color that are told apart alike, whatever the levels."""
    norm = BoundaryNorm(levels, 256, extend=extend)
    return axes.contourf(places[..., 0], places[..., 1], values, levels=levels, cmap=cmap, norm=norm, extend=extend)


def add_color_bar(drawn: Any, axes: Axes, label: str, **style: Any) -> None:
    """Add what colors mean, with its unit, to the right of axes and as high as they are."""
    beside = axes.inset_axes((1.02, 0.0, 0.03, 1.0))
    axes.figure.colorbar(drawn, cax=beside, **{"format": "%g", **style}).set_label(label, color=INK)


def name_point(axes: Axes, place: ArrayLike, name: str, beside: tuple[float, float] = (6, 0), **style: Any) -> None:
    """Write a name beside a point, so many typographic points to the right and up, where lines do not hide it."""
    side = "left" if beside[0] >= 0 else "right"
    style = {"fontsize": 9, "va": "center", "ha": side, "path_effects": HALO, **style}
    x, y = np.asarray(place, float).tolist()
    axes.annotate(shortened(name, 40), (x, y), beside, textcoords="offset points", **style)


def draw_way(axes: Axes, start: ArrayLike, end: ArrayLike, color: str, head: str = "-|>", **style: Any) -> None:
    """Draw an arrow from one point to another."""
    way = {"arrowstyle": head, "color": color, "shrinkA": 0, "shrinkB": 0, **style}
    axes.annotate("", np.asarray(end, float).tolist(), np.asarray(start, float).tolist(), arrowprops=way, zorder=8)


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


@dataclasses.dataclass(frozen=True, kw_only=True)
class RangeScale:
    """A plan on which directions are true, and ranges from its middle are log(1 + range / near), or true too.

    Args:
        nearest: meters of the nearest object.
        rim: meters of what is drawn at 1 and farthest.
        middle: (2,) east and north of the middle.
        true: whether ranges are true.
    """

    nearest: float
    rim: float
    middle: NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.zeros(2))
    true: bool = False

    def radius(self, meters: float | NDArray[np.float64]) -> NDArray[np.float64]:
        """Of ranges, on the plan."""
        meters = np.minimum(meters, self.rim)
        near = max(self.nearest / 2.0, self.rim / 1000.0)
        return np.asarray(meters / self.rim if self.true else np.log1p(meters / near) / math.log1p(self.rim / near))

    def place(self, enu: NDArray[np.float64]) -> NDArray[np.float64]:
        """(..., 2) on the plan of (..., 2 or more) east and north in meters."""
        offset = enu[..., :2] - self.middle
        distance = np.hypot(offset[..., 0], offset[..., 1])[..., None]
        return np.asarray(offset / np.maximum(distance, 1e-9) * self.radius(distance))


def draw_field(axes: Axes, outline: NDArray[np.float64], color: str) -> None:
    """Draw the (M, 2) outline of what a camera sees on a plan."""
    axes.fill(*outline.T, facecolor=color, alpha=0.08, edgecolor="none", zorder=0)
    axes.plot(*outline.T, color=color, alpha=0.5, linewidth=0.9, zorder=1)


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
    if kind == "png" and isinstance(figure.canvas, FigureCanvasAgg):
        # `savefig` draws twice.
        figure.canvas.draw()
        image = Image.fromarray(np.asarray(figure.canvas.buffer_rgba()))
        image.save(data, "png", dpi=(figure.dpi, figure.dpi))
        return data.getvalue()
    # The same figure makes the same bytes: no file has a date, and an SVG no random names.
    with rc_context({"svg.hashsalt": "kcal"}):
        figure.savefig(data, format=kind, metadata={"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind))
    return data.getvalue()
