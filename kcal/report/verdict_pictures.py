"""The pictures of a verdict's page, each small enough for a phone: PNG bytes by name."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from matplotlib.axes import Axes

from kcal.calibrate.camera.advice import board_tilts
from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.calibrate.camera.trust import Examination
from kcal.calibrate.rig.result import RigResult
from kcal.finding import FAULTS
from kcal.report.calibration import (
    board_figure,
    difference_figure,
    draw_coverage,
    draw_residuals,
    draw_uncertainty,
    draw_view_rms,
)
from kcal.report.figures import ACCENT, FAINT, INK, WARN, framed_figure, picture_bytes
from kcal.report.rig import rig_figure
from kcal.report.verdict import RangeAnswer
from kcal.texts import range_text

# Inches of a picture for a phone, and pixels of an inch.
_WIDE, _DPI = 4.4, 160
_PART_COLORS = {"marks": ACCENT, "lenses": "#dd7a1f", "relative pose": "#0f766e", FAULTS: WARN}


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
                found["halves"] = picture_bytes(difference_figure(half.difference, title, narrow=True))
        if examination.model is not None:
            figure = difference_figure(examination.model, "Difference from the hybrid lens", narrow=True)
            found["model"] = picture_bytes(figure)
    board = ((examination and examination.reference) or result).measured_board
    if board is not None and bool(board.amplitudes.any()):
        found["board"] = picture_bytes(board_figure(board))
    return found


def rig_pictures(result: RigResult) -> dict[str, bytes]:
    """The picture of a solved rig, by its name on the page."""
    return {"rig": picture_bytes(rig_figure(result, narrow=True))}


def range_picture(answers: Sequence[RangeAnswer]) -> bytes:
    """Standard deviation of ranges by their sources, beside what is required."""
    figure = framed_figure(_WIDE, 1.3 + 0.6 * len(answers), dpi=_DPI)
    axes = figure.add_subplot()
    names = list(answers[0].parts)
    for row, answer in enumerate(answers):
        far = answer.requirement.distance
        total = answer.sigma
        start = 0.0
        for name in names:
            # Shares of the variance, drawn as shares of the bar.
            length = 100.0 * total / far * (answer.parts[name] / total) ** 2 if 0 < total < math.inf else 0.0
            color, label = _PART_COLORS.get(name, FAINT), None if row else name
            axes.barh(row, length, left=start, color=color, height=0.5, label=label)
            start += length
        allowed = 100.0 * answer.requirement.meters / far
        axes.plot([allowed, allowed], [row - 0.4, row + 0.4], color=INK, linewidth=2.2)
    axes.plot([], [], color=INK, linewidth=2.2, label="required")
    axes.set_yticks(range(len(answers)), [range_text(answer.requirement.distance) for answer in answers])
    axes.invert_yaxis()
    axes.set(xlabel="σ of the range, % (colors: shares of the variance)", xlim=(0.0, None))
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(frameon=False, fontsize=8.5, loc="outside upper left", ncols=3)
    return picture_bytes(figure)


def _drawn(
    draw: Callable[[Axes, CameraCalibrationResult], None], result: CameraCalibrationResult, height: float
) -> bytes:
    figure = framed_figure(_WIDE, height, dpi=_DPI)
    draw(figure.add_subplot(), result)
    return picture_bytes(figure)


def _draw_poses(axes: Axes, result: CameraCalibrationResult) -> None:
    """Tilt of each view against its distance, with a tick that shows its roll."""
    used = result.cam_from_board_rotation.isfinite().all(-1).all(-1)
    rotation, translation = result.cam_from_board_rotation[used], result.cam_from_board_translation[used]
    tilts, distance = board_tilts(rotation).numpy(), translation.norm(dim=-1).numpy()
    roll = torch.atan2(rotation[:, 1, 0] - rotation[:, 0, 1], rotation[:, 0, 0] + rotation[:, 1, 1]).numpy()
    axes.quiver(
        distance, tilts, np.cos(roll), -np.sin(roll), color=ACCENT, pivot="mid", scale=26.0, width=0.005, headwidth=4.0
    )
    axes.axhspan(0.0, 15.0, color=FAINT, alpha=0.2, linewidth=0)
    axes.set(xlabel="distance, m", ylabel="tilt, degrees", ylim=(0.0, max(50.0, 1.1 * float(tilts.max()))))
    axes.margins(x=0.1)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title("Poses; arrows: roll; gray: too little tilt", fontsize=10, loc="left")
