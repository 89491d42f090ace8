"""Each step of what errors of matches have in common, against values worked out by hand or in plain loops."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from kcal import Camera, Rig
from kcal.lens.pose import rotation_from_vector
from kcal.scene import common_errors as parts
from kcal.scene.common_errors import line_errors

DRAW = torch.Generator().manual_seed(8)
FLAT = torch.zeros(3, dtype=torch.float64)


def level_rig(roll: float = 0.0) -> Rig:
    """Pinholes side by side, f 500 px, a meter apart; the right one rolled about its axis."""
    camera = Camera.build(focal=(500, 500), center=(240, 160), size=(481, 321), model="pinhole")
    turn = rotation_from_vector(torch.tensor([0.0, 0.0, roll], dtype=torch.float64))
    return Rig.pair(camera, camera, turn, turn @ torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64))


@pytest.mark.parametrize("roll", [0.0, 0.5, -1.2])
def test_off_the_line_by_so_many_pixels(roll: float) -> None:
    """Side by side, lines are rows: what is off is the difference of rows, in the frame of the rolled image."""
    rig = level_rig(roll)
    turn = rig.right_from_left_rotation[:2, :2]
    left = torch.tensor([[250.0, 170.0], [100.0, 60.0], [400.0, 300.0]]).double()
    middle = torch.tensor([240.0, 160.0]).double()
    right = (left + torch.tensor([[-9.0, 0.7], [-3.0, -0.4], [-30.0, 0.0]]).double() - middle) @ turn.T + middle
    own = torch.tensor([[0.04, 0.01], [0.01, 0.09]]).double()
    found = line_errors(rig, torch.stack([left, right], 1))
    assert float(torch.sign(found.off[0])) * found.off == pytest.approx([0.7, -0.4, 0.0], abs=1e-3)
    assert found.sigma((turn @ own @ turn.T).expand(3, 2, 2)) == pytest.approx(3 * [0.3], rel=2e-3)


def test_no_matches_have_slopes_of_their_shape() -> None:
    """So that a pair without matches goes with others."""
    found = line_errors(level_rig(), torch.zeros(0, 2, 2).double())
    assert (found.off.shape, found.slopes.shape) == ((0,), (0, 5))


def test_smooth_errors_are_the_lenses() -> None:
    """A polynomial of degree four goes altogether; one of degree five stays in part; what is far off stays whole."""
    at = 400.0 * torch.rand(300, 2, generator=DRAW).double()
    u, v = ((at - 200.0) / 120.0).unbind(1)
    smooth = 0.1 + 0.2 * u - 0.1 * v + 0.1 * u * v**3 + 0.05 * u**4 - 0.02 * v**4 + 0.03 * u**2 * v**2
    sigma = 0.5 + torch.rand(300, generator=DRAW).double()
    left = parts._without_lenses(smooth, sigma, at)
    assert float(left.abs().max()) < 1e-10
    assert float(parts._without_lenses(u**5 / 5, 20 * sigma, at).abs().max()) > 0.02
    odd = smooth.clone()
    odd[7] += 6.0 * sigma[7] + smooth.abs().max()
    odd[9] -= 6.0 * sigma[9] + smooth.abs().max()
    left = parts._without_lenses(odd, sigma, at)
    assert left[[7, 9]] == pytest.approx((odd - smooth)[[7, 9]], abs=1e-9)
    left[[7, 9]] = 0.0
    assert float(left.abs().max()) < 1e-9


def test_smooth_errors_by_weight_and_of_enough() -> None:
    """Of two errors at each place the weighted mean is smooth: (0 + 1/4) / (1 + 1/4) of 0 ± 1 and 1 ± 2."""
    at = 400.0 * torch.rand(40, 2, generator=DRAW).double().repeat(2, 1)
    error, sigma = (torch.tensor([0.0, 1.0]).double().repeat_interleave(40) + k for k in (0.0, 1.0))
    assert parts._without_lenses(error, sigma, at) == pytest.approx([-0.2] * 40 + [0.8] * 40)
    # Four for each of the 15 coefficients.
    ones = torch.ones(60).double()
    assert float(parts._without_lenses(ones, ones, at[:60]).abs().max()) < 1e-9
    assert parts._without_lenses(ones[:59], ones[:59], at[:59]).tolist() == [1.0] * 59
    # One row of pixels: no spread downward.
    at[:, 1] = 7.0
    assert float(parts._without_lenses(ones, ones, at[:60]).abs().max()) < 1e-9


@pytest.mark.parametrize("count", [0, 1])
def test_columns_of_hardly_any_places(count: int) -> None:
    """Without a warning, which would stop the tests; one place is the middle."""
    found = parts.smooth_columns(torch.full((count, 2), 7.0).double())
    assert found.tolist() == [[1.0] + [0.0] * 14] * count


def test_variance_of_errors() -> None:
    """Errors that have scale σ² + floor exactly; never less than σ² without a floor; too few tell nothing."""
    sigma = torch.tensor([0.02, 0.2, 0.05]).double().repeat(20)
    floor = parts._FLOORS[13]
    error = (2.0 * (sigma.square() + floor)).sqrt() * torch.tensor([1.0, -1.0]).repeat(30)
    assert parts._error_variance(error, sigma) == pytest.approx((2.0, 2.0 * floor))
    assert parts._error_variance(1.5 * sigma, sigma) == pytest.approx((2.25, 0.0))
    assert parts._error_variance(sigma[:50], sigma[:50]) == pytest.approx((1.0, 0.0))
    assert parts._error_variance(3.0 * sigma[:50], sigma[:50]) == pytest.approx((9.0, 0.0))
    assert parts._error_variance(3.0 * sigma[:49], sigma[:49]) == (1.0, 0.0)


def test_classes_of_shares() -> None:
    share = torch.rand(400, generator=DRAW).double()
    for count, pairs, classes in ((400, 2, 4), (399, 2, 3), (199, 2, 1), (400, 1, 4), (100, 1, 2), (20, 1, 1)):
        found = parts._classes(share[:count], pairs)
        sizes = found.bincount()
        assert len(sizes) == classes
        assert int(sizes.max() - sizes.min()) <= 1
        assert found[share[:count].argsort()].tolist() == sorted(found.tolist())


def test_shifts_between_pairs() -> None:
    """What most matches of about the same disparity say, in whole and parts of pixels; of too few, nothing."""
    count = 80
    left = 300.0 * torch.rand(count, 2, generator=DRAW).double()
    disparity = torch.stack([-30.0 * torch.rand(count, generator=DRAW).double(), torch.zeros(count).double()], 1)
    moves = torch.tensor([[0.0, 0.0], [3.25, -1.75], [-2.5, 4.5]]).double()
    places = torch.cat([torch.stack([left + move, left + move + disparity], 1) for move in moves])
    # A fifth has moved otherwise.
    places[count : count + 16, :, 0] += 4.0
    pair = torch.arange(3).repeat_interleave(count)
    assert parts._shifts(places, pair) == pytest.approx(moves, abs=1e-9)
    # Another disparity is another thing: 1.6 px instead of at most 1.5.
    other = places.clone()
    other[count : 2 * count, 1, 0] += 1.6
    assert parts._shifts(other, pair)[1].tolist() != pytest.approx([3.25, -1.75], abs=0.5)
    far = torch.stack([left[:60], left[:60]], 1)
    far = far * 1000.0
    both = torch.cat([far, far + 2.0])
    for enough, found in ((50, 2.0), (49, 0.0)):
        some = torch.cat([both[:60], both[60 : 60 + enough]])
        which = torch.arange(2).repeat_interleave(torch.tensor([60, enough]))
        assert parts._shifts(some, which)[1].tolist() == pytest.approx([found, found])


def test_the_common_share() -> None:
    """Mean product of two errors in sigmas over the overlap that it had from patches; between 0 and 1."""
    error = torch.tensor([0.1, 0.4, -0.2, 0.3]).double()
    variance = torch.tensor([0.04, 0.16, 0.01, 0.09]).double()
    # In sigmas .5, 1, -2, 1: products .5 and -2.
    same = torch.tensor([[0, 1]] * 50 + [[2, 3]] * 5)
    overlap = torch.full((55,), 0.5).double()
    assert parts._common_share(error, variance, same, overlap) == pytest.approx((25.0 - 10.0) / 27.5)
    assert parts._common_share(error, variance, same[:49], overlap[:49]) == 1.0
    assert parts._common_share(error, variance, same[:50], overlap[:50]) == 1.0
    assert parts._common_share(error, variance, same[:50], 2 * overlap[:50]) == pytest.approx(0.5)
    assert parts._common_share(error, variance, torch.tensor([[2, 3]] * 60), torch.ones(60).double()) == 0.0


def stated(values: list[float]) -> Tensor:
    return torch.tensor(values).double()[:, None, None] * torch.tensor([[2.0, 0.5], [0.5, 1.0]]).double()


def matches(left: list[list[float]]) -> Tensor:
    """Of pinholes side by side, exactly on their lines."""
    own = torch.tensor(left).double()
    return torch.stack([own, own - torch.tensor([10.0, 0.0]).double()], 1)


def test_too_few_to_learn_from_count_their_overlap() -> None:
    """Half a patch beside: (1 + 1/2); with four times the variance 1 + 1/2 · 2/4 and, from the other's view, 4 of 2."""
    rig, half = level_rig(), parts.PATCH / 2.0

    def factor(left: list[list[float]], values: list[float]) -> list[float]:
        covariance = stated(values)
        lines = line_errors(rig, matches(left))
        (found,) = parts.with_common_errors([lines], [matches(left)], [covariance], [torch.zeros(len(left)).double()])
        share = found / covariance
        assert share.flatten(1).amax(1) == pytest.approx(share.flatten(1).amin(1))
        return share[:, 0, 0].tolist()

    assert factor([[100, 100], [100 + half, 100]], [1.0, 1.0]) == pytest.approx([1.5, 1.5])
    assert factor([[100, 100], [100, 100 + half]], [1.0, 1.0]) == pytest.approx([1.5, 1.5])
    assert factor([[100, 100], [100 + half, 100 - half]], [1.0, 1.0]) == pytest.approx([1.25, 1.25])
    assert factor([[100, 100], [100 + half, 100]], [1.0, 4.0]) == pytest.approx([1.25, 2.0])
    assert factor([[100, 100], [100 + 2.1 * half, 100]], [1.0, 1.0]) == pytest.approx([1.0, 1.0])
    assert factor([[100, 100], [100 + half, 100], [100 - half, 100]], [1.0] * 3) == pytest.approx([2.0, 1.5, 1.5])


def test_one_thing_in_three_pairs_counts_once() -> None:
    rig = level_rig()
    pixels = [matches([[100, 100], [300, 200]]), matches([[100, 100]]), matches([[100, 100]])]
    covariance = [stated([1.0, 1.0]), stated([1.0]), stated([1.0])]
    fits = [torch.ones(len(own)).double() for own in pixels]
    found = parts.with_common_errors([line_errors(rig, own) for own in pixels], pixels, covariance, fits)
    assert [len(one) for one in found] == [2, 1, 1]
    assert torch.cat(found)[:, 1, 1] == pytest.approx([3.0, 1.0, 3.0, 3.0])


def test_learned_parts_against_plain_loops() -> None:
    """Two pairs of things some of which are alike: scale, floor, share and overlaps put together one by one."""
    rig, count = level_rig(), 70
    draw = torch.Generator().manual_seed(5)
    left = torch.tensor([[20.0 + 21.5 * i, 20.0 + 33.0 * j] for i in range(14) for j in range(5)]).double()
    beside = left[::3] + torch.tensor([4.0, -6.0]).double()
    shared = 0.08 * torch.randn(count, generator=draw).double()
    pixels, covariance = [], []
    for k in range(2):
        own = torch.cat([left, beside]) + 1.25 * k
        right = own - torch.tensor([10.0, 0.0]).double()
        right[:count, 1] += shared
        right[:, 1] += 0.05 * torch.randn(len(right), generator=draw).double()
        pixels.append(torch.stack([own, right], 1))
        covariance.append(stated((0.002 + 0.004 * torch.rand(len(own), generator=draw)).tolist()))
    fits = [torch.ones(len(own)).double()] * 2
    lines = [line_errors(rig, own) for own in pixels]
    found = torch.cat(parts.with_common_errors(lines, pixels, covariance, fits))

    places, every = torch.cat(pixels), torch.cat(covariance)
    together = line_errors(rig, places)
    off, sigma = together.off, together.sigma(every)
    variance = sigma**2
    for _ in range(2):
        error = parts._without_lenses(off, variance**0.5, places[:, 0])
        good = error.abs() < 5.0 * sigma
        scale, floor = parts._error_variance(error[good], sigma[good])
        variance = scale * sigma**2 + floor
    size = len(pixels[0])
    still = places[:, 0] - 1.25 * torch.tensor([[0.0]] * size + [[1.0]] * size).double()
    overlap = np.zeros((2 * size, 2 * size))
    same = []
    x, y = still.T.tolist()
    for i in range(2 * size):
        for j in range(2 * size):
            dx, dy = abs(x[i] - x[j]), abs(y[i] - y[j])
            overlap[i, j] = max(0.0, 1 - dx / parts.PATCH) * max(0.0, 1 - dy / parts.PATCH)
            if i < size <= j and max(dx, dy) < 1.5 and bool(good[i] & good[j]):
                same.append((i, j))
    assert len(same) > 50
    products = sum(float(error[i] * error[j] / (variance[i] * variance[j]).sqrt()) for i, j in same)
    share = products / sum(overlap[i, j] for i, j in same)
    assert 0.3 < share < 0.95
    weight = [1.0 / (share * v + (1 - share) * v / 2) for v in variance.tolist()]
    for i in range(2 * size):
        total = float(variance[i]) * weight[i]
        for j in range(2 * size):
            if i != j and overlap[i, j]:
                part = overlap[i, j] * math.sqrt(float(variance[i] * variance[j]))
                total += part * weight[j] * (1.0 if (i < size) == (j < size) else share)
        own = scale * every[i] + floor * torch.eye(2).double()
        wanted = total / weight[i] / float(variance[i]) * own
        assert found[i].flatten().tolist() == pytest.approx(wanted.flatten().tolist(), rel=1e-6)
