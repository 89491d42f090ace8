"""What rounds of evidence decide, what several cameras say of a board, and what one tells of its type."""

import dataclasses
import functools
import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from calibrate_scenes import observe
from printed_boards import printed_points, printed_views
from torch import Tensor

from kcal import Board, Camera
from kcal.calibrate.hybrid import cameras_fit, fitted_views
from kcal.calibrate.hybrid.board_modes import board_modes
from kcal.calibrate.hybrid.cameras_fit import CameraFit, _measured, fit_turned
from kcal.calibrate.hybrid.evidence import Amplitudes
from kcal.calibrate.hybrid.families import Hyperprior, typical_hyperprior
from kcal.calibrate.hybrid.fit import FitOptions
from kcal.calibrate.hybrid.fitted_views import Rounds, columns_may_be_read
from kcal.calibrate.hybrid.measured_board import printed_board
from kcal.calibrate.problem.state import Readout, motion_sigma
from kcal.gaussian import Gaussian, numbered
from kcal.lens.information import BOARD_SLOT, LENS_SLOT
from kcal.lens.zernike import ZernikeModes

BOARD = Board(columns=8, rows=6, square=0.03)
SIZE = (1280, 960)
MODES = ZernikeModes(radial=5, decentered=3, astigmatic=2, other=2)


@dataclasses.dataclass
class Views:
    """Stand-ins for views whose data say only whether columns were read."""

    readout: Readout | None
    hyperprior: Hyperprior | None = None

    def problem(self, *_: object) -> None: ...

    def data(self, *_: object) -> bool:
        return self.readout.columns


class TestColumns:
    READOUT = Readout(center=torch.zeros(3), distance=1.0, size=SIZE)

    def asked(self, log_ratio: float, *, converged: bool = True, readout: Readout | None = READOUT) -> bool:
        state = SimpleNamespace(motion=torch.zeros(1, 12), _replace=lambda **_: None)
        estimate = SimpleNamespace(
            amplitudes=Amplitudes(torch.zeros(0), 0.01, np.full(4, log_ratio)), state=state, families=None,
            _replace=lambda **_: None,
        )  # fmt: skip
        rounds = cast(Rounds, SimpleNamespace(capture=Views(readout), estimate=estimate, converged=converged))
        return columns_may_be_read(rounds)

    @pytest.mark.parametrize("better", [True, False])
    def test_by_the_evidence_of_columns_against_rows(self, better: bool, monkeypatch: pytest.MonkeyPatch) -> None:
        """Where motions are moderate and the rounds came to rest; the smaller loss is the larger evidence."""
        losses = {True: 1.0, False: 2.0 if better else 0.5}

        def maximum(columns: bool, *_: object, **__: object) -> SimpleNamespace:
            return SimpleNamespace(loss=losses[columns])

        def at_rows(columns: bool, *_: object) -> SimpleNamespace:
            return SimpleNamespace(value=lambda _: losses[columns])

        monkeypatch.setattr(fitted_views, "maximize_evidence", maximum)
        monkeypatch.setattr(fitted_views, "EvidenceLoss", at_rows)
        assert self.asked(-3.0) is better
        assert self.asked(-3.0, readout=None) is False
        # There is no solution near which anything could be asked.
        assert self.asked(-3.0, converged=False) is True
        far = 20.0
        large = motion_sigma(np.full(4, far), 0.01)
        assert max(large.turn, large.shift) > fitted_views._TOO_MUCH
        assert self.asked(far) is True


def test_a_solution_without_a_last_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """It stays where the problem was linearized, unless that is asked for; the effort counts residuals."""
    seen: list[tuple[bool, int, float]] = []

    problem = SimpleNamespace(bent="bent")

    def minimized(given: object, state: object, options: Any, bend: object) -> SimpleNamespace:
        assert (given, bend) == (problem, "bent")
        seen.append((options.last_step, options.max_iterations, options.tolerance))
        return SimpleNamespace(state="there", iterations=torch.tensor(3))

    monkeypatch.setattr(fitted_views, "minimize", minimized)
    monkeypatch.setattr(fitted_views.FittedViews, "problem", lambda *_: problem)
    pixels = torch.zeros(2, 48, 2).double()
    pixels[0, 3] = torch.nan
    weights = torch.ones(2, 48).double()
    weights[1, :4] = 0.0
    views = fitted_views.FittedViews(
        points=BOARD.points, board=board_modes(BOARD.points), pixels=pixels, size=SIZE, weights=weights,
        hyperprior=typical_hyperprior(),
    )  # fmt: skip
    freedom = 2 * (96 - 5) - 12
    assert views.freedom == freedom
    estimate = cast(Any, SimpleNamespace(state="here", _replace=lambda state: state))
    assert views.solved(estimate, (7, 0.1)) == (problem, "there", 3)
    views.solved(estimate, (9, 0.2), True)
    assert seen == [(False, 7, pytest.approx(0.1 / freedom)), (True, 9, pytest.approx(0.2 / freedom))]


def test_evidence_of_a_printed_board_against_one_as_ordered() -> None:
    """In nats: the likelihood of amplitudes of zero is that of each camera's own residuals there."""
    modes = board_modes(BOARD.points)
    slots = numbered(BOARD_SLOT, 28)
    mean = 1e-4 * torch.randn(3, 28, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    sigma = torch.tensor([2e-5, 3e-5, 1e-5], dtype=torch.float64)
    messages = [Gaussian.independent(slots, m, s.expand(28)) for m, s in zip(mean, sigma, strict=True)]
    cameras = [
        cast(
            CameraFit,
            SimpleNamespace(
                board=k, message=message, turns=torch.zeros(2), fit=SimpleNamespace(board_shapes=modes, displaced=None)
            ),
        )
        for k, message in zip((0, 1, 0), messages, strict=True)
    ]
    sets = cast(Any, [SimpleNamespace(board=BOARD)] * 3)
    found = _measured(0, sets, ["left", "right", "middle"], cameras, [torch.zeros(2)] * 3)
    assert (found.name, found.observations, found.board) == ("left", ("left", "middle"), BOARD)
    prior, evidence = printed_board(modes, [messages[0], messages[2]])
    as_ordered = -0.5 * float(sum((mean[k] / sigma[k]).square().sum() for k in (0, 2)))
    assert found.log_evidence == pytest.approx(evidence - as_ordered)
    both = torch.stack([mean[k] / sigma[k] ** 2 for k in (0, 2)]).sum(0)
    information = (sigma[0] ** -2 + sigma[2] ** -2) * torch.eye(28).double() + prior.products[:-1, :-1]
    torch.testing.assert_close(found.amplitudes, torch.linalg.solve(information, both), rtol=1e-6, atol=1e-12)
    torch.testing.assert_close(found.half.T @ found.half, torch.linalg.inv(information), rtol=1e-6, atol=1e-18)


@functools.cache
def shots() -> Tensor:
    truth = Camera.build(
        focal=(800, 800), center=(644, 476), size=SIZE, coefficients=[-0.12, 0.03, 4e-4, -3e-4, 0.0], model="opencv5"
    )
    return printed_views(truth, BOARD, printed_points(BOARD, 3), 9, 11, noise=0.1, pupil=0.0)


@pytest.mark.parametrize("shape", ["exact", "printed"])
def test_what_a_camera_tells_of_its_lens(shape: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its data alone: with the priors of the fit they give the fit. Their freedom: residuals that count, less poses."""
    freedoms: list[float] = []
    about = cameras_fit._about_hyperparameters

    def noted(fit: Any, data: Gaussian, freedom: float) -> Gaussian:
        freedoms.append(freedom * fit.tempering)
        return about(fit, data, freedom)

    monkeypatch.setattr(cameras_fit, "_about_hyperparameters", noted)
    pixels = shots().clone()
    pixels[2, 5] = torch.nan
    weights = torch.ones(9, 48).double()
    weights[1, :3] = 0.0
    options = FitOptions(modes=MODES, board=shape)
    found = fit_turned(observe(pixels, board=BOARD, size=SIZE), weights, options, one_type=True)
    assert freedoms == [pytest.approx(2 * (9 * 48 - 4) - 6 * 9)]
    fit = found.fit
    deviation, count = fit.families.deviation(fit.expected), len(found.lens.slots)
    assert found.lens.slots == numbered(LENS_SLOT, count)
    both = found.lens + Gaussian.independent(found.lens.slots, fit.families.mean[:count], deviation[:count])
    wanted = fit.state.parameters[[0, 2, 3]]
    mean, half = both.mean_and_half()
    off = (mean[:3] - wanted) / half.square().sum(0).sqrt()[:3]
    assert float(off.abs().max()) < 0.3
    # What they say of the amplitudes is largest near those of the fit.
    assert math.isfinite(float(found.hyper.rows.abs().sum()))
    assert len(found.hyper.slots) == len(fit.hyperparameters)
