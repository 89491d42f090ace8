import math

import pytest
import torch
from locate_rigs import SIZE, tensor, turned
from torch import Tensor

from kcal import Camera, InputError, Localizer, PositionStatus, Rig
from kcal.locate import enu_to_geodetic
from kcal.locate.angular import triangulate
from scripts.shared import station_scenes as scenes
from scripts.shared.station_scenes import ORIGIN, drawn_errors, marks, ring

OK = int(PositionStatus.OK)


def targets(count: int, seed: int = 0) -> Tensor:
    return scenes.targets(count, torch.Generator().manual_seed(seed))


def noise(shape: tuple[int, ...], sigma: float, seed: int = 1) -> Tensor:
    return sigma * torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("radius", [1000.0, 5000.0, 40_000.0])
def test_exact_marks_through_bent_light_give_the_point_back(radius: float) -> None:
    rig, points = ring(4, radius), targets(6)
    rig.root = rig.with_errors(attitude_deg=0.01)
    found = Localizer(rig)(marks(rig, points))
    assert (found.status == OK).all()
    # Without refraction, points 40 km away would be 16 m too high; one radius serves for all verticals.
    assert (found.enu - points).norm(dim=-1).max() < 1e-3
    assert torch.allclose(found.geodetic, enu_to_geodetic(points, ORIGIN), atol=1e-9)
    assert found.reprojection.max() < 1e-5


@pytest.mark.parametrize("count", [2, 3, 5])
def test_ellipses_contain_the_truth_as_often_as_they_say(count: int) -> None:
    rig = ring(count, 4000.0)
    root = rig.with_errors(position_m=0.3, attitude_deg=(0.004, 0.004, 0.02), refraction=0.1)
    generator, points = torch.Generator().manual_seed(7), targets(2000)
    seen = marks(rig, points, drawn_errors(root, 2000, generator)) + noise((2000, count, 2), 0.3)
    found = Localizer(rig, pixel_sigma=0.3, root=root)(seen)
    ok = found.status == OK
    error = (found.enu - points)[ok]
    assert ok.sum() > 1990
    squares = (error * torch.linalg.solve(found.covariance[ok], error)).sum(-1)
    # Four standard deviations of 2,000 draws.
    assert abs(float((squares < 7.815).double().mean()) - 0.95) < 0.02


def test_a_camera_with_a_poor_attitude_counts_less() -> None:
    rig = ring(3, 5000.0)
    root = rig.with_errors(attitude_deg=0.002)
    root[:, rig.pose_columns(1)] *= 50.0
    found = Localizer(rig, root=root)(marks(rig, targets(1)) + noise((1, 3, 2), 0.1))
    alike = Localizer(rig, root=rig.with_errors(attitude_deg=0.1))(marks(rig, targets(1)))
    assert found.covariance[0].diagonal().sum() < 0.05 * alike.covariance[0].diagonal().sum()


def test_any_subset_of_cameras_is_as_if_the_others_were_not_there() -> None:
    rig, points = ring(5, 5000.0), targets(3)
    root = rig.with_errors(position_m=0.1, attitude_deg=0.01, refraction=0.1)
    pixels = marks(rig, points) + noise((3, 5, 2), 0.3)
    for chosen in ([0, 1], [1, 3], [0, 2, 4]):
        seen = torch.zeros(3, 5, dtype=torch.bool)
        seen[:, chosen] = True
        found = Localizer(rig, root=root)(torch.where(seen[..., None], pixels, math.nan), seen)
        few = Rig(
            [rig.each[c] for c in chosen], [rig.names[c] for c in chosen], rig.rotation[chosen],
            center=rig.center[chosen],
            origin=ORIGIN,
        )  # fmt: skip
        less = few.with_errors(position_m=0.1, attitude_deg=0.01, refraction=0.1)
        alone = Localizer(few, root=less)(pixels[:, chosen])
        assert torch.allclose(found.enu, alone.enu, atol=1e-5)
        assert torch.allclose(found.covariance, alone.covariance, rtol=1e-6)
        assert torch.equal(found.used, seen)
        assert (found.anchor == chosen[0]).all()


def test_every_row_is_alone() -> None:
    rig, points = ring(4, 5000.0), targets(6)
    pixels = marks(rig, points) + noise((6, 4, 2), 0.3)
    good = Localizer(rig, root=rig.with_errors(attitude_deg=0.01))
    whole = good(pixels)
    spoiled = pixels.clone()
    spoiled[1] = math.nan
    spoiled[2, 0, 1] = math.inf
    spoiled[3, 1:] = math.nan
    seen = torch.ones(6, 4, dtype=torch.bool)
    seen[4] = False
    spoiled.requires_grad_()
    found = good(spoiled, seen)
    names = [PositionStatus(int(status)).name for status in found.status]
    assert names == ["OK", "NOT_FINITE", "OK", "BEARING_ONLY", "MASKED", "OK"]
    for row in (0, 5):
        assert torch.allclose(found.enu[row], whole.enu[row], atol=1e-6)
    assert found.used.sum(-1).tolist() == [4, 0, 3, 1, 0, 4]
    (gradient,) = torch.autograd.grad(found.enu.sum() + found.inverse_range.sum(), spoiled)
    assert torch.isfinite(gradient).all()
    assert all(not value.isnan().any() for value in found if value.is_floating_point())


@pytest.mark.parametrize("count", [3, 4, 7])
def test_a_wrong_view_is_named_and_left_out(count: int) -> None:
    rig = ring(count, 3000.0)
    root = rig.with_errors(attitude_deg=0.003)
    points = targets(40)
    pixels = marks(rig, points) + noise((40, count, 2), 0.3)
    wrong = torch.arange(40) % count
    pixels[torch.arange(40), wrong] += torch.tensor([[120.0, 90.0], [-20.0, 30.0]])[torch.arange(40) % 2]
    found = Localizer(rig, root=root)(pixels)
    named = found.bad & (found.status == OK)[:, None]
    # Of three views, an error along a line that the others allow may be anyone's; such rows say so.
    assert named.any(-1).sum() >= (20 if count == 3 else 40)
    rows = named.any(-1).nonzero()[:, 0]
    assert (named[rows].to(int).argmax(-1) == wrong[rows]).all()
    assert (found.misfit[rows].argmax(-1) == wrong[rows]).all()
    assert (found.enu - points)[rows].norm(dim=-1).max() < 5.0
    assert (found.status[(found.status != OK).nonzero()[:, 0]] == int(PositionStatus.CONTRADICTION)).all()


def test_good_views_are_left_alone() -> None:
    rig = ring(6, 3000.0)
    root = rig.with_errors(attitude_deg=0.02)
    errors = drawn_errors(root, 2000, torch.Generator().manual_seed(3))
    pixels = marks(rig, targets(2000), errors) + noise((2000, 6, 2), 0.3)
    found = Localizer(rig, root=root)(pixels)
    # One in ten thousand; without the errors that pixels share, nearly all.
    assert (found.bad.any(-1) | (found.status != OK)).sum() <= 2
    assert Localizer(rig)(pixels).bad.any(-1).sum() > 1000


def test_two_views_that_contradict_each_other_are_told() -> None:
    rig = ring(2, 3000.0)
    pixels = marks(rig, targets(2))
    pixels[1, 0, 1] += 60.0
    found = Localizer(rig)(pixels)
    assert found.status.tolist() == [OK, int(PositionStatus.CONTRADICTION)]
    assert (found.enu[1] == 0).all()
    assert torch.isinf(found.covariance[1].diagonal()).all()


def test_gradients_are_exact() -> None:
    rig = ring(3, 5000.0)
    locate = Localizer(rig, root=rig.with_errors(attitude_deg=0.01, refraction=0.1))
    pixels = (marks(rig, targets(2)) + noise((2, 3, 2), 0.3)).requires_grad_()
    cov = (0.1 * torch.eye(2, dtype=torch.float64)).repeat(2, 3, 1, 1).requires_grad_()

    def places(pixels: Tensor, cov: Tensor) -> Tensor:
        return locate(pixels, None, 0.5 * (cov + cov.mT)).enu

    assert torch.autograd.gradcheck(places, (pixels, cov), eps=1e-4, rtol=1e-4, atol=1e-3)


def test_one_camera_with_a_stated_height() -> None:
    rig = ring(3, 3000.0)
    points = targets(5)
    height = enu_to_geodetic(points, ORIGIN)[:, 2]
    # Far below the towers, so that lines of sight meet the height steeply enough.
    points = points - torch.tensor([0.0, 0.0, 300.0])
    height = enu_to_geodetic(points, ORIGIN)[:, 2]
    root = rig.with_errors(attitude_deg=0.02, refraction=0.1)
    locate = Localizer(rig, root=root)
    seen = torch.tensor([False, True, False]).expand(5, 3)
    found = locate(marks(rig, points), seen, height=height, height_sigma=2.0)
    assert (found.status == OK).all()
    assert (found.enu - points).norm(dim=-1).max() < 0.02
    generator, many = torch.Generator().manual_seed(4), points.repeat(400, 1)
    shifted = marks(rig, many, drawn_errors(root, 2000, generator)) + noise((2000, 3, 2), 0.3)
    told = height.repeat(400) + noise((2000,), 2.0, 5)
    result = locate(shifted, seen[:1].expand(2000, 3), height=told, height_sigma=2.0)
    error = result.enu - many
    squares = (error * torch.linalg.solve(result.covariance, error)).sum(-1)
    assert abs(float((squares < 7.815).double().mean()) - 0.95) < 0.02
    high = points + torch.tensor([0.0, 0.0, 900.0])
    upward = marks(rig, high)
    assert (locate(upward, seen, height=height).status == int(PositionStatus.BEARING_ONLY)).all()
    # A summit, or an aircraft: the line of sight climbs to its height.
    found = locate(upward, seen, height=enu_to_geodetic(high, ORIGIN)[:, 2], height_sigma=2.0)
    assert (found.status == OK).all()
    assert (found.enu - high).norm(dim=-1).max() < 0.02


@pytest.mark.parametrize("count", [1, 3])
def test_one_camera_alone_is_as_one_of_several(count: int) -> None:
    rig, points = ring(3, 9000.0), targets(4) - torch.tensor([0.0, 0.0, 400.0])
    few = Rig(rig.each[:count], rig.names[:count], rig.rotation[:count], center=rig.center[:count], origin=ORIGIN)
    pixels = marks(rig, points)[:, :count]
    seen = torch.arange(count).expand(4, count) == 0
    height = enu_to_geodetic(points, ORIGIN)[:, 2]
    found = Localizer(few, root=few.with_errors(attitude_deg=0.01))(pixels, seen, height=height)
    assert (found.status == OK).all()
    assert (found.enu - points).norm(dim=-1).max() < 0.1
    exact, nearly = (
        Localizer(few, pixel_sigma=5.0)(pixels, seen, height=height, height_sigma=sigma) for sigma in (1e-9, 1e-2)
    )
    assert torch.allclose(exact.range_low, nearly.range_low, rtol=1e-6)  # noise of pixels is what is left
    assert torch.allclose(*(found.covariance[:, :2, :2] for found in (exact, nearly)), rtol=1e-5)
    alike = [Localizer(few)(pixels, seen, height=level).enu for level in (float(height[0]), height[:1].numpy())]
    assert torch.equal(*alike)
    assert torch.allclose(alike[0][0], found.enu[0])


def test_errors_of_clocks_widen_along_the_motion() -> None:
    rig = ring(3, 3000.0)
    pixels, velocity = marks(rig, targets(1)), torch.tensor([[[50.0, 0.0]] * 3], dtype=torch.float64)
    still = Localizer(rig, clock_sigma=0.1)(pixels)
    moving = Localizer(rig, clock_sigma=0.1)(pixels, velocity=velocity)
    assert moving.covariance[0, 0, 0] > 50 * still.covariance[0, 0, 0]
    assert moving.covariance[0, 2, 2] < 1.5 * still.covariance[0, 2, 2]


def test_bad_arguments() -> None:
    rig = ring(3, 3000.0)
    with pytest.raises(InputError, match=r"shape \(\.\.\., N, 3, 2\)"):
        Localizer(rig)(torch.zeros(4, 2, 2))
    with pytest.raises(InputError, match="seen: bool"):
        Localizer(rig)(torch.zeros(4, 3, 2), torch.ones(4, 3))
    with pytest.raises(InputError, match="a root"):
        Localizer(rig, root=torch.ones(2, 5))
    with pytest.raises(InputError, match="unlike names"):
        Rig(rig.each, ["a", "a", "b"], rig.rotation, center=rig.center)


@pytest.mark.parametrize("lost", [math.nan, -50.0, None])
def test_rows_that_nobody_saw_leave_gradients_alone(lost: float | None) -> None:
    """Also those by freed poses, where cameras share errors; NaN, outside the images, or masked."""
    rig, mask = ring(3, 5000.0).free("tower 2"), None
    rig.root = rig.with_errors(attitude_deg=0.01)
    pixels = marks(rig, targets(2)).detach()
    if lost is None:
        mask = torch.tensor([True, False])
    else:
        pixels[1] = lost
    gradients = []
    for rows, which in ((pixels, mask), (pixels[:1], None)):
        moved = rows.clone().requires_grad_()
        found = Localizer(rig)(moved, mask=which)
        loss = found.inverse_range[found.status == OK].sum()
        gradients.append(torch.autograd.grad(loss, [moved, *(p for p in rig.parameters() if p.requires_grad)]))
    for whole, alone in zip(*gradients, strict=True):
        torch.testing.assert_close(whole[: len(alone)] if whole.shape != alone.shape else whole, alone)
    assert not gradients[0][0][1].any()


def test_a_joint_covariance_of_left_and_right_serves_all_calls() -> None:
    camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
    rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
    left, right = torch.tensor([[960.0, 540.0]]), torch.tensor([[940.0, 540.1]])
    joint = torch.diag(torch.tensor([0.04, 0.09, 0.01, 0.16])).double()[None]
    each = torch.stack([joint[:, :2, :2], joint[:, 2:, 2:]], 1)
    velocity, localize = torch.full((1, 2, 2), 30.0).double(), Localizer(rig, clock_sigma=0.01)
    both = torch.stack([left, right], 1)
    for call in (localize, Localizer(rig, weights="all", clock_sigma=0.01)):
        for more in ({}, {"velocity": velocity}):
            found = call(left, right, joint, **more).covariance
            torch.testing.assert_close(found, call(both, cov=each, **more).covariance)
    # What marks have in common counts beside the motion: errors along the row that are alike move no range.
    mixed = joint.clone()
    mixed[:, 0, 2] = mixed[:, 2, 0] = 0.019
    less = localize(left, right, mixed, velocity=velocity).inverse_range_sigma
    more_px2 = 2 * 0.019
    own = localize(left, right, joint, velocity=velocity).inverse_range_sigma
    assert float(own.square() - less.square()) == pytest.approx(more_px2 / (1600.0 * 10.0) ** 2, rel=1e-3)
    with pytest.raises(InputError, match="marks are independent"):
        Localizer(rig, weights="all")(left, right, mixed)


CAMERAS = [
    Camera.build(focal=(1600, 1602), center=(957, 541), size=SIZE, coefficients=[-0.2, 0.05]),
    Camera.build(focal=(1200, 1200), center=(960, 540), size=SIZE, coefficients=[-0.1, 0.02]),
    Camera.build(focal=(2400, 2395), center=(950, 545), size=SIZE, model="pinhole"),
]
# A world far from its origin, as in a national grid.
SHIFT = tensor(4.0e5, 5.0e6, 100.0)


def poses() -> torch.Tensor:
    rows = []
    for yaw, center in ((0.0, [0.0, 0.0, 0.0]), (1.0, [12.0, 0.3, -0.5]), (-2.0, [-20.0, -0.4, 1.0])):
        rotation = turned(yaw, 0.3 * yaw)
        rows.append(torch.cat([rotation, -rotation @ (tensor(*center) + SHIFT)[:, None]], -1))
    return torch.stack(rows)


def views(cameras: list[Camera] = CAMERAS, pose: torch.Tensor | None = None) -> Localizer:
    pose = poses() if pose is None else pose
    turn, shift = pose[:, :, :3], pose[:, :, 3:]
    return Localizer(Rig(cameras, [str(c) for c in range(len(cameras))], turn, center=-(turn.mT @ shift)[..., 0]))


def seen(points: torch.Tensor) -> torch.Tensor:
    pixels = []
    for camera, pose in zip(CAMERAS, poses(), strict=True):
        pixel, valid = camera.project(points @ pose[:, :3].T + pose[:, 3])
        assert valid.all()
        pixels.append(pixel)
    return torch.stack(pixels, -2)


def test_exact_marks_give_the_point_back() -> None:
    points = tensor([3.0, 1.0, 60.0], [50.0, 20.0, 500.0], [-300.0, 40.0, 5000.0])
    found = views()(seen(points + SHIFT))
    assert (found.status == PositionStatus.OK).all()
    # The world's coordinates hold 1e-9 m, the baseline is 32 m.
    assert ((found.enu - SHIFT - points).norm(dim=-1) / points.norm(dim=-1)).max() < 1e-8
    assert found.reprojection.max() < 1e-6


def test_likelihood_weighs_by_covariance_and_its_covariance_is_true() -> None:
    n = 6000
    point = tensor([40.0, 10.0, 800.0]) + SHIFT
    generator = torch.Generator().manual_seed(2)
    # One camera is ten times worse than the others, along one axis.
    roots = torch.stack([0.1 * torch.eye(2), tensor([1.0, 0.0], [0.2, 0.1]).float(), 0.1 * torch.eye(2)]).double()
    marks = seen(point) + (roots @ torch.randn(n, 3, 2, 1, dtype=torch.float64, generator=generator))[..., 0]
    found = views()(marks, cov=roots @ roots.mT)
    rays = torch.stack([camera.unproject(marks[:, c])[0] for c, camera in enumerate(CAMERAS)], -2)
    closed = [triangulate(poses(), rays, method=method).points for method in ("linear", "angular")]
    errors = [float((one - point).square().sum(-1).mean().sqrt()) for one in (found.enu, *closed)]
    assert errors[0] < 0.7 * min(errors[1:])
    spread, claimed = torch.cov(found.enu.T), found.covariance.mean(0)
    scale = claimed.diagonal().sqrt()
    assert ((spread - claimed) / scale[:, None] / scale[None, :]).abs().max() < 0.06


def test_one_covariance_may_stand_for_all_pixels() -> None:
    marks = seen(tensor([40.0, 10.0, 800.0], [-60.0, 20.0, 900.0]) + SHIFT)
    cov = tensor([0.04, 0.01], [0.01, 0.09])
    locate = views()
    shared, each = locate(marks, cov=cov), locate(marks, cov=cov.expand(*marks.shape, 2))
    assert torch.equal(shared.covariance, each.covariance)
    assert torch.equal(shared.enu, each.enu)


def test_statuses_without_nan() -> None:
    camera = CAMERAS[2]
    pose = torch.eye(3, 4, dtype=torch.float64).repeat(3, 1, 1)
    pose[1, 0, 3], pose[2, 0, 3] = -10.0, -20.0
    good = tensor([990.0, 545.0], [980.0, 545.0], [970.0, 545.0])
    rows = [good, good[[1, 1, 1]], good[[2, 1, 0]], good.clone(), good.clone(), good.clone()]
    rows[3][:2, 0], rows[4][0, 1] = math.nan, 2000.0
    cov = 0.01 * torch.eye(2, dtype=torch.float64).repeat(6, 3, 1, 1)
    cov[5, 2, 1, 1] = -1.0
    marks = torch.stack(rows).requires_grad_()
    found = views([camera] * 3, pose)(marks, cov=cov)
    names = ["OK", "PARALLEL", "PARALLEL", "BEARING_ONLY", "OK", "BAD_COVARIANCE"]
    assert [PositionStatus(s).name for s in found.status.tolist()] == names
    for name, value in found._asdict().items():
        assert not torch.isnan(value).any(), name
    lost = torch.tensor([False, True, True, True, False, True])
    assert (found.enu[lost] == 0).all()
    (gradient,) = torch.autograd.grad(found.enu.sum() + found.reprojection.sum(), marks)
    assert torch.isfinite(gradient).all()
    assert (gradient[lost] == 0).all()
    assert (gradient[~lost] != 0).any(-1).any(-1).all()


def test_multiview_bad_arguments() -> None:
    with pytest.raises(InputError, match="not a rotation"):
        views(pose=2.0 * poses())
