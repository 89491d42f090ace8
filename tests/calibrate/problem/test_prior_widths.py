"""How wide priors of coefficients are, and how corners are weighted by their covariances."""

from __future__ import annotations

import math

import pytest
import torch

from kcal.calibrate.problem.board_problem import apply_twist
from kcal.calibrate.problem.parameters import CoefficientPrior, is_overparameterized
from kcal.calibrate.problem.views import whitening
from kcal.lens.camera_parameters import parameter_names
from kcal.lens.model import LensModel
from kcal.lens.pose import rotation_from_vector


@pytest.mark.parametrize("reach", [0.5, 0.8])
def test_each_coefficient_shifts_a_place_at_the_reach_by_the_width(reach: float) -> None:
    """Radial terms by r^(2 j + 1) of the radius, each by itself; assembly errors are twenty times as rare."""
    model = LensModel.named("opencv14")
    prior = CoefficientPrior(0.3, reach).term(model, noise=0.2)
    sigma = dict(
        zip([parameter_names(model)[i] for i in prior.index.tolist()], (0.2 / prior.weight).tolist(), strict=True)
    )
    for power, names in ((2, ("k1", "k4")), (4, ("k2", "k5")), (6, ("k3", "k6"))):
        for name in names:
            assert sigma[name] == pytest.approx(0.3 / reach**power), name
    least = sigma["p1"]
    assert sigma["p2"] == least
    for name, power in (("s1", 1), ("s2", 3), ("s3", 1), ("s4", 3)):
        assert sigma[name] == pytest.approx(least / reach ** (power - 1)), name
    assert sigma["tau_x"] == sigma["tau_y"] == least
    assert prior.mean.abs().max() == 0.0
    fewer = CoefficientPrior(0.3, reach).term(model, noise=0.2, without=("k1", "p2"))
    assert len(fewer.index) == len(prior.index) - 2


def test_models_with_terms_that_are_nearly_redundant() -> None:
    found = {
        name: is_overparameterized(LensModel.named(name))
        for name in ("opencv4", "opencv5", "opencv8", "opencv12", "opencv14")
    }
    assert found == {"opencv4": False, "opencv5": False, "opencv8": True, "opencv12": True, "opencv14": True}


def test_corners_are_whitened_by_their_own_covariance_and_the_rest() -> None:
    """Where residuals are larger than corners say, all get the same noise more; the mean weight is one."""
    half = torch.randn(5, 4, 2, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    covariances = 0.01 * (half @ half.mT + 0.5 * torch.eye(2))
    covariances[1, 2] = torch.nan
    seen = torch.ones(5, 4, dtype=torch.bool)
    seen[1, 2] = False
    own = float(covariances[seen].diagonal(dim1=-2, dim2=-1).mean())
    for variance, more in ((own + 0.03, 0.03), (0.5 * own, 0.0)):
        found = whitening(covariances, variance)
        assert bool(found[1, 2].isnan().all())
        information = found[seen].mT @ found[seen]
        wanted = torch.linalg.inv(covariances[seen] + more * torch.eye(2))
        scale = wanted.diagonal(dim1=-2, dim2=-1).mean()
        torch.testing.assert_close(information, wanted / scale)


@pytest.mark.parametrize("length", [0.0, 1e-3, 9e-3, 1.1e-2, 1.0, 3.0])
def test_a_twist_is_the_exponential_of_its_matrix(length: float) -> None:
    direction = torch.tensor([0.3, -0.5, math.sqrt(1 - 0.34)], dtype=torch.float64)
    step = torch.cat([length * direction, torch.tensor([0.2, 0.7, -0.4], dtype=torch.float64)])
    rotation = rotation_from_vector(torch.tensor([0.4, 0.1, -0.9]).double())
    translation = torch.tensor([1.5, -2.0, 3.0], dtype=torch.float64)
    matrix = torch.zeros(4, 4, dtype=torch.float64)
    x, y, z = (length * direction).tolist()
    matrix[:3, :3] = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    # The turn is about the camera's center, the shift is along it.
    matrix[:3, 3] = step[3:] - torch.linalg.cross(step[:3], translation)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    wanted = torch.linalg.matrix_exp(matrix) @ pose
    found = apply_twist(rotation, translation, step)
    torch.testing.assert_close(found[0], wanted[:3, :3], rtol=0, atol=1e-13)
    torch.testing.assert_close(found[1], wanted[:3, 3], rtol=0, atol=1e-12)
