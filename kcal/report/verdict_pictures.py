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
from kcal.finding import FAULTS
from kcal.report.calibration import (
    board_figure,
    difference_figure,
    draw_coverage,
    draw_residuals,
    draw_uncertainty,
    draw_view_rms,
)
from kcal.report.figures import ACCENT, FAINT, INK, WARN, new_figure, picture_bytes
from kcal.report.verdict import RangeAnswer
from kcal.texts import range_text

_PART_COLORS = {"marks": ACCENT, "lenses": "#dd7a1f", "relative pose": "#0f766e", FAULTS: WARN}


def camera_pictures(result: CameraCalibrationResult, examination: Examination | None = None) -> dict[str, bytes]:
    """Pictures of a calibration: coverage, uncertainty, residuals, views, poses; halves, model and board if known."""
    observations = result.observations
    width, height = observations.image_size
    tall = 5.2 * height / width + 0.9
    found = {
        "coverage": _drawn(lambda axes: draw_coverage(axes, observations, result), tall),
        "uncertainty": _drawn(lambda axes: draw_uncertainty(axes, observations, result), tall),
        "residuals": _drawn(lambda axes: draw_residuals(axes, result), 5.6),
        "views": _drawn(lambda axes: draw_view_rms(axes, observations, result), 4.2),
        "poses": _drawn(lambda axes: _draw_poses(axes, result), 4.6),
    }
    if examination is not None:
        for half in examination.halves:
            title = f"Difference of cameras from halves: {half.label}"
            found.setdefault("halves", picture_bytes(difference_figure(half.difference, title)))
            if not half.alike and (half.difference.probability or 0.0) < 1e-3:
                found["halves"] = picture_bytes(difference_figure(half.difference, title))
        if examination.model is not None:
            found["model"] = picture_bytes(difference_figure(examination.model, "Difference from the hybrid lens"))
    board = ((examination and examination.reference) or result).measured_board
    if board is not None and bool(board.amplitudes.any()):
        found["board"] = picture_bytes(board_figure(board))
    return found


def range_picture(answers: Sequence[RangeAnswer]) -> bytes:
    """Standard deviation of ranges by their sources, beside what is required."""
    figure = new_figure(6.4, 1.3 + 0.75 * len(answers), dpi=110)
    axes = figure.add_subplot()
    names = list(answers[0].parts)
    for row, answer in enumerate(answers):
        far = answer.requirement.distance
        total = answer.sigma
        start = 0.0
        for name in names:
            # Shares of the variance, drawn as shares of the bar.
            length = 100.0 * total / far * (answer.parts[name] / total) ** 2 if 0 < total < math.inf else 0.0
            axes.barh(
                row,
                length,
                left=start,
                color=_PART_COLORS.get(name, FAINT),
                height=0.5,
                label=name if row == 0 else None,
            )
            start += length
        allowed = 100.0 * answer.requirement.meters / far
        axes.plot([allowed, allowed], [row - 0.4, row + 0.4], color=INK, linewidth=2.2)
    axes.plot([], [], color=INK, linewidth=2.2, label="required")
    axes.set_yticks(range(len(answers)), [range_text(answer.requirement.distance) for answer in answers])
    axes.invert_yaxis()
    axes.set(xlabel="σ of the range, % (colors: shares of its variance)", xlim=(0.0, None))
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(
        frameon=False, fontsize=8.5, loc="upper center", bbox_to_anchor=(0.5, 1.0 + 0.35 / len(answers)), ncols=4
    )
    figure.tight_layout()
    return picture_bytes(figure)


def _drawn(draw: Callable[[Axes], None], height: float) -> bytes:
    figure = new_figure(6.4, height, dpi=110)
    draw(figure.add_subplot())
    figure.tight_layout()
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
    axes.set_title("Poses; arrows: roll; gray: too little tilt for the focal length", fontsize=10, loc="left")
