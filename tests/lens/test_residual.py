"""The residual field and the hybrid camera: derivatives, inverse, bounds, graphs, state."""

from __future__ import annotations

import copy
import math
from pathlib import Path

import onnxruntime
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lenses import parameters, strong
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.hybrid import HybridCamera
from kcal.lens.images import Undistort
from kcal.lens.modules import Unproject
from kcal.lens.projection import project_components
from kcal.lens.residual import (
    LARGEST_SLOPE,
    Field,
    FieldGrid,
    FieldResidual,
    FieldScale,
    correct_components,
    field_basis,
    field_bounds,
    undo_components,
)
from kcal.lens.rig import StereoRig

GRID = FieldGrid.covering((-0.6, -0.4), (0.6, 0.4), widths=[0.5, 0.2])
POINTS = torch.tensor([[0.1, -0.2, 1.1], [-0.3, 0.2, 1.3], [0.5, 0.3, 1.2], [0.0, 0.0, 1.0]], dtype=torch.float64)


def random_weights(seed: int = 0, slope: float = 0.3, grid: FieldGrid = GRID) -> Tensor:
    """Weights whose field has that slope at its steepest, all different."""
    weights = torch.randn(2, grid.count, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return weights * slope / field_bounds(Field(grid, weights))[1]


def make_hybrid(model: str = "opencv8", slope: float = 0.05, seed: int = 0) -> HybridCamera:
    vector = parameters(model, 0.3 * strong(model))
    vector[:5] = torch.tensor([1600.0, 1610.0, 955.0, 541.0, 2.0])
    camera = Camera(vector, size=(1920, 1080), model=model)
    return HybridCamera.of(camera, FieldResidual(GRID, random_weights(seed, slope)))


def numeric(function, x: Tensor, step: float = 1e-6) -> Tensor:
    """Central differences of function(x) by every element of x, the last dimension."""
    columns = []
    for i in range(x.numel()):
        move = torch.zeros(x.numel(), dtype=x.dtype)
        move[i] = step
        move = move.reshape(x.shape)
        columns.append((function(x + move) - function(x - move)) / (2 * step))
    return torch.stack(columns, -1)


class TestField:
    def test_the_formula(self) -> None:
        scale = FieldScale(width=0.3, left=-0.2, top=0.1, columns=2, rows=3)
        weights = torch.arange(12, dtype=torch.float64).reshape(2, 6) / 1000
        x, y = 0.15, 0.4
        wanted = [x, y]
        for i in range(2):
            for j in range(3):
                square = (x + 0.2 - 0.24 * i) ** 2 + (y - 0.1 - 0.24 * j) ** 2
                for c in range(2):
                    wanted[c] += float(weights[c, 3 * i + j]) * math.exp(-square / (2 * 0.09))
        point = torch.tensor([[x, y]], dtype=torch.float64)
        found = FieldResidual(FieldGrid(scales=(scale,)), weights)(point)
        torch.testing.assert_close(found[0], torch.tensor(wanted, dtype=torch.float64), rtol=1e-13, atol=0)

    def test_jacobians_are_autograd_and_numeric(self) -> None:
        point = torch.tensor([0.13, -0.21], dtype=torch.float64)
        weights = random_weights()

        def by_point(p: Tensor) -> Tensor:
            moved = correct_components(p[:1], p[1:], Field(GRID, weights))
            return torch.cat([moved.x, moved.y])

        def by_weights(w: Tensor) -> Tensor:
            moved = correct_components(point[:1], point[1:], Field(GRID, w), slopes=False)
            return torch.cat([moved.x, moved.y])

        moved = correct_components(point[:1], point[1:], Field(GRID, weights))
        closed = torch.stack(moved.point, -1).reshape(2, 2)
        automatic = torch.func.jacrev(by_point)(point)
        torch.testing.assert_close(closed, automatic, rtol=1e-12, atol=1e-15)
        torch.testing.assert_close(numeric(by_point, point), automatic, rtol=1e-7, atol=1e-9)
        basis = field_basis(point[:1], point[1:], GRID)[:, 0]
        closed = torch.stack([torch.stack([basis, 0 * basis]), torch.stack([0 * basis, basis])])
        automatic = torch.func.jacrev(by_weights)(weights)
        torch.testing.assert_close(closed, automatic, rtol=1e-12, atol=1e-15)
        torch.testing.assert_close(
            numeric(by_weights, weights).reshape(automatic.shape), automatic, rtol=1e-6, atol=1e-9
        )

    def test_dies_out(self) -> None:
        field = FieldResidual(GRID, random_weights())
        far = torch.tensor([[0.6 + 6 * 0.6, 0.0], [1e9, -1e9]], dtype=torch.float64)
        assert float((field(far) - far).abs().max()) < 1e-7 * field.bounds()[0]

    @settings(max_examples=20, deadline=None)
    @given(st.integers(0, 10_000), st.sampled_from([0.02, 0.3, 0.49]))
    def test_bounds_hold_and_are_close(self, seed: int, slope: float) -> None:
        field = Field(GRID, random_weights(seed, slope))
        largest, steepest = field_bounds(field)
        assert steepest == pytest.approx(slope, rel=1e-9)
        some = torch.rand(2, 20_000, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) * 3 - 1.5
        moved = correct_components(some[0], some[1], field)
        a, b, d, e = moved.point
        slopes = torch.stack([a - 1, b, d, e - 1]).norm(dim=0)
        distance = torch.stack([moved.x - some[0], moved.y - some[1]]).norm(dim=0)
        assert float(slopes.max()) <= steepest <= 4 * float(slopes.max())
        assert float(distance.max()) <= largest <= 4 * float(distance.max())

    @settings(max_examples=20, deadline=None)
    @given(st.integers(0, 10_000), st.sampled_from([0.001, 0.1, 0.49]))
    def test_undone_everywhere(self, seed: int, slope: float) -> None:
        field = Field(GRID, random_weights(seed, slope))
        goal = torch.rand(2, 500, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) * 4 - 2
        x, y, settled = undo_components(goal[0], goal[1], field)
        assert bool(settled.all())
        back = correct_components(x, y, field, slopes=False)
        torch.testing.assert_close(torch.stack([back.x, back.y]), goal, rtol=0, atol=4e-13)

    def test_a_steep_field_is_refused(self) -> None:
        with pytest.raises(InputError, match="its slope reaches"):
            FieldResidual(GRID, random_weights(slope=1.01 * LARGEST_SLOPE))
        field = FieldResidual(GRID, random_weights())
        steep = {"weights": random_weights(slope=2.0)}
        with pytest.raises(InputError, match="its slope reaches"):
            field.load_state_dict(steep)

    def test_bad_input(self) -> None:
        with pytest.raises(InputError, match="shape"):
            FieldResidual(GRID, torch.zeros(3, GRID.count))
        with pytest.raises(InputError, match="not finite"):
            FieldResidual(GRID, torch.full((2, GRID.count), torch.nan))
        with pytest.raises(InputError, match="width must be positive"):
            FieldScale(width=0.0, left=0.0, top=0.0, columns=1, rows=1)
        with pytest.raises(InputError, match="at least one"):
            FieldScale(width=1.0, left=0.0, top=0.0, columns=0, rows=1)


class TestCamera:
    def test_zero_weights_change_nothing(self) -> None:
        camera = make_hybrid().parametric
        zero = HybridCamera.of(camera, FieldResidual(GRID))
        pixels = camera.project(POINTS)[0]
        torch.testing.assert_close(zero.project(POINTS)[0], pixels, rtol=0, atol=1e-11)
        torch.testing.assert_close(zero.unproject(pixels)[0], camera.unproject(pixels)[0], rtol=0, atol=1e-13)

    def test_closed_form_derivatives(self) -> None:
        camera = make_hybrid()
        field, vector = camera.residual.field, camera.params.detach()
        wanted = range(len(vector))

        def project(points: Tensor, values: Tensor) -> Tensor:
            return project_components(points.T, values, camera.model, None, field).pixels

        closed = project_components(POINTS.T, vector, camera.model, wanted, field)
        torch.testing.assert_close(closed.pixels.T, camera.project(POINTS)[0], rtol=0, atol=1e-11)
        by_point, by_camera = torch.func.jacrev(project, argnums=(0, 1))(POINTS, vector)
        each = torch.stack([by_point[:, n, n] for n in range(len(POINTS))], 1)  # (2, N, 3)
        torch.testing.assert_close(closed.by_point, each.permute(2, 0, 1), rtol=1e-11, atol=1e-9)
        torch.testing.assert_close(closed.by_camera, by_camera.permute(2, 0, 1), rtol=1e-11, atol=1e-9)
        step = numeric(lambda v: project(POINTS, v), vector, 1e-5)
        torch.testing.assert_close(step, by_camera, rtol=1e-5, atol=1e-5)

    @pytest.mark.parametrize("model", ["opencv4", "opencv14", "ext20"])
    @pytest.mark.parametrize("slope", [0.01, 0.4])
    def test_round_trip(self, model: str, slope: float) -> None:
        camera = make_hybrid(model, slope)
        pixels = camera.grid(40, 30)
        rays, valid = camera.unproject(pixels)
        assert float(valid.double().mean()) > 0.9
        back, seen = camera.project(rays)
        assert bool(seen[valid].all())
        assert float((back - pixels)[valid].abs().max()) < 1e-9

    def test_gradients_of_unproject(self) -> None:
        """Implicit gradients by pixels, parameters and weights are those of differences."""
        camera = make_hybrid("opencv5", 0.2)
        pixels = torch.tensor([[700.0, 400.0]], dtype=torch.float64)
        state = {k: v.detach() for k, v in camera.state_dict().items()}

        def unproject(pixels: Tensor, values: Tensor, weights: Tensor) -> Tensor:
            now = state | {"params": values, "residual.weights": weights}
            return torch.func.functional_call(Unproject(camera), {f"camera.{k}": v for k, v in now.items()}, pixels)[0]

        inputs = (pixels, state["params"], state["residual.weights"])
        automatic = torch.autograd.functional.jacobian(unproject, inputs)
        for i, steps in enumerate((1e-3, 1e-6, 1e-6)):
            found = numeric(lambda v: unproject(*inputs[:i], v, *inputs[i + 1 :]), inputs[i], steps)  # noqa: B023
            torch.testing.assert_close(found.reshape(automatic[i].shape), automatic[i], rtol=1e-5, atol=1e-8)

    def test_gradgradcheck(self) -> None:
        camera = make_hybrid("opencv4", 0.3).free("fx", "weights")
        assert camera.free_names == ("fx", "weights")
        pixels = torch.tensor([[700.0, 400.0]], dtype=torch.float64, requires_grad=True)
        ray = camera.unproject(pixels)[0]
        (first,) = torch.autograd.grad(ray[0, 0], pixels, create_graph=True)
        second = torch.autograd.grad(first[0, 0], pixels)[0][0, 0]

        def slope(u: float) -> Tensor:
            p = torch.tensor([[u, 400.0]], dtype=torch.float64, requires_grad=True)
            return torch.autograd.grad(camera.unproject(p)[0][0, 0], p)[0][0, 0]

        assert float(second) == pytest.approx(float(slope(700.05) - slope(699.95)) / 0.1, rel=1e-5)

    def test_state_precision_and_fingerprint(self) -> None:
        camera = make_hybrid()
        other = make_hybrid(seed=1)
        assert camera.fingerprint != other.fingerprint != other.parametric.fingerprint
        other.load_state_dict(camera.state_dict())
        assert other.fingerprint == camera.fingerprint
        weights = camera.residual.weights.detach().clone()
        weights[1, 7] = torch.nextafter(weights[1, 7], torch.tensor(9.0).double())
        assert HybridCamera.of(camera, FieldResidual(GRID, weights)).fingerprint != camera.fingerprint
        half = copy.deepcopy(camera).half()
        assert half.fingerprint == camera.fingerprint
        with torch.autocast("cpu", dtype=torch.bfloat16):
            assert torch.equal(camera.project(POINTS)[0], half.project(POINTS)[0])

    def test_free(self) -> None:
        camera = make_hybrid()
        assert camera.free_names == ()
        assert camera.free("weights").free_names == ("weights",)
        assert camera.free("k1").free_names == ("k1",)
        assert "weights" in camera.free().free_names
        with pytest.raises(InputError, match="nonsense"):
            camera.free("nonsense")

    def test_no_batch(self) -> None:
        vector = make_hybrid().params.detach()
        with pytest.raises(InputError, match="not a batch"):
            HybridCamera(torch.stack([vector, vector]), size=(4, 4), model="opencv8")

    def test_in_rig_and_undistortion(self) -> None:
        camera = make_hybrid()
        rig = StereoRig(camera, make_hybrid(seed=2), torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
        copied = copy.deepcopy(rig)
        copied.load_state_dict(rig.state_dict())
        assert copied.left.fingerprint == camera.fingerprint
        vector = camera.params.detach().clone()
        vector[:5] /= 15.0
        small = HybridCamera(vector, size=(128, 72), model="opencv8", residual=camera.residual)
        # A ramp shows in each new pixel the column where the hybrid, not its lens alone, puts that pixel's ray.
        ramp = torch.arange(128.0, dtype=torch.float64).expand(1, 1, 72, 128)
        module = Undistort(small)
        images, masks = module(ramp)
        image, mask = images[0, 0], masks[0]
        pixels = module.new_camera.grid(128, 72)
        wanted, _ = small.project(module.new_camera.unproject(pixels)[0])
        torch.testing.assert_close(image[mask], wanted[..., 0][mask], rtol=0, atol=1e-9)
        lens_alone = small.parametric.project(module.new_camera.unproject(pixels)[0])[0]
        assert float((wanted - lens_alone)[mask].norm(dim=-1).max()) > 0.3
        assert len(camera.valid_polygon()) >= 4


class TestGraphs:
    @pytest.mark.parametrize("direction", ["project", "unproject"])
    def test_compile_export_onnx_vmap(self, direction: str, tmp_path: Path) -> None:
        torch.compiler.reset()
        lens, grid = make_hybrid("opencv4").parametric, FieldGrid(scales=GRID.scales[:1])
        camera = HybridCamera.of(lens, FieldResidual(grid, random_weights(0, 0.05, grid))).eval()
        points = torch.cat([POINTS, torch.tensor([[0.1, 0.0, -1.0], [torch.nan, 0.0, 1.0]])])
        module = camera if direction == "project" else Unproject(camera).eval()
        if direction == "unproject":
            points = camera.project(points)[0]
            points[-1] = torch.nan
        wanted = module(points)

        def check(got: tuple[Tensor, Tensor], wanted: tuple[Tensor, Tensor] = wanted) -> None:
            assert torch.equal(got[1], wanted[1])
            torch.testing.assert_close(got[0], wanted[0], rtol=0, atol=1e-10)

        check(torch.compile(module, fullgraph=True, backend="eager", dynamic=True)(points))
        count = torch.export.Dim("count", min=2)
        program = torch.export.export(module, (points,), dynamic_shapes=({0: count},)).module()
        check(program(points.repeat(5, 1)), module(points.repeat(5, 1)))
        path = tmp_path / "camera.onnx"
        torch.onnx.export(module, (points,), path, dynamo=True, dynamic_shapes=({0: count},), verbose=False)
        session = onnxruntime.InferenceSession(path)
        many = points.repeat(3, 1)
        values, valid = session.run(None, {session.get_inputs()[0].name: many.numpy()})
        assert values.dtype == "float64"
        check((torch.from_numpy(values), torch.from_numpy(valid)), module(many))
        sets = torch.stack([points, points.flip(0)])
        check(torch.func.vmap(module)(sets), module(sets))

    def test_vmap_over_cameras(self) -> None:
        cameras = [make_hybrid(seed=s) for s in (0, 1)]
        pixels = cameras[0].project(POINTS)[0]
        modules = [Unproject(camera) for camera in cameras]
        stacked, buffers = torch.func.stack_module_state(modules)

        def call(parameters: dict[str, Tensor], buffers: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
            return torch.func.functional_call(modules[0], (parameters, buffers), (pixels,))

        rays, valid = torch.func.vmap(call)(stacked, buffers)
        assert bool(valid.all())
        for i, camera in enumerate(cameras):
            torch.testing.assert_close(rays[i], camera.unproject(pixels)[0], rtol=0, atol=1e-12)
