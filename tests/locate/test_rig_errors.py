"""Errors of rig and mounting together: what `Localizer` adds up is what moving rig and mounting does."""

from __future__ import annotations

import math

import pytest
import torch
from locate_rigs import real_rig, tensor

from kcal import InputError, Localizer, Origin, Rig
from kcal.lens import rotation_from_vector
from kcal.locate import enu_from_cam
from kcal.locate.mounting import run_errors
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
    known = RigCovariance.of(rig, pose=whole[:6, :6])
    cross = torch.cat([torch.zeros(len(known.matrix) - 6, 6, dtype=torch.float64), whole[:6, 6:]])
    localize = Localizer(
        rig, origin=ORIGIN, heading_deg=35.0, pitch_deg=-1.0, roll_deg=0.5, pixel_sigma=0.1, calibration=known,
        mounting=whole[6:, 6:], link=cross if link else None,
    )  # fmt: skip
    found = localize(*rig(POINTS)[0].unbind(-2))
    return found.enu, found.covariance


def test_covariance_is_that_of_moving_rig_and_mounting() -> None:
    rig = real_rig()
    left, right = rig(POINTS)[0].unbind(-2)
    plain = Localizer(rig, origin=ORIGIN, heading_deg=35.0, pitch_deg=-1.0, roll_deg=0.5, pixel_sigma=0.1)
    start = plain(left, right)
    expected = start.covariance.clone()
    values, vectors = torch.linalg.eigh(joint())
    for step in (vectors * values.clamp_min(0).sqrt()).T:
        ends = []
        for sign in (-1e-3, 1e-3):
            turn = rotation_from_vector(sign * step[:3])
            pose = turn @ rig.right_from_left_rotation, rig.right_from_left_translation + sign * step[3:6]
            moved = Localizer(Rig.pair(rig.left, rig.right, *pose), origin=ORIGIN, heading_deg=35.0)
            in_rig = moved(left, right).enu @ enu_from_cam(35.0)
            turned = rotation_from_vector(sign * step[9:]) @ enu_from_cam(35.0, -1.0, 0.5)
            ends.append(in_rig @ turned.T + sign * step[6:9])
        change = (ends[1] - ends[0]) / 2e-3
        expected = expected + change[:, :, None] * change[:, None, :]
    torch.testing.assert_close(located(True)[1], expected, rtol=2e-3, atol=1e-6)
    # Taken as independent they are something else.
    assert not torch.allclose(located(False)[1], expected, rtol=0.1)


def test_a_link_must_fit() -> None:
    rig, whole = real_rig(), joint()
    known = RigCovariance.of(rig, pose=whole[:6, :6])
    size = len(known.matrix)
    for link, mounting, message in (
        (torch.zeros(size, 5), whole[6:, 6:], r"\(26, 6\), is needed"),
        (torch.zeros(size, 6), None, "needs the covariances of both"),
        (torch.ones(size, 6), whole[6:, 6:], "not a covariance"),
    ):
        with pytest.raises(InputError, match=message):
            Localizer(rig, origin=ORIGIN, heading_deg=0.0, calibration=known, mounting=mounting, link=link.double())


def test_stated_errors_are_added_to_what_the_rig_knows() -> None:
    rig, whole = real_rig(), joint()
    assert run_errors(rig) == (None, None, None)
    rig.covariance = RigCovariance.of(rig, pose=whole[:6, :6])
    stored = torch.block_diag(whole[6:, 6:], tensor(0.01)[None])
    link = torch.zeros(len(rig.covariance.matrix), 7, dtype=torch.float64)
    rig.mounting = Mounting(origin=ORIGIN, heading_deg=35.0, covariance=stored, link=link)
    found = run_errors(rig, yaw_deg=0.1, heading_deg=0.2, origin_m=3.0)
    assert found.link is link
    yaw = torch.zeros_like(rig.covariance.matrix)
    yaw[-5, -5] = math.radians(0.1) ** 2
    torch.testing.assert_close(found.calibration.matrix, rig.covariance.matrix + yaw, rtol=0, atol=1e-12)
    more = torch.diag(tensor(9.0, 9.0, 9.0, 0.0, 0.0, math.radians(0.2) ** 2, 0.0))
    torch.testing.assert_close(found.mounting, stored + more)
    # Elsewhere the rig's own mounting says nothing.
    other = run_errors(rig, elsewhere=True)
    assert (other.mounting, other.link) == (None, None)
    assert other.calibration is rig.covariance
