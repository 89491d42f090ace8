"""Points through the lens and back: kcal beside OpenCV and kornia, in speed, accuracy and honesty.

Tables: throughput of project and unproject (100, 10 000 and 1 000 000 points, float64, one thread, eager and
compiled; the hybrid camera beside opencv14), what the three answer where a pixel has no ray, and undistortion of 1080p
images. Within a round every side runs once, in turn; ratios are taken within a round: medians, below 1
kcal is faster.
"""

from __future__ import annotations

import io
import itertools
import time
from collections.abc import Callable
from unittest import mock

import cv2
import numpy as np
import torch
from kornia.geometry.calibration import distort_points, undistort_image, undistort_points
from torch import Tensor

import kcal.lens.inverse
from kcal import Camera, Rig
from kcal.calibrate.hybrid.fit import fit_hybrid
from kcal.lens import LensModel, Unproject, bake, cylinder_view, looking, pinhole_view
from kcal.lens.images import StereoRectification, Undistort, undistort_maps
from kcal.lens.inverse import InverseStart
from kcal.lens.model import HybridForm, distort_components
from kcal.lens.zernike import ZernikeModes
from kcal.nets import train_inverse
from scripts.shared.distorted import distort
from scripts.shared.page import Lines, median, ratio, section, timed, times
from scripts.shared.real_captures import load

SIZE = (1920, 1080)
# A barrel lens of 62 degrees across, every term of OpenCV's at work, and no fold in the image.
LENS = [-0.28, 0.1, 5e-4, -3e-4, 0.02, 0.05, 0.02, 0.01, 4e-4, -2e-4, -3e-4, 1e-4, 0.004, -0.006]
MORE = [0.004, -0.002, 0.003, 0.001, 1e-4, -1e-4]
MODELS = {"opencv14": LENS, "ext20": LENS + MORE}
COUNTS = (100, 10_000, 1_000_000)
CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 1e-10)
# kornia issue 3273: a camera whose corners lie beyond the fold of its lens.
NO_CORNERS = {
    "focal": (1917.36, 1917.36),
    "center": (1920, 1080),
    "size": (3840, 2160),
    "coefficients": [-0.2535, 0.0924, -0.0006, 0.0007, -0.0191],
}

Call = Callable[[], object]


def build(model: str) -> Camera:
    """The camera of the tables."""
    return Camera.build(focal=(1600, 1605), center=(957, 541), size=SIZE, coefficients=MODELS[model], model=model)


def peers_project(camera: Camera, points: Tensor) -> list[Call]:
    """OpenCV and kornia with the first 14 coefficients: neither has more."""
    matrix, lens = camera.matrix, camera.coefficients[:14]
    array, K, d, zero = points.numpy(), matrix.numpy(), lens.numpy().copy(), np.zeros(3)
    # kornia takes the pixels of an undistorted camera, so that the division by depth is done beforehand.
    flat = points[:, :2] / points[:, 2:] * camera.focal + camera.center
    return [lambda: cv2.projectPoints(array, zero, zero, K, d)[0], lambda: distort_points(flat, matrix, lens)]


def peers_unproject(camera: Camera, pixels: Tensor) -> list[Call]:
    """OpenCV until 1e-10 in at most 20 iterations; kornia with 20 iterations."""
    matrix, lens = camera.matrix, camera.coefficients[:14]
    array, K, d = pixels.numpy()[:, None].copy(), matrix.numpy(), lens.numpy().copy()
    return [
        lambda: cv2.undistortPoints(array, K, d, criteria=CRITERIA)[:, 0],
        lambda: undistort_points(pixels, matrix, lens, num_iters=20),
    ]


@section("lens.md", "speed", rounds=1, points=COUNTS[:1])
@torch.no_grad()
def throughput(rounds: int = 15, points: tuple[int, ...] = COUNTS) -> Lines:
    """Rows of both directions."""
    yield [
        "direction", "coefficients", "points", "kcal eager", "kcal compiled", "OpenCV", "kornia", "compiled / OpenCV",
        "compiled / kornia",
    ]  # fmt: skip
    for direction, model in itertools.product(("project", "unproject"), MODELS):
        torch.compiler.reset()
        camera = build(model)
        # The compiler may take the parameters for what they are, constants of this camera.
        module = camera if direction == "project" else Unproject(camera)
        compiled = torch.compile(module, fullgraph=True, dynamic=True)
        for count in points:
            there = _points(camera, count)
            data = there if direction == "project" else camera.project(there)[0]
            peers = (peers_project if direction == "project" else peers_unproject)(camera, data)
            calls: list[Call] = [lambda: module(data), lambda: compiled(data), *peers]  # noqa: B023
            found = times(calls, rounds)
            rate = [median([1e-6 * count / s for s in side]) for side in found]
            faster = [ratio(found[1], found[other]) for other in (2, 3)]
            yield [direction, len(MODELS[model]), f"{count:.0e}", *rate, *faster]


@section("lens.md", "hybrid speed", rounds=1, points=COUNTS[:1])
@torch.no_grad()
def hybrid_throughput(rounds: int = 15, points: tuple[int, ...] = COUNTS) -> Lines:
    """Rows of both directions for the hybrid camera, beside 14 coefficients and OpenCV with these."""
    yield [
        "direction", "points", "hybrid", "first call, ms", "opencv14", "OpenCV", "hybrid / OpenCV",
        "largest difference to the formulas, px",
    ]  # fmt: skip
    seen, weight = load("wide")
    fitted = fit_hybrid(seen.board.points, seen.pixels(), seen.image_size, weight).camera
    plain = build("opencv14")
    for direction, count in itertools.product(("project", "unproject"), points):
        # A new camera, so that its first call fits the polynomials.
        hybrid = fitted.with_parameters(fitted.params)
        there, others = _points(fitted, count), _points(plain, count)
        pixels, other_pixels = hybrid._project_by_formulas(there)[0], plain.project(others)[0]
        calls: list[Call]
        if direction == "project":
            calls = [lambda: hybrid.project(there), lambda: plain.project(others)]  # noqa: B023
            calls.append(peers_project(plain, others)[0])
        else:
            calls = [lambda: hybrid.unproject(pixels), lambda: plain.unproject(other_pixels)]  # noqa: B023
            calls.append(peers_unproject(plain, other_pixels)[0])
        start = time.perf_counter()
        calls[0]()
        first = f"{1e3 * (time.perf_counter() - start):.0f}"
        found = times(calls, rounds)
        rate = [median([1e-6 * count / s for s in side]) for side in found]
        again = calls[0]()[0] if direction == "project" else hybrid.project_rays(calls[0]()[0])[0]  # type: ignore[index]
        yield [
            direction, f"{count:.0e}", rate[0], first, *rate[1:], ratio(found[0], found[2]),
            f"{float((again - pixels).abs().max()):.1e}",
        ]  # fmt: skip


@section("lens.md", "accuracy")
@torch.no_grad()
def accuracy(count: int = 100_000) -> Lines:
    """Largest error of each direction over the image, in pixels."""
    camera = build("opencv14")
    points = _points(camera, count)
    pixels, _ = camera.project(points)
    forward = [torch.as_tensor(np.asarray(call())).reshape(-1, 2) for call in peers_project(camera, points)]
    differences = [f"{float((other - pixels).abs().max()):.1e}" for other in forward]
    rays, valid = camera.unproject(pixels)
    found = [rays / rays[:, 2:]]
    for normalized in normalized_by_peers(camera, pixels):
        found.append(torch.cat([normalized, torch.ones(count, 1)], -1))
    errors = [float((camera.project(ray)[0] - pixels).norm(dim=-1).max()) for ray in found]
    assert bool(valid.all())
    yield ["", "kcal", "OpenCV", "kornia"]
    yield ["project, largest difference to kcal, px", "", *differences]
    yield ["unproject, largest round trip, px", *(f"{e:.1e}" for e in errors)]


def normalized_by_peers(camera: Camera, pixels: Tensor) -> list[Tensor]:
    """Answers of OpenCV and kornia on the plane z = 1; kornia's own are pixels of an undistorted camera."""
    opencv, kornias = (torch.as_tensor(np.asarray(call())) for call in peers_unproject(camera, pixels))
    return [opencv, (kornias - camera.center) / camera.focal]


@section("lens.md", "no ray")
@torch.no_grad()
def honesty() -> Lines:
    """What each answers where iterations diverge, or no ray exists."""
    strong = {"focal": (500, 500), "center": (1600, 1200), "size": (3201, 2401)}
    pincushion = Camera.build(**strong, coefficients=[0.5])  # type: ignore[arg-type]
    barrel = Camera.build(**strong, coefficients=[-0.5])  # type: ignore[arg-type]
    corners = Camera.build(**NO_CORNERS)  # type: ignore[arg-type]
    cases = [
        ("k1 = 0.5, three focal lengths off axis: a ray exists", pincushion, [3100.0, 1200.0]),
        ("k1 = -0.5, three focal lengths off axis: none exists", barrel, [3100.0, 1200.0]),
        ("3840x2160, corner without a preimage", corners, [0.0, 0.0]),
        ("3840x2160, the opposite corner", corners, [3839.0, 2159.0]),
    ]
    yield [
        "pixel", "kcal: ray's x / z, y / z", "OpenCV (20, 1e-10)", "round trip, px", "kornia, 20 iterations",
        "round trip, px",
    ]  # fmt: skip
    for name, camera, pixel in cases:
        pixels = torch.tensor([pixel], dtype=torch.float64)
        rays, valid = camera.unproject(pixels)
        own, trip = _answer(rays[0, :2] / rays[0, 2], camera, pixels) if bool(valid) else ("**invalid**", "0")
        assert float(trip) < 1e-9
        cells = [_answer(normalized[0], camera, pixels) for normalized in normalized_by_peers(camera, pixels)]
        yield [name, own, *itertools.chain(*cells)]


def _answer(normalized: Tensor, camera: Camera, pixels: Tensor) -> tuple[str, str]:
    """The answer, and how far from the pixel the formulas of the lens put it (no fold asked after)."""
    again = distort(normalized[None], camera.coefficients, camera.model) * camera.focal + camera.center
    x, y = normalized.tolist()
    return f"{x:.4g}, {y:.4g}", f"{float((again - pixels).norm()):.2g}"


def _points(camera: Camera, count: int) -> Tensor:
    """Points 1 to 50 m deep that are seen in pixels spread over the image."""
    generator = torch.Generator().manual_seed(1)
    pixels = torch.rand(count, 2, generator=generator, dtype=torch.float64) * torch.tensor(camera.size)
    depth = 1 + 49 * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    rays, _ = camera.unproject(pixels)
    return rays / rays[:, 2:] * depth


POINTS = 10_000
# A lens of some 150 degrees, as fitted to a real one.
WIDE = [0.4749, 0.02579, 3e-5, -9e-6, 8.2e-5, 0.7623, 0.09433, 1.329e-3, 3.1e-5, -2e-7, -2.6e-5, 3e-8, 1.1e-3, 1e-3]
# Corners beyond the fold: kornia issue 3273.
FOLDING = [-0.2535, 0.0924, -0.0006, 0.0007, -0.0191]


def hybrid() -> Camera:
    """A lens between pinhole and stereographic with all default modes, decaying with their degree as real ones do."""
    modes = ZernikeModes()
    form = HybridForm(shape=0.7, radius=0.8, modes=modes)
    degree = torch.tensor([mode[-1] for mode in modes.real_modes], dtype=torch.float64)
    noise = torch.randn(len(degree), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    weights = (3e-4 * torch.exp(-0.5 * (degree - 3)) * noise).tolist()
    return Camera.build(
        focal=(1500, 1500), center=(957, 541), size=SIZE, coefficients=[0, 2e-3, 1e-3, *weights],
        model=LensModel(hybrid=form),
    )  # fmt: skip


CAMERAS: dict[str, Callable[[], Camera]] = {
    "opencv5": lambda: Camera.build(focal=(1600, 1605), center=(957, 541), size=SIZE, coefficients=LENS[:5]),
    "opencv14": lambda: build("opencv14"),
    "ext20": lambda: build("ext20"),
    "opencv14, 150°": lambda: Camera.build(
        focal=(2073.8, 2077.7), center=(3003.5, 2001.4), size=(6016, 4016), coefficients=WIDE, model="opencv14"
    ),
    "opencv5, corners beyond the fold": lambda: Camera.build(
        focal=(1917.36, 1917.36), center=(1920, 1080), size=(3840, 2160), coefficients=FOLDING
    ),
    "fisheye4": lambda: Camera.build(
        focal=(400, 402), center=(637, 481), size=(1280, 960), coefficients=[0.02, -0.01, 0.003], model="fisheye4"
    ),
    "hybrid": hybrid,
}


def random_pixels(camera: Camera, count: int) -> Tensor:
    """Pixels of the image that have a ray."""
    generator = torch.Generator().manual_seed(5)
    pixels = torch.rand(2 * count, 2, generator=generator, dtype=torch.float64) * torch.tensor(camera.size) - 0.5
    return pixels[camera.unproject(pixels)[1]][:count]


def evaluations(camera: Camera, pixels: Tensor, start: InverseStart | None) -> int:
    """How often one call of `unproject` evaluates the lens for all its pixels."""
    with mock.patch.object(kcal.lens.inverse, "distort_components", wraps=distort_components) as counted:
        camera.unproject(pixels, start=start)
    return counted.call_count


@section("lens.md", "inverse nets", rounds=1, cameras=("opencv5",))
@torch.no_grad()
def inverse_nets(rounds: int = 15, cameras: tuple[str, ...] = tuple(CAMERAS)) -> Lines:
    """Evaluations and time of `unproject` with and without a net."""
    yield ["camera", "evaluations of the lens a call", "with the net", "time with / without"]
    for name in cameras:
        camera = CAMERAS[name]()
        guess = train_inverse(camera).net.guess
        pixels = random_pixels(camera, POINTS)
        plain, helped = camera.unproject(pixels), camera.unproject(pixels, start=guess)
        assert torch.equal(plain[1], helped[1])
        assert float((plain[0] - helped[0]).abs().max()) < 1e-6
        found = times([lambda: camera.unproject(pixels), lambda: camera.unproject(pixels, start=guess)], rounds)  # noqa: B023
        saved = (evaluations(camera, pixels, start) for start in (None, guess))
        yield [name, *saved, ratio(found[1], found[0])]


@section("lens.md", "lookup tables", rounds=1, cameras=("opencv5",))
@torch.no_grad()
def lookup_tables(rounds: int = 15, cameras: tuple[str, ...] = tuple(CAMERAS)) -> Lines:
    yield [
        "camera", "tolerance, px", "baking, s", "file, kB", "bound, px", "largest error found, px", "answers for",
        "project: table / camera", "unproject: table / camera",
    ]  # fmt: skip
    for name in cameras:
        camera = CAMERAS[name]()
        pixels = random_pixels(camera, 10 * POINTS)
        rays, _ = camera.unproject(pixels)
        few, few_rays = pixels[:POINTS], rays[:POINTS]
        for tolerance in (1e-2, 1e-3):
            lookup, seconds = timed(bake, camera, tolerance)
            again, valid = lookup.unproject(pixels)
            largest = float((camera.project_rays(again)[0] - pixels).norm(dim=-1)[valid].max())
            there, seen = lookup.project(rays)
            largest = max(largest, float((there - pixels).norm(dim=-1)[seen].max()))
            calls: list[Call] = [
                lambda: camera.project_rays(few_rays),  # noqa: B023
                lambda: lookup.project(few_rays),  # noqa: B023
                lambda: camera.unproject(few),  # noqa: B023
                lambda: lookup.unproject(few),  # noqa: B023
            ]
            found = times(calls, rounds)
            buffer = io.BytesIO()
            np.savez(buffer, **{key: value.numpy() for key, value in lookup.state_dict().items()})
            yield [
                name, f"{tolerance:.0e}", f"{seconds:.1f}", round(len(buffer.getvalue()) / 1000),
                f"{max(lookup.bound):.1e}", f"{largest:.1e}", f"{100 * min(lookup.coverage):.1f} %",
                ratio(found[1], found[0]), ratio(found[3], found[2]),
            ]  # fmt: skip


# Of images.
EIGHT = [-0.28, 0.1, 1e-3, -1e-3, 0.02, 0.05, 0.02, 0.01]
# Name, channels, dtype. kornia takes floats only.
CASES = (
    ("gray, float32", 1, torch.float32),
    ("color, float32", 3, torch.float32),
    ("gray, uint8", 1, torch.uint8),
    ("color, uint8", 3, torch.uint8),
)


@section("lens.md", "rectification", rounds=1)
@torch.no_grad()
def views(rounds: int = 30) -> Lines:
    """Kinds of rectification, in CPU milliseconds a megapixel of the new image."""
    yield ["view", "maps, once", "float32, color", "`cv2.remap`", "uint8, color", "`cv2.remap`"]
    camera = Camera.build(focal=(1400, 1400), center=(957, 541), size=SIZE, coefficients=EIGHT, model="opencv8")
    fisheye = Camera.build(focal=(600, 600), center=(957, 541), size=SIZE, coefficients=[0.02], model="fisheye4")
    turn = looking(1.0, 0.5)
    rig = Rig.pair(camera, camera, turn, -turn @ torch.tensor([10.0, 0.1, 0.2], dtype=torch.float64))
    kinds: list[tuple[str, Callable[[], list[Undistort]]]] = [
        ("pinhole, alpha 0", lambda: [Undistort(camera)]),
        ("fisheye, 60 degrees at 40 degrees", lambda: [Undistort(fisheye, pinhole_view(60, SIZE), looking(40, 0))]),
        ("fisheye on a cylinder", lambda: [Undistort(fisheye, cylinder_view(fisheye))]),
        ("stereo pair", lambda: [getattr(StereoRectification(rig), side) for side in ("left", "right")]),
    ]
    for name, make in kinds:
        modules, spent = timed(make)
        pixels = sum(module.mask.numel() for module in modules) / 1e6
        cells = [f"{1e3 * spent / pixels:.0f}"]
        for dtype in (torch.float32, torch.uint8):
            image = _image(3, dtype)
            array = np.ascontiguousarray(image[0].permute(1, 2, 0).numpy())
            maps = [undistort_maps(one.camera, one.new_camera, one.rotation) for one in modules]
            calls: list[Call] = [
                lambda: [module(image) for module in modules],  # noqa: B023
                lambda: [cv2.remap(array, one.map_x, one.map_y, cv2.INTER_LINEAR) for one in maps],  # noqa: B023
            ]
            found = times(calls, rounds, time.process_time)
            cells += [median([1e3 * value / pixels for value in seconds]) for seconds in found]
        yield [name, *cells]


@section("lens.md", "images", rounds=1)
def images(rounds: int = 30) -> Lines:
    camera = Camera.build(focal=(1400, 1400), center=(957, 541), size=SIZE, coefficients=EIGHT, model="opencv8")
    new = Camera.build(focal=(1400, 1400), center=(957, 541), size=SIZE, model="pinhole")
    milliseconds = _milliseconds(times([lambda: undistort_maps(camera, new)], 3)[0])
    print(f"Making kcal's maps, once for each camera: {milliseconds} ms.")
    yield [
        "image", "kcal, maps kept", "`cv2.remap`", "kornia `undistort_image`", "kcal / cv2", "kcal / kornia",
        "largest difference to cv2, levels of 255",
    ]  # fmt: skip
    undistort = Undistort(camera, new)
    for name, channels, dtype in CASES:
        yield _row(name, camera, undistort, _image(channels, dtype), rounds)


def _image(channels: int, dtype: torch.dtype) -> torch.Tensor:
    """Levels 0 to 255 of a smooth pattern with some noise, (1, C, H, W)."""
    width, height = SIZE
    x, y = torch.meshgrid(torch.arange(width), torch.arange(height), indexing="xy")
    pattern = 127.5 + 90 * torch.sin(x / 17) * torch.cos(y / 23)
    noise = 8 * torch.randn(channels, height, width, generator=torch.Generator().manual_seed(0))
    return (pattern + noise).clamp(0, 255).round()[None].to(dtype)


@torch.no_grad()
def _row(name: str, camera: Camera, undistort: Undistort, image: torch.Tensor, rounds: int) -> list[object]:
    maps = undistort_maps(undistort.camera, undistort.new_camera)
    # OpenCV's images have their channels last.
    array = np.ascontiguousarray(image[0].permute(1, 2, 0).squeeze(-1).numpy())
    matrix, lens = camera.matrix[None].to(torch.float32), camera.coefficients[None].to(torch.float32)
    calls: list[Call] = [lambda: undistort(image), lambda: cv2.remap(array, maps.map_x, maps.map_y, cv2.INTER_LINEAR)]
    if image.is_floating_point():
        calls.append(lambda: undistort_image(image, matrix, lens))
    found = times(calls, rounds)
    faster = [ratio(found[0], other) for other in found[1:]]
    theirs = torch.from_numpy(np.atleast_3d(cv2.remap(array, maps.map_x, maps.map_y, cv2.INTER_LINEAR)))
    difference = float((undistort(image)[0][0].double() - theirs.permute(2, 0, 1).double()).abs().max())
    cells: list[object] = [name, *(_milliseconds(t) for t in found), *["–"] * (3 - len(found))]
    cells += [*faster, *["–"] * (2 - len(faster)), f"{difference:.3f}"]
    return cells


def _milliseconds(seconds: list[float]) -> str:
    return median([1e3 * value for value in seconds])
