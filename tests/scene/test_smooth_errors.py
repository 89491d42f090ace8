"""Errors that all matches share: a pose is as uncertain as they make it, however many matches there are."""

import dataclasses

import pytest
import torch
from torch import Tensor

from kcal import Baseline, Features, Rig, RigData, RigOptions, solve_rig
from kcal.lens.pose import rotation_from_vector, side_axes
from kcal.rig import Effect
from kcal.scene import common_errors
from kcal.scene.common_errors import line_errors, smooth_effects
from kcal.scene.match import MatchedPair, PairCounts, counted
from tests.helpers.scene_pairs import SIZE, drawn_pixels, small_rig

RIG = small_rig()
SIGMA = 0.05
SIZE_OF_EACH = common_errors._SMOOTH_PX


def some_pixels(count: int) -> Tensor:
    return drawn_pixels(torch.Generator().manual_seed(7), count)


def effects_of(pixels: Tensor) -> tuple[Effect, ...]:
    return smooth_effects(pixels, line_errors(RIG, pixels).across, SIZE)


def turn_covariance(pixels: Tensor, effects: tuple[Effect, ...]) -> Tensor:
    """(3, 3) of the relative rotation that an adjustment states."""
    nothing = torch.zeros(len(pixels), dtype=torch.float64)
    each = (0.5 * SIGMA**2 * torch.eye(2, dtype=torch.float64)).expand(len(pixels), 2, 2, 2)
    features = Features(
        names=tuple(map(str, range(len(pixels)))), pixels=pixels, inverse_range=nothing,
        inverse_range_sigma=torch.full_like(nothing, torch.inf), covariance=each, effects=effects,
    )  # fmt: skip
    tape = Baseline(first=0, second=1, length=float(RIG.baseline), sigma=1e-4)
    data = RigData(cameras=(RIG.left, RIG.right), names=("left", "right"), features=features, baselines=(tape,))
    return solve_rig(data, RigOptions(intrinsics="fixed")).relative_covariance(0, 1)[:3, :3]


def test_three_errors_across_the_lines() -> None:
    pixels = some_pixels(50)
    across = line_errors(RIG, pixels).across
    both = torch.stack([one.shift[:, 1] - one.shift[:, 0] for one in effects_of(pixels)])
    u, v = (2.0 * pixels[:, 0] / torch.tensor(SIZE) - 1.0).unbind(1)
    for found, amount in zip(both, (torch.ones_like(u), u, v), strict=True):
        torch.testing.assert_close(found, SIZE_OF_EACH * amount[:, None] * across, rtol=1e-12, atol=0.0)


@pytest.mark.slow
def test_a_pose_is_as_uncertain_as_they_make_it() -> None:
    """The variances of generalized least squares with errors that matches share, and ones that do not vanish."""
    floor = []
    for count in (150, 600):
        pixels = some_pixels(count)
        lines = line_errors(RIG, pixels)
        u, v = (2.0 * pixels[:, 0] / torch.tensor(SIZE) - 1.0).unbind(1)
        shared = SIZE_OF_EACH * torch.stack([torch.ones_like(u), u, v], 1)
        together = SIGMA**2 * torch.eye(count, dtype=torch.float64) + shared @ shared.T
        expected = torch.linalg.inv(lines.slopes.T @ torch.linalg.solve(together, lines.slopes))[:3, :3]
        found = turn_covariance(pixels, effects_of(pixels))
        # Half of a match's error is in each image, of which one has pixels that are a little larger.
        torch.testing.assert_close(found.diagonal(), expected.diagonal(), rtol=0.03, atol=0.0)
        floor.append(float((found - turn_covariance(pixels, ())).diagonal()[[0, 2]].sum()))
    assert floor[1] > 0.8 * floor[0]


def test_matches_have_them() -> None:
    pixels = some_pixels(100)
    each = (SIGMA**2 * torch.eye(2, dtype=torch.float64)).expand(len(pixels), 2, 2)
    counts = PairCounts(name="a", matched=100, untextured=0, off_line=0, moved=0, thinned=0, used=100)
    own = MatchedPair(pixels, each, torch.ones(100, dtype=torch.float64), counts, RIG)
    found = counted([own, own._replace(counts=dataclasses.replace(counts, name="b"))], SIZE).features
    for one, expected in zip(found.effects, effects_of(found.pixels), strict=True):
        assert one.name == expected.name
        assert torch.equal(one.shift, expected.shift)


def test_slopes_are_those_of_differences() -> None:
    """Where nothing is off: what is off has a slope of its own, which a pose does not use."""
    pixels = some_pixels(40)
    covariance = torch.eye(2, dtype=torch.float64).expand(len(pixels), 2, 2)
    turn, shift, step = RIG.right_from_left_rotation, RIG.right_from_left_translation, 1e-6
    turned = [rotation_from_vector(step * axis) @ turn for axis in torch.eye(3, dtype=torch.float64)]
    moved = [Rig.pair(RIG.left, RIG.right, one, shift) for one in turned]
    axes = torch.cat(side_axes(shift[None] / RIG.baseline))
    moved += [Rig.pair(RIG.left, RIG.right, turn, shift + step * RIG.baseline * axis) for axis in axes]
    expected = torch.stack([line_errors(rig, pixels).off for rig in moved], -1) / step
    found = line_errors(RIG, pixels)
    sigma = found.sigma(covariance)
    # Of right pixels that are found by iteration.
    assert found.off.abs().max() < 1e-7
    torch.testing.assert_close(found.slopes, expected, rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(sigma, torch.ones_like(sigma), rtol=1e-12, atol=0.0)
