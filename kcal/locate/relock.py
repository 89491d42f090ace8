"""Check whether a solved rig has turned, and correct it."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from kcal.calibrate.rig.drift import Drift, measure_drift
from kcal.calibrate.rig.sources import Features, Landmarks
from kcal.errors import InputError
from kcal.lens.mounting import REFRACTION, REFRACTION_SIGMA
from kcal.lens.rig import RigCovariance, StereoRig
from kcal.locate.geodesy import enu_from_cam
from kcal.locate.marks import Marks
from kcal.locate.mounting import attitude
from kcal.threads import in_one_thread


def check_rig(rig: StereoRig, *, features: Features | None = None, landmarks: Landmarks | None = None) -> Drift:
    """Measure how the cameras have turned (`measure_drift`) with what the rig knows of itself.

    Its mounting gives the left camera's pose for landmarks, and its covariance says how well the attitudes were known.

    Args:
        rig: as it was solved, with its `covariance` and, for landmarks, its `mounting`.
        features: see `measure_drift`.
        landmarks: see `measure_drift`; in the frame of `rig.mounting.origin`.

    Raises:
        InputError: nothing to measure with, or landmarks for a rig without mounting.
        DegenerateError: too little to tell the turn.

    Example:
        >>> from kcal.rig import planned_rig
        >>> rig, rows = planned_rig(), torch.tensor([[-90.0, 2, 300], [80, -9, 250], [4, 6, 400], [30, 20, 200]])
        >>> pixels = torch.cat([torch.stack(rig(rows.double())[:2], 1)] * 2, 1)  # the same then and now
        >>> unknown = torch.zeros(4).double(), torch.full((4,), torch.inf).double()
        >>> static = Features(names=tuple("abcd"), pixels=pixels, inverse_range=unknown[0],
        ...                   inverse_range_sigma=unknown[1])
        >>> check_rig(rig, features=static).significant
        False
    """
    pose: tuple[Tensor, Tensor] | None = None
    left = torch.zeros(3, 3, dtype=torch.float64)
    refraction = REFRACTION, REFRACTION_SIGMA
    if rig.mounting is not None:
        stands = rig.mounting
        rotation = enu_from_cam(stands.heading_deg, stands.pitch_deg, stands.roll_deg).T
        pose = rotation, torch.zeros(3, dtype=torch.float64)
        if stands.covariance is not None:
            left = rotation @ stands.covariance[3:6, 3:6] @ rotation.T
            # Light that was held straight stays so; otherwise another day has another coefficient.
            straight = len(stands.covariance) == 7 and not bool(stands.covariance[6, 6])
            refraction = (
                REFRACTION if stands.refraction is None else stands.refraction,
                0.0 if straight else REFRACTION_SIGMA,
            )
    before = None if rig.covariance is None else (rig.covariance.matrix[-6:-3, -6:-3], left)
    return measure_drift(rig, features=features, landmarks=landmarks, pose=pose, before=before, refraction=refraction)


def seen_again(then: Marks, now: Marks, sigma: float) -> Features:
    """Things of unknown range that are marked in old and new images, for `check_rig`; `sigma` of a mark, pixels.

    Raises:
        InputError: no name is in both.

    Example:
        >>> pixels = torch.tensor([[10.0, 20.0], [30.0, 40.0]], dtype=torch.float64)
        >>> found = seen_again(Marks(("a", "b"), pixels, pixels), Marks(("b", "c"), pixels, pixels), 0.3)
        >>> found.names, found.pixels[0].tolist()
        (('b',), [[30.0, 40.0], [30.0, 40.0], [10.0, 20.0], [10.0, 20.0]])
    """
    common = tuple(name for name in then.names if name in now.names)
    if not common:
        raise InputError("no name is in both files of marks; give the same things the same names")
    pixels = [marks.pixels[[marks.names.index(name) for name in common]] for marks in (then, now)]
    unknown = torch.zeros(len(common), dtype=torch.float64)
    return Features(
        names=common,
        pixels=torch.cat(pixels, 1),
        inverse_range=unknown,
        inverse_range_sigma=torch.full_like(unknown, torch.inf),
        pixel_sigma=sigma,
    )


@in_one_thread
def relocked(rig: StereoRig, drift: Drift, note: str) -> StereoRig:
    """The rig with the attitudes that `check_rig` found; cameras and their places stay.

    The covariance of the drift is added to that of the rig: the errors of the first solution are still in it, and those
    of the check come on top. A rig that counted as exact has the latter alone.

    Args:
        rig: the rig as it was solved.
        drift: what was found.
        note: when and from what, for the record.

    Example:
        >>> from kcal.rig import planned_rig
        >>> rig, rows = planned_rig(), torch.tensor([[-90.0, 2, 300], [80, -9, 250], [4, 6, 400], [30, 20, 200]])
        >>> pixels = torch.cat([torch.stack(rig(rows.double())[:2], 1)] * 2, 1)
        >>> unknown = torch.zeros(4).double(), torch.full((4,), torch.inf).double()
        >>> static = Features(names=tuple("abcd"), pixels=pixels, inverse_range=unknown[0],
        ...                   inverse_range_sigma=unknown[1])
        >>> bool(relocked(rig, check_rig(rig, features=static), "Monday").baseline == rig.baseline)
        True
    """
    new = StereoRig(rig.left, rig.right, drift.rig.right_from_left_rotation, drift.rig.right_from_left_translation)
    new.covariance = (rig.covariance or RigCovariance.of(rig)).with_pose(drift.pose_covariance)
    new.mounting = rig.mounting
    if rig.mounting is not None and drift.cam_from_local is not None and drift.left_covariance is not None:
        rotation, covariance = drift.cam_from_local, rig.mounting.covariance
        heading, pitch, roll = attitude(rotation.T)
        if covariance is not None:
            covariance = covariance.clone()
            covariance[3:6, 3:6] += rotation.T @ drift.left_covariance @ rotation
        new.mounting = dataclasses.replace(
            rig.mounting, heading_deg=heading, pitch_deg=pitch, roll_deg=roll, covariance=covariance
        )
    if rig.calibration is not None:
        new.calibration = dataclasses.replace(rig.calibration, relocked=note, baseline_m=float(new.baseline))
    return new
