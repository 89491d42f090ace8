"""`ExtendedDistortion`: the formulas of OpenCV and kornia, derivatives, an inverse that knows where there is none."""

from __future__ import annotations

import copy
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

MODELS = ["opencv4", "opencv5", "opencv8", "opencv12", "opencv14", "ext16", "ext18", "ext20", "ext22", "ext24"]


def of_model(model: str) -> ExtendedDistortion:
    """With every coefficient different from zero."""
    names = PRESETS[model].names
    return ExtendedDistortion([LENS.get(name, 1e-3) for name in names], model)


def points(count: int = 40, reach: float = 0.6) -> Tensor:
    generator = torch.Generator().manual_seed(3)
    return reach * (2.0 * torch.rand(count, 2, generator=generator, dtype=torch.float64) - 1.0)


@pytest.mark.parametrize("model", MODELS[:5])
def test_it_is_the_distortion_of_opencv_and_kornia(model: str) -> None:
    distortion, here = of_model(model), points()
    found, valid = distortion(here)
    assert bool(valid.all())
    rays = np.concatenate([here.numpy(), np.ones((len(here), 1))], 1)
    coefficients = distortion.coefficients.numpy()
    wanted, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), coefficients)
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
