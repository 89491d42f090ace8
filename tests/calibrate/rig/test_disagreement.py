"""Parts of a rig's data that contradict each other are told, and widen its sigmas."""

import dataclasses

import pytest

from kcal import Baseline, RigData, solve_rig
from kcal.calibrate.rig.result import RigResult
from scripts.check.rig import BASELINE, NAMES, STRAIGHT, TRUTH, generator, landmarks


def yaw_sigma(found: RigResult) -> float:
    return float(found.relative_covariance()[1, 1].sqrt())


@pytest.fixture(scope="module")
def clean() -> RigData:
    tape = Baseline(first=0, second=1, length=BASELINE, sigma=0.005)
    marked = landmarks(generator(5), 30)
    return RigData(cameras=(TRUTH.left, TRUTH.right), names=NAMES, landmarks=marked, baselines=(tape,))


@pytest.fixture(scope="module")
def solved(clean: RigData) -> RigResult:
    return solve_rig(clean, STRAIGHT)


def test_good_rigs_keep_their_sigmas(solved: RigResult) -> None:
    assert not any("disagree" in text for text in solved.warnings)


def test_landmarks_on_one_side_that_are_off_are_told(clean: RigData, solved: RigResult) -> None:
    assert clean.landmarks is not None
    pixels = clean.landmarks.pixels.clone()
    # As if the lens of the right camera were off by 0.4 px on the right.
    pixels[..., 1, 0] += 0.4 * (pixels[..., 1, 0] > pixels[..., 1, 0].median())
    found = solve_rig(
        dataclasses.replace(clean, landmarks=dataclasses.replace(clean.landmarks, pixels=pixels)), STRAIGHT
    )
    told = [one for one in found.findings if "disagree" in one.text]
    assert len(told) == 1
    assert "landmarks in the" in told[0].text
    assert yaw_sigma(found) > 1.3 * yaw_sigma(solved)
