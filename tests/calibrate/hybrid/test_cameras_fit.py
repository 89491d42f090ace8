"""Several cameras and one board: shared where it is one, turned where it was read from another end."""

import functools
import math

import pytest
import torch
from calibrate_scenes import observe
from printed_boards import middle_error, printed_points, printed_views, shape_error
from torch import Tensor

from kcal import Board, Camera, InputError, Observations
from kcal.calibrate.hybrid.board_modes import turned_corners
from kcal.calibrate.hybrid.cameras_fit import CamerasFit, fit_cameras, measure_board
from kcal.calibrate.hybrid.fit import FitOptions, HybridFit, fit_hybrid
from kcal.calibrate.hybrid.measured_board import MeasuredBoard
from kcal.lens.zernike import ZernikeModes

BOARD = Board(columns=8, rows=6, square=0.03)
SIZE = (1280, 960)
NOISE = 0.1
# Enough for these lenses, and fast.
MODES = ZernikeModes(radial=7, decentered=4, astigmatic=3, other=3)


def camera(seed: int) -> Camera:
    u = torch.randn(4, generator=torch.Generator().manual_seed(seed)).tolist()
    return Camera.build(
        focal=(800 + 10 * u[0],) * 2,
        center=(640 + 8 * u[1], 480 + 8 * u[2]),
        size=SIZE,
        coefficients=[-0.12 + 0.01 * u[3], 0.03, 4e-4, -3e-4, 0.0],
        model="opencv5",
    )


def seen_by(truth: Camera, points: Tensor, count: int, seed: int, turns: Tensor | None = None) -> Observations:
    pixels = printed_views(truth, BOARD, points, count, seed, noise=NOISE, pupil=2e-3)
    return observe(pixels if turns is None else turned_corners(pixels, BOARD, turns), board=BOARD, size=SIZE)


def deviations(fit: HybridFit) -> Tensor:
    return fit.half[:, -28:].square().sum(0).sqrt()


PRINT = printed_points(BOARD, 3)


@functools.cache
def shared(passes: int) -> CamerasFit:
    sets = [seen_by(camera(1), PRINT, 9, 11), seen_by(camera(2), PRINT, 9, 12)]
    return fit_cameras(sets, FitOptions(modes=MODES), names=["left", "right"], passes=passes)


@pytest.mark.slow
def test_a_shared_board_is_better_known() -> None:
    """Two cameras measure their board better than one, and their boards are the same."""
    found = shared(1)
    assert [c.board for c in found.cameras] == [0, 0]
    # The lab: 38 to 57 nats for the same print.
    assert all(c.nats > 30.0 for c in found.cameras)
    (board,) = found.boards
    assert board.observations == ("left", "right")
    assert board.log_evidence > 500.0
    alone = [
        fit_cameras([seen_by(camera(k), PRINT, 9, 10 + k)], FitOptions(modes=MODES)).cameras[0].fit for k in (1, 2)
    ]
    errors = [shape_error(fit.board_points, PRINT) for fit in alone]
    assert shape_error(board.points, PRINT) < 0.8 * math.sqrt(0.5 * sum(e * e for e in errors))
    for one, both in zip(alone, found.cameras, strict=True):
        assert float((deviations(both.fit) / deviations(one)).mean()) < 0.8
        assert float(((both.fit.state.board - board.amplitudes) / deviations(both.fit)).abs().max()) < 0.4


@pytest.mark.slow
def test_a_second_pass_changes_little() -> None:
    one, two = shared(1), shared(2)
    moved = (one.boards[0].amplitudes - two.boards[0].amplitudes).abs()
    assert float((moved / one.boards[0].half.square().sum(0).sqrt()).max()) < 0.1
    for before, after in zip(one.cameras, two.cameras, strict=True):
        moved = before.fit.camera.params[[0, 2, 3]] - after.fit.camera.params[[0, 2, 3]]
        assert float((moved / before.fit.half[:, :3].square().sum(0).sqrt()).abs().max()) < 0.15


def test_two_prints_are_two_boards() -> None:
    sets = [seen_by(camera(1), PRINT, 9, 11), seen_by(camera(2), printed_points(BOARD, 4), 9, 12)]
    found = fit_cameras(sets, FitOptions(modes=MODES))
    assert [c.board for c in found.cameras] == [0, 1]
    assert [board.observations for board in found.boards] == [("1",), ("2",)]
    # The lab: 1,650 nats and more.
    assert all(c.nats < -500.0 for c in found.cameras)


@pytest.mark.slow
def test_turned_views_are_found_within_and_between_cameras() -> None:
    """The left camera read 4 of 9 views from the other end, the right one all but one."""
    left, right = (torch.tensor([2, 0, 2, 0, 2, 0, 0, 2, 0]), torch.tensor([2, 2, 2, 2, 0, 2, 2, 2, 2]))
    sets = [seen_by(camera(k), PRINT, 9, 10 + k, turns) for k, turns in ((1, left), (2, right))]
    found = fit_cameras(sets, FitOptions(modes=MODES))
    assert [c.board for c in found.cameras] == [0, 0]
    ends = [(turns + c.turns) % 4 for turns, c in zip((left, right), found.cameras, strict=True)]
    # All read from one end: which one cannot be known.
    assert len(set(torch.cat(ends).tolist())) == 1
    assert found.cameras[0].fit.sigma == pytest.approx(NOISE, rel=0.1)
    there = found.boards[0].points
    if int(ends[0][0]) == 2:
        there = turned_corners(there[None], BOARD, torch.tensor([2]))[0]
    assert shape_error(there, PRINT) < 3e-5


@pytest.mark.slow
def test_a_measured_board_helps_the_next_camera() -> None:
    """Five views with the board that two others measured, against five views alone and against a wrong board."""
    (board,) = shared(1).boards
    errors = []
    for seed in (21, 22, 23):
        seen = seen_by(camera(seed), PRINT, 5, seed)
        kinds: tuple[MeasuredBoard | str, ...] = (board, "printed")
        # Five views would be allowed the motion of a hand; these stood still.
        still = [FitOptions(modes=MODES, board=kind, motion=False) for kind in kinds]
        fits = [fit_hybrid(BOARD.points, seen.pixels(), SIZE, options=options) for options in still]
        errors.append([middle_error(fit.camera, camera(seed), 0.75) for fit in fits])
    known, alone = torch.tensor(errors).square().mean(0).sqrt().tolist()
    assert known < 0.7 * alone
    right = fit_cameras([seen], FitOptions(modes=MODES, board=board))
    assert right.boards == (board,)
    assert right.cameras[0].nats > 10.0
    wrong = seen_by(camera(23), printed_points(BOARD, 4), 5, 23)
    assert fit_cameras([wrong], FitOptions(modes=MODES, board=board)).cameras[0].nats < -100.0


@pytest.mark.slow
def test_sigma_of_the_board() -> None:
    """Over 20 cameras and prints, 95 % intervals of the amplitudes contain 95 %."""
    inside, chi2 = [], []
    for seed in range(20):
        points = printed_points(BOARD, seed)
        pixels = printed_views(camera(seed), BOARD, points, 13, seed, noise=NOISE, pupil=2e-3)
        fit = fit_hybrid(BOARD.points, pixels, SIZE, options=FitOptions(modes=MODES))
        shapes = fit.board_shapes.shapes.flatten(1).T
        error = fit.state.board - torch.linalg.lstsq(shapes, (points - BOARD.points).T.flatten()).solution
        inside.append((error.abs() < 1.96 * deviations(fit)).double().mean())
        half = fit.half[:, -28:]
        chi2.append(float(error @ torch.linalg.solve(half.T @ half, error)) / 28)
    # 560 intervals that are not all independent: .95 ± .012.
    assert 0.92 < float(torch.stack(inside).mean()) < 0.98
    assert 0.85 < sum(chi2) / 20 < 1.2


@pytest.mark.slow
def test_a_fleet_knows_its_lens() -> None:
    """Five views of a camera whose type is known from five others, against five views alone."""
    flat = BOARD.points
    sets = [seen_by(camera(seed), flat, 8, seed) for seed in range(5)]
    fleet = fit_cameras(sets, FitOptions(modes=MODES, board="exact"), one_type=True)
    assert fleet.boards == ()
    # Focal lengths scatter by 10 px; five cameras say that coarsely.
    assert 5.0 < float(fleet.lens.unknowns.sd[0]) < 25.0
    errors = []
    for seed in (31, 32, 33, 34):
        pixels = seen_by(camera(seed), flat, 5, seed).pixels()
        fits = [
            fit_hybrid(flat, pixels, SIZE, options=FitOptions(modes=MODES, board="exact", lens=lens))
            for lens in (fleet.lens, None)
        ]
        errors.append([middle_error(fit.camera, camera(seed), 0.75) for fit in fits])
    known, alone = torch.tensor(errors).square().mean(0).sqrt().tolist()
    assert known < 0.85 * alone


def test_bad_input() -> None:
    with pytest.raises(InputError, match="no observations"):
        measure_board([])
    known = {"amplitudes": torch.zeros(28).double(), "half": torch.eye(28).double(), "log_evidence": 0.0}
    other = MeasuredBoard(name="other", board=Board(columns=8, rows=6, square=0.031), **known)
    seen = seen_by(camera(1), PRINT, 5, 1)
    with pytest.raises(InputError, match="show another board"):
        fit_cameras([seen], FitOptions(board=other))
    with pytest.raises(InputError, match="one at least"):
        fit_cameras([seen], passes=0)
    with pytest.raises(InputError, match="one size"):
        fit_cameras([seen, seen.model_copy(update={"image_size": (1280, 961)})], one_type=True)
