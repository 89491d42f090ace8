"""Pictures of a calibration, its board, its intervals, and of the views that it is made of."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import NDArray
from torch import Tensor

import kcal.report.figures as figures
from kcal.calibrate.camera.advice import board_tilts, reached, unreached_share
from kcal.calibrate.camera.at_setting import ComparisonResult
from kcal.calibrate.camera.calibrate import CameraCalibrationResult
from kcal.calibrate.camera.export import Misfit
from kcal.calibrate.camera.trust import Examination, IntervalCheck
from kcal.calibrate.hybrid.measured_board import MeasuredBoard, board_text
from kcal.corners.images import read_gray, to_8bit
from kcal.corners.observations import Observations, View
from kcal.errors import FileError
from kcal.lens.difference import CameraDifference, difference_text
from kcal.lens.uncertainty import image_sigma
from kcal.texts import percent_text
from kcal.threads import in_one_thread

# Draw a calibration: where the board was seen, the residuals, and the RMS of each view.

# Of boards that are far, dark, to those that are near.
_NEAR_COLORS = LinearSegmentedColormap.from_list("near", [figures.INK, figures.ACCENT, "#e08214"])
# Of a view's RMS: pale below the median, blue at the median, magenta from twice the median on.
_RMS_COLORS = LinearSegmentedColormap.from_list("rms", ["#bcd6ee", figures.ACCENT, figures.WARN])


@in_one_thread
def calibration_figure(
    result: CameraCalibrationResult, name: str = "", figure: Figure | SubFigure | None = None
) -> Figure:
    """Draw a calibration: coverage with magnified residuals, uncertainty over the image, residuals, RMS of each view.

    Args:
        result: from `calibrate_camera`.
        name: of the camera, for the title.
        figure: of yours, or a part of it, to draw into.

    Returns:
        A matplotlib figure that belongs to no window and no global state; its four axes may be changed.

    Source:
        Coverage is Fig. 1 of the paper.

    Example:
        >>> import torch
        >>> from kcal import Board, CalibrationOptions, Camera, Observations, View, calibrate_camera
        >>> from kcal.lens import rotation_from_vector
        >>> camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), coefficients=[-0.2, 0.05])
        >>> board, views = Board(columns=7, rows=6, square=0.05), []
        >>> for turn in ((0.5, 0, 0), (-0.5, 0, 0.2), (0, 0.5, 0), (0, -0.5, 0.1), (0.3, 0.3, 1.5)):
        ...     rotation = rotation_from_vector(torch.tensor(turn).double())
        ...     pixels, _ = camera.project((board.points - board.points.mean(0)) @ rotation.T + torch.eye(3)[2] * 0.7)
        ...     pixels = pixels + 0.1 * torch.sin(1e3 * pixels)  # noise, of a kind
        ...     views.append(View(name=f"{len(views)}.png", pixels=tuple(map(tuple, pixels.tolist()))))
        >>> seen = Observations(board=board, image_size=camera.size, views=tuple(views))
        >>> result = calibrate_camera(seen, CalibrationOptions(model="opencv4"))
        >>> figure = calibration_figure(result)
        >>> figure.savefig("camera.svg")  # doctest: +SKIP
        >>> len(figure.axes)
        4
    """
    model = "" if result.hybrid is not None else f", model {result.camera.model}"
    whose = f"{figures.shortened(name, 60)}: " if name else ""
    total = len(result.observations.views)
    used = total - len({view.view for view in result.rejected_views})
    views = f"{used} of {total} views" if used < total else f"{total} views"
    width, height = result.observations.image_size
    tall = min(5.9 * height / width, 8.0)
    title = f"{whose}{views}{model}, RMS {result.rms:.3f} px"
    figure = figures.framed_figure(13.5, tall + 4.4, title, into=figure)
    above, below = np.asarray(figure.subfigures(2, 1, height_ratios=(tall + 0.9, 3.5)))
    images, bars = above.subplots(1, 2), below.subplots(1, 2, width_ratios=(1.0, 2.4))
    draw_coverage(images[0], result)
    draw_uncertainty(images[1], result)
    draw_residuals(bars[0], result)
    draw_view_rms(bars[1], result)
    return figures.whole(figure)


def draw_coverage(axes: Axes, result: CameraCalibrationResult) -> None:
    """Draw corners and magnified residuals in the colors of their views' RMS."""
    width = result.observations.image_size[0]
    figures.frame_image(axes, result.observations.image_size)
    pixels = result.observations.pixels().numpy()
    errors = -result.residuals.numpy()
    # Views that were left out have corners and no residuals.
    seen = np.isfinite(pixels + errors).all(-1)
    where, error = pixels[seen], errors[seen]
    rms = np.broadcast_to(result.per_view_rms.numpy()[:, None], seen.shape)[seen]
    norm = _rms_norm(result)
    # A typical residual is drawn as long as a sixtieth of the image.
    wanted = width / 60 / max(float(np.sqrt(np.mean(error**2))), 1e-9)
    figures.draw_arrows(axes, where, error, wanted, "px", rms, cmap=_RMS_COLORS, norm=norm, width=0.002)
    drawn = axes.scatter(where[:, 0], where[:, 1], c=rms, cmap=_RMS_COLORS, norm=norm, s=4, linewidths=0)
    grid = result.camera.grid(97, 73)
    valid = result.camera.unproject(grid)[1].numpy()
    if not valid.all():
        axes.contourf(*grid.unbind(-1), ~valid, levels=[0.5, 1.5], colors=[figures.WARN], alpha=0.25)
        axes.text(0.02, 0.02, "shaded: no valid ray", transform=axes.transAxes, color=figures.WARN, fontsize=9)
    figures.add_color_bar(drawn, axes, "RMS of the view, px", extend="max")
    axes.set_title("Corners and residuals", fontsize=10, loc="left")


def _rms_norm(result: CameraCalibrationResult) -> Normalize:
    """Twice the median and more has the color of a warning."""
    return Normalize(0.0, 2.0 * max(float(np.nanmedian(result.per_view_rms.numpy())), 1e-12), clip=True)


def draw_uncertainty(axes: Axes, result: CameraCalibrationResult) -> None:
    """Draw σ of the image of distant points."""
    width, height = result.observations.image_size
    figures.frame_image(axes, (width, height))
    known = result.camera.calibration
    if known is None or known.known(result.camera.params) is None:
        axes.set_title("No covariance: σ in the image is not known", fontsize=10, loc="left")
        return
    columns, rows = 65, max(2, round(65 * height / width))
    sigma = image_sigma(result.camera, columns, rows).numpy()
    places = result.camera.grid(columns, rows).numpy()
    good = np.isfinite(sigma)
    low, high = np.quantile(sigma[good], [0.0, 0.98])
    levels = figures.round_levels(max(low, 1e-6), max(high, 2e-6))
    shown = figures.draw_values(axes, places, np.where(good, sigma, np.nan), levels, extend="both")
    lines = axes.contour(places[..., 0], places[..., 1], sigma, levels=levels, colors="white", linewidths=0.6)
    axes.clabel(lines, fontsize=8, fmt="%g")
    _draw_reached(axes, result.observations)
    axes.set_title("Uncertainty; dashed: boards' reach", fontsize=10, loc="left")
    figures.add_color_bar(shown, axes, "σ in the image, px")


def _draw_reached(axes: Axes, observations: Observations) -> None:
    """Outline the part of the image in which boards were seen."""
    width, height = observations.image_size
    seen = reached(observations, 256, max(2, round(256 * height / width))).numpy()
    if not seen.all():
        columns, rows = (np.linspace(-0.5, n - 0.5, count) for n, count in ((width, 256), (height, len(seen))))
        axes.contour(columns, rows, seen, levels=[0.5], colors=figures.INK, linewidths=1.0, linestyles="dashed")


def draw_residuals(axes: Axes, result: CameraCalibrationResult) -> None:
    """Draw all residuals beside a circular Gaussian."""
    error = -result.residuals.numpy().reshape(-1, 2)
    error = error[np.isfinite(error).all(-1)]
    sigma = float(np.sqrt(np.mean(error**2)))
    limit = max(5.0 * sigma, 1e-9)
    axes.scatter(error[:, 0], error[:, 1], s=5, color=figures.ACCENT, alpha=0.45, linewidths=0)
    turn = np.linspace(0, 2 * np.pi, 200)
    # 95 % of a circular Gaussian lie within 2.45 σ.
    axes.plot(2.448 * sigma * np.cos(turn), 2.448 * sigma * np.sin(turn), color=figures.INK, linewidth=1)
    outside = float(np.mean(np.hypot(*error.T) > 2.448 * sigma))
    axes.axhline(0, color=figures.FAINT, linewidth=0.6)
    axes.axvline(0, color=figures.FAINT, linewidth=0.6)
    axes.set(xlim=(-limit, limit), ylim=(limit, -limit), aspect="equal", xlabel="u, pixels", ylabel="v, pixels")
    axes.locator_params(nbins=5)
    axes.set_title(f"Residuals: σ {sigma:.3f} px per axis", fontsize=10, loc="left")
    text = f"{100 * outside:.1f} % outside the 95 % circle"
    axes.text(
        0.03, 0.97, text, transform=axes.transAxes, fontsize=9, color=figures.INK, va="top", path_effects=figures.HALO
    )


def draw_view_rms(axes: Axes, result: CameraCalibrationResult) -> None:
    """Draw the RMS of each view as bars."""
    rms = result.per_view_rms.numpy()
    place = np.arange(len(rms))
    axes.bar(place, rms, color=_RMS_COLORS(_rms_norm(result)(rms)), width=0.8)
    axes.axhline(float(np.nanmedian(rms)), color=figures.INK, linewidth=0.8)
    axes.set_ylabel("RMS, pixels")
    axes.set_title("RMS of each view; line: median", fontsize=10, loc="left")
    if len(rms) <= 40:
        names = [name.rsplit(".", 1)[0] for name in result.observations.names]
        axes.set_xticks(place, [figures.shortened(name, 20) for name in names], rotation=90, fontsize=7)
    else:
        axes.set_xlabel("view")


# Draw a measured board: heights as colors, print errors as magnified arrows.

_ACROSS = 160
# What is below this (mm) is not worth full colors and long arrows.
_LEAST = 0.01


def board_figure(board: MeasuredBoard, ax: Axes | None = None) -> Figure:
    """Draw heights over the best plane and in-plane displacements from the best fit of the ordered board."""
    corners = 1e3 * board.board.points
    low, high = corners[:, :2].amin(0), corners[:, :2].amax(0)
    wide, tall = (high - low).tolist()
    down = max(2, round(_ACROSS * tall / wide))
    x = torch.linspace(float(low[0]), float(high[0]), _ACROSS, dtype=torch.float64)
    y = torch.linspace(float(low[1]), float(high[1]), down, dtype=torch.float64)
    places = torch.nn.functional.pad(torch.cartesian_prod(y, x).flip(-1), (0, 1))
    heights = 1e3 * board.displacements(1e-3 * places)[:, 2].view(down, _ACROSS).numpy()
    moved = 1e3 * board.displacements()[:, :2].numpy()
    square = 1e3 * board.board.square
    head = [*board_text(board), "colors: height over the best plane; arrows: displacement in the plane"]
    tall_inches = min(9.0, 7.0 * (tall + 2 * square) / (wide + 2 * square)) + 0.8
    axes = figures.one_panel(ax, 9.0, tall_inches, f"{board.name}: {board.board}", head)
    most = max(float(np.abs(heights).max()), _LEAST)
    levels = MaxNLocator(nbins=20, symmetric=True).tick_values(-1.0001 * most, 1.0001 * most)
    drawn = figures.draw_values(axes, places.view(down, _ACROSS, 3).numpy(), heights, list(levels), "RdBu_r")
    figures.add_color_bar(drawn, axes, "height, mm (positive: away from the cameras)", ticks=levels[::2])
    axes.plot(corners[:, 0], corners[:, 1], ".", color=figures.GRAY, markersize=3)
    longest = max(float(np.linalg.norm(moved, axis=-1).max()), _LEAST)
    axes.set(xlim=(low[0] - square, high[0] + square), ylim=(high[1] + square, low[1] - square), aspect="equal")
    axes.set(xlabel="x, mm", ylabel="y, mm")
    # The longest arrow is nearly as long as the corners are apart.
    figures.draw_arrows(axes, corners[:, :2].numpy(), moved, 0.9 * square / longest, "mm", width=0.0028)
    axes.spines[["top", "right"]].set_visible(False)
    return figures.finished(axes)


def models_figure(compared: ComparisonResult, title: str = "", ax: Axes | None = None) -> Figure:
    """Draw the held-out RMS of each model, the best first, with the standard error of its difference from the best."""
    ranked = [entry for entry in compared.ranking if math.isfinite(entry[1])]
    names, rms, _, error = zip(*ranked, strict=True)
    axes = figures.one_panel(ax, 7.6, 1.1 + 0.45 * len(ranked), title)
    axes.axvline(rms[0], color=figures.FAINT, linewidth=0.8)
    axes.errorbar(rms, range(len(ranked)), xerr=error, fmt="o", color=figures.ACCENT, capsize=4)
    axes.set_yticks(range(len(ranked)), names)
    axes.set(
        ylim=(len(ranked) - 0.5, -0.5),
        xlabel="held-out RMS, px (bars: ± standard error of the difference from the best)",
    )
    axes.spines[["top", "right"]].set_visible(False)
    return figures.finished(axes)


# Draw where stated intervals contain the truth: maps of the image, from repeated captures.

_MOST = 3  # ranges that are drawn
# What 95 % intervals should have is blue, and 90 % in the middle of the colors.
_LEVELS = [0.0, 0.5, 0.7, 0.8, 0.85, 0.9, 0.925, 0.95, 0.975, 1.0]


def range_label(at: float) -> str:
    """A range in words: "1000 m", or "far away".

    Example:
        >>> range_label(1000.0), range_label(math.inf)
        ('1000 m', 'far away')
    """
    return "far away" if math.isinf(at) else f"{at:g} m"


def interval_figure(check: IntervalCheck, observations: Observations, title: str = "") -> Figure:
    """Draw the share of refits whose error is within the stated 95 % ellipse, at up to three ranges.

    Args:
        check: the comparison.
        observations: the capture; what its boards reached is outlined.
        title: above the maps.
    """
    shown = list(zip(check.ranges, check.coverage, check.shares, strict=True))[:_MOST]
    notes = [f"Share of {len(check.errors)} refits within the stated 95 % ellipse. Dashed: where boards were seen."]
    figure, panels = figures.image_figure(observations.image_size, len(shown), title, notes)
    for axes, (at, coverage, (share, error)) in zip(panels, shown, strict=True):
        drawn = figures.draw_values(axes, check.pixels.numpy(), coverage.numpy(), _LEVELS, "RdYlBu")
        _draw_reached(axes, observations)
        axes.set_title(f"{range_label(at)}: {100 * share:.1f} ± {100 * error:.1f} %", fontsize=10, loc="left")
    percent = FuncFormatter(lambda value, _: f"{100 * value:g} %")
    figures.add_color_bar(drawn, panels[-1], "share of refits (95 % is right)", format=percent, ticks=_LEVELS)
    return figure


# Draw a detection: every view with its corners, worst first, and where in the image corners were seen.

_MOST_VIEWS = 24  # views in a gallery
_MOST_FAILED = 8  # failed images in it
_VIEWS_ACROSS = 4
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
    tiles: list[FailedImage | View] = [*failed[:_MOST_FAILED], *(observations.views[i] for i in order[:_MOST_VIEWS])]
    across = max(1, min(_VIEWS_ACROSS, len(tiles)))
    down = max(1, math.ceil(len(tiles) / across))
    width, height = observations.image_size
    names = {one.name for one in failed[:_MOST_FAILED]}
    unshown = (failure for failure in observations.failures if failure.name not in names)
    listed = [f"{failure.name}: {failure.reason}"[:130] for failure in unshown]
    title = f"{len(observations.views)} views"
    if standing_out:
        title += "; the first stands out" if standing_out == 1 else f"; the first {standing_out} stand out"
    if len(order) > _MOST_VIEWS:
        title += f" ({_MOST_VIEWS} are shown)"
    if observations.failures:
        title += f"; without a board: {len(observations.failures)}"
    gap = 0.7 if failed else 0.35  # room for reasons
    figure = figures.framed_figure(3.6 * across + 0.3, down * (3.5 * height / width + gap), title, listed[:10], 110)
    for place, tile in enumerate(tiles, 1):
        axes = figure.add_subplot(down, across, place)
        if isinstance(tile, View):
            _draw_view(axes, observations, tile)
        else:
            _draw_failed(axes, tile, observations.image_size)
    return figure


def coverage_figure(observations: Observations, ax: Axes | None = None) -> Figure:
    """Draw where corners were seen, in colors for near and far boards, over how many views reached each part.

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
    count = max(len(pixels), 1)
    ends = [(-0.5, size - 0.5) for size in (count, height, width)]
    cells = (np.histogramdd((views, v, u), (count, rows, columns), ends)[0] > 0).sum(0, dtype=float)
    share = percent_text(1.0 - unreached_share(observations))
    title = f"{len(pixels)} views, {int(seen.sum())} corners; boards reached {share} of the image, hatched: not"
    axes = figures.image_panel(ax, (width, height), title, ["Gray: how many views reached a part of the image."])
    whole = (-0.5, width - 0.5, height - 0.5, -0.5)
    axes.imshow(cells, cmap="Grays", vmin=0, vmax=2.5 * max(cells.max(), 1), extent=whole)
    outside = ~reached(observations, 4 * 65, max(2, round(4 * 65 * height / width))).numpy()
    if outside.any():
        x, y = (np.linspace(-0.5, n - 0.5, m) for n, m in zip((width, height), outside.shape[::-1], strict=True))
        hatched = axes.contourf(x, y, outside, levels=[0.5, 1.5], colors="none", hatches=["///"])
        hatched.set_edgecolor((figures.WARN, 0.5))
        hatched.set_linewidth(0.0)
    apart = _spacing(observations)[views]
    drawn = axes.scatter(u, v, c=apart, cmap=_NEAR_COLORS, s=9, linewidths=0)
    figures.add_color_bar(drawn, axes, "distance between corners, px (large: board near)")
    return figures.finished(axes)


def _spacing(observations: Observations) -> NDArray[np.float64]:
    """(V,) median distance of neighboring corners of each view, px."""
    pixels = observations.pixels().numpy()
    rows = pixels[:, : observations.board.corners].reshape(len(pixels), -1, observations.board.columns, 2)
    apart = np.linalg.norm(np.diff(rows, axis=2), axis=-1).reshape(len(pixels), -1)
    known = [row[np.isfinite(row)] for row in apart]
    return np.array([np.median(row) if len(row) else 1.0 for row in known])


def _order(views: Sequence[View]) -> tuple[list[int], int]:
    """Indices of the views that stand out, the worst first, then of the others in their order; how many stand out."""
    sigmas = [_predicted_sigma(view) or 0.0 for view in views]
    limit = _STANDS_OUT * float(np.median(sigmas)) if sigmas else 0.0
    out = [i for i, view in enumerate(views) if not view.seen.all() or sigmas[i] > limit > 0]
    out.sort(key=lambda i: (int((~views[i].seen).sum()), sigmas[i]), reverse=True)
    return [*out, *(i for i in range(len(views)) if i not in out)], len(out)


def _predicted_sigma(view: View) -> float | None:
    """Root mean square of the corners' predicted standard deviations, px."""
    if view.covariance is None:
        return None
    traces = [0.5 * (spread[0] + spread[2]) for spread in view.covariance if spread is not None]
    return math.sqrt(sum(traces) / len(traces)) if traces else None


def _draw_tile(axes: Axes, path: str | Path | None, size: tuple[int, int], title: str, color: str) -> None:
    whole = (-0.5, size[0] - 0.5, size[1] - 0.5, -0.5)
    axes.imshow(_thumbnail(path, size), cmap="gray", vmin=0, vmax=255, extent=whole)
    figures.frame_image(axes, size)
    axes.set(xticks=[], yticks=[], xlabel="", ylabel="")
    axes.set_title(title, fontsize=8, loc="left", pad=3, color=color)


def _draw_view(axes: Axes, observations: Observations, view: View) -> None:
    sigma, unseen = _predicted_sigma(view), int((~view.seen).sum())
    text = figures.shortened(view.name, 34) + (f"  σ {sigma:.3f} px" if sigma is not None else "")
    text += f"  {unseen} left out" if unseen else ""
    _draw_tile(axes, view.image, observations.image_size, text, figures.WARN if unseen else figures.INK)
    places = view.places
    axes.plot(*places[: observations.board.columns].T, color=figures.ACCENT, linewidth=1.2)
    axes.scatter(places[:, 0], places[:, 1], s=9, color=figures.WARN, linewidths=0)
    axes.scatter(places[:1, 0], places[:1, 1], s=60, facecolors="none", edgecolors=figures.ACCENT, linewidths=1.6)


def _draw_failed(axes: Axes, failed: FailedImage, size: tuple[int, int]) -> None:
    text = textwrap.wrap(f"failed: {figures.shortened(failed.name, 34)}: {failed.reason}", 62)[:3]
    _draw_tile(axes, failed.path, size, "\n".join(text), figures.WARN)
    if failed.rejected is not None:
        u, v = failed.rejected.numpy().T
        axes.scatter(u, v, s=16, marker="x", color=figures.WARN, linewidths=1.0)
    for spine in axes.spines.values():
        spine.set(visible=True, color=figures.WARN, linewidth=2.0)


def _thumbnail(path: str | Path | None, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Subsample an image; gray where the file is missing or has another size."""
    with suppress(FileError):
        if path is not None and (image := to_8bit(read_gray(path))).shape[::-1] == size:
            step = max(1, max(image.shape) // _THUMB)
            return image[step // 2 :: step, step // 2 :: step]
    return np.full((2, 2), 200, np.uint8)


# Draw how differently two lenses see: a map of the difference with magnified arrows, and of its error bars.

# Arrows per row of the picture, at most.
_ARROWS = 17


def difference_figure(
    found: CameraDifference | Misfit, title: str = "", lines: list[str] | None = None, narrow: bool = False
) -> Figure:
    """Draw the shift as colors and magnified arrows; beside it, in the same colors, its σ if there is one.

    Args:
        found: two cameras compared, or the misfit of an exported lens.
        title: above all.
        lines: below; those that sum it up if left out.
        narrow: for a phone.
    """
    if isinstance(found, CameraDifference):
        sigma, told = found.sigma, difference_text(found)
    else:
        sigma, told = None, [f"{found.model}: RMS {found.rms:.4g} px, largest {found.largest:.4g} px, at infinity"]
    low, high = (value.flatten(0, 1) for value in (found.pixels.amin((0, 1), True), found.pixels.amax((0, 1), True)))
    width, height = (round(float(value)) for value in (high - low)[0] + (1.0 if float(low[0, 0]) >= 0 else 0.0))
    sizes = [found.length.numpy()] + ([sigma.numpy()] if sigma is not None else [])
    figure, panels = figures.image_figure((width, height), len(sizes), title, told if lines is None else lines, narrow)
    places = found.pixels.numpy()
    most = max(float(np.nanmax(values)) for values in sizes)
    least = min(float(np.nanquantile(values, 0.05)) for values in sizes)
    levels = figures.round_levels(max(least, most / 1000.0, 1e-7), max(most, 1e-6), least=3)
    for axes, values in zip(panels, sizes, strict=True):
        drawn = figures.draw_values(axes, places, values, levels, extend="min")
        if narrow or axes is panels[-1]:
            figures.add_color_bar(drawn, axes, "px, on a logarithmic scale", ticks=levels)
    step = max(1, math.ceil(places.shape[1] / _ARROWS))
    # The border is no place for an arrow: half of those would be outside.
    shown = np.nan_to_num(found.shift.numpy())[step // 2 :: step, step // 2 :: step]
    longest = float(np.linalg.norm(shown, axis=-1).max())
    # Of a camera and itself, rounding alone is left.
    if longest > 1e-6:
        wanted = 1.5 * step * width / places.shape[1] / longest
        figures.draw_arrows(panels[0], places[step // 2 :: step, step // 2 :: step], shown, wanted, width=0.004)
    for axes, text in zip(panels, ("Difference", "Its standard deviation σ"), strict=False):
        axes.set_title(text, fontsize=10, loc="left")
    return figure


# The pictures of a verdict's page: PNG bytes by name.


def camera_pictures(result: CameraCalibrationResult, examination: Examination | None = None) -> dict[str, bytes]:
    """Pictures of a calibration: coverage, uncertainty, residuals, views, poses; halves, model and board if known."""
    width, height = result.observations.image_size
    tall = 3.0 * height / width + 0.9
    found = {
        "coverage": _drawn(draw_coverage, result, tall),
        "uncertainty": _drawn(draw_uncertainty, result, tall),
        "residuals": _drawn(draw_residuals, result, 4.0),
        "views": _drawn(draw_view_rms, result, 3.4),
        "poses": _drawn(_draw_poses, result, 3.6),
    }
    if examination is not None:
        for half in examination.halves:
            apart = not half.alike and (half.difference.probability or 0.0) < 1e-3
            if apart or "halves" not in found:
                title = f"Difference of cameras from halves: {half.label}"
                found["halves"] = figures.picture_bytes(difference_figure(half.difference, title, narrow=True))
        if examination.model is not None:
            figure = difference_figure(examination.model, "Difference from the hybrid lens", narrow=True)
            found["model"] = figures.picture_bytes(figure)
    board = ((examination and examination.reference) or result).measured_board
    if board is not None and bool(board.amplitudes.any()):
        found["board"] = figures.picture_bytes(board_figure(board))
    return found


def _drawn(
    draw: Callable[[Axes, CameraCalibrationResult], None], result: CameraCalibrationResult, height: float
) -> bytes:
    figure = figures.framed_figure(4.4, height, dpi=160)
    draw(figure.add_subplot(), result)
    return figures.picture_bytes(figure)


def _draw_poses(axes: Axes, result: CameraCalibrationResult) -> None:
    """Tilt of each view against its distance, with a tick that shows its roll."""
    used = result.cam_from_board_rotation.isfinite().all(-1).all(-1)
    rotation, translation = result.cam_from_board_rotation[used], result.cam_from_board_translation[used]
    tilts, distance = board_tilts(rotation).numpy(), translation.norm(dim=-1).numpy()
    roll = torch.atan2(rotation[:, 1, 0] - rotation[:, 0, 1], rotation[:, 0, 0] + rotation[:, 1, 1]).numpy()
    arrows: Any = {"color": figures.ACCENT, "pivot": "mid", "scale": 26.0, "width": 0.005, "headwidth": 4.0}
    axes.quiver(distance, tilts, np.cos(roll), -np.sin(roll), **arrows)
    axes.axhspan(0.0, 15.0, color=figures.FAINT, alpha=0.2, linewidth=0)
    axes.set(xlabel="distance, m", ylabel="tilt, degrees", ylim=(0.0, max(50.0, 1.1 * float(tilts.max()))))
    axes.margins(x=0.1)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title("Poses; arrows: roll; gray: too little tilt", fontsize=10, loc="left")
