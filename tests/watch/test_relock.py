"""A rig that is checked and corrected: what was known of it is turned into the right axes, and nothing is lost."""

import dataclasses
import math

import pytest
import torch
from locate_rigs import pinhole_rig, real_rig, tensor
from torch import Tensor

from kcal import Camera, InputError, Landmarks, Origin, Rig
from kcal.io.camera_file import provenance
from kcal.lens import rotation_from_vector, vector_from_rotation
from kcal.lens.calibration import RigCalibration
from kcal.locate import enu_from_cam
from kcal.rig import Mounting, RigCovariance
from kcal.watch.turned import DriftEffect, check_rig, drift_of_turns, measure_drift

# Sigmas of the origin (east, north, up) and of turns about these axes, all unlike; simulated light goes straight.
STANDING = torch.diag(tensor(1e-3, 2e-3, 3e-3, 1e-5, 2e-5, 3e-5, 0.0) ** 2)
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


def in_exact_places(rig: Rig) -> Rig:
    root = rig.root.clone()
    for c in (0, 1):
        root[:, rig.pose_columns(c)][:, :3] = 0.0
    rig.root = root
    return rig


def test_what_was_known_of_the_attitudes_counts_about_the_cameras_axes() -> None:
    """Looking east, a turn about east is a roll, one about north a pitch, one about up a yaw."""
    rig = in_exact_places(standing_rig())
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
    # Where the camera stands is as uncertain as before; its attitude is what landmarks tell from there.
    marks, by_place = eastward(rig, tensor(math.radians(-0.01), math.radians(-0.02), 0.0)), []
    for shift in 1e-3 * torch.eye(3, dtype=torch.float64):
        moved = measure_drift(rig, landmarks=marks, pose=(enu_from_cam(90.0).T, shift), refraction=(0.0, 0.0))
        by_place.append((moved.left - found.left) / 1e-3)
    slope = torch.stack(by_place, 1)
    own = found.attitude_covariance + slope @ STANDING[:3, :3] @ slope.T
    onto = found.cam_from_local.T
    spread = new.mounting.covariance
    torch.testing.assert_close(spread[:3, :3], STANDING[:3, :3], rtol=1e-9, atol=1e-24)
    torch.testing.assert_close(spread[3:6, 3:6], onto @ own @ onto.T, rtol=1e-2, atol=1e-11)
    torch.testing.assert_close(new.right_from_left_rotation, found.rig.right_from_left_rotation, rtol=0, atol=0)
    torch.testing.assert_close(new.right_from_left_translation, found.rig.right_from_left_translation, rtol=0, atol=0)
    torch.testing.assert_close(rig.mounting.covariance, STANDING, rtol=1e-12, atol=1e-24)


def test_an_exact_mounting_gets_the_errors_of_the_check_and_none_is_refused() -> None:
    rig = in_exact_places(standing_rig(covariance=None))
    marks = eastward(rig, tensor(0.0, math.radians(0.02), 0.0))
    found = check_rig(rig, landmarks=marks)
    new = found.relocked("Monday")
    assert new.mounting is not None
    x, y, z = found.attitude_covariance.diagonal().tolist()
    errors = new.mounting.covariance.diagonal()[:6]
    torch.testing.assert_close(errors, tensor(0.0, 0.0, 0.0, z, x, y), rtol=2e-3, atol=1e-15)
    assert new.mounting.heading_deg == pytest.approx(89.98, abs=1e-5)
    rig.mounting = None
    with pytest.raises(InputError, match="need the left camera's pose"):
        check_rig(rig, landmarks=marks)


@pytest.mark.slow
@pytest.mark.parametrize("held", [0.0, 1.0])
def test_errors_of_lenses_are_in_the_attitudes_then_and_now(held: float) -> None:
    """Of a rig that landmarks had turned to make up for its principal points (1), and of one that knew nothing of them.

    The first is checked to thousandths of a degree though the points are off by 3 px (0.12°); the second is not said to
    have turned. Both, corrected, are as wrong as they say: χ² of turns, and of yaws and principal points together.
    """
    draw = torch.Generator().manual_seed(1)
    camera = Camera.build(focal=(2000, 2000), center=(959.5, 539.5), size=(1920, 1080), coefficients=[-0.1, 0.02])
    rig = Rig.pair(camera, camera, rotation_from_vector(tensor(0.002, -0.003, 0.001)), tensor(-10.0, 0.0, 0.0))
    rig.mounting = Mounting(origin=ORIGIN, heading_deg=90.0, refraction=0.0, covariance=torch.zeros(7, 7).double())
    size, count = rig.sizes[0], 13
    root, pose = torch.zeros(count, rig.quantities).double(), 2 * size
    for c, side in enumerate((1.0, -1.0)):
        root[2 * c, c * size + 2] = root[2 * c + 1, c * size + 3] = 3.0
        root[2 * c, pose + 1], root[2 * c + 1, pose] = side * held * 3.0 / 2000, -side * held * 3.0 / 2000
    root[4:, pose : pose + 9] = torch.diag(tensor(1e-5, 1e-5, 1e-4, 0.01, 0.02, 0.02, 0.02, 0.02, 0.02))
    root[4:7, pose + 9 : pose + 12] = 1e-4 * torch.eye(3).double()
    rig.relative_root = root
    level, squares = rig.mounting.enu_from_cam, []
    for _ in range(24):
        errors = rig.root.T @ torch.randn(count, generator=draw, dtype=torch.float64)
        turns = 1e-3 * torch.randn(2, 3, generator=draw, dtype=torch.float64)
        across = torch.rand(14, 3, generator=draw, dtype=torch.float64) - 0.5
        away = 750.0 + 900.0 * across[:, :1]
        points, seen, stands = away * torch.cat([torch.ones_like(away), across[:, 1:] * tensor(0.7, 0.35)], 1), [], []
        for c in (0, 1):
            center, turned = errors[rig.pose_columns(c)].split(3)
            lens = Camera(camera.params.detach() - errors[c * size :][:size], size=camera.size, model=camera.model)
            rotation = rotation_from_vector(turns[c]) @ rotation_from_vector(rig.rotation[c] @ turned) @ rig.rotation[c]
            stands.append((rotation @ level.T, level @ (rig.center[c] - center)))
            pixels = lens.project((points - stands[c][1]) @ stands[c][0].T)[0]
            seen.append(pixels + 0.1 * torch.randn(14, 2, generator=draw, dtype=torch.float64))
        survey = torch.full((14, 3), 0.01, dtype=torch.float64)
        marks = Landmarks(
            names=tuple("abcdefghijklmn"), points=points, sigma=survey, pixels=torch.stack(seen, 1), pixel_sigma=0.1
        )
        found = check_rig(rig, landmarks=marks)
        relative = rotation_from_vector(turns[1]) @ rig.right_from_left_rotation @ rotation_from_vector(-turns[0])
        off = vector_from_rotation(found.rig.right_from_left_rotation @ relative.T)
        new = found.relocked("Monday")
        (left, _), (right, _) = stands
        own = vector_from_rotation(found.cam_from_local @ left.T)
        attitude = -found.cam_from_local.T @ own
        yaw = vector_from_rotation(new.right_from_left_rotation @ left @ right.T)[1]
        # Where the middle of an image looks: yaw and principal point make up for each other.
        looks = torch.zeros(2, new.quantities, dtype=torch.float64)
        looks[0, 2], looks[0, size + 2], looks[0, pose + 1] = -1.0, 1.0, 2000.0
        looks[1, 2], looks[1, -4:-1] = 1.0, -2000.0 * found.cam_from_local[1]
        together = torch.stack([errors[size + 2] - errors[2] + 2000.0 * yaw, errors[2] + 2000.0 * own[1]])
        joint = (new.relative_root @ looks.T).T @ (new.relative_root @ looks.T)
        assert float(joint.diagonal().amax()) < 0.4**2
        squares.append([
            float(error @ torch.linalg.solve(spread, error))
            for error, spread in (
                (off, found.relative_covariance), (found.left - turns[0], found.left_covariance),
                (found.right - turns[1], found.right_covariance), (attitude, new.mounting.covariance[3:6, 3:6]),
                (together, joint),
            )
        ])  # fmt: skip
        spread = math.degrees(float(found.relative_covariance[1, 1].sqrt()))
        assert spread < 0.005 if held else 0.1 < spread < 0.15
    freedom = tensor(3.0, 3.0, 3.0, 3.0, 2.0)
    mean = torch.tensor(squares).mean(0) / freedom
    assert bool(((mean - 1.0).abs() < 4.0 * (2.0 / 24 / freedom).sqrt()).all())


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


@pytest.mark.parametrize("degrees", [-0.06, 0.05])
def test_sigma_of_a_drift_is_that_of_the_range_that_is_found(degrees: float) -> None:
    """Four times as far, or half as far: 1 / range changes alike."""
    rig, yaw = pinhole_rig(1600.0, 10.0), torch.diag(tensor(0.0, 1e-7, 0.0) ** 2)

    def turned(radians: float) -> DriftEffect:
        turn = rotation_from_vector(tensor(0.0, radians, 0.0))
        new = Rig.pair(rig.left, rig.right, turn @ rig.right_from_left_rotation, turn @ rig.right_from_left_translation)
        return effect_of(rig, new, yaw, (5000.0,))

    effect, more = (turned(math.radians(degrees) + extra) for extra in (0.0, 1e-7))
    assert effect.sigma.item() == pytest.approx(abs(float(more.found - effect.found)), rel=1e-3)


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
