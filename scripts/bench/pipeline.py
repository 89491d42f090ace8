"""Time of one frame from detections to positions: 1, 10 and 100 objects, eager and compiled.

One thread. `localize` is `Localizer` alone, with a covariance for each pair, compiled step by step
(`whole_graph`) with `cpp_wrapper`;
`associate` pairs as many detections of both images; `match` is `ObjectDisparity` on boxes of 12 px, all of which have
their image in both. One graph is compiled for any number of pairs from two; a single pair goes twice.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import torch
from kornia.geometry.calibration import distort_points, undistort_points
from kornia.geometry.epipolar import triangulate_points
from torch import Tensor

from kcal import Camera, Localizer, Origin, Rig, load_rig
from kcal.pipeline.association import associate
from kcal.rig import RigCovariance, planned_rig
from kcal.track import Detections, ObjectDisparity
from scripts.check.pairing import OPTIONS, SIZE, site_rig
from scripts.shared.page import Lines
from scripts.shared.sections import section
from scripts.shared.timing import children_seconds, times

COUNTS = (1, 10, 100)
PAIRS = 4096
LENSES = {"pinhole": [], "opencv5": [-0.1, 0.02, 1e-4, 1e-4, 0.001], "default": None}
SHIFT = 16


def milliseconds(call: Callable[[], object], calls: int) -> str:
    """Median and 99th percentile of the clock, and processor time of a call, after five calls that do not count."""
    for _ in range(5):
        call()
    found, before = [], time.process_time()
    for _ in range(calls):
        start = time.perf_counter()
        call()
        found.append(1e3 * (time.perf_counter() - start))
    spent = 1e3 * (time.process_time() - before) / calls
    return f"{np.median(found):.2f} / {np.quantile(found, 0.99):.2f} ({spent:.2f})"


def processor() -> float:
    """Seconds of processor time, with those of compilers that were started."""
    return time.process_time() + children_seconds()


def spent(calls: list[Callable[[], object]], rounds: int = 9) -> list[str]:
    """Median milliseconds of processor time of each call; in each round every call runs once."""
    middles = [1e3 * float(np.median(each)) for each in times(calls, rounds, time.process_time)]
    return [f"{middle:.2g}" if middle < 10 else f"{middle:.0f}" for middle in middles]


def localizer(lens: str) -> tuple[Localizer, Tensor, Tensor]:
    """The sample rig or one with other lenses, with a covariance of the cameras, and marks of points from 100 m on."""
    rig = load_rig("assets/sample-rig.json")
    values = LENSES[lens]
    if values is not None:
        camera = Camera.build(focal=(1600, 1605), center=(957, 541), size=SIZE, coefficients=values, model=lens)
        whole = Rig.pair(camera, camera, rig.right_from_left_rotation, rig.right_from_left_translation)
        own = torch.diag(torch.tensor([0.1, 0.1, 0.1, 0.1, 1e-3, *([1e-4] * len(values))], dtype=torch.float64) ** 2)
        whole.covariance = RigCovariance.of(whole, left=own, right=own, pose=1e-9 * torch.eye(6).double())
        rig = whole
    localize = Localizer(rig.placed(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=35.0))
    random = torch.Generator().manual_seed(0)
    depth = 10 ** (2.0 + 1.5 * torch.rand(PAIRS, 1, generator=random).double())
    place = (torch.rand(PAIRS, 2, generator=random).double() - 0.5) * torch.tensor([0.9, 0.5])
    left, right = rig(torch.cat([place, torch.ones(PAIRS, 1)], -1) * depth)[0].unbind(-2)
    return localize, left.detach() + 0.1, right.detach() + 0.1


def backward(call: Callable[..., Tensor], *inputs: Tensor) -> None:
    """Forward and backward by all inputs."""
    call(*(value.detach().clone().requires_grad_() for value in inputs)).sum().backward()


@section("pairing.md", "gradients", lenses=("pinhole", "opencv5"))
def gradients(lenses: tuple[str, ...] = tuple(LENSES)) -> Lines:
    """Tables: compiling, and derivatives beside kornia."""
    made = {lens: localizer(lens) for lens in lenses}
    rows = []
    for lens, (localize, left, right) in made.items():
        torch.compiler.reset()
        run = torch.compile(localize, fullgraph=True, dynamic=True)
        costs = []
        for count in (100, 200):
            start = processor()
            run(left[:count], right[:count])
            costs.append(processor() - start)
        start = processor()
        backward(lambda a, b: run(a, b).enu, left, right)  # noqa: B023
        costs.append(processor() - start)
        calls: list[Callable[[], object]] = []
        for count in (100, PAIRS):
            pair = left[:count], right[:count]
            calls += [lambda f=f, p=pair: f(*p) for f in (localize, run)]  # type: ignore[misc]
        calls += [lambda f=f: backward(lambda a, b: f(a, b).enu, left, right) for f in (localize, run)]  # type: ignore[misc]  # noqa: B023
        rows.append([lens, *(f"{cost:.1f}" for cost in costs), *spent(calls)])
    heads = ["lens", "compiling, s", "second shape, s", "with gradients, s"]
    heads += [
        f"{what}, {how}, ms" for what in ("100", PAIRS, f"{PAIRS} with gradients") for how in ("eager", "compiled")
    ]
    yield "Processor time of `Localizer`, one thread:"
    yield heads
    yield from rows
    camera = made["opencv5"][0].rig.left
    pixels, K, d = made["opencv5"][1], camera.matrix, camera.coefficients
    rays = camera.unproject(pixels)[0]
    flat = rays[:, :2] / rays[:, 2:] * camera.focal + camera.center
    rig = made["pinhole"][0].rig
    seen = torch.cat([rig.right_from_left_rotation, rig.right_from_left_translation[:, None]], -1)
    P, Q = rig.left.matrix @ torch.eye(3, 4).double(), rig.right.matrix @ seen
    a, b = made["pinhole"][1:]
    each: dict[str, list[Callable[[], object]]] = {
        "project, 5 coefficients": [
            lambda: backward(lambda x: camera.project(x)[0], rays),
            lambda: backward(lambda x: distort_points(x, K, d), flat),
        ],
        "unproject, 5 coefficients": [
            lambda: backward(lambda x: camera.unproject(x)[0], pixels),
            lambda: backward(lambda x: undistort_points(x, K, d, num_iters=20), pixels),
        ],
        "triangulate, pinhole": [
            lambda: backward(lambda x, y: Localizer(rig)(x, y).enu, a, b),
            lambda: backward(lambda x, y: triangulate_points(P[None], Q[None], x[None], y[None]), a, b),
        ],
    }
    yield "Millions of points a second, forward and backward:"
    yield ["", "kcal", "kornia"]
    for name, both in each.items():
        yield [name, *(f"{1e-3 * PAIRS / float(value):.2g}" for value in spent(both))]


def boxes(pixels: Tensor) -> Detections:
    """Detections of 12 px around pixels."""
    return Detections.read(torch.cat([pixels - 6, pixels + 6], -1), size=SIZE, first_pixel=0.0)


@section("pairing.md", "latency", calls=3, eager=True)
def latency(calls: int = 200, eager: bool = False) -> Lines:
    """So many calls of each; `eager` leaves out the compiled one."""
    rig = site_rig()
    localize = Localizer(rig.placed(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=35.0))
    compiled = None
    if not eager:
        localize.whole_graph = True
        compiled = torch.compile(localize, fullgraph=True, dynamic=True, options={"cpp_wrapper": True})
    match = ObjectDisparity(planned_rig())
    random = torch.Generator().manual_seed(0)
    texture = torch.rand(1, 1, SIZE[1] // 4, SIZE[0] // 4, generator=random)
    left = 255 * torch.nn.functional.interpolate(texture, scale_factor=4.0, mode="bicubic")[0, 0]
    right = left.roll(-SHIFT, 1)
    rows: list[list[object]] = []
    for count in COUNTS:
        depth = 10 ** torch.empty(count, dtype=torch.float64).uniform_(2.3, 3.7, generator=random)
        place = torch.stack([torch.empty(count).uniform_(-s, s, generator=random) for s in (0.45, 0.25)], -1)
        points = torch.cat([place.double(), torch.ones(count, 1)], -1) * depth[:, None]
        exact = rig(points)[0]
        noisy = exact + 0.1 * torch.randn(2, count, 2, generator=random, dtype=torch.float64).movedim(0, 1)
        pixels, others = noisy.unbind(1)
        covariance = 0.01 * torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
        first, second = boxes(pixels), boxes(others)
        # In images that are shifted by a whole number of pixels, so that all objects are 1 km away.
        objects = (pixels.clamp_min(60.0)).round()
        aims = objects - torch.tensor([SHIFT - 1.0, 0.5], dtype=torch.float64)
        seen = boxes(objects).boxes
        work: list[Callable[[], object]] = [lambda a=pixels, b=others, c=covariance: localize(a, b, c)]  # type: ignore[misc]
        if compiled is not None:
            given = (pixels, others, covariance)
            twice = [torch.cat([value, value])[: max(count, 2)] for value in given]
            if not rows:
                # With ten rows no other size of the inputs is the same, which the compiler would take for a rule.
                start = time.process_time()
                compiled(*(value.repeat(10, *[1] * (value.ndim - 1)) for value in given))
                print(f"compiled in {time.process_time() - start:.0f} s of processor time", flush=True)
            work.append(lambda of=twice: compiled(*of))  # type: ignore[misc]
        work.append(lambda a=first, b=second: associate(rig, a, b, OPTIONS))  # type: ignore[misc]
        work.append(lambda a=seen, b=aims: match(left, right, a, b))  # type: ignore[misc]
        rows.append([count, *(milliseconds(call, calls) for call in work)])
    heads = ["objects", "localize, eager", *(["localize, compiled"] if not eager else []), "associate", "match"]
    yield "Milliseconds a call: median / 99th percentile (processor time, mean)."
    yield heads
    yield from rows
