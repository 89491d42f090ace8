"""Sum up a calibration in the few numbers that tell whether a camera can be trusted."""

from __future__ import annotations

import dataclasses
import math

import torch

from kcal.calibrate.camera.advice import unreached_share
from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.calibrate.camera.warnings import corner_pupil
from kcal.lens.paraxial import ParaxialFocal, paraxial_focal
from kcal.lens.uncertainty import image_sigma


@dataclasses.dataclass(frozen=True, kw_only=True)
class CalibrationSummary:
    """The figures of a calibration to read first.

    Args:
        center: px, standard deviation of a far direction in the middle of the image, after the best turn of the camera
            (`kcal.lens.uncertainty.pixel_covariance`).
        border: its median along the image's border.
        worst: its largest value in the image; NaN where the camera has no error bars.
        unreached: share of the image that no board reached.
        pupil: meters by which the entrance pupil of the image's farthest corner lies before that of its middle; None
            without a hybrid lens.
        pupil_sigma: its standard deviation.
        focal: the focal lengths on the optical axis, with their standard deviations.

    Example:
        >>> CalibrationSummary(center=0.05, border=0.2, worst=0.5, unreached=0.1).pupil is None
        True
    """

    center: float
    border: float
    worst: float
    unreached: float
    pupil: float | None = None
    pupil_sigma: float | None = None
    focal: ParaxialFocal | None = None


def summarize(result: CameraCalibrationResult) -> CalibrationSummary:
    """Sum up one calibration.

    Example:
        >>> from kcal import Board, Camera, Observations, View, calibrate_camera
        >>> from kcal.lens import rotation_from_vector
        >>> board, views = Board(columns=7, rows=6, square=0.05), []
        >>> truth = Camera.build(focal=(800, 800), center=(322, 238), size=(640, 480), model="pinhole")
        >>> tilts = torch.tensor([[0.5, 0, 0], [-0.5, 0.1, 0], [0, 0.5, 0.2], [0.1, -0.5, 0]], dtype=torch.float64)
        >>> for i, rotation in enumerate(rotation_from_vector(tilts)):
        ...     points = board.points @ rotation.T + torch.tensor([-0.15, -0.14, 0.7], dtype=torch.float64)
        ...     views.append(View(name=str(i), pixels=truth.project(points)[0].tolist()))
        >>> result = calibrate_camera(Observations(board=board, image_size=(640, 480), views=views))
        >>> brief = summarize(result)
        >>> 0 < brief.center < brief.border < brief.worst, 0 < brief.unreached < 1
        (True, True)
    """
    camera = result.camera
    center = border = worst = math.nan
    if camera.calibration is not None and camera.calibration.known(camera.params) is not None:
        sigma = image_sigma(camera)
        rows, columns = sigma.shape
        edge = torch.cat([sigma[0], sigma[-1], sigma[1:-1, 0], sigma[1:-1, -1]])
        center, border = float(sigma[rows // 2, columns // 2]), float(edge.nanmedian())
        worst = float(sigma[sigma.isfinite()].max())
    pupil = corner_pupil(camera, result.covariance)
    return CalibrationSummary(
        center=center,
        border=border,
        worst=worst,
        unreached=unreached_share(result.observations),
        pupil=None if pupil is None else pupil.depth,
        pupil_sigma=None if pupil is None else pupil.sigma,
        focal=paraxial_focal(camera),
    )


def distances_text(result: CameraCalibrationResult) -> str:
    """The board's size and how far away it was, so that centimeters in place of millimeters are noticed.

    The board in millimeters from outer corner to outer corner, and distances in meters.
    """
    board = result.observations.board
    far = result.cam_from_board_translation
    middle = (result.cam_from_board_rotation @ board.points.mean(0)) + far
    distance = middle.norm(dim=-1)
    distance = distance[distance.isfinite()]
    width, height = (1e3 * side for side in board.extent)
    return (
        f"board {board.record}: {width:g} x {height:g} mm; "
        f"nearest view {_distance_text(float(distance.min()))}, farthest {_distance_text(float(distance.max()))}"
    )


def _distance_text(value: float) -> str:
    return f"{value:.{max(0, 1 - math.floor(math.log10(value)))}f} m" if value > 0 else "0 m"
