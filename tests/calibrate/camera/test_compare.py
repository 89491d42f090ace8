"""Comparison of models, refits, files of results, and the check of intervals."""

import functools
import math
from pathlib import Path

import cv2
import pytest
import torch
from calibrate_scenes import SIZE, camera, corner_pixels, observe
from command_line import invoked as run
from lenses import HYBRID, strong
from printed_boards import printed_views

from kcal import Board, CalibrationOptions, Camera, DegenerateError, InputError, Observations, calibrate_camera
from kcal.calibrate.camera.advice import possible_views
from kcal.calibrate.camera.at_setting import ComparisonResult, compare_models
from kcal.calibrate.camera.checks import OutlierRejection
from kcal.corners.marker_boards import _opencv_board
from kcal.io.camera_file import CameraFile, load_camera, save_camera
from kcal.lens import camera_difference, refit_camera
from kcal.lens.uncertainty import paraxial_focal
from scripts.shared.printed_board import Paper, pose

# A parametric camera in place of another one, with the misfit stated.


def test_a_model_that_holds_the_lens_finds_it() -> None:
    truth = camera("opencv5")
    found = refit_camera(truth, "opencv14")
    assert found.rms < 1e-3
    assert found.covered == 1.0
    pixels = truth.grid(9, 7).reshape(-1, 2)
    rays, _ = truth.unproject(pixels)
    assert float((found.camera.project(1e6 * rays)[0] - pixels).norm(dim=-1).max()) <= found.largest * 1.5


@pytest.mark.slow
def test_the_misfit_is_that_over_the_image() -> None:
    """A richer model misses less; what is stated is what a comparison at other places of the image finds."""
    head = torch.tensor([520.0, 520.0, 325.0, 235.0, 0.0], dtype=torch.float64)
    truth = Camera(torch.cat([head, 0.3 * strong(HYBRID)]), size=SIZE, model=HYBRID)
    plain, rich = refit_camera(truth, "opencv4"), refit_camera(truth, "opencv14")
    assert 0 < rich.rms < plain.rms
    pixels = truth.grid(40, 30).reshape(-1, 2)
    rays, _ = truth.unproject(pixels)
    seen, valid = rich.camera.project(1e9 * rays)
    rms = float((seen - pixels)[valid].square().sum(-1).mean().sqrt())
    assert rms == pytest.approx(rich.rms, rel=0.1)


def test_refusals() -> None:
    with pytest.raises(InputError, match="parametric"):
        refit_camera(camera(), HYBRID)
    with pytest.raises(InputError, match="unknown lens model"):
        refit_camera(camera(), "opencv9")


# Models compared on held-out views: the true one predicts to the noise, a poorer one does not, and errors are told.


BOARD = Board(columns=8, rows=6, square=0.04)

COMPARED_SIZE = (640, 480)

NOISE = 0.05


@functools.cache
def capture(count: int = 12, bend: float = 0.0, spread: bool = False) -> Observations:
    """Views through a lens of opencv5; a board that is bent obliquely by so many meters."""
    camera = Camera.build(focal=(500, 500), center=(322, 238), size=COMPARED_SIZE, coefficients=[-0.25, 0.08])
    points = BOARD.points.clone()
    middle = points.mean(0)
    a, b = ((points - middle) / (points.amax(0) - middle).clamp_min(1e-9))[:, :2].T
    points[:, 2] = bend * a * b
    seen = observe(printed_views(camera, BOARD, points, count, 3, noise=NOISE), board=BOARD, size=COMPARED_SIZE)
    known = ((NOISE**2, 0.0, NOISE**2),) * len(points) if spread else None
    return seen.model_copy(
        update={"views": tuple(view.model_copy(update={"covariance": known}) for view in seen.views)}
    )


@pytest.mark.slow
def test_the_true_model_predicts_to_the_noise() -> None:
    result = compare_models(capture(), ["pinhole", "opencv5"], groups="views", parts=4)
    # Of each held-out view six numbers are fitted again, the poses.
    wanted = NOISE * math.sqrt(2.0 - 6.0 / len(BOARD.points))
    assert result.rms["opencv5"] == pytest.approx(wanted, rel=0.1)
    assert result.rms["pinhole"] > 10 * wanted
    more, error = result.difference("pinhole", "opencv5")
    assert more > 3 * error > 0
    assert result.failures == {}
    assert result.corners.tolist() == [48] * 12


@pytest.mark.slow
def test_the_board_is_the_measured_one() -> None:
    """An oblique bend of 1.5 mm: with the ordered board, or a warp that cannot follow it, held-out views show it."""
    result = compare_models(capture(bend=1.5e-3), ["hybrid", "opencv5"], groups="views", parts=2)
    wanted = NOISE * math.sqrt(2.0 - 6.0 / len(BOARD.points))
    assert result.rms["hybrid"] < 1.3 * wanted
    assert result.rms["opencv5"] > 2 * wanted


@pytest.mark.slow
def test_equal_covariances_change_nothing() -> None:
    plain, weighted = (
        compare_models(capture(spread=spread), ["opencv5"], groups="views", parts=3) for spread in (False, True)
    )
    assert weighted.rms["opencv5"] == pytest.approx(plain.rms["opencv5"], rel=1e-6)


@pytest.mark.slow
def test_groups() -> None:
    told: list[str] = []
    result = compare_models(capture(), ["opencv4"], groups=list("aabbccddeeff"), parts=2, progress=told.append)
    assert result.corners.tolist() == [96] * 6
    assert told == ["opencv4, part 1 of 2", "opencv4, part 2 of 2"]
    assert compare_models(capture(), ["opencv4"], parts=2).corners.tolist() == [288] * 2
    with pytest.raises(InputError, match="a label for each of the 12 views"):
        compare_models(capture(), ["opencv4"], groups="everything")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="2 groups of views cannot be held out in 3 parts"):
        compare_models(capture(), ["opencv4"], groups=[0] * 6 + [1] * 6, parts=3)


def test_models_that_cannot_be_fitted_are_infinite_and_named() -> None:
    few = capture().subset(capture().names[:4])
    with pytest.raises(DegenerateError):
        compare_models(few, ["opencv5"], groups="views", parts=2)
    for names in ([], ["opencv5", "opencv5"]):
        with pytest.raises(InputError, match="different models"):
            compare_models(capture(), names)
    camera = Camera.build(focal=(500, 500), center=(322, 238), size=COMPARED_SIZE)
    with pytest.raises(InputError, match="known camera"):
        compare_models(capture(), ["opencv5"], options=CalibrationOptions(camera=camera))


def test_errors_of_differences() -> None:
    """The delta method, against draws of whole groups."""
    generator = torch.Generator().manual_seed(0)
    corners = torch.full((400,), 40)
    common = torch.rand(400, dtype=torch.float64, generator=generator) * 5
    costs = torch.stack([common, common * 1.1 + 0.3 * torch.rand(400, dtype=torch.float64, generator=generator)])
    result = ComparisonResult(models=("a", "b"), costs=costs, corners=corners)
    more, error = result.difference("b", "a")
    draws = []
    for _ in range(300):
        some = torch.randint(400, (400,), generator=generator)
        one, other = (costs[:, some].sum(-1) / corners[some].sum()).sqrt()
        draws.append(float(other - one))
    assert error == pytest.approx(float(torch.tensor(draws).std()), rel=0.15)
    assert more == pytest.approx(result.rms["b"] - result.rms["a"])
    broken = ComparisonResult(
        models=("a", "b"), costs=costs.index_fill(1, torch.tensor([3]), math.inf), corners=corners
    )
    assert broken.rms == {"a": math.inf, "b": math.inf}
    assert all(map(math.isnan, broken.difference("a", "b")))


# A result saves itself: the camera, its error bars, and how it was calibrated.


def test_all_that_is_known_is_in_the_file(tmp_path: Path) -> None:
    pixels = corner_pixels(8, 2)
    pixels = pixels + 0.1 * torch.randn(pixels.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    pixels[2, 7] += 30.0
    seen = observe(pixels)
    result = calibrate_camera(seen, CalibrationOptions(model="opencv5", reject=OutlierRejection()))
    assert [corner.view for corner in result.rejected_corners] == [seen.names[2]]

    file = CameraFile.load(result.save(tmp_path / "left.camera.json", name="left", source="left.obs.json"))
    assert file.name == "left"
    assert file.camera().fingerprint == result.camera.fingerprint
    assert file.standard_deviations is not None
    assert {name: file.standard_deviations[name] for name in result.sigma} == result.sigma
    stored = file.covariance_matrix()
    assert stored is not None
    assert torch.equal(stored, result.information.covariance())
    # Once inverted from normal equations, once from their root.
    scale = result.covariance.diagonal().sqrt().clamp_min(1e-300)
    assert float(((stored - result.covariance) / scale / scale[:, None]).abs().max()) < 1e-6
    record = file.calibration
    assert (record.rms, record.views, record.points) == (result.rms, 8, int(pixels.shape[0] * pixels.shape[1]) - 1)
    assert list(record.per_view_rms) == list(seen.names)
    assert record.excluded == result.excluded
    assert record.excluded[0].name == f"{seen.names[2]} corner 7"
    assert record.observations == "left.obs.json"
    # A board that was taken as ordered was not measured.
    assert record.board_deviation is None

    # The camera itself carries all of it, until its parameters change.
    carried = load_camera(save_camera(result.camera, tmp_path / "again.camera.json")).calibration
    assert carried.record.excluded == result.excluded
    assert carried.sigma["fx"] == result.sigma["fx"]


@pytest.mark.parametrize("options", [{"model": "opencv5"}, {"model": "opencv5", "board_warp": True}, {}])
def test_how_the_board_deviates_is_kept_where_it_was_solved(tmp_path: Path, options: dict) -> None:
    """Of a warped board and of a printed one; a board that was taken as exact has nothing to keep."""
    pixels = corner_pixels(8, 2)
    seen = observe(pixels + 0.1 * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(3)))
    result = calibrate_camera(seen, CalibrationOptions(**options))
    record = CameraFile.load(result.save(tmp_path / "a.camera.json")).calibration
    if options == {"model": "opencv5"}:
        assert record.board_deviation is None
        return
    assert record.board_deviation is not None
    moved = result.board_points - seen.board.points
    assert record.board_deviation == tuple((x, y, z) for x, y, z in moved.tolist())
    assert float(moved.abs().max()) > 0


# From rendered photographs of each kind of board to a camera: it is the true one within its error bars.


CAMERA = Camera.build(focal=(430, 430), center=(243, 177), size=(480, 360), coefficients=[-0.1, 0.02])

TILTS = (
    [0.5, 0.0, 0.0], [-0.5, 0.0, 0.1], [0.0, 0.5, 1.5], [0.0, -0.5, -0.1],
    [0.35, 0.35, 0.8], [-0.35, 0.35, 0.0], [0.1, 0.1, 1.6], [0.35, -0.35, 3.0],
)  # fmt: skip

KALIBR = "target_type: 'aprilgrid'\ntagCols: 4\ntagRows: 3\ntagSize: 0.035\ntagSpacing: 0.3\n"


def photographs(folder, paper, distance, shift):
    for i, tilt in enumerate(TILTS):
        place = (shift * (1, -1)[i % 2], shift * (1, -1)[i // 2 % 2])
        image, _ = paper.shoot(
            CAMERA, *pose(paper.board, tilt, distance * (1.15 if i % 3 else 1.0), place), seed=i, supersample=3
        )
        cv2.imwrite(f"{folder}/{i}.png", image)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "square", "distance", "shift"),
    [
        ("april.yaml", None, 0.33, 0.02),
        ("asymmetric:4x11", "20mm", 0.42, 0.008),
        ("circles:8x6:11mm", "22mm", 0.31, 0.008),
    ],
)
def test_calibration(tmp_path, text, square, distance, shift):
    if square is None:
        (tmp_path / text).write_text(KALIBR)
        text = str(tmp_path / text)
    what = ["--board", text, *(["--square", square] if square else [])]
    board = Board.parse(text, square)
    photographs(tmp_path, Paper(board, 0.25), distance, shift)
    seen, file = tmp_path / "a.obs.json", tmp_path / "a.camera.json"
    told = run("detect", tmp_path / "*.png", *what, "-o", seen, "--gallery", tmp_path / "gallery.png")
    width, height = (1000 * side for side in board.extent)
    assert "board found in 8 of 8 images" in told
    assert f"{width:g} x {height:g} mm" in " ".join(told.split())
    assert ("looks the same turned by 180°" in told) == (board.pattern == "circles")
    assert Observations.load(seen).board == board
    told = run("calibrate", seen, "-o", file)
    assert f"{width:g} x {height:g} mm" in " ".join(told.split())
    camera = load_camera(file)
    assert camera.calibration.record.board == board.record
    assert str(board.record) in " ".join(run("show", file).split())
    difference = camera_difference(camera, CAMERA)
    # Error bars that hold: chance makes larger differences in more than 1 of 100 cases.
    assert difference.probability > 0.01
    focal = paraxial_focal(camera)
    assert float((focal.value - 430).abs().max()) < 3 * float(focal.sigma.max())
    assert float(focal.sigma.max()) < 0.005 * 430
    # What follows from a board is there for each kind.
    assert len(possible_views(camera, board).words) > 50


@pytest.mark.slow
def test_old_charuco_boards_calibrate(tmp_path):
    """The old numbering, as OpenCV drew it; views that show a part only."""
    board = Board.parse("charuco:8x5", "25mm")
    paper = Paper(board, 0.25)
    cells = round(25 / 0.25)
    size = ((board.columns + 1) * cells, (board.rows + 1) * cells)
    drawn = torch.from_numpy(_opencv_board(board, True).generateImage(size)) / 255.0
    left, top = (round(float(side) / 0.25) - cells for side in paper.origin)
    paper.light[top : top + size[1], left : left + size[0]] = drawn.numpy()
    photographs(tmp_path, paper, 0.26, 0.04)
    seen, file = tmp_path / "a.obs.json", tmp_path / "a.camera.json"
    run("detect", tmp_path / "*.png", "--board", "charuco:8x5", "--square", "25mm", "-o", seen)
    assert any(None in view.pixels for view in Observations.load(seen).views)
    run("calibrate", seen, "-o", file)
    assert camera_difference(load_camera(file), CAMERA).probability > 0.01


@pytest.mark.slow
def test_two_boards_are_detected_one_after_the_other(tmp_path):
    from scripts.shared.printed_board import expose, light_of

    boards = Board.parse("aprilgrid:3x3", "30mm"), Board.parse("aprilgrid:3x3:id9", "30mm")
    papers = [Paper(board, 0.25) for board in boards]
    for i, tilt in enumerate(TILTS[:3]):
        scenes = [(papers[k], *pose(boards[k], tilt, 0.5, (x, 0.0))) for k, x in enumerate((-0.1, 0.1))]
        cv2.imwrite(str(tmp_path / f"{i}.png"), expose(light_of(scenes, CAMERA, 3), *CAMERA.size, supersample=3))
    for number, text in enumerate(("aprilgrid:3x3", "aprilgrid:3x3:id9")):
        output = tmp_path / f"{number}.obs.json"
        run("detect", tmp_path / "*.png", "--board", text, "--square", "30mm", "-o", output)
        assert len(Observations.load(output).views) == 3
    left, right = (Observations.load(tmp_path / f"{number}.obs.json").pixels()[0, :, 0] for number in (0, 1))
    assert float(left.nanmean()) < 240 < float(right.nanmean())
