"""The network of a field, trained together with camera, poses and board."""

import copy
import dataclasses
import functools

import pytest
import torch
from torch import Tensor, nn

from kcal import CalibrationOptions, InputError, calibrate_camera
from kcal.calibrate import calibrate_views, compare_models
from kcal.calibrate.hybrid.fit import FitOptions, HybridFit, fit_hybrid, settle
from kcal.calibrate.hybrid.fitted_views import Estimate
from kcal.calibrate.hybrid.network_fit import (
    FieldTraining,
    _gauss_newton,
    _joint_products,
    _Moved,
    _trunk,
    _Turn,
    _with_weights,
    weights_of,
)
from kcal.nets import NetworkModes
from scripts.bench.network_field import BOARD, NOISE, SIZE, capture, network, off


class Rings(nn.Module):
    """A user's network."""

    def __init__(self) -> None:
        super().__init__()
        self.places, self.out = nn.Linear(2, 10), nn.Linear(10, 2)
        with torch.no_grad():
            self.places.weight.mul_(3.0)

    def forward(self, places: Tensor) -> Tensor:
        result: Tensor = self.out(torch.cos(self.places(places)))
        return result


@functools.cache
def fitted(training: FieldTraining | None) -> HybridFit:
    modes = NetworkModes.of(network())[0]
    return fit_hybrid(
        BOARD.points,
        capture().pixels(),
        SIZE,
        options=FitOptions(modes=modes, board="exact", motion=False, square=True, training=training),
    )


def options(training: FieldTraining | None, field: nn.Module | None = None) -> CalibrationOptions:
    return CalibrationOptions(field=field or network(), training=training, board="exact", motion=False)


@pytest.mark.slow
def test_training_finds_what_fixed_features_and_twenty_coefficients_cannot() -> None:
    """A dent, seen at places that no corner had; by Gauss-Newton sooner than by Adam."""
    newton, adam, fixed = fitted(FieldTraining()), fitted(FieldTraining(optimizer="adam")), fitted(None)
    ext20 = calibrate_camera(capture(), CalibrationOptions(model="ext20"))
    assert off(newton.camera) < 0.7 * min(off(fixed.camera), off(adam.camera))
    assert off(fixed.camera) < 0.5 * off(ext20.camera)
    assert newton.log_evidence > adam.log_evidence >= fixed.log_evidence
    # Corners have noise of 0.05 px along both axes.
    assert newton.sigma == pytest.approx(NOISE, rel=0.1)


@pytest.mark.slow
def test_the_users_network_stays_and_the_camera_has_a_trained_copy() -> None:
    torch.manual_seed(1)
    given = Rings()
    before = copy.deepcopy(given.state_dict())
    result = calibrate_camera(capture(8, 0.3), options(FieldTraining(turns=1), given))
    assert all(torch.equal(before[name], value) for name, value in given.state_dict().items())
    assert isinstance(result.camera.field, Rings)
    moved = result.camera.field.places.weight - given.places.weight
    assert float(moved.abs().max()) > 0.01
    assert str(result.camera.model) == "network"
    # Each weight of the last layer has error bars; those before it count as known.
    names = [name for name in result.sigma if name.startswith("n")]
    assert len(names) == 20
    assert all((result.sigma[name] or 0.0) > 0 for name in names)
    assert result.hybrid is not None
    still = fitted(None).camera.field
    assert isinstance(still, nn.Sequential)
    assert torch.equal(still.get_parameter("0.weight"), network().get_parameter("0.weight").double())


def turn() -> tuple[_Turn, Estimate]:
    pixels = capture(6).pixels()
    options = FitOptions(modes=NetworkModes.of(Rings())[0], board="exact", motion=False)
    found = settle(BOARD.points, pixels, SIZE, torch.ones_like(pixels[..., 0]), options)
    return _Turn(capture=found.capture, initial=weights_of(_trunk(found.estimate)), spread=0.5), found.estimate


def test_derivatives_by_the_networks_weights() -> None:
    """Rows of Gauss-Newton against differences of the solver's own residuals."""
    torch.manual_seed(4)
    own, estimate = turn()
    problem = own.capture.problem(estimate)
    weights = weights_of(_trunk(estimate))
    rows = _Moved(own, problem, estimate).rows(weights, slice(1, 3))
    for k in (0, 7, 25):
        sides = []
        for sign in (1.0, -1.0):
            other = weights.clone()
            other[k] += sign * 1e-5
            changed = _with_weights(estimate, other)
            sides.append(own.capture.problem(changed).pixel_errors(changed.state)[1:3].flatten(-2))
        torch.testing.assert_close(rows[:, k], (sides[0] - sides[1]) / 2e-5, rtol=1e-4, atol=1e-7)

    # The prior of the weights, about their initial values, is part of the step.
    near, far = (
        _joint_products(dataclasses.replace(own, initial=weights - shift, spread=spread), problem, estimate)
        for shift, spread in ((0.0, 1e9), (0.1, 0.5))
    )
    pull, hold = (far - near)[-1 - len(weights) : -1, -1], (far - near).diagonal()[-1 - len(weights) : -1]
    torch.testing.assert_close(hold, torch.full_like(hold, estimate.variance / 0.25), rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(pull, 0.1 * hold, rtol=1e-6, atol=1e-9)


def test_a_turn_lowers_the_cost_and_a_narrow_prior_holds_the_weights() -> None:
    torch.manual_seed(4)
    own, estimate = turn()
    before = own.cost(own.capture.problem(estimate), estimate)
    after, steps = _gauss_newton(own, estimate)
    assert steps > 0
    assert own.cost(own.capture.problem(after), after) < before
    narrow, _ = _gauss_newton(dataclasses.replace(own, spread=1e-5), estimate)
    moved = [weights_of(_trunk(each)) - own.initial for each in (after, narrow)]
    assert float(moved[1].abs().max()) < 1e-4 < 1e-2 < float(moved[0].abs().max())


@pytest.mark.slow
def test_the_layer_takes_it_too() -> None:
    pixels = capture().pixels().requires_grad_()
    found = calibrate_views(pixels, BOARD.points, SIZE, options(None))
    assert str(found.model) == "network"
    (gradient,) = torch.autograd.grad(found.parameters[2], pixels)
    # All corners one pixel to the right; a prior holds the principal point a little.
    assert float(gradient[..., 0].sum()) == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_it_is_compared_by_its_name() -> None:
    found = compare_models(capture(8), ["network"], groups="views", parts=2, options=options(None))
    assert found.models == ("network",)
    assert NOISE < found.rms["network"] < 1.0


def test_options_that_do_not_fit() -> None:
    with pytest.raises(InputError, match="leave the model opencv5 out"):
        CalibrationOptions(model="opencv5", field=network())
    with pytest.raises(InputError, match="gauss-newton or adam"):
        FieldTraining(optimizer="sgd")  # type: ignore[arg-type]
    for bad in ({"turns": 0}, {"spread": 0.0}):
        with pytest.raises(InputError, match="must be positive"):
            FieldTraining(**bad)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"correction \(N, 2\)"):
        CalibrationOptions(field=nn.Linear(2, 3))
