"""Association and disparity of a detector's boxes on a rendered site, against the truth.

A frame has 30 textured objects from 100 m to 5 km, placed at random so that some hide others, before hills at infinity.
Objects beyond 1 km are 12 px large with a contrast (four standard deviations) of 30 gray levels. The noise of the
images moves an edge pixel by 0.3 px: it is 0.3 of the median slope in the objects. Each edge of a box errs by 2 px. 5 %
of the detections are missing in each image, and as many false ones are added; what is hidden by half is not detected.

Time of one frame from detections to positions: 1, 10 and 100 objects, eager and compiled.

One thread. `localize` is `Localizer` alone, with a covariance for each pair, compiled step by step
(`whole_graph`) with `cpp_wrapper`;
`associate` pairs as many detections of both images; `match` is `ObjectDisparity` on boxes of 12 px, all of which have
their image in both. One graph is compiled for any number of pairs from two; a single pair goes twice.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from kornia.geometry.calibration import distort_points, undistort_points
from kornia.geometry.epipolar import triangulate_points
from torch import Tensor

from kcal import Camera, Localizer, Origin, Rig, load_rig
from kcal.corners import MatchStatus
from kcal.lens import rotation_from_vector
from kcal.pipeline.association import AssociationOptions, associate
from kcal.rig import RigCovariance, planned_rig
from kcal.track import Detections, ObjectDisparity
from scripts.shared.marking_scene import (
    Floats,
    Plate,
    background,
    exposed,
    paint_plate,
    plate,
    texture_gradient,
    true_box,
)
from scripts.shared.page import Lines, children_seconds, section, table, timed, times
from scripts.shared.page import rms as rms_of

SIZE, FOCAL, TARGETS = (1920, 1080), 1600.0, 30
BOX_EDGE, MISSING, NOISE = 2.0, 0.05, 0.3
OPTIONS = AssociationOptions(box_sigma=BOX_EDGE / np.sqrt(2), nearest=90.0)
RANGES = ((100.0, 500.0), (500.0, 1500.0), (1500.0, 5000.0))


def site_rig() -> Rig:
    """Two cameras 10 m apart with mild lenses, roughly parallel, whose relative pose is known to 0.003°."""
    lens = [-0.15, 0.04, 3e-4, -2e-4]
    cameras = [
        Camera.build(focal=(FOCAL + d, FOCAL + 2 + d), center=(958 + d, 541 - d), size=SIZE, coefficients=lens)
        for d in (0, 5)
    ]
    turn = rotation_from_vector(torch.tensor([0.004, -0.006, 0.01], dtype=torch.float64))
    rig = Rig.pair(cameras[0], cameras[1], turn, torch.tensor([-10.0, 0.15, 0.1]))
    sigma = torch.tensor([5e-5, 5e-5, 1e-4, 5e-3, 5e-3, 5e-3], dtype=torch.float64)
    rig.covariance = RigCovariance.of(rig, pose=torch.diag(sigma**2))
    return rig


class Frame(NamedTuple):
    """Both images, detections with the numbers of their objects (-1: false), and the objects, nearest last."""

    images: list[torch.Tensor]
    seen: list[Detections]
    numbers: list[list[int]]
    items: list[Plate]


def frame(rig: Rig, random: np.random.Generator) -> Frame:
    depths = np.sort(10 ** random.uniform(2.0, np.log10(5000.0), TARGETS))[::-1]
    items = []
    for depth in depths:
        size = 12.0 * min(max(1000.0 / depth, 1.0) ** 0.7, 5.0)
        pixel = torch.tensor([[random.uniform(200, 1800), random.normal(540, 60)]], dtype=torch.float64)
        ray, _ = rig.left.unproject(pixel)
        point = ray[0] / ray[0, 2] * depth
        items.append(plate(point, (size, size), FOCAL, 30.0, random, (5.0, max(14.0, 0.3 * size))))
    seed = int(random.integers(1 << 30))
    images = [background(rig, side, np.random.default_rng(seed)) for side in (0, 1)]
    boxes = [[true_box(rig, side, item) for item in items] for side in (0, 1)]
    for side in (0, 1):
        for item in items:
            paint_plate(images[side], rig, side, item)
    sigma = NOISE * float(np.median([texture_gradient(images[0], box) for box in boxes[0]]))
    seen, numbers = [], []
    for side in (0, 1):
        kept = [
            i for i, box in enumerate(boxes[side])
            if not hidden(box, boxes[side][i + 1 :]) and inside(box) and random.uniform() > MISSING
        ]  # fmt: skip
        found = [boxes[side][i] for i in kept]
        for _ in range(random.poisson(MISSING * TARGETS)):
            u, v, half = random.uniform(100, 1800), random.normal(540, 60), random.uniform(5, 12)
            found.append(np.array([u - half, v - half, u + half, v + half]))
        noisy = np.array(found) + random.normal(0, BOX_EDGE, (len(found), 4))
        small = (noisy[:, 2:] - noisy[:, :2]).min(1) < 3
        noisy[small] = np.array(found)[small]
        seen.append(Detections.read(noisy, size=SIZE, first_pixel=0.0))
        numbers.append(kept + [-1] * (len(found) - len(kept)))
    return Frame([exposed(image, sigma, random) for image in images], seen, numbers, items)


def hidden(box: Floats, nearer: list[Floats]) -> bool:
    """Whether the boxes of nearer objects cover half of it."""
    u, v = np.meshgrid(np.linspace(box[0], box[2], 15), np.linspace(box[1], box[3], 15))
    covered = np.zeros(u.shape, dtype=bool)
    for left, top, right, bottom in nearer:
        covered |= (u > left) & (u < right) & (v > top) & (v < bottom)
    return bool(covered.mean() > 0.5)


def inside(box: Floats) -> bool:
    return bool(box[0] > 5 and box[1] > 5 and box[2] < SIZE[0] - 6 and box[3] < SIZE[1] - 6)


class Pair(NamedTuple):
    """A right pair: range, error of the disparity by boxes and by matching, its stated sigma, and the status."""

    depth: float
    by_boxes: float
    by_match: float
    sigma: float
    status: int


class Counts(NamedTuple):
    """Pairs made, right ones among them, and all that were to be made; then of those that are not ambiguous."""

    made: int
    right: int
    there: int
    clear: int
    clear_right: int


def associated(rig: Rig, view: Frame, *, looks: bool) -> tuple[Counts, list[tuple[int, int]]]:
    images = (view.images[0], view.images[1]) if looks else None
    found = associate(rig, view.seen[0], view.seen[1], OPTIONS, images)
    named = [
        (view.numbers[0][i], view.numbers[1][j]) for i, j in zip(found.left.tolist(), found.right.tolist(), strict=True)
    ]
    good = [first == second != -1 for first, second in named]
    clear = (~found.ambiguous).tolist()
    there = len({*view.numbers[0]} & {*view.numbers[1]} - {-1})
    both = sum(a and b for a, b in zip(good, clear, strict=True))
    numbers = zip(found.left.tolist(), found.right.tolist(), strict=True)
    right = [pair for pair, ok in zip(numbers, good, strict=True) if ok]
    return Counts(len(named), sum(good), there, sum(clear), both), right


def disparities(rig: Rig, view: Frame, pairs: list[tuple[int, int]]) -> list[Pair]:
    left, right = (view.seen[side].select(torch.tensor([pair[side] for pair in pairs])) for side in (0, 1))
    anchors, aims = left.anchors(), right.anchors()
    found = ObjectDisparity(rig)(view.images[0], view.images[1], left.boxes, aims)
    depths = torch.tensor([float(view.items[view.numbers[0][i]].point[2]) for i, _ in pairs], dtype=torch.float64)
    rays, _ = rig.left.unproject(anchors)
    truth, _ = rig.right.project(rig.right_from_left(rays * (depths / rays[:, 2])[:, None]))
    boxes, match, sigma = (aims - truth)[:, 0], (found.pixels - truth)[:, 0], found.covariance[:, 0, 0].sqrt()
    columns = [column.tolist() for column in (depths, boxes, match, sigma, found.status)]
    return [Pair(*row) for row in zip(*columns, strict=True)]


def rms(values: list[float]) -> str:
    return f"{rms_of(values):.3f}" if values else "none"


def pair_row(name: str, pairs: list[Pair]) -> list[str]:
    good = [pair for pair in pairs if pair.status == MatchStatus.GOOD]
    ratio = np.abs([pair.by_match / pair.sigma for pair in good])
    wild = int(np.sum(ratio > 5))
    return [
        name, str(len(pairs)), rms([pair.by_boxes for pair in pairs]), rms([pair.by_match for pair in good]),
        f"{np.median(np.abs([pair.by_match for pair in good])) * 1.4826:.3f}", rms([pair.sigma for pair in good]),
        f"{np.mean(ratio < 1.96):.1%}", f"{wild}", f"{1 - len(good) / len(pairs):.1%}",
    ]  # fmt: skip


@functools.cache
def drawn(frames: int, seed: int) -> tuple[dict[bool, list[Counts]], list[Pair]]:
    """Counts of each frame, without and with looks, and right pairs."""
    rig, random = site_rig(), np.random.default_rng(seed)
    counts: dict[bool, list[Counts]] = {False: [], True: []}
    pairs: list[Pair] = []
    for _ in range(frames):
        view = frame(rig, random)
        for looks, some in counts.items():
            count, right = associated(rig, view, looks=looks)
            some.append(count)
        pairs += disparities(rig, view, right)
    return counts, pairs


@section("pairing.md", "association", frames=1)
def association(frames: int = 20, seed: int = 0) -> Lines:
    yield f"{frames} frames of {TARGETS} objects."
    yield ["pairs by", "to be found", "precision", "recall", "precision of those not ambiguous", "ambiguous"]
    for looks, some in drawn(frames, seed)[0].items():
        total = Counts(*np.sum(some, axis=0).tolist())
        yield [
            "geometry, size and looks" if looks else "geometry and size", total.there,
            f"{total.right / total.made:.1%}", f"{total.right / total.there:.1%}",
            f"{total.clear_right / total.clear:.1%}", f"{1 - total.clear / total.made:.1%}",
        ]  # fmt: skip


@section("pairing.md", "disparity", frames=1)
def disparity(frames: int = 20, seed: int = 0) -> Lines:
    pairs = drawn(frames, seed)[1]
    binned = {f"{low:g} to {high:g} m": [pair for pair in pairs if low <= pair.depth < high] for low, high in RANGES}
    heads = ["range", "pairs", "by boxes: RMS px", "by matching: RMS px", "1.48 median px", "stated σ px", "in 95 %",
             "beyond 5 σ", "refused"]  # fmt: skip
    return table(heads, (pair_row(name, part) for name, part in {**binned, "all": pairs}.items() if part))


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
                _, seconds = timed(compiled, *(value.repeat(10, *[1] * (value.ndim - 1)) for value in given))
                print(f"compiled in {seconds:.0f} s of processor time", flush=True)
            work.append(lambda of=twice: compiled(*of))  # type: ignore[misc]
        work.append(lambda a=first, b=second: associate(rig, a, b, OPTIONS))  # type: ignore[misc]
        work.append(lambda a=seen, b=aims: match(left, right, a, b))  # type: ignore[misc]
        rows.append([count, *(milliseconds(call, calls) for call in work)])
    heads = ["objects", "localize, eager", *(["localize, compiled"] if not eager else []), "associate", "match"]
    yield "Milliseconds a call: median / 99th percentile (processor time, mean)."
    yield heads
    yield from rows
