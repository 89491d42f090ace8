"""Views that add nothing: copies are left out and named, frames of one pose are refused, ordinary captures are not."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from calibrate_scenes import BOARD, camera, motions, observe, pixels_of

from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.camera.checks import copied_views, repeated_poses
from kcal.corners.board import Board
from kcal.corners.detect import detect
from kcal.errors import DegenerateError
from kcal.lens.pose import rotation_from_vector

TRUTH = camera("opencv5")
NOISE = 0.1
FIVE = CalibrationOptions(model="opencv5")


def noise(shape: tuple[int, ...], seed: int) -> torch.Tensor:
    return torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def seen() -> torch.Tensor:
    return pixels_of(TRUTH, motions(TRUTH, 6, 3), noise=NOISE, seed=3)


@pytest.mark.slow
@pytest.mark.parametrize("change", [0.0, 0.01], ids=["same", "compressed"])
@pytest.mark.parametrize("options", [FIVE, CalibrationOptions()], ids=["opencv5", "hybrid"])
def test_copies_change_nothing_and_are_named(seen: torch.Tensor, options: CalibrationOptions, change: float) -> None:
    """0.01 px is what JPEG does, with noise of 0.1 px."""
    alone = calibrate_camera(observe(seen), options)
    more = seen[[1, 4, 1]] + change * noise((3, 42, 2), 1)
    result = calibrate_camera(observe(torch.cat([seen, more])), options)
    # The same views give the same numbers, to rounding.
    assert result.sigma == pytest.approx(alone.sigma, rel=1e-6)
    torch.testing.assert_close(result.camera.params, alone.camera.params, rtol=1e-8, atol=1e-8)
    assert {view.view: view.reason for view in result.rejected_views} == {
        "v06": "it is a copy of v01",
        "v07": "it is a copy of v04",
        "v08": "it is a copy of v01",
    }
    warning = result.warnings[-1]
    assert warning.startswith(
        "3 of 9 views are copies of others (v06 of v01, v07 of v04, v08 of v01) and were left out"
    )
    assert result.warnings[:-1] == alone.warnings
    assert [math.isnan(rms) for rms in result.per_view_rms.tolist()] == [False] * 6 + [True] * 3
    torch.testing.assert_close(result.per_view_rms[:6], alone.per_view_rms, rtol=1e-8, atol=0)
    assert bool(result.residuals[6:].isnan().all())
    assert result.camera.calibration is not None
    assert result.camera.calibration.record is not None
    assert result.camera.calibration.record.views == 6
    assert (result.rejected_views[1].corners, result.rejected_views[1].residual) == (42, result.per_view_rms[4])


def test_frames_with_noise_of_their_own_are_no_copies(seen: torch.Tensor) -> None:
    """Six poses, three frames each: noise averages, and the message says what does not."""
    exact = pixels_of(TRUTH, motions(TRUTH, 6, 3))
    result = calibrate_camera(observe(exact.repeat(3, 1, 1) + NOISE * noise((18, 42, 2), 2)), FIVE)
    assert result.rejected_views == ()
    (warning,) = result.warnings
    assert warning.startswith("18 views show the board in 6 poses only")
    once = calibrate_camera(observe(seen), FIVE)
    assert result.sigma["fx"] == pytest.approx(once.sigma["fx"] / 3**0.5, rel=0.15)
    # Half of the views in poses of others are an accident of many captures.
    few = calibrate_camera(observe(torch.cat([seen, exact[:5] + NOISE * noise((5, 42, 2), 4)])), FIVE)
    assert few.warnings == ()


@pytest.mark.parametrize("options", [FIVE, CalibrationOptions()], ids=["opencv5", "hybrid"])
@pytest.mark.parametrize("poses", [1, 2])
def test_many_frames_of_too_few_poses_are_refused(poses: int, options: CalibrationOptions) -> None:
    """A board in a hand that tries to stand still: half a millimeter, and a tenth of a degree."""
    rotation, translation = motions(TRUTH, poses, 5)
    turns = rotation_from_vector(math.radians(0.1) * noise((12, 3), 6)).unflatten(0, (-1, poses))
    still = turns @ rotation, translation + 5e-4 * noise((12, 3), 7).unflatten(0, (-1, poses))
    frames = pixels_of(TRUTH, (still[0].flatten(0, 1), still[1].flatten(0, 1)), noise=NOISE)
    with pytest.raises(DegenerateError, match=rf"12 views show the board in {poses} pose\(s\) only, .*: at least 3"):
        calibrate_camera(observe(frames), options)
    with pytest.raises(DegenerateError, match=r"2 view\(s\) of the board"):
        calibrate_camera(observe(frames[:2].repeat(4, 1, 1)), options)


def test_poses_under_a_known_camera_are_found_for_every_view(seen: torch.Tensor) -> None:
    result = calibrate_camera(observe(seen[[0, 0, 0]]), CalibrationOptions(camera=TRUTH))
    assert result.rejected_views == result.warnings == ()
    assert bool(torch.isfinite(result.cam_from_board_translation).all())
    freed = calibrate_camera(observe(seen[[0, 1, 0]]), CalibrationOptions(camera=TRUTH, free=("fx", "fy")))
    assert [view.view for view in freed.rejected_views] == ["v02"]


def test_views_are_compared_by_the_corners_that_both_have(seen: torch.Tensor) -> None:
    part, other = seen[0].clone(), seen[0].clone()
    part[:20], other[20:] = math.nan, math.nan
    few = seen[0].clone()
    few[:22] = math.nan  # less than half in common
    assert copied_views(torch.stack([seen[0], part, seen[1]]), 0.0) == {1: 0}
    assert copied_views(torch.stack([part, other]), 0.0) == {}
    assert copied_views(torch.stack([seen[0], few]), 0.0) == {}
    # A chain: each is compared with the first of its group, so that what moves slowly is not all one.
    steps = torch.stack([seen[0] + step for step in (0.0, 0.02, 0.04, 0.06)])
    assert copied_views(steps, NOISE) == {1: 0, 3: 2}
    # However large the residuals are: 0.03 px along an axis.
    assert copied_views(steps, 100.0) == {1: 0, 3: 2}
    assert copied_views(steps, 0.01) == {}


def test_poses_count_by_the_size_of_the_board() -> None:
    """Moved by 4 and by 6 percent of the corners' distance from their middle; small boards move less."""
    points = 1e3 * BOARD.points[:, :2]
    radius = float((points - points.mean(0)).square().sum(-1).mean().sqrt())
    for scale in (0.1, 1.0):
        view = scale * points
        along = scale * radius * torch.tensor([0.6, 0.8]).double()
        assert repeated_poses(torch.stack([view, view + 0.04 * along, view + 0.06 * along])) == {1: 0}


def test_real_captures_repeat_nothing_and_their_copies_are_found(kcal_data: Path, tmp_path: Path) -> None:
    """Thirteen pictures of OpenCV's sample, three of them once more with other qualities of JPEG."""
    files = sorted((kcal_data / "opencv_stereo").glob("left*.jpg"))
    for file, quality in zip(files[:3], (95, 80, 60), strict=True):
        image = cv2.imdecode(np.frombuffer(file.read_bytes(), np.uint8), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(tmp_path / f"again_{file.name}"), image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    again = sorted(tmp_path.iterdir())
    observations = detect([*files, *again], Board(columns=9, rows=6, square=0.025))
    assert repeated_poses(observations.pixels()[:13]) == {}
    result = calibrate_camera(observations, FIVE)
    assert [view.view for view in result.rejected_views] == [file.name for file in again]


def test_of_many_views_each_copy_names_the_first_of_its_group() -> None:
    rng = torch.Generator().manual_seed(3)
    views = 900 * torch.rand(700, 12, 2, dtype=torch.float64, generator=rng)
    views[torch.rand(700, 12, generator=rng) < 0.1] = torch.nan
    # Copies stand within a block of comparisons, in the next one, and after another copy.
    for copy, original in ((3, 1), (300, 2), (699, 3), (650, 255), (256, 0)):
        views[copy] = views[original]
    assert copied_views(views, 0.0) == {3: 1, 256: 0, 300: 2, 650: 255, 699: 1}
