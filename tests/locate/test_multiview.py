import math

import pytest
import torch
from locate_rigs import SIZE, tensor, turned

from kcal import Camera, InputError, Localizer, PositionStatus, Rig
from kcal.locate.angular import triangulate

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


def test_bad_arguments() -> None:
    with pytest.raises(InputError, match="not a rotation"):
        views(pose=2.0 * poses())
