"""What images tell of attitudes: turns found, dirt and darkness said, other cameras refused."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from kcal.errors import FileError, InputError
from kcal.scene.match import ImagePair, match_scene
from kcal.watch.history import between_rows
from kcal.watch.measure import (
    MEMORY,
    AnotherCameraError,
    FixedFeatures,
    between_turn,
    load_references,
    measured,
    new_reference,
    renewed,
    save_references,
    seen_by,
    with_look,
)
from tests.helpers.scene_pairs import pair, small_rig

RIG = small_rig()
TURNS = torch.tensor([1e-4, -3e-4, 2e-4, -2e-4, 4e-4, 1e-4], dtype=torch.float64)
NOTHING = torch.zeros(6, dtype=torch.float64)


@pytest.fixture(scope="module")
def then() -> tuple[FixedFeatures, FixedFeatures]:
    one = pair(1)
    return new_reference(one.left, "left"), new_reference(one.right, "right")


@pytest.fixture(scope="module")
def now() -> ImagePair:
    return pair(2, turns=TURNS)


def test_turns_of_both_cameras_are_found(then: tuple[FixedFeatures, FixedFeatures], now: ImagePair) -> None:
    found = measured(RIG, then, (now.left, now.right), NOTHING, between=False)
    off = (found.look.turn - TURNS)[:, None]
    assert float(off.T @ torch.linalg.solve(found.look.covariance, off)) < 22.5  # χ² of six angles, once in a thousand
    assert math.degrees(float(found.look.covariance[4, 4].sqrt())) < 0.001
    assert found.sides[0].found > 300
    assert not found.note


@pytest.mark.slow
def test_matches_between_the_cameras_tell_the_relative_turn(now: ImagePair) -> None:
    values, covariance = between_turn(RIG, match_scene((RIG.left, RIG.right), now))
    off = (values - between_rows(RIG) @ TURNS)[:, None]
    assert float(off.T @ torch.linalg.solve(covariance, off)) < 20.5
    # The small baseline tells little of its own direction; pitch and roll it does.
    assert math.degrees(float(covariance[0, 0].sqrt())) < 0.003


@pytest.mark.slow
def test_a_dirty_lens_makes_it_unsure_and_is_said(then: tuple[FixedFeatures, FixedFeatures], now: ImagePair) -> None:
    clean = seen_by(RIG.left, then[0], now.left, NOTHING[:3], "left")
    dirty = now.left.copy()
    dirty[:, 70:] = 100
    few = seen_by(RIG.left, then[0], dirty, NOTHING[:3], "left")
    assert 8 <= few.found < 100
    assert "left: only" in few.note
    assert float(few.covariance[1, 1]) > 3 * float(clean.covariance[1, 1])
    off = (few.turn - TURNS[:3])[:, None]
    assert float(off.T @ torch.linalg.solve(few.covariance, off)) < 16.3
    dark = seen_by(RIG.left, then[0], np.full_like(now.left, 7), NOTHING[:3], "left")
    assert dark.found == 0
    assert "dark, fog, or a dirty lens" in dark.note
    assert not dark.lost


@pytest.mark.slow
def test_a_jump_beyond_the_near_search_is_found(then: tuple[FixedFeatures, FixedFeatures]) -> None:
    turns = torch.tensor([0.0, 0.03, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)  # 15 px
    there = seen_by(RIG.left, then[0], pair(3, turns=turns).left, NOTHING[:3], "left")
    assert float(there.turn[1]) == pytest.approx(0.03, abs=2e-4)


def test_another_lens_is_refused(then: tuple[FixedFeatures, FixedFeatures], now: ImagePair) -> None:
    import cv2

    grown = cv2.warpAffine(now.left, np.array([[1.005, 0, -1.2], [0, 1.005, -0.8]]), now.left.shape[::-1])
    with pytest.raises(AnotherCameraError, match=r"left: images are 0\.\d\d % larger"):
        seen_by(RIG.left, then[0], grown, NOTHING[:3], "left")
    with pytest.raises(AnotherCameraError, match="was the camera replaced"):
        seen_by(RIG.left, then[0], now.left[:-1], NOTHING[:3], "left")


@pytest.mark.slow
def test_another_view_is_lost(then: tuple[FixedFeatures, FixedFeatures]) -> None:
    other = seen_by(RIG.left, then[0], pair(5, texture=0.37).right[::-1].copy(), NOTHING[:3], "left")
    assert other.lost
    assert other.found == 0
    assert float(other.covariance[0, 0]) == 1.0


def test_what_moves_is_learned_out_and_made_up_for(then: tuple[FixedFeatures, FixedFeatures]) -> None:
    image, reference = pair(1).left, then[0]
    count = len(reference.pixels)
    moving = torch.zeros(count, dtype=torch.bool)
    moving[: 3 * count // 5] = True
    off = torch.where(moving[:, None], 0.8, 0.0) * torch.ones(count, 2, dtype=torch.float64)
    for _ in range(MEMORY + 5):
        reference = with_look(reference, torch.ones(count, dtype=torch.bool), off)
    turn, covariance = torch.tensor([0.0, 2e-4, 0.0]).double(), 1e-10 * torch.eye(3).double()
    after = renewed(reference, RIG.left, image, turn, covariance)
    kept = count - int(moving.sum())
    assert torch.equal(after.pixels[:kept], reference.pixels[~moving])
    assert len(after.pixels) > kept
    # New ones stand where they would have been: seen with that turn, they agree with the old ones.
    assert float(after.variance[1, 1]) == pytest.approx(1e-10 * ((len(after.pixels) - kept) / len(after.pixels)) ** 2)
    added = after.at(torch.arange(len(after.pixels)) >= kept)
    assert float(seen_by(RIG.left, added, image, turn, "left").turn[1]) == pytest.approx(2e-4, abs=5e-6)


def test_features_seldom_found_are_learned_out(then: tuple[FixedFeatures, FixedFeatures]) -> None:
    reference, count = then[0], len(then[0].pixels)
    seen = torch.arange(count) >= 20
    for _ in range(MEMORY + 60):
        reference = with_look(reference, seen, torch.zeros(count, 2, dtype=torch.float64))
    after = renewed(reference, RIG.left, pair(1).left, NOTHING[:3], torch.eye(3).double())
    assert len(after.pixels) == count - 20


def test_an_image_without_features_makes_no_reference() -> None:
    with pytest.raises(InputError, match="right: 0 features; a reference needs 20"):
        new_reference(np.zeros((320, 480), np.uint8), "right")


def test_references_are_stored(tmp_path: Path, then: tuple[FixedFeatures, FixedFeatures]) -> None:
    path = save_references(tmp_path / "a.reference.npz", RIG, then)
    back = load_references(path, RIG)
    assert torch.equal(back[1].patches, then[1].patches)
    assert torch.equal(back[0].pixels, then[0].pixels)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(FileError, match=r"a\.reference\.npz"):
        load_references(path, RIG)
    other = small_rig()
    other.translation[1] += 0.1
    save_references(path, other, then)
    with pytest.raises(FileError, match="another rig"):
        load_references(path, RIG)
