"""What is left out, views that repeat each other, and weak priors."""

import math
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import torch
from calibrate_scenes import BOARD, SIZE, camera, corner_pixels, motions, observe, pixels_of
from torch import Tensor

from kcal import Board, Camera, DegenerateError, InputError, detect
from kcal.calibrate.camera import hybrid
from kcal.calibrate.camera.calibrate import CalibrationOptions, CameraCalibrationResult, calibrate_camera
from kcal.calibrate.camera.checks import OutlierRejection, copied_views, corners_beyond, least_planar, repeated_poses
from kcal.lens import rotation_from_vector
from kcal.lens.projection import project_components

# Wrong corners and views are found, listed and left out; good ones stay.


REJECT = CalibrationOptions(model="opencv5", reject=OutlierRejection())

NOISE = 0.1


def scene(count: int = 14, seed: int = 2) -> Tensor:
    return corner_pixels(count, 5, noise=NOISE, seed=seed)


def spoil(pixels: Tensor, seed: int, share: float = 0.02) -> tuple[Tensor, set[tuple[int, int]]]:
    """A share of the corners moved by 5 to 60 pixels in any direction that does not lead out of the image."""
    generator = torch.Generator().manual_seed(seed)
    wrong = torch.rand(pixels.shape[:2], generator=generator) < share
    turn = 6.2831853 * torch.rand(pixels.shape[:2], generator=generator, dtype=torch.float64)
    length = 5.0 + 55.0 * torch.rand(pixels.shape[:2], generator=generator, dtype=torch.float64)
    shift = torch.stack([length * torch.cos(turn), length * torch.sin(turn)], -1)
    size = torch.tensor(SIZE, dtype=torch.float64)
    stays = ((pixels + shift >= 0) & (pixels + shift <= size - 1)).all(-1, keepdim=True)
    moved = torch.where(wrong[..., None], pixels + torch.where(stays, shift, -shift), pixels)
    return moved, {(i, n) for i, n in wrong.nonzero().tolist()}


def listed(result: CameraCalibrationResult) -> set[tuple[int, int]]:
    return {(int(corner.view[1:]), corner.corner) for corner in result.rejected_corners}


def test_normal_noise_loses_one_corner_in_a_hundred_calibrations() -> None:
    """A hundredth of a corner is expected beyond the limit in each; 7 of 300 or more have a chance of 3 %."""
    draws = torch.randn(300, 14, 42, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert sum(int(corners_beyond(NOISE * draw).sum()) for draw in draws) < 7


def assert_same_solution(one: CameraCalibrationResult, other: CameraCalibrationResult) -> None:
    """Within a ten-thousandth of each σ: vector kernels round by where memory lies, and iterations stop accordingly."""
    moved = (one.camera.params - other.camera.params).abs()
    for name, change in zip(one.camera.names, moved.tolist(), strict=True):
        assert change <= 1e-4 * (one.sigma.get(name) or 0.0), name
    assert one.rms == pytest.approx(other.rms, rel=1e-9)


def test_clean_data_keep_all_corners_and_the_same_result() -> None:
    seen = observe(scene())
    result, plain = calibrate_camera(seen, REJECT), calibrate_camera(seen, CalibrationOptions(model="opencv5"))
    assert result.rejected_corners == ()
    assert result.rejected_views == ()
    assert result.rejected_share == 0.0
    assert_same_solution(result, plain)
    assert plain.warnings == ()


@pytest.mark.slow
def test_gross_outliers_are_found_and_move_nothing() -> None:
    """By more than a σ; of 25 views, as 14 do not determine eight coefficients (flat valley)."""
    clean = scene(25)
    pixels, wrong = spoil(clean, 4)
    options = CalibrationOptions(weak_prior=None, model="opencv8", reject=OutlierRejection())
    result = calibrate_camera(observe(pixels), options)
    reference = calibrate_camera(observe(clean), CalibrationOptions(weak_prior=None, model="opencv8"))
    assert listed(result) == wrong
    assert result.rejected_share == pytest.approx(len(wrong) / (25 * 42))
    before, after = (dict(zip(r.camera.names, r.camera.params.tolist(), strict=True)) for r in (reference, result))
    for name, sigma in reference.sigma.items():
        assert sigma is not None
        assert abs(after[name] - before[name]) < sigma, name
    for corner in result.rejected_corners:
        i, n = int(corner.view[1:]), corner.corner
        assert bool(result.residuals[i, n].isnan().all())
        assert corner.residual == pytest.approx(float((pixels - clean)[i, n].norm()), abs=1.0)
        assert "noise explains" in corner.reason


def test_the_result_is_that_of_the_data_that_are_left() -> None:
    pixels, wrong = spoil(scene(), 4)
    result = calibrate_camera(observe(pixels), REJECT)
    assert len(listed(result)) >= 5
    assert listed(result) == wrong
    for i, n in wrong:
        pixels[i, n] = torch.nan
    again = calibrate_camera(observe(pixels), CalibrationOptions(model="opencv5"))
    assert_same_solution(result, again)
    assert result.sigma == pytest.approx(again.sigma, rel=1e-5)


def test_a_view_of_another_board_is_left_out_whole() -> None:
    """Its corners are those of a board whose squares are a tenth longer than wide."""
    truth = camera()
    poses = motions(truth, 14, 5)
    pixels = pixels_of(truth, poses, noise=NOISE, seed=2)
    stretched = BOARD.points * torch.tensor([1.1, 1.0, 1.0], dtype=torch.float64)
    # Curved as well, or the pose would take most of it.
    stretched = stretched + 0.006 * torch.sin(40.0 * BOARD.points[:, [1, 0, 2]])
    pixels[6] = truth.project(stretched @ poses[0][6].T + poses[1][6])[0]
    result = calibrate_camera(observe(pixels), REJECT)
    assert [view.view for view in result.rejected_views] == ["v06"]
    assert result.rejected_views[0].corners == 42
    assert result.rejected_share >= 1 / 14
    assert bool(result.per_view_rms[6].isnan())
    assert bool(result.cam_from_board_rotation[6].isnan().all())
    assert bool(result.per_view_rms[torch.arange(14) != 6].isfinite().all())
    assert result.rms == pytest.approx(NOISE * 2**0.5, rel=0.15)


def test_too_much_is_refused() -> None:
    pixels, _ = spoil(scene(), 6, share=0.2)
    with pytest.raises(InputError, match=r"more than the 10 % that may be left out"):
        calibrate_camera(observe(pixels), REJECT)
    with pytest.raises(InputError, match="limit must be between"):
        OutlierRejection(limit=0.5)


def test_without_rejection_a_warning_names_the_worst_corner() -> None:
    pixels = scene()
    pixels[3, 17] += 5.0
    result = calibrate_camera(observe(pixels), CalibrationOptions(model="opencv5"))
    assert any("corner 17 of view v03" in text for text in result.warnings)
    assert result.rejected_corners == ()


# Views that no lens fits, or that say nothing of their pose, are left out by name before anything is refused.


VIEWS = 12


def corners() -> Tensor:
    return pixels_of(camera(), motions(camera(), VIEWS, 1), noise=0.1)


def shuffled(pixels: Tensor, views: list[int], seed: int = 1) -> Tensor:
    """Corners of some views in any order."""
    generator = torch.Generator().manual_seed(seed)
    changed = pixels.clone()
    for i in views:
        changed[i] = changed[i][torch.randperm(BOARD.corners, generator=generator)]
        # Not the other way round, which is noticed without a fit.
        if float(torch.det(torch.linalg.lstsq(_affine_rows(), changed[i]).solution[:2])) < 0:
            changed[i] = changed[i].reshape(6, 7, 2).flip(1).reshape(-1, 2)
    return changed


def _affine_rows() -> Tensor:
    return torch.cat([BOARD.points[:, :2], torch.ones(BOARD.corners, 1, dtype=torch.float64)], 1)


def reasons(result: CameraCalibrationResult) -> dict[str, str]:
    return {view.view: view.reason for view in result.rejected_views}


@pytest.mark.slow
def test_a_few_views_that_no_lens_fits() -> None:
    wrong = [3, 7]
    pixels = shuffled(corners(), wrong)
    found = calibrate_camera(observe(pixels))
    assert list(reasons(found)) == [f"v{i:02}" for i in wrong]
    assert f"{len(wrong)} of {VIEWS} views were left out: v03 (" in found.warnings[0]
    kept = [i for i in range(VIEWS) if i not in wrong]
    alone = calibrate_camera(observe(pixels[kept], names=[f"v{i:02}" for i in kept]))
    # The same fit; where memory lies decides the order of its sums.
    for name in ("fx", "cx", "cy"):
        one, other = (float(result.camera.params[result.camera.names.index(name)]) for result in (found, alone))
        assert one == pytest.approx(other, abs=1e-3 * (alone.sigma[name] or 0.0))
    assert found.residuals[wrong].isnan().all()
    assert len(found.observations.views) == VIEWS


@pytest.mark.slow
def test_many_such_views_are_refused_by_name() -> None:
    with pytest.raises(InputError, match=r"no lens shows all corners.* 3 of 12 views .* v02 \(.* v05 \(.* v08 \("):
        calibrate_camera(observe(shuffled(corners(), [2, 5, 8], seed=3)))


@pytest.mark.slow
def test_a_view_that_moved_by_more_than_hands_do() -> None:
    """It would make room for motion in all views: σ of the focal length was 7.9 px with it."""
    pixels = corners()[:8]
    x, t = (pixels[4] / torch.tensor(SIZE) - 0.5).T
    pixels[4] += 30.0 * torch.stack([3.0 * t * t, 2.0 * t * x], -1)
    found = calibrate_camera(observe(pixels))
    assert list(reasons(found)) == ["v04"]
    assert found.sigma["fx"] < 2.0
    assert float(found.camera.params[0]) == pytest.approx(float(camera().params[0]), abs=4.0)


def test_of_five_views_nobody_knows_which_is_wrong() -> None:
    assert [hybrid.few_views(*at) for at in ((1, 5), (1, 6), (2, 9), (2, 10))] == [False, True, False, True]


@pytest.mark.slow
def test_mirrored_views() -> None:
    pixels = corners()
    pixels[5, :, 0] = pixels[5, :, 0].max() + pixels[5, :, 0].min() - pixels[5, :, 0]
    assert "mirrored" in reasons(calibrate_camera(observe(pixels)))["v05"]
    # Where all are, nothing tells which: they are used, and `kcal report` says so.
    flipped = corners()
    flipped[..., 0] = SIZE[0] - 1 - flipped[..., 0]
    assert reasons(calibrate_camera(observe(flipped), CalibrationOptions(model="opencv5"))) == {}


@pytest.mark.slow
def test_a_start_that_shows_nothing_is_not_used() -> None:
    plain = calibrate_camera(observe(corners()))
    given = calibrate_camera(observe(corners()), CalibrationOptions(focal=5.0))
    assert "focal length that was given for the start (5 px)" in given.warnings[0]
    assert "not used" in given.warnings[0]
    assert given.warnings[1:] == plain.warnings
    near = calibrate_camera(observe(corners()), CalibrationOptions(focal=420.0))
    assert near.warnings == plain.warnings
    assert given.rms == pytest.approx(plain.rms, rel=1e-3)


def test_what_is_left_must_be_enough() -> None:
    pixels = corners()[:4]
    pixels[:2, 4:] = torch.nan
    with pytest.raises(DegenerateError, match=r"^2 of 4 views .* of no use: v00 \(it has 4 corners.*, v01 \(it has 4"):
        calibrate_camera(observe(pixels))


def test_an_arithmetic_failure_is_an_error_of_the_views(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hybrid, "calibrate_hybrid", Mock(side_effect=ZeroDivisionError))
    with pytest.raises(InputError, match=r"no lens shows all corners where they are\. Look first at v0\d \("):
        calibrate_camera(observe(corners()[:6]))


def test_views_are_named_where_the_fit_names_none(monkeypatch: pytest.MonkeyPatch) -> None:
    failure = DegenerateError("the views do not determine the focal length")
    monkeypatch.setattr(hybrid, "calibrate_hybrid", Mock(side_effect=failure))
    with pytest.raises(DegenerateError, match=r"focal length; the views are v00, v01, v02, v03, v04 and 7 more"):
        calibrate_camera(observe(corners()))


def test_copies_among_what_is_left() -> None:
    """Both kinds of views that add nothing are listed."""
    pixels = corners()
    pixels[6] = pixels[2]
    pixels[4, 5:] = torch.nan
    found = calibrate_camera(observe(pixels))
    assert reasons(found) == {"v04": "it has 5 corners, and at least 6 are needed", "v06": "it is a copy of v02"}
    assert math.isnan(float(found.per_view_rms[4]))
    assert math.isnan(float(found.per_view_rms[6]))
    assert found.camera.calibration is not None


@pytest.mark.slow
@pytest.mark.parametrize("model", ["opencv5", "hybrid"])
def test_views_without_a_board_at_all(model: str) -> None:
    """Corners anywhere: whatever is refused names the views to look at."""
    pixels = 400.0 * torch.rand(6, BOARD.corners, 2, generator=torch.Generator().manual_seed(1)).double()
    with pytest.raises((InputError, DegenerateError), match=r"v0\d"):
        calibrate_camera(observe(pixels), CalibrationOptions(model=model))


def test_which_views_look_least_like_a_board() -> None:
    pixels = shuffled(corners(), [4])
    assert least_planar(BOARD.points, pixels, [str(i) for i in range(VIEWS)]).startswith("4 (its corners are ")
    assert "," not in least_planar(BOARD.points, pixels, [str(i) for i in range(VIEWS)])
    both = least_planar(BOARD.points, shuffled(corners(), [4, 9]), [str(i) for i in range(VIEWS)])
    assert {text.strip().split(" ")[0] for text in both.split(",")} == {"4", "9"}


# Views that add nothing: copies are left out and named, frames of one pose are refused, ordinary captures are not.


TRUTH = camera("opencv5")

FIVE = CalibrationOptions(model="opencv5")


def noise(shape: tuple[int, ...], seed: int) -> torch.Tensor:
    return torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def seen() -> torch.Tensor:
    return pixels_of(TRUTH, motions(TRUTH, 6, 3), noise=NOISE, seed=3)


@pytest.mark.slow
@pytest.mark.parametrize("options", [FIVE, CalibrationOptions()], ids=["opencv5", "hybrid"])
def test_copies_change_nothing_and_are_named(seen: torch.Tensor, options: CalibrationOptions) -> None:
    """The same, or 0.01 px off, which is what JPEG does, with noise of 0.1 px."""
    alone = calibrate_camera(observe(seen), options)
    for change in (0.0, 0.01):
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
        assert result.warnings[-1].startswith(
            "3 of 9 views are copies of others (v06 of v01, v07 of v04, v08 of v01) and were left out"
        )
        assert result.warnings[:-1] == alone.warnings
        assert [math.isnan(rms) for rms in result.per_view_rms.tolist()] == [False] * 6 + [True] * 3
        torch.testing.assert_close(result.per_view_rms[:6], alone.per_view_rms, rtol=1e-8, atol=0)
        assert bool(result.residuals[6:].isnan().all())
        assert result.camera.calibration.record.views == 6
        assert (result.rejected_views[1].corners, result.rejected_views[1].residual) == (42, result.per_view_rms[4])


def test_frames_with_noise_of_their_own_are_no_copies(seen: torch.Tensor) -> None:
    """Six poses, three frames each: noise averages, and the message says what does not."""
    exact = pixels_of(TRUTH, motions(TRUTH, 6, 3))
    result = calibrate_camera(observe(exact.repeat(3, 1, 1) + NOISE * noise((18, 42, 2), 2)), FIVE)
    assert result.rejected_views == ()
    (warning,) = result.warnings
    assert warning.startswith("18 views show the board in 6 poses only")
    assert result.sigma["fx"] == pytest.approx(calibrate_camera(observe(seen), FIVE).sigma["fx"] / 3**0.5, rel=0.15)
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
    with pytest.raises(DegenerateError, match=rf"12 views show the board in {poses} poses? only, .*: at least 3"):
        calibrate_camera(observe(frames), options)
    with pytest.raises(DegenerateError, match=r"2 views of the board"):
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


@pytest.mark.slow
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


# What rich models may claim under their weak prior, and the covariance of tied and fixed parameters.


# The plain lens of most users: what its 14 coefficients cannot be told apart by.
TRUE_LENS = Camera.build(
    focal=(500, 505), center=(325.8, 235.3), size=(640, 480), coefficients=[-0.2, 0.05, 5e-4, -3e-4], model="opencv14"
)

POSES = motions(TRUE_LENS, 25, 3)


def capture(seed: int, **options: object) -> CameraCalibrationResult:
    pixels = pixels_of(TRUE_LENS, POSES, noise=0.2, seed=seed)
    return calibrate_camera(observe(pixels), CalibrationOptions(model="opencv14", **options))  # type: ignore[arg-type]


def squared_distance(result: CameraCalibrationResult) -> float:
    """Squared error of the image of one direction in units of its covariance; infinite without an image."""
    pixel = torch.tensor([[520.0, 120.0]], dtype=torch.float64)
    ray, valid = TRUE_LENS.normalize(pixel)
    assert bool(valid.all())
    point = torch.tensor([[float(ray[0, 0]), float(ray[0, 1]), 1.0]], dtype=torch.float64)
    camera = result.camera
    seen = project_components(point.T, camera.params, camera.model, list(range(len(camera.names))))
    if not bool(seen.regular.all()):
        return torch.inf
    error = seen.pixels[:, 0] - pixel[0]
    slopes = seen.by_camera[..., 0].T
    return float(error @ torch.linalg.solve(slopes @ result.covariance @ slopes.T, error))


@pytest.fixture(scope="module")
def plain() -> list[CameraCalibrationResult]:
    return [capture(seed, weak_prior=None) for seed in range(4)]


@pytest.fixture(scope="module")
def weak() -> list[CameraCalibrationResult]:
    return [capture(seed) for seed in range(8)]


@pytest.mark.slow
def test_ellipses_of_rich_models_hold_the_truth(weak: list[CameraCalibrationResult]) -> None:
    """8 captures; fewer than 6 inside 95 % ellipses happen once in 170. Gauss and Newton's held one in five."""
    assert sum(squared_distance(result) < 5.991 for result in weak) >= 6


@pytest.mark.slow
def test_a_weak_prior_ends_nearer_to_the_truth(
    plain: list[CameraCalibrationResult], weak: list[CameraCalibrationResult]
) -> None:
    def error(results: list[CameraCalibrationResult]) -> Tensor:
        return torch.stack([result.camera.center - TRUE_LENS.center for result in results]).square().mean().sqrt()

    assert float(error(weak[:4])) < 0.7 * float(error(plain))
    for one, other in zip(plain, weak[:4], strict=True):
        # It costs next to nothing in RMS: of 14 parameters, what chance gives them.
        assert one.rms <= other.rms * (1 + 1e-9)
        assert other.rms < one.rms * 1.03


@pytest.mark.slow
def test_sigma_is_the_covariances(plain: list[CameraCalibrationResult]) -> None:
    for result in plain:
        for k, name in enumerate(result.camera.names):
            sigma = result.sigma.get(name)
            if sigma is not None:
                assert sigma**2 == pytest.approx(float(result.covariance[k, k]), rel=1e-12)
        assert float(torch.linalg.eigvalsh(correlations(result.covariance))[0]) > -1e-9
        assert bool((result.covariance[result.camera.names.index("skew")] == 0).all())


def correlations(matrix: Tensor) -> Tensor:
    scale = torch.where(matrix.diagonal() > 0, matrix.diagonal(), 1.0).sqrt()
    return matrix / scale / scale[:, None]


def test_tied_and_fixed_parameters_in_the_covariance() -> None:
    pixels = pixels_of(camera("opencv4"), motions(camera("opencv4"), 6, 3), noise=0.2)
    options = CalibrationOptions(model="opencv4", tied=(("fx", "fy"),), fixed={"cx": None})
    found = calibrate_camera(observe(pixels), options).covariance
    assert float(found[0, 1]) == float(found[0, 0]) == float(found[1, 1]) > 0
    assert bool((found[2] == 0).all())


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_a_weak_prior_that_is_none_is_refused(value: float) -> None:
    with pytest.raises(InputError, match="weak_prior"):
        CalibrationOptions(weak_prior=value)


def test_a_small_model_hardly_feels_the_weak_prior() -> None:
    seen = observe(corner_pixels(12, 3, noise=0.2))
    with_prior, without = (
        calibrate_camera(seen, CalibrationOptions(model="opencv5", weak_prior=value)) for value in (0.3, None)
    )
    for k, name in enumerate(without.camera.names):
        sigma = without.sigma.get(name)
        if sigma is not None:
            assert abs(float(with_prior.camera.params[k] - without.camera.params[k])) < 0.5 * sigma, name
