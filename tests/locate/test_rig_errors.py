"""Errors of rig and mounting together: what `Localizer` adds up is what moving rig and mounting does."""

import math

import pytest
import torch
from locate_rigs import real_rig, tensor

from kcal import InputError, Localizer, Origin, Rig
from kcal.gaussian import half_of_covariance
from kcal.lens.pose import rotation_from_vector, vector_from_rotation
from kcal.locate import enu_from_cam
from kcal.locate.mounting import with_stated_errors
from kcal.rig import Mounting, RigCovariance

ORIGIN = Origin(lat=19.07, lon=72.87, height=14.0)
POINTS = tensor([10.0, -3.0, 120.0], [-150.0, 20.0, 900.0], [300.0, 60.0, 2500.0])


def joint() -> torch.Tensor:
    """(12, 12) of the relative pose and the mounting, strongly correlated as after a resection."""
    scale = tensor(*[2e-5] * 3, *[5e-3] * 3, *[0.02] * 3, *[3e-5] * 3)
    mix = torch.randn(12, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    return (scale[:, None] * mix) @ (scale[:, None] * mix).T / 12.0


def located(link: bool) -> tuple[torch.Tensor, torch.Tensor]:
    rig, whole = real_rig(), joint()
    rig.covariance = RigCovariance.of(rig, pose=whole[:6, :6])
    there = rig.placed(origin=ORIGIN, heading_deg=35.0, pitch_deg=-1.0, roll_deg=0.5, covariance=whole[6:, 6:])
    if link:
        refraction = torch.diag(tensor(*[0.0] * (rig.quantities - 1), 0.1))[-1:]
        linked = torch.nn.functional.pad(half_of_covariance(whole), (sum(rig.sizes), 1))
        there.relative_root = torch.cat([linked, refraction])
    found = Localizer(there, pixel_sigma=0.1)(*rig(POINTS)[0].unbind(-2))
    return found.enu, found.covariance


def test_covariance_is_that_of_moving_rig_and_mounting() -> None:
    rig = real_rig()
    left, right = rig(POINTS)[0].unbind(-2)
    plain = Localizer(rig.placed(origin=ORIGIN, heading_deg=35.0, pitch_deg=-1.0, roll_deg=0.5), pixel_sigma=0.1)
    expected = plain(left, right).covariance.clone()
    values, vectors = torch.linalg.eigh(joint())
    for step in (vectors * values.clamp_min(0).sqrt()).T:
        ends = []
        for sign in (-1e-3, 1e-3):
            turn = rotation_from_vector(sign * step[:3])
            pose = turn @ rig.right_from_left_rotation, rig.right_from_left_translation + sign * step[3:6]
            moved = Localizer(Rig.pair(rig.left, rig.right, *pose).placed(origin=ORIGIN, heading_deg=35.0))
            in_rig = moved(left, right).enu @ enu_from_cam(35.0)
            turned = rotation_from_vector(sign * step[9:]) @ enu_from_cam(35.0, -1.0, 0.5)
            ends.append(in_rig @ turned.T + sign * step[6:9])
        change = (ends[1] - ends[0]) / 2e-3
        expected = expected + change[:, :, None] * change[:, None, :]
    torch.testing.assert_close(located(True)[1], expected, rtol=2e-3, atol=1e-6)
    # Taken as independent they are something else.
    assert not torch.allclose(located(False)[1], expected, rtol=0.1)


def test_root_and_relative_root_are_the_same_errors() -> None:
    """Moving both cameras in the rig's frame, and what that does to the relative pose and to place and attitude."""
    rig = real_rig().placed(origin=ORIGIN, heading_deg=35.0, pitch_deg=-1.0, roll_deg=0.5)
    root = torch.randn(9, rig.quantities, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    rig.root = root
    relative = rig.relative_root
    look = enu_from_cam(35.0, -1.0, 0.5)
    first = sum(rig.sizes)
    for row, found in zip(root, relative, strict=True):
        poses = []
        for camera in (0, 1):
            shift, turn = (1e-6 * row[rig.pose_columns(camera)]).split(3)
            rotation = rig.rotation[camera] @ rotation_from_vector(-turn)
            poses.append((rotation, rig.center[camera] + shift))
        (left, here), (right, there) = poses
        turned = vector_from_rotation(right @ left.T @ rig.right_from_left_rotation.T)
        moved = right @ (here - there) - rig.right_from_left_translation
        shift, turn = row[rig.pose_columns(0)].split(3)
        expected = torch.cat([row[:first], turned / 1e-6, moved / 1e-6, look @ shift, look @ turn, row[-1:]])
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-4)
    rig.relative_root = relative
    torch.testing.assert_close(rig.root, root, rtol=0, atol=1e-12)
    with pytest.raises(InputError, match=r"\(K, 33\) is needed"):
        rig.relative_root = relative[:, 1:]


def test_what_is_set_is_independent_of_the_rest() -> None:
    rig, whole = real_rig(), joint()
    rig.mounting = Mounting(origin=ORIGIN, heading_deg=35.0)
    assert not rig.known
    assert float(rig.mounting.covariance[6, 6]) == pytest.approx(0.01)
    rig.covariance = known = RigCovariance.of(rig, pose=whole[:6, :6])
    rig.mounting = Mounting(origin=ORIGIN, heading_deg=95.0, covariance=whole[6:, 6:])
    torch.testing.assert_close(rig.covariance.matrix, known.matrix, rtol=1e-9, atol=1e-15)
    torch.testing.assert_close(rig.mounting.covariance[:6, :6], whole[6:, 6:], rtol=1e-9, atol=1e-15)
    assert float(rig.mounting.covariance[6, 6]) == pytest.approx(0.01)
    relative = rig.relative_root
    assert float((relative[:, :-7].T @ relative[:, -7:]).abs().max()) == 0.0
    rig.covariance = None
    torch.testing.assert_close(rig.mounting.covariance[:6, :6], whole[6:, 6:], rtol=1e-9, atol=1e-15)
    rig.mounting = None
    assert rig.root is None


def test_stated_errors_are_added_to_what_the_rig_knows() -> None:
    rig, whole = real_rig(), joint()
    assert with_stated_errors(rig).root is None
    rig.covariance = RigCovariance.of(rig, pose=whole[:6, :6])
    stored = torch.block_diag(whole[6:, 6:], tensor(0.01)[None])
    rig.mounting = Mounting(origin=ORIGIN, heading_deg=35.0, covariance=stored)
    found = with_stated_errors(rig, yaw_deg=0.1, heading_deg=0.2, origin_m=3.0)
    yaw = torch.zeros_like(rig.covariance.matrix)
    yaw[-5, -5] = math.radians(0.1) ** 2
    torch.testing.assert_close(found.covariance.matrix, rig.covariance.matrix + yaw, rtol=0, atol=1e-12)
    more = torch.diag(tensor(9.0, 9.0, 9.0, 0.0, 0.0, math.radians(0.2) ** 2, 0.0))
    torch.testing.assert_close(found.mounting.covariance, stored + more)
    # The rig itself stays as it was, and elsewhere its own mounting says nothing.
    torch.testing.assert_close(rig.mounting.covariance, stored)
    other = rig.placed(origin=ORIGIN, heading_deg=0.0)
    assert float(other.mounting.covariance[:6].abs().max()) == 0.0
    torch.testing.assert_close(other.covariance.matrix, rig.covariance.matrix, rtol=1e-12, atol=1e-18)
