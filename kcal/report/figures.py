"""What all pictures share: no global state, PNG files written whole."""

from __future__ import annotations

import io
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from kcal.errors import InputError
from kcal.files import write_atomic


def new_figure(width: float, height: float, dpi: int = 130) -> Figure:
    """A figure of so many inches that belongs to no window."""
    figure = Figure(figsize=(width, height), dpi=dpi, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def check_picture_format(path: str | Path) -> None:
    """Raise `InputError` unless `path` ends with .png."""
    if Path(path).suffix.lower() != ".png":
        raise InputError(f"{path}: the picture is a PNG; the file name must end with .png")


def save_png(path: str | Path, figure: Figure) -> Path:
    """Write a figure as PNG, atomically.

    Raises:
        InputError: a suffix other than .png.
        FileError: the file cannot be written.
    """
    check_picture_format(path)
    data = io.BytesIO()
    figure.savefig(data, format="png")
    return write_atomic(path, data.getvalue())
