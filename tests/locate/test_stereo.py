import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lenses import hybrid_camera
from locate_rigs import SIZE, pinhole_rig, real_rig, spread_points, tensor, turned

from kcal import Camera, Localizer, PositionStatus, Rig
from kcal.locate.views import fit_pairs

RIG = real_rig()


def test_pupils_move_by_meters_at_any_range() -> None:
    left, right = hybrid_camera("wide", 1), hybrid_camera("wide", 2)
    right = right.with_parameters(right.params.index_put((tensor(6).long(),), tensor(-0.004)))
    rotation = turned(0.5, 0.3, -1.0)
    rig = Rig.pair(left, right, rotation, rotation @ -tensor(10, 0.1, -0.2))
    points = spread_points(torch.logspace(0.8, 5, 60, dtype=torch.float64))
    pixels, seen = rig(points)
    (seen_left, seen_right), seen = pixels.unbind(-2), seen.all(-1)
    result = Localizer(rig, pixel_sigma=1e-3)(seen_left[seen], seen_right[seen])
    assert int(seen.sum()) > 40
    torch.testing.assert_close(1 / result.enu.norm(dim=-1), 1 / points[seen].norm(dim=-1), rtol=0, atol=1e-13)


@settings(max_examples=25, deadline=None)
@given(
    depth=st.floats(20, 10_000),
    x=st.floats(-0.4, 0.4),
    y=st.floats(-0.25, 0.25),
    yaw=st.floats(-8, 8),
    pitch=st.floats(-5, 5),
    roll=st.floats(-20, 20),
    baseline=st.floats(1, 50),
    angle=st.floats(0, 2 * math.pi),
)
def test_round_trip_for_any_rig(
    depth: float, x: float, y: float, yaw: float, pitch: float, roll: float, baseline: float, angle: float
) -> None:
    camera = Camera.build(focal=(900, 900), center=(959.5, 539.5), size=SIZE, coefficients=[-0.1, 0.01])
    rotation = turned(yaw, pitch, roll)
    offset = -baseline * tensor(math.cos(angle), math.sin(angle), 0.1)
    rig = Rig.pair(camera, camera, rotation, rotation @ offset)
    point = depth * tensor([x, y, 1.0])
    pixels, seen = rig(point)
    (left, right), seen = pixels.unbind(-2), seen.all(-1)
    result = Localizer(rig, pixel_sigma=1e-3)(left, right)
    if bool(seen[0]) and bool(rig.left.inside(left)[0] & rig.right.inside(right)[0]):
        assert result.status.item() == PositionStatus.OK
        # Parallax 1e-4 rad at the worst, pixels rounded to 1e-13.
        assert torch.allclose(result.enu, point, rtol=1e-8)
        assert result.range_low < result.enu.norm() < result.range_high
    else:
        assert result.status.item() != PositionStatus.OK


def test_range_slope_is_z_squared_over_focal_times_baseline() -> None:
    focal, baseline, z = 1600.0, 10.0, 5000.0
    rig = pinhole_rig(focal, baseline)
    left, right = rig(tensor([0.0, 0.0, z]))[0].unbind(-2)
    left.requires_grad_()
    right.requires_grad_()
    Localizer(rig)(left, right).enu[0, 2].backward()
    slope = z * z / (focal * baseline)
    # More u on the left is more disparity: nearer. v carries no range.
    assert left.grad[0, 0].item() == pytest.approx(-slope, rel=1e-9)
    assert right.grad[0, 0].item() == pytest.approx(slope, rel=1e-9)
    # A vertical slip of 1 px moves y, not Z: 1e-6 of the horizontal slope is rounding.
    assert abs(left.grad[0, 1].item()) < 1e-6 * slope


def test_outside_the_lens() -> None:
    # x - x³/12 turns back at r = 2: distorted 4/3, that is 1333 px from the center of a wide sensor.
    camera = Camera.build(
        focal=(1000, 1000), center=(2000, 500), size=(4001, 1001), coefficients=[-1 / 12], model="opencv4"
    )
    rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
    result = Localizer(rig)(tensor([3400.0, 500.0], [2100.0, 500.0]), tensor([3390.0, 500.0], [2090.0, 500.0]))
    assert [PositionStatus(s).name for s in result.status.tolist()] == ["OUTSIDE_LENS", "OK"]


def test_lines_that_cross_behind_one_camera() -> None:
    # The right camera stands 10 m ahead and looks the same way: it is ahead of the crossing point of these lines.
    camera = Camera.build(focal=(800, 800), center=(959.5, 539.5), size=SIZE, model="pinhole")
    rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, -10.0]))
    # The lines meet at (0.5 m, 0, 4 m): 6 m behind the right camera, whose ray leads away from it.
    behind = Localizer(rig)(tensor([959.5 + 800 / 8, 539.5]), tensor([959.5 + 800 / 12, 539.5]))
    left, right = rig(tensor([3.0, 0.0, 20.0]))[0].unbind(-2)
    assert PositionStatus(int(Localizer(rig)(left, right).status)).name == "OK"
    assert PositionStatus(int(behind.status)).name == "BEHIND"
    assert behind.enu.abs().max() == 0


def test_along_the_baseline_there_is_no_range() -> None:
    camera = Camera.build(focal=(800, 800), center=(959.5, 539.5), size=SIZE, model="pinhole")
    rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([0.0, 0.0, -10.0]))
    marks = tensor([959.5, 539.5]).requires_grad_()
    result = Localizer(rig)(marks, marks)
    assert PositionStatus(int(result.status)).name == "PARALLEL"
    assert (result.range_low.item(), result.range_high.item()) == (0.0, math.inf)
    assert torch.isfinite(torch.autograd.grad(result.enu.sum() + result.inverse_range.sum(), marks)[0]).all()


def test_parallax_and_its_noise_use_the_local_size_of_a_pixel() -> None:
    focal, sigma = 1600.0, 0.3
    rig = pinhole_rig(focal, 1e-3)
    # A baseline of 1 mm: both cameras see the point at the same place in the image.
    left, right = rig(tensor([0.0, 0.0, 1.0], [0.5, 0.0, 1.0], [0.0, 0.3, 1.0]))[0].unbind(-2)
    result = Localizer(rig, pixel_sigma=sigma)(left, right)
    # Along u, off axis by angle a: d(angle)/du = cos²(a) / f; above the axis only the distance grows: cos(a) / f.
    expected = tensor(1.0, 1 / 1.25, 1 / math.sqrt(1.09)) * math.sqrt(2) * sigma / focal
    # The two views differ by 1e-3 in angle, the differences by 1e-8.
    # Seen from a short baseline the parallax is baseline * cos(a) / range, a being the angle off axis along u.
    across = 1e-3 * tensor(1.0, 1 / math.sqrt(1.25), 1.0)
    assert torch.allclose(across * result.inverse_range_sigma, expected, rtol=1e-3)
    assert math.asin(1e-3 * result.inverse_range[0].item() / math.hypot(1, 1e-3)) == pytest.approx(
        math.atan(1e-3), rel=1e-9
    )


def test_ranges_do_not_hang_on_the_length_of_the_direction() -> None:
    """A direction need not have length one: twice as long with twice the inverse it is the same point."""
    points = spread_points(torch.logspace(1.8, 3.5, 12, dtype=torch.float64))
    left, right = RIG(points)[0].unbind(-2)
    found = fit_pairs(RIG, left, right)
    torch.testing.assert_close(1.0 / (found.fit.inverse / (found.scale * found.length)), points.norm(dim=-1))
    longer = found._replace(
        fit=found.fit._replace(direction=2.0 * found.fit.direction, inverse=2.0 * found.fit.inverse)
    )
    torch.testing.assert_close(longer.length, 2.0 * found.length, rtol=1e-14, atol=0)
