"""Small parts of the fit, and boards that were measured."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from kcal import Board, InputError
from kcal.calibrate.hybrid.base_fit import Base, _through_base, _with_constants
from kcal.calibrate.hybrid.board_modes import BENDING, KNOWN, PRINT, STRETCH, TRAPEZOID, board_modes, undetermined_modes
from kcal.calibrate.hybrid.cameras_fit import _but_one, fleet_priors, typical_lens
from kcal.calibrate.hybrid.evidence import Amplitudes, Quadratic, overdispersion, posterior_root, view_data
from kcal.calibrate.hybrid.families import LensPrior, PriorFamilies, prior_families, typical_hyperprior
from kcal.calibrate.hybrid.fit import pixels_are_square, with_square_pixels
from kcal.calibrate.hybrid.fitted_views import Estimate
from kcal.calibrate.hybrid.measured_board import MeasuredBoard, load_measured_board, save_measured_board
from kcal.calibrate.problem.state import BoardState
from kcal.gaussian import Gaussian
from kcal.lens import LensModel
from kcal.lens.model import HybridForm
from kcal.lens.zernike import ZernikeModes
from kcal.solve.schur import Products

# Small parts of default lenses' fits: shares of the image, types of cameras, square pixels, quadratics, by hand.


BOARD = Board(columns=6, rows=5, square=0.1)

SIZE = (640, 480)

MODES = ZernikeModes()

FORM = HybridForm(shape=0.4, radius=0.7, modes=MODES)


def tensor(*values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


class TestFleets:
    def test_the_next_camera_of_a_type(self) -> None:
        """Of exactly known cameras: mean and spread of all, one more that is off by a tenth, Student's t of n."""
        values = tensor([0.1, 0.2], [0.3, -0.1], [-0.2, 0.4], [0.05, 0.1], [0.2, -0.3])
        typical = typical_hyperprior()._replace(mean=tensor(1.0, -7.0), sd=tensor(1.5, 2.0), most=None)
        told = [typical.mean + typical.sd * value for value in values]
        exact = torch.full((2,), 1e-7).double()
        found, others = fleet_priors([Gaussian.independent((0, 1), one, exact) for one in told], typical)

        def by_hand(some: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
            n = len(some)
            variance = (0.01 + (some - mean).square().sum(0)) / n
            wide = variance * (1 + 1 / n) * n / (n - 2)
            return typical.mean + typical.sd * some.sum(0) / (n + variance), typical.sd * wide.sqrt()

        # The mean of the whole type, towards what is typical by its spread.
        mean = values.mean(0)
        for _ in range(50):
            mean = values.sum(0) / (5 + (0.01 + (values - mean).square().sum(0)) / 5)
        wanted = by_hand(values, mean)
        torch.testing.assert_close(found.mean, wanted[0], rtol=1e-6, atol=1e-9)
        torch.testing.assert_close(found.sd, wanted[1], rtol=1e-6, atol=1e-9)
        for k in range(5):
            wanted = by_hand(torch.cat([values[:k], values[k + 1 :]]), mean)
            torch.testing.assert_close(others[k].mean, wanted[0], rtol=1e-6, atol=1e-9)
            torch.testing.assert_close(others[k].sd, wanted[1], rtol=1e-6, atol=1e-9)
        # Four tell a type, and each of them nothing of the others; three tell none.
        four, each = fleet_priors([Gaussian.independent((0, 1), one, exact) for one in told[:4]], typical)
        assert four is not typical
        assert all(one is not typical for one in each)
        three, each = fleet_priors([Gaussian.independent((0, 1), one, exact) for one in told[:3]], typical)
        assert all(one is typical for one in each)
        assert three is not typical
        assert fleet_priors([Gaussian.independent((0, 1), one, exact) for one in told[:2]], typical)[0] is typical

    @pytest.mark.parametrize("square", [True, False])
    def test_priors_of_a_known_lens(self, square: bool) -> None:
        """Its unknowns have no amplitudes; those of the board stay as they are."""
        usual = prior_families(FORM, 800.0, board_modes(BOARD.points), SIZE, 0.6, None if square else 1.02)
        h = typical_hyperprior(MODES).mean
        lens = typical_lens(FORM, usual, h, square)
        count = 6 + len(MODES) + (not square)
        assert len(lens.mean) == len(lens.sd) == count
        assert float(lens.sd[0]) == pytest.approx(0.05 * 800.0)
        torch.testing.assert_close(lens.sd[1 : count - (not square)], usual.deviation(h)[1 : count - (not square)])
        if not square:
            assert float(lens.mean[-1]) == pytest.approx(816.0)
            assert float(lens.sd[-1]) == pytest.approx(0.05 * 816.0)
        known = LensPrior(FORM, 800.0, lens)
        assert known.square is square
        families = known.families(usual)
        torch.testing.assert_close(families.deviation(h)[:count], lens.sd)
        torch.testing.assert_close(families.deviation(h + 0.3)[:count], lens.sd)
        torch.testing.assert_close(families.deviation(h + 0.3)[count:], usual.deviation(h + 0.3)[count:])
        torch.testing.assert_close(families.mean[:count], lens.mean)

    def test_units_of_priors(self) -> None:
        """Pixels of the focal length, a twentieth of the diagonal, meters of distance; a print's in its extent."""
        board = board_modes(BOARD.points)
        families = prior_families(FORM, 800.0, board, SIZE, 0.6)
        unit = families.log_unit.exp()
        corner = math.atan(400.0 / 800.0)
        assert unit[:6].tolist() == pytest.approx([160.0, 40.0, 40.0, 1.0 + 0.5 / corner**2, 0.6, 0.6])
        assert families.mean[:6].tolist() == pytest.approx([800.0, 319.5, 239.5, 0.5 - 0.4, 0.0, 0.0])
        assert not bool(families.mean[6:].any())
        torch.testing.assert_close(unit[-28:], board.unit)
        assert families.amplitude[:4].tolist() == [-1] * 4
        assert families.amplitude[-28:].tolist() == (int(families.amplitude[4]) + 1 + board.family).tolist()
        assert families.decay[-28:].tolist() == [-1] * 28
        # Of a measured board: as sure as it is.
        told = board._replace(unit=torch.full((28,), 0.3).double(), family=torch.full((28,), KNOWN))
        other = families.with_board(told, 28, len(typical_hyperprior(MODES).mean))
        torch.testing.assert_close(
            other.deviation(typical_hyperprior(MODES).mean)[-28:], torch.full((28,), 0.3).double()
        )
        torch.testing.assert_close(other.log_unit[:-28], families.log_unit[:-28])


class TestPixels:
    def test_what_cannot_be_told_from_square(self) -> None:
        """Within 3.75 standard deviations, on both sides; what is no number is not told."""
        for sign in (1.0, -1.0):
            assert pixels_are_square(sign * 3.74)
            assert not pixels_are_square(sign * 3.76)
        assert pixels_are_square(math.nan)

    def test_two_focal_lengths_as_one(self) -> None:
        board = board_modes(BOARD.points)
        model = LensModel(hybrid=FORM)
        families = prior_families(FORM, 800.0, board, SIZE, 0.6, 1.02)
        h = typical_hyperprior(MODES).mean
        for ratio, near in ((1.029, True), (0.971, True), (1.031, False), (0.969, False)):
            params = torch.zeros(5 + model.size).double()
            params[:4] = tensor(800.0, 800.0 * ratio, 320.0, 240.0)
            state = BoardState.still(
                params, torch.zeros(28).double(), torch.eye(3)[None].double(), torch.zeros(1, 3).double()
            )
            found = with_square_pixels(Estimate(model, families, state, Amplitudes(h, 1.0)), board)
            assert (found is not None) is near
            if found is not None:
                middle = 400.0 * (1.0 + ratio)
                assert found.state.parameters[:4].tolist() == pytest.approx([middle, middle, 320.0, 240.0])
                square = prior_families(FORM, 800.0, board, SIZE, 0.6)
                torch.testing.assert_close(found.families.log_unit, square.log_unit)
                assert torch.equal(found.families.amplitude, square.amplitude)

    def test_corners_through_the_base_projection(self) -> None:
        """Perspective, and a fisheye's equal angles; none beyond 80 degrees."""
        offset = tensor([[300.0, 400.0], [0.0, 0.0], [10.0, 0.0]])[None]
        seen = torch.ones(1, 1, 3, dtype=torch.bool)[0]
        ideal, usable = _through_base(offset[0], seen, 500.0, 1.0)
        assert ideal[0].tolist() == [pytest.approx([0.6, 0.8]), [0.0, 0.0], pytest.approx([0.02, 0.0])]
        assert usable.tolist() == [[True] * 3]
        ideal, _ = _through_base(offset[0], seen, 500.0, 0.0)
        assert ideal[0, 0].tolist() == pytest.approx([0.6 * math.tan(1.0), 0.8 * math.tan(1.0)])
        for degrees, good in ((79.0, True), (81.0, False)):
            away = 500.0 * math.radians(degrees)
            ideal, usable = _through_base(tensor([[away, 0.0]]), seen[:, :1], 500.0, 0.0)
            assert usable.tolist() == [[good]]
            assert bool(ideal.isfinite().all()) is good
        assert not bool(_through_base(offset[0], ~seen, 500.0, 1.0)[1].any())

    def test_fields_live_a_little_beyond_the_corners(self) -> None:
        state = BoardState.still(torch.zeros(0), torch.zeros(0), torch.eye(3)[None], tensor([0.0, 0.0, 0.5]))
        base = Base(500.0, 0.3, None, state, 0.01, 3)
        assert base.distance == 0.5
        model, families = _with_constants(base, SIZE, MODES, board_modes(BOARD.points))
        assert model.hybrid.radius == pytest.approx(1.08 * 400.0 / 500.0)
        assert model.hybrid.shape == 0.3
        assert float(families.mean[0]) == 500.0


class TestBoards:
    def test_what_cameras_cannot_tell_of_a_board(self) -> None:
        """At a place 0.2 m to the right and 0.1 m below its middle: shifts, tilts, a turn from x to y, the scale."""
        points = BOARD.points
        modes = undetermined_modes(points)
        x, y = (points[29] - points.mean(0))[:2].tolist()
        wanted = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, x], [0, 0, y], [-y, x, 0], [x, y, 0]]
        assert modes[:, :, 29].tolist() == [pytest.approx(row) for row in wanted]
        # None is among those that boards have.
        both = torch.cat([modes, board_modes(points).shapes]).flatten(1)
        assert int(torch.linalg.matrix_rank(both / both.norm(dim=1, keepdim=True), rtol=1e-6)) == 7 + 28

    def test_modes_by_their_corners(self) -> None:
        """Legendre's polynomials of a corner's place, each with its unit in extents of the board."""
        modes = board_modes(BOARD.points)
        a, b = 1.0 - 2.0 / 5.0 * 2, 1.0 - 2.0 / 4.0  # of the fourth column and the fourth row
        corner = 3 * 6 + 3

        def p(n: int, t: float) -> float:
            return float(np.polynomial.legendre.Legendre.basis(n)(t))

        assert modes.family.tolist() == [BENDING] * 12 + [STRETCH] * 2 + [PRINT] * 2 + [TRAPEZOID] * 2 + [PRINT] * 10
        bending = [(i, d - i) for d in (2, 3, 4) for i in range(d + 1)]
        printed = [(i, d - i) for d in (2, 3) for i in range(d + 1)]
        wanted = [[0, 0, p(i, a) * p(j, b)] for i, j in bending] + [[a, 0, 0], [b, 0, 0]]
        for i, j in printed:
            value = p(i, a) * p(j, b)
            wanted += [[value, 0, 0], [0, value, 0]]
        assert modes.shapes[:, :, corner].tolist() == [pytest.approx(row, abs=1e-12) for row in wanted]
        unit = [0.5 ** (i + j - 2) for i, j in bending] + [1.0, 1.0]
        unit += [0.5 ** (i + j - 1) for i, j in printed for _ in range(2)]
        assert modes.unit.tolist() == pytest.approx([0.5 * one for one in unit])  # 0.5 m wide

    def test_what_all_others_say(self) -> None:
        said = [Gaussian.independent(("x",), tensor(float(k)), tensor(1.0)) for k in range(4)]
        for k, one in enumerate(_but_one(said)):
            assert float(one.mean) == pytest.approx((6.0 - k) / 3.0)
        assert _but_one(said[:1]) == [None]


class TestQuadratics:
    def test_tempered_data_count_less(self) -> None:
        data = Quadratic(draw(4, 4), 8.0, draw(3))
        less = data.tempered(2.0)
        torch.testing.assert_close(less.products, data.products / 2.0)
        assert less.freedom == 4.0
        assert data.tempered(1.0) is data
        torch.testing.assert_close(data.g, -data.products[:3, 3])
        assert data.c == float(data.products[3, 3])

    def test_products_about_views_that_stand_still(self) -> None:
        """Residuals as they would be without the motions, which are unknowns about zero."""
        rows, motions, residual = draw(3, 2, 9), draw(3, 12, 9, seed=1), draw(3, 1, 9, seed=2)
        motion = draw(3, 12, seed=3)
        shared = torch.cat([rows, residual], 1)
        found = view_data(Products.of_rows(torch.cat([motions, shared], 1), 12), tensor(0.3, 0.4), motion, 11.0)
        still = residual - motion[:, None] @ motions
        both = torch.cat([rows, still], 1)
        torch.testing.assert_close(found.still.products, (both @ both.mT).sum(0))
        torch.testing.assert_close(found.own, motions @ motions.mT)
        torch.testing.assert_close(found.cross, motions @ both.mT)
        torch.testing.assert_close(found.score, (rows @ still.mT)[..., 0])
        assert (found.moving, found.still.freedom) == (True, 11.0)
        # Integrated out: the same as with a covariance of I + Uᵀ R² U.
        log_ratio = np.log([0.5, 0.8, 1.2, 0.3])
        spread = torch.from_numpy(np.repeat(np.exp(log_ratio), 3))
        whole = found.integrated(log_ratio)
        total, volume = torch.zeros(3, 3).double(), 0.0
        for k in range(3):
            U = motions[k] * spread[:, None]
            covariance = torch.eye(9).double() + U.T @ U
            total = total + both[k] @ torch.linalg.solve(covariance, both[k].T)
            volume += float(torch.linalg.slogdet(covariance)[1])
        torch.testing.assert_close(whole.data.products, total)
        assert whole.log_determinant == pytest.approx(volume)

    def test_roots_of_posteriors(self) -> None:
        half = draw(5, 3)
        K, deviation = half.T @ half, tensor(0.5, 2.0, 0.0)
        root = posterior_root(K, deviation, 0.3)
        scaled = K * deviation[:, None] * deviation / 0.3
        torch.testing.assert_close(root.T @ root, torch.linalg.inv(torch.eye(3).double() + scaled))

    def test_scores_that_scatter_more(self) -> None:
        """Of views whose scores have the variance that their data say, about one; three times as large, nine."""
        rows = draw(400, 2, 6)
        noise = 0.5 * draw(400, 6, seed=1)
        K = (rows @ rows.mT).sum(0)
        score = (rows @ noise[..., None])[..., 0]
        wide = tensor(10.0, 10.0)
        one = overdispersion(score, K, wide, 0.25)
        assert one == pytest.approx(1.0, abs=0.12)
        centered = score - score.mean(0)
        by_hand = float((centered @ torch.linalg.inv(K) * centered).sum() / 0.25 * 400 / 399 / 2.0)
        assert one == pytest.approx(max(by_hand, 1.0), rel=1e-3)
        assert overdispersion(3.0 * score, K, wide, 0.25) == pytest.approx(9.0 * by_hand, rel=1e-3)
        assert overdispersion(0.1 * score, K, wide, 0.25) == 1.0

    def test_data_of_still_views(self) -> None:
        rows = draw(2, 4, 5)
        found = view_data(Products.of_rows(rows, 0), tensor(1.0, 2.0, 3.0), rows.new_zeros(2, 0), 7.0)
        torch.testing.assert_close(found.still.products, (rows @ rows.mT).sum(0))
        assert not found.moving
        torch.testing.assert_close(found.score, (rows[:, :3] @ rows[:, 3:].mT)[..., 0])


def test_deviations_and_their_slopes() -> None:
    one = torch.ones(3).double()
    families = PriorFamilies(
        0 * one, tensor(0.1, 0.2, 0.3), torch.tensor([0, -1, 1]), torch.tensor([1, -1, -1]), 2 * one
    )
    h = tensor(0.4, -0.5)
    assert families.deviation(h).log().tolist() == pytest.approx([0.1 + 0.4 - math.exp(-0.5) * 2.0, 0.2, 0.3 - 0.5])
    first, second = families.log_variance_slopes(h)
    for k in (0, 1):
        step = 1e-6 * torch.eye(2).double()[k]
        up, down = (2.0 * families.deviation(h + sign * step).log() for sign in (1, -1))
        assert first[:, k].tolist() == pytest.approx(((up - down) / 2e-6).tolist(), abs=1e-6)
        bend = (up + down - 4.0 * families.deviation(h).log()) / 1e-12
        assert second[:, k].tolist() == pytest.approx(bend.tolist(), abs=1e-2)


# What a measured board says of itself, against straightforward fits to its corners; its sigmas by differences.


PLATE = Board(columns=6, rows=9, square=0.02)

KINDS = ("bending", "stretch", "shear", "print_error")


def made(amplitudes: Tensor, spread: float = 1e-5) -> MeasuredBoard:
    half = spread * torch.randn(28, 28, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    return MeasuredBoard(name="plate", board=PLATE, amplitudes=amplitudes, half=half, log_evidence=5.0)


def drawn() -> Tensor:
    return 3e-5 * torch.randn(28, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def plane_part() -> tuple[Tensor, Tensor]:
    """A (3, 2) of the best affine map from the ordered to the measured corners in the plane, and what it leaves."""
    places = torch.cat([PLATE.points[:, :2], torch.ones(PLATE.corners, 1, dtype=torch.float64)], 1)
    found = made(drawn()).points
    affine = torch.linalg.lstsq(places, found).solution
    return affine, found - places @ affine


def test_values() -> None:
    board = made(drawn())
    affine, rest = plane_part()
    right, down = affine[0, :2], affine[1, :2]
    assert board.stretch.value == pytest.approx(float(right.norm() / down.norm()) - 1.0, abs=1e-6)
    assert board.shear.value == pytest.approx(float(right @ down / right.norm() / down.norm()), abs=1e-6)
    assert board.bending.value == pytest.approx(float(rest[:, 2].abs().max()), rel=1e-9)
    assert board.print_error.value == pytest.approx(float(rest[:, :2].square().sum(-1).mean().sqrt()), rel=1e-9)
    assert board.stretch.value != 0.0
    assert board.shear.value != 0.0


@pytest.mark.parametrize("kind", KINDS)
def test_sigmas(kind: str) -> None:
    """That of a function of the amplitudes, to first order."""

    def value(amplitudes: Tensor) -> float:
        return float(getattr(made(amplitudes), kind).value)

    slope = (
        torch.tensor([value(drawn() + step) - value(drawn() - step) for step in 1e-9 * torch.eye(28).double()]) / 2e-9
    )
    board = made(drawn(), 1e-7)
    assert getattr(board, kind).sigma == pytest.approx(float((board.half @ slope.double()).norm()), rel=1e-4)


def test_an_error_below_its_noise() -> None:
    """A board as it was ordered: its RMS has no slope, and its sigma is what noise alone would show."""
    board = made(torch.zeros(28, dtype=torch.float64))
    assert board.print_error.value == 0.0
    draws = torch.randn(100, 28, generator=torch.Generator().manual_seed(3), dtype=torch.float64) @ board.half
    shown = torch.tensor([made(draw).print_error.value for draw in draws])
    assert board.print_error.sigma == pytest.approx(float(shown.square().mean().sqrt()), rel=0.15)


def test_displacements() -> None:
    """No shift and no tilt is left in them; they are what an affine map leaves, and stretch and shear."""
    board = made(drawn())
    there = board.displacements()
    torch.testing.assert_close(board.displacements(PLATE.points), there)
    x, y = (PLATE.points[:, :2] - PLATE.points[:, :2].mean(0)).unbind(-1)
    u, v, w = there.unbind(-1)
    assert max(abs(float(one)) for one in [u.sum(), v.sum(), w.sum(), (x * w).sum(), (y * w).sum()]) < 1e-12
    _, rest = plane_part()
    torch.testing.assert_close(w, rest[:, 2])
    stretch, shear = 0.5 * board.stretch.value, 0.5 * board.shear.value
    torch.testing.assert_close(u - rest[:, 0], stretch * x + shear * y, rtol=0, atol=1e-10)
    torch.testing.assert_close(v - rest[:, 1], shear * x - stretch * y, rtol=0, atol=1e-10)


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    size = torch.eye(28, dtype=torch.float64)
    for amplitudes, half in ((drawn()[:-1], size), (drawn(), size[:-1]), (drawn() / 0.0, size), (drawn(), size / 0.0)):
        with pytest.raises(InputError, match="measured board"):
            MeasuredBoard(name="plate", board=PLATE, amplitudes=amplitudes, half=half, log_evidence=0.0)
    with pytest.raises(InputError, match="the observations show another board"):
        made(drawn()).prior_for(PLATE.points + 1e-6)
    board = made(drawn())
    again = load_measured_board(save_measured_board(board, tmp_path / "board.json"))
    assert torch.equal(again.amplitudes, board.amplitudes)
    assert torch.equal(again.half, board.half)
    assert (again.name, again.board, again.log_evidence) == (board.name, board.board, 5.0)
