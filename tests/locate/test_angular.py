"""The closed form beside Eq. 9 by singular values, and against the optimum it claims."""

import math
from typing import Literal

import pytest
import torch
from locate_rigs import tensor, turned

from kcal import InputError
from kcal.lens.pose import side_axes
from kcal.locate.angular import triangulate, triangulate_angular, triangulate_linear, triangulate_pairs

GENERATOR = torch.Generator().manual_seed(7)


def poses(count: int) -> torch.Tensor:
    rows = []
    for i in range(count):
        rotation = turned(0.7 * i, -0.3 * i, 0.5 * i)
        rows.append(torch.cat([rotation, rotation @ tensor([-9.0 * i], [0.4 * i * i], [-0.8 * i])], -1))
    return torch.stack(rows)


def rays_to(points: torch.Tensor, cameras: torch.Tensor) -> torch.Tensor:
    return torch.einsum("cij,nj->nci", cameras[:, :, :3], points) + cameras[:, :, 3]


def world_points(n: int = 50) -> torch.Tensor:
    depth = torch.logspace(1.7, 4.0, n, dtype=torch.float64)
    return torch.stack([0.3 * depth * (3 * depth).sin(), 0.2 * depth * depth.cos(), depth], -1)


@pytest.mark.parametrize("count", [2, 3, 5])
def test_exact_rays_give_the_point_back(count: int) -> None:
    cameras, points = poses(count), world_points()
    found = triangulate_angular(cameras, rays_to(points, cameras) * 3.0)
    assert found.valid.all()
    # Parallaxes down to 1e-3 rad with rays rounded to 1e-16.
    assert ((found.points - points).norm(dim=-1) / points.norm(dim=-1)).max() < 1e-12


@pytest.mark.parametrize("count", [2, 4])
def test_as_accurate_as_singular_values(count: int) -> None:
    cameras, n = poses(count), 20_000
    point = tensor(300.0, -50.0, 2000.0)
    rays = rays_to(point.expand(n, 3), cameras)
    rays = rays / rays.norm(dim=-1, keepdim=True)
    rays = rays + 5e-5 * torch.randn(rays.shape, dtype=torch.float64, generator=GENERATOR)
    errors = [(solve(cameras, rays)[0] - point).square().sum(-1) for solve in (triangulate_angular, triangulate_linear)]
    own, other = (error.mean().sqrt() for error in errors)
    # Not one result with another name: they differ, by a small part of their error.
    assert own < 1.001 * other
    assert 1e-9 < (errors[0] - errors[1]).abs().max() < 0.05 * errors[1].max()


def test_two_rays_are_turned_as_little_as_possible() -> None:
    cameras = poses(2)
    rays = rays_to(world_points(6)[:, :], cameras)
    rays = rays / rays.norm(dim=-1, keepdim=True)
    rays = rays + 2e-3 * torch.randn(rays.shape, dtype=torch.float64, generator=GENERATOR)
    pose = cameras[1, :, :3], cameras[1, :, 3]
    points = triangulate_pairs(rays[:, 0], rays[:, 1], pose).points

    def cost(points: torch.Tensor) -> torch.Tensor:
        seen = torch.stack([points, points @ pose[0].T + pose[1]], -2)
        return (1.0 - torch.nn.functional.cosine_similarity(seen, rays, dim=-1) ** 2).sum(-1)

    best = cost(points)
    for axis in torch.eye(3, dtype=torch.float64):
        for sign in (1.0, -1.0):
            step = sign * 1e-4 * points.norm(dim=-1, keepdim=True) * axis
            # The direction of the plane is exact to third order in the miss of 2e-3 rad.
            assert (cost(points + step) > best - 1e-13).all()


def test_a_vertical_miss_does_not_pull_the_point_nearer() -> None:
    left = tensor([0.0, 1e-3, 1.0])
    pose = torch.eye(3, dtype=torch.float64), tensor(-10.0, 0.0, 0.0)
    found = triangulate_pairs(left, tensor([-2e-3, -1e-3, 1.0]), pose)
    # The mid-point of the lines would stand at 2500 m: the rays miss by as much as they converge.
    assert found.points[0, 2].item() == pytest.approx(5000.0, rel=1e-5)


@pytest.mark.parametrize("count", [2, 3])
def test_gradients(count: int) -> None:
    cameras = poses(count)
    rays = rays_to(world_points(4), cameras)
    rays = rays / rays.norm(dim=-1, keepdim=True)
    rays = (rays + 1e-3 * torch.randn(rays.shape, dtype=torch.float64, generator=GENERATOR)).requires_grad_()
    cameras.requires_grad_()
    assert torch.autograd.gradcheck(
        lambda c, r: triangulate_angular(c, r).points * 1e-3, (cameras, rays), eps=1e-7, rtol=1e-4, atol=1e-4
    )


@pytest.mark.parametrize("count", [2, 3])
def test_what_does_not_meet_is_flagged_without_nan(count: int) -> None:
    cameras = torch.eye(3, 4, dtype=torch.float64).repeat(count, 1, 1)
    cameras[:, 0, 3] = -10.0 * torch.arange(count)
    shifts = torch.arange(count, dtype=torch.float64)
    slopes = tensor(-0.01, 0.0, 0.01)[:, None] * shifts  # converging, parallel, diverging
    rays = torch.stack([slopes, torch.zeros_like(slopes), torch.ones_like(slopes)], -1)
    bad = rays[:1].clone()
    bad[0, 1, 1] = torch.nan
    along = tensor([1.0, 0.0, 0.0]).expand(1, count, 3)
    rays = torch.cat([rays, bad, along, torch.zeros_like(along)]).requires_grad_()
    found = triangulate_angular(cameras, rays)
    assert found.valid.tolist() == [True, False, False, False, False, False]
    assert (found.points[1:] == 0).all()
    (gradient,) = torch.autograd.grad(found.points.sum(), rays)
    assert torch.isfinite(gradient).all()
    assert (gradient[1:] == 0).all()


def test_batches_and_pieces() -> None:
    cameras, points = poses(2), world_points(20_000)
    rays = rays_to(points, cameras)
    # More than one piece of the eager path, and a batch of cameras through the path for any number of them.
    whole = triangulate_angular(cameras, rays)
    deep = triangulate_angular(torch.stack([cameras, cameras]), torch.stack([rays[:100], rays[:100]]))
    assert torch.allclose(whole.points, points, rtol=1e-10)
    assert torch.allclose(deep.points[1], points[:100], rtol=1e-10)


def test_side_axes_are_orthonormal() -> None:
    rays = torch.nn.functional.normalize(torch.randn(500, 3, dtype=torch.float64, generator=GENERATOR), dim=-1)
    rays = torch.cat([rays, tensor([0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0])])
    frame = torch.stack([rays, *side_axes(rays)], -1)
    assert torch.allclose(frame.mT @ frame, torch.eye(3, dtype=torch.float64).expand_as(frame), atol=1e-14)


def test_cameras_one_above_the_other() -> None:
    """The axes that the solution works in are made from the baseline, which may point anywhere."""
    points = world_points()
    for step in ([0.0, -10.0, 0.0], [0.0, 0.0, -10.0], [-6.0, -8.0, 0.0], [0.1, 9.0, 0.1]):
        cameras = torch.eye(3, 4, dtype=torch.float64).repeat(2, 1, 1)
        cameras[1, :, 3] = tensor(*step)
        rays = rays_to(points, cameras)
        found, valid = triangulate_pairs(rays[:, 0], rays[:, 1], (cameras[1, :, :3], cameras[1, :, 3]))
        assert valid.all()
        # Parallaxes down to 2e-5 rad where one camera stands behind the other.
        assert ((found - points).norm(dim=-1) / points.norm(dim=-1)).max() < 1e-10


@pytest.mark.parametrize("method", ["angular", "linear"])
def test_who_saw_a_point_counts_for_two_cameras_too(method: Literal["angular", "linear"]) -> None:
    """The other ray is a finite one here; alone and in a batch of rigs."""
    cameras = torch.eye(3, 4, dtype=torch.float64).repeat(2, 1, 1)
    cameras[1, 0, 3] = -10.0
    rays = tensor([0.0, 0.0, 1.0], [-0.002, 0.0, 1.0]).expand(3, 2, 3)
    seen = torch.tensor([[True, True], [True, False], [False, True]])
    for one, lead in ((cameras, ()), (cameras[None], (1,))):
        found = triangulate(one, rays, seen, method=method)
        assert found.valid.reshape(3).tolist() == [True, False, False]
        assert found.valid.shape == (*lead, 3)
        if method == "angular":
            wanted = tensor([0.0, 0.0, 5000.0], [0.0, 0.0, 0.0], [10.0, 0.0, 0.0])
            torch.testing.assert_close(found.points.reshape(3, 3), wanted, rtol=1e-12, atol=1e-12)
    for bad in (seen.double(), seen[0], seen[:, :1]):
        with pytest.raises(InputError, match=r"seen: bool of shape \(..., N, 2\) is needed"):
            triangulate(cameras, rays, bad, method=method)


def test_a_batch_of_rigs_of_two_is_one_by_one() -> None:
    """Where rays miss each other, too."""
    rigs = torch.stack([poses(2), poses(3)[1:], poses(4)[2:]])
    noise = 0.02 * torch.randn(3, 20, 2, 3, dtype=torch.float64, generator=GENERATOR)
    rays = torch.stack([rays_to(world_points(20), rig) for rig in rigs]) + noise
    found, shared = triangulate_angular(rigs, rays), triangulate_angular(rigs, rays[0])
    for k in range(3):
        alone = triangulate_angular(rigs[k], rays[k])
        torch.testing.assert_close(found.points[k], alone.points, rtol=1e-12, atol=1e-12)
        assert torch.equal(found.valid[k], alone.valid)
        torch.testing.assert_close(
            shared.points[k], triangulate_angular(rigs[k], rays[0]).points, rtol=1e-12, atol=1e-12
        )


@pytest.mark.parametrize("method", ["angular", "linear"])
@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("unseen", [0.0, math.nan])
def test_what_nobody_saw_has_no_gradient(method: Literal["angular", "linear"], count: int, unseen: float) -> None:
    cameras = poses(count).requires_grad_()
    rays = rays_to(world_points(3), cameras.detach())
    seen = torch.ones(3, count, dtype=torch.bool)
    seen[0], seen[1, count - 1] = False, False
    rays = torch.where(seen[..., None], rays, unseen).requires_grad_()
    found = triangulate(cameras, rays, seen, method=method)
    assert found.valid.tolist() == [False, count > 2, True]
    gradients = torch.autograd.grad(found.points[found.valid].sum(), (cameras, rays))
    assert all(bool(each.isfinite().all()) for each in gradients)
    assert not gradients[1][~seen].any()
