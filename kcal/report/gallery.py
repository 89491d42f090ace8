"""Draw a detection: every view with its corners, worst first, and where in the image corners were seen."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from kcal.calibrate.camera.advice import reached, unreached_share
from kcal.corners.images import read_gray, to_8bit
from kcal.corners.observations import Observations, View
from kcal.errors import FileError
from kcal.report.colors import ACCENT, INK, WARN
from kcal.report.figures import frame_image, new_figure, save_picture

_MOST_VIEWS = 24  # views in a gallery
_MOST_FAILED = 8  # failed images in it
_ACROSS = 4
_STANDS_OUT = 2.0  # predicted error of a view over the median
_THUMB = 480  # pixels of a view's longer side
_CELLS = 8  # of the coverage map along the image's longer side


class FailedImage(NamedTuple):
    """An image in which no board was found.

    Args:
        name: as in the observations' failures.
        path: of the image.
        reason: why, in words.
        rejected: (N, 2) corners found that are not used, NaN or none where nothing was found.
    """

    name: str
    path: Path
    reason: str
    rejected: Tensor | None = None


def gallery_figure(observations: Observations, failed: Sequence[FailedImage] = ()) -> Figure:
    """Draw the failed images with their reasons, then the views with their corners.

    A failed image shows the corners that were found in it and rejected. Views that stand out come first: those with
    corners left out, then those whose corners are predicted to be twice as uncertain as is usual here. The others
    follow in their order. Corner 0 is a ring and the first row a line, so that a board read from its other end is seen
    at once. At most 8 failed images and 24 views are shown; other failures are listed with their reasons.

    Args:
        observations: with the paths of their images; a view whose image is not there is drawn on gray.
        failed: images that gave no view, from `kcal.corners.detect.detect`.
    """
    order, standing_out = _order(observations.views)
    shown, drawn = order[:_MOST_VIEWS], failed[:_MOST_FAILED]
    across = max(1, min(_ACROSS, len(shown) + len(drawn)))
    down = max(1, math.ceil((len(shown) + len(drawn)) / across))
    width, height = observations.image_size
    names = {one.name for one in drawn}
    listed = [f"{failure.name}: {failure.reason}" for failure in observations.failures if failure.name not in names]
    listed = listed[:10]
    foot = 0.22 * len(listed) + 0.15
    gap = 0.32 + (0.35 if drawn else 0.0)  # room for reasons
    tall = down * (3.6 * height / width + gap) + 0.7 + foot
    figure = new_figure(3.6 * across + 0.3, tall, dpi=110)
    between = gap / (3.6 * height / width)
    grid = figure.add_gridspec(
        down, across, left=0.02, right=0.98, top=1 - 0.7 / tall, bottom=foot / tall, hspace=between, wspace=0.04
    )
    for place, one in enumerate(drawn):
        _draw_failed(figure.add_subplot(grid[place // across, place % across]), one, observations.image_size)
    for place, i in enumerate(shown, len(drawn)):
        _draw_view(figure.add_subplot(grid[place // across, place % across]), observations, observations.views[i])
    title = f"{len(observations.views)} views"
    if standing_out:
        title += "; the first stands out" if standing_out == 1 else f"; the first {standing_out} stand out"
    if len(order) > _MOST_VIEWS:
        title += f" ({_MOST_VIEWS} are shown)"
    if observations.failures:
        title += f"; without a board: {len(observations.failures)}"
    figure.text(0.02, 1 - 0.25 / tall, title, fontsize=13, color=INK, va="center")
    for row, text in enumerate(listed):
        figure.text(0.02, (foot - 0.15 - 0.22 * row) / tall, text[:130], fontsize=8, color=WARN, va="center")
    return figure


def coverage_figure(observations: Observations) -> Figure:
    """Draw where corners were seen, one color per view (the paper's Fig. 1), over how many views reached each part.

    Parts that no board reached are hatched: the lens model extrapolates there. Their share is the one that `kcal
    calibrate` and its report tell (`kcal.calibrate.camera.advice.unreached_share`).
    """
    width, height = observations.image_size
    pixels = observations.pixels().numpy()
    seen = np.isfinite(pixels).all(-1)
    columns = _CELLS if width >= height else max(1, round(_CELLS * width / height))
    rows = _CELLS if height > width else max(1, round(_CELLS * height / width))
    u, v = pixels[seen].T
    views = np.broadcast_to(np.arange(len(pixels))[:, None], seen.shape)[seen]
    cells = np.zeros((rows, columns))
    for view in range(len(pixels)):
        mine = views == view
        once, _, _ = np.histogram2d(
            v[mine], u[mine], bins=(rows, columns), range=((-0.5, height - 0.5), (-0.5, width - 0.5))
        )
        cells += once > 0
    figure = new_figure(9.0, 9.0 * height / width * 0.86 + 1.2)
    axes = figure.add_subplot()
    figure.subplots_adjust(left=0.07, right=0.99, bottom=0.09, top=0.9)
    axes.imshow(
        cells, cmap="Grays", vmin=0, vmax=2.5 * max(cells.max(), 1), extent=(-0.5, width - 0.5, height - 0.5, -0.5)
    )
    outside = ~reached(observations, 4 * 65, max(2, round(4 * 65 * height / width))).numpy()
    x, y = (
        np.linspace(-0.5, size - 0.5, count) for size, count in zip((width, height), outside.shape[::-1], strict=True)
    )
    if outside.any():
        hatched = axes.contourf(x, y, outside, levels=[0.5, 1.5], colors="none", hatches=["///"])
        hatched.set_edgecolor((WARN, 0.5))
        hatched.set_linewidth(0.0)
    axes.scatter(u, v, c=views, cmap="turbo", s=7, linewidths=0)
    frame_image(axes, observations.image_size)
    share = 100.0 * (1.0 - unreached_share(observations))
    axes.set_title(
        f"{len(pixels)} views, {int(seen.sum())} corners; boards reached {share:.0f} % of the image, hatched: not",
        fontsize=11,
        loc="left",
    )
    return figure


def save_gallery(path: str | Path, observations: Observations, failed: Sequence[FailedImage] = ()) -> Path:
    """Write a picture of failed images and of views with their corners as PNG or SVG; see `gallery_figure`."""
    return save_picture(path, gallery_figure(observations, failed))


def save_coverage(path: str | Path, observations: Observations) -> Path:
    """Write a picture of where in the image corners were seen as PNG or SVG; see `coverage_figure`."""
    return save_picture(path, coverage_figure(observations))


def _order(views: Sequence[View]) -> tuple[list[int], int]:
    """Indices of the views that stand out, the worst first, then of the others in their order; how many stand out."""
    sigmas = [_predicted_sigma(view) or 0.0 for view in views]
    limit = _STANDS_OUT * float(np.median(sigmas)) if sigmas else 0.0
    out = [i for i, view in enumerate(views) if view.pixels.count(None) or sigmas[i] > limit > 0]
    out.sort(key=lambda i: (views[i].pixels.count(None), sigmas[i]), reverse=True)
    return [*out, *(i for i in range(len(views)) if i not in out)], len(out)


def _predicted_sigma(view: View) -> float | None:
    """Root mean square of the corners' predicted standard deviations, px."""
    if view.covariance is None:
        return None
    traces = [0.5 * (spread[0] + spread[2]) for spread in view.covariance if spread is not None]
    return math.sqrt(sum(traces) / len(traces)) if traces else None


def _draw_view(axes: Axes, observations: Observations, view: View) -> None:
    width, height = observations.image_size
    whole = (-0.5, width - 0.5, height - 0.5, -0.5)
    axes.imshow(_thumbnail(view.image, (width, height)), cmap="gray", vmin=0, vmax=255, extent=whole)
    places = np.array([(math.nan, math.nan) if pixel is None else pixel for pixel in view.pixels])
    first = places[: observations.board.columns]
    axes.plot(first[:, 0], first[:, 1], color=ACCENT, linewidth=1.2)
    axes.scatter(places[:, 0], places[:, 1], s=9, color=WARN, linewidths=0)
    axes.scatter(places[:1, 0], places[:1, 1], s=60, facecolors="none", edgecolors=ACCENT, linewidths=1.6)
    frame_image(axes, (width, height))
    axes.set(xticks=[], yticks=[], xlabel="", ylabel="")
    sigma, unseen = _predicted_sigma(view), view.pixels.count(None)
    text = view.name if len(view.name) <= 34 else "…" + view.name[-33:]
    text += f"  σ {sigma:.3f} px" if sigma is not None else ""
    text += f"  {unseen} left out" if unseen else ""
    axes.set_title(text, fontsize=8.5, loc="left", pad=3, color=WARN if unseen else INK)


def _draw_failed(axes: Axes, failed: FailedImage, size: tuple[int, int]) -> None:
    width, height = size
    whole = (-0.5, width - 0.5, height - 0.5, -0.5)
    axes.imshow(_thumbnail(failed.path, size), cmap="gray", vmin=0, vmax=255, extent=whole)
    if failed.rejected is not None:
        u, v = failed.rejected.numpy().T
        axes.scatter(u, v, s=16, marker="x", color=WARN, linewidths=1.0)
    frame_image(axes, size)
    axes.set(xticks=[], yticks=[], xlabel="", ylabel="")
    for spine in axes.spines.values():
        spine.set(visible=True, color=WARN, linewidth=2.0)
    name = failed.name if len(failed.name) <= 34 else "…" + failed.name[-33:]
    text = textwrap.wrap(f"failed: {name}: {failed.reason}", 66)[:3]
    axes.set_title("\n".join(text), fontsize=7.5, loc="left", pad=3, color=WARN)


def _thumbnail(path: str | Path | None, size: tuple[int, int]) -> npt.NDArray[np.uint8]:
    """Subsample an image; gray where the file is missing or has another size."""
    gray = np.full((2, 2), 200, np.uint8)
    if path is None:
        return gray
    try:
        image = to_8bit(read_gray(path))
    except FileError:
        return gray
    if (image.shape[1], image.shape[0]) != size:
        return gray
    step = max(1, max(image.shape) // _THUMB)
    return image[step // 2 :: step, step // 2 :: step]
