"""The 26 real images of OpenCV's stereo sample (environment variable KCAL_DATA), against OpenCV on the same corners."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from kcal import Board, Camera, Observations, RigOptions, calibrate_rig, detect
from kcal.calibrate.camera.calibrate import CalibrationOptions, CameraCalibrationResult, calibrate_camera
from kcal.calibrate.rig.result import RigResult
from kcal.lens import camera_difference
from kcal.report.judge_rig import triangulated_sides
from kcal.rig import pair_by_name

cv2 = pytest.importorskip("cv2")

BOARD = Board(columns=9, rows=6, square=0.025)
SIZE = (640, 480)
STEPS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 300, 1e-12)
RATIONAL = cv2.CALIB_RATIONAL_MODEL
PRISM = RATIONAL | cv2.CALIB_THIN_PRISM_MODEL
FLAGS = {"opencv5": 0, "opencv8": RATIONAL, "opencv12": PRISM, "opencv14": PRISM | cv2.CALIB_TILTED_MODEL}
SIDES = ("left", "right")
Solve = Callable[[str, str], CameraCalibrationResult]


@pytest.fixture(scope="module")
def seen(kcal_data: Path) -> dict[str, Observations]:
    """Corners of both cameras, rounded to float32 as OpenCV takes them.

    By the saddle fit, which leaves out no corner here and gives no covariances: both sides minimize the plain RMS.
    """
    found = {}
    for side in SIDES:
        views = detect(sorted((kcal_data / "opencv_stereo").glob(f"{side}*.jpg")), BOARD, "saddle")
        assert len(views.views) == 13
        pixels = views.pixels()
        assert bool(torch.isfinite(pixels).all())
        rounded = pixels.float().double().tolist()
        kept = [
            view.model_copy(update={"pixels": tuple(map(tuple, corners))})
            for view, corners in zip(views.views, rounded, strict=True)
        ]
        found[side] = views.model_copy(update={"views": tuple(kept)})
    return found


@pytest.fixture(scope="module")
def solved(seen: dict[str, Observations]) -> Solve:
    """kcal's calibrations, each solved once."""
    known: dict[tuple[str, str], CameraCalibrationResult] = {}

    def solve(side: str, model: str) -> CameraCalibrationResult:
        if (side, model) not in known:
            known[side, model] = calibrate_camera(seen[side], CalibrationOptions(weak_prior=None, model=model))
        return known[side, model]

    return solve


def opencv(seen: Observations, model: str) -> tuple:
    pixels = seen.pixels().float()
    board = BOARD.points.float().numpy()
    return cv2.calibrateCamera(
        [board] * len(pixels), list(pixels.numpy()), SIZE, None, None, flags=FLAGS[model], criteria=STEPS
    )


# Of the right images; of the left ones OpenCV's minimum with 14 coefficients, which have many, is 0.7 % lower than the
# lower one of the two next to kcal's starts.
class TestCamera:
    @pytest.mark.slow
    def test_five_coefficients_are_opencvs(self, seen: dict[str, Observations], solved: Solve) -> None:
        rms, matrix, lens, *_ = opencv(seen["right"], "opencv5")
        result = solved("right", "opencv5")
        assert result.rms == pytest.approx(rms, abs=1e-6)
        assert result.rms < 0.17
        # The board bends, which this lens does not allow for.
        assert [finding.name for finding in result.findings] == ["patterns"]
        # The same camera to the digits at which OpenCV stops, which is far below σ (0.3 px).
        found = result.camera.matrix
        assert float(found[0, 0]) == pytest.approx(matrix[0, 0], abs=1e-2)
        assert float(found[1, 2]) == pytest.approx(matrix[1, 2], abs=1e-2)
        other = Camera.build(
            focal=(matrix[0, 0], matrix[1, 1]), center=(matrix[0, 2], matrix[1, 2]), size=SIZE, coefficients=lens[0, :5]
        )
        rays, valid = other.unproject(other.grid(17, 13).reshape(-1, 2))
        assert bool(valid.all())
        assert float((result.camera.project(rays)[0] - other.project(rays)[0]).abs().max()) < 1e-2

    @pytest.mark.slow
    @pytest.mark.parametrize("model", ["opencv8", "opencv12", "opencv14"])
    def test_richer_models_never_end_above_opencv(
        self, model: str, seen: dict[str, Observations], solved: Solve
    ) -> None:
        # OpenCV rounds the board's corners to float32: 1e-6 px.
        assert solved("right", model).rms <= opencv(seen["right"], model)[0] + 1e-6

    @pytest.mark.slow
    def test_richer_models_never_end_above_smaller_ones(self, solved: Solve) -> None:
        rms = [solved("right", model).rms for model in ("opencv4", *FLAGS)]
        assert rms == sorted(rms, reverse=True)

    @pytest.mark.slow
    def test_a_model_that_is_too_rich_says_so(self, solved: Solve) -> None:
        """13 views do not determine 14 coefficients: σ of the principal point grows tenfold, or a warning comes."""
        rich, plain = solved("right", "opencv14"), solved("right", "opencv5")
        grown = [(rich.sigma[name] or torch.inf) / (plain.sigma[name] or 0.0) for name in ("cx", "cy")]
        assert rich.warnings or min(grown) > 3.0


@pytest.fixture(scope="module")
def rigs(seen: dict[str, Observations], solved: Solve) -> dict[bool, RigResult]:
    """Solved with the cameras held (False) and refined (True); as in OpenCV, nothing is left out and nothing moves."""
    cameras = [solved(side, "opencv5").camera for side in SIDES]
    pairs = pair_by_name(seen["left"].names, seen["right"].names)
    plain = RigOptions(reject=False, motion=False)
    options = {refine: dataclasses.replace(plain, intrinsics="free" if refine else "fixed") for refine in (False, True)}
    return {refine: calibrate_rig(*cameras, *seen.values(), pairs, option) for refine, option in options.items()}


class TestRig:
    @pytest.mark.slow
    def test_is_opencvs(self, seen: dict[str, Observations], rigs: dict[bool, RigResult]) -> None:
        result = rigs[False]
        assert len(result.pairs) == 13
        assert result.flipped == ()
        assert result.left_out == ()
        # One of these pairs costs ten times as much to join as the typical one: nothing is left out, but it is named.
        named, scatter = result.warnings
        assert named.startswith("board left08.jpg right08.jpg: it does not fit")
        # Fixed cameras of five coefficients pull the boards apart by more than their corners' noise explains.
        assert scatter.startswith("the boards differ from each other by")
        board = BOARD.points.float().numpy()
        corners = [list(seen[side].pixels().float().numpy()) for side in SIDES]
        lenses = [
            part for camera in result.cameras
            for part in (camera.matrix.numpy().copy(), camera.coefficients.numpy().copy())
        ]  # fmt: skip
        rms, _, _, _, _, rotation, translation, *_ = cv2.stereoCalibrate(
            [board] * 13, *corners, *lenses, SIZE, flags=cv2.CALIB_FIX_INTRINSIC, criteria=STEPS
        )
        assert result.rms == pytest.approx(rms, rel=1e-6)
        assert float(result.stereo().baseline) == pytest.approx(float((translation**2).sum() ** 0.5), rel=1e-6)
        found = result.stereo().right_from_left_rotation
        torch.testing.assert_close(found, torch.from_numpy(rotation).double(), rtol=0, atol=1e-6)

    def test_refined_cameras_never_end_above(self, rigs: dict[bool, RigResult]) -> None:
        assert rigs[True].rms <= rigs[False].rms
        assert rigs[True].left_out == ()

    @pytest.mark.parametrize("refined", [False, True])
    def test_squares_are_as_large_as_they_are(self, rigs: dict[bool, RigResult], refined: bool) -> None:
        result = rigs[refined]
        mean, _ = triangulated_sides(result.stereo(), BOARD.columns, BOARD.rows, result.pixels)
        assert mean == pytest.approx(BOARD.square, rel=1e-3)

    @pytest.mark.slow
    def test_a_turned_board_changes_nothing(
        self, seen: dict[str, Observations], solved: Solve, rigs: dict[bool, RigResult]
    ) -> None:
        turned = [
            view.model_copy(update={"pixels": view.pixels[::-1]}) if i in (2, 6, 9) else view
            for i, view in enumerate(seen["right"].views)
        ]
        right = seen["right"].model_copy(update={"views": tuple(turned)})
        pairs = pair_by_name(seen["left"].names, right.names)
        cameras = [solved(side, "opencv5").camera for side in SIDES]
        result = calibrate_rig(*cameras, seen["left"], right, pairs, RigOptions(reject=False, motion=False))
        assert [result.pairs.index(turned.board) for turned in result.flipped] == [2, 6, 9]
        # The calibrations know nothing but these pairs: refining within them is letting the cameras free.
        assert float(result.stereo().baseline) == pytest.approx(float(rigs[True].stereo().baseline), rel=1e-7)


@pytest.mark.slow
def test_a_lens_seen_in_a_ring_alone_is_solved_to_the_end(kcal_data: Path) -> None:
    """A mirror's focal length is hardly determined, so that rounds of evidence drift along a valley.

    A round that ended before its solution once had the largest evidence, and the camera an RMS of 0.73 px.
    """
    found = calibrate_camera(Observations.load(kcal_data / "captures" / "kaidan.obs.json"))
    assert found.rms < 0.1
    assert found.hybrid.converged
    assert float(found.camera.focal[0] / found.hybrid.families.mean[0]) < 1.7
    # σ is of corners along an axis, wider where residuals repeat within views.
    assert found.rms / 2**0.5 < found.hybrid.sigma < 2.0 * found.rms


@pytest.mark.slow
def test_four_views_of_a_stranger(kcal_data: Path) -> None:
    """Two focal lengths led them astray: no lens showed all corners."""
    seen = Observations.load(kcal_data / "captures" / "gavin_r.obs.json")
    few = [f"chessboard-R{number}.png" for number in (15, 8, 5, 14)]
    rest = [name for name in seen.names if name not in few]
    found, others = (calibrate_camera(seen.subset(names)).camera for names in (few, rest))
    assert camera_difference(found, others).same
