import math

import pytest
import torch
from locate_rigs import pinhole_rig, tensor

from kcal import Localizer
from kcal.locate.stereo import PositionStatus, range_interval

N = 20_000


@pytest.mark.parametrize("z", [1000.0, 5000.0, 16_000.0])
def test_interval_covers_95_percent_of_noisy_marks(z: float) -> None:
    # f b = 16 000 px m: 16, 3.2 and 1 px of disparity against 0.42 px of noise in it.
    rig = pinhole_rig(1600.0, 10.0)
    point = tensor([150.0, -40.0, z])
    left, right = rig(point)[0].unbind(-2)
    noise = 0.3 * torch.randn(2, N, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(11))
    result = Localizer(rig, pixel_sigma=0.3)(left + noise[0], right + noise[1])
    true_range = point.norm()
    covered = (result.range_low <= true_range) & (true_range <= result.range_high)
    # 20 000 draws know 95 % to 0.15 %; the approximations of the interval must fit in the rest.
    assert 0.94 < covered.double().mean().item() < 0.96
    below, above = (true_range < result.range_low).double().mean(), (true_range > result.range_high).double().mean()
    assert 0.02 < below.item() < 0.03
    assert 0.02 < above.item() < 0.03


def test_disparity_at_and_below_zero_is_bearing_only_with_an_open_end() -> None:
    rig = pinhole_rig(1600.0, 10.0)
    disparity = tensor(3.2, 1.3, 1.25, 0.2, 0.0, -0.2, -5.0)
    left = torch.stack([960.0 + disparity, torch.full_like(disparity, 540.0)], -1)
    right = torch.stack([torch.full_like(disparity, 960.0), torch.full_like(disparity, 540.0)], -1)
    result = Localizer(rig, pixel_sigma=0.3)(left, right)
    # 3 sigma of the disparity are 3 * 0.3 * sqrt(2) = 1.27 px; 1.96 sigma are 0.83 px.
    assert torch.isinf(result.range_high).tolist() == [False, False, False, True, True, True, True]
    names = ["OK"] * 2 + ["BEARING_ONLY"] * 2 + ["PARALLEL"] * 3
    assert [PositionStatus(s).name for s in result.status.tolist()] == names
    # Nearest possible: 16 000 px m / (d + 0.83 px); diverging by 5 px no range explains the marks.
    expected = [16_000 / (d + 1.959964 * 0.3 * math.sqrt(2)) for d in (3.2, 1.3, 1.25, 0.2, 0.0, -0.2)]
    # Disparity over focal length is the tangent of the parallax: 1e-5 relative at these angles.
    assert result.range_low[:6].tolist() == pytest.approx(expected, rel=1e-4)
    assert result.range_low[6].item() == math.inf


def test_interval_is_skewed_outward() -> None:
    # Half a pixel of noise in the disparity at 5 km: 95 % is 3.8 to 7.2 km, not 5 ± 1.5.
    f = 1600.0
    low, high = range_interval(tensor(3.2 / (10.0 * f)), tensor(0.5 / (10.0 * f)))
    assert low.item() == pytest.approx(3828, abs=1)
    assert high.item() == pytest.approx(7207, abs=1)


def test_gradients_are_finite_at_infinity() -> None:
    inverse = tensor(1e-4, 0.0, -1e-4).requires_grad_()
    ranges = range_interval(inverse, torch.zeros(3, dtype=torch.float64))[1]
    gradient = torch.autograd.grad(ranges[torch.isfinite(ranges)].sum(), inverse)[0]
    assert gradient[0].item() == pytest.approx(-1e8, rel=1e-5)
    assert gradient[1:].tolist() == [0.0, 0.0]
