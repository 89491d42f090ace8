"""The default lens and its points."""

import copy
import math

import numpy as np
import pytest
import torch
from lenses import FEW_MODES, HYBRID, KINDS, hybrid_camera, parameters, strong
from torch import Tensor
from torch.autograd import gradgradcheck
from torch.func import functional_call

from kcal import Camera, InputError
from kcal.lens import LensModel, bake
from kcal.lens.hybrid_points import FEWEST, PIECE, Forward, fit_plane_map, polynomials_of, trim
from kcal.lens.model import HybridForm, distort_components, growth_by_shape, largest_base_radius
from kcal.lens.projection import plane_from_points, project_components, rays_from_plane
from kcal.lens.views import source_pixels
from kcal.lens.zernike import ZernikeModes

# The hybrid lens: its base projection, where its rays start, its disc and folds, round trips, and its state.


SMALL = ZernikeModes(radial=5, decentered=2, astigmatic=1, other=0)


def plain(base: float, radius: float = 1.0, **coefficients: float) -> Camera:
    """A camera with a hybrid lens whose coefficients are zero except some."""
    model = LensModel(hybrid=HybridForm(shape=base, radius=radius, modes=SMALL))
    values = [coefficients.get(name, 0.0) for name in model.names]
    return Camera.build(focal=(500, 500), center=(400, 300), size=(801, 601), coefficients=values, model=model)


def directions(angles: Tensor, count: int = 9) -> Tensor:
    """Unit vectors at angles (radians) off the axis, at `count` azimuths each."""
    azimuth = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    theta, azimuth = (value.flatten() for value in torch.meshgrid(angles, azimuth, indexing="ij"))
    return torch.stack([theta.sin() * azimuth.cos(), theta.sin() * azimuth.sin(), theta.cos()], -1)


class TestBaseMap:
    @pytest.mark.parametrize(
        ("shape", "radius"),
        [
            (1.0, torch.tan),
            (0.25, lambda theta: 2 * torch.tan(theta / 2)),
            (0.0, lambda theta: theta),
            (-0.5, lambda theta: torch.tanh(theta * math.sqrt(0.5)) / math.sqrt(0.5)),
            (1e-3, lambda theta: torch.tan(theta * math.sqrt(1e-3)) / math.sqrt(1e-3)),
        ],
    )
    def test_radius_by_angle(self, shape, radius) -> None:
        theta = torch.cat([torch.tensor([0.0, 1e-9]), torch.linspace(0.01, 1.3, 40)]).double()
        rays = directions(theta, 1)
        model = LensModel(hybrid=HybridForm(shape=shape, radius=1.3 * float(radius(theta[-1])), modes=SMALL))
        x, y = plane_from_points(*(5.0 * rays).unbind(-1), model)
        torch.testing.assert_close(x, radius(theta), rtol=1e-14, atol=0)
        assert float(y.abs().max()) == 0.0
        torch.testing.assert_close(torch.stack(rays_from_plane(x, y, model), -1), rays, rtol=0, atol=1e-15)

    def test_zero_coefficients_are_the_base_alone(self) -> None:
        rays = directions(torch.linspace(0.0, 0.7, 9).double())
        for shape, other in ((1.0, "pinhole"), (0.0, "fisheye4")):
            same = Camera(
                torch.cat([plain(shape).params[:5], torch.zeros(LensModel.named(other).size).double()]),
                size=(801, 601),
                model=other,
            )
            torch.testing.assert_close(plain(shape).project(rays)[0], same.project(rays)[0], rtol=0, atol=1e-12)

    def test_shape_coefficient_changes_the_shape(self) -> None:
        """To first order, δ is a change of s: halving the step quarters what is left."""
        rays = directions(torch.linspace(0.0, 0.7, 9).double())
        left = []
        for step in (2e-3, 1e-3):
            bent = plain(0.6, shape=step).project(rays)[0]
            left.append(float((bent - plain(0.6 + step).project(rays)[0]).abs().max()))
        assert left[0] < 1e-3
        assert 3.9 < left[0] / left[1] < 4.1

    @pytest.mark.parametrize("u", [-0.9, -0.021, -0.019, 0.0, 0.019, 0.021, 3.0])
    def test_growth_is_continuous_and_has_the_right_slope(self, u: float) -> None:
        at = torch.tensor(u, dtype=torch.float64)
        step = 1e-5
        value, slope = growth_by_shape(at)
        near = (growth_by_shape(at + step)[0] - growth_by_shape(at - step)[0]) / (2 * step)
        torch.testing.assert_close(slope, near, rtol=1e-7, atol=1e-10)
        angle = math.sqrt(abs(u)) if u else 0.0
        exact = ((math.atan(angle) if u > 0 else math.atanh(angle)) / angle * (1 + u) - 1) / (2 * u) if u else 1 / 3
        torch.testing.assert_close(float(value), exact, rtol=1e-12, atol=0)

    def test_largest_radius(self) -> None:
        """What the projection cannot reach is no part of the lens, however large its disc is."""
        for shape in (1.0, 0.3, 0.0, -0.4):
            assert HybridForm(shape=shape, radius=1e3, modes=SMALL).reach == largest_base_radius(shape)
            camera = plain(shape, 1e3)
            rays = directions(torch.linspace(0.01, 3.14, 400).double(), 2)
            pixels, valid = camera.project(rays)
            assert 0 < int(valid.sum()) < len(valid)
            back, found = camera.unproject(pixels[valid])
            assert bool(found.all())
            torch.testing.assert_close(back, rays[valid], rtol=0, atol=1e-9)


class TestPupil:
    @pytest.mark.parametrize("kind", KINDS)
    def test_all_points_of_a_ray_have_its_pixel(self, kind: str) -> None:
        camera = hybrid_camera(kind, modes=FEW_MODES)
        pixels = camera.grid(9, 7).flatten(0, 1)
        rays, valid = camera.unproject(pixels)
        origins = camera.ray_origins(rays)
        assert bool(valid.all())
        assert 1e-4 < float(origins[:, 2].max()) < 0.01
        assert float(origins[:, :2].abs().max()) == 0.0
        for distance in (0.05, 0.1, 0.5, 1.0, 7.0, 5000.0, 1e9):
            again, seen = camera.project(origins + distance * rays)
            assert bool(seen.all())
            torch.testing.assert_close(again, pixels, rtol=0, atol=1e-9)

    def test_distance_counts_but_not_at_infinity(self) -> None:
        near, far = plain(0.5, pupil1=3e-3), plain(0.5)
        rays = directions(torch.tensor([0.5]).double())
        difference = near.project(rays)[0] - far.project(rays)[0]
        # The ray starts 3 mm · 0.25 farther ahead: at 1 m the angle grows by 0.75 mm · sin 0.5.
        slope = 500 * (1 + 0.5 * math.tan(math.sqrt(0.5) * 0.5) ** 2 / 0.5)
        torch.testing.assert_close(
            torch.linalg.vector_norm(difference, dim=-1),
            torch.full((9,), 0.75e-3 * math.sin(0.5) * slope, dtype=torch.float64),
            rtol=0.01,
            atol=0,
        )
        torch.testing.assert_close(near.project_rays(rays)[0], far.project_rays(rays)[0], rtol=0, atol=1e-9)
        torch.testing.assert_close(near.project(rays * 1e9)[0], far.project(rays * 1e9)[0], rtol=0, atol=1e-8)

    def test_other_cameras_start_at_the_origin(self) -> None:
        camera = Camera.build(focal=(500, 500), center=(400, 300), size=(801, 601), coefficients=[-0.1])
        rays = directions(torch.tensor([0.1, 0.4]).double())
        assert torch.equal(camera.ray_origins(rays), torch.zeros_like(rays))
        assert torch.equal(camera.project_rays(rays)[0], camera.project(rays)[0])

    def test_too_close_is_not_valid_or_right(self) -> None:
        """Among points as close as the pupil moves, rays intersect; what is called valid lies on its ray."""
        camera = plain(0.2, 3.0, pupil1=0.05)
        points = directions(torch.linspace(0.05, 1.4, 30).double(), 3)
        points = torch.cat([points * distance for distance in (0.003, 0.01, 0.03, 0.1, 0.3)])
        pixels, valid = camera.project(points)
        assert bool((~valid).any())
        assert int(valid.sum()) > 120
        rays, _ = camera.unproject(pixels[valid])
        arm = points[valid] - camera.ray_origins(rays)
        torch.testing.assert_close(torch.nn.functional.normalize(arm, dim=-1), rays, rtol=0, atol=1e-7)

    def test_origins_carry_gradients(self) -> None:
        camera = plain(0.5, pupil1=3e-3).free("pupil1", "pupil2")
        assert camera.free_names == ("pupil1", "pupil2")
        camera.ray_origins(directions(torch.tensor([0.5]).double(), 2))[:, 2].sum().backward()
        named = dict(zip(camera.names, camera.params.grad.tolist(), strict=True))
        assert named["pupil1"] == pytest.approx(2 * 0.25)
        assert named["pupil2"] == pytest.approx(2 * 0.0625)
        assert named["fx"] == 0.0

    def test_batch(self) -> None:
        cameras = [plain(0.5, pupil1=value) for value in (1e-3, 2e-3)]
        batch = Camera(torch.stack([camera.params for camera in cameras]), size=(801, 601), model=cameras[0].model)
        rays = directions(torch.tensor([0.2, 0.5]).double(), 2)
        for i, camera in enumerate(cameras):
            torch.testing.assert_close(batch.ray_origins(rays)[i], camera.ray_origins(rays))


class TestDerivatives:
    @pytest.mark.slow
    def test_second_derivatives_of_the_projection(self) -> None:
        vector = parameters(HYBRID, strong(HYBRID)).requires_grad_(True)
        camera = Camera(vector.detach(), size=(4, 3), model=HYBRID)
        points = torch.tensor([[0.1, -0.2, 1.1], [-0.6, 0.5, 0.7]], dtype=torch.float64, requires_grad=True)

        def project(points: Tensor, values: Tensor) -> Tensor:
            return functional_call(camera, {"params": values}, (points,))[0]

        assert gradgradcheck(project, (points, vector), eps=1e-6, atol=1e-7, rtol=1e-5)

    @pytest.mark.parametrize("kind", KINDS)
    def test_far_off_axis_and_on_it(self, kind: str) -> None:
        camera = hybrid_camera(kind, modes=FEW_MODES)
        rays, _ = camera.unproject(camera.grid(5, 4).flatten(0, 1))
        points = torch.cat([rays * 0.8, torch.tensor([[0.0, 0.0, 1.2], [1e-12, -1e-12, 1.0]]).double()])
        analytic = project_components(points.T, camera.params, camera.model, range(len(camera.names)))
        assert bool(analytic.regular.all())

        def pixels(points: Tensor, values: Tensor) -> Tensor:
            return project_components(points.T, values, camera.model).pixels

        by_point, by_camera = torch.func.jacfwd(pixels, argnums=(0, 1))(points, camera.params.detach())
        own = torch.stack([by_point[:, n, n] for n in range(len(points))], -2)
        scale = float(camera.focal[0])
        torch.testing.assert_close(analytic.by_point.movedim(0, -1), own, rtol=0, atol=1e-12 * scale)
        torch.testing.assert_close(analytic.by_camera.movedim(0, -1), by_camera, rtol=0, atol=1e-12 * scale)


class TestRegion:
    def test_ends_with_the_disc(self) -> None:
        camera = plain(0.25, 0.8)
        edge = 2 * math.atan(0.4)
        for factor, expected in ((1 - 1e-9, True), (1 + 1e-9, False)):
            points = directions(torch.tensor([edge * factor], dtype=torch.float64), 60)
            assert camera.project(points)[1].tolist() == [expected] * 60
            pixels = camera.center + 500 * 0.8 * factor * points[:, :2] / points[:, :2].norm(dim=-1, keepdim=True)
            assert camera.unproject(pixels)[1].tolist() == [expected] * 60
        assert camera.project(torch.tensor([[0.0, 0.0, -1.0], [0.3, 0.0, -1.0]]))[1].tolist() == [False, False]

    @pytest.mark.parametrize(("name", "weight"), [("z5+1", -0.12), ("z2+0", 0.3), ("z2+2", 0.6), ("shape", -2.5)])
    def test_a_field_that_folds_is_flagged(self, name: str, weight: float) -> None:
        camera = plain(1.0, 1.0, **{name: weight})
        x, y = (torch.linspace(-0.99, 0.99, 81, dtype=torch.float64),) * 2
        place = torch.cartesian_prod(x, y)
        place = place[place.norm(dim=-1) < 0.999]
        folded = distort_components(place[:, 0], place[:, 1], camera.coefficients, camera.model).determinant <= 0
        # z + w z² has no fold: it turns twice around its critical point.
        assert int(folded.sum()) > 50 or name == "z2+2"
        points = torch.cat([place, torch.ones(len(place), 1).double()], -1)
        pixels, valid = camera.project(points)
        assert not bool((valid & folded).any())
        assert 100 < int(valid.sum()) < len(valid)
        # One-to-one where valid: each pixel leads back to its own ray.
        rays, found = camera.unproject(pixels[valid])
        assert bool(found.all())
        torch.testing.assert_close(rays[:, :2] / rays[:, 2:], place[valid], rtol=0, atol=1e-8)
        # And no ray where there is none: valid pixels of the image project to themselves.
        image = camera.grid(61, 47).flatten(0, 1)
        rays, found = camera.unproject(image)
        assert 0 < int(found.sum()) < len(found)
        again, seen = camera.project(rays[found])
        assert bool(seen.all())
        torch.testing.assert_close(again, image[found], rtol=0, atol=1e-8)

    def test_polygon(self) -> None:
        whole = plain(1.0, 2.0).valid_polygon()
        assert sorted(map(tuple, whole.tolist())) == [(-0.5, -0.5), (-0.5, 600.5), (800.5, -0.5), (800.5, 600.5)]
        # A disc of 250 px, regular throughout.
        polygon = plain(1.0, 0.5).valid_polygon()
        radius = (polygon - torch.tensor([400.0, 300.0])).norm(dim=-1)
        torch.testing.assert_close(radius, torch.full_like(radius, 250.0), rtol=0, atol=0.01)
        # x (1 + δ m² G) turns back where its derivative vanishes.
        folding = plain(1.0, 1.0, shape=-2.5)
        polygon = folding.valid_polygon()
        inside = folding.center + 0.999 * (polygon - folding.center)
        outside = folding.center + 1.001 * (polygon - folding.center)
        assert bool(folding.unproject(inside)[1].all())
        assert not bool((folding.unproject(outside)[1] & folding.inside(outside)).any())


class TestRoundTrip:
    @pytest.mark.parametrize("seed", [0, 1])
    @pytest.mark.parametrize("kind", KINDS)
    def test_whole_image(self, kind: str, seed: int) -> None:
        camera = hybrid_camera(kind, seed)
        assert bool(camera.covers_image())
        width, height = camera.size
        pixels = torch.rand(3000, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        pixels = pixels * torch.tensor([width, height]) - 0.5
        rays, valid = camera.unproject(pixels)
        assert bool(valid.all())
        torch.testing.assert_close(rays.norm(dim=-1), torch.ones(3000).double(), rtol=0, atol=1e-15)
        again, seen = camera.project(camera.ray_origins(rays) + 1.3 * rays)
        assert bool(seen.all())
        torch.testing.assert_close(again, pixels, rtol=0, atol=1e-9)
        # The other way round.
        back, found = camera.unproject(camera.project(camera.ray_origins(rays) + 0.7 * rays)[0])
        assert bool(found.all())
        torch.testing.assert_close(back, rays, rtol=0, atol=1e-12)

    def test_tables_and_images_are_those_at_infinity(self) -> None:
        camera = hybrid_camera("webcam", modes=FEW_MODES)
        pixels = camera.grid(7, 5).flatten(0, 1) * 0.98 + 5.0
        rays, _ = camera.unproject(pixels)
        seen, _ = source_pixels(camera, rays)
        torch.testing.assert_close(seen, pixels, rtol=0, atol=1e-9)
        table = bake(camera, tolerance=1e-3)
        torch.testing.assert_close(table.project(rays)[0], pixels, rtol=0, atol=1e-3)
        torch.testing.assert_close(table.unproject(pixels)[0], rays, rtol=0, atol=1e-5)


class TestModel:
    def test_names(self) -> None:
        camera = plain(0.5)
        assert camera.names[:8] == ("fx", "fy", "cx", "cy", "skew", "shape", "pupil1", "pupil2")
        assert camera.names[8:] == SMALL.names
        assert str(camera.model) == "hybrid"
        assert "hybrid" in repr(camera)

    def test_free_by_name(self) -> None:
        camera = plain(0.5).free("z2+0", "pupil2")
        camera.project(torch.tensor([[0.3, 0.1, 1.0]]))[0].sum().backward()
        moved = [name for name, g in zip(camera.names, camera.params.grad.tolist(), strict=True) if g]
        assert moved == ["pupil2", "z2+0"]
        with pytest.raises(InputError, match="unknown parameter 'z99'"):
            camera.free("z99")

    def test_fingerprint_depends_on_the_constants(self) -> None:
        base = plain(0.5)
        seen = {
            base.fingerprint,
            plain(0.5, 1.1).fingerprint,
            plain(0.6).fingerprint,
            plain(0.5, pupil2=1e-9).fingerprint,
        }
        modes = ZernikeModes(radial=5, decentered=2, astigmatic=1, other=1)
        other = LensModel(hybrid=HybridForm(shape=0.5, radius=1.0, modes=modes))
        assert other.names == base.model.names
        seen.add(Camera(base.params, size=base.size, model=other).fingerprint)
        assert len(seen) == 5
        assert plain(0.5).fingerprint == base.fingerprint

    def test_state_dict_and_copies(self) -> None:
        source, target = hybrid_camera("webcam", 1, FEW_MODES), hybrid_camera("webcam", 2, FEW_MODES)
        pixels = source.grid(4, 3).flatten(0, 1)
        target.load_state_dict(source.state_dict())
        assert target.fingerprint == source.fingerprint
        for other in (target, copy.deepcopy(source), source.with_parameters(source.params)):
            assert torch.equal(other.unproject(pixels)[0], source.unproject(pixels)[0])

    @pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
    def test_on_a_gpu(self) -> None:
        camera = hybrid_camera("wide")
        pixels = camera.grid(40, 30).flatten(0, 1)
        rays, _ = camera.unproject(pixels)
        moved = copy.deepcopy(camera).to("cuda")
        there, valid = moved.unproject(pixels.cuda())
        assert bool(valid.all())
        torch.testing.assert_close(there.cpu(), rays, rtol=0, atol=1e-12)
        torch.testing.assert_close(moved.project(there)[0].cpu(), camera.project(rays)[0], rtol=0, atol=1e-9)

    @pytest.mark.parametrize(
        ("shape", "radius", "message"),
        [
            (1.0, 0.0, "radius"),
            (1.0, math.nan, "radius"),
            (1.0, math.inf, "radius"),
            (11.0, 1.0, "shape"),
            (math.nan, 1.0, "shape"),
        ],
    )
    def test_impossible_constants(self, shape: float, radius: float, message: str) -> None:
        with pytest.raises(InputError, match=message):
            HybridForm(shape=shape, radius=radius)

    def test_no_other_terms(self) -> None:
        with pytest.raises(InputError, match="terms of its own"):
            LensModel(hybrid=HybridForm(shape=1.0, radius=1.0), tangential=True)
        with pytest.raises(InputError, match="terms of its own"):
            LensModel(hybrid=HybridForm(shape=1.0, radius=1.0), fisheye=True)


# Many points of a hybrid camera at once: polynomials agree with the formulas, and stand back where they must.


COUNT = PIECE + 1000


def random_pixels(camera: Camera, count: int = COUNT, beyond: float = 0.0) -> Tensor:
    """Pixels all over the image, and as far beyond it as `beyond` of its size."""
    share = torch.rand(count, 2, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    return ((1.0 + 2.0 * beyond) * share - beyond) * torch.tensor(camera.size) - 0.5


def random_points(camera: Camera, nearest: float = 0.8, count: int = COUNT) -> Tensor:
    """Points seen all over the image, from `nearest` meters to some hundred."""
    rays, _ = camera._unproject_by_formulas(random_pixels(camera, count))
    return camera.ray_origins(rays) + rays * nearest * torch.exp(
        6.0 * torch.rand(count, 1, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    )


def polynomials(camera: Camera) -> Forward:
    found = camera._fitted.forward(camera.params.detach(), camera.model, camera.valid_region)
    assert found is not None
    return found


def distance(a: Tensor, b: Tensor) -> float:
    return float((a - b).abs().max())


def both_ways(camera: Camera, direction: str, given: Tensor) -> tuple[Tensor, Tensor, float]:
    """Values and mask of many points at once, where the formulas say the same, and how far apart they are in pixels."""
    values, valid = getattr(camera, direction)(given)
    own, known = getattr(camera, f"_{direction}_by_formulas")(given)
    assert torch.equal(valid, known)
    off = distance(values, own) * (float(camera.focal.max()) if direction == "unproject" else 1.0)
    assert off < 1e-9
    return values, valid, off


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("kind", KINDS)
class TestAgree:
    def test_project(self, kind: str, seed: int) -> None:
        camera = hybrid_camera(kind, seed)
        points = random_points(camera)
        _, valid, off = both_ways(camera, "project", points)
        assert bool(valid.all())
        assert off > 0.0
        # All points by polynomials, none by the formulas.
        fitted = polynomials(camera)
        assert fitted(points, torch.empty(fitted.rows, COUNT).double())[1] is None

    def test_unproject(self, kind: str, seed: int) -> None:
        camera = hybrid_camera(kind, seed)
        pixels = random_pixels(camera)
        rays, valid, off = both_ways(camera, "unproject", pixels)
        assert bool(valid.all())
        assert off > 0.0
        torch.testing.assert_close(rays.norm(dim=-1), torch.ones(COUNT).double(), rtol=0, atol=1e-15)
        assert distance(camera.project_rays(rays)[0], pixels) < 1e-9
        fitted = camera._fitted._backward
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
        pixels, valid, _ = both_ways(camera, "project", points)
        assert 0.02 < float(valid.double().mean()) < 0.9
        assert torch.equal(pixels[~valid], camera.center.expand_as(pixels[~valid]))

        pixels = random_pixels(camera, FEWEST, beyond=0.1)
        pixels[:64] = torch.cartesian_prod(*[torch.tensor(special).double()] * 2)
        valid = both_ways(camera, "unproject", pixels)[1]
        assert 100 < int((~valid).sum()) < 0.5 * FEWEST

    def test_a_lens_that_folds(self) -> None:
        form = HybridForm(shape=1.0, radius=1.0, modes=ZernikeModes(radial=5, decentered=2, astigmatic=1, other=0))
        lens = [-0.12 if name == "z5+1" else 0.0 for name in form.names]
        camera = Camera.build(
            focal=(500, 510), center=(400, 300), size=(801, 601), skew=0.7, coefficients=lens,
            model=LensModel(hybrid=form),
        )  # fmt: skip
        points = torch.randn(FEWEST, 3, generator=torch.Generator().manual_seed(8), dtype=torch.float64)
        both_ways(camera, "project", points)
        both_ways(camera, "unproject", random_pixels(camera, FEWEST))

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


class TestPointDerivatives:
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


class TestPolynomials:
    def test_what_is_left_out_stays_below_the_bound(self) -> None:
        series = np.array([1.0, -0.5, 1e-3, 3e-6, -4e-6, 2e-6])
        assert len(trim(series, 6.5e-6)) == 4
        assert len(trim(series, 5.5e-6)) == 5
        assert len(trim(series, 2.0)) == 0
        t = np.linspace(-1, 1, 999)
        whole = np.polynomial.chebyshev.chebval(t, series)
        assert float(np.abs(whole - np.polynomial.chebyshev.chebval(t, trim(series, 6.5e-6))).max()) < 6.5e-6

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

        fitted = fit_plane_map(exact, {1: 9, 0: 6, 2: 6, 5: 7, -4: 6, -1: 7, 3: 5}, 1e-13)
        assert fitted.matrix.shape == (16, 8)
        x, y = 0.7 * (2.0 * torch.rand(2, 500, generator=torch.Generator().manual_seed(9), dtype=torch.float64) - 1.0)
        u, v, square = fitted(x, y, torch.empty(fitted.rows, 500, dtype=torch.float64))
        torch.testing.assert_close(torch.stack([u, v]), torch.stack(exact(x, y)), rtol=0, atol=1e-13)
        torch.testing.assert_close(square, x * x + y * y)
