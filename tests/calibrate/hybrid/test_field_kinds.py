"""Fits of a simulated camera with fields of every kind; the evidence sets their amplitudes."""

import math

import pytest
import torch
from printed_boards import WIDE, middle_error
from torch import Tensor

from kcal import Board
from kcal.calibrate.hybrid import fitted_views
from kcal.calibrate.hybrid.board_modes import board_modes
from kcal.calibrate.hybrid.families import SQUARE, prior_families, typical_hyperprior
from kcal.calibrate.hybrid.fit import FitOptions, HybridFit, fit_hybrid
from kcal.lens import rotation_from_vector
from kcal.lens.field_modes import FieldModes, GaussianModes, NetworkModes
from kcal.lens.model import HybridForm
from kcal.lens.zernike import ZernikeModes

BOARD = Board(columns=8, rows=6, square=0.05)
SIZE, NOISE = (1280, 960), 0.05
KINDS: dict[str, FieldModes] = {
    "zernike": ZernikeModes(radial=9, decentered=4, astigmatic=3, other=2),
    "gaussian": GaussianModes(widths=(1.0, 0.5)),
    "network": NetworkModes.random(40),
}


def capture(count: int = 20) -> Tensor:
    generator, middle, found = torch.Generator().manual_seed(11), BOARD.points.mean(0), []
    while len(found) < count:
        u = 2.0 * torch.rand(6, generator=generator, dtype=torch.float64) - 1.0
        turn = rotation_from_vector(torch.stack([0.6 * u[0], 0.6 * u[1], math.pi * u[2]]))
        shift = torch.stack([0.35 * u[3], 0.25 * u[4], 0.6 + 0.1 * u[5]])
        pixels, valid = WIDE.project((BOARD.points - middle) @ turn.T + shift)
        if bool((valid & WIDE.inside(pixels)).all()):
            found.append(pixels + NOISE * torch.randn(pixels.shape, generator=generator, dtype=torch.float64))
    return torch.stack(found)


def fitted(modes: FieldModes) -> HybridFit:
    return fit_hybrid(BOARD.points, capture(), SIZE, options=FitOptions(modes=modes, board="exact"))


@pytest.mark.parametrize("kind", KINDS)
def test_a_camera_is_found_with_each(kind: str) -> None:
    found = fitted(KINDS[kind])
    assert found.camera.names[8:] == KINDS[kind].names
    # Corners of 0.05 px on both axes; each view takes six numbers, the lens some tens.
    assert found.rms == pytest.approx(NOISE * math.sqrt(2.0), rel=0.12)
    assert found.sigma == pytest.approx(NOISE, rel=0.12)
    # Only Zernike fields know that lenses are round: others leave more between field, focal length and pupil.
    assert middle_error(found.camera, WIDE, 0.8) < (2.5 if kind == "zernike" else 6.0) * NOISE
    assert len(found.hyperparameters) == len(KINDS[kind].hyperprior) + 6
    assert 8 < found.effective < 80


def test_priors_of_gaussian_units_fall_by_octaves() -> None:
    form = HybridForm(shape=0.5, radius=0.9, modes=GaussianModes(widths=(1.0, 0.5, 0.25)))
    families = prior_families(form, 800.0, board_modes(BOARD.points), SIZE, 0.6)
    h = typical_hyperprior(form.modes).mean.clone()
    h[0], h[1] = math.log(1e-3), math.log(2.0)
    deviation = families.deviation(h)[6 : 6 + len(form.modes)]
    wide, middle, fine = (deviation[form.names.index(f"g{i}.0x") - 3] for i in (0, 1, 2))
    assert float(wide) == pytest.approx(0.9e-3)
    assert float(middle / wide) == pytest.approx(math.exp(-2.0))
    assert float(fine / middle) == pytest.approx(math.exp(-2.0))
    # What comes after the field's own hyperparameters moves the pupil and the board.
    shifted = h.clone()
    shifted[2] += 1.0
    changed = (families.deviation(shifted) / families.deviation(h) - 1.0).abs() > 1e-12
    assert changed.nonzero()[:, 0].tolist() == [4, 5]
    shifted = h.clone()
    shifted[3:] += 1.0
    changed = (families.deviation(shifted) / families.deviation(h) - 1.0).abs() > 1e-12
    assert changed.nonzero()[:, 0].tolist() == list(range(6 + len(form.modes), len(families.mean)))


def test_pixels_are_square_or_have_two_focal_lengths() -> None:
    board = board_modes(BOARD.points)
    form = HybridForm(shape=0.5, radius=0.9, modes=KINDS["zernike"])
    h = typical_hyperprior(form.modes).mean
    place = 3 + form.names.index("z1-1")
    square, free = (prior_families(form, 800.0, board, SIZE, 0.6, aspect) for aspect in (None, 1.2))
    assert float(square.deviation(h)[place]) == pytest.approx(0.9 * SQUARE)
    rows = 6 + len(form.modes)
    assert float(free.mean[rows]) == pytest.approx(960.0)
    assert float(free.deviation(h)[rows]) == pytest.approx(0.2 * 960.0)
    kept = torch.arange(len(free.mean)) != rows
    torch.testing.assert_close(free.deviation(h)[kept], square.deviation(h), rtol=0, atol=0)
    for of_free, of_square in zip(free.log_variance_slopes(h), square.log_variance_slopes(h), strict=True):
        assert (of_free[kept.numpy()] == of_square).all()


@pytest.mark.parametrize("rounds", [1, 12])
def test_rounds_that_run_out_are_said(rounds: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fitted_views, "_ROUNDS", rounds)
    assert fit_hybrid(BOARD.points, capture(6), SIZE).converged == (rounds == 12)


def test_pixels_are_square_where_that_is_said() -> None:
    """Although these are not: rows are 1 % higher than columns are wide."""
    pixels = capture(5) * torch.tensor([1.0, 1.01])
    found = fit_hybrid(BOARD.points, pixels, SIZE, options=FitOptions(square=True)).camera.params
    assert float(found[0]) == float(found[1])
