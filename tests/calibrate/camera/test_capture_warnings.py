"""What is said of views that moved while their rows were read, and of boards that are not as ordered."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from calibrate_scenes import observe

from kcal import Board, CalibrationOptions, Camera, DegenerateError, InputError, Observations, View, calibrate_camera
from kcal.calibrate.camera.warnings import (
    check_end,
    general_findings,
    measured_aspect,
    motion_findings,
    moves_beyond_hands,
    pixel_findings,
)
from kcal.calibrate.hybrid.fit import FitOptions, HybridFit, fit_hybrid
from kcal.calibrate.problem.state import LARGEST
from kcal.finding import sentences
from kcal.lens import rotation_from_vector
from kcal.lens.uncertainty import paraxial_focal
from kcal.lens.zernike import ZernikeModes
from kcal.sim.captures import BoardSize, board_points, sample_board_poses
from kcal.solve.lm import SolverStatus
from scripts.shared.simulated import Hands, moving_capture

BOARD = BoardSize(9, 6, 0.05)
CAMERA = Camera.build(focal=(1100, 1100), center=(639.5, 479.5), size=(1280, 960), coefficients=[-0.1])
HANDS = Hands(turning=(1.0, 1.0), speed=(0.3, 0.3), readout=(0.03, 0.03), exposure=(0.005, 0.005))
MODES = ZernikeModes(radial=7, decentered=4, astigmatic=3, other=2)


def fitted(views: int, hands: Hands | None) -> HybridFit:
    poses = sample_board_poses(CAMERA, BOARD, views, torch.Generator().manual_seed(4), fill=(0.3, 0.5))
    seen = moving_capture(CAMERA, poses, sigma=0.05, seed=5, hands=hands, board=BOARD).pixels
    pixels = torch.where(CAMERA.inside(seen.nan_to_num(nan=-9.0))[..., None], seen, torch.nan)
    return fit_hybrid(board_points(BOARD), pixels, CAMERA.size, options=FitOptions(modes=MODES, square=True))


@pytest.mark.slow
def test_motion_is_told_in_pixels() -> None:
    fit = fitted(12, HANDS)
    many = sentences(motion_findings(fit))
    assert len(many) == 1
    assert "moved while rows were read" in many[0]
    assert fit.motion_sigma is not None
    assert fit.readout is not None
    log_ratio = fit.log_ratio + math.log(LARGEST / fit.motion_sigma.shift)
    at_limit = dataclasses.replace(fit, log_ratio=np.where(np.arange(4) == 1, log_ratio, fit.log_ratio))
    near = dataclasses.replace(at_limit, readout=dataclasses.replace(fit.readout, distance=0.1))
    assert [moves_beyond_hands(one) for one in (fit, at_limit, near)] == [False, True, False]
    assert "views move by more than any hand does" in sentences(motion_findings(at_limit))[0]
    assert "moved while rows were read" in sentences(motion_findings(near))[0]
    assert motion_findings(fitted(12, None)) == []


@pytest.mark.slow
def test_few_views_that_moved() -> None:
    """They do not tell that they moved, nor that they stood still."""
    for hands in (HANDS, None):
        few = sentences(motion_findings(fitted(5, hands)))
        assert [text.startswith("5 views hardly tell whether") for text in few] == [True]


def test_a_camera_without_rays() -> None:
    folded = Camera.build(focal=(800, 800), center=(321, 240), size=(640, 480), coefficients=[-1e9])
    with pytest.raises(DegenerateError, match="no pixel of the image has a ray"):
        general_findings(["a"], folded, 0.1, torch.tensor([0.1]), (), SolverStatus.CONVERGED)


def unequal(factor: float, board: Board, roll: float = math.pi, aspect: float = 1.0) -> Observations:
    """Views of a board whose columns are farther apart than its rows by a factor, by pixels of an aspect ratio."""
    camera = Camera.build(focal=(900, 900 * aspect), center=(644, 476), size=(1280, 960), coefficients=[-0.1, 0.02])
    generator, views = torch.Generator().manual_seed(7), []
    points = (board.points - board.points.mean(0)) * torch.tensor([factor, 1.0, 1.0])
    for _ in range(12):
        u = 2.0 * torch.rand(6, generator=generator, dtype=torch.float64) - 1.0
        tilt = rotation_from_vector(torch.stack([0.6 * u[0], 0.6 * u[1], 0.0 * u[0]]))
        rotation = tilt @ rotation_from_vector(roll * u[2] * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
        pixels = camera.project(points @ rotation.T + torch.stack([0.08 * u[3], 0.05 * u[4], 0.45 + 0.1 * u[5]]))[0]
        noisy = pixels + 0.05 * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
        views.append(torch.where(camera.inside(noisy)[:, None], noisy, torch.nan))
    return observe(torch.stack(views), board=board, size=camera.size)


ASYMMETRIC = Board(columns=4, rows=11, square=0.02, pattern="asymmetric")
CHECKERBOARD = Board(columns=9, rows=6, square=0.025)


class TestSpacing:
    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("factor", "board"), [(1.25, ASYMMETRIC), (0.7, CHECKERBOARD), (0.95, CHECKERBOARD), (1.3, CHECKERBOARD)]
    )
    def test_columns_that_are_not_as_far_apart_as_rows(self, factor: float, board: Board) -> None:
        """They are measured and said first, and the camera is right all the same."""
        found = calibrate_camera(unequal(factor, board))
        first, *others = found.warnings
        rows = 1e3 * board.square
        assert first.startswith(f"columns of the board are {rows * factor:.4g} mm apart, and its rows {rows:g} mm")
        assert not any(part in text for text in others for part in ("square", "moved", "one camera", "repeat"))
        assert found.rms < 0.08
        assert found.camera.focal[0] == pytest.approx(900.0, abs=5.0 * (found.sigma["fx"] or 0.0))

    @pytest.mark.slow
    @pytest.mark.parametrize("options", [CalibrationOptions(model="opencv5"), CalibrationOptions(board="exact")])
    def test_a_lens_that_cannot_allow_for_it_is_refused(self, options: CalibrationOptions) -> None:
        with pytest.raises(InputError, match="columns of the board are 30 mm apart, and its rows 25 mm"):
            calibrate_camera(unequal(1.2, CHECKERBOARD), options)
        assert calibrate_camera(unequal(1.0, CHECKERBOARD), options).warnings == ()

    @pytest.mark.parametrize(("roll", "aspect"), [(math.pi, 1.0), (0.1, 1.0), (math.pi, 1.25)])
    def test_a_board_as_ordered_is_not_blamed(self, roll: float, aspect: float) -> None:
        said = calibrate_camera(unequal(1.0, CHECKERBOARD, roll, aspect)).warnings
        assert not any("apart" in text for text in said)
        assert any("pixels are not square" in text for text in said) == (aspect != 1.0)

    @pytest.mark.slow
    def test_upright_views_hardly_tell_the_board_from_the_pixels(self) -> None:
        (upright,) = (t for t in calibrate_camera(unequal(1.2, CHECKERBOARD, 0.1)).warnings if "apart" in t)
        (turned,) = (t for t in calibrate_camera(unequal(1.2, CHECKERBOARD)).warnings if "apart" in t)
        assert "or else pixels are not square" in upright
        assert "or else" not in turned

    def test_real_circles(self, kcal_data: Path) -> None:
        rows = [line.split(",") for line in (kcal_data / "field/asym/rolled.csv").read_text().splitlines()[1:]]
        views: dict[str, list[tuple[float, float]]] = {}
        for name, u, v in rows:
            views.setdefault(name, []).append((float(u), float(v)))
        seen = [View(name=name, pixels=corners) for name, corners in views.items()]
        found = calibrate_camera(Observations(board=ASYMMETRIC, image_size=(1280, 800), views=tuple(seen)))
        assert float(paraxial_focal(found.camera).value[0]) == pytest.approx(954.0, abs=2.0)
        assert found.warnings[0].startswith("columns of the board are 25 mm apart, and its rows 20 mm")


def test_a_fit_that_did_not_reach_its_solution_is_refused() -> None:
    """Its RMS is far above the noise that its error bars are made of; with tempering these are wider than the noise."""
    fit = fitted(12, None)
    for end in (fit, dataclasses.replace(fit, sigma=3.0 * fit.sigma, tempering=9.0)):
        check_end(end)
        with pytest.raises(InputError, match=r"ended before it reached its solution: RMS 79\.6 px"):
            check_end(dataclasses.replace(end, weighted_rms=79.6))


def test_a_sentence_about_pixels_needs_its_evidence() -> None:
    """That of the finished fit: 2.6 standard deviations are none."""
    fit = calibrate_camera(unequal(1.0, CHECKERBOARD, aspect=1.01)).hybrid
    assert not fit.square
    aspect, sigma = measured_aspect(fit)
    assert aspect == pytest.approx(1.01, abs=5.0 * sigma)
    assert "f_y / f_x = 1.01" in sentences(pixel_findings(fit))[0]
    assert pixel_findings(dataclasses.replace(fit, half=(aspect - 1.0) / sigma / 2.6 * fit.half)) == []
