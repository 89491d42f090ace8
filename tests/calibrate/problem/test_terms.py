"""Terms of the board problem, weights, and robust losses."""

import pytest
import torch
from calibrate_scenes import camera, corner_pixels, motions, observe, pixels_of
from torch import Tensor

from kcal import CalibrationOptions, Observations, calibrate_camera
from kcal.calibrate.problem.parameters import FoldBarrier, GaussianPrior, ParameterConstraints, Term
from kcal.lens import LensModel, rotation_from_vector
from kcal.lens.pose import apply_twist
from kcal.solve import RobustLoss

# Steps along twists, barriers before folds, and priors as residuals.


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


def test_constraints_hold_what_the_lens_has() -> None:
    """Fixed parameters, and ties, also of names that this lens does not have."""
    model, values = LensModel.named("opencv5"), torch.arange(10.0, dtype=torch.float64)
    held = ParameterConstraints(fixed={"cx": 7.5, "k6": 1.0}, tied=(("fx", "fy"), ("k1", "k4", "k2"), ("s1", "s2")))
    names = ["fx", "fy", "cx", "cy", "skew", *model.names]
    wanted = dict(zip(names, values.tolist(), strict=True)) | {"fx": 0.5, "fy": 0.5, "cx": 7.5, "k1": 5.5, "k2": 5.5}
    assert held.impose(values, model).tolist() == list(wanted.values())


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
        cost = float((FoldBarrier(self.MODEL, 1.0, 0.1).rows(barrier_values(self.MODEL, radial))[-1] ** 2).sum())
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


# Two of five values share an unknown, one is held.
SLOTS = torch.tensor([0, 0, -1, 2, 1])


def gaussian(batch: bool) -> GaussianPrior:
    weight = torch.tensor([[0.5, 2.0, 3.0, 0.1]] * 2, dtype=torch.float64)
    weight[1] *= 2.0
    mean = torch.tensor([1.0, -2.0, 0.5, 0.3], dtype=torch.float64)
    return GaussianPrior(torch.tensor([0, 2, 1, 3]), mean, weight if batch else weight[0])


@pytest.mark.parametrize("term", [gaussian(False), gaussian(True)], ids=["one", "batch"])
def test_cost_and_products_of_a_prior_are_those_of_its_rows(term: Term) -> None:
    """Priors have shortcuts of their own; products are added to what is there, and tied values to one unknown."""
    values = torch.tensor([[0.3, 0.4, -1.0, 2.0, 5.0], [-0.3, 0.7, 1.5, -2.0, 1.0]], dtype=torch.float64)
    residual = term.rows(values)[:, -1]
    assert float(residual.abs().min()) > 0
    torch.testing.assert_close(term.cost(values), 0.5 * residual.square().sum(-1))
    assert bool((term.cost(values) > 0).all())
    torch.testing.assert_close(Term.cost(term, values), term.cost(values))
    unknowns = torch.zeros(2, 4, term.rows(values).shape[-1], dtype=torch.float64)
    for value, slot in enumerate(SLOTS.tolist()):
        if slot >= 0:
            unknowns[:, slot] += term.rows(values)[:, value]
    unknowns[:, -1] = residual
    before = torch.arange(32.0, dtype=torch.float64).reshape(2, 4, 4)
    for add in (term.add_to, lambda *rest: Term.add_to(term, *rest)):
        total = before.clone()
        add(total, values, SLOTS)
        torch.testing.assert_close(total, before + unknowns @ unknowns.mT, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("radial", [{"k1": -0.32}, {"k1": 40.0, "k4": 45.0, "k5": -0.3}, {"k1": -0.2}])
def test_cost_and_products_of_a_barrier_are_those_of_its_rows(radial: dict[str, float]) -> None:
    model = LensModel.named("opencv8")
    barrier, values = FoldBarrier(model, 1.0, 0.1), barrier_values(model, radial)
    rows = barrier.rows(values)
    assert float(barrier.cost(values)) == pytest.approx(0.5 * float(rows[-1].square().sum()))
    slots = torch.arange(len(values)) - 2
    total = torch.ones(len(values) - 1, len(values) - 1, dtype=torch.float64)
    barrier.add_to(total, values, slots.clamp_min(-1))
    free = torch.cat([rows[2:-1], rows[-1:]])
    torch.testing.assert_close(total, 1.0 + free @ free.mT, rtol=1e-12, atol=1e-12)


def test_a_barrier_counts_in_proportion_to_its_weight_and_grows_towards_the_fold() -> None:
    model = LensModel.named("opencv8")

    def cost(k1: float, weight: float = 0.1, radius: float = 1.0) -> float:
        return float(FoldBarrier(model, radius, weight).cost(barrier_values(model, {"k1": k1})))

    # q = 1 + 2 k1 r² / (1 + k1 r²) is least at r = 1, where it reaches the bound of 0.1 at k1 = -0.9 / 2.9.
    assert cost(-0.310) == 0.0
    assert 0.0 < cost(-0.311) < cost(-0.32) < cost(-0.33)
    assert cost(-0.32, weight=0.3) == pytest.approx(9.0 * cost(-0.32))
    # A lens is regular or not within a radius: k1 r² decides.
    assert cost(-0.32 / 4.0, radius=2.0) == pytest.approx(cost(-0.32))
    q = 1.0 + 2.0 * -0.32 / (1.0 - 0.32)
    rows = FoldBarrier(model, 1.0, 0.1).rows(barrier_values(model, {"k1": -0.32}))
    assert float(rows[-1].max()) == pytest.approx(0.1 * torch.log(torch.tensor(0.1 / q)).item(), rel=1e-5)


# Robust losses, and weights.


KINDS = ("huber", "cauchy", "tukey")


@pytest.mark.parametrize("kind", KINDS)
def test_wrong_corners_hardly_matter(kind: str) -> None:
    """Two of a hundred corners are 15 px off: plain least squares is thrown off ten times as far."""
    truth = camera()
    pixels = pixels_of(truth, motions(truth, 12, 5), noise=0.1, seed=2)
    clean = calibrate_camera(observe(pixels), CalibrationOptions(model="opencv5")).camera.params
    wrong = torch.rand(pixels.shape[:2], generator=torch.Generator().manual_seed(3)) < 0.02
    pixels[wrong] += torch.where(pixels[wrong] < 460.0, 15.0, -15.0)  # within the image
    spoilt = calibrate_camera(observe(pixels), CalibrationOptions(model="opencv5")).camera.params
    result = calibrate_camera(
        observe(pixels), CalibrationOptions(model="opencv5", loss=RobustLoss(kind=kind, scale=0.4))
    )
    assert float((result.camera.params - clean)[:4].norm()) < 0.1 * float((spoilt - clean)[:4].norm())
    assert result.weighted_rms is not None
    assert result.weighted_rms < 0.5 * result.rms


def with_covariance(seen, sigma):
    """The observations with a covariance of sigma² (V,) for each view's corners."""
    views = []
    for view, value in zip(seen.views, sigma.tolist(), strict=True):
        spread = tuple(None if pixel is None else (value**2, 0.0, value**2) for pixel in view.pixels)
        views.append(view.model_copy(update={"covariance": spread}))
    return Observations.model_validate(seen.model_copy(update={"views": tuple(views)}).model_dump())


def mixed(seed):
    """Views of which every second one is ten times as blurred, and what is known about that."""
    truth = camera()
    poses = motions(truth, 12, seed)
    sigma = torch.where(torch.arange(12) % 2 == 0, 0.02, 0.3).double()
    exact = pixels_of(truth, poses)
    noise = torch.randn(exact.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return truth, with_covariance(observe(exact + sigma[:, None, None] * noise), sigma)


def test_equal_covariances_change_nothing():
    seen = observe(corner_pixels(6, 1, noise=0.1))
    plain = calibrate_camera(seen, CalibrationOptions(model="opencv5"))
    weighted = calibrate_camera(with_covariance(seen, torch.full((6,), 0.05)), CalibrationOptions(model="opencv5"))
    # Both stop at a minimum found to 1e-12 of its cost, which is flat: parameters to 1e-6 of their σ.
    torch.testing.assert_close(weighted.camera.params, plain.camera.params, rtol=1e-6, atol=1e-6)
    assert weighted.rms == pytest.approx(plain.rms, rel=1e-12)
    assert weighted.weighted_rms == pytest.approx(plain.rms, rel=1e-9)
    assert plain.weighted_rms is None


def test_weights_beat_no_weights_and_know_their_error():
    error = {True: [], False: []}
    pull = []
    for seed in range(4):
        truth, seen = mixed(seed)
        for weighted in (True, False):
            result = calibrate_camera(seen, CalibrationOptions(model="opencv5", weighted=weighted))
            away = result.camera.params[:4] - truth.params[:4]
            error[weighted].append(away)
            if weighted:
                pull.append(away / torch.tensor([result.sigma[name] for name in ("fx", "fy", "cx", "cy")]))
                # The plain RMS stays OpenCV's: 0.3 px in half of the views, two axes.
                assert result.rms == pytest.approx(0.3, rel=0.15)
                assert result.weighted_rms < 0.5 * result.rms
    good, bad = (torch.stack(error[key]).square().mean().sqrt() for key in (True, False))
    assert float(good) < 0.4 * float(bad)
    # 16 numbers, of which four at a time depend on each other.
    assert 0.4 < float(torch.stack(pull).square().mean().sqrt()) < 1.8
