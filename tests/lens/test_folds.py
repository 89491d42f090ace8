"""No pixel has two valid rays, also where a fold is too narrow to be seen by sampling."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from kcal.lens.camera import Camera
from kcal.lens.model import HybridForm, LensModel
from kcal.lens.region import Jet, Span, direction_limits, in_region, valid_region
from scripts.check import folds
from scripts.check.uncertainty import LENS
from scripts.shared.distorted import distort
from tests.helpers.lenses import MODELS, strong
from tests.lens.test_whole_region import BENT

NARROW = [-3.99999958, 3.99999958, 0, 0, 0, -3.9999996, 3.9999996, 0]

# Strongly tilted and decentered.
CUSP = [
    0.4906688414378017, 0.6196398857144331, -0.03566072384144904, -0.8170457463408914, 0.28638828387970944,
    -0.10748996625727007, -0.34266925372018825, 0.5654486645213991, 0.7754243240635172, -0.4821760661559888,
    0.21348189927875633, 0.3613066779086383, -1.3398265686041242, 0.36778917746958295,
]  # fmt: skip


def along_x(camera: Camera, x: Tensor) -> tuple[Tensor, Tensor]:
    """Columns of the pixels of points (x, 0, 1), and which are valid."""
    zero = torch.zeros_like(x)
    pixels, valid = camera.project(torch.stack([x, zero, zero + 1], -1))
    return pixels[:, 0], valid


class TestRadialFolds:
    def test_a_fold_of_two_ten_thousandths(self) -> None:
        camera = Camera.build(
            focal=(1000, 1000), center=(959.5, 539.5), size=(1920, 1080), model="opencv8", coefficients=NARROW
        )
        _, valid = along_x(camera, torch.tensor([0.70711, 0.74244], dtype=torch.float64))
        assert not bool(valid.all())
        columns, valid = along_x(camera, torch.linspace(0.0, 1.0, 200_001, dtype=torch.float64))
        assert bool((columns[valid].diff() > 0).all())
        # The fold begins at 0.70706; up to there nothing is lost.
        assert bool(valid[:141_200].all())

    def test_the_same_lens_without_other_terms(self) -> None:
        model = LensModel(numerator=3, denominator=3)
        lens = torch.tensor(NARROW, dtype=torch.float64)[[0, 1, 4, 5, 6, 7]]
        assert float(valid_region(lens, model).radius) == pytest.approx(0.7071, abs=1e-4)

    @settings(deadline=None, max_examples=10)
    @given(
        root=st.floats(0.2, 1.2),
        tiny=st.floats(-10, -3),
        weights=st.tuples(*[st.floats(0.1, 2.0)] * 4),
        radial=st.booleans(),
    )
    def test_terms_that_nearly_cancel(self, root: float, tiny: float, weights: tuple[float, ...], radial: bool) -> None:
        double = np.array([1.0, -2.0 / root**2, 1.0 / root**4])
        numerator, denominator = (double + 10.0**tiny * np.array([0.0, *pair]) for pair in (weights[:2], weights[2:]))
        model = LensModel(numerator=2, denominator=2, tangential=not radial)
        lens = torch.zeros(model.size, dtype=torch.float64)
        lens[list(model.numerator_index)] = torch.from_numpy(numerator[1:])
        lens[list(model.denominator_index)] = torch.from_numpy(denominator[1:])
        camera = Camera(torch.cat([torch.tensor([1000.0, 1000, 0, 0, 0]).double(), lens]), size=(100, 100), model=model)
        width = 10.0 ** (0.5 * tiny)
        offsets = torch.linspace(-40, 40, 4001, dtype=torch.float64) * width * root
        x = torch.cat([torch.linspace(0.0, 2.0, 2001, dtype=torch.float64), root + offsets]).clamp(min=0).unique()
        columns, valid = along_x(camera, x)
        # Where the denominator nearly vanishes, the formula itself rounds so much, in pixels.
        assert bool((columns[valid].diff() > -1e-11 / 10.0**tiny).all())
        assert bool(valid[: int((x < 0.5 * root).sum())].all())


class TestOtherTerms:
    @pytest.mark.slow
    def test_constructed_lenses(self) -> None:
        """A small run of scripts/check/folds.py."""
        generator, unproven, found = np.random.default_rng(5), 0, 0
        for _ in range(16):
            lens = folds.construct(generator)
            unproven += folds.two_rays(lens, folds.sampled(lens), np.random.default_rng(0)) is not None
            region = valid_region(lens.coefficients, lens.model)
            found += folds.two_rays(lens, region, np.random.default_rng(0)) is not None
        assert unproven >= 2
        assert found == 0

    def test_behind_the_end_of_a_fold(self) -> None:
        """Where a fold ends in the plane, points behind it are cut out, and points beside it stay."""
        region = valid_region(torch.tensor(BENT, dtype=torch.float64), "opencv14")
        assert region.cuts.shape == (2, 4)
        for cut in region.cuts:
            angle, half = torch.atan2(cut[1], cut[0]), torch.acos(cut[2])
            angle = angle + half * torch.tensor([0.0, 0.0, 0.99, -0.99, 1.01, -1.01], dtype=torch.float64)
            reach = cut[3] * torch.tensor([0.999, *[1.001] * 5], dtype=torch.float64)
            before, *cut_out, left, right = region.encloses(reach * torch.cos(angle), reach * torch.sin(angle)).tolist()
            assert before
            assert not any(cut_out)
            # On one side, the edge of the region is nearer.
            assert left or right

    def test_a_plane_that_is_wound_twice_around_the_axis(self) -> None:
        """In complex numbers the lens is z + z² / 2: regular but at z = -1, and the same at z and -2 - z."""
        lens = torch.zeros(12, dtype=torch.float64)
        lens[3], lens[8] = 0.5, -1.0
        camera = Camera(
            torch.cat([torch.tensor([1000.0, 1000.0, 0.0, 0.0, 0.0]).double(), lens]), size=(100, 100), model="opencv12"
        )
        points = torch.tensor([[-0.3, 0.2, 1.0], [-1.7, -0.2, 1.0]], dtype=torch.float64)
        normalized = distort(points[:, :2], lens, "opencv12")
        torch.testing.assert_close(normalized[0], normalized[1], rtol=0, atol=1e-15)
        assert camera.project(points)[1].tolist() == [True, False]

    def test_a_cusp_between_two_of_64_directions(self) -> None:
        """The edge of the region goes back and forth within 2°; the lens was found by scripts/check/folds.py."""
        lens = torch.tensor(CUSP, dtype=torch.float64)
        points = torch.tensor([[0.41027282959, -0.09644074454], [0.46236123257, -0.14250184100]], dtype=torch.float64)
        normalized = distort(points, lens, "opencv14")
        torch.testing.assert_close(normalized[0], normalized[1], rtol=0, atol=1e-9)
        valid = in_region(*points.T, lens, LensModel.named("opencv14"), valid_region(lens, "opencv14"))
        assert not bool(valid.all())

    def test_several_lenses_are_judged_each_on_its_own(self) -> None:
        lenses = torch.stack([strong("opencv14"), torch.tensor(BENT, dtype=torch.float64), torch.zeros(14).double()])
        for lens, *own in zip(lenses, *valid_region(lenses, "opencv14"), strict=True):
            alone = valid_region(lens, "opencv14")
            assert torch.equal(alone.radius, own[0])
            assert torch.equal(alone.edge, own[1])
            assert torch.equal(alone.cuts, own[2][: len(alone.cuts)])
            assert bool(torch.isinf(own[2][len(alone.cuts) :, 3]).all())


def test_a_fold_between_every_third_step() -> None:
    """Of a hybrid lens every third is looked at first: there the determinant is .06, and here it is -2e-4."""
    model = LensModel(hybrid=HybridForm(shape=0.5, radius=0.9))
    lens = torch.zeros(model.size, dtype=torch.float64)
    lens[model.names.index("z31+1")] = 2.32596e-3
    assert float(direction_limits(lens, model, 4).max()) == pytest.approx(0.9 * 0.9869, abs=1e-4)
    assert direction_limits(0.5 * lens, model, 4).tolist() == pytest.approx([0.9] * 4, abs=1e-14)


@pytest.mark.parametrize("name", [*MODELS, "pinhole", "fisheye4"])
def test_ordinary_lenses_lose_nothing(name: str) -> None:
    model = LensModel.named(name)
    lenses = [torch.zeros(model.size, dtype=torch.float64), strong(model) * (0.1 if model.fisheye else 1.0)]
    if model.size <= len(LENS) and not model.fisheye:
        lenses.append(torch.tensor(LENS[: model.size], dtype=torch.float64))
    for lens in lenses:
        region, unproven = valid_region(lens, model), folds.sampled(folds.Lens("", model, lens))
        assert all(torch.equal(a, b) for a, b in zip(region, unproven, strict=True))


class TestJets:
    def test_nothing_is_proven_within_rounding(self) -> None:
        low = torch.tensor([1.0 - 1e-9], dtype=torch.float64)
        one = torch.ones_like(low)
        # (1 - x²)², whose double root at 1 rounding can turn into none or two.
        jet: Jet = Span(low, low + 2e-9).polynomial([-2.0 * one, one], [2, 4], constant=1.0)
        assert jet.sign().tolist() == [0.0]

    def test_a_small_value_is_proven(self) -> None:
        low = torch.tensor([1.0 - 1e-7], dtype=torch.float64)
        one = torch.ones_like(low)
        jet = Span(low, low + 2e-7).polynomial([(-2.0 + 1e-12) * one, one], [2, 4], constant=1.0)
        assert jet.sign().tolist() == [1.0]
        assert math.isclose(float(jet.value), 1e-12, rel_tol=1e-2)
