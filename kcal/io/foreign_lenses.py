"""Lenses of other programs that no parametric model of kcal is: their formulas, and kcal's camera nearest to one.

One table, `LENSES`, has the published projection of each. From it follow the rays of pixels, the hybrid camera that
stands for a lens that is read, and the lens that stands for a camera that is written.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

import kcal.io.foreign as foreign
from kcal.errors import DegenerateError
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.model import HybridForm, LensModel, radius_over_angle
from kcal.lens.projection import angle_over_distance, project_components
from kcal.lens.zernike import ZernikeModes
from kcal.threads import in_one_thread

Plane = tuple[Tensor, Tensor, Tensor]


class ForeignLens(NamedTuple):
    """A lens: the names of its parameters, and where rays of length one meet its plane.

    Args:
        names: of the parameters after the focal lengths and the principal point.
        plane: x, y and whether there is one, of the parameters (P,) and X, Y, Z (N,) each.
        limits: below and above each of the first parameters, both exclusive.
        starts: parameters from which a fit begins; those that are left out begin at zero.
    """

    names: tuple[str, ...]
    plane: Callable[[Sequence[Tensor], Tensor, Tensor, Tensor], Plane]
    limits: tuple[tuple[float, float], ...] = ()
    starts: tuple[tuple[float, ...], ...] = ((),)


def _powers(square: Tensor, factors: Sequence[Tensor]) -> Tensor:
    """The sum of factors times r², r⁴, ..."""
    total = torch.zeros_like(square)
    for factor in reversed(factors):
        total = square * (factor + total)
    return total


def _bent(x: Tensor, y: Tensor, k: Sequence[Tensor], p: Sequence[Tensor] = (), s: Sequence[Tensor] = ()) -> Plane:
    """Radial terms; tangential ones in OpenCV's order, then factors of theirs; a thin prism's, s[:2] across."""
    square, one = x * x + y * y, 1.0 + _powers(x * x + y * y, p[2:])
    across, down = x + x * _powers(square, k) + _powers(square, s[:2]), y + y * _powers(square, k)
    if p:
        across = across + one * (2.0 * p[0] * x * y + p[1] * (square + 2.0 * x * x))
        down = down + one * (p[0] * (square + 2.0 * y * y) + 2.0 * p[1] * x * y)
    return across, down + _powers(square, s[2:]), square >= 0


def _at_depth(X: Tensor, Y: Tensor, depth: Tensor) -> Plane:
    """The plane at the depth one, and what is in front of it."""
    there = depth > 1e-9
    below = torch.where(there, depth, 1.0)
    return X / below, Y / below, there


def _on_angles(X: Tensor, Y: Tensor, Z: Tensor) -> tuple[Tensor, Tensor]:
    """Directions times the angle from the axis."""
    scale = angle_over_distance(X, Y, Z)
    return X * scale, Y * scale


def _omni(v: Sequence[Tensor], X: Tensor, Y: Tensor, Z: Tensor) -> Plane:
    x, y, there = _at_depth(X, Y, Z + v[0])
    return *_bent(x, y, v[1:3], v[3:5])[:2], there


def _double_sphere(v: Sequence[Tensor], X: Tensor, Y: Tensor, Z: Tensor) -> Plane:
    depth = Z + v[0]
    return _at_depth(X, Y, v[1] * (X * X + Y * Y + depth * depth).sqrt() + (1.0 - v[1]) * depth)


def _eucm(v: Sequence[Tensor], X: Tensor, Y: Tensor, Z: Tensor) -> Plane:
    return _at_depth(X, Y, v[0] * (v[1] * (X * X + Y * Y) + Z * Z).sqrt() + (1.0 - v[0]) * Z)


def _fov(v: Sequence[Tensor], X: Tensor, Y: Tensor, Z: Tensor) -> Plane:
    wide = 2.0 * torch.tan(0.5 * v[0])
    scale = wide / v[0] * angle_over_distance(wide * X, wide * Y, Z)
    return X * scale, Y * scale, Z > 1e-9


def _division(v: Sequence[Tensor], X: Tensor, Y: Tensor, Z: Tensor) -> Plane:
    root = Z * Z - 4.0 * v[0] * (X * X + Y * Y)
    x, y, there = _at_depth(X, Y, 0.5 * (Z + root.clamp_min(1e-30).sqrt()))
    return x, y, there & (root > 0)


def _theta(v: Sequence[Tensor], X: Tensor, Y: Tensor, Z: Tensor) -> Plane:
    """k1 to k6, p1, p2, s0 to s3, all of the angle: THIN_PRISM_FISHEYE and OpenSfM's fisheye62 are parts of it."""
    return _bent(*_on_angles(X, Y, Z), v[:6], v[6:8], v[8:])


def _rad_tan_thin_prism(v: Sequence[Tensor], X: Tensor, Y: Tensor, Z: Tensor) -> Plane:
    """The radial terms of the angle, then the others of what they give; p0 and p1 are OpenCV's p2 and p1."""
    x, y, _ = _bent(*_on_angles(X, Y, Z), v[:6])
    return _bent(x, y, (), (v[7], v[6]), v[8:])


def _dual(v: Sequence[Tensor], X: Tensor, Y: Tensor, Z: Tensor) -> Plane:
    (x, y, there), (across, down) = _at_depth(X, Y, Z), _on_angles(X, Y, Z)
    x, y = v[0] * x + (1.0 - v[0]) * across, v[0] * y + (1.0 - v[0]) * down
    return *_bent(x, y, v[1:3])[:2], there


def _frame(v: Sequence[Tensor], X: Tensor, Y: Tensor, Z: Tensor) -> Plane:
    x, y, there = _at_depth(X, Y, Z)
    return *_bent(x, y, v[:4], v[4:])[:2], there


def _fisheye(v: Sequence[Tensor], X: Tensor, Y: Tensor, Z: Tensor) -> Plane:
    return _bent(*_on_angles(X, Y, Z), v[:4], v[4:])


def _modified(v: Sequence[Tensor], X: Tensor, Y: Tensor, Z: Tensor) -> Plane:
    """RealSense's: tangential terms of what radial ones give, but r of the ray."""
    x, y, there = _at_depth(X, Y, Z)
    square, (a, b, _) = x * x + y * y, _bent(x, y, (v[0], v[1], v[4]))
    across = a + 2.0 * v[2] * a * b + v[3] * (square + 2.0 * a * a)
    return across, b + 2.0 * v[3] * a * b + v[2] * (square + 2.0 * b * b), there


def _equisolid(v: Sequence[Tensor], X: Tensor, Y: Tensor, Z: Tensor) -> Plane:
    """Twice the sine of half the angle from the axis."""
    scale = (2.0 / (1.0 + Z).clamp_min(1e-9)).sqrt()
    return _bent(X * scale, Y * scale, v[:4], v[4:])


_THETA = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s0", "s1", "s2", "s3")
# Names of Metashape in the order of OpenCV, whose p1 is its p2.
_PARTIAL = ("k1", "k2", "k3", "k4", "p2", "p1", "p3", "p4")
_MOST_XI = 100.0
# Mei and Rives 2007 (omni-radtan, OpenCV's omnidir), Usenko et al. 2018 (ds), Khomutenko et al. 2016 (eucm), Devernay
# and Faugeras 2001 (fov), Fitzgibbon 2001 (division), COLMAP's and OpenSfM's documentation, Metashape's manual,
# librealsense's rsutil.h.
LENSES = {
    "omni-radtan": ForeignLens(("xi", "k1", "k2", "p1", "p2"), _omni, ((-1, _MOST_XI),), ((0.0,), (1.0,), (2.0,))),
    "ds": ForeignLens(("xi", "alpha"), _double_sphere, ((-1, 1), (0, 1)), ((-0.2, 0.55), (0.1, 0.5))),
    "eucm": ForeignLens(("alpha", "beta"), _eucm, ((0, 1), (0, 1e3)), ((0.5, 1.0), (0.7, 1.2))),
    "fov": ForeignLens(("omega",), _fov, ((0, 3),), ((0.5,), (1.2,))),
    "division": ForeignLens(("k",), _division, (), ((-0.2,),)),
    "fisheye624": ForeignLens(_THETA, _theta),
    "rad-tan-thin-prism": ForeignLens((*_THETA[:6], "p0", "p1", *_THETA[8:]), _rad_tan_thin_prism),
    "dual": ForeignLens(("transition", "k1", "k2"), _dual, ((-1e-9, 1 + 1e-9),), ((0.5,),)),
    "frame with p3, p4": ForeignLens(_PARTIAL, _frame),
    "modified_brown_conrady": ForeignLens(("k1", "k2", "p1", "p2", "k3"), _modified),
    "fisheye with p1 to p4": ForeignLens(_PARTIAL, _fisheye),
    "equisolid fisheye": ForeignLens(_PARTIAL, _equisolid),
}  # fmt: skip


class ForeignCamera(NamedTuple):
    """A camera with such a lens, to be written: its kind, fx, fy, cx, cy, skew and the lens's own, size and name."""

    kind: str
    values: tuple[float, ...]
    size: tuple[int, int]
    name: str

    def project(self, rays: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (N, 2) of rays (N, 3) of any length, and whether there are any.

        Example:
            >>> camera = ForeignCamera("eucm", (500, 500, 320, 240, 0, 0.6, 1.1), (640, 480), "left")
            >>> camera.project(torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64))[0].tolist()
            [[320.0, 240.0]]
        """
        fx, fy, cx, cy, skew, *own = torch.tensor(self.values, dtype=torch.float64)
        X, Y, Z = (rays / rays.norm(dim=-1, keepdim=True)).unbind(-1)
        x, y, there = LENSES[self.kind].plane(own, X, Y, Z)
        return torch.stack([fx * x + skew * y + cx, fy * y + cy], -1), there

    def unproject(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Rays (N, 3) of pixels (N, 2), and whether there are any: by Newton's method, from rays up to the fold."""
        turn = torch.arange(48, dtype=torch.float64) * (math.tau / 48)
        fan = _FAN[:, None, None] * torch.stack([turn.cos(), turn.sin()], -1)
        seen, det, _, there = self._by_angles(fan.reshape(-1, 2))
        before = (there & (det > 0)).reshape(fan.shape[:2]).long().cumprod(0)
        chosen, folds = before.bool().flatten(), _FAN[(before.sum(0)).clamp_max(len(_FAN) - 1)]
        if not bool(chosen.any()):
            return _rays_toward(torch.zeros_like(pixels)), torch.zeros(len(pixels), dtype=torch.bool)
        places = fan.reshape(-1, 2)[chosen][torch.cdist(pixels, seen[chosen]).argmin(1)]
        for _ in range(_NEWTON):
            seen, det, slopes, there = self._by_angles(places)
            (a, b, c, d), (u, v) = slopes.flatten(1).T, (pixels - seen).T
            step = torch.stack([d * u - b * v, a * v - c * u], -1) / det[:, None]
            places = (places + torch.where(step.isfinite(), step, 0.0).clamp(-0.3, 0.3)).detach()
        seen, det, _, there = self._by_angles(places)
        toward = (torch.atan2(places[:, 1], places[:, 0]) / (math.tau / 48)).round().long() % 48
        good = there & (det > 0) & ((seen - pixels).norm(dim=-1) < _FOUND) & (places.norm(dim=-1) <= folds[toward])
        return _rays_toward(places), good

    def _by_angles(self, places: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Pixels of rays by the direction times the angle from the axis, with derivatives (N, 2, 2) and their det."""
        with torch.enable_grad():
            places = places.detach().requires_grad_()
            seen, there = self.project(_rays_toward(places))
            slopes = torch.stack(
                [torch.autograd.grad(seen[:, i].sum(), places, retain_graph=True)[0] for i in (0, 1)], 1
            )
        return seen.detach(), slopes.det(), slopes, there


def as_written(camera: Camera | ForeignCamera, otherwise: str = "") -> tuple[str, str, list[float]]:
    """Its name or another one, its model or kind, and fx, fy, cx, cy, skew and the coefficients."""
    if isinstance(camera, ForeignCamera):
        return camera.name or otherwise, camera.kind, list(camera.values)
    return foreign.camera_name(camera, otherwise), str(camera.model), camera.params.tolist()


# Angles from the axis of rays from which Newton's method starts; its steps; pixels that a ray may be off.
_FAN, _NEWTON, _FOUND = torch.linspace(0.0, 3.1, 65, dtype=torch.float64), 12, 1e-7


def _rays_toward(places: Tensor) -> Tensor:
    angle = places.square().sum(-1, keepdim=True).clamp_min(1e-24).sqrt()
    return torch.cat([places * angle.sin() / angle, angle.cos()], -1)


# Columns and rows of pixels through which a hybrid lens is laid, and those between them on which it is compared.
_GRID, _BETWEEN = (49, 37), (64, 48)
# Pixels beyond which a lens does not stand for another.
_FAR = 0.5


def foreign_camera(
    kind: str,
    name: str,
    core: Sequence[float],
    size: Sequence[int],
    own: Sequence[float],
    notes: list[str],
    skew: float = 0.0,
) -> Camera:
    """The camera of a lens: of a model of kcal, or the hybrid camera that comes nearest to it over the image.

    Args:
        kind: a model of kcal, or of `LENSES`.
        name: of the camera.
        core: fx, fy, cx, cy in kcal's convention.
        size: (width, height).
        own: the lens's parameters in the order of the model or of the table.
        notes: get a sentence on how near a hybrid camera comes.
        skew: change of a column with y.

    Raises:
        ValueError: a parameter out of range, or a lens that no hybrid lens follows.
    """
    if kind not in LENSES:
        return foreign.named_camera(name, core, size, kind, own, skew)
    known = LENSES[kind]
    for value, (low, high) in zip(own, known.limits, strict=False):
        if not low < value < high:
            raise ValueError(f"{name}: {kind} with a parameter of {value:g}; from {low} to {high:g} is possible")
    camera = foreign.named_camera(name, core, size, "pinhole", (), skew)
    values = (*camera.params.tolist(), *own, *[0.0] * (len(known.names) - len(own)))
    return nearest_hybrid(ForeignCamera(kind, values, camera.size, name).unproject, camera, f"its {kind} lens", notes)


@in_one_thread
def nearest_hybrid(
    unproject: Callable[[Tensor], tuple[Tensor, Tensor]], like: Camera, title: str, notes: list[str]
) -> Camera:
    """The hybrid camera through the rays that pixels (N, 2) have; those without one have none in it, either.

    Where the lens ends inside the image, so does the camera, or slightly before.

    Args:
        unproject: rays (N, 3) of pixels, and which have one.
        like: a camera of that size and name.
        title: what the lens is called.
        notes: get a sentence on how near it comes.

    Raises:
        ValueError: hardly a pixel has a ray, or no hybrid lens follows.
    """
    name = foreign.camera_name(like, "camera")

    def lines(grid: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
        pixels = like.grid(*grid).reshape(-1, 2)
        rays, good = unproject(pixels)
        return rays[good], pixels[good], pixels[~good]

    rays, pixels, _ = lines(_GRID)
    if len(rays) < _GRID[0] * _GRID[1] // 4:
        raise ValueError(f"{name}: {title} has no ray for most of the image")
    between, seen, dark = lines(_BETWEEN)
    camera, why = None, "its rim would be guessed"
    for reach in _REACHES:
        try:
            camera = hybrid_through(rays, pixels, like.size, reach)
        except DegenerateError as refused:
            why = str(refused)
            continue
        if not bool(camera.unproject(dark)[1].any()):
            break
        camera = None
    if camera is None:
        raise ValueError(f"{name}: no lens of kcal follows {title}: {why}")
    camera.calibration = CameraCalibration(name=name)
    there, shown = camera.project_rays(between)
    error = (there - seen)[shown].norm(dim=-1)
    rms, most = float(error.square().mean().sqrt()), float(error.max())
    if not most < _FAR:
        raise ValueError(f"{name}: no lens of kcal follows {title}: the nearest is {most:.2g} px off")
    covered = float(camera.unproject(like.grid(*_BETWEEN).reshape(-1, 2))[1].double().mean())
    rest = "" if covered == 1.0 else f"; {1.0 - covered:.1%} of the image has no ray"
    notes.append(f"{name}: {title} became kcal's hybrid lens, RMS {rms:.2g} px, at most {most:.2g} px{rest}")
    return camera


def fit_foreign(kind: str, camera: Camera) -> ForeignCamera:
    """The lens of a kind that comes nearest to a camera over its image, at infinity.

    Example:
        >>> camera = Camera.build(focal=(300, 300), center=(320, 240), size=(640, 480), model="fisheye4")
        >>> fitted = fit_foreign("ds", camera)
        >>> rays, _ = camera.unproject([[10.0, 10.0]])
        >>> bool((fitted.project(rays)[0] - 10.0).norm() < 1.0)
        True
    """
    from scipy.optimize import least_squares

    pixels = camera.grid(33, 25).reshape(-1, 2)
    rays, valid = camera.unproject(pixels)
    rays, pixels, known, found = rays[valid], pixels[valid], LENSES[kind], []
    name, focal = foreign.camera_name(camera, ""), float(camera.focal.mean())
    low, high = ([*([end] * 4), *(pair[i] for pair in known.limits), *[end] * (len(known.names) - len(known.limits))]
                 for i, end in enumerate((-math.inf, math.inf)))  # fmt: skip
    near = torch.tensor([[1e-4, 0.0, 1.0]], dtype=torch.float64)

    def filled(values: np.ndarray) -> ForeignCamera:
        return ForeignCamera(kind, (*values[:4].tolist(), 0.0, *values[4:].tolist()), camera.size, name)

    def errors(values: np.ndarray) -> np.ndarray:
        off = filled(values).project(rays)[0] - pixels
        return torch.nan_to_num(off, 1e6).clamp(-1e6, 1e6).flatten().numpy()

    for start in known.starts:
        own = np.array([*start, *[0.0] * (len(known.names) - len(start))])
        slope = float(filled(np.array([1.0, 1.0, 0.0, 0.0, *own])).project(near)[0][0, 0]) / 1e-4
        first = np.array([focal / slope, focal / slope, *camera.center.tolist(), *own])
        scale = np.array([focal, focal, 0.1 * focal, 0.1 * focal, *[0.1 if each else 0.01 for each in own]])
        found.append(least_squares(errors, first, bounds=(low, high), x_scale=scale, max_nfev=200))
    return filled(min(found, key=lambda one: one.cost if math.isfinite(one.cost) else math.inf).x)


# A hybrid lens through given rays and pixels: lenses of other programs that no parametric model of kcal has.

# How far the lens reaches, outermost rays being 1: beyond them, unless pixels there have no ray.
_REACHES = (1.05, 1.0, 0.99, 0.98, 0.96, 0.93, 0.9, 0.86)
_SHAPES = torch.linspace(-1.0, 1.2, 221, dtype=torch.float64)
_STEPS = 4


def hybrid_through(rays: Tensor, pixels: Tensor, size: tuple[int, int], reach: float) -> Camera:
    """The hybrid camera that comes nearest to pixels (N, 2) of rays (N, 3).

    By least squares, without an entrance pupil. The rays should reach all over the image; those beyond `reach`, as a
    share of the outermost one's distance in the lens's plane, are left out.

    Raises:
        DegenerateError: rays that no hybrid lens shows.
    """
    middle = 0.5 * (torch.tensor(size, dtype=torch.float64) - 1.0)
    theta, radius = torch.atan2(rays[:, :2].norm(dim=-1), rays[:, 2]), (pixels - middle).norm(dim=-1)
    plane = theta * radius_over_angle(_SHAPES[:, None] * theta**2)
    focal = (plane * radius).sum(1) / plane.square().sum(1)
    off = (focal[:, None] * plane - radius).square().sum(1)
    best = int(torch.where(off.isfinite(), off, math.inf).argmin())
    limit = reach * float(plane[best].max())
    form = HybridForm(shape=float(_SHAPES[best]), radius=limit, modes=ZernikeModes())
    inside = plane[best] < limit
    rays, pixels = rays[inside], pixels[inside]
    model = LensModel(hybrid=form)
    values = torch.zeros(5 + model.size, dtype=torch.float64)
    values[:4] = torch.stack([focal[best], focal[best], *middle])
    # Aspect and skew are modes of the field.
    free = [0, 2, 3, *(5 + i for i, name in enumerate(model.names) if name not in ("pupil1", "pupil2"))]
    for _ in range(_STEPS):
        found = project_components(rays.T, values, model, free)
        slopes = found.by_camera.flatten(1).T
        scale = slopes.norm(dim=0)
        error = (pixels.T - found.pixels).reshape(-1, 1)
        values[free] += torch.linalg.lstsq(slopes / scale, error, driver="gelsd").solution[:, 0] / scale
    camera = Camera(values, size=size, model=model)
    _, shown = camera.project_rays(rays)
    if not bool(shown.all()):
        raise DegenerateError(f"a hybrid lens shows only {float(shown.double().mean()):.1%} of these rays")
    return camera
