"""The paper's joint training of a residual and an inverse net (Eq. 12), by Adam and by least squares.

A camera is calibrated with 20 coefficients on simulated views through a lens of 14; its residual net (Eq. 11) and an
inverse net are then trained together on the same corners with A*, K* and the poses held (`kcal.nets.train_jointly`), by
Adam at the learning rate of the residual that ends lowest after a tenth of the steps, and by Levenberg-Marquardt. Held
out are other views, whose poses alone are solved. The last rows train the inverse alone, all over the image.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.calibrate.camera.trust import seen_pixels
from kcal.lens.camera import Camera
from kcal.nets.inverse import InverseFit, InverseNetOptions, train_inverse
from kcal.nets.joint import JointFit, JointOptions, train_jointly
from scripts.shared.page import Lines, section, table, timed
from scripts.shared.real_captures import held_out, warped
from scripts.shared.views import observed, simulate

MODEL = "ext20"
RATES, TRIAL = [10.0**e for e in range(-6, 0)], 0.1
HEADS = [
    "trained", "loss, px²", "corners, RMS px", "held out, RMS px", "inverse at the corners, RMS px",
    "over the image, RMS px", "largest, px", "CPU s",
]  # fmt: skip


def points_of(result: CameraCalibrationResult) -> Tensor:
    """Corners (V, N, 3) in the camera frame, as a calibration with coefficients placed them."""
    seen = result.observations
    board = seen.board.points if result.board_warp is None else warped(seen, result.board_warp)
    return board @ result.cam_from_board_rotation.mT + result.cam_from_board_translation[:, None]


def by_adam(result: CameraCalibrationResult, steps: int, hidden: tuple[int, int] = (8, 12)) -> JointFit:
    """Adam at the best of several learning rates of the residual net."""
    corners = result.camera, points_of(result), seen_pixels(result)

    def fit(rate: float, count: int) -> JointFit:
        return train_jointly(*corners, JointOptions(method="adam", steps=count, rates=(rate, 1e-2), hidden=hidden))

    best = min(RATES, key=lambda rate: float(fit(rate, max(1, int(TRIAL * steps))).losses[-1]))
    return fit(best, steps)


def by_least_squares(result: CameraCalibrationResult, steps: int | None = None) -> JointFit:
    """Levenberg-Marquardt on the same loss."""
    return train_jointly(result.camera, points_of(result), seen_pixels(result), JointOptions(steps=steps))


def rows(steps: int, views: int, hidden: tuple[int, int] = (8, 12)) -> list[list[str]]:
    """The table without its heads."""
    seen = observed(simulate(views)["pixels"].tolist())
    result, seconds = timed(calibrate_camera, seen, CalibrationOptions(model=MODEL))
    others = observed(simulate(views, seed=1000)["pixels"].tolist())
    weight = torch.ones_like(others.pixels()[..., 0])

    def outside(camera: Camera) -> str:
        total, count = held_out(camera, others.board.points, others, weight)
        return f"{math.sqrt(total / count):.4f}"

    def inverse(fit: InverseFit) -> list[str]:
        return [f"{fit.rms:.4f}", f"{fit.largest:.4f}"]

    found = [["calibration, no net", "", f"{result.rms:.4f}", outside(result.camera), "", "", "", f"{seconds:.1f}"]]
    joint = {
        "Eq. 12 by Adam": timed(by_adam, result, steps, hidden),
        "Eq. 12 by Levenberg-Marquardt": timed(by_least_squares, result, min(steps, 100)),
    }
    for name, (fit, seconds) in joint.items():
        cells = [f"{float(fit.losses[-1]):.6f}", f"{fit.rms:.4f}", outside(fit.camera), f"{fit.inverse_rms:.4f}"]
        found.append([name, *cells, *inverse(fit.inverse), f"{seconds:.1f}"])
    for name, radial in (("inverse alone, as in the paper", False), ("inverse alone, after the closed form", True)):
        options = InverseNetOptions(hidden=hidden[1], radial=radial)
        alone, seconds = timed(train_inverse, result.camera, options)
        found.append([name, "", "", "", "", *inverse(alone), f"{seconds:.1f}"])
    return found


@section("paper.md", "eq 12", steps=2, views=4)
def eq_12(steps: int = 2000, views: int = 30) -> Lines:
    return table(HEADS, rows(steps, views))
