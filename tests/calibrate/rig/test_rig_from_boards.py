"""Rigs, simulated: the pose comes back, turned and wrong pairs are found, and mixed-up input is refused."""

import functools
import os
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from calibrate_scenes import BOARD, SIZE, Motions, camera, motions, observe, pixels_of
from rig_scenes import CAMERAS, landmarks, tensor
from torch import Tensor

from kcal import (
    Board,
    Camera,
    FileError,
    InputError,
    Observations,
    RigData,
    RigOptions,
    calibrate_rig,
    load_rig,
    solve_rig,
)
from kcal.calibrate.problem.state import warp_modes
from kcal.calibrate.rig.pairs import boards_of_several, pair_by_name, read_pairs
from kcal.calibrate.rig.result import RigResult
from kcal.lens import rotation_from_vector, vector_from_rotation
from kcal.solve import SolverStatus
from kcal.texts import counted_text

# 8 x 6 corners: the colors are the same after half a turn, so that a detector cannot know the first corner.
AMBIGUOUS = Board(columns=8, rows=6, square=0.04)
LEFT = camera()
RIGHT = Camera.build(focal=(560, 555), center=(310.0, 250.0), size=SIZE, coefficients=[-0.15, 0.03, 0, 0.001, 0])
ROTATION = rotation_from_vector(torch.tensor([0.02, 0.1, 0.01], dtype=torch.float64))
TRANSLATION = torch.tensor([-0.12, 0.005, 0.01], dtype=torch.float64)


@functools.cache
def poses(count: int, seed: int, board: Board) -> Motions:
    """Boards seen completely by both cameras."""
    rotation, translation = motions(LEFT, 5 * count + 5, seed, board=board, fill=0.4)
    points = board.points @ rotation.transpose(-1, -2) + translation[:, None]
    pixels, valid = RIGHT.project(points @ ROTATION.T + TRANSLATION)
    both = (valid & RIGHT.inside(pixels)).all(-1).nonzero()[:count, 0]
    assert len(both) == count
    return rotation[both], translation[both]


def views(count: int, seed: int, *, board: Board = BOARD, noise: float = 0.0, noise_seed: int = 0) -> Tensor:
    """Corners (P, 2, N, 2)."""
    rotation, translation = poses(count, seed, board)
    left = pixels_of(LEFT, (rotation, translation), board=board, noise=noise, seed=noise_seed)
    turned = (ROTATION @ rotation, translation @ ROTATION.T + TRANSLATION)
    return torch.stack([left, pixels_of(RIGHT, turned, board=board, noise=noise, seed=noise_seed + 500)], 1)


def names(count: int) -> list[tuple[str, str]]:
    return [(f"l{i}", f"r{i}") for i in range(count)]


def labels(count: int) -> list[str]:
    """The pairs' names in a result."""
    return [" ".join(pair) for pair in names(count)]


def observed(pixels: Tensor, board: Board = BOARD) -> list[Observations]:
    """Of the left and the right camera."""
    return [observe(pixels[:, c], board=board, names=[pair[c] for pair in names(len(pixels))]) for c in (0, 1)]


def solve(
    pixels: Tensor, *, left: Camera = LEFT, right: Camera = RIGHT, board: Board = BOARD, **options: Any
) -> RigResult:
    return calibrate_rig(left, right, *observed(pixels, board), names(len(pixels)), RigOptions(**options))


def off(result: RigResult) -> tuple[float, float]:
    """Angle (radians) and distance (meters) from the true pose."""
    rig = result.stereo()
    turn = vector_from_rotation(rig.right_from_left_rotation @ ROTATION.T)
    return float(turn.norm()), float((rig.right_from_left_translation - TRANSLATION).norm())


class TestTruth:
    @pytest.mark.parametrize("count", [1, 2, 3])
    def test_comes_back(self, count: int) -> None:
        result = solve(views(count, 1))
        assert result.status == SolverStatus.EXACT
        assert result.rms < 1e-11
        assert max(off(result)) < 1e-11
        assert result.pairs == tuple(labels(count))
        assert result.flipped == ()
        assert result.left_out == ()
        assert float(result.stereo().baseline) == pytest.approx(float(TRANSLATION.norm()), rel=1e-10)
        told = [text.split(":")[0] for text in result.warnings]
        assert told == ([f"{counted_text(count, 'pair')} only"] if count < 3 else [])

    def test_corners_that_one_camera_did_not_see(self) -> None:
        pixels = views(5, 1)
        hidden = torch.rand(pixels.shape[:-1], generator=torch.Generator().manual_seed(1)) < 0.4
        pixels[hidden] = torch.nan
        result = solve(pixels)
        assert result.status == SolverStatus.EXACT
        assert max(off(result)) < 1e-10
        assert torch.equal(torch.isnan(result.pixels[..., 0]), hidden)

    def test_numbers_follow_from_the_residuals(self) -> None:
        pixels = views(6, 2, noise=0.2)
        pixels[2, 1, :9] = torch.nan
        result = solve(pixels)
        seen = torch.isfinite(pixels[..., 0]).sum(-1).double()
        left, right = result.rms_px
        both = ((left**2 * seen[:, 0].sum() + right**2 * seen[:, 1].sum()) / seen.sum()) ** 0.5
        assert result.rms == pytest.approx(float(both), rel=1e-12)
        squared = (result.pair_rms**2 * seen.sum(-1)).sum() / seen.sum()
        assert result.rms == pytest.approx(float(squared**0.5), rel=1e-9)
        # 0.2 px an axis, with 6 parameters and 36 of poses from 990 numbers; 4 standard errors.
        assert result.rms == pytest.approx(0.2 * (2 * (1 - 42 / 990)) ** 0.5, rel=4 / (2 * 990) ** 0.5)

    def test_refined_cameras_fit_no_worse_and_start_may_be_off(self) -> None:
        pixels = views(8, 3, noise=0.1)
        rough = [Camera(c.params * torch.tensor([1.01, 1.01] + [1.0] * 8).double(), size=SIZE) for c in (LEFT, RIGHT)]
        fixed = solve(pixels, left=rough[0], right=rough[1])
        refined = solve(pixels, left=rough[0], right=rough[1], intrinsics="free")
        assert refined.rms < fixed.rms
        assert refined.rms == pytest.approx(0.1 * 2**0.5, rel=0.1)
        assert abs(float(refined.cameras[0].focal[0]) - 500) < 4
        assert torch.equal(fixed.cameras[0].params, rough[0].params)
        # The error of the focal length shows in the σ of the pose.
        assert bool((refined.sigma_translation > solve(pixels).sigma_translation).all())

    @pytest.mark.slow
    def test_sigma_is_the_spread(self) -> None:
        """40 repetitions: 39 s² / σ² is χ²; s² / σ² lies in 0.332 to 2.17 but for 6e-5 (4 standard deviations)."""
        # In which nothing moves and nothing is wrong.
        plain = {"motion": False, "reject": False}
        results = [solve(views(4, 5, noise=0.2, noise_seed=seed), **plain) for seed in range(40)]
        turns = torch.stack(
            [vector_from_rotation(result.stereo().right_from_left_rotation @ ROTATION.T) for result in results]
        )
        shifts = torch.stack([result.stereo().right_from_left_translation - TRANSLATION for result in results])
        for found, sigma in ((turns, "sigma_rotation"), (shifts, "sigma_translation")):
            predicted = torch.stack([getattr(result, sigma) for result in results]).pow(2).mean(0)
            ratio = found.var(0) / predicted
            assert bool(((ratio > 0.332) & (ratio < 2.17)).all()), (sigma, ratio)
            assert bool((found.mean(0).abs() < 4.5 * (predicted / 40).sqrt()).all()), sigma


class TestSaving:
    @pytest.mark.parametrize("intrinsics", ["fixed", "free"])
    def test_all_that_is_known_comes_back(self, tmp_path: Path, intrinsics: str) -> None:
        pixels = views(6, 2, noise=0.1)
        pixels[1, 1], pixels[4, 1] = pixels[1, 1].flip(-2), pixels[4, 1] + 40.0
        result = solve(pixels, intrinsics=intrinsics)
        rig = load_rig(result.save(tmp_path / "rig.json"))
        assert rig.fingerprint == result.stereo().fingerprint
        assert rig.covariance is not None
        stored = result.stereo().covariance
        assert stored is not None
        assert torch.equal(rig.covariance.half, stored.half)
        scale = stored.half.norm(dim=0).clamp_min(1e-300)
        unit = (stored.matrix - result.joint_covariance()) / scale / scale[:, None]
        assert float(unit.abs().max()) < 1e-12
        record = rig.calibration
        assert record is not None
        assert record == result.stereo().calibration
        assert (record.rms, *record.rms_px) == (result.rms, *result.rms_px)
        assert record.per_pair_rms == dict(zip(result.pairs, result.pair_rms.tolist(), strict=True))
        assert record.flipped == ("l1 r1",)
        assert [left_out.name for left_out in record.excluded] == ["l4 r4"]


class TestBoardWarp:
    def test_comes_back(self) -> None:
        """A board that bulges by 3 mm along its rows and is flat along its columns."""
        rotation, translation = poses(8, 3, BOARD)
        bent = BOARD.points.clone()
        bent[:, 2] += tensor(0.003, 0.0) @ warp_modes(BOARD.points)[:, 2]
        points = bent @ rotation.transpose(-1, -2) + translation[:, None]
        pixels = torch.stack([LEFT.project(points)[0], RIGHT.project(points @ ROTATION.T + TRANSLATION)[0]], 1)
        flat = solve(pixels, reject=False)
        assert flat.board_warp is None
        assert flat.rms > 0.1
        for intrinsics in ("fixed", "free"):
            result = solve(pixels, board_warp=True, intrinsics=intrinsics)
            assert result.board_warp is not None
            torch.testing.assert_close(result.board_warp, tensor(0.003, 0.0), rtol=0, atol=1e-9)
            assert max(off(result)) < 1e-8

    def test_needs_boards(self) -> None:
        marks = landmarks()
        with pytest.raises(InputError, match="cannot be estimated without boards"):
            solve_rig(
                RigData(cameras=CAMERAS[:2], names=("left", "right"), landmarks=marks), RigOptions(board_warp=True)
            )


class TestWeights:
    @pytest.mark.slow
    def test_corners_count_by_their_covariances(self) -> None:
        """Half the corners five times worse, and known to be: the scatter of the yaw falls."""
        noise = torch.where(torch.arange(BOARD.corners) % 2 == 0, 0.05, 0.4)[:, None]
        error: dict[bool, list[float]] = {True: [], False: []}
        for seed in range(6):
            pixels = views(4, 5) + noise * torch.randn(
                4, 2, BOARD.corners, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
            )
            pairs = names(4)
            seen = []
            for plain in observed(pixels):
                spread = tuple((float(s) ** 2, 0.0, float(s) ** 2) for s in noise[:, 0])
                known = tuple(view.model_copy(update={"covariance": spread}) for view in plain.views)
                seen.append(plain.model_copy(update={"views": known}))
            for weighted in error:
                result = calibrate_rig(LEFT, RIGHT, seen[0], seen[1], pairs, RigOptions(weighted=weighted))
                error[weighted].append(off(result)[0] ** 2)
                # The RMS that is reported stays the plain one.
                assert result.rms == pytest.approx(float(noise.square().mean().sqrt()) * 2**0.5, rel=0.2)
        assert sum(error[True]) < 0.25 * sum(error[False])

    def test_boards_of_several_cameras_have_covariances_if_all_views_do(self) -> None:
        pixels, spread = views(4, 5), ((0.04, 0.01, 0.09),) * BOARD.corners
        plain, seen = {}, {}
        for c, name in enumerate(("left", "right")):
            plain[c] = observe(pixels[:, c], names=[f"{name}-{i}.png" for i in range(4)])
            known = tuple(view.model_copy(update={"covariance": spread}) for view in plain[c].views)
            seen[c] = plain[c].model_copy(update={"views": known})
        found = boards_of_several((LEFT, RIGHT), ("left", "right"), seen).covariance
        assert found is not None
        expected = torch.tensor([[0.04, 0.01], [0.01, 0.09]], dtype=torch.float64)
        assert torch.equal(found, expected.expand(4, 2, BOARD.corners, 2, 2))
        assert boards_of_several((LEFT, RIGHT), ("left", "right"), {**seen, 1: plain[1]}).covariance is None

    def test_covariance_is_that_of_the_sigmas(self) -> None:
        for refine in (False, True):
            result = solve(views(5, 3, noise=0.1), intrinsics="free" if refine else "fixed")
            assert result.joint_covariance().shape == (26, 26)
            sigma = result.joint_covariance().diagonal().sqrt()
            torch.testing.assert_close(sigma[20:23], result.sigma_rotation, rtol=1e-6, atol=0)
            torch.testing.assert_close(sigma[23:], result.sigma_translation, rtol=1e-6, atol=0)
            # Parameters that were held have none: all, or the skew of each camera.
            assert bool((sigma[:20] > 0).any()) == refine
            assert sigma[4] == sigma[14] == 0


class TestScatter:
    """Corners of one board that are off alike tell less than their noise and number say."""

    @pytest.mark.slow
    def test_covariance_knows_of_views_that_are_shifted(self) -> None:
        """By .06 px each, which shows in no residual; without a test of it χ² of the pose is 6 times too large."""
        squares = []
        for seed in range(6):
            pixels = views(10, 2, noise=0.1, noise_seed=seed)
            assert not solve(pixels, motion=False).findings
            generator = torch.Generator().manual_seed(seed)
            pixels[:, 1] += 0.06 * torch.randn(10, 1, 2, generator=generator, dtype=torch.float64)
            result = solve(pixels, motion=False)
            (told,) = result.findings
            assert told.name == "sigmas"
            times = float(re.findall(r"the boards differ from each other by ([0-9.]+) times", told.text)[0])
            assert 1.4 < times < 3.0
            turn = vector_from_rotation(result.stereo().right_from_left_rotation @ ROTATION.T)
            error = torch.cat([turn, result.stereo().right_from_left_translation - TRANSLATION])
            squares.append(float(error @ torch.linalg.solve(result.relative_covariance(), error)))
            # What is said of a corner stays its noise, and the source is as far off as was found.
            assert result.sigma_corner == pytest.approx(0.1, rel=0.15)
            assert result.sources[0].sigmas == pytest.approx(1.0, abs=0.1)
        assert sum(squares) / 6 < 2.0 * 6

    def test_of_few_boards_none_is_left_out(self) -> None:
        """Found in a real capture: of four pairs a good one was left out, and the baseline was off by 5 sigmas."""
        pixels = views(5, 2, noise=0.1)
        pixels[3, 1] += torch.tensor([0.0, 2.0], dtype=torch.float64)
        with pytest.raises(InputError, match=r"board l3 r3 and the other 4 contradict each other, and of so few"):
            solve(pixels)
        assert solve(pixels, reject=False).left_out == ()


class TestTurned:
    """Trap 8: a board read from its other end in some pairs."""

    @pytest.mark.parametrize(
        ("count", "side", "board"), [(1, 0, BOARD), (2, 1, BOARD), (1, 1, AMBIGUOUS), (2, 0, AMBIGUOUS)]
    )
    def test_in_20_and_40_percent_of_pairs(self, count: int, side: int, board: Board) -> None:
        pixels = views(5, 7, board=board, noise=0.1)
        plain = solve(pixels, board=board)
        turned = pixels.clone()
        which = [3, 1][:count]
        turned[which, side] = turned[which, side].flip(-2)
        result = solve(turned, board=board)
        assert [turned.board for turned in result.flipped] == [labels(5)[i] for i in sorted(which)]
        assert result.left_out == ()
        assert result.rms == pytest.approx(plain.rms, rel=1e-9)
        # Both stop where the cost is flat to 1e-12 of itself.
        assert float(result.stereo().baseline) == pytest.approx(float(plain.stereo().baseline), rel=1e-6)
        # The corners come back as used.
        expected = pixels.clone()
        if side == 0:
            expected[which] = expected[which].flip(-2)
        assert torch.equal(result.pixels, expected)

    def test_in_all_pairs_with_unseen_corners(self) -> None:
        pixels = views(5, 7, noise=0.1)
        pixels[2, 1, :10] = torch.nan
        pixels[4, 0, -12:] = torch.nan
        plain = solve(pixels)
        pixels[:, 1] = pixels[:, 1].flip(-2)
        result = solve(pixels)
        assert result.flipped == tuple((label, "right") for label in labels(5))
        assert float(result.stereo().baseline) == pytest.approx(float(plain.stereo().baseline), rel=1e-6)

    @pytest.mark.slow
    @pytest.mark.parametrize("count", [1, 2])
    def test_one_or_two_pairs_are_taken_as_read(self, count: int) -> None:
        """A single pair fits both ways; chance must not decide."""
        for seed in range(8):
            result = solve(views(count, seed, noise=0.1))
            assert result.flipped == ()
            assert result.left_out == ()
            assert off(result)[1] < 0.01


class TestWrongPairs:
    def test_are_left_out_and_named(self) -> None:
        pixels = views(8, 2, noise=0.1)
        wrong = pixels.clone()
        wrong[2, 1], wrong[5, 1] = pixels[5, 1], pixels[2, 1]
        result = solve(wrong)
        assert {item.name for item in result.left_out} == {"l2 r2", "l5 r5"}
        assert all("px away from where the other boards put it" in item.reason for item in result.left_out)
        assert [pair for pair in labels(8) if pair not in result.pairs] == ["l2 r2", "l5 r5"]
        assert len(result.pair_rms) == len(result.pixels) == 6
        kept = torch.tensor([0, 1, 3, 4, 6, 7])
        assert float(result.stereo().baseline) == pytest.approx(float(solve(pixels[kept]).stereo().baseline), rel=1e-6)

    @pytest.mark.slow
    def test_stay_and_are_named_where_nothing_is_rejected(self) -> None:
        pixels = views(8, 2, noise=0.1)
        pixels[3, 1] += 40.0
        result = solve(pixels, reject=False)
        assert result.left_out == ()
        assert result.pairs == tuple(labels(8))
        assert any(text.startswith("board l3 r3: ") and text.endswith("it was kept") for text in result.warnings)
        assert any("px is high" in text for text in result.warnings)

    @pytest.mark.parametrize("shift", [(0.0, 4.0), (15.0, 0.0)])
    def test_a_board_that_moved_between_the_exposures(self, shift: tuple[float, float]) -> None:
        """Left in, 4 px in one pair of eight turn the rig by 0.4 degrees."""
        pixels = views(8, 2, noise=0.1)
        pixels[3, 1] += torch.tensor(shift, dtype=torch.float64)
        result = solve(pixels)
        assert [item.name for item in result.left_out] == ["l3 r3"]
        assert off(result)[0] < 5 * float(result.sigma_rotation.norm())
        assert off(result)[1] < 5 * float(result.sigma_translation.norm())

    @pytest.mark.slow
    @pytest.mark.parametrize("shift", [(1.0, 0.0), (0.0, 1.0), (0.5, 0.5)])
    def test_a_pixel_is_noticed_and_can_be_left_out(self, shift: tuple[float, float]) -> None:
        """Each camera alone fits such a pair well, and the joint RMS hardly rises: what joining it costs tells."""
        pixels = views(8, 2, noise=0.1)
        pixels[3, 1] += torch.tensor(shift, dtype=torch.float64)
        warned = solve(pixels, reject=False)
        assert warned.left_out == ()
        assert [text.split(":")[0] for text in warned.warnings[:1]] == ["board l3 r3"]
        # Until it is left out, no board is trusted as much.
        assert [finding.name for finding in warned.findings[1:]] == ["sigmas"]
        assert max(warned.items, key=lambda item: item.over_limit).name == "l3 r3"
        result = solve(pixels, reject=True)
        assert [item.name for item in result.left_out] == ["l3 r3"]
        assert "does not fit the other boards" in result.left_out[0].reason
        assert result.warnings == ()
        assert off(result)[0] < 5 * float(result.sigma_rotation.norm())
        assert off(result)[0] < 0.5 * off(warned)[0]

    def test_good_pairs_are_neither_named_nor_left_out(self) -> None:
        for seed in range(3):
            result = solve(views(6, 2, noise=0.1, noise_seed=seed), reject=True)
            assert result.left_out == ()
            assert result.warnings == ()

    def test_an_exact_capture_loses_no_pair_to_rounding(self) -> None:
        assert solve(views(6, 2)).left_out == ()


class TestRefusals:
    def test_swapped_cameras(self) -> None:
        pixels = views(5, 1, noise=0.1)
        for seen, sides in ((pixels, (RIGHT, LEFT)), (pixels.flip(1), (LEFT, RIGHT))):
            with pytest.raises(InputError, match="swapped"):
                solve(seen, left=sides[0], right=sides[1])

    def test_nearly_equal_cameras_are_not_called_swapped_for_noise(self) -> None:
        assert solve(views(5, 1, noise=0.3), right=Camera(RIGHT.params * (1 + 1e-5), size=SIZE)).left_out == ()

    def test_another_camera(self) -> None:
        other = Camera.build(focal=(1200, 600), center=(320, 240), size=SIZE)
        with pytest.raises(InputError, match=r"right observations do not fit the right camera \(RMS \d+\.\d px\)"):
            solve(views(5, 1), right=other)

    @pytest.mark.slow
    def test_a_camera_that_is_merely_wrong_is_warned_of(self) -> None:
        other = Camera.build(focal=(800, 800), center=(320, 240), size=SIZE)
        assert "if nothing moved, a camera is wrong" in solve(views(6, 1), right=other).warnings[0]

    def test_views_that_do_not_belong_together(self) -> None:
        left, right = observed(views(3, 1))
        _, other = observed(views(3, 1), Board(columns=7, rows=6, square=0.051))
        half = Camera(RIGHT.params, size=(320, 240))
        for taker, seen, pairs, told in (
            (RIGHT, other, names(3), r"the cameras saw different boards: .*50 mm.*51 mm"),
            (half, right, names(3), "the right camera has images of 320x240, its observations of 640x480"),
            (RIGHT, right, [], "no pair of views"),
            (RIGHT, right, [("l0", "r7")], "no view named 'r7'"),
        ):
            with pytest.raises(InputError, match=told):
                calibrate_rig(LEFT, taker, left, seen, pairs)

    def test_too_few_corners(self) -> None:
        pixels = views(3, 1)
        pixels[1, 1, 5:] = torch.nan
        with pytest.raises(InputError, match="pair l1, r1: at least 6 corners are needed in each view"):
            solve(pixels)

    def test_corners_on_one_line(self) -> None:
        pixels = views(3, 1, noise=0.1)
        pixels[1, 1, 7:] = torch.nan
        with pytest.raises(InputError, match=r"r1: .* lie on one line"):
            solve(pixels)


class TestPairByName:
    @pytest.mark.parametrize(
        ("left", "right", "expected"),
        [
            (["left01.jpg", "left02.jpg"], ["right01.jpg", "right02.jpg"], [(0, 0), (1, 1)]),
            (["left02.jpg", "left01.jpg"], ["right01.jpg", "right03.jpg"], [(1, 0)]),
            (["l_1.png", "l_10.png"], ["r_10.png", "r_1.png"], [(0, 1), (1, 0)]),
            (["01_L.tif", "02_L.tif"], ["02_R.tif", "01_R.tif"], [(0, 1), (1, 0)]),
            (["cam0/0001.png", "cam0/0002.png"], ["cam1/0001.png", "cam1/0002.png"], [(0, 0), (1, 1)]),
            (["cam0_7.png"], ["cam1_7.png"], [(0, 0)]),
            (["Camera 2 - 0007.png"], ["Camera 3 - 0007.png"], [(0, 0)]),
            (["a.jpg", "b.jpg"], ["b.jpg", "a.jpg"], [(0, 1), (1, 0)]),
            (["IMG_0012.JPG"], ["DSC_00012.JPG"], [(0, 0)]),
            # "l" and "r" within words are no sides.
            (["world_1.png"], ["world_2.png", "world_1.png"], [(0, 1)]),
            # Equal names win over equal numbers.
            (["1_5.png", "2_5.png"], ["2_5.png", "1_5.png"], [(0, 1), (1, 0)]),
        ],
    )
    def test_pairs(self, left: list[str], right: list[str], expected: list[tuple[int, int]]) -> None:
        assert pair_by_name(left, right) == [(left[i], right[j]) for i, j in expected]

    @pytest.mark.parametrize(
        ("left", "right"),
        [
            (["a/left01.png", "b/left01.png"], ["right01.png"]),
            (["left01.png"], ["a/right01.png", "b/right01.png"]),
            (["x_1.png", "y_1.png"], ["z_1.png"]),
        ],
    )
    def test_doubt_is_an_error(self, left: list[str], right: list[str]) -> None:
        with pytest.raises(InputError, match=r"look alike; give a CSV of pairs"):
            pair_by_name(left, right)

    @pytest.mark.parametrize(("left", "right"), [(["left01.png"], ["right02.png"]), ([], ["a"]), (["a"], []), ([], [])])
    def test_no_partner_is_an_error(self, left: list[str], right: list[str]) -> None:
        with pytest.raises(InputError, match=r"has a partner by name .* give a CSV of pairs"):
            pair_by_name(left, right)


class TestPairsFile:
    LEFT, RIGHT = ("a.png", "b.png", "c, d.png"), ("1.png", "2.png", "3.png")

    def read(self, folder: Path, content: str | bytes) -> list[tuple[str, str]]:
        path = folder / "pairs.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return read_pairs(path, self.LEFT, self.RIGHT)

    @pytest.mark.parametrize(
        "content",
        [
            "left,right\na.png,2.png\nb.png,1.png\n",
            "left,right\r\na.png,2.png\r\nb.png,1.png",
            "\ufeffleft,right\na.png,2.png\nb.png,1.png\n",
            "left , right\n\n a.png , 2.png\n\nb.png,1.png\n\n",
            'left,right\n"a.png",2.png\nb.png,"1.png"',
        ],
        ids=["plain", "Windows", "byte order mark", "blanks", "quotes"],
    )
    def test_reads(self, tmp_path: Path, content: str) -> None:
        assert self.read(tmp_path, content) == [("a.png", "2.png"), ("b.png", "1.png")]

    @pytest.mark.parametrize(
        ("content", "error", "message"),
        [
            ("", FileError, "the header must be left,right; it is nothing"),
            ("right,left\n1.png,a.png\n", FileError, "the header must be left,right; it is right,left"),
            ("a.png,1.png\n", FileError, "it is a.png,1.png"),
            ("left;right\na.png;1.png\n", FileError, "it is left;right"),
            ("left,right\n", FileError, "no pair below the header"),
            ("left,right\n\n\n", FileError, "no pair below the header"),
            ("left,right\na.png\n", FileError, "line 2 has 1 fields, two are needed"),
            ("left,right\na.png,1.png,x\n", FileError, "line 2 has 3 fields"),
            (
                "left,right\na.png,1.png\nz.png,2.png\n",
                InputError,
                "line 3: no view of the left camera is named 'z.png'",
            ),
            ("left,right\na.png,b.png\n", InputError, "line 2: no view of the right camera is named 'b.png'"),
            ("left,right\na.png,1.png\na.png,2.png\n", InputError, "line 3: 'a.png' is paired twice"),
            ("left,right\na.png,1.png\nb.png,1.png\n", InputError, "line 3: '1.png' is paired twice"),
            (b"left,right\na\xff.png,1.png\n", FileError, "cannot read"),
            ("left,right\n" + 200_000 * "a" + ",1.png\n", FileError, "cannot read: field larger"),
        ],
    )
    def test_refuses(self, tmp_path: Path, content: str | bytes, error: type[Exception], message: str) -> None:
        with pytest.raises(error) as caught:
            self.read(tmp_path, content)
        assert str(caught.value).startswith(str(tmp_path / "pairs.csv"))
        assert message in str(caught.value)

    def test_what_is_no_file(self, tmp_path: Path) -> None:
        os.mkfifo(tmp_path / "pipe.csv")  # to which nobody writes
        for name, told in (("none.csv", "cannot read"), ("", "cannot read"), ("pipe.csv", "not a regular file")):
            with pytest.raises(FileError, match=told):
                read_pairs(tmp_path / name, self.LEFT, self.RIGHT)
