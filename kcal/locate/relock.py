"""A rig file whose cameras have been found turned, brought up to date."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from kcal.calibrate.rig.drift import Drift
from kcal.io.rig_file import RigFile, RigMounting, RigPose
from kcal.locate.geodesy import enu_from_cam
from kcal.locate.mounting import attitude


def standing(file: RigFile) -> tuple[Tensor, Tensor] | None:
    """The left camera's pose in the local frame at its own place: cam_from_enu (3, 3) and zeros; None if not stored."""
    stands = file.mounting
    if stands is None:
        return None
    rotation = enu_from_cam(stands.heading_deg, stands.pitch_deg, stands.roll_deg).T
    return rotation, torch.zeros(3, dtype=torch.float64)


def known_before(file: RigFile) -> tuple[Tensor, Tensor] | None:
    """Covariances (3, 3) of the relative turn and of the left camera's attitude, both about camera axes, as stored."""
    joint, stands = file.joint_covariance(), file.mounting
    if joint is None:
        return None
    left = torch.zeros(3, 3, dtype=torch.float64)
    pose = standing(file)
    if stands is not None and pose is not None and stands.covariance is not None:
        left = pose[0] @ torch.tensor(stands.covariance, dtype=torch.float64)[3:, 3:] @ pose[0].T
    return joint[-6:-3, -6:-3], left


def relocked(file: RigFile, drift: Drift, note: str) -> RigFile:
    """The rig file with the attitudes that `measure_drift` found.

    Cameras and their places stay. The covariance of the drift is added to that of the rig: the errors of then are
    still in it, those of the check come on top.

    Args:
        file: the old rig file.
        drift: what was found.
        note: when and from what, for the record.

    Example:
        >>> from kcal.io.rig_file import rig_to_file
        >>> from kcal.locate.budget import planned_rig
        >>> callable(relocked), rig_to_file(planned_rig()).mounting
        (True, None)
    """
    covariance = file.joint_covariance()
    size = 10 + len(file.left.coefficients) + len(file.right.coefficients) + 6
    joint = torch.zeros(size, size, dtype=torch.float64) if covariance is None else covariance.clone()
    joint[-6:, -6:] += drift.pose_covariance
    mounting = file.mounting
    if mounting is not None and drift.cam_from_local is not None and drift.left_covariance is not None:
        rotation = drift.cam_from_local
        heading, pitch, roll = attitude(rotation.T)
        spread = None
        if mounting.covariance is not None:
            matrix = torch.tensor(mounting.covariance, dtype=torch.float64)
            matrix[3:, 3:] += rotation.T @ drift.left_covariance @ rotation
            spread = tuple(map(tuple, matrix.tolist()))
        mounting = RigMounting(
            lat=mounting.lat,
            lon=mounting.lon,
            height=mounting.height,
            heading_deg=heading,
            pitch_deg=pitch,
            roll_deg=roll,
            covariance=spread,
            link=mounting.link,
        )
    rig = drift.rig
    calibration = file.calibration
    if calibration is not None:
        calibration = dataclasses.replace(calibration, relocked=note, baseline_m=float(rig.baseline))
    return RigFile(
        left=file.left,
        right=file.right,
        right_from_left=RigPose.model_validate(
            {
                "rotation": rig.right_from_left_rotation.tolist(),
                "translation": rig.right_from_left_translation.tolist(),
            }
        ),
        covariance=None if covariance is None else tuple(map(tuple, joint.tolist())),
        mounting=mounting,
        calibration=calibration,
    )
