"""Corners of a board that are off their places one by one: found where they are, and only there; carried on."""

import functools
import math
from pathlib import Path

import pytest
import torch
from calibrate_scenes import observe
from hybrid_views import views_of
from printed_boards import printed_points, printed_views
from torch import Tensor

from kcal import Board, Boards, Camera, InputError, Observations, calibrate_camera, load_camera
from kcal.calibrate.hybrid.board_modes import board_modes, turned_corners, turned_deviation
from kcal.calibrate.hybrid.cameras_fit import CamerasFit, fit_cameras
from kcal.calibrate.hybrid.fit import FitOptions, HybridFit, fit_hybrid
from kcal.calibrate.hybrid.measured_board import MeasuredBoard, load_measured_board, off_by, save_measured_board
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.rig.solve import without_repeated
from kcal.lens.zernike import ZernikeModes
from kcal.solve.lm import LMOptions
from kcal.solve.schur import Products

BOARD, SIZE, NOISE, OFF = Board(columns=8, rows=6, square=0.03), (1280, 960), 0.05, 1e-4
MODES = ZernikeModes(radial=7, decentered=4, astigmatic=3, other=3)
PLANTED = OFF * torch.randn(BOARD.corners, 2, generator=torch.Generator().manual_seed(5), dtype=torch.float64)


def camera(seed: int) -> Camera:
    return Camera.build(
        focal=(800 + 7 * seed,) * 2, center=(640 + 5 * seed, 480 - 4 * seed), size=SIZE,
        coefficients=[-0.12, 0.03, 4e-4, -3e-4, 0.0], model="opencv5",
    )  # fmt: skip


def seen(seed: int, off: Tensor | None, views: int = 12) -> Observations:
    pixels = printed_views(camera(seed), BOARD, off_by(BOARD.points, off), views, seed, noise=NOISE, pupil=2e-3)
    return observe(pixels, board=BOARD, size=SIZE)


@functools.cache
def fit(planted: bool, corners: bool = True) -> HybridFit:
    options = FitOptions(modes=MODES, corners=corners, motion=False, bending=False)
    return fit_hybrid(BOARD.points, seen(1, PLANTED if planted else None).pixels(), SIZE, options=options)


def beside(off: Tensor) -> Tensor:
    """(2 N,) what the modes, a shift, a turn and a scale leave of displacements (N, 2)."""
    x, y = (BOARD.points[:, :2] - BOARD.points[:, :2].mean(0)).unbind(-1)
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    modes = [shape[:2] for shape in board_modes(BOARD.points).shapes if bool(shape[:2].any())]
    modes += [torch.stack(mode) for mode in ((one, zero), (zero, one), (-y, x), (x, y))]
    basis, _ = torch.linalg.qr(torch.stack(modes).flatten(1).T)
    flat = off.T.flatten()
    return flat - basis @ (basis.T @ flat)


def agreement(one: Tensor | None, other: Tensor) -> float:
    assert one is not None
    return float(torch.corrcoef(torch.stack([beside(one), beside(other)]))[0, 1])


def problem(pixels: Tensor, found: HybridFit, precision: float = 0.0) -> tuple[BoardProblem, BoardState]:
    """With unknown displacements, and where they were found."""
    off = torch.zeros_like(PLANTED) if found.displaced is None else found.displaced
    board = torch.cat([found.state.board, off.T.flatten()])
    count = len(found.half) + off.numel()
    weight = torch.full((count,), precision, dtype=torch.float64)
    made = views_of(BOARD.points, found.board_shapes.with_corners(), pixels).problem_under(
        found.model, 0.0 * weight, weight
    )
    return made, found.state._replace(board=board, motion=found.state.motion[:, :0])


@pytest.mark.parametrize("shown", [1.0, 0.3], ids=["all corners", "few corners"])
def test_products_are_those_of_the_rows(shown: float) -> None:
    """Although no row by a displacement is written; and rows are derivatives of the residuals."""
    pixels = seen(1, PLANTED).pixels()
    hidden = torch.rand(pixels.shape[:-1], generator=torch.Generator().manual_seed(2)) > shown
    pixels[hidden] = torch.nan
    made, state = problem(pixels, fit(True))
    rows = made.corner_rows(state)
    for ours, theirs in zip(made.products(state), Products.of_rows(rows, made.local_size), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)
    corner, step = int((~hidden).sum(0).argmax()), 1e-5
    for axis in (0, 1):
        at = len(state.board) - 2 * BOARD.corners + axis * BOARD.corners + corner
        board = [state.board.clone(), state.board.clone()]
        board[0][at] += step
        board[1][at] -= step
        high, low = (made.residuals(state._replace(board=one)) for one in board)
        own = rows[:, made.local_size + made.unknown_count - len(state.board) + at]
        torch.testing.assert_close((high - low) / (2.0 * step), own, rtol=1e-6, atol=1e-4)
    reduced, off = made.reduced_rows(state), made.off_poses(state).transpose(0, 1).flatten(1)
    torch.testing.assert_close(reduced.T @ reduced, off @ off.T, rtol=1e-7, atol=1e-3)


def test_found_where_they_are_and_only_there() -> None:
    assert fit(False).displaced is None
    assert agreement(fit(True).displaced, PLANTED) > 0.9
    assert fit(True).sigma == pytest.approx(NOISE, rel=0.1)
    smooth = fit(True, corners=False)
    assert smooth.displaced is None
    assert smooth.sigma > 1.5 * NOISE
    assert fit(True).log_evidence > smooth.log_evidence + 100.0


def test_a_fit_that_begins_with_another_keeps_them() -> None:
    """It would find them again after rounds without them."""
    rounds = list[str]()
    options = FitOptions(modes=MODES, motion=False, likely=True)
    again = fit_hybrid(
        BOARD.points, seen(1, PLANTED).pixels(), SIZE, options=options, start=fit(True), progress=rounds.append
    )
    assert len(rounds) <= 2
    assert agreement(again.displaced, PLANTED) == pytest.approx(agreement(fit(True).displaced, PLANTED), abs=2e-3)
    assert again.expected.tolist() == again.hyperparameters.tolist()


def test_an_exact_board_has_none() -> None:
    options = FitOptions(modes=MODES, board="exact", motion=False)
    assert fit_hybrid(BOARD.points, seen(1, PLANTED).pixels(), SIZE, options=options).displaced is None


def test_error_bars_know_them_no_better_than_they_are_known() -> None:
    """The covariance of lens and modes is that of the dense posterior of all unknowns, displacements among them."""
    found = fit(True)
    made, state = problem(seen(1, PLANTED).pixels(), found)
    assert found.readout is None
    spread = float(found.board_shapes.unit.max()) * math.exp(float(found.expected[-1]))
    deviation = torch.cat([found.families.deviation(found.expected), torch.full((2 * BOARD.corners,), spread).double()])
    deviation[: len(found.half)][found.half.square().sum(0) == 0] = 1e-12  # modes that no pixel feels
    K = made.products(state).off(made.pose).total[:-1, :-1] * deviation * deviation[:, None] / found.sigma**2
    whole = torch.linalg.inv(K + torch.eye(len(K)).double()) * deviation * deviation[:, None]
    ours, theirs = (found.half.T @ found.half).diagonal(), whole.diagonal()[: len(found.half)]
    felt = ours > 0
    torch.testing.assert_close(ours[felt], theirs[felt], rtol=1e-3, atol=0)
    known = torch.linalg.inv(K[: len(ours), : len(ours)] + torch.eye(len(ours)).double()).diagonal()
    # Were displacements known, error bars would be smaller.
    assert float((theirs / known / deviation[: len(ours)].square())[felt].max()) > 1.1


def test_turned_boards() -> None:
    board = Board(columns=6, rows=6, square=0.02)
    off = torch.randn(36, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    moved = board.points[:, :2] + off - board.points[:, :2].mean(0)
    for turn in range(4):
        there = turned_corners(moved[None], board, torch.tensor([turn]))[0]
        quarter = torch.linalg.matrix_power(torch.tensor([[0.0, 1.0], [-1.0, 0.0]]).double(), turn)
        ours = board.points[:, :2] - board.points[:, :2].mean(0) + turned_deviation(off, board, turn)
        torch.testing.assert_close(ours, there @ quarter.T)


@functools.cache
def shared() -> CamerasFit:
    points = printed_points(BOARD, 3)
    pixels = [printed_views(camera(k), BOARD, off_by(points, PLANTED), 8, k, noise=NOISE, pupil=2e-3) for k in (1, 2)]
    # The second camera's were all read from the other end.
    pixels[1] = turned_corners(pixels[1], BOARD, torch.full((8,), 2))
    return fit_cameras([observe(one, board=BOARD, size=SIZE) for one in pixels], FitOptions(modes=MODES))


@pytest.mark.slow
def test_cameras_tell_each_other_of_them(tmp_path: Path) -> None:
    """Also where one of them read its views from another end; a board file keeps them."""
    found = shared()
    assert [camera.board for camera in found.cameras] == [0, 0]
    (board,) = found.boards
    assert board.corners is not None
    order = int(found.cameras[0].turns[0])
    assert agreement(board.corners, turned_deviation(PLANTED, BOARD, order)) > 0.9
    for camera in found.cameras:
        assert agreement(camera.fit.displaced, turned_deviation(PLANTED, BOARD, order)) > 0.9
    read = load_measured_board(save_measured_board(board, tmp_path / "plate.board.json"))
    assert read.corners is not None
    assert torch.equal(read.corners, board.corners)
    assert torch.equal(read.points, board.points)
    torch.testing.assert_close(board.displacements(), off_by(board.displacements(BOARD.points), board.corners))


@pytest.mark.slow
def test_a_measured_board_brings_them() -> None:
    """A camera with five views of it, too few to find much of them, has them all."""
    (board,) = shared().boards
    new = printed_views(camera(3), BOARD, off_by(printed_points(BOARD, 3), PLANTED), 5, 9, noise=NOISE, pupil=2e-3)
    own = fit_cameras([observe(new, board=BOARD, size=SIZE)], FitOptions(modes=MODES, board=board)).cameras[0].fit
    assert board.corners is not None
    assert agreement(own.displaced, board.corners) > 0.9
    assert own.sigma < 1.2 * NOISE


@pytest.mark.slow
def test_a_rig_does_not_count_views_twice(tmp_path: Path) -> None:
    """Its boards are read as the calibration has them: with single corners, or residuals would not be the same."""
    found = calibrate_camera(seen(1, PLANTED))
    assert found.measured_board is not None
    assert found.measured_board.corner_error == pytest.approx(OFF * math.sqrt(2.0), rel=0.3)
    views = found.observations
    boards = Boards(board=BOARD, pixels=views.pixels()[:, None], names=views.names, views=(views.names,))
    left = without_repeated(
        found.information, load_camera(found.save(tmp_path / "a.camera.json")), boards, [0], LMOptions()
    )
    assert len(left.rows) == 0


def test_bad_input() -> None:
    with pytest.raises(InputError, match="displacements of 48 corners"):
        MeasuredBoard(
            name="", board=BOARD, amplitudes=torch.zeros(28).double(), half=torch.eye(28).double(), log_evidence=0.0,
            corners=torch.zeros(47, 2).double(),
        )  # fmt: skip
