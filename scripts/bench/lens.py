"""Points through the lens and back: kcal beside OpenCV and kornia, in speed, accuracy and honesty.

Tables: throughput of project and unproject (100, 10 000 and 1 000 000 points, float64, one thread, eager and
compiled; the hybrid camera beside opencv14), what the three answer where a pixel has no ray, and undistortion of 1080p
images. Within a round every side runs once, in turn; ratios are taken within a round: medians, below 1
kcal is faster.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import torch
from kornia.geometry.calibration import distort_points, undistort_points
from torch import Tensor

from kcal.calibrate.hybrid.fit import fit_hybrid
from kcal.lens.camera import Camera
from kcal.lens.camera_like import Unproject
from scripts.shared import wide_lens
from scripts.shared.distorted import distort
from scripts.shared.page import table
from scripts.shared.sections import section
from scripts.shared.timing import median, ratio, times

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
    return [
        lambda: cv2.projectPoints(array, zero, zero, K, d)[0],
        lambda: distort_points(flat, matrix, lens),
    ]


def peers_unproject(camera: Camera, pixels: Tensor) -> list[Call]:
    """OpenCV until 1e-10 in at most 20 iterations; kornia with 20 iterations."""
    matrix, lens = camera.matrix, camera.coefficients[:14]
    array, K, d = pixels.numpy()[:, None].copy(), matrix.numpy(), lens.numpy().copy()
    return [
        lambda: cv2.undistortPoints(array, K, d, criteria=CRITERIA)[:, 0],
        lambda: undistort_points(pixels, matrix, lens, num_iters=20),
    ]


@section("lens.md", "speed", rounds=1, points=COUNTS[:1])
def throughput(rounds: int = 15, points: tuple[int, ...] = COUNTS) -> Iterator[str]:
    """Rows of both directions."""
    heads = ["direction", "coefficients", "points", "kcal eager", "kcal compiled", "OpenCV", "kornia"]
    return table([*heads, "compiled / OpenCV", "compiled / kornia"], _throughput(rounds, points))


@torch.no_grad()
def _throughput(rounds: int, counts: tuple[int, ...]) -> Iterator[list[object]]:
    for direction, model in itertools.product(("project", "unproject"), MODELS):
        torch.compiler.reset()
        camera = build(model)
        # The compiler may take the parameters for what they are, constants of this camera.
        module = camera if direction == "project" else Unproject(camera)
        compiled = torch.compile(module, fullgraph=True, dynamic=True)
        for count in counts:
            points = _points(camera, count)
            data = points if direction == "project" else camera.project(points)[0]
            peers = (peers_project if direction == "project" else peers_unproject)(camera, data)
            calls: list[Call] = [lambda: module(data), lambda: compiled(data), *peers]  # noqa: B023
            found = times(calls, rounds)
            rate = [median([1e-6 * count / s for s in side]) for side in found]
            faster = [ratio(found[1], found[other]) for other in (2, 3)]
            yield [direction, len(MODELS[model]), f"{count:.0e}", *rate, *faster]


@section("lens.md", "hybrid speed", rounds=1, points=COUNTS[:1])
def hybrid_throughput(rounds: int = 15, points: tuple[int, ...] = COUNTS) -> Iterator[str]:
    """Rows of both directions for the hybrid camera, beside 14 coefficients and OpenCV with these."""
    heads = ["direction", "points", "hybrid", "first call, ms", "opencv14", "OpenCV", "hybrid / OpenCV"]
    return table([*heads, "largest difference to the formulas, px"], _hybrid_throughput(rounds, points))


@torch.no_grad()
def _hybrid_throughput(rounds: int, counts: tuple[int, ...]) -> Iterator[list[object]]:
    seen, weights = wide_lens.load()
    fitted = fit_hybrid(seen.board.points, seen.pixels(), seen.image_size, torch.from_numpy(weights)).camera
    plain = build("opencv14")
    for direction, count in itertools.product(("project", "unproject"), counts):
        # A new camera, so that its first call fits the polynomials.
        hybrid = fitted.with_parameters(fitted.params)
        points, others = _points(fitted, count), _points(plain, count)
        pixels, other_pixels = hybrid._project_by_formulas(points)[0], plain.project(others)[0]
        calls: list[Call]
        if direction == "project":
            calls = [lambda: hybrid.project(points), lambda: plain.project(others)]  # noqa: B023
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
def accuracy(count: int = 100_000) -> list[str]:
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
    rows = [["project, largest difference to kcal, px", "", *differences],
            ["unproject, largest round trip, px", *(f"{e:.1e}" for e in errors)]]  # fmt: skip
    return [*table(["", "kcal", "OpenCV", "kornia"], rows)]


def normalized_by_peers(camera: Camera, pixels: Tensor) -> list[Tensor]:
    """Answers of OpenCV and kornia on the plane z = 1; kornia's own are pixels of an undistorted camera."""
    opencv, kornias = (torch.as_tensor(np.asarray(call())) for call in peers_unproject(camera, pixels))
    return [opencv, (kornias - camera.center) / camera.focal]


@section("lens.md", "no ray")
@torch.no_grad()
def honesty() -> list[str]:
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
    rows = []
    for name, camera, pixel in cases:
        pixels = torch.tensor([pixel], dtype=torch.float64)
        rays, valid = camera.unproject(pixels)
        own, trip = _answer(rays[0, :2] / rays[0, 2], camera, pixels) if bool(valid) else ("**invalid**", "0")
        assert float(trip) < 1e-9
        cells = [_answer(normalized[0], camera, pixels) for normalized in normalized_by_peers(camera, pixels)]
        rows.append([name, own, *itertools.chain(*cells)])
    heads = ["pixel", "kcal: ray's x / z, y / z", "OpenCV (20, 1e-10)", "round trip, px", "kornia, 20 iterations"]
    return [*table([*heads, "round trip, px"], rows)]


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
