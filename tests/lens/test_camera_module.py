"""`Camera` and `Rig` as modules: precision, devices' dtypes, state, batches, refusals."""

import copy
from collections.abc import Callable

import pytest
import torch
from lenses import HYBRID, parameters, strong
from torch import nn

from kcal import Camera, InputError, Rig
from kcal.lens import LensModel, bake

POINTS = torch.tensor([[0.1, -0.2, 1.1], [-0.6, 0.5, 1.3], [1.2, 0.9, 2.5]], dtype=torch.float64)


def make_camera(model: str | LensModel = "opencv14") -> Camera:
    vector = parameters(model, strong(model))
    # Values that no lower precision can hold.
    vector[0] = 1600.0 / 3.0
    return Camera(vector, size=(1920, 1080), model=model)


def make_rig() -> Rig:
    rotation = torch.linalg.matrix_exp(torch.tensor([[0, -0.1, 0.2], [0.1, 0, -0.3], [-0.2, 0.3, 0]]).double())
    return Rig.pair(
        make_camera(), make_camera("opencv5"), rotation, torch.tensor([-1 / 3, 0.1, 0.2], dtype=torch.float64)
    )


CASTS: dict[str, Callable[[nn.Module], nn.Module]] = {
    "half": lambda m: m.half(),
    "bfloat16": lambda m: m.bfloat16(),
    "float": lambda m: m.float(),
    "double": lambda m: m.double(),
    "to float16": lambda m: m.to(torch.float16),
    "to cpu float32": lambda m: m.to("cpu", torch.float32),
    "inside a network": lambda m: nn.Sequential(nn.Linear(2, 2), m).half()[1],
}


class TestPrecision:
    @pytest.mark.parametrize("cast", CASTS.values(), ids=CASTS)
    def test_casts_do_not_round(self, cast: Callable[[nn.Module], nn.Module]) -> None:
        for module in (make_camera(), make_camera(HYBRID), make_rig()):
            before = {name: value.clone() for name, value in module.state_dict().items()}
            after = cast(module).state_dict()
            assert before.keys() == after.keys()
            assert all(torch.equal(after[name], value) for name, value in before.items())
            kinds = {value.dtype for name, value in after.items() if not name.endswith("_extra_state")}
            assert kinds == {torch.float64, torch.bool}

    def test_a_network_around_it_is_still_cast(self) -> None:
        network = nn.Sequential(nn.Linear(2, 2), make_camera()).half()
        assert network[0].weight.dtype == torch.float16
        assert network[1].params.dtype == torch.float64

    @pytest.mark.parametrize("model", ["opencv14", HYBRID], ids=str)
    def test_float32_is_promoted(self, model: str | LensModel) -> None:
        camera = make_camera(model)
        low = POINTS.float()
        assert torch.equal(camera.project(low)[0], camera.project(low.double())[0])
        pixels = torch.tensor([[5.0, 3.0]])
        assert torch.equal(camera.unproject(pixels)[0], camera.unproject(pixels.double())[0])

    @pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
    def test_less_is_refused(self, dtype: torch.dtype) -> None:
        """1023.5 px is 1024 in bfloat16, and half a pixel is what float16 has left there."""
        camera = make_camera()
        for call, value in ((camera.project, POINTS), (camera.unproject, POINTS[..., :2]), (camera, POINTS)):
            with pytest.raises(InputError, match=rf"{dtype} has steps of .*\.double\(\)"):
                call(value.to(dtype))

    def test_a_point_alone_is_refused(self) -> None:
        camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="opencv5")
        point, pixel = torch.tensor([0.1, 0.2, 1.0]), torch.tensor([100.0, 100.0])
        for call, value in ((camera.project, point), (camera.project_rays, point), (camera.unproject, pixel)):
            with pytest.raises(InputError, match=r"N, \d\) is needed, got \(\d,\); write points\[None\]"):
                call(value)
        lookup = bake(camera)
        with pytest.raises(InputError, match=r"got \(3,\)"):
            lookup.project(point)

    def test_autocast_changes_nothing(self) -> None:
        camera, rig = make_camera(), make_rig()
        pixels = camera.project(POINTS)[0]
        with torch.autocast("cpu", dtype=torch.bfloat16):
            assert torch.equal(camera.project(POINTS)[0], pixels)
            cast = camera.unproject(pixels)[0]
            rays = rig.right_from_left(POINTS)
        assert torch.equal(cast, camera.unproject(pixels)[0])
        assert torch.equal(rays, rig.right_from_left(POINTS))

    def test_the_default_dtype_changes_nothing(self) -> None:
        reference = make_camera().project(POINTS)[0]
        torch.set_default_dtype(torch.float16)
        try:
            assert torch.equal(make_camera().project(POINTS)[0], reference)
        finally:
            torch.set_default_dtype(torch.float32)


class TestState:
    def test_parameters_are_frozen_until_asked(self) -> None:
        camera = make_camera()
        assert [p.requires_grad for p in camera.parameters()] == [False]
        assert camera.requires_grad_(True).params.requires_grad

    def test_camera_keeps_its_own_copy(self) -> None:
        vector = parameters("opencv5", strong("opencv5"))
        camera = Camera(vector, size=(4, 3))
        vector[0] = 99.0
        assert float(camera.focal[0]) == 2.1

    def test_state_dict_round_trip(self) -> None:
        source = make_rig()
        target = copy.deepcopy(source)
        with torch.no_grad():
            for tensor in target.state_dict().values():
                tensor.zero_()
        target.load_state_dict(source.state_dict())
        assert all(torch.equal(a, b) for a, b in zip(source(POINTS), target(POINTS), strict=True))
        assert target.left.fingerprint == source.left.fingerprint

    def test_valid_radius_follows_on_request(self) -> None:
        camera = Camera.build(focal=(1, 1), center=(0, 0), size=(4, 3), model="opencv4")
        point = torch.tensor([[3.0, 0.0, 1.0]])
        assert camera.project(point)[1].tolist() == [True]
        with torch.no_grad():
            camera.params[5] = -1 / 12
        camera.update_valid_region()
        assert float(camera.valid_radius) == pytest.approx(2.0, abs=1e-12)
        assert camera.project(point)[1].tolist() == [False]

    def test_fingerprint_changes_with_everything(self) -> None:
        base = make_camera("opencv5")
        seen = {base.fingerprint}
        for i in range(10):
            vector = base.params.clone()
            vector[i] = torch.nextafter(vector[i], torch.tensor(9.0).double())
            seen.add(Camera(vector, size=base.size).fingerprint)
        seen.add(Camera(base.params, size=(1920, 1081)).fingerprint)
        padded = torch.cat([base.params, torch.zeros(3, dtype=torch.float64)])
        seen.add(Camera(padded, size=base.size, model="opencv8").fingerprint)
        assert len(seen) == 13
        assert make_camera("opencv5").fingerprint == base.fingerprint


class TestBatches:
    @pytest.mark.parametrize("model", ["opencv14", HYBRID], ids=str)
    def test_points_in_any_leading_shape(self, model: str | LensModel) -> None:
        camera = make_camera(model)
        flat, _ = camera.project(POINTS)
        for shape in ((1, 3, 3), (3, 1, 3)):
            pixels, valid = camera.project(POINTS.reshape(shape))
            assert pixels.shape == (*shape[:-1], 2)
            assert valid.shape == shape[:-1]
            assert torch.equal(pixels.reshape(3, 2), flat)

    @pytest.mark.parametrize("model", ["ext20", HYBRID], ids=str)
    def test_batch_equals_each_alone(self, model: str | LensModel) -> None:
        vectors = torch.stack([parameters(model, scale * strong(model)) for scale in (0.0, 0.5, 1.0, 1.1)])
        batch = Camera(vectors.reshape(2, 2, -1), size=(4, 3), model=model)
        pixels, valid = batch.project(POINTS)
        rays, found = batch.unproject(pixels)
        assert pixels.shape == (2, 2, 3, 2)
        assert valid.shape == found.shape == (2, 2, 3)
        for i, vector in enumerate(vectors):
            alone = Camera(vector, size=(4, 3), model=model)
            own, _ = alone.project(POINTS)
            # Vectorized kernels may round otherwise: one unit in the last place of numbers near one.
            torch.testing.assert_close(pixels[i // 2, i % 2], own, rtol=0, atol=1e-14)
            # Newton stops within 1e-13, and batches stop together: some iterate once more than alone.
            torch.testing.assert_close(rays[i // 2, i % 2], alone.unproject(own)[0], rtol=0, atol=1e-12)

    def test_one_point_set_a_camera(self) -> None:
        vectors = torch.stack([parameters("opencv5", scale * strong("opencv5")) for scale in (0.0, 1.0)])
        pixels, valid = Camera(vectors, size=(4, 3)).project(torch.stack([POINTS, POINTS.flip(0)]))
        assert valid.tolist() == [[True] * 3] * 2
        torch.testing.assert_close(
            pixels[1], Camera(vectors[1], size=(4, 3)).project(POINTS.flip(0))[0], rtol=0, atol=1e-14
        )


class TestRefusals:
    @pytest.mark.parametrize(
        ("vector", "message"),
        [
            (torch.ones(9), r"shape \(\.\.\., 10\) is needed, got \(9,\)"),
            (torch.ones(10, dtype=torch.int64), "floating point"),
            (torch.full((10,), float("nan")), "10 of 10 values are not finite"),
            (torch.zeros(10), "focal lengths must be positive"),
            (torch.zeros(0, 10), r"at least one is needed, got \(0, 10\)"),
            (-torch.ones(10), "focal lengths must be positive"),
        ],
    )
    def test_camera(self, vector: torch.Tensor, message: str) -> None:
        with pytest.raises(InputError, match=message):
            Camera(vector, size=(4, 3), model="opencv5")

    def test_camera_options(self) -> None:
        with pytest.raises(InputError, match="width, height"):
            Camera(torch.ones(10), size=(0, 3))
        with pytest.raises(InputError, match="unknown lens model 'opencv6'"):
            Camera(torch.ones(10), size=(4, 3), model="opencv6")
        with pytest.raises(InputError, match=r"6 coefficients given, opencv5 has 5; choose model=.opencv8."):
            Camera.build(focal=(1, 1), center=(0, 0), size=(4, 3), coefficients=[0.0] * 6)

    @pytest.mark.parametrize(
        ("rotation", "translation", "message"),
        [
            (torch.eye(3)[:2], torch.ones(3), "shapes"),
            (torch.eye(3), torch.ones(1, 3), "shapes"),
            (torch.eye(4), torch.ones(3), "shape"),
            (2 * torch.eye(3), torch.ones(3), "not a rotation"),
            (torch.diag(torch.tensor([1.0, 1.0, -1.0])), torch.ones(3), "not a rotation"),
            (torch.full((3, 3), float("nan")), torch.ones(3), "not finite"),
            (torch.eye(3), torch.full((3,), float("inf")), "not finite"),
            (torch.eye(3, dtype=torch.int64), torch.ones(3), "floating point"),
        ],
    )
    def test_rig(self, rotation: torch.Tensor, translation: torch.Tensor, message: str) -> None:
        with pytest.raises(InputError, match=message):
            Rig.pair(make_camera(), make_camera(), rotation, translation)


class TestRig:
    def test_forward_is_its_parts(self) -> None:
        rig = make_rig()
        pixels, valid = rig(POINTS)
        left, right = pixels.unbind(-2)
        assert torch.equal(left, rig.left.project(POINTS)[0])
        right_points = POINTS @ rig.right_from_left_rotation.T + rig.right_from_left_translation
        assert torch.equal(right, rig.right.project(right_points)[0])
        assert torch.equal(valid[:, 0], rig.left.project(POINTS)[1] & rig.left.inside(left))
        assert torch.equal(valid[:, 1], rig.right.project(right_points)[1] & rig.right.inside(right))

    def test_valid_only_if_both_see(self) -> None:
        camera = Camera.build(focal=(100, 100), center=(50, 50), size=(101, 101), model="pinhole")
        rig = Rig.pair(camera, camera, torch.diag(torch.tensor([-1.0, 1.0, -1.0])), torch.tensor([0.0, 0.0, 5.0]))
        # The cameras face each other 5 m apart: only what lies between is in front of both.
        points = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 6.0], [0.0, 0.0, -1.0]])
        assert rig(points)[1].all(-1).tolist() == [True, False, False]

    def test_baseline(self) -> None:
        assert float(make_rig().baseline) == pytest.approx((1 / 9 + 0.01 + 0.04) ** 0.5, rel=1e-15)
