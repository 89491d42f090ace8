"""Draw a calibration: where the board was seen, the residuals, and the RMS of each view."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from kcal.calibrate.camera.advice import reached
from kcal.calibrate.camera.calibrate import CameraCalibrationResult
from kcal.corners.observations import Observations
from kcal.lens.uncertainty import image_sigma
from kcal.report.colors import ACCENT, FAINT, INK, WARN
from kcal.report.figures import HALO, draw_arrows, frame_image, new_figure, round_levels, save_picture, shortened
from kcal.threads import in_one_thread

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
    figure = new_figure(*size)

    def axes(left: float, bottom: float, across: float, up: float) -> Axes:
        return figure.add_axes((left / size[0], bottom / size[1], across / size[0], up / size[1]))

    images = axes(0.3, 3.85, wide, tall), axes(6.55, 3.85, wide / (1.0 - COLORBAR_SHARE), tall)
    draw_coverage(images[0], observations, result)
    draw_uncertainty(images[1], observations, result)
    for drawn in images:
        frame_image(drawn, observations.image_size, margin=0.005)
        drawn.set(xticks=[], yticks=[], xlabel="", ylabel="")
        drawn.spines[:].set_visible(False)
    draw_residuals(axes(0.95, 0.75, 2.5, 2.5), result)
    draw_view_rms(axes(4.75, 0.75, 7.7, 2.5), observations, result)
    for drawn in figure.axes:
        drawn.set_title(drawn.get_title(loc="left") or drawn.get_title(), fontsize=12, loc="left")
        drawn.set_title("", loc="center")
    model = "" if result.hybrid is not None else f", model {result.camera.model}"
    whose = f"{shortened(name, 60)}: " if name else ""
    total = len(observations.views)
    used = total - len({view.view for view in result.rejected_views})
    views = f"{used} of {total} views" if used < total else f"{total} views"
    text = f"{whose}{views}{model}, RMS {result.rms:.3f} px"
    place = 0.3 / size[0], 1.0 - 0.2 / size[1]
    figure.text(*place, text, ha="left", va="top", fontsize=17, fontweight="bold", color=INK)
    return figure


def save_calibration_picture(path: str | Path, result: CameraCalibrationResult, name: str = "") -> Path:
    """Write the picture of `calibration_figure` as PNG or SVG, atomically."""
    return save_picture(path, calibration_figure(result, name))


def draw_coverage(axes: Axes, observations: Observations, result: CameraCalibrationResult) -> None:
    """Draw corners and magnified residuals."""
    width, height = observations.image_size
    pixels = observations.pixels().numpy()
    errors = -result.residuals.numpy()
    # Views that were left out have corners and no residuals.
    seen = np.isfinite(pixels + errors).all(-1)
    where, error = pixels[seen], errors[seen]
    axes.add_patch(Rectangle((-0.5, -0.5), width, height, fill=False, edgecolor=INK, linewidth=1.2))
    view = np.broadcast_to(np.arange(len(pixels))[:, None], seen.shape)[seen]
    # A typical residual is drawn as long as a sixtieth of the image.
    wanted = width / 60 / max(float(np.sqrt(np.mean(error**2))), 1e-9)
    scale = draw_arrows(axes, where, error, wanted, view, cmap="turbo", width=0.0015)
    axes.scatter(where[:, 0], where[:, 1], c=view, cmap="turbo", s=4, linewidths=0)
    grid = result.camera.grid(97, 73)
    valid = result.camera.unproject(grid)[1].numpy()
    if not valid.all():
        axes.contourf(*grid.unbind(-1), ~valid, levels=[0.5, 1.5], colors=[WARN], alpha=0.25)
        axes.text(0.02, 0.02, "shaded: no valid ray", transform=axes.transAxes, color=WARN, fontsize=9)
    frame_image(axes, observations.image_size, margin=0.03)
    axes.set_title(f"Corners, one color per view; arrows: observed minus modeled, x {scale:g}", fontsize=10, loc="left")


def draw_uncertainty(axes: Axes, observations: Observations, result: CameraCalibrationResult) -> None:
    """Draw σ of far directions over the image."""
    width, height = observations.image_size
    frame_image(axes, observations.image_size, margin=0.03)
    axes.add_patch(Rectangle((-0.5, -0.5), width, height, fill=False, edgecolor=INK, linewidth=1.2))
    known = result.camera.calibration
    if known is None or known.known(result.camera.params) is None:
        axes.set_title("No covariance: σ in the image is not known", fontsize=10, loc="left")
        return
    columns, rows = 65, max(2, round(65 * height / width))
    sigma = image_sigma(result.camera, columns, rows).numpy()
    places = result.camera.grid(columns, rows).numpy()
    good = np.isfinite(sigma)
    low, high = np.quantile(sigma[good], [0.0, 0.98])
    levels = round_levels(max(low, 1e-6), max(high, 2e-6))
    shown = axes.contourf(
        places[..., 0], places[..., 1], np.where(good, sigma, np.nan), levels=levels, cmap="viridis_r",
        norm=LogNorm(levels[0], levels[-1]), extend="both",
    )  # fmt: skip
    lines = axes.contour(places[..., 0], places[..., 1], sigma, levels=levels, colors="white", linewidths=0.6)
    axes.clabel(lines, fontsize=8, fmt="%g")
    seen = reached(observations, 4 * columns, 4 * rows).numpy()
    if not seen.all():
        x, y = (np.linspace(-0.5, size - 0.5, count) for size, count in ((width, 4 * columns), (height, 4 * rows)))
        axes.contour(x, y, seen, levels=[0.5], colors=INK, linewidths=1.0, linestyles="dashed")
    axes.set_title("σ of far directions, pixels; dashed: what boards reached", fontsize=10, loc="left")
    axes.figure.colorbar(shown, ax=axes, fraction=COLORBAR_SHARE - 0.02, pad=0.02, format="%g")


def draw_residuals(axes: Axes, result: CameraCalibrationResult) -> None:
    """Draw all residuals beside a circular Gaussian."""
    error = -result.residuals.numpy().reshape(-1, 2)
    error = error[np.isfinite(error).all(-1)]
    sigma = float(np.sqrt(np.mean(error**2)))
    limit = max(5.0 * sigma, 1e-9)
    axes.scatter(error[:, 0], error[:, 1], s=5, color=ACCENT, alpha=0.45, linewidths=0)
    turn = np.linspace(0, 2 * np.pi, 200)
    # 95 % of a circular Gaussian lie within 2.45 σ.
    axes.plot(2.448 * sigma * np.cos(turn), 2.448 * sigma * np.sin(turn), color=INK, linewidth=1)
    outside = float(np.mean(np.hypot(*error.T) > 2.448 * sigma))
    axes.axhline(0, color=FAINT, linewidth=0.6)
    axes.axvline(0, color=FAINT, linewidth=0.6)
    axes.set(xlim=(-limit, limit), ylim=(limit, -limit), aspect="equal", xlabel="u, pixels", ylabel="v, pixels")
    axes.locator_params(nbins=5)
    axes.set_title(f"Residuals: σ {sigma:.3f} px per axis", fontsize=10, loc="left")
    text = f"{100 * outside:.1f} % outside the 95 % circle"
    axes.text(0.03, 0.97, text, transform=axes.transAxes, fontsize=9, color=INK, va="top", path_effects=HALO)


def draw_view_rms(axes: Axes, observations: Observations, result: CameraCalibrationResult) -> None:
    """Draw the RMS of each view as bars."""
    rms = result.per_view_rms.numpy()
    typical = float(np.nanmedian(rms))
    colors = [WARN if value > 2 * typical else ACCENT for value in rms]
    place = np.arange(len(rms))
    axes.bar(place, rms, color=colors, width=0.8)
    axes.axhline(typical, color=INK, linewidth=0.8)
    axes.set_ylabel("RMS, pixels")
    axes.set_title("RMS of each view; line: median", fontsize=10, loc="left")
    if len(rms) <= 40:
        axes.set_xticks(place, [name.rsplit(".", 1)[0] for name in observations.names], rotation=90, fontsize=7)
    else:
        axes.set_xlabel("view")
