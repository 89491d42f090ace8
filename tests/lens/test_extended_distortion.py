"""Extended distortion and the bounds of its Taylor series."""

import copy
import itertools
import pickle

import cv2
import numpy as np
import pytest
import torch
from calibrate_scenes import LENS, camera
from kornia.geometry.calibration import distort_points
from lenses import hybrid_camera
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.camera_parameters import ExtendedDistortion
from kcal.lens.model import PRESETS
from kcal.lens.region import Jet, Span

# `ExtendedDistortion`: the formulas of OpenCV and kornia, derivatives, an inverse that knows where there is none.


MODELS = ["opencv4", "opencv5", "opencv8", "opencv12", "opencv14", "ext16", "ext18", "ext20", "ext22", "ext24"]


def of_model(model: str) -> ExtendedDistortion:
    """With every coefficient different from zero."""
    return ExtendedDistortion([LENS.get(name, 1e-3) for name in PRESETS[model].names], model)


def points(count: int = 40, reach: float = 0.6) -> Tensor:
    generator = torch.Generator().manual_seed(3)
    return reach * (2.0 * torch.rand(count, 2, generator=generator, dtype=torch.float64) - 1.0)


@pytest.mark.parametrize("model", MODELS[:5])
def test_it_is_the_distortion_of_opencv_and_kornia(model: str) -> None:
    distortion, here = of_model(model), points()
    found, valid = distortion(here)
    assert bool(valid.all())
    rays = np.concatenate([here.numpy(), np.ones((len(here), 1))], 1)
    wanted, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), distortion.coefficients.numpy())
    np.testing.assert_allclose(found, wanted[:, 0], rtol=0, atol=1e-14)
    theirs = distort_points(here[None], torch.eye(3)[None].double(), distortion.coefficients[None])[0]
    torch.testing.assert_close(found, theirs, rtol=0, atol=1e-14)


@pytest.mark.parametrize("model", MODELS)
def test_jacobians_are_those_of_autograd(model: str) -> None:
    distortion, here = of_model(model), points(6)

    def forward(where: Tensor, coefficients: Tensor) -> Tensor:
        return torch.func.functional_call(distortion, {"params": coefficients}, (where,))[0]

    by_point, by_coefficients = torch.func.jacrev(forward, argnums=(0, 1))(here, distortion.params)
    found = distortion.jacobian(here)
    torch.testing.assert_close(found.by_point, torch.einsum("npnq->npq", by_point), rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(found.by_coefficients, by_coefficients, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("model", ["opencv14", "ext20", "ext24"])
@pytest.mark.parametrize("way", ["forward", "inverse"])
def test_gradcheck_by_points_and_coefficients(model: str, way: str) -> None:
    distortion, here = of_model(model).free(), points(4, 0.4).requires_grad_()

    def value(where: Tensor, coefficients: Tensor) -> Tensor:
        stub = copy.deepcopy(distortion)
        del stub.params
        stub.params = coefficients
        return getattr(stub, way)(where)[0]

    assert torch.autograd.gradcheck(value, (here, distortion.params), atol=1e-6)


@pytest.mark.parametrize("model", [*MODELS, "fisheye4"])
def test_the_inverse_undoes_it(model: str) -> None:
    distortion = ExtendedDistortion([0.02, -0.01, 0.003], model) if model == "fisheye4" else of_model(model)
    distorted, _ = distortion(points())
    again, valid = distortion.inverse(distorted)
    assert bool(valid.all())
    torch.testing.assert_close(again, points(), rtol=0, atol=1e-12)


def test_beyond_a_fold_nothing_is_valid() -> None:
    distortion = ExtendedDistortion([-0.3])
    fold = (1 / 0.9) ** 0.5  # of r - 0.3 r³
    beside = torch.tensor([[0.99 * fold, 0.0], [1.01 * fold, 0.0], [torch.nan, 0.0], [0.0, torch.inf]]).double()
    distorted, valid = distortion(beside)
    assert valid.tolist() == [True, False, False, False]
    assert bool((distorted[1:] == 0).all())
    found = distortion.jacobian(beside)
    assert bool(torch.isfinite(found.by_coefficients).all())
    assert bool((found.by_point[1:] == 0).all())
    highest = fold - 0.3 * fold**3
    back, valid = distortion.inverse(torch.tensor([[0.999 * highest, 0.0], [1.001 * highest, 0.0]]).double())
    assert valid.tolist() == [True, False]
    assert bool((back[1] == 0).all())


def test_a_batch_is_each_alone() -> None:
    alone = [of_model("ext20"), ExtendedDistortion([-0.1, 0.02])]
    together = ExtendedDistortion(torch.stack([one.coefficients for one in alone]), "ext20")
    here = torch.stack([points(), points()])
    distorted, valid = together(here)
    back, found = together.inverse(distorted)
    assert bool((valid & found).all())
    torch.testing.assert_close(back, here, rtol=0, atol=1e-12)
    for i, one in enumerate(alone):
        torch.testing.assert_close(distorted[i], one(here[i])[0], rtol=0, atol=1e-15)
        torch.testing.assert_close(together.jacobian(here).by_coefficients[i], one.jacobian(here[i]).by_coefficients)


def test_only_free_coefficients_learn() -> None:
    distortion = of_model("ext20").free("k1", "s6")
    distortion(points())[0].sum().backward()
    moved = {name for name, g in zip(distortion.names, distortion.params.grad.tolist(), strict=True) if g}
    assert moved == {"k1", "s6"} == set(distortion.free_names)


def test_state_copies_and_precision() -> None:
    distortion, other = of_model("ext20"), ExtendedDistortion([-0.9], "ext20")
    assert not bool(other(points())[1].all())
    other.load_state_dict(distortion.state_dict())
    for one in (other, copy.deepcopy(distortion), pickle.loads(pickle.dumps(distortion)), distortion.half()):
        found, valid = one(points())
        assert bool(valid.all())
        assert torch.equal(found, of_model("ext20")(points())[0])


class TestOfACamera:
    @pytest.mark.parametrize("model", ["opencv5", "opencv14", "ext20"])
    def test_the_camera_is_made_of_it(self, model: str) -> None:
        whole = camera(model)
        rays = torch.cat([points(), torch.ones(len(points()), 1, dtype=torch.float64)], 1)
        distorted, valid = whole.distortion(points())
        wanted, seen = whole.project(rays)
        assert torch.equal(valid, seen)
        torch.testing.assert_close(distorted * whole.focal + whole.center, wanted, rtol=0, atol=1e-9)
        torch.testing.assert_close(whole.distortion.inverse(distorted)[0], whole.normalize(wanted)[0])
        torch.testing.assert_close(distorted, ExtendedDistortion(whole.coefficients, model)(points())[0])

    def test_of_the_default_camera(self) -> None:
        whole = hybrid_camera("webcam")
        distorted, valid = whole.distortion(points(reach=0.3))
        back, found = whole.distortion.inverse(distorted)
        assert bool((valid & found).all())
        torch.testing.assert_close(back, points(reach=0.3), rtol=0, atol=1e-12)

    def test_parameters_are_shared(self) -> None:
        whole = camera("ext20")
        distortion = whole.distortion.free("k1")
        assert whole.free_names == ("k1",)
        optimizer = torch.optim.SGD(distortion.parameters(), lr=0.1)
        distortion(points())[0].square().sum().backward()
        before = float(whole.params.detach()[5])
        optimizer.step()
        assert float(whole.params.detach()[5]) != before
        distortion.update_valid_region()
        assert torch.equal(whole.distortion(points())[0], distortion(points())[0])
        assert torch.equal(copy.deepcopy(distortion)(points())[0], distortion(points())[0])


def test_bad_input_is_refused() -> None:
    with pytest.raises(InputError, match="opencv4 has 4"):
        ExtendedDistortion([0.0] * 5, "opencv4")
    with pytest.raises(InputError, match="distortion coefficients"):
        ExtendedDistortion(torch.zeros(5), "ext20")
    with pytest.raises(InputError, match="not finite"):
        ExtendedDistortion([float("nan")])
    with pytest.raises(InputError, match="unknown parameter 'fx': there are k1"):
        ExtendedDistortion().free("fx")
    with pytest.raises(InputError, match="normalized"):
        ExtendedDistortion()(torch.zeros(3, 3))


# Bounds of functions that are known to within errors: every function is within them, and none is far within.


HALF = 0.5


def number(value: float) -> Tensor:
    return torch.tensor([value], dtype=torch.float64)


def jet(value: float, slope: float, bend: float, value_error: float, slope_error: float) -> Jet:
    return Jet(*(number(part) for part in (value, slope, bend, value_error, slope_error, HALF)))


FIRST, SECOND = jet(2.0, -3.0, 1.5, 0.25, 0.5), jet(-1.0, 0.75, 2.0, 0.125, 0.0625)


def members(one: Jet) -> list[tuple[float, float, float]]:
    """Value, slope and second derivative of parabolas at the ends of what a jet encloses."""
    value, slope, bend = float(one.value), float(one.slope), float(one.bend)
    signs = itertools.product((-1.0, 1.0), repeat=3)
    return [(value + a * float(one.value_error), slope + b * float(one.slope_error), c * bend) for a, b, c in signs]


TIMES = torch.linspace(-HALF, HALF, 21, dtype=torch.float64)


def test_size_is_the_largest_value_and_slope() -> None:
    for one in (FIRST, SECOND):
        value, slope = (float(part) for part in one.size())
        assert slope == pytest.approx(max(abs(b + c * t) for _, b, c in members(one) for t in (-HALF, HALF)))
        largest = max(float((a + b * TIMES + 0.5 * c * TIMES**2).abs().max()) for a, b, c in members(one))
        assert largest <= value <= largest + 0.5 * float(one.bend) * HALF**2 + 1e-12


@pytest.mark.parametrize("kind", ["sum", "difference", "product"])
def test_functions_of_two_are_enclosed(kind: str) -> None:
    """At the center within the errors, with the largest reached; nowhere more bent than stated."""
    found = {"sum": FIRST + SECOND, "difference": FIRST - SECOND, "product": FIRST * SECOND}[kind]
    values, slopes, bends = [], [], []
    for (a, da, dda), (b, db, ddb) in itertools.product(members(FIRST), members(SECOND)):
        first, second = a + da * TIMES + 0.5 * dda * TIMES**2, b + db * TIMES + 0.5 * ddb * TIMES**2
        if kind == "product":
            values.append(a * b)
            slopes.append(da * b + a * db)
            bends.append(float((dda * second + 2 * (da + dda * TIMES) * (db + ddb * TIMES) + ddb * first).abs().max()))
        else:
            sign = 1.0 if kind == "sum" else -1.0
            values.append(a + sign * b)
            slopes.append(da + sign * db)
            bends.append(abs(dda + sign * ddb))
    off = max(abs(value - float(found.value)) for value in values)
    assert off <= float(found.value_error) <= 1.01 * off
    off = max(abs(slope - float(found.slope)) for slope in slopes)
    assert off <= float(found.slope_error) <= 1.1 * off
    assert max(bends) <= float(found.bend) <= 1.5 * max(bends)
    assert float(found.half) == HALF


def test_rounding_is_part_of_the_errors() -> None:
    exact = [jet(3.0, 5.0, 0.0, 0.0, 0.0), jet(7.0, 11.0, 0.0, 0.0, 0.0)]
    eps = torch.finfo(torch.float64).eps
    for found, value, slope in ((exact[0] + exact[1], 10.0, 16.0), (exact[0] * exact[1], 21.0, 3 * 11 + 5 * 7.0)):
        assert eps * value < float(found.value_error) < 100 * eps * value
        assert eps * slope < float(found.slope_error) < 100 * eps * slope


def test_signs_that_are_sure() -> None:
    """The smallest value is 2 - .25 - (3 + .5) / 2 - 1.5 / 8 for the first: below zero."""
    assert float(FIRST.sign()) == 0.0
    for value, sign in ((2.19, 1.0), (2.18, 0.0), (-2.18, 0.0), (-2.19, -1.0)):
        assert float(jet(value, -3.0, 1.5, 0.25, 0.5).sign()) == sign
    # From -3 it rises to -3 + .5 + 1.5 / 2 at the ends.
    for slope, falls in ((-1.26, True), (-1.25, False), (1.26, False)):
        assert bool(jet(0.0, slope, 1.5, 0.0, 0.5).falls()) == falls


def test_polynomials_on_an_interval() -> None:
    """1 - 2 x + 3 x^3 from 1 to 1.5: value, slope and second derivative at the center, the last everywhere."""
    span = Span(number(1.0), number(1.5))
    found = span.polynomial([number(-2.0), number(3.0)], [1, 3], 1.0)
    x = 1.25
    assert float(found.value) == pytest.approx(1 - 2 * x + 3 * x**3, rel=1e-12)
    assert float(found.slope) == pytest.approx(-2 + 9 * x**2, rel=1e-12)
    assert float(found.half) == pytest.approx(0.25, rel=1e-8)
    # 18 x is largest at the upper end.
    assert float(found.bend) == pytest.approx(18 * 1.5, rel=1e-8)
    assert float(found.bend) > 18 * 1.5
    eps = torch.finfo(torch.float64).eps
    assert eps * 16 < float(found.value_error) < 1000 * eps * 16
    assert eps * 20 < float(found.slope_error) < 1000 * eps * 20
    nothing = span.polynomial([], [], 4.0)
    assert (float(nothing.value), float(nothing.slope), float(nothing.bend)) == (4.0, 0.0, 0.0)
