import pytest
import torch
from locate_rigs import tensor, turned

from kcal.errors import InputError
from kcal.locate.angular import triangulate_linear

GENERATOR = torch.Generator().manual_seed(5)


def stereo(baseline: float = 10.0) -> torch.Tensor:
    """Left at the origin; right `baseline` to its right, turned a little."""
    rotation = turned(1.0, 0.5, -0.3)
    right = torch.cat([rotation, (rotation @ tensor(-baseline, 0.0, 0.0))[:, None]], -1)
    return torch.stack([torch.eye(3, 4, dtype=torch.float64), right])


def rays_to(points: torch.Tensor, cameras: torch.Tensor) -> torch.Tensor:
    """(N, 3) world points to (N, C, 3) directions in the cameras' frames."""
    return torch.einsum("cij,nj->nci", cameras[:, :, :3], points) + cameras[:, :, 3]


def world_points(n: int = 40, near: float = 50.0, far: float = 5000.0) -> torch.Tensor:
    depth = torch.logspace(torch.tensor(near).log10(), torch.tensor(far).log10(), n, dtype=torch.float64)
    angles = 0.5 * (torch.rand(n, 2, dtype=torch.float64, generator=GENERATOR) - 0.5)
    return torch.cat([angles * depth[:, None], depth[:, None]], -1)


@pytest.mark.parametrize("baseline", [0.5, 10.0, 100.0])
def test_exact_rays_give_the_point_back(baseline: float) -> None:
    points, cameras = world_points(), stereo(baseline)
    found, valid = triangulate_linear(cameras, rays_to(points, cameras))
    assert valid.all()
    # Rounding of a ray (1e-16) grows with range / baseline, up to 1e4 here.
    assert ((found - points).norm(dim=-1) / points.norm(dim=-1)).max() < 1e-11


def test_agrees_with_equation_9_as_printed() -> None:
    points, cameras = world_points(8), stereo()
    for point, pair in zip(points, rays_to(points, cameras), strict=True):
        rows = []
        for (x, y, z), P in zip(pair.tolist(), cameras, strict=True):
            rows += [x / z * P[2] - P[0], y / z * P[2] - P[1]]
        solution = torch.linalg.svd(torch.stack(rows))[2][3]
        by_paper = solution[:3] / solution[3]
        # The paper's unscaled system loses some digits itself.
        assert torch.allclose(by_paper, point, rtol=1e-9)
        assert torch.allclose(triangulate_linear(cameras, pair[None])[0][0], by_paper, rtol=1e-9)


def test_far_origins_cost_no_digits() -> None:
    # The same scene at an earth radius from the origin, as in ECEF.
    points, cameras = world_points(), stereo()
    shift = tensor(1.8e6, 5.7e6, 2.1e6)
    moved = cameras.clone()
    moved[:, :, 3] -= cameras[:, :, :3] @ shift
    found, valid = triangulate_linear(moved, rays_to(points, cameras))
    assert valid.all()
    # The matrices hold the centers to 1e-9 m only: 1e-10 of the baseline, hence of the range.
    assert (found - shift - points).norm(dim=-1).max() < 5e-6


def test_three_cameras_and_batches() -> None:
    third = torch.cat([turned(-2.0), turned(-2.0) @ tensor([0.0], [-30.0], [4.0])], -1)
    cameras = torch.cat([stereo(), third[None]])
    points = world_points(12)
    rays = rays_to(points, cameras)
    found, valid = triangulate_linear(cameras, rays)
    assert valid.all()
    assert torch.allclose(found, points, rtol=1e-11, atol=1e-10)

    batched, _ = triangulate_linear(cameras[None, None], torch.stack([rays, rays.flip(0)])[:, None])
    assert batched.shape == (2, 1, 12, 3)
    assert torch.allclose(batched[1, 0], found.flip(0), rtol=1e-11)
    with pytest.raises(InputError, match="to fit the cameras"):
        triangulate_linear(stereo(), rays)
    with pytest.raises(InputError, match="C >= 2"):
        triangulate_linear(cameras[:1], rays[:, :1])
    with pytest.raises(InputError, match="floating"):
        triangulate_linear(cameras, rays.long())


def test_length_of_rays_is_no_weight() -> None:
    points, cameras = world_points(), stereo()
    rays = rays_to(points, cameras)
    rays = rays + 1e-4 * torch.randn(rays.shape, dtype=torch.float64, generator=GENERATOR) * rays[..., 2:]
    scaled = rays * torch.rand(*rays.shape[:2], 1, dtype=torch.float64, generator=GENERATOR).add(0.01)
    a, b = triangulate_linear(cameras, rays)[0], triangulate_linear(cameras, scaled)[0]
    assert torch.allclose(a, b, rtol=1e-11, atol=1e-9)


def test_first_and_second_derivatives() -> None:
    cameras = stereo().requires_grad_()
    # Inconsistent rays: the general case, with a smallest singular value that is not zero.
    rays = rays_to(world_points(3, far=200.0), cameras.detach())
    rays = rays / rays.norm(dim=-1, keepdim=True)
    rays = (rays + 2e-3 * torch.randn(rays.shape, dtype=torch.float64, generator=GENERATOR)).requires_grad_()

    def scaled(cameras: torch.Tensor, rays: torch.Tensor) -> torch.Tensor:
        return triangulate_linear(cameras, rays)[0] / 100.0

    # Differences of a range by an angle: slopes of 1e3 and curvatures of 1e6 need these tolerances.
    assert torch.autograd.gradcheck(scaled, (cameras, rays), eps=1e-7, rtol=1e-5, atol=1e-5)
    assert torch.autograd.gradgradcheck(scaled, (cameras, rays), eps=1e-7, rtol=1e-4, atol=1e-2)


def test_equal_singular_values_do_not_spoil_the_gradient() -> None:
    # Six cameras 1 m from the origin on the axes, all looking at it: singular values 2, 2, 2, 0.
    axes = [tensor([1, 0, 0], [0, 1, 0], [0, 0, 1]).roll(shift, 0) for shift in range(3)]
    rotations = [rotation * tensor([sign], [1], [sign]) for rotation in axes for sign in (1.0, -1.0)]
    cameras = torch.stack([torch.cat([rotation, tensor([0.0], [0.0], [1.0])], -1) for rotation in rotations])
    rays = tensor([0.0, 0.0, 1.0]).expand(1, 6, 3).clone().requires_grad_()

    system = torch.linalg.cross(*torch.broadcast_tensors(rays[..., None], cameras), dim=-2).flatten(-3, -2)
    solution = torch.linalg.svd(system, full_matrices=False)[2][..., 3, :]
    (plain,) = torch.autograd.grad((solution[..., 0] / solution[..., 3]).sum(), rays)
    assert torch.isnan(plain).any(), "torch's own derivative has become finite: the chord steps may no longer be needed"

    found, valid = triangulate_linear(cameras, rays)
    assert valid.all()
    assert found.abs().max() < 1e-15
    (slopes,) = torch.autograd.grad(found[0, 2], rays)
    # The first camera looks along the world's z; the four cameras across it pull the point with equal weights.
    assert slopes[0, 0].abs().max() < 1e-12
    assert slopes[0, 2:].norm(dim=-1).tolist() == pytest.approx([0.25] * 4, abs=1e-12)


@pytest.mark.parametrize(
    ("left", "right", "why"),
    [
        ([0, 0, 1], [0, 0, 1], "parallel"),
        ([0, 0, 1], [0.1, 0, 1], "diverging: the lines cross behind"),
        ([1, 0, 0], [1, 0, 0], "both along the baseline"),
        ([float("nan"), 0, 1], [0, 0, 1], "not finite"),
        ([0, 0, 0], [0, 0, 1], "no direction"),
    ],
)
def test_what_cannot_be_located_is_flagged_and_finite(left: list[float], right: list[float], why: str) -> None:
    cameras = torch.eye(3, 4, dtype=torch.float64).repeat(2, 1, 1)
    cameras[1, 0, 3] = -10.0
    rays = tensor([left, right], [[0.05, 0, 1], [-0.05, 0, 1]]).requires_grad_()
    found, valid = triangulate_linear(cameras, rays)
    assert valid.tolist() == [False, True], why
    assert found[0].tolist() == [5.0, 0.0, 0.0]
    found.sum().backward()
    assert torch.isfinite(rays.grad).all()
    assert (rays.grad[0] == 0).all()
