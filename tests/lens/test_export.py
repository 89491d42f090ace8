"""Cameras compile as one graph, export with any number of points, run as ONNX, map under vmap, and travel as files."""

from pathlib import Path

import onnxruntime
import pytest
import safetensors.torch
import torch
from lenses import camera_of
from torch import Tensor, nn
from whole_graphs import traced_whole

from kcal import Camera, FileError, InputError, Rig
from kcal.lens import Unproject, save_onnx

# In front, beside the axis, off the image but in the lens, behind, and not a number.
POINTS = torch.tensor(
    [[0.1, -0.2, 1.1], [-0.3, 0.2, 1.3], [1.2, 0.9, 2.5], [0.1, 0.0, -1.0], [0.0, 0.0, 1.0], [torch.nan, 0.0, 1.0]],
    dtype=torch.float64,
)
DIRECTIONS = ("project", "unproject")
ROUNDING = {"rtol": 0, "atol": 1e-11}


@pytest.fixture(autouse=True)
def _fresh_compiler() -> None:
    """Forget the graphs of other tests: the compiler keeps no more than eight of a function."""
    torch.compiler.reset()


def make_camera(preset: str, scale: float = 0.5) -> Camera:
    return camera_of(preset, scale)


def module_and_input(camera: Camera, direction: str, repeats: int = 1) -> tuple[nn.Module, Tensor]:
    if direction == "project":
        return camera, POINTS.repeat(repeats, 1)
    pixels = camera.project(POINTS)[0]
    pixels[-1] = torch.nan
    return Unproject(camera), pixels.repeat(repeats, 1)


def assert_same(got: tuple[Tensor, Tensor], wanted: tuple[Tensor, Tensor]) -> None:
    assert torch.equal(got[1], wanted[1])
    torch.testing.assert_close(got[0], wanted[0], **ROUNDING)


# Of each kind of lens one with all its terms: others of the kind have fewer.
KINDS = ("opencv14", "ext24", "fisheye4", "hybrid")
# Each kind's own operations are in both directions; of a hybrid lens, the graph of the other one takes long.
ONNX = [(preset, direction) for preset in ("opencv14", "fisheye4") for direction in DIRECTIONS] + [
    ("hybrid", "unproject")
]


@pytest.mark.slow
@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("preset", KINDS)
def test_compiles_as_one_graph_and_exports(preset: str, direction: str) -> None:
    camera = make_camera(preset)
    module, points = module_and_input(camera, direction)
    assert_same(torch.compile(module, fullgraph=True, backend="eager", dynamic=True)(points), module(points))
    if (preset, direction) in ONNX:  # exported there
        return
    count = torch.export.Dim("count", min=2)
    program = torch.export.export(module, (points,), dynamic_shapes=({0: count},)).module()
    for repeats in (1, 7):
        _, many = module_and_input(camera, direction, repeats)
        assert_same(program(many), module(many))


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "direction"), ONNX)
def test_onnx(preset: str, direction: str, tmp_path: Path) -> None:
    camera = make_camera(preset)
    module, points = module_and_input(camera, direction)
    path = tmp_path / "camera.onnx"
    save_onnx(module, points, path)
    session = onnxruntime.InferenceSession(path)
    for repeats in (1, 7):
        _, many = module_and_input(camera, direction, repeats)
        values, valid = session.run(None, {session.get_inputs()[0].name: many.numpy()})
        assert values.dtype == "float64"
        assert_same((torch.from_numpy(values), torch.from_numpy(valid)), module(many))


class Almost(nn.Module):
    """A factor that is almost one, as of a lens that is tilted by 0.004."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("angle", torch.tensor(0.004, dtype=torch.float64))

    def forward(self, x: Tensor) -> Tensor:
        return x * torch.cos(self.get_buffer("angle"))


def test_onnx_keeps_a_factor_that_is_almost_one(tmp_path: Path) -> None:
    x = torch.tensor([[1.0, 2.0], [3.0, 4.0]], dtype=torch.float64)
    session = onnxruntime.InferenceSession(save_onnx(Almost(), x, tmp_path / "factor.onnx"))
    (found,) = session.run(None, {session.get_inputs()[0].name: x.numpy()})
    torch.testing.assert_close(torch.from_numpy(found), Almost()(x), rtol=1e-15, atol=0)


class Numbers(nn.Module):
    """Numbers that float32 rounds, where the exporter makes tensors of them."""

    def forward(self, x: Tensor) -> Tensor:
        return torch.where(x > 0.1, 6356752.314245179 - 1.959963984540054 * x, 1e-9 / 3.0)


def test_onnx_keeps_numbers_in_float64(tmp_path: Path) -> None:
    x = torch.tensor([[0.05, 0.3], [0.1000000001, 1e6]], dtype=torch.float64)
    session = onnxruntime.InferenceSession(save_onnx(Numbers(), x, tmp_path / "numbers.onnx"))
    (found,) = session.run(None, {session.get_inputs()[0].name: x.numpy()})
    assert torch.equal(torch.from_numpy(found), Numbers()(x))


def test_onnx_refuses_what_it_cannot_write(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="folder"):
        save_onnx(make_camera("opencv5"), POINTS, tmp_path / "none" / "camera.onnx")
    with pytest.raises(InputError, match=r"\(N, K\)"):
        save_onnx(make_camera("opencv5"), POINTS[None], tmp_path / "camera.onnx")


@pytest.mark.slow
@traced_whole
@pytest.mark.parametrize("direction", DIRECTIONS)
def test_code_is_generated(direction: str) -> None:
    """With the real compiler, not only the tracer; one model, because it takes long."""
    module, points = module_and_input(make_camera("opencv5"), direction, 3)
    assert_same(torch.compile(module, fullgraph=True)(points), module(points))


@pytest.mark.slow
@traced_whole
def test_graphs_flag_pixels_without_a_ray() -> None:
    """Corners beyond the fold (kornia issue 3273), where the number of steps is fixed."""
    camera = Camera.build(
        focal=(1917.36, 1917.36),
        center=(1920, 1080),
        size=(3840, 2160),
        coefficients=[-0.2535, 0.0924, -0.0006, 0.0007, -0.0191],
    )
    pixels = camera.grid(49, 28).flatten(0, 1)
    rays, valid = camera.unproject(pixels)
    compiled_rays, compiled_valid = torch.compile(Unproject(camera), fullgraph=True, backend="eager")(pixels)
    assert 20 < int((~valid).sum()) < 100
    # Never a ray where there is none; beside the fold one in some hundred pixels that an eager call finds is missing.
    assert not bool((compiled_valid & ~valid).any())
    assert int((compiled_valid != valid).sum()) <= 7
    torch.testing.assert_close(compiled_rays[compiled_valid], rays[compiled_valid], **ROUNDING)


@pytest.mark.parametrize("preset", ["opencv5", "opencv14", "ext24", "fisheye4", "hybrid"])
class TestVmap:
    def test_over_point_sets(self, preset: str) -> None:
        camera = make_camera(preset)
        for direction in DIRECTIONS:
            module, points = module_and_input(camera, direction)
            sets = torch.stack([points, points.flip(0)])
            assert_same(torch.func.vmap(module)(sets), module(sets))

    def test_over_cameras(self, preset: str) -> None:
        cameras = [make_camera(preset, scale) for scale in (0.1, 0.5)]
        for direction in DIRECTIONS:
            modules, points = zip(*(module_and_input(camera, direction) for camera in cameras), strict=True)
            parameters, buffers = torch.func.stack_module_state(list(modules))

            def call(parameters: dict[str, Tensor], buffers: dict[str, Tensor], x: Tensor) -> tuple[Tensor, Tensor]:
                return torch.func.functional_call(modules[0], (parameters, buffers), (x,))  # noqa: B023

            values, valid = torch.func.vmap(call)(parameters, buffers, torch.stack(points))
            for i, (module, own) in enumerate(zip(modules, points, strict=True)):
                assert_same((values[i], valid[i]), module(own))


class TestFiles:
    def test_safetensors_round_trip_is_exact(self, tmp_path: Path) -> None:
        camera = make_camera("ext24").free("fx", "k1")
        path = tmp_path / "camera.safetensors"
        safetensors.torch.save_model(camera, str(path))
        other = make_camera("ext24", 0.1)
        safetensors.torch.load_model(other, str(path))
        assert other.fingerprint == camera.fingerprint
        assert torch.equal(other.free_mask, camera.free_mask)
        # What follows from the parameters has followed.
        assert torch.equal(other.valid_edge, camera.valid_edge)
        assert_same(other.project(POINTS), camera.project(POINTS))

    def test_a_whole_rig(self, tmp_path: Path) -> None:
        turn = torch.linalg.matrix_exp(torch.tensor([[0, -0.1, 0.2], [0.1, 0, -0.3], [-0.2, 0.3, 0]]).double())
        shift = torch.tensor([-1 / 3, 0.1, 0.2], dtype=torch.float64)
        rig = Rig.pair(make_camera("ext20"), make_camera("opencv5"), turn, shift)
        path = tmp_path / "rig.safetensors"
        safetensors.torch.save_file(rig.state_dict(), str(path))
        other = Rig.pair(make_camera("ext20", 0.1), make_camera("opencv5", 0.1), torch.eye(3), torch.ones(3))
        other.load_state_dict(safetensors.torch.load_file(str(path)))
        assert all(torch.equal(a, b) for a, b in zip(other(POINTS[:3]), rig(POINTS[:3]), strict=True))
