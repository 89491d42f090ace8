"""Baked cameras: never farther off than they say, never valid where the camera is not, and readable by numpy alone."""

import functools
import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
from lenses import hybrid_camera
from torch import Tensor

from kcal import Camera, DegenerateError, FileError, InputError
from kcal.lens import load_lookup, save_lookup, save_onnx
from kcal.lens.baking import (
    RINGS,
    LookupCamera,
    Spline,
    bake,
    chart_from_points,
    evaluate_spline,
    extend_nodes,
    filter_nodes,
    rays_from_chart,
)

_BARREL = [-0.28, 0.1, 5e-4, -3e-4, 0.02, 0.05, 0.02, 0.01, 4e-4, -2e-4, -3e-4, 1e-4, 0.004, -0.006]
_HD: dict[str, Any] = {"focal": (1600, 1605), "center": (957, 541), "size": (1920, 1080)}


def _opencv14() -> Camera:
    return Camera.build(**_HD, coefficients=_BARREL, model="opencv14")


def _folding() -> Camera:
    """Corners beyond the fold (kornia issue 3273, a fourth of its size)."""
    lens = [-0.2535, 0.0924, -0.0006, 0.0007, -0.0191]
    return Camera.build(focal=(479.34, 479.34), center=(480, 270), size=(960, 540), coefficients=lens)


def _fisheye() -> Camera:
    """Reaches 120° off axis in the corners."""
    return Camera.build(
        focal=(370, 372), center=(637, 481), size=(1280, 960), coefficients=[0.02, -0.01, 0.003], model="fisheye4"
    )


CAMERAS = {
    "opencv14": _opencv14,
    "hybrid": functools.partial(hybrid_camera, "webcam"),
    "folding": _folding,
    "fisheye": _fisheye,
}


@functools.cache
def baked(name: str, tolerance: float = 1e-3) -> tuple[Camera, LookupCamera]:
    camera = CAMERAS[name]()
    return camera, bake(camera, tolerance)


def random_pixels(camera: Camera, count: int = 20000) -> Tensor:
    generator = torch.Generator().manual_seed(11)
    size = torch.tensor(camera.size, dtype=torch.float64)
    return torch.rand(count, 2, generator=generator, dtype=torch.float64) * size - 0.5


def check_bounds(camera: Camera, lookup: LookupCamera) -> None:
    pixels = random_pixels(camera)
    rays, exact = camera.unproject(pixels)
    found, valid = lookup.unproject(pixels)
    assert not bool((valid & ~exact).any())
    assert float(valid.sum() / exact.sum()) > lookup.coverage[1] - 0.01
    again, seen = camera.project_rays(found[valid])
    assert bool(seen.all())
    assert float(torch.linalg.vector_norm(again - pixels[valid], dim=-1).max()) <= lookup.bound[1]
    torch.testing.assert_close(torch.linalg.vector_norm(found, dim=-1), torch.ones(len(found)).double())

    points, pixels = rays[exact] * 3.0, pixels[exact]
    found, valid = lookup.project(points)
    assert float(valid.double().mean()) > lookup.coverage[0] - 0.01
    assert float(torch.linalg.vector_norm(found - pixels, dim=-1)[valid].max()) <= lookup.bound[0]

    # Points anywhere: beside the image, beyond the fold, behind the camera.
    points = torch.randn(20000, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    found, valid = lookup.project(points)
    wanted, seen = camera.project_rays(points)
    # Within the bound of the image's edge the two may differ about what is in the image.
    seen &= camera.inside(wanted) | (torch.linalg.vector_norm(found - wanted, dim=-1) <= lookup.bound[0])
    assert int(valid.sum()) > 100
    assert not bool((valid & ~seen).any())
    assert float(torch.linalg.vector_norm(found - wanted, dim=-1)[valid].max()) <= lookup.bound[0]
    assert torch.equal(found[~valid], lookup.center.expand_as(found[~valid]))


@pytest.mark.parametrize("name", CAMERAS)
def test_errors_keep_the_stated_bound(name: str) -> None:
    # Near a fold tables have to be fine, and take seconds.
    tolerance = 1e-2 if name == "folding" else 1e-3
    camera, lookup = baked(name, tolerance)
    assert max(lookup.bound) <= tolerance
    check_bounds(camera, lookup)
    if name == "folding":
        assert 0.95 < min(lookup.coverage) < 1.0
    else:
        assert lookup.coverage == (1.0, 1.0)


def test_the_tolerance_decides_about_the_grid() -> None:
    camera, coarse = baked("opencv14", 1e-2)
    _, fine = baked("opencv14", 1e-6)
    check_bounds(camera, fine)
    assert max(fine.bound) <= 1e-6
    cells = [lookup.chart_from_pixels.cells.numel() for lookup in (coarse, fine)]
    # Fourth order in the step: 10⁴ in error is 10 in step, 100 in cells, and refining may overshoot.
    assert 20 * cells[0] < cells[1] < 500 * cells[0]


def test_nothing_is_said_where_nothing_is_known() -> None:
    camera, lookup = baked("opencv14")
    width, height = camera.size
    pixels = [[-0.6, 5.0], [width - 0.4, 5.0], [5.0, -0.6], [5.0, height - 0.4], [torch.nan, 0.0], [torch.inf, 0.0]]
    rays, valid = lookup.unproject(torch.tensor(pixels, dtype=torch.float64))
    assert not bool(valid.any())
    assert torch.equal(rays, torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).expand(6, 3))
    corners = torch.tensor([[-0.5, -0.5], [width - 0.5, height - 0.5]], dtype=torch.float64)
    assert bool(lookup.unproject(corners)[1].all())
    points = [[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [torch.nan, 0.0, 1.0], [torch.inf, 0.0, 1.0]]
    pixels_found, valid = lookup.project(torch.tensor(points, dtype=torch.float64))
    assert not bool(valid.any())
    assert bool(torch.isfinite(pixels_found).all())


def test_gradients() -> None:
    camera, lookup = baked("opencv14", 1e-6)
    pixels = camera.grid(5, 4).reshape(-1, 2)[6:9].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda p: lookup.unproject(p)[0], (pixels,), eps=1e-3, atol=1e-9)
    points = torch.tensor([[0.1, -0.2, 1.1], [-0.3, 0.2, 1.3]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda p: lookup.project(p)[0], (points,), atol=1e-4)
    slopes = [
        torch.autograd.functional.jacobian(lambda p: c.project(p)[0].sum(0), points)  # noqa: B023
        for c in (camera, lookup)
    ]
    # Slopes lose one order: an error of 1e-6 px over cells of some ten pixels.
    torch.testing.assert_close(slopes[1], slopes[0], rtol=1e-6, atol=1e-3)
    behind = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]], dtype=torch.float64, requires_grad=True)
    lookup.project(behind)[0].sum().backward()
    assert not bool(behind.grad.any())


def test_state_precision_and_shapes() -> None:
    _, lookup = baked("opencv14")
    _, other = baked("opencv14", 1e-2)
    wanted = lookup.unproject(torch.tensor([[[100.0, 200.0]], [[300.0, 50.0]]]))[0]
    assert wanted.shape == (2, 1, 3)
    copy = bake(_opencv14(), 1e-3).half()
    assert {b.dtype for b in copy.buffers()} == {torch.float64, torch.bool}
    assert torch.equal(copy.unproject(torch.tensor([[[100.0, 200.0]], [[300.0, 50.0]]]))[0], wanted)
    with pytest.raises(RuntimeError, match="size mismatch"):
        other.load_state_dict(lookup.state_dict())


@pytest.mark.slow
@pytest.mark.parametrize("direction", ["project", "unproject"])
def test_graphs(direction: str, tmp_path: Path) -> None:
    torch.compiler.reset()
    camera, lookup = baked("opencv14", 1e-2)

    class Direction(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.lookup = lookup

        def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
            return self.lookup.project(x) if direction == "project" else self.lookup.unproject(x)

    pixels = torch.cat([camera.grid(5, 4).reshape(-1, 2), torch.tensor([[-30.0, 5.0]], dtype=torch.float64)])
    inputs = camera.unproject(pixels)[0] if direction == "project" else pixels
    module = Direction()
    wanted = module(inputs)
    got = [torch.compile(module, fullgraph=True, backend="eager", dynamic=True)(inputs)]
    if direction == "unproject":  # the same operations; one export, because it takes long
        got.append(run_as_onnx(module, inputs, tmp_path / "lookup.onnx"))
    for values, valid in got:
        assert torch.equal(valid, wanted[1])
        torch.testing.assert_close(values, wanted[0], rtol=1e-12, atol=1e-10)


def run_as_onnx(module: torch.nn.Module, inputs: Tensor, path: Path) -> tuple[Tensor, Tensor]:
    session = onnxruntime.InferenceSession(save_onnx(module, inputs, path))
    values, valid = session.run(None, {session.get_inputs()[0].name: inputs.numpy()})
    return torch.from_numpy(values), torch.from_numpy(valid)


class TestFile:
    def test_round_trip_is_exact(self, tmp_path: Path) -> None:
        camera, lookup = baked("folding", 1e-2)
        again = load_lookup(save_lookup(lookup, tmp_path / "camera.npz"))
        assert (again.size, again.bound, again.coverage) == (lookup.size, lookup.bound, lookup.coverage)
        assert again.source == camera.fingerprint
        pixels = random_pixels(camera, 500)
        for got, wanted in zip(again.unproject(pixels), lookup.unproject(pixels), strict=True):
            assert torch.equal(got, wanted)
        rays = camera.unproject(pixels)[0]
        for got, wanted in zip(again.project(rays), lookup.project(rays), strict=True):
            assert torch.equal(got, wanted)

    def test_numpy_alone_reads_it_as_the_documentation_says(self, tmp_path: Path) -> None:
        camera, lookup = baked("opencv14")
        file = np.load(save_lookup(lookup, tmp_path / "camera.npz"), allow_pickle=False)

        def read(which: str, x: float, y: float) -> tuple[Any, bool]:
            t = (np.array([x, y]) - file[f"{which}_origin"]) / file[f"{which}_step"]
            i, j = np.floor(t).astype(int)
            f = t - np.floor(t)
            bumps = np.array(
                [(1 - f) ** 3, 3 * f**3 - 6 * f**2 + 4, -3 * f**3 + 3 * f**2 + 3 * f + 1, f**3]
            ) / 6.0  # fmt: skip
            block = file[f"{which}_coefficients"][:, j - 1 : j + 3, i - 1 : i + 3]
            return np.einsum("kmn,m,n->k", block, bumps[:, 1], bumps[:, 0]), file[f"{which}_cells"][j - 1, i - 1]

        for pixel in random_pixels(camera, 5):
            (p, q), valid = read("unproject", *pixel.tolist())
            s = (p * p + q * q) / 4
            ray = np.array([p, q, 1 - s]) / (1 + s)
            assert valid
            np.testing.assert_allclose(ray, lookup.unproject(pixel[None])[0][0].numpy(), atol=1e-14)
            X, Y, Z = ray * 2.5
            scale = 2 / (np.sqrt(X * X + Y * Y + Z * Z) + Z)
            found, valid = read("project", X * scale, Y * scale)
            assert valid
            np.testing.assert_allclose(found, pixel.numpy(), atol=sum(lookup.bound))

    def test_nothing_in_a_file_is_executed(self, tmp_path: Path) -> None:
        """An array of objects is a pickle, which may call anything when it is loaded."""

        class Trap:
            def __reduce__(self) -> tuple[Any, ...]:
                return Path.touch, (tmp_path / "executed",)

        _, lookup = baked("opencv14")
        arrays = dict(np.load(save_lookup(lookup, tmp_path / "camera.npz")))
        for name in arrays:
            np.savez(tmp_path / "trap.npz", **(arrays | {name: np.array([Trap()], dtype=object)}))
            with pytest.raises(FileError):
                load_lookup(tmp_path / "trap.npz")
        assert not (tmp_path / "executed").exists()

    def test_what_is_no_such_file(self, tmp_path: Path) -> None:
        path = tmp_path / "camera.npz"
        path.write_text("not a table")
        with pytest.raises(FileError, match=r"not an \.npz"):
            load_lookup(path)
        np.savez(path, kcal=np.array("rig"))
        with pytest.raises(FileError, match="not a kcal lookup file"):
            load_lookup(path)
        _, lookup = baked("opencv14")
        arrays = dict(np.load(save_lookup(lookup, path)))
        for name, value, complaint in (
            ("project_step", None, "project_step is missing"),
            ("project_cells", arrays["project_cells"][1:], "coefficients"),
            ("project_cells", arrays["project_cells"].astype(float), "bool"),
            ("unproject_origin", np.array([np.nan, 0.0]), "finite"),
            ("unproject_step", np.array([0.0, 1.0]), "positive"),
            ("bound", np.array([np.nan, 0.1]), "bound is nan"),
            ("bound", np.array([0.1, -1.0]), "bound is 0.1, -1; finite numbers from 0"),
            ("bound", np.array([0.1, np.inf]), "bound is 0.1, inf"),
            ("bound", np.array([0.1]), "two numbers are needed"),
            ("bound", np.array(["0.1", "0.1"]), "two numbers are needed"),
            ("coverage", np.array([1.1, 1.0]), "from 0 to 1"),
            ("coverage", np.array([np.nan, 1.0]), "coverage is nan"),
            ("center", np.array([np.nan, 1.0]), "center is nan"),
            ("center", np.array([1, 2]), "two numbers are needed"),
            ("image_size", np.array([0, 480]), "image_size is 0, 480"),
            ("image_size", np.array([640.0, 480.0]), "two numbers are needed"),
            ("image_size", np.array([60000, 60000]), "500 megapixels"),
            ("version", np.array([1, 1]), "of version 1"),
            ("version", np.array(True), "of version 1"),
            ("kcal", np.array([["lookup"]]), "not a kcal lookup file"),
            ("project_cells", np.zeros((0, 0), bool), "at least one"),
        ):
            changed = {key: array for key, array in arrays.items() if key != name}
            np.savez(path, **changed, **({} if value is None else {name: value}))
            with pytest.raises(FileError, match=complaint):
                load_lookup(path)

    @pytest.mark.parametrize("seed", range(60))
    def test_damage_is_an_error(self, tmp_path: Path, seed: int) -> None:
        """Bytes flipped, cut and repeated anywhere: the file is refused, or the tables are the same."""
        _, lookup = baked("opencv14")
        whole = save_lookup(lookup, tmp_path / "camera.npz").read_bytes()
        if seed % 2:
            # Deflated, where damage ends in another library's errors.
            packed = io.BytesIO()
            np.savez_compressed(packed, **np.load(io.BytesIO(whole)))
            whole = packed.getvalue()
        rng = np.random.default_rng(seed)
        damaged = bytearray(whole)
        # The directory of the archive is at its end, and headers are where the arrays are small.
        places = rng.choice([len(whole), 400], 3) * rng.random(3)
        for place in places:
            damaged[-1 - int(place) if seed % 3 else int(place)] ^= 1 << int(rng.integers(8))
        if seed % 5 == 0:
            damaged = damaged[: int(rng.integers(len(damaged)))]
        path = tmp_path / "damaged.npz"
        path.write_bytes(damaged)
        try:
            again = load_lookup(path)
        except FileError:
            return
        for name, value in lookup.state_dict().items():
            assert torch.equal(again.state_dict()[name], value)

    def test_headers_that_promise_too_much(self, tmp_path: Path) -> None:
        _, lookup = baked("opencv14")
        path = save_lookup(lookup, tmp_path / "camera.npz")
        arrays = dict(np.load(path))

        def member(header: str, data: bytes) -> bytes:
            text = header.encode().ljust(118 - 1) + b"\n"
            return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + data

        for header in (
            "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000000,)}",
            "{'descr': '<f8', 'fortran_order': False, 'shape': (-1,)}",
            "{'descr': '|O', 'fortran_order': False, 'shape': (2,)}",
            "{'descr': [], 'fortran_order': None, 'shape': 3}",
            "(" * 90,
        ):
            np.savez(path, **{name: array for name, array in arrays.items() if name != "center"})
            with zipfile.ZipFile(path, "a") as archive:
                archive.writestr("center.npy", member(header, bytes(16)))
            with pytest.raises(FileError, match=r"camera\.npz: (not an \.npz|bad lookup file)"):
                load_lookup(path)

    def test_an_archive_that_unpacks_to_much_more_is_not_unpacked(self, tmp_path: Path) -> None:
        with (
            zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive,
            archive.open("center.npy", "w") as member,
        ):
            for _ in range(300):
                member.write(bytes(2**20))
        with pytest.raises(FileError, match="unpacks to 300 MiB"):
            load_lookup(tmp_path / "bomb.npz")


def test_bad_input_is_refused() -> None:
    camera = _opencv14()
    with pytest.raises(InputError, match="batch"):
        bake(Camera(camera.params.expand(2, -1), size=camera.size, model=camera.model))
    for tolerance in (0.0, -1.0, 1e-9, float("nan"), float("inf")):
        with pytest.raises(InputError, match="tolerance"):
            bake(camera, tolerance)
    with pytest.raises(DegenerateError, match="no pixel"):
        bake(Camera.build(focal=(100, 100), center=(5000, 5000), size=(640, 480), coefficients=[-50.0]))
    with pytest.raises(InputError, match="floating"):
        baked("opencv14")[1].unproject(torch.tensor([[1, 2]]))


def test_the_image_ends_half_a_pixel_beyond_its_outer_pixels() -> None:
    camera, lookup = baked("opencv14")
    width, height = lookup.size
    u, v = (torch.tensor([-0.6, -0.4, 100.0, side - 0.6, side - 0.4]).double() for side in (width, height))
    pixels = torch.stack(torch.meshgrid(u, v, indexing="ij"), -1)
    assert torch.equal(lookup.inside(pixels), camera.inside(pixels))
    assert lookup.inside(pixels).sum() == 9


class TestSpline:
    def test_cubics_are_exact(self) -> None:
        generator = torch.Generator().manual_seed(2)
        coefficients = torch.randn(2, 4, 4, generator=generator, dtype=torch.float64)

        def cubic(x: Tensor, y: Tensor) -> Tensor:
            powers = torch.arange(4)
            return torch.einsum(
                "kab,a...,b...->k...", coefficients, *(z ** powers.view(-1, *[1] * z.ndim) for z in (x, y))
            )

        rows, columns = 5, 7
        step, low = torch.tensor([0.2, 0.3]).double(), torch.tensor([-0.7, -0.5]).double()
        x = low[0] + step[0] * torch.arange(-RINGS, columns + 1 + RINGS)
        y = low[1] + step[1] * torch.arange(-RINGS, rows + 1 + RINGS)
        grid = torch.meshgrid(x, y, indexing="xy")
        cells = torch.ones(rows, columns, dtype=torch.bool)
        place = torch.rand(2, 300, generator=generator, dtype=torch.float64)
        x, y = low[0] + step[0] * columns * place[0], low[1] + step[1] * rows * place[1]
        known = torch.ones(rows + 1 + 2 * RINGS, columns + 1 + 2 * RINGS, dtype=torch.bool)
        # Complete, and with two rings that have to be continued.
        for rings in (0, 2):
            known[:rings], known[:, len(known[0]) - rings :] = False, False
            values, filled = extend_nodes(cubic(*grid), known)
            assert bool(filled.all())
            found, valid = evaluate_spline(Spline(filter_nodes(values), low - step, step, cells), x, y)
            assert bool(valid.all())
            torch.testing.assert_close(found, cubic(x, y), rtol=0, atol=1e-12)

    def test_islands_do_not_leak(self) -> None:
        """Values far from what is known stay unknown, and do not touch what is."""
        known = torch.zeros(12, 12, dtype=torch.bool)
        known[:6, :6] = True
        values = torch.full((1, 12, 12), torch.nan, dtype=torch.float64)
        values[0, :6, :6] = 1.0
        extended, filled = extend_nodes(values, known, 3)
        assert bool(filled[:6, :9].all())
        assert not bool(filled[:, 10:].any())
        assert torch.equal(extended[0][filled], torch.ones(int(filled.sum()), dtype=torch.float64))
        assert not bool(extended[0][~filled].any())


def test_chart() -> None:
    generator = torch.Generator().manual_seed(4)
    rays = torch.nn.functional.normalize(torch.randn(50, 3, generator=generator, dtype=torch.float64), dim=-1)
    p, q, usable = chart_from_points(rays * 4.0)
    assert bool(usable.all())
    torch.testing.assert_close(rays_from_chart(torch.stack([p, q], -1)), rays)
