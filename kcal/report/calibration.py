"""Pictures of a calibration, its board, its intervals, and of the views that it is made of."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from torch import Tensor

import kcal.report.figures as figures
from kcal.calibrate.camera.advice import reached, unreached_share
from kcal.calibrate.camera.at_setting import ComparisonResult
from kcal.calibrate.camera.calibrate import CameraCalibrationResult
from kcal.calibrate.camera.export import Misfit
from kcal.calibrate.camera.interval_check import IntervalCheck
from kcal.calibrate.hybrid.measured_board import Measured, MeasuredBoard
from kcal.corners.images import read_gray, to_8bit
from kcal.corners.observations import Observations, View
from kcal.errors import FileError
from kcal.lens.difference import CameraDifference, difference_text
from kcal.lens.uncertainty import image_sigma
from kcal.report.figures import INK, draw_arrows, frame_image, new_figure, wrapped
from kcal.texts import measured_text, percent_text
from kcal.threads import in_one_thread

# Draw a calibration: where the board was seen, the residuals, and the RMS of each view.

# Of the width of axes: their color bar and the gap before it.
COLORBAR_SHARE = 0.055


@in_one_thread
def calibration_figure(result: CameraCalibrationResult, name: str = "") -> Figure:
    """Draw a calibration: coverage with magnified residuals, uncertainty over the image, residuals, RMS of each view.

    Args:
        result: from `calibrate_camera`.
        name: of the camera, for the title.

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
        5
    """
    observations = result.observations
    wide = 5.9  # inches, as all of the following
    tall = wide * observations.image_size[1] / observations.image_size[0]
    size = 13.5, 4.75 + tall
    figure = figures.new_figure(*size)

    def axes(left: float, bottom: float, across: float, up: float) -> Axes:
        return figure.add_axes((left / size[0], bottom / size[1], across / size[0], up / size[1]))

    images = axes(0.3, 3.85, wide, tall), axes(6.55, 3.85, wide / (1.0 - COLORBAR_SHARE), tall)
    draw_coverage(images[0], observations, result)
    draw_uncertainty(images[1], observations, result)
    for drawn in images:
        figures.frame_image(drawn, observations.image_size, margin=0.005)
        drawn.set(xticks=[], yticks=[], xlabel="", ylabel="")
        drawn.spines[:].set_visible(False)
    draw_residuals(axes(0.95, 0.75, 2.5, 2.5), result)
    draw_view_rms(axes(4.75, 0.75, 7.7, 2.5), observations, result)
    for drawn in figure.axes:
        drawn.set_title(drawn.get_title(loc="left") or drawn.get_title(), fontsize=12, loc="left")
        drawn.set_title("", loc="center")
    model = "" if result.hybrid is not None else f", model {result.camera.model}"
    whose = f"{figures.shortened(name, 60)}: " if name else ""
    total = len(observations.views)
    used = total - len({view.view for view in result.rejected_views})
    views = f"{used} of {total} views" if used < total else f"{total} views"
    text = f"{whose}{views}{model}, RMS {result.rms:.3f} px"
    place = 0.3 / size[0], 1.0 - 0.2 / size[1]
    figure.text(*place, text, ha="left", va="top", fontsize=17, fontweight="bold", color=figures.INK)
    return figure


def draw_coverage(axes: Axes, observations: Observations, result: CameraCalibrationResult) -> None:
    """Draw corners and magnified residuals."""
    width, height = observations.image_size
    pixels = observations.pixels().numpy()
    errors = -result.residuals.numpy()
    # Views that were left out have corners and no residuals.
    seen = np.isfinite(pixels + errors).all(-1)
    where, error = pixels[seen], errors[seen]
    axes.add_patch(Rectangle((-0.5, -0.5), width, height, fill=False, edgecolor=figures.INK, linewidth=1.2))
    view = np.broadcast_to(np.arange(len(pixels))[:, None], seen.shape)[seen]
    # A typical residual is drawn as long as a sixtieth of the image.
    wanted = width / 60 / max(float(np.sqrt(np.mean(error**2))), 1e-9)
    scale = figures.draw_arrows(axes, where, error, wanted, view, cmap="turbo", width=0.0015)
    axes.scatter(where[:, 0], where[:, 1], c=view, cmap="turbo", s=4, linewidths=0)
    grid = result.camera.grid(97, 73)
    valid = result.camera.unproject(grid)[1].numpy()
    if not valid.all():
        axes.contourf(*grid.unbind(-1), ~valid, levels=[0.5, 1.5], colors=[figures.WARN], alpha=0.25)
        axes.text(0.02, 0.02, "shaded: no valid ray", transform=axes.transAxes, color=figures.WARN, fontsize=9)
    figures.frame_image(axes, observations.image_size, margin=0.03)
    axes.set_title(f"Corners, one color per view; arrows: observed minus modeled, x {scale:g}", fontsize=10, loc="left")


def draw_uncertainty(axes: Axes, observations: Observations, result: CameraCalibrationResult) -> None:
    """Draw σ of far directions over the image."""
    width, height = observations.image_size
    figures.frame_image(axes, observations.image_size, margin=0.03)
    axes.add_patch(Rectangle((-0.5, -0.5), width, height, fill=False, edgecolor=figures.INK, linewidth=1.2))
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
    shown = axes.contourf(
        places[..., 0], places[..., 1], np.where(good, sigma, np.nan), levels=levels, cmap="viridis_r",
        norm=LogNorm(levels[0], levels[-1]), extend="both",
    )  # fmt: skip
    lines = axes.contour(places[..., 0], places[..., 1], sigma, levels=levels, colors="white", linewidths=0.6)
    axes.clabel(lines, fontsize=8, fmt="%g")
    seen = reached(observations, 4 * columns, 4 * rows).numpy()
    if not seen.all():
        x, y = (np.linspace(-0.5, size - 0.5, count) for size, count in ((width, 4 * columns), (height, 4 * rows)))
        axes.contour(x, y, seen, levels=[0.5], colors=figures.INK, linewidths=1.0, linestyles="dashed")
    axes.set_title("σ of far directions, pixels; dashed: what boards reached", fontsize=10, loc="left")
    axes.figure.colorbar(shown, ax=axes, fraction=COLORBAR_SHARE - 0.02, pad=0.02, format="%g")


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


def draw_view_rms(axes: Axes, observations: Observations, result: CameraCalibrationResult) -> None:
    """Draw the RMS of each view as bars."""
    rms = result.per_view_rms.numpy()
    typical = float(np.nanmedian(rms))
    colors = [figures.WARN if value > 2 * typical else figures.ACCENT for value in rms]
    place = np.arange(len(rms))
    axes.bar(place, rms, color=colors, width=0.8)
    axes.axhline(typical, color=figures.INK, linewidth=0.8)
    axes.set_ylabel("RMS, pixels")
    axes.set_title("RMS of each view; line: median", fontsize=10, loc="left")
    if len(rms) <= 40:
        axes.set_xticks(place, [name.rsplit(".", 1)[0] for name in observations.names], rotation=90, fontsize=7)
    else:
        axes.set_xlabel("view")


# Draw a measured board: heights as colors, print errors as magnified arrows.

_ACROSS = 160
# What is below this (mm) is not worth full colors and long arrows.
_LEAST = 0.01


def board_text(board: MeasuredBoard) -> list[str]:
    """Bending, stretch, shear and print error with their standard deviations, one line each."""

    def text(found: Measured, scale: float, unit: str) -> str:
        return measured_text(scale * found.value, scale * found.sigma, unit)

    return [
        f"bending {text(board.bending, 1e3, 'mm')} (height over the best plane, at most)",
        f"stretch {text(board.stretch, 100.0, '%')} (width over height)",
        f"shear {text(board.shear, 100.0, '%')}",
        f"print error {text(board.print_error, 1e3, 'mm')} RMS, beyond stretch and shear",
    ]


def board_figure(board: MeasuredBoard) -> Figure:
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
    figure = figures.new_figure(9.0, min(12.0, 7.4 * (tall + 2 * square) / (wide + 2 * square) + 2.0))
    axes = figure.add_axes((0.08, 0.08, 0.78, 0.9 - 1.25 / figure.get_figheight()))
    most = max(float(np.abs(heights).max()), _LEAST)
    levels = MaxNLocator(nbins=20, symmetric=True).tick_values(-1.0001 * most, 1.0001 * most)
    drawn = axes.contourf(x.numpy(), y.numpy(), heights, levels=levels, cmap="RdBu_r", alpha=0.8)
    beside = axes.inset_axes((1.02, 0.0, 0.025, 1.0))
    figure.colorbar(drawn, cax=beside, label="height, mm (positive: away from the cameras)", ticks=levels[::2])
    axes.plot(corners[:, 0], corners[:, 1], ".", color=figures.GRAY, markersize=3)
    longest = max(float(np.linalg.norm(moved, axis=-1).max()), _LEAST)
    # The longest arrow is about as long as the corners are apart.
    scale = figures.draw_arrows(
        axes, corners[:, :2].numpy(), moved, 0.9 * square / longest, color=figures.INK, width=0.0028
    )
    axes.set(xlim=(low[0] - square, high[0] + square), ylim=(high[1] + square, low[1] - square), aspect="equal")
    axes.set(xlabel="x, mm", ylabel="y, mm")
    axes.spines[["top", "right"]].set_visible(False)
    head = [f"{board.name}: {board.board}", *board_text(board), f"arrows: displacement in the plane x {scale:g}"]
    figure.text(0.08, 1.0 - 0.12 / figure.get_figheight(), "\n".join(head), va="top", fontsize=9, color=figures.INK)
    return figure


def models_figure(compared: ComparisonResult, title: str = "") -> Figure:
    """Draw the held-out RMS of each model, the best first, with the standard error of its difference from the best."""
    ranked = [entry for entry in compared.ranking if math.isfinite(entry[1])]
    names, rms, _, error = zip(*ranked, strict=True)
    figure = figures.new_figure(7.6, 1.5 + 0.45 * len(ranked), layout="constrained")
    axes = figure.add_subplot()
    axes.axvline(rms[0], color=figures.FAINT, linewidth=0.8)
    axes.errorbar(rms, range(len(ranked)), xerr=error, fmt="o", color=figures.ACCENT, capsize=4)
    axes.set_yticks(range(len(ranked)), names)
    axes.set(
        ylim=(len(ranked) - 0.5, -0.5),
        xlabel="held-out RMS, px (bars: ± standard error of the difference from the best)",
    )
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(title, fontsize=11, loc="left")
    return figure


# Draw where stated intervals contain the truth: maps of the image, from repeated captures.

_MOST = 3  # ranges that are drawn
_WIDE, _BESIDE, _BELOW, _ABOVE = 4.6, 0.75, 0.55, 0.8  # inches
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
    width, height = observations.image_size
    shown = list(zip(check.ranges, check.coverage, check.shares, strict=True))[:_MOST]
    tall = _WIDE * height / width
    across, down = (_WIDE + _BESIDE) * len(shown) + 1.0, tall + _BELOW + _ABOVE
    figure = figures.new_figure(across, down)
    places = check.pixels.numpy()
    seen = reached(observations, 256, max(2, round(256 * height / width))).numpy()
    columns, rows = (np.linspace(-0.5, size - 0.5, count) for size, count in ((width, 256), (height, len(seen))))
    for i, (at, coverage, (share, error)) in enumerate(shown):
        left = _BESIDE + i * (_WIDE + _BESIDE)
        axes = figure.add_axes((left / across, _BELOW / down, _WIDE / across, tall / down))
        drawn = axes.contourf(
            places[..., 0],
            places[..., 1],
            coverage.numpy(),
            levels=_LEVELS,
            cmap="RdYlBu",
            norm=BoundaryNorm(_LEVELS, 256),
        )
        if not seen.all():
            axes.contour(columns, rows, seen, levels=[0.5], colors=figures.INK, linewidths=1.0, linestyles="dashed")
        figures.frame_image(axes, observations.image_size)
        axes.set_title(f"{range_label(at)}: {100 * share:.1f} ± {100 * error:.1f} %", fontsize=10, loc="left")
        if i:
            axes.set(ylabel="")
    beside = figure.add_axes(((across - 0.85) / across, _BELOW / down, 0.16 / across, tall / down))
    figure.colorbar(drawn, cax=beside, format=lambda value, _: f"{100 * value:g} %", ticks=_LEVELS)
    text = f"{title}\n" if title else ""
    text += f"Share of {len(check.errors)} refits within the stated 95 % ellipse; dashed: what boards reached"
    figure.text(0.2 / across, 1.0 - 0.1 / down, text, va="top", fontsize=10, color=figures.INK)
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
    shown, drawn = order[:_MOST_VIEWS], failed[:_MOST_FAILED]
    across = max(1, min(_VIEWS_ACROSS, len(shown) + len(drawn)))
    down = max(1, math.ceil((len(shown) + len(drawn)) / across))
    width, height = observations.image_size
    names = {one.name for one in drawn}
    listed = [f"{failure.name}: {failure.reason}" for failure in observations.failures if failure.name not in names]
    listed = listed[:10]
    foot = 0.22 * len(listed) + 0.15
    gap = 0.32 + (0.35 if drawn else 0.0)  # room for reasons
    tall = down * (3.6 * height / width + gap) + 0.7 + foot
    figure = figures.new_figure(3.6 * across + 0.3, tall, dpi=110)
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
    figure.text(0.02, 1 - 0.25 / tall, title, fontsize=13, color=figures.INK, va="center")
    for row, text in enumerate(listed):
        figure.text(0.02, (foot - 0.15 - 0.22 * row) / tall, text[:130], fontsize=8, color=figures.WARN, va="center")
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
    figure = figures.new_figure(9.0, 9.0 * height / width * 0.86 + 1.2)
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
        hatched.set_edgecolor((figures.WARN, 0.5))
        hatched.set_linewidth(0.0)
    axes.scatter(u, v, c=views, cmap="turbo", s=7, linewidths=0)
    figures.frame_image(axes, observations.image_size)
    share = 100.0 * (1.0 - unreached_share(observations))
    axes.set_title(
        f"{len(pixels)} views, {int(seen.sum())} corners; boards reached {percent_text(share / 100.0)} of "
        "the image, hatched: not",
        fontsize=11,
        loc="left",
    )
    return figure


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
    axes.plot(first[:, 0], first[:, 1], color=figures.ACCENT, linewidth=1.2)
    axes.scatter(places[:, 0], places[:, 1], s=9, color=figures.WARN, linewidths=0)
    axes.scatter(places[:1, 0], places[:1, 1], s=60, facecolors="none", edgecolors=figures.ACCENT, linewidths=1.6)
    figures.frame_image(axes, (width, height))
    axes.set(xticks=[], yticks=[], xlabel="", ylabel="")
    sigma, unseen = _predicted_sigma(view), view.pixels.count(None)
    text = view.name if len(view.name) <= 34 else "…" + view.name[-33:]
    text += f"  σ {sigma:.3f} px" if sigma is not None else ""
    text += f"  {unseen} left out" if unseen else ""
    axes.set_title(text, fontsize=8.5, loc="left", pad=3, color=figures.WARN if unseen else figures.INK)


def _draw_failed(axes: Axes, failed: FailedImage, size: tuple[int, int]) -> None:
    width, height = size
    whole = (-0.5, width - 0.5, height - 0.5, -0.5)
    axes.imshow(_thumbnail(failed.path, size), cmap="gray", vmin=0, vmax=255, extent=whole)
    if failed.rejected is not None:
        u, v = failed.rejected.numpy().T
        axes.scatter(u, v, s=16, marker="x", color=figures.WARN, linewidths=1.0)
    figures.frame_image(axes, size)
    axes.set(xticks=[], yticks=[], xlabel="", ylabel="")
    for spine in axes.spines.values():
        spine.set(visible=True, color=figures.WARN, linewidth=2.0)
    name = failed.name if len(failed.name) <= 34 else "…" + failed.name[-33:]
    text = textwrap.wrap(f"failed: {name}: {failed.reason}", 66)[:3]
    axes.set_title("\n".join(text), fontsize=7.5, loc="left", pad=3, color=figures.WARN)


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


# Draw how differently two lenses see: a map of the difference with magnified arrows, and of its error bars.

# Arrows per row of the picture, at most.
_ARROWS = 17
# Inches: width of an image and of its panel, and the height of an upright image.
_WIDTH, _PANEL, _TALLEST = 5.2, 6.9, 8.0


def difference_figure(found: CameraDifference | Misfit, title: str = "", lines: list[str] | None = None) -> Figure:
    """Draw the shift as colors and magnified arrows; beside it, its sigma if there is one.

    Args:
        found: two cameras compared, or the misfit of an exported lens.
        title: above all.
        lines: below the title; those that sum it up if left out.
    """
    if lines is None:
        lines = (
            difference_text(found)
            if isinstance(found, CameraDifference)
            else [f"{found.model}: RMS {found.rms:.4g} px, largest {found.largest:.4g} px, at infinity"]
        )
    sigma = found.sigma if isinstance(found, CameraDifference) else None
    low, high = (value.flatten(0, 1) for value in (found.pixels.amin((0, 1), True), found.pixels.amax((0, 1), True)))
    width, height = (round(float(value)) for value in (high - low)[0] + (1.0 if float(low[0, 0]) >= 0 else 0.0))
    panels = [("difference, px", found.length)] + ([("sigma of it, px", sigma)] if sigma is not None else [])
    # Inches: every panel has an image, its axis to the left and its color bar to the right.
    across = _PANEL * len(panels) + 0.2
    head = [*wrapped(title, across - 0.4, 11.0)] if title else []
    body = [part for line in lines for part in wrapped(line, across - 0.4, 9.0)]
    tall = min(_WIDTH * height / width, _TALLEST)
    top = 0.15 + 0.2 * len(head) + 0.17 * len(body) + 0.4
    down = top + tall + 0.6
    figure = new_figure(across, down)
    places = found.pixels.numpy()
    for i, (label, values) in enumerate(panels):
        left, wide = i * _PANEL + 0.8, tall * width / height
        axes = figure.add_axes((left / across, 0.55 / down, wide / across, tall / down))
        beside = figure.add_axes(((left + wide + 0.12) / across, 0.55 / down, 0.16 / across, tall / down))
        _colors(axes, beside, places, values, label)
        if i == 0:
            step = max(1, math.ceil(places.shape[1] / _ARROWS))
            # The border is no place for an arrow: half of those would be outside.
            shown = np.nan_to_num(found.shift.numpy())[step // 2 :: step, step // 2 :: step]
            longest = float(np.linalg.norm(shown, axis=-1).max())
            if longest > 0:
                wanted = 1.5 * step * width / places.shape[1] / longest
                here = places[step // 2 :: step, step // 2 :: step]
                scale = draw_arrows(axes, here, shown, wanted, color=INK, width=0.004)
                axes.set_title(f"arrows x {scale:g}", fontsize=9, color=INK, loc="left")
        frame_image(axes, (width, height))
    figure.text(0.2 / across, 1.0 - 0.12 / down, "\n".join(head), va="top", fontsize=11, color=INK)
    below = 0.12 + 0.2 * len(head)
    figure.text(0.2 / across, 1.0 - below / down, "\n".join(body), va="top", fontsize=9, color=INK)
    return figure


def _colors(axes: Axes, beside: Axes, places: NDArray[np.float64], values: Tensor, label: str) -> None:
    most = float(np.nanmax(values.numpy()))
    levels = MaxNLocator(nbins=16).tick_values(0.0, max(most, 1e-12))
    drawn = axes.contourf(places[..., 0], places[..., 1], values.numpy(), levels=levels, cmap="viridis_r", alpha=0.85)
    axes.figure.colorbar(drawn, cax=beside, label=label)
