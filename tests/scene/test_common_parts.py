"""Each step of what errors of matches have in common, against values worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.special import ndtri
from scipy.stats import t as student
from torch import Tensor

from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector
from kcal.lens.rig import StereoRig
from kcal.scene import common_errors as parts

DRAW = torch.Generator().manual_seed(8)


def level_rig(roll: float = 0.0) -> StereoRig:
    """Pinholes side by side, f 500 px, a meter apart; the right one rolled about its axis."""
    camera = Camera.build(focal=(500, 500), center=(240, 160), size=(481, 321), model="pinhole")
    turn = rotation_from_vector(torch.tensor([0.0, 0.0, roll], dtype=torch.float64))
    return StereoRig(camera, camera, turn, turn @ torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64))


@pytest.mark.parametrize("roll", [0.0, 0.5, -1.2])
def test_off_the_line_by_so_many_pixels(roll: float) -> None:
    """Side by side, lines are rows: what is off is the difference of rows, in the frame of the rolled image."""
    rig = level_rig(roll)
    turn = rig.right_from_left_rotation[:2, :2]
    left = torch.tensor([[250.0, 170.0], [100.0, 60.0], [400.0, 300.0]]).double()
    middle = torch.tensor([240.0, 160.0]).double()
    apart = torch.tensor([[-9.0, 0.7], [-3.0, -0.4], [-30.0, 0.0]]).double()
    right = (left + apart - middle) @ turn.T + middle
    own = torch.tensor([[0.04, 0.01], [0.01, 0.09]]).double()
    off, sigma = parts.off_line(rig, torch.stack([left, right], 1), (turn @ own @ turn.T).expand(3, 2, 2))
    sign = float(torch.sign(off[0]))
    assert sign * off == pytest.approx([0.7, -0.4, 0.0], abs=1e-3)
    assert sigma == pytest.approx(3 * [0.3], rel=2e-3)


def test_smooth_errors_are_the_lenses() -> None:
    """A polynomial of degree four goes altogether, one of degree five stays; leverages add up to their number."""
    at = 400.0 * torch.rand(300, 2, generator=DRAW).double()
    u, v = ((at - 200.0) / 120.0).unbind(1)
    smooth = 0.1 + 0.2 * u - 0.1 * v + 0.1 * u * v**3 + 0.05 * u**4 - 0.02 * v**4 + 0.03 * u**2 * v**2
    weight = 0.5 + torch.rand(300, generator=DRAW).double()
    left, leverage = parts._without_lenses(smooth, weight, at)
    assert float(left.abs().max()) < 1e-10
    assert float(leverage.sum()) == pytest.approx(15.0)
    assert float(parts._without_lenses(u**5 / 5, weight, at)[0].abs().max()) > 0.02


def test_smooth_errors_by_weight_and_of_enough() -> None:
    """Of two errors at each place the weighted mean is smooth: (0 + 1/4) / (1 + 1/4) of 0 ± 1 and 1 ± 2."""
    at = 400.0 * torch.rand(40, 2, generator=DRAW).double().repeat(2, 1)
    error = torch.tensor([0.0, 1.0]).double().repeat_interleave(40)
    left, leverage = parts._without_lenses(error, (error + 1.0) ** -2, at)
    assert left == pytest.approx([-0.2] * 40 + [0.8] * 40)
    # Each place is told four times as much by the better of the two.
    assert leverage[:40] == pytest.approx(4.0 * leverage[40:])
    # Four for each of the 15 coefficients.
    ones = torch.ones(60).double()
    assert float(parts._without_lenses(ones, ones, at[:60])[0].abs().max()) < 1e-9
    left, leverage = parts._without_lenses(ones[:59], ones[:59], at[:59])
    assert (left.tolist(), leverage.tolist()) == ([1.0] * 59, [0.0] * 59)
    # One row of pixels: no spread downward.
    at[:, 1] = 7.0
    assert float(parts._without_lenses(ones, ones, at[:60])[0].abs().max()) < 1e-9


@pytest.mark.parametrize("tail", [3.0, 10.0])
def test_the_likeliest_scale_and_tail(tail: float) -> None:
    """Quantiles of Student's distribution: its squared scale, and its degrees of freedom or a neighbor of them."""
    error = torch.from_numpy(student.ppf((np.arange(4000) + 0.5) / 4000, tail))
    sigma = torch.full((4000,), 0.5).double()
    shape, found = parts._error_variance(1.5 * error, sigma)
    assert found == tail
    assert shape == pytest.approx(np.full(4000, 2.25), rel=0.03)


def test_variance_of_errors() -> None:
    """Errors of scale σ² + floor without tails; never less than σ²."""
    sigma = torch.tensor([0.02, 0.2, 0.05]).double().repeat(400)
    floor = parts._FLOORS[9]
    normal = torch.from_numpy(ndtri((np.arange(400) + 0.5) / 400)).repeat_interleave(3)
    shape, tail = parts._error_variance((2.0 * (sigma.square() + floor)).sqrt() * normal, sigma)
    assert tail >= 30.0
    assert shape / (2.0 * (sigma.square() + floor)) == pytest.approx(np.ones(1200), rel=0.05)
    shape, _ = parts._error_variance(0.1 * sigma * normal, sigma)
    assert bool((shape >= sigma.square() - 1e-12).all())


def test_what_few_errors_tell() -> None:
    """Of fifty something is learned; of fewer nothing, and they count as noise says."""
    at, kind, repeats = (
        400.0 * torch.rand(50, 2, generator=DRAW).double(),
        torch.zeros(50).long(),
        torch.ones(50).double(),
    )
    sigma = torch.full((50,), 0.1).double()
    error = 0.3 * torch.from_numpy(ndtri((np.arange(50) + 0.5) / 50))
    *_, variance, _ = parts._learned(error, sigma, at, kind, repeats)
    assert float(variance.min()) > 4.0 * 0.1**2
    shape, influence, variance, weight = parts._learned(*(part[:49] for part in (error, sigma, at, kind, repeats)))
    assert torch.equal(variance, sigma[:49].square())
    assert torch.equal(shape, variance)
    assert torch.equal(influence, error[:49])
    assert weight.tolist() == [1.0] * 49
    # Errors a tenth of noise are noise.
    *_, variance, _ = parts._learned(0.03 * error, sigma, at, kind, repeats)
    assert float(variance.min()) >= 0.1**2 - 1e-12


def test_classes_of_slant_and_misfit() -> None:
    """Fifty for each at least: halves of slant, and in each as many of little as of much misfit."""
    slant, misfit = torch.rand(2, 400, generator=DRAW).double()
    for count, pairs, classes in ((400, 2, 4), (399, 2, 2), (100, 1, 2), (99, 1, 1), (200, 1, 4), (20, 1, 1)):
        some = [part[:count].split(count // pairs + count % pairs) for part in (slant, misfit)]
        found = parts._classes(*some)
        sizes = found.bincount()
        assert len(sizes) == classes, (count, pairs)
        assert int(sizes.max() - sizes.min()) <= 2
    found = parts._classes([slant], [misfit])
    assert float(slant[found < 2].max()) < float(slant[found >= 2].min())
    for low in (0, 2):
        assert float(misfit[found == low].max()) < float(misfit[found == low + 1].min())
    # Of pairs with other contrast, each counts by its own.
    other = parts._classes([slant, slant], [misfit, 7.0 * misfit])
    assert other[:400].tolist() == other[400:].tolist()


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
        none = [torch.zeros(len(left)).double()]
        (found,) = parts.with_common_errors([rig], [matches(left)], [covariance], none, none)
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
    slant = [torch.zeros(len(own)).double() for own in pixels]
    found = parts.with_common_errors([rig] * 3, pixels, covariance, slant, slant)
    assert [len(one) for one in found] == [2, 1, 1]
    ratio = torch.cat(found)[:, 1, 1]
    assert ratio == pytest.approx([3.0, 1.0, 3.0, 3.0])
