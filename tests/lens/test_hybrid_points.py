"""Many points of a hybrid camera at once: polynomials agree with the formulas, and stand back where they must."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest
import torch
from lenses import FEW_MODES, KINDS, hybrid_camera
from torch import Tensor
from whole_graphs import traced_whole

from kcal.lens.camera import Camera
from kcal.lens.hybrid_points import FEWEST, PIECE, Forward, fit_plane_map, polynomials_of, trim
from kcal.lens.hybrid_terms import HybridForm
from kcal.lens.model import LensModel
from kcal.lens.zernike import ZernikeModes

COUNT = PIECE + 1000


def random_pixels(camera: Camera, count: int = COUNT, beyond: float = 0.0) -> Tensor:
    """Pixels all over the image, and as far beyond it as `beyond` of its size."""
    generator = torch.Generator().manual_seed(5)
    share = torch.rand(count, 2, generator=generator, dtype=torch.float64)
    return ((1.0 + 2.0 * beyond) * share - beyond) * torch.tensor(camera.size) - 0.5


def random_points(camera: Camera, nearest: float = 0.8, count: int = COUNT) -> Tensor:
    """Points seen all over the image, from `nearest` meters to some hundred."""
    rays, _ = camera._unproject_by_formulas(random_pixels(camera, count))
    generator = torch.Generator().manual_seed(6)
    return camera.ray_origins(rays) + rays * nearest * torch.exp(
        6.0 * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    )


def polynomials(camera: Camera) -> Forward:
    found = camera._fitted.forward(camera.params.detach(), camera.model, camera.valid_region)
    assert found is not None
    return found


def distance(a: Tensor, b: Tensor) -> float:
    return float((a - b).abs().max())


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("kind", KINDS)
class TestAgree:
    def test_project(self, kind: str, seed: int) -> None:
        camera = hybrid_camera(kind, seed)
        points = random_points(camera)
        pixels, valid = camera.project(points)
        own, known = camera._project_by_formulas(points)
        assert torch.equal(valid, known)
        assert bool(valid.all())
        assert 0.0 < distance(pixels, own) < 1e-9
        # All points by polynomials, none by the formulas.
        fitted = polynomials(camera)
        assert fitted(points, torch.empty(fitted.rows, COUNT).double())[1] is None

    def test_unproject(self, kind: str, seed: int) -> None:
        camera = hybrid_camera(kind, seed)
        pixels = random_pixels(camera)
        rays, valid = camera.unproject(pixels)
        own, known = camera._unproject_by_formulas(pixels)
        assert torch.equal(valid, known)
        assert bool(valid.all())
        assert 0.0 < distance(rays, own) * float(camera.focal.max()) < 1e-9
        torch.testing.assert_close(rays.norm(dim=-1), torch.ones(COUNT).double(), rtol=0, atol=1e-15)
        assert distance(camera.project_rays(rays)[0], pixels) < 1e-9
        fitted = camera._fitted._backward
        assert fitted is not None
        assert fitted(pixels, torch.empty(fitted.rows, COUNT).double())[1] is None


class TestStandBack:
    @pytest.mark.parametrize("kind", KINDS)
    def test_masks_and_values_everywhere(self, kind: str) -> None:
        """Beyond the image and the disc, behind the camera, near it, at infinity and without a number."""
        camera = hybrid_camera(kind)
        generator = torch.Generator().manual_seed(7)
        points = torch.randn(FEWEST, 3, generator=generator, dtype=torch.float64)
        points *= torch.exp(4.0 * torch.randn(FEWEST, 1, generator=generator, dtype=torch.float64))
        special = [math.nan, math.inf, -math.inf, 0.0, 1e-300, 1e200, -1e200, 1e-5]
        points[: len(special) ** 3] = torch.cartesian_prod(*[torch.tensor(special).double()] * 3)
        pixels, valid = camera.project(points)
        own, known = camera._project_by_formulas(points)
        assert torch.equal(valid, known)
        assert 0.02 < float(valid.double().mean()) < 0.9
        assert distance(pixels, own) < 1e-9
        assert torch.equal(pixels[~valid], camera.center.expand_as(pixels[~valid]))

        pixels = random_pixels(camera, FEWEST, beyond=0.1)
        pixels[:64] = torch.cartesian_prod(*[torch.tensor(special).double()] * 2)
        rays, valid = camera.unproject(pixels)
        own, known = camera._unproject_by_formulas(pixels)
        assert torch.equal(valid, known)
        assert 100 < int((~valid).sum()) < 0.5 * FEWEST
        assert distance(rays, own) * float(camera.focal.max()) < 1e-9

    def test_a_lens_that_folds(self) -> None:
        form = HybridForm(shape=1.0, radius=1.0, modes=ZernikeModes(radial=5, decentered=2, astigmatic=1, other=0))
        lens = [-0.12 if name == "z5+1" else 0.0 for name in form.names]
        camera = Camera.build(
            focal=(500, 510), center=(400, 300), size=(801, 601), skew=0.7, coefficients=lens,
            model=LensModel(hybrid=form),
        )  # fmt: skip
        points = torch.randn(FEWEST, 3, generator=torch.Generator().manual_seed(8), dtype=torch.float64)
        pixels, valid = camera.project(points)
        own, known = camera._project_by_formulas(points)
        assert torch.equal(valid, known)
        assert distance(pixels, own) < 1e-9
        pixels = random_pixels(camera, FEWEST)
        rays, valid = camera.unproject(pixels)
        own, known = camera._unproject_by_formulas(pixels)
        assert torch.equal(valid, known)
        assert distance(rays, own) * 510 < 1e-9

    def test_lenses_for_which_polynomials_will_not_do(self) -> None:
        """A pinhole to 86°, and a fisheye to 179°: none are fitted."""
        for shape in (1.0, 0.0):
            model = LensModel(hybrid=HybridForm(shape=shape, radius=1e3, modes=FEW_MODES))
            camera = Camera.build(focal=(500, 500), center=(400, 300), size=(801, 601), model=model)
            pixels = random_pixels(camera)
            assert camera._fitted.forward(camera.params.detach(), model, camera.valid_region) is None
            rays, valid = camera.unproject(pixels)
            assert bool(valid.all())
            assert distance(camera.project(rays)[0], pixels) < 1e-9

    def test_changed_parameters_are_noticed(self) -> None:
        camera = hybrid_camera("webcam", modes=FEW_MODES)
        points = random_points(camera)
        before, _ = camera.project(points)
        camera.unproject(before)
        copied = copy.deepcopy(camera)
        camera.params.data[9] += 1e-3
        camera.params.data[4] = 0.8  # skew
        after, _ = camera.project(points)
        assert polynomials(camera).intrinsics[4] == 0.8
        assert distance(after, before) > 0.1
        assert distance(after, camera._project_by_formulas(points)[0]) < 1e-9
        rays, _ = camera.unproject(before)
        assert camera._fitted._backward is not None
        assert distance(rays, camera._unproject_by_formulas(before)[0]) < 1e-12
        assert torch.equal(copied.project(points)[0], before)

    def test_few_points_batches_and_other_cameras_have_none(self) -> None:
        camera = hybrid_camera("webcam", modes=FEW_MODES)
        camera.project(random_points(camera, count=FEWEST - 1))
        batch = camera.with_parameters(torch.stack([camera.params, camera.params]))
        batch.project(random_points(camera))
        assert camera._fitted._key is None
        assert batch._fitted._key is None

    def test_shapes_strides_and_precision(self) -> None:
        camera = hybrid_camera("wide", modes=FEW_MODES)
        points = random_points(camera, count=2 * 3 * 5000)
        flat, _ = camera.project(points)
        pixels, valid = camera.project(points.reshape(2, 3, 5000, 3))
        assert torch.equal(pixels.flatten(0, 2), flat)
        assert valid.shape == (2, 3, 5000)
        assert torch.equal(camera.project(points.T.contiguous().T)[0], flat)
        kept = points.clone()
        assert camera.unproject(flat.float())[0].dtype == torch.float64
        assert torch.equal(points, kept)
        normalized, _ = camera.normalize(flat)
        rays, _ = camera.unproject(flat)
        ahead = rays[:, 2] > 0.1
        assert distance(normalized[ahead] * rays[ahead, 2:], rays[ahead, :2]) < 1e-13


class TestDerivatives:
    """Derivatives come from the formulas, and values beside them agree with the polynomials."""

    def test_reverse(self) -> None:
        camera = hybrid_camera("webcam", modes=FEW_MODES)
        points = random_points(camera, count=FEWEST)
        plain, _ = camera.project(points)
        leaf = points.clone().requires_grad_(True)
        pixels, _ = camera.project(leaf)
        assert pixels.requires_grad
        assert distance(pixels.detach(), plain) < 1e-9
        freed = copy.deepcopy(camera).free()
        freed.unproject(plain)[0].sum().backward()
        assert freed.params.grad is not None
        with torch.no_grad():
            assert torch.equal(freed.project(leaf)[0], plain)
            assert torch.equal(freed.unproject(plain)[0], camera.unproject(plain)[0])

    def test_function_transforms(self) -> None:
        camera = hybrid_camera("webcam", modes=FEW_MODES)
        points = random_points(camera, count=FEWEST)
        plain, _ = camera.project(points)
        step = torch.ones_like(points)
        value, slope = torch.func.jvp(lambda p: camera.project(p)[0], (points,), (step,))
        assert distance(value, plain) < 1e-9
        ahead, behind = (camera.project(points + h * step)[0] for h in (1e-6, -1e-6))
        assert distance((ahead - behind) / 2e-6, slope) < 1e-3
        reverse = torch.func.grad(lambda p: camera.project(p)[0].sum())(points)
        assert distance((reverse * step).sum(-1), slope.sum(-1)) < 1e-9 * float(slope.abs().max())
        mapped = torch.func.vmap(lambda p: camera.project(p)[0])(torch.stack([points, points]))
        assert distance(mapped[1], plain) < 1e-9

    @traced_whole
    def test_compiled(self) -> None:
        camera = hybrid_camera("webcam", modes=FEW_MODES)
        points = random_points(camera, count=FEWEST)
        plain, _ = camera.project(points)
        pixels, valid = torch.compile(camera, fullgraph=True, backend="eager")(points)
        assert bool(valid.all())
        assert distance(pixels, plain) < 1e-9


class TestPolynomials:
    def test_what_is_left_out_stays_below_the_bound(self) -> None:
        series = np.array([1.0, -0.5, 1e-3, 3e-6, -4e-6, 2e-6])
        assert len(trim(series, 6.5e-6)) == 4
        assert len(trim(series, 5.5e-6)) == 5
        assert len(trim(series, 2.0)) == 0
        t = np.linspace(-1, 1, 999)
        whole = np.polynomial.chebyshev.chebval(t, series)
        short = np.polynomial.chebyshev.chebval(t, trim(series, 6.5e-6))
        assert float(np.abs(whole - short).max()) < 6.5e-6

    def test_several_at_once(self) -> None:
        series = [np.array([0.3]), np.array([]), np.array([1.0, 2.0, -0.5, 0.25]), np.array([0.0, 1.0])]
        t = torch.linspace(-1, 1, 7, dtype=torch.float64)
        found = polynomials_of(series)(t, torch.full((4, 7), torch.nan, dtype=torch.float64))
        for own, each in zip(found, series, strict=True):
            expected = np.polynomial.chebyshev.chebval(t.numpy(), each) if len(each) else np.zeros(7)
            torch.testing.assert_close(own, torch.from_numpy(expected + np.zeros(7)), rtol=0, atol=1e-15)

    def test_a_map_that_is_a_polynomial_is_found(self) -> None:
        """Every kind of term: radial, swirl, decentering, and turns of both signs."""

        def exact(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
            z, s = torch.complex(x, y), x * x + y * y
            w = z * (1.1 - 0.2 * s**3) + 0.1j * z * s + (0.03 - 0.02j) * s**2 + (0.05 + 0.01j) * z**2 * s
            w = w + (0.02 + 0.03j) * z**5 * s + 0.01 * z.conj() ** 4 - 0.04j * z.conj() * s**2
            return w.real, w.imag

        degrees = {1: 9, 0: 6, 2: 6, 5: 7, -4: 6, -1: 7, 3: 5}
        fitted = fit_plane_map(exact, degrees, 1e-13)
        assert fitted.matrix.shape == (16, 8)
        x, y = 0.7 * (2.0 * torch.rand(2, 500, generator=torch.Generator().manual_seed(9), dtype=torch.float64) - 1.0)
        u, v, square = fitted(x, y, torch.empty(fitted.rows, 500, dtype=torch.float64))
        torch.testing.assert_close(torch.stack([u, v]), torch.stack(exact(x, y)), rtol=0, atol=1e-13)
        torch.testing.assert_close(square, x * x + y * y)
