"""What a fit is used for: its residuals and parts, starts of many views and of known lenses, robust weights, boards."""

from __future__ import annotations

import dataclasses
import functools
import math
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import pytest
import torch
from printed_boards import shown
from torch import Tensor

from kcal import Board, CalibrationOptions, Camera
from kcal.calibrate.hybrid import fit as room
from kcal.calibrate.hybrid.base_fit import fit_projection
from kcal.calibrate.hybrid.board_modes import board_modes, turned
from kcal.calibrate.hybrid.cameras_fit import (
    CameraFit,
    _begun_fleet,
    _learned_fleet,
    compared,
    fleet_priors,
    typical_lens,
)
from kcal.calibrate.hybrid.evidence import WORTH
from kcal.calibrate.hybrid.families import LensPrior, prior_families, typical_hyperprior
from kcal.calibrate.hybrid.fit import FitOptions, HybridFit, fit_hybrid
from kcal.calibrate.hybrid.fitted_views import _cauchy_weights, moving_residuals
from kcal.calibrate.hybrid.measured_board import MeasuredBoard, evidence, printed_board
from kcal.calibrate.problem.state import HAND, HAND_SPREAD, Readout
from kcal.gaussian import Gaussian, numbered
from kcal.lens.information import BOARD_SLOT
from kcal.lens.model import HybridForm
from kcal.lens.zernike import ZernikeModes
from scripts.shared.simulated import against_truth, simulated

BOARD = Board(columns=8, rows=6, square=0.03)
SIZE = (1280, 960)
MODES = ZernikeModes(radial=5, decentered=3, astigmatic=2, other=2)
TRUTH = Camera.build(
    focal=(800, 800), center=(644, 476), size=SIZE, coefficients=[-0.12, 0.03, 4e-4, -3e-4, 0.0], model="opencv5"
)


def places(count: int, seed: int = 11) -> Tensor:
    """(V, N, 3) corners in the camera's frame, all in the image."""
    generator, found = torch.Generator().manual_seed(seed), list[Tensor]()
    while len(found) < count:
        cam = shown(BOARD, BOARD.points, generator)
        pixels, valid = TRUTH.project(cam)
        if bool((valid & TRUTH.inside(pixels)).all()):
            found.append(cam)
    return torch.stack(found)


def shots(count: int = 9, noise: float = 0.1) -> Tensor:
    pixels = TRUTH.project(places(count))[0]
    return pixels + noise * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)


@functools.cache
def fitted() -> HybridFit:
    return fit_hybrid(BOARD.points, shots(), SIZE, options=FitOptions(modes=MODES, board="exact", motion=False))


class TestFits:
    def test_residuals_of_other_corners(self) -> None:
        """Projected minus observed; those of the fit for its own corners, and moved by as much as other ones are."""
        fit = fitted()
        torch.testing.assert_close(fit.residuals_of(shots()), fit.residuals)
        torch.testing.assert_close(fit.residuals_of(shots() + 2.0), fit.residuals - 2.0)
        assert fit.rms == pytest.approx(float(fit.residuals.square().sum(-1).mean().sqrt()))
        assert fit.motion_sigma is None
        behind = dataclasses.replace(fit, state=fit.state._replace(translation=-fit.state.translation))
        assert bool(torch.isinf(behind.residuals_of(shots())).any())

    def test_some_of_its_views(self) -> None:
        fit = fitted()
        some = fit.only([4, 1])
        torch.testing.assert_close(some.residuals, fit.residuals[[4, 1]])
        torch.testing.assert_close(some.state.rotation, fit.state.rotation[[4, 1]])
        torch.testing.assert_close(some.state.translation, fit.state.translation[[4, 1]])
        again = some.among([2, 0], 4)
        torch.testing.assert_close(again.residuals[[2, 0]], some.residuals)
        torch.testing.assert_close(again.state.translation[[2, 0]], some.state.translation)
        assert bool(again.residuals[[1, 3]].isnan().all() & again.state.rotation[[1, 3]].isnan().all())

    def test_covariance_of_its_parameters(self) -> None:
        """Both focal lengths alike, no skew, and the rest in the order of the unknowns."""
        fit = fitted()
        own = fit.half.T @ fit.half
        covariance = fit.covariance
        count = len(fit.state.parameters)
        assert covariance.shape == (count, count)
        assert (
            float(covariance[0, 0])
            == float(covariance[1, 1])
            == float(covariance[0, 1])
            == pytest.approx(float(own[0, 0]))
        )
        assert not bool(covariance[4].any())
        torch.testing.assert_close(covariance[2:4, 2:4], own[1:3, 1:3])
        torch.testing.assert_close(covariance[5:, 5:], own[3 : count - 2, 3 : count - 2])

    def test_a_wrong_corner_changes_little_where_that_is_asked_for(self) -> None:
        wrong = shots()
        wrong[3, 7] += 40.0
        robust = fit_hybrid(
            BOARD.points, wrong, SIZE, options=FitOptions(modes=MODES, board="exact", motion=False, robust=True)
        )
        plain = fit_hybrid(BOARD.points, wrong, SIZE, options=FitOptions(modes=MODES, board="exact", motion=False))
        good = fitted().state.parameters
        assert float(robust.residuals[3, 7].norm()) == pytest.approx(math.hypot(40.0, 40.0), rel=0.05)
        off = [float((fit.state.parameters - good)[[0, 2, 3]].norm()) for fit in (robust, plain)]
        assert off[0] < 0.15 * off[1]

    def test_weights_of_a_cauchy_loss(self) -> None:
        """Its scale is three robust standard deviations; none for what has no image or was not seen."""
        errors = torch.zeros(1, 2, 7).double()
        errors[0, 0] = torch.tensor([0.118, 0.118, 0.118, 0.118, 0.9, math.nan, 0.0])
        errors[0, 1, 6] = 0.118
        seen = torch.tensor([[True, True, True, True, True, True, False]])
        problem = cast(Any, SimpleNamespace(pixel_errors=lambda state: errors, seen=seen))
        weights = torch.ones(1, 7).double()
        weights[0, 1] = 2.0
        found = _cauchy_weights(problem, cast(Any, None), weights)[0].tolist()

        def by_hand(length: float) -> float:
            return (1.0 + (length / 0.3) ** 2) ** -0.5

        wanted = [by_hand(0.118), 2.0 * by_hand(0.236), by_hand(0.118), by_hand(0.118), by_hand(0.9), 0.0, 0.0]
        assert found == pytest.approx(wanted)


class TestStarts:
    @pytest.mark.parametrize("ratio", [1.0, 1.03])
    def test_many_views(self, ratio: float) -> None:
        """Of 61 views every second one tells the projection, and all get poses."""
        there = places(61)
        truth = Camera.build(focal=(800, 800 * ratio), center=(644, 476), size=SIZE, model="pinhole")
        base = fit_projection(BOARD.points, truth.project(there)[0], SIZE, torch.ones(61, 48), square=ratio == 1.0)
        assert base.focal == pytest.approx(800.0, rel=1e-4)
        assert (base.aspect is None) if ratio == 1.0 else (base.aspect == pytest.approx(ratio, rel=1e-4))
        cam = BOARD.points @ base.state.rotation.mT + base.state.translation[:, None]
        torch.testing.assert_close(cam, there, rtol=0, atol=2e-4)
        assert base.distance == pytest.approx(float(base.state.translation.norm(dim=-1).median()))

    def test_a_focal_length_that_is_told(self) -> None:
        """A rough one is corrected, also where it is wrong; an exact one is taken."""
        pixels = TRUTH.project(places(8))[0]
        ones = torch.ones(8, 48)
        free = fit_projection(BOARD.points, pixels, SIZE, ones).focal
        for told in (700.0, 3000.0):
            assert fit_projection(BOARD.points, pixels, SIZE, ones, known_focal=told).focal == pytest.approx(
                free, rel=1e-2
            )
        assert fit_projection(BOARD.points, pixels, SIZE, ones, known_focal=700.0, exact_focal=True).focal == 700.0

    def test_a_lens_of_a_known_type(self) -> None:
        """Its form and modes are those of the type, and it is found as without."""
        fit = fitted()
        form = fit.model.hybrid
        assert form is not None
        lens = LensPrior(form, float(fit.families.mean[0]), typical_lens(form, fit.families, fit.expected, True))
        again = fit_hybrid(BOARD.points, shots(), SIZE, options=FitOptions(board="exact", motion=False, lens=lens))
        assert again.model.hybrid == form
        sigma = fit.half.square().sum(0).sqrt()[:3]
        off = (again.state.parameters - fit.state.parameters)[[0, 2, 3]] / sigma
        assert float(off.abs().max()) < 0.5
        assert again.sigma == pytest.approx(fit.sigma, rel=0.05)


class TestTypes:
    def camera(self, focal: float, *, square: bool = True) -> CameraFit:
        form = HybridForm(shape=focal / 1e4, radius=0.7, modes=MODES)
        families = prior_families(form, focal + 1.0, board_modes(BOARD.points), SIZE, 0.6, None if square else 1.1)
        state = SimpleNamespace(parameters=torch.tensor([focal, focal, 0.0, 0.0]))
        camera = SimpleNamespace(model=SimpleNamespace(hybrid=form))
        typical = typical_hyperprior().mean
        blind = Gaussian(numbered("amplitude", len(typical)), typical, torch.zeros(0, len(typical) + 1).double())
        return cast(CameraFit, SimpleNamespace(
            fit=SimpleNamespace(square=square, state=state, camera=camera, families=families), hyper=blind, lens=None
        ))  # fmt: skip

    def test_a_type_begins_with_the_camera_of_middle_focal_length(self) -> None:
        """Of those whose pixels are not square, if there are any."""
        plain = [self.camera(focal) for focal in (800.0, 700.0, 900.0, 650.0)]
        lens = _begun_fleet(plain)
        assert (lens.form.shape, lens.focal, lens.square) == (0.08, 801.0, True)
        wanted = typical_lens(lens.form, plain[0].fit.families, typical_hyperprior().mean, True)
        torch.testing.assert_close(lens.unknowns.sd, wanted.sd)
        other = _begun_fleet([*plain, self.camera(600.0, square=False)])
        assert (other.form.shape, other.focal, other.square) == (0.06, 601.0, False)

    def test_what_cameras_tell_of_each_other(self) -> None:
        lens = _begun_fleet([self.camera(800.0)])
        slots = numbered("lens", len(lens.unknowns.mean))
        told = [Gaussian.independent(slots, lens.unknowns.mean + 0.1 * k * lens.unknowns.sd, 0.1 * lens.unknowns.sd)
                for k in range(5)]  # fmt: skip
        cameras = [cast(CameraFit, SimpleNamespace(lens=one)) for one in told]
        following, each = _learned_fleet(cameras, lens)
        whole, others = fleet_priors(told, lens.unknowns)
        torch.testing.assert_close(following.unknowns.mean, whole.mean)
        assert (following.form, following.focal) == (lens.form, lens.focal)
        for one, wanted in zip(each, others, strict=True):
            torch.testing.assert_close(one.unknowns.sd, wanted.sd)
            assert one.form == lens.form


class TestBoards:
    def test_a_measured_board_as_a_prior(self) -> None:
        half = 1e-5 * torch.randn(28, 28, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
        amplitudes = 3e-5 * torch.randn(28, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        board = MeasuredBoard(name="plate", board=BOARD, amplitudes=amplitudes, half=half, log_evidence=5.0)
        mean, root = board.prior_for(BOARD.points).whole.mean_and_half()
        torch.testing.assert_close(mean, amplitudes)
        torch.testing.assert_close(root.T @ root, half.T @ half, rtol=1e-5, atol=1e-16)

    @pytest.mark.parametrize("turn", [0, 2])
    def test_a_camera_against_a_measured_board(self, turn: int) -> None:
        """By the evidence of both against that of some printed board; read from another end, all views are turned."""
        amplitudes = 1e-4 * torch.randn(28, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        slots = numbered(BOARD_SLOT, 28)
        known = Gaussian.independent(slots, amplitudes, torch.full((28,), 1e-6).double())
        message = Gaussian.independent(slots, amplitudes + 1e-6, torch.full((28,), 2e-6).double())
        fit = SimpleNamespace(board_shapes=board_modes(BOARD.points))

        @dataclasses.dataclass
        class Camera:
            message: Gaussian
            turns: Tensor
            fit: Any
            board: int = -1
            nats: float = math.nan

        begin = torch.tensor([0, 2, 2])
        found = compared(cast(Any, Camera(turned(message, turn) if turn else message, begin, fit)), known, BOARD)
        assert torch.equal(found.turns, (begin + turn) % 4)
        assert found.board == 0
        wanted = evidence(known, [message]) - printed_board(fit.board_shapes, [message])[1]
        assert found.nats == pytest.approx(wanted, rel=1e-6)
        assert wanted > 10.0


def test_pixels_that_amplitudes_to_be_expected_leave_square(monkeypatch: pytest.MonkeyPatch) -> None:
    """The likeliest amplitudes may state the ratio too surely; then those to be expected decide."""

    @dataclasses.dataclass
    class Rounds:
        estimate: str

        def _replace(self, estimate: str) -> Rounds:
            return Rounds(estimate)

    scores = {"likely": 5.0, "expected": 2.5}

    def expected(rounds: Rounds) -> str:
        assert rounds.estimate == "likely"
        return "expected"

    monkeypatch.setattr(room, "expected_estimate", expected)
    monkeypatch.setattr(room, "_standing", lambda rounds: scores[rounds.estimate])
    begin = cast(Any, Rounds("likely"))
    assert room.aspect_score(begin) == 2.5
    scores["expected"] = -4.0
    assert room.aspect_score(begin) == -4.0
    scores["likely"] = -3.0
    assert room.aspect_score(begin) == -3.0


def test_motion_is_looked_for_again_where_the_aspect_may_have_hidden_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The aspect hides no more motion than it was worth: half the square of its standard deviations, in nats."""
    asked = Mock(return_value=False)
    monkeypatch.setattr(room, "motion_is_worth", asked)
    for score in (0.0, 3.5):

        def of_pixels(rounds: Any, *_: object, score: float = score) -> float:
            assert rounds.gained < WORTH
            return score

        monkeypatch.setattr(room, "aspect_score", of_pixels)
        fit_hybrid(BOARD.points, shots(8), SIZE, options=FitOptions(modes=MODES))
        assert asked.call_count == (score == 3.5)


@pytest.mark.parametrize(("views", "kept"), [(5, True), (6, False)])
def test_few_views_do_not_tell_that_they_stood_still(views: int, kept: bool) -> None:
    """They keep the motion of a hand, which six views that stood still lose, and error bars for what is open of it."""
    fit = fit_hybrid(BOARD.points, shots(views), SIZE, options=FitOptions(modes=MODES, board="exact", square=True))
    assert (fit.motion_sigma is not None, fit.wider > 1.01) == (kept, kept)
    if fit.motion_sigma is not None:
        assert abs(math.log(fit.motion_sigma.turn / HAND[0])) < 3.0 * HAND_SPREAD


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 6, 27])
def test_three_views_by_hand(seed: int) -> None:
    """Lens and board explain most of their motion: a fit that begins without it ends far off, its bars too small."""
    found = against_truth(simulated(seed, 3, 0.08, by_hand=True), CalibrationOptions())
    assert found["everywhere"] > 0.95
    assert found["rms"] < 12.0


def test_motions_of_views_that_were_held_out() -> None:
    """A view that moved as its rows were read is explained by its motion where motions are likely; else it is not."""
    there = places(3)
    flat = BOARD.points - BOARD.points.mean(0)
    sides = torch.stack([torch.linalg.lstsq(flat[:, :2], cam - cam.mean(0)).solution.T for cam in there])
    rotation = torch.cat([sides, torch.linalg.cross(sides[..., 0], sides[..., 1])[..., None]], -1)
    translation = there.mean(1) - rotation @ BOARD.points.mean(0)
    readout = Readout(center=BOARD.points.mean(0), distance=0.5, size=SIZE)
    late = readout.time(TRUTH.project(there)[0])[..., None]
    moved = TRUTH.project(there + 1e-3 * late * torch.tensor([1.0, 0.0, 0.0]))[0]
    # Of the second view there is no pose.
    rotation[1], translation[1] = torch.nan, torch.nan
    found = [
        moving_residuals(TRUTH, BOARD.points, moved, rotation, translation, readout, torch.full((12,), weight).double())
        for weight in (1e-6, 1e9)
    ]
    assert all(bool(one[1].isnan().all()) for one in found)
    explained, left = (float(one[[0, 2]].square().mean().sqrt()) for one in found)
    assert explained < 0.02 * left
    assert left > 0.05
    unposed = rotation * torch.nan, translation * torch.nan
    nothing = moving_residuals(TRUTH, BOARD.points, moved, *unposed, readout, torch.ones(12).double())
    assert bool(nothing.isnan().all())
