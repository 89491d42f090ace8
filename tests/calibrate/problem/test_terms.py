"""Steps along twists, barriers before folds, and priors as residuals."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from kcal.calibrate.problem.priors import FoldBarrier, GaussianPrior
from kcal.calibrate.problem.twist import apply_twist
from kcal.lens.model import LensModel
from kcal.lens.pose import rotation_from_vector


@pytest.mark.parametrize("size", [1e-7, 0.0099, 0.0101, 0.3, 3.0])
def test_a_step_is_the_exponential_of_its_twist(size: float) -> None:
    draw = torch.randn(4, 12, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    turn = size * torch.nn.functional.normalize(draw[:, :3], dim=-1)
    shift, translation, rotation = draw[:, 3:6], draw[:, 6:9], rotation_from_vector(draw[:, 9:])
    twist = torch.zeros(4, 4, 4, dtype=torch.float64)
    twist[:, :3, :3] = torch.linalg.cross(turn[:, None].expand(4, 3, 3), torch.eye(3).double().expand(4, 3, 3)).mT
    twist[:, :3, 3] = shift - torch.linalg.cross(turn, translation)
    expected = torch.linalg.matrix_exp(twist)
    moved = apply_twist(rotation, translation, torch.cat([turn, shift], -1))
    torch.testing.assert_close(moved[0], expected[:, :3, :3] @ rotation, rtol=0, atol=1e-13)
    image = (expected[:, :3, :3] @ translation[..., None])[..., 0] + expected[:, :3, 3]
    torch.testing.assert_close(moved[1], image, rtol=0, atol=1e-13)


def barrier_values(model: LensModel, radial: dict[str, float]) -> Tensor:
    names = ["fx", "fy", "cx", "cy", "skew", *model.names, "warp_x", "warp_y"]
    return torch.tensor([radial.get(name, 0.0) for name in names], dtype=torch.float64)


class TestFoldBarrier:
    MODEL = LensModel.named("opencv8")

    def test_a_regular_lens_costs_nothing(self) -> None:
        barrier = FoldBarrier(self.MODEL, 1.0, 0.1)
        assert barrier.rows(barrier_values(self.MODEL, {"k1": -0.2, "k4": 0.1})).shape == (15 + 1, 0)

    @pytest.mark.parametrize("radial", [{"k1": -0.4}, {"k4": -1.01}, {"k4": 100.0, "k1": 100.0}])
    def test_no_lens_that_folds_has_a_cost(self, radial: dict[str, float]) -> None:
        """r (1 - 0.4 r²) folds at 0.91; 1 - 1.01 r² has a pole at 0.995; the third only shapes the axis: dear."""
        rows = FoldBarrier(self.MODEL, 1.0, 0.1).rows(barrier_values(self.MODEL, radial))
        cost = float((rows[-1] ** 2).sum())
        assert cost != cost or cost > 0.01

    @pytest.mark.parametrize(
        ("name", "radial"),
        [
            ("opencv8", {"k1": -0.32}),
            ("opencv8", {"k4": -0.85}),
            ("opencv8", {"k1": 40.0, "k4": 45.0, "k5": -0.3}),
            ("opencv5", {"k1": -0.32}),
        ],
    )
    def test_derivatives(self, name: str, radial: dict[str, float]) -> None:
        model = LensModel.named(name)
        barrier, values = FoldBarrier(model, 1.0, 0.1), barrier_values(model, radial)
        rows = barrier.rows(values)
        assert float(rows[-1].abs().max()) > 0
        numeric = [
            (barrier.rows(values + 1e-7 * unit)[-1] - barrier.rows(values - 1e-7 * unit)[-1]) / 2e-7
            for unit in torch.eye(len(values), dtype=torch.float64)
        ]
        torch.testing.assert_close(rows[:-1], torch.stack(numeric), rtol=1e-5, atol=1e-6)


def test_prior_rows() -> None:
    prior = GaussianPrior(
        torch.tensor([0, 3]), torch.tensor([500.0, 1.0]).double(), torch.tensor([0.1, 2.0], dtype=torch.float64)
    )
    rows = prior.rows(torch.tensor([[510.0, 0.0, 0.0, 2.0]], dtype=torch.float64))
    assert rows[0, -1].tolist() == [1.0, 2.0]
    assert rows[0, :-1].tolist() == [[0.1, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 2.0]]
