"""The split of range errors by what to improve: by hand, against the localizer, and for correlated errors."""

import math

import pytest
import torch
from locate_rigs import real_rig, tensor

from kcal import InputError, Localizer, Origin, Rig
from kcal.locate.budget import planned_rig, range_sigmas, usual_ranges
from kcal.report.tables import range_sigma_rows
from kcal.rig import Mounting, RigCovariance, mounting_covariance

ORIGIN = Origin(lat=-33.9, lon=151.2, height=40.0)
SIZE = len(planned_rig().left.names)


def known(rig: Rig, *errors: torch.Tensor) -> Rig:
    """The rig with independent errors, each of which moves all of its quantities."""
    half = torch.stack(errors)
    rig.covariance = RigCovariance.of(rig, joint=half.T @ half)
    return rig


def error(rig: Rig, **parts: float) -> torch.Tensor:
    """One error of a planned rig: left_cx in px, yaw in radians."""
    value = torch.zeros(2 * SIZE + 6, dtype=torch.float64)
    value[rig.left.names.index("cx")] = parts.get("left_cx", 0.0)
    value[2 * SIZE + 1] = parts.get("yaw", 0.0)
    return value


def test_each_part_by_hand() -> None:
    """f B = 16 000 px m: a pixel of disparity is d² / 16 000 m, and 1 / 1600 of yaw a pixel."""
    rig = planned_rig()
    found = range_sigmas(known(rig, error(rig, left_cx=0.2), error(rig, yaw=0.1 / 1600)), pixel_sigma=0.1)
    pixel = tensor(250.0, 1000.0, 5000.0) ** 2 / 16_000
    torch.testing.assert_close(found.marks, 0.1 * math.sqrt(2) * pixel, rtol=2e-3, atol=0)
    torch.testing.assert_close(found.lenses, 0.2 * pixel, rtol=2e-3, atol=0)
    torch.testing.assert_close(found.pose, 0.1 * pixel, rtol=2e-3, atol=0)
    torch.testing.assert_close(found.total, math.sqrt(0.02 + 0.04 + 0.01) * pixel, rtol=2e-3, atol=0)
    assert found.ranged.tolist() == [True, True, True]
    assert not found.sideways.any()
    nothing = range_sigmas(planned_rig(), pixel_sigma=0.1)
    assert torch.equal(nothing.total, nothing.marks)


def test_what_the_pose_makes_up_for_is_no_error() -> None:
    """The principal point and the yaw are unknown to a pixel, their effect on ranges to a hundredth of it."""
    rig = planned_rig()
    # Both move the disparity by a pixel, in opposite directions.
    together = error(rig, left_cx=1.0, yaw=1.0 / 1600)
    found = range_sigmas(known(rig, together, error(rig, yaw=0.01 / 1600)), [5000.0], pixel_sigma=0.1)
    pixel = 5000.0**2 / 16_000
    assert float(found.lenses) < 1e-3 * pixel
    assert float(found.pose) == pytest.approx(0.01 * pixel, rel=1e-3)
    # Alone, either would be a hundred times as much.
    assert float(range_sigmas(known(rig, error(rig, left_cx=1.0)), [5000.0]).lenses) == pytest.approx(pixel, rel=1e-3)


def test_parts_sum_to_what_the_localizer_says_and_pose_is_conditional() -> None:
    rig = real_rig()
    size = len(rig.left.names) + len(rig.right.names) + 6
    scale = torch.cat([1e-3 * torch.ones(size - 6), 1e-5 * torch.ones(3), 1e-3 * torch.ones(3)]).double()
    half = scale * torch.randn(40, size, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    known(rig, *half)
    rig.mounting = Mounting(origin=ORIGIN, heading_deg=20.0)
    found = range_sigmas(rig, [400.0, 2000.0], pixel_sigma=0.1)
    squares = torch.stack([found.marks, found.lenses, found.pose]).square().sum(0)
    torch.testing.assert_close(squares, found.total.square())
    both = rig.right_from_left_rotation[2] + tensor(0.0, 0.0, 1.0)
    left, right = rig(found.distance[:, None] * both / both.norm())[0].unbind(-2)
    located = Localizer(rig, pixel_sigma=0.1)(left, right)
    torch.testing.assert_close(found.total, located.inverse_range_sigma * found.distance**2, rtol=1e-6, atol=0)
    # With exact lenses: the covariance of the pose is its Schur complement, and that of the lenses is zero.
    matrix = rig.covariance.matrix
    lenses, link, pose = matrix[:-6, :-6], matrix[:-6, -6:], matrix[-6:, -6:]
    scaled = lenses / scale[:-6, None] / scale[:-6]
    link = link / scale[:-6, None]
    rig.covariance = RigCovariance.of(rig, pose=pose - link.T @ torch.linalg.solve(scaled, link))
    torch.testing.assert_close(range_sigmas(rig, [400.0, 2000.0]).pose, found.pose, rtol=1e-5, atol=0)


def test_the_mounting_moves_points_sideways() -> None:
    rig = planned_rig()
    standing = mounting_covariance(origin_m=(0.3, 0.4, 0.1), attitude_deg=(0.0, 0.0, 0.01))
    rig.mounting = Mounting(origin=ORIGIN, heading_deg=90.0, covariance=standing)
    found = range_sigmas(rig, [1000.0, 5000.0])
    turn = math.radians(0.01)
    # It looks east, so that north is sideways.
    assert found.sideways.tolist() == pytest.approx([math.hypot(0.4, 1000 * turn), math.hypot(0.4, 5000 * turn)])
    assert torch.equal(found.total, found.marks)


def test_rows_and_what_cannot_be_told() -> None:
    rig = planned_rig(baseline_m=0.5)
    known(rig, error(rig, yaw=0.09 / 1600))
    rows = range_sigma_rows(range_sigmas(rig, [100.0, 5000.0], pixel_sigma=0.1))
    assert rows[1] == ["100 m", "2.1 m", "1.8 m", "0", "1.1 m", "0"]
    assert rows[2] == ["5 km", "bearing only", "", "", "", "0"]
    with pytest.raises(InputError, match="positive numbers"):
        range_sigmas(rig, [-1.0])
    with pytest.raises(InputError, match=r"does not see a point at 0\.1 m"):
        range_sigmas(rig, [0.1])
    exact = planned_rig()
    exact.covariance = RigCovariance.of(exact)
    assert torch.equal(range_sigmas(exact).total, range_sigmas(exact).marks)


@pytest.mark.parametrize(
    ("baseline", "ranges"),
    [
        (0.083, [2.5, 10.0, 50.0]),
        (0.5, [10.0, 50.0, 250.0]),
        (8.0, [250.0, 1000.0, 5000.0]),
        (12.5, [250.0, 1000.0, 5000.0]),
    ],
)
def test_usual_ranges_follow_the_baseline(baseline: float, ranges: list[float]) -> None:
    assert usual_ranges(planned_rig(baseline_m=baseline)) == pytest.approx(ranges)
