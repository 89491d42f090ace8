"""Whether a pixel has two valid rays, on lenses that are built to fold where it is hard to see.

The numerator and the denominator of a radial factor that nearly cancel, denominators and derivatives with nearly double
roots, the same with tangential, prism and tilt terms, and coefficients at random. Two rays are looked for without what
`kcal.lens.region` knows of a lens: valid points are sampled, ever more densely around the complex roots of the
numerator, of the denominator and of the derivative. Newton's method then starts from those with nearly equal images,
and from the neighborhood of points that the lens turns over.

Whether the inverse of the lens is right or says so, on thousands of random lenses from mild to absurd.

For each lens two questions are asked. Points all over its valid region are projected: does the inverse find them
again? And pixels all over the image and a margin of half its size: do those that it calls valid project back to
themselves?

Points where a fold is so near that the lens flattens 10000 to 1 are left out of the first question: there the ray is
not determined by the pixel. Round trips may be off by 1e-9 px and what the lens makes of the rounding of its input.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections import Counter
from typing import NamedTuple

import numpy as np
import torch
from numpy.polynomial import Polynomial
from torch import Tensor

from kcal import CalibrationOptions, Camera, calibrate_camera
from kcal.lens import LensModel
from kcal.lens.inverse import inverse_jacobian, newton_step, prepare_inverse, undistort
from kcal.lens.model import distort_components
from kcal.lens.projection import from_pixels
from kcal.lens.region import DIRECTIONS, Region, direction_limits, in_region, sampled_region, valid_region
from scripts.check.uncertainty import LENS
from scripts.shared.page import Lines, section, table
from scripts.shared.real_captures import load, stereo_images

FOCAL, SIZE = 1000.0, (1920, 1080)
# Directions and radii at which valid points are sampled; the radii of a narrow fold at these distances from its root.
SPOKES, RADII = 3, 40
NEAR = np.concatenate([-np.logspace(-7, -0.7, 20)[::-1], [0.0], np.logspace(-7, -0.7, 20)])
# Rays closer together than this, on the plane z = 1, count as one.
SEPARATE = 1e-6
RATIONAL = ("opencv8", "opencv12", "opencv14", "ext20", "ext24")


class Lens(NamedTuple):
    """A constructed lens: how it was built, its model and its coefficients (P,)."""

    kind: str
    model: LensModel
    coefficients: Tensor


def compose(name: str, numerator: Polynomial, denominator: Polynomial | None, others: dict[str, float]) -> Lens:
    """A lens with these polynomials in r², cut off where the model has no more coefficients."""
    model = LensModel.named(name)
    values = torch.zeros(model.size, dtype=torch.float64)
    for places, factor in ((model.numerator_index, numerator), (model.denominator_index, denominator)):
        for place, value in zip(places, factor.coef[1:] if factor else (), strict=False):
            values[place] = float(value)
    for term, value in others.items():
        if term in model.names:
            values[model.names.index(term)] = value
    return Lens("", model, values)


def construct(generator: np.random.Generator) -> Lens:
    """Draw a lens that is hard to judge."""
    draw, normal = generator.uniform, generator.standard_normal
    kind = generator.choice(["cancelling", "pole", "derivative", "random"], p=[0.4, 0.2, 0.2, 0.2])
    root, tiny, s = draw(0.1, 1.3) ** 2, 10.0 ** draw(-12, -2), Polynomial([0.0, 1.0])
    double = (1 - s / root) ** 2 * (1 + draw(-0.2, 0.4) * s)
    name = str(generator.choice(RATIONAL))
    if name.startswith("ext") and draw() < 0.5:
        double = double * (1 - s / draw(0.1, 1.3) ** 2) ** 2
    others = dict.fromkeys(("p1", "p2", "s1", "s2", "s3", "s4", "s5", "s6", "tau_x", "tau_y"), 0.0)
    share = draw()
    if share < 0.7:
        size = 10.0 ** draw(-9, -1.3)
        others = {term: size * normal() if term[0] != "t" else min(1.0, 10 * size) * draw(-0.3, 0.3) for term in others}
    if kind == "cancelling":
        numerator, denominator = (double + tiny * (abs(normal()) * s + normal() * s**2) for _ in range(2))
        lens = compose(name, numerator, denominator, others)
    elif kind == "pole":
        lens = compose(name, 1 + 0.1 * normal() * s, double + tiny * abs(normal()) * s, others)
    elif kind == "derivative":
        slope = double + tiny * normal() * s
        name = str(generator.choice(["opencv5", "opencv8", "fisheye4", "ext24"]))
        lens = compose(name, Polynomial(slope.coef / (2 * np.arange(len(slope.coef)) + 1)), None, others)
    else:
        model = LensModel.named(str(generator.choice(["opencv4", "opencv5", *RATIONAL])))
        lens = Lens("", model, torch.from_numpy(10.0 ** draw(-2, -0.3) * normal(model.size)))
    if share > 0.9:
        # The same lens as a model without other terms, which has a valid region of its own kind.
        full = lens.model
        model = LensModel(numerator=full.numerator, denominator=full.denominator, fisheye=full.fisheye)
        lens = Lens("", model, lens.coefficients[[full.names.index(own) for own in model.names]])
    return lens._replace(kind=str(kind))


def radial_polynomials(lens: Lens) -> tuple[Polynomial, Polynomial, Polynomial]:
    """Numerator, denominator and derivative of the radial part, as polynomials in r²."""
    model, values = lens.model, lens.coefficients.numpy()
    numerator = Polynomial([1.0, *values[list(model.numerator_index)]])
    denominator = Polynomial([1.0, *values[list(model.denominator_index)]])
    s = Polynomial([0.0, 1.0])
    slope = numerator * denominator + 2 * s * (numerator.deriv() * denominator - numerator * denominator.deriv())
    return numerator, denominator, slope


def sample(lens: Lens, region: Region, generator: np.random.Generator) -> Tensor:
    """Valid points (2, N) of a lens, dense where its radial part is nearly singular."""
    roots = np.concatenate([np.atleast_1d(each.roots()) for each in radial_polynomials(lens)])
    radii = np.sqrt(roots.real[(roots.real > 1e-4) & (roots.real < 10.0)])
    radii = np.unique(np.concatenate([np.linspace(0.02, 2.0, RADII), *(r * (1.0 + NEAR) for r in radii)]))
    angle = generator.uniform(0.0, 2 * math.pi) + np.arange(SPOKES) * (2 * math.pi / SPOKES)
    angle = angle + generator.choice([0.0, 1e-3], SPOKES)
    x, y = (torch.from_numpy(np.outer(radii, f(angle)).ravel()) for f in (np.cos, np.sin))
    valid = in_region(x, y, lens.coefficients, lens.model, region)
    return torch.stack([x[valid], y[valid]])


def two_rays(lens: Lens, region: Region, generator: np.random.Generator) -> Tensor | None:
    """Two valid points (2, 2) of the plane with the same image, if any are found."""
    for starts in (near_pairs, around_folds):
        x, y, goal_x, goal_y = starts(lens, region, generator)
        for _ in range(12):
            here = distort_components(x, y, lens.coefficients, lens.model)
            x, y = newton_step(x, y, here.x - goal_x, here.y - goal_y, inverse_jacobian(here.point))
        here = distort_components(x, y, lens.coefficients, lens.model)
        solved = torch.hypot(here.x - goal_x, here.y - goal_y) < 1e-12 * (1.0 + torch.hypot(goal_x, goal_y))
        good = solved & in_region(x, y, lens.coefficients, lens.model, region)
        # The outermost two solutions of each target.
        along = torch.where(good, x + 0.1 * y, torch.nan)
        low, high = (f(along.nan_to_num(nan), -1).indices[:, None] for f, nan in ((torch.min, 1e9), (torch.max, -1e9)))
        pair = [torch.cat([value.gather(-1, low), value.gather(-1, high)], -1) for value in (x, y, here.determinant)]
        distance = torch.hypot(pair[0][:, 1] - pair[0][:, 0], pair[1][:, 1] - pair[1][:, 0])
        # Near a fold, rounding alone moves a point: both must be determined by their image.
        found = good.any(-1) & (distance > SEPARATE) & (pair[2].amin(-1) * distance > 1e-9)
        if bool(found.any()):
            best = int(torch.where(found, distance, 0.0).argmax())
            return torch.stack([pair[0][best], pair[1][best]], -1)
    return None


def near_pairs(lens: Lens, region: Region, generator: np.random.Generator) -> tuple[Tensor, ...]:
    """Valid points, and others whose images lie closer by than a regular part of a lens brings them; each (N, K)."""
    x, y = sample(lens, region, generator)
    image = distort_components(x, y, lens.coefficients, lens.model)
    apart = torch.hypot(x[:, None] - x, y[:, None] - y)
    together = torch.hypot(image.x[:, None] - image.x, image.y[:, None] - image.y)
    ratio = torch.where(apart > 0.5 * SEPARATE, together / apart, torch.inf).fill_diagonal_(-1.0)
    nearest = ratio.topk(min(5, len(x)), -1, largest=False).indices
    return x[nearest], y[nearest], image.x[:, None], image.y[:, None]


def around_folds(lens: Lens, region: Region, generator: np.random.Generator) -> tuple[Tensor, ...]:
    """Starts (N, K) around points that the lens turns over, whose images have more than one preimage if any have."""
    angle = torch.from_numpy(generator.uniform(0.0, 2 * math.pi, 8000))
    unit_x, unit_y = torch.cos(angle), torch.sin(angle)
    edge = torch.maximum(region.radius, region.fraction(unit_x, unit_y).clamp(min=1e-3).reciprocal()).clamp(max=3.0)
    radius = 1.1 * edge * torch.from_numpy(generator.uniform(0.0, 1.0, 8000)).sqrt()
    x, y = radius * unit_x, radius * unit_y
    image = distort_components(x, y, lens.coefficients, lens.model)
    turned = (image.positive & (image.determinant < 0)).nonzero()[:, 0][:120]
    step = torch.tensor([0.01, 0.03, 0.1, 0.3], dtype=torch.float64)[:, None]
    around = torch.arange(8, dtype=torch.float64) * (math.pi / 4)
    offset_x, offset_y = ((step * f(around)).flatten() for f in (torch.cos, torch.sin))
    return x[turned, None] + offset_x, y[turned, None] + offset_y, image.x[turned, None], image.y[turned, None]


def sampled(lens: Lens) -> Region:
    """The region by samples alone, without proof."""
    directions = 1 if lens.model.radial else DIRECTIONS
    return sampled_region(lens.coefficients, lens.model, direction_limits(lens.coefficients, lens.model, directions))


def constructed(count: int, seed: int, compared: int, minutes: float) -> Lines:
    """How many constructed lenses have two rays; of the first ones also without the proof."""
    end = time.monotonic() + 60.0 * minutes
    generator, tally = np.random.default_rng(seed), Counter[tuple[str, str]]()
    for number in range(count):
        if time.monotonic() > end:
            break
        lens, place = construct(generator), int(generator.integers(1 << 30))
        tally[lens.kind, "all"] += 1
        if number < compared:
            tally[lens.kind, "compared"] += 1
            tally[lens.kind, "before"] += two_rays(lens, sampled(lens), np.random.default_rng(place)) is not None
        region = valid_region(lens.coefficients, lens.model)
        found = two_rays(lens, region, np.random.default_rng(place))
        if found is not None:
            tally[lens.kind, "after"] += 1
            print(number, lens.kind, lens.model, lens.coefficients.tolist(), found.tolist(), flush=True)
        if (number + 1) % 500 == 0:
            print(number + 1, dict(tally), flush=True)
    kinds = sorted({kind for kind, _ in tally})
    rows = [
        [kind, tally[kind, "all"], tally[kind, "after"], f"{tally[kind, 'before']} of {tally[kind, 'compared']}"]
        for kind in kinds
    ]
    total = {name: sum(tally[kind, name] for kind in kinds) for name in ("all", "after", "before", "compared")}
    rows.append(["together", total["all"], total["after"], f"{total['before']} of {total['compared']}"])
    return table(["radial part", "lenses", "with two rays", "with two rays before the proof"], rows)


def lost_pixels(camera: Camera, step: int) -> tuple[int, int]:
    """Pixels of the image, every `step`-th, that are valid without the proof, and those of them that it takes away."""
    width, height = camera.size
    pixels = camera.grid(width // step, height // step).reshape(-1, 2)
    values = camera.params.detach()
    points = torch.stack(from_pixels(pixels[:, 0], pixels[:, 1], values), -1)
    ready = prepare_inverse(values[5:], camera.model, torch.hypot(*points.unbind(-1)).max())
    _, valid = undistort(points, values[5:], camera.model, ready)
    unproven = ready._replace(region=sampled(Lens("", camera.model, values[5:])))
    _, before = undistort(points, values[5:], camera.model, unproven)
    return int(before.sum()), int((before & ~valid).sum())


def mild(generator: np.random.Generator) -> Camera:
    """A camera with coefficients as calibrations find them; many fold beyond the image, some inside it."""
    model = LensModel.named(str(generator.choice(["opencv4", "opencv5", *RATIONAL, "fisheye4"])))
    sigma = {"k1": 0.15, "k2": 0.05, "k3": 0.01, "k4": 0.05, "k5": 0.02, "k6": 0.005, "tau_x": 0.01, "tau_y": 0.01}
    values = [sigma.get(name, 1e-3) * generator.standard_normal() for name in model.names]
    values[0] -= 0.0 if model.fisheye else 0.1
    return Camera.build(focal=(FOCAL, FOCAL), center=(959.5, 539.5), size=SIZE, coefficients=values, model=model)


def calibrated() -> list[Camera]:
    """Cameras of the real views, with parametric models."""
    sources = [load("wide").seen, stereo_images("left"), stereo_images("right")]
    models = ("opencv5", "opencv8", "opencv14", "ext20", "ext24")
    return [
        calibrate_camera(seen, CalibrationOptions(model=model, weak_prior=weak)).camera
        for seen in sources
        for model in models
        for weak in ((0.3, None) if model in ("opencv5", "opencv8") else (0.3,))
    ]


def ordinary_lenses(count: int, seed: int) -> Lines:
    """Valid pixels that ordinary cameras lose by the proof."""
    generator = np.random.default_rng(seed)
    groups: dict[str, tuple[list[Camera], int]] = {
        "calibrated on real views": (calibrated(), 2),
        "of the simulations in scripts/check": (
            [
                Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=SIZE, coefficients=LENS[:size], model=name)
                for name, size in (("opencv5", 5), ("opencv8", 8), ("opencv14", 14))
            ],
            2,
        ),
        "drawn at random": ([mild(generator) for _ in range(count)], 8),
    }
    yield ["cameras", "number", "that fold inside the image", "valid pixels", "lost"]
    for name, (cameras, step) in groups.items():
        counts = [lost_pixels(camera, step) for camera in cameras]
        folding = sum(not bool(camera.covers_image()) for camera in cameras)
        yield [name, len(cameras), folding, sum(all_ for all_, _ in counts), sum(lost for _, lost in counts)]


@section("lens.md", "folds", lenses=3, compared=1, ordinary=0)
def folds(
    lenses: int = 10_000, compared: int = 1000, minutes: float = math.inf, ordinary: int = 400, seed: int = 0
) -> Lines:
    yield from constructed(lenses, seed, compared, minutes)
    if ordinary:
        yield ""
        yield from ordinary_lenses(ordinary, seed)


MODELS = ("opencv4", "opencv5", "opencv8", "opencv12", "opencv14", "ext20", "ext24", "fisheye4")
# Standard deviation of every coefficient: 0.01 is an ordinary lens, 0.9 has folds and poles all over.
SCALES = (0.01, 0.03, 0.1, 0.3, 0.9)
BATCH = 8
FLAT = 1e-4
# How far off axis points are looked for, on the plane z = 1 or in radians, and how far out their images may lie.
REACH, MARGIN = 1.5, 3.0
PIXELS = 1e-9


@dataclasses.dataclass
class Tally:
    """What was counted: points and pixels asked for, and how many of them came out wrong."""

    points: int = 0
    lost: int = 0
    elsewhere: int = 0
    pixels: int = 0
    valid: int = 0
    wrong: int = 0
    worst: float = 0.0

    def add(self, other: Tally) -> None:
        """Add another count to this one."""
        for field in dataclasses.fields(self):
            combine = max if field.name == "worst" else sum
            setattr(self, field.name, combine((getattr(self, field.name), getattr(other, field.name))))


def jacobian(normalized: Tensor, coefficients: Tensor, model: LensModel) -> Tensor:
    """Derivative (..., N, 2, 2) of the distorted position by the point (..., N, 2)."""
    lens = distort_components(normalized[..., 0], normalized[..., 1], coefficients, model)
    return torch.stack(lens.point, -1).unflatten(-1, (2, 2))


def check_points(lenses: Tensor, model: LensModel, count: int, generator: torch.Generator) -> Tally:
    """Points of the valid region there and back; lenses are (B, P)."""
    ready = prepare_inverse(lenses, model)
    angle = torch.rand(len(lenses), count, generator=generator, dtype=torch.float64) * 2 * math.pi
    unit_x, unit_y = torch.cos(angle), torch.sin(angle)
    edge = torch.maximum(ready.region.radius[:, None], ready.region.fraction(unit_x, unit_y).reciprocal())
    radius = torch.sqrt(torch.rand(len(lenses), count, generator=generator, dtype=torch.float64))
    radius = radius * edge.clamp(max=REACH)
    x, y = radius * unit_x, radius * unit_y
    image = distort_components(x, y, lenses, model)
    singular = torch.linalg.svdvals(jacobian(torch.stack([x, y], -1), lenses, model))[..., -1]
    asked = in_region(x, y, lenses, model, ready.region) & (singular > FLAT)
    asked &= (image.x.abs() < MARGIN) & (image.y.abs() < MARGIN)
    back, valid = undistort(torch.stack([image.x, image.y], -1), lenses, model, ready)
    error = torch.hypot(back[..., 0] - x, back[..., 1] - y)
    elsewhere = error > 1e-11 * (1 + torch.hypot(image.x, image.y)) / singular
    return Tally(
        points=int(asked.sum()), lost=int((asked & ~valid).sum()), elsewhere=int((asked & valid & elsewhere).sum())
    )


def check_pixels(lenses: Tensor, model: LensModel, count: int, generator: torch.Generator) -> Tally:
    """Pixels of the image and a margin there and back."""
    head = torch.tensor([2000.0, 1900.0, 960.0, 540.0, 0.0], dtype=torch.float64).expand(len(lenses), 5)
    camera = Camera(torch.cat([head, lenses], -1), size=(1920, 1080), model=model)
    pixels = torch.rand(len(lenses), count, 2, generator=generator, dtype=torch.float64) - 0.25
    pixels = pixels * torch.tensor([3840.0, 2160.0], dtype=torch.float64)
    rays, valid = camera.unproject(pixels)
    again, seen = camera.project(rays * 5.0)
    error = torch.linalg.vector_norm(again - pixels, dim=-1)
    point, _ = undistort((pixels - camera.center[:, None]) / camera.focal[:, None], lenses, model)
    steepest = torch.linalg.matrix_norm(jacobian(point, lenses, model), ord=2)
    reach = 1 + torch.linalg.vector_norm(point, dim=-1)
    allowed = PIXELS + 4 * torch.finfo(torch.float64).eps * reach * steepest * 2000.0
    wrong = valid & ~(seen & (error < allowed) & torch.isfinite(rays).all(-1))
    ordinary = valid & seen & (allowed < 2 * PIXELS)
    worst = float(error[ordinary].max()) if bool(ordinary.any()) else 0.0
    return Tally(pixels=valid.numel(), valid=int(valid.sum()), wrong=int(wrong.sum()), worst=worst)


def sweep(lenses: int, seed: int, points: int = 200) -> Tally:
    """Check at least so many lenses, spread over all models and scales."""
    total = Tally()
    generator = torch.Generator().manual_seed(seed)
    rounds = math.ceil(lenses / (len(MODELS) * len(SCALES) * BATCH))
    jobs = [(model, scale) for model in MODELS for scale in SCALES for _ in range(rounds)]
    for name, scale in jobs:
        model = LensModel.named(name)
        coefficients = scale * torch.randn(BATCH, model.size, generator=generator, dtype=torch.float64)
        total.add(check_points(coefficients, model, points, generator))
        total.add(check_pixels(coefficients, model, points, generator))
    return total
