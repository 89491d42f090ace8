import math

import pytest
import torch
from locate_rigs import pinhole_rig, tensor

from kcal import InputError, Localizer, Origin
from kcal.locate.tabulate import circular_error


def test_circles_lines_and_ellipses() -> None:
    enu = tensor([0.0, 1e6, 0.0]).expand(3, 3)
    radii = circular_error(enu, torch.diag_embed(tensor([1.0, 1.0, 1.0], [1e-3, 1.0, 1e-3], [0.5, 1.0, 2.0]) ** 2))
    # Rayleigh; one-dimensional normal; and by integration for an aspect of two.
    assert radii[0].tolist() == pytest.approx([math.sqrt(2 * math.log(2)), math.sqrt(-2 * math.log(0.05))], rel=5e-3)
    assert radii[1].tolist() == pytest.approx([0.6745, 1.9600], rel=5e-3)
    assert radii[2].tolist() == pytest.approx([0.8696, 2.0345], rel=5e-3)


def test_skewed_positions_of_a_real_geometry_by_simulation() -> None:
    """0.1 px at 5 km and f b = 16 000 px m: a thousand times longer than wide."""
    rig, n = pinhole_rig(1600.0, 10.0), 40_000
    left, right = rig(tensor([0.0, 0.0, 5000.0]))[0].unbind(-2)
    module = Localizer(rig.placed(origin=Origin(lat=0.0, lon=0.0, height=0.0), heading_deg=0.0), pixel_sigma=0.1)
    noise = 0.1 * torch.randn(2, n, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    found = module(left + noise[0], right + noise[1])
    middle = module(left, right)
    radii = circular_error(middle.enu[0], middle.covariance[0])
    distance = (found.enu - middle.enu)[:, :2].norm(dim=-1)
    # 40 000 draws know a quantile to 0.5 %.
    assert radii.tolist() == pytest.approx(distance.quantile(tensor(0.5, 0.95)).tolist(), rel=0.015)
    # The usual formula for nearly round ellipses misses.
    east, north = middle.covariance[0].diagonal()[:2].sqrt().tolist()
    assert abs(2.0789 * (east + north) / 2 * 1.177 / radii[1].item() - 1) > 0.1
    # Counted from each estimate, as a user does: the shares hold.
    each = circular_error(found.enu[:2000], found.covariance[:2000])
    inside = (found.enu - middle.enu)[:2000, :2].norm(dim=-1, keepdim=True) <= each
    assert inside.double().mean(0).tolist() == pytest.approx([0.5, 0.95], abs=0.025)


def test_the_unknown_is_infinite() -> None:
    enu = tensor([0.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 100.0, 0.0])
    cov = torch.diag_embed(tensor([1.0, 1.0, 1.0], [math.inf] * 3, [1.0, 1e4, 1.0]))
    radii = circular_error(enu, cov)
    assert torch.isinf(radii[:2]).all()
    # A range of 100 ± 100 m: 16 % of what is possible lies beyond infinity.
    assert torch.isfinite(radii[2]).tolist() == [True, False]
    with pytest.raises(InputError, match="probabilities"):
        circular_error(enu, cov, (1.0,))
    with pytest.raises(InputError, match="covariance"):
        circular_error(enu, cov[0])


def sampled(enu: torch.Tensor, covariance: torch.Tensor, draws: int) -> list[float]:
    """The same two radii by drawing errors of X / |X|² in space."""
    distance = enu.norm()
    slope = (torch.eye(3).double() - 2.0 * torch.outer(enu, enu) / distance**2) / distance**2
    factor = torch.linalg.cholesky(slope @ covariance @ slope.T)
    uniform = torch.quasirandom.SobolEngine(3, scramble=True, seed=5).draw(draws, dtype=torch.float64)
    drawn = enu / distance**2 + torch.special.ndtri(uniform.clamp(1e-12, 1 - 1e-12)) @ factor.T
    away = (drawn / drawn.square().sum(-1, keepdim=True) - enu)[:, :2].norm(dim=-1)
    away = torch.where(drawn @ enu > 0, away, torch.inf).sort().values
    return [away[round(share * draws)].item() for share in (0.5, 0.95)]


@pytest.mark.parametrize("elevation", [0.0, 40.0, 80.0])
@pytest.mark.parametrize("along", [0.002, 0.05, 0.2, 0.3])
@pytest.mark.parametrize(("level", "upward"), [(1e-4, 1e-4), (0.005, 0.001), (0.006, 0.006), (0.1, 0.05)])
def test_radii_are_those_of_many_draws(elevation: float, along: float, level: float, upward: float) -> None:
    up, flat = math.sin(math.radians(elevation)), math.cos(math.radians(elevation))
    sight, across = tensor(0.6 * flat, 0.8 * flat, up), tensor(0.8, -0.6, 0.0)
    above = torch.linalg.cross(across, sight)
    # Errors along and across go together, as those of yaw and heading do.
    mixed = along * sight + 0.5 * level * flat * across
    parts = (mixed, level * flat * across, upward * flat * above, 1e-5 * sight)
    covariance = 1e6 * sum(torch.outer(part, part) for part in parts)
    expected = sampled(1e3 * sight, covariance, 2**17)
    # Where errors across are large, kcal draws 2^13 itself.
    exact = level < 0.1
    assert circular_error(1e3 * sight, covariance).tolist() == pytest.approx(expected, rel=3e-3 if exact else 1.5e-2)
