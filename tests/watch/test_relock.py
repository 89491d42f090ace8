"""A rig that is checked and corrected: what was known of it is turned into the right axes, and nothing is lost."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from locate_rigs import pinhole_rig, real_rig, tensor
from torch import Tensor

from kcal import InputError, Landmarks, Origin, Rig
from kcal.io.camera_file import provenance
from kcal.lens import rotation_from_vector
from kcal.lens.calibration import RigCalibration
from kcal.locate import enu_from_cam
from kcal.rig import Mounting, RigCovariance
from kcal.watch.turned import DriftEffect, check_rig, drift_of_turns, measure_drift

# Sigmas of the origin (east, north, up) and of turns about these axes, all unlike; simulated light goes straight.
STANDING = torch.diag(tensor(0.1, 0.2, 0.3, 1e-5, 2e-5, 3e-5, 0.0) ** 2)
ORIGIN = Origin(lat=19.07, lon=72.87, height=14.0)


def eastward(rig: Rig, turn: Tensor) -> Landmarks:
    """Exact landmarks for a level rig that looks east, both cameras turned by `turn` about their centers."""
    draw = torch.rand(14, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2)) - 0.5
    points = 300.0 * tensor(0.0, 0.0, 1.0) + draw * tensor(150.0, 60.0, 300.0)
    rotation = rotation_from_vector(turn)
    turned = Rig.pair(rig.left, rig.right, torch.eye(3), rotation @ rig.right_from_left_translation)
    pixels, seen = turned(points @ rotation.T)
    assert bool(seen.all())
    return Landmarks(
        names=tuple("abcdefghijklmn"),
        points=points @ enu_from_cam(90.0).T,
        sigma=torch.full((14, 3), 0.01, dtype=torch.float64),
        pixels=pixels,
        pixel_sigma=0.1,
    )


def standing_rig(covariance: Tensor | None = STANDING) -> Rig:
    rig = pinhole_rig()
    rig.covariance = RigCovariance.of(rig, pose=torch.diag(tensor(1e-6, 2e-6, 3e-6, 1e-2, 2e-2, 3e-2) ** 2))
    rig.mounting = Mounting(origin=ORIGIN, heading_deg=90.0, covariance=covariance, refraction=0.0)
    rig.calibration = RigCalibration(rms=0.1, rms_px=(0.1, 0.1), pairs=0, per_pair_rms={}, **provenance())
    return rig


def test_what_was_known_of_the_attitudes_counts_about_the_cameras_axes() -> None:
    """Looking east, a turn about east is a roll, one about north a pitch, one about up a yaw."""
    rig = standing_rig()
    marks = eastward(rig, torch.zeros(3).double())
    pose = enu_from_cam(90.0).T, torch.zeros(3).double()
    alone = measure_drift(rig, landmarks=marks, pose=pose, refraction=(0.0, 0.0))
    found = check_rig(rig, landmarks=marks)
    more = found.left_covariance - alone.left_covariance
    torch.testing.assert_close(more, torch.diag(tensor(2e-5, 3e-5, 1e-5) ** 2), rtol=0, atol=1e-15)
    more = found.relative_covariance - alone.relative_covariance
    torch.testing.assert_close(more, torch.diag(tensor(1e-6, 2e-6, 3e-6) ** 2), rtol=0, atol=1e-17)


def test_a_relocked_rig_stands_as_it_was_found() -> None:
    rig = standing_rig()
    # To the right by 0.02°, upward by 0.01°.
    found = check_rig(rig, landmarks=eastward(rig, tensor(math.radians(-0.01), math.radians(-0.02), 0.0)))
    assert found.left_significant
    assert not found.significant
    new = found.relocked("Monday")
    assert new.mounting is not None
    assert rig.mounting is not None
    angles = new.mounting.heading_deg, new.mounting.pitch_deg, new.mounting.roll_deg
    assert angles == pytest.approx((90.02, 0.01, 0.0), abs=1e-5)
    assert new.mounting.origin == rig.mounting.origin
    assert (new.calibration.relocked, rig.calibration.relocked) == ("Monday", None)
    assert float(new.baseline) == pytest.approx(10.0, abs=1e-9)
    x, y, z = found.left_covariance.diagonal().tolist()
    more = (new.mounting.covariance - STANDING).diagonal()
    # The camera is turned by 0.02° against east and north.
    torch.testing.assert_close(more, tensor(0.0, 0.0, 0.0, z, x, y, 0.0), rtol=2e-3, atol=1e-15)
    torch.testing.assert_close(
        new.covariance.matrix[-6:, -6:] - rig.covariance.matrix[-6:, -6:], found.pose_covariance, rtol=1e-6, atol=1e-16
    )
    torch.testing.assert_close(new.right_from_left_rotation, found.rig.right_from_left_rotation, rtol=0, atol=0)
    torch.testing.assert_close(new.right_from_left_translation, found.rig.right_from_left_translation, rtol=0, atol=0)
    torch.testing.assert_close(rig.mounting.covariance, STANDING, rtol=1e-12, atol=1e-24)


def test_an_exact_mounting_gets_the_errors_of_the_check_and_none_is_refused() -> None:
    rig = standing_rig(covariance=None)
    marks = eastward(rig, tensor(0.0, math.radians(0.02), 0.0))
    found = check_rig(rig, landmarks=marks)
    new = found.relocked("Monday")
    assert new.mounting is not None
    x, y, z = found.left_covariance.diagonal().tolist()
    errors = new.mounting.covariance.diagonal()[:6]
    torch.testing.assert_close(errors, tensor(0.0, 0.0, 0.0, z, x, y), rtol=2e-3, atol=1e-15)
    assert new.mounting.heading_deg == pytest.approx(89.98, abs=1e-5)
    rig.mounting = None
    with pytest.raises(InputError, match="need the left camera's pose"):
        check_rig(rig, landmarks=marks)


def effect_of(old: Rig, new: Rig, covariance: Tensor, distances: tuple[float, ...]) -> DriftEffect:
    still = drift_of_turns(old, torch.zeros(6).double(), torch.eye(6).double())
    return dataclasses.replace(still, rig=new, relative_covariance=covariance).effect(distances)


def test_sigma_of_a_drift_is_what_each_of_its_turns_does() -> None:
    """Turning by a thousandth of each column of a root of the covariance, and locating with the old rig."""
    rig = real_rig()
    root = 1e-5 * tensor([1.0, 0.0, 0.0], [0.5, 2.0, 0.0], [-3.0, 1.0, 2.0])
    effect = effect_of(rig, rig, root @ root.T, (250.0, 1000.0))
    torch.testing.assert_close(effect.found, effect.distance, rtol=1e-9, atol=0)
    squares = torch.zeros(2).double()
    for column in root.T:
        turn = rotation_from_vector(1e-3 * column)
        new = Rig.pair(rig.left, rig.right, turn @ rig.right_from_left_rotation, turn @ rig.right_from_left_translation)
        shift = effect_of(rig, new, root @ root.T, (250.0, 1000.0)).found - effect.distance
        squares += (1e3 * shift) ** 2
    torch.testing.assert_close(effect.sigma, squares.sqrt(), rtol=1e-3, atol=0)


def test_sigma_of_a_drift_by_the_disparity() -> None:
    """A yaw of ω shifts a range Z by Z² ω / b."""
    rig = pinhole_rig(1600.0, 10.0)
    yaw = torch.diag(tensor(0.0, 1e-5, 0.0) ** 2)
    assert effect_of(rig, rig, yaw, (1000.0,)).sigma.item() == pytest.approx(1.0, rel=2e-3)


@pytest.mark.parametrize("distance", [0.0, -100.0, math.inf, math.nan])
def test_effect_of_a_drift_at_impossible_distances(distance: float) -> None:
    rig = pinhole_rig(1600.0, 10.0)
    with pytest.raises(InputError, match="positive numbers of meters"):
        effect_of(rig, rig, torch.zeros(3, 3).double(), (250.0, distance))
