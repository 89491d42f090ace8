"""Matches of the scene itself, against pictures whose truth is known."""

import math

import numpy as np
import pytest
import torch

from kcal import Baseline, InputError, RigData, RigOptions, solve_rig
from kcal.lens import vector_from_rotation
from kcal.scene.match import ImagePair, MatchedPair, match_scene, scene_features, scene_of
from kcal.scene.refine import Stillness, still_there
from tests.helpers.scene_pairs import pair, small_rig, true_right

RIG = small_rig()
CAMERAS = RIG.left, RIG.right


@pytest.fixture(scope="module")
def matched() -> MatchedPair:
    return match_scene(CAMERAS, pair(1))


@pytest.mark.slow
def test_matches_are_as_far_from_the_truth_as_they_say(matched: MatchedPair) -> None:
    truth, _ = true_right(matched.pixels[:, 0])
    off = matched.pixels[:, 1] - truth
    right = off.norm(dim=-1) < 2.0
    assert len(off) > 150
    assert float(right.double().mean()) > 0.95
    assert float(off[right].square().mean().sqrt()) < 0.15
    # Beside the epipolar lines, where edges of things do not count.
    sigmas = off[right, 1] / matched.covariance[right, 1, 1].sqrt()
    assert 0.8 < float(sigmas.square().mean().sqrt()) < 1.35


def test_the_pose_comes_from_the_images_alone(matched: MatchedPair) -> None:
    turn = matched.rig.right_from_left_rotation @ RIG.right_from_left_rotation.T
    assert math.degrees(float(vector_from_rotation(turn).norm())) < 0.1
    assert float(matched.rig.baseline) == pytest.approx(1.0, abs=1e-3)


def test_a_rig_from_the_scene_and_a_tape(matched: MatchedPair) -> None:
    features = scene_of(CAMERAS, [pair(1)], [matched]).features
    tape = Baseline(first=0, second=1, length=float(RIG.baseline), sigma=0.002)
    data = RigData(cameras=CAMERAS, names=("left", "right"), features=features, baselines=(tape,))
    found = solve_rig(data, RigOptions(intrinsics="fixed"))
    turn = found.rotation[1] @ found.rotation[0].T @ RIG.right_from_left_rotation.T
    sigmas = vector_from_rotation(turn) / found.sigma_rotation
    assert float(sigmas.abs().max()) < 4.0
    assert float(torch.rad2deg(found.sigma_rotation).max()) < 0.05


@pytest.mark.slow
def test_what_moves_is_found_by_time() -> None:
    pairs = [pair(1, van=0.0), pair(2, van=-9.0)]
    found = [match_scene(CAMERAS, one) for one in pairs]

    def on_the_van(pixels: torch.Tensor) -> int:
        at = 30.0 * RIG.left.unproject(pixels)[0]
        at = 30.0 * at / at[:, 2:]
        return int(((at[:, 0] > 4.5) & (at[:, 0] < 11.5) & (at[:, 1] > -7.5) & (at[:, 1] < -1.5)).sum())

    together = scene_of(CAMERAS, pairs, found)
    before, after = (
        on_the_van(found[0].pixels[:, 0]),
        on_the_van(together.features.pixels[: together.counts[0].used, 0]),
    )
    assert before > 15
    assert after <= 0.1 * before
    # The van hides other things at other times; all else stays.
    gone = together.counts[0].moved - (before - after)
    assert gone < 0.25 * len(found[0].pixels)
    assert together.counts[0].matched == sum(
        getattr(together.counts[0], name) for name in ("untextured", "off_line", "moved", "thinned", "used")
    )


@pytest.mark.slow
def test_a_change_of_range_is_not_still(matched: MatchedPair) -> None:
    def images(seed: int, shift: int) -> tuple[torch.Tensor, torch.Tensor]:
        one = pair(seed)
        return torch.from_numpy(one.left).float(), torch.from_numpy(np.roll(one.right, shift, 1)).float()

    some = matched.pixels[::4], matched.covariance[::4]
    same = still_there(matched.rig, images(1, 0)[0], images(2, 0), *some)
    assert float((same == int(Stillness.STILL)).double().mean()) > 0.9
    # A part of the scene comes nearer by a pixel of disparity, the rest stays.
    after = images(2, 0)
    after[1][:, 340:] = images(2, -1)[1][:, 340:]
    nearer = still_there(matched.rig, images(1, 0)[0], after, *some)
    half = some[0][:, 1, 0] > 355.0
    assert float((nearer[half] == int(Stillness.ELSEWHERE)).double().mean()) > 0.6
    assert float((nearer[some[0][:, 1, 0] < 325.0] == int(Stillness.ELSEWHERE)).double().mean()) < 0.1


def test_the_best_all_over_the_image_are_kept(matched: MatchedPair) -> None:
    found = matched
    few = scene_of(CAMERAS, [pair(1)], [found], most=100)
    assert len(few.features.names) == 100 == few.counts[0].used
    assert few.counts[0].thinned == len(found.pixels) - 100
    assert (few.features.pixels[:, 0].std(0) > 0.8 * found.pixels[:, 0].std(0)).all()


@pytest.mark.slow
def test_repeats_in_the_same_light_tell_less_than_they_count() -> None:
    """The errors of one thing are alike in pairs of one minute: they went for independent, and contradicted others."""

    def information(pairs: list[ImagePair], found: list[MatchedPair]) -> float:
        return float((0.5 / scene_of(CAMERAS, pairs, found).features.covariance[:, 0, 1, 1]).sum())

    # Noise enough, so that another pair tells anything at all.
    pairs = [pair(1, noise=4.0), pair(2, noise=4.0)]
    found = [match_scene(CAMERAS, each) for each in pairs]
    one, two = information(pairs[:1], found[:1]), information(pairs, found)
    assert one < 0.75 * float((1.0 / found[0].covariance[:, 1, 1]).sum())
    assert one < two < 1.7 * one


def test_images_of_other_scenes_are_refused() -> None:
    one, other = pair(1), pair(2, texture=40.0)
    with pytest.raises(InputError, match="in common"):
        scene_features(CAMERAS, [ImagePair("mixed", one.left, other.right)])


def test_no_pair_is_refused() -> None:
    with pytest.raises(InputError, match="no pair"):
        scene_features(CAMERAS, [])


def test_a_picture_in_two_pairs() -> None:
    """Its errors would count twice, as if they were independent."""
    one = ImagePair("first", np.zeros((4, 6), np.uint8), np.ones((4, 6), np.uint8))
    for again in (one._replace(name="copy"), one._replace(name="copy", left=one.left + 7)):
        with pytest.raises(InputError, match=r"copy: the (left|right) image is that of first"):
            scene_of(CAMERAS, [one, again], [])
