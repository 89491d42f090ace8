"""Fit the polynomials of `kcal.lens.hybrid_points` to the formulas of a hybrid camera, and compare both."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.polynomial import chebyshev
from torch import Tensor

from kcal.dispatch import is_traced, may_overwrite
from kcal.lens.distortion import distort_components
from kcal.lens.hybrid_points import FEWEST, Backward, Forward
from kcal.lens.hybrid_terms import HybridForm
from kcal.lens.inverse import PreparedInverse, undistort_components
from kcal.lens.model import LensModel
from kcal.lens.newton import inverse_jacobian
from kcal.lens.plane import plane_from_points, rays_from_plane
from kcal.lens.plane_map import Polynomials, chebyshev_nodes, fit_plane_map, polynomials_of, shifted_powers, trim
from kcal.lens.projection import INTRINSICS, to_pixels
from kcal.lens.pupil import pupil_depth, ray_starts
from kcal.lens.region import SURE, Region
from kcal.lens.zernike import ZernikeModes

# Pixels: left out of each polynomial; largest difference to the formulas; what the last step of an inverse may leave.
_LEFT_OUT, _LARGEST_ERROR, _REMAINDER = 5e-11, 5e-10, 1e-10
# Points nearer than this many times the movement of the pupil are left to the formulas.
_NEAREST = 100.0
# Places at which the polynomials of one variable are fitted, and those of both are compared with the formulas.
_NODES, _COMPARED = 30, 1500
# The first guess of an inverse needs no terms below this.
_GUESSED = 1e-9


class FittedPolynomials:
    """The polynomials of one camera: fitted when they are first needed, and again once its parameters have changed."""

    def __init__(self) -> None:
        self._key: Tensor | None = None
        self._forward: Forward | None = None
        self._backward: Backward | None = None
        self._has_backward = False

    def forward(self, parameters: Tensor, model: LensModel, region: Region) -> Forward | None:
        """The way from points to pixels; None if polynomials are not accurate enough."""
        key = torch.cat([parameters, region.radius[None]])
        if self._key is None or not torch.equal(key, self._key):
            self._forward, self._backward, self._has_backward = fit_forward(parameters, model, region), None, False
            self._key = key
        return self._forward

    def backward(self, parameters: Tensor, model: LensModel, ready: PreparedInverse) -> Backward | None:
        """The way from pixels to rays; None if polynomials are not accurate enough."""
        forward = self.forward(parameters, model, ready.region)
        if forward is not None and not self._has_backward:
            self._backward = fit_backward(forward, parameters, model, ready)
            self._has_backward = True
        return self._backward


def worth_fitting(points: Tensor, parameters: Tensor, model: LensModel) -> bool:
    """Whether polynomials may map these points (..., N, K), and are worth their fit."""
    if is_traced() or model.hybrid is None or parameters.ndim > 1:
        return False
    if not isinstance(model.hybrid.modes, ZernikeModes):
        return False
    on_host = points.device.type == "cpu" and parameters.device.type == "cpu"
    return on_host and points.numel() >= FEWEST * points.shape[-1] and may_overwrite(points, parameters)


@torch.no_grad()
def fit_forward(parameters: Tensor, model: LensModel, region: Region) -> Forward | None:
    """Fit the way from points to pixels; None if polynomials are not accurate enough."""
    assert model.hybrid
    radius = SURE * float(region.radius) * (1.0 - 1e-12)
    if not radius > 0:
        return None
    coefficients = parameters[len(INTRINSICS) :]

    def distort(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        lens = distort_components(radius * x, radius * y, coefficients, model, slopes=False)
        return lens.x, lens.y

    # A little less than the nearest place to which the rim of the disc is mapped.
    rim = torch.arange(256, dtype=torch.float64) * (2.0 * math.pi / 256)
    reach = 0.999999 * float(torch.hypot(*distort(torch.cos(rim), torch.sin(rim))).amin())
    fx, fy, cx, cy, skew = parameters[: len(INTRINSICS)].tolist()
    pixel = 1.0 / max(fx, fy)

    def scaled(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        u, v = distort(x, y)
        return u / reach, v / reach

    lens = fit_plane_map(scaled, _degrees(model.hybrid), _LEFT_OUT * pixel / reach)
    X, _, Z = rays_from_plane(torch.tensor(radius, dtype=torch.float64), torch.zeros(()).double(), model)
    widest = float(X / (1.0 + Z)) ** 2
    angles = torch.linspace(0.0, 2.0 * math.atan(math.sqrt(widest)), 100, dtype=torch.float64)
    # Without any movement, a micrometer.
    nearest = max(_NEAREST * float(pupil_depth(angles * angles, coefficients).abs().amax()), 1e-6)
    base = _base(coefficients, model, radius, widest, nearest, 2.0 * _LEFT_OUT * pixel)
    if base is None:
        return None
    forward = Forward(base, widest, nearest, radius, reach, lens, (fx, fy, cx, cy, skew))
    return forward if _forward_error(forward, parameters, model) <= _LARGEST_ERROR else None


@torch.no_grad()
def fit_backward(forward: Forward, parameters: Tensor, model: LensModel, ready: PreparedInverse) -> Backward | None:
    """Fit the way from pixels to rays; None if polynomials are not accurate enough."""
    assert model.hybrid
    coefficients = parameters[len(INTRINSICS) :]
    radius, reach = forward.radius, forward.reach

    def undistort(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        everywhere = torch.ones_like(x, dtype=torch.bool)
        x, y, _ = undistort_components(reach * x, reach * y, everywhere, coefficients, model, ready)
        return x / radius, y / radius

    others = max(10, 1 + max((degree for j, degree in _degrees(model.hybrid).items() if j not in (0, 1, 2)), default=0))
    degrees = {j: others for j in range(-others, others + 1)} | {0: 24, 1: 41, 2: 26}
    guess = fit_plane_map(undistort, degrees, _GUESSED)
    place = torch.from_numpy(np.sqrt(0.5 * (1.0 + chebyshev_nodes(_NODES))))
    X, _, Z = rays_from_plane(radius * place, torch.zeros_like(place), model)
    pixel = 1.0 / max(forward.intrinsics[:2])
    chart = polynomials_of([trim(_series((X / ((1.0 + Z) * place)).numpy()), 2.0 * _LEFT_OUT * pixel / radius)])
    # What was missed is added as if the slopes were one: its error is that times what they differ.
    angle = torch.linspace(0.0, 2.0 * math.pi, 33, dtype=torch.float64)
    x, y = ((radius * place[:, None] * wave).flatten() for wave in (torch.cos(angle), torch.sin(angle)))
    a, b, d, e = inverse_jacobian(distort_components(x, y, coefficients, model).point)
    differ = float(torch.sqrt((a - 1.0) ** 2 + b * b + d * d + (e - 1.0) ** 2).amax())
    remainder = _REMAINDER * pixel / (reach * max(differ, 1e-3))
    backward = Backward(forward, guess, chart, remainder**2)
    return backward if _backward_error(backward, parameters, model) <= _LARGEST_ERROR else None


def _degrees(form: HybridForm) -> dict[int, int]:
    """Highest degree of each j in the field, and enough for the shape of the base projection in the radial profile."""
    assert isinstance(form.modes, ZernikeModes)
    found = {1: form.modes.radial + 20}
    for j, degree in form.modes.complex_modes:
        found[j] = max(found.get(j, 0), degree)
    return found


def _series(values: np.ndarray) -> np.ndarray:
    """The Chebyshev series through values (N, ...) at the nodes."""
    count = len(values)
    waves = chebyshev.chebvander(chebyshev_nodes(count), count - 1) * (2.0 / count)
    waves[:, 0] *= 0.5
    return waves.T @ values


def _base(
    coefficients: Tensor, model: LensModel, radius: float, widest: float, nearest: float, bound: float
) -> Polynomials | None:
    """`Forward.base`; None where rays do not start anywhere."""
    square = torch.from_numpy(0.5 * widest * (1.0 + chebyshev_nodes(_NODES)))[:, None]
    nearness = torch.from_numpy(0.5 / nearest * (1.0 + chebyshev_nodes(8)))
    chart = torch.sqrt(square)
    ahead, across = (1.0 - square) / ((1.0 + square) * nearness), 2.0 * chart / ((1.0 + square) * nearness)
    ahead, across = ahead.flatten(), across.flatten()
    depth, found = ray_starts(across, torch.zeros_like(across), ahead, coefficients)
    if not bool(found.all()):
        return None
    x, _ = plane_from_points(across, torch.zeros_like(across), ahead - depth, model)
    stretch = (x.unflatten(0, (_NODES, -1)) / (radius * chart)).numpy()
    bound = bound / (radius * math.sqrt(widest))
    series = [trim(row, bound) for row in _series(_series(stretch).T)]
    count = max((k + 1 for k, part in enumerate(series) if len(part)), default=0)
    # By powers of the nearness instead of Chebyshev polynomials of it.
    rows = [np.zeros(max(map(len, series[k:count]))) for k in range(count)]
    for part, powers in zip(series, shifted_powers(count), strict=False):
        for k, row in enumerate(rows):
            row[: len(part)] += powers[k] * nearest**k * part if powers[k] else 0.0
    return polynomials_of(rows)


def _forward_error(forward: Forward, parameters: Tensor, model: LensModel) -> float:
    """Largest difference in pixels to the formulas, at points all over the domain."""
    generator = torch.Generator().manual_seed(0)
    square, turn, nearness = torch.rand(3, _COMPARED, generator=generator, dtype=torch.float64)
    square, turn, distance = square * forward.widest, turn * 2.0 * math.pi, forward.nearest / nearness
    across = 2.0 * torch.sqrt(square) / (1.0 + square) * distance
    X, Y, Z = across * torch.cos(turn), across * torch.sin(turn), (1.0 - square) / (1.0 + square) * distance
    pixels, found = forward(torch.stack([X, Y, Z], -1), X.new_empty((forward.rows, len(X))))
    coefficients = parameters[len(INTRINSICS) :]
    depth, _ = ray_starts(X, Y, Z, coefficients)
    return _largest_distance(X, Y, Z - depth, pixels, found, parameters, model)


def _backward_error(backward: Backward, parameters: Tensor, model: LensModel) -> float:
    """Largest distance in pixels from where the formulas project the rays, all over the domain."""
    generator = torch.Generator().manual_seed(0)
    square, turn = torch.rand(2, _COMPARED, generator=generator, dtype=torch.float64)
    radius, turn = torch.sqrt(square) * backward.forward.reach, turn * 2.0 * math.pi
    pixels = torch.stack(to_pixels(radius * torch.cos(turn), radius * torch.sin(turn), parameters), -1)
    rays, found = backward(pixels, pixels.new_empty((backward.rows, len(pixels))))
    X, Y, Z = rays.unbind(-1)
    return _largest_distance(X, Y, Z, pixels, found, parameters, model)


def _largest_distance(
    X: Tensor, Y: Tensor, Z: Tensor, pixels: Tensor, found: Tensor | None, parameters: Tensor, model: LensModel
) -> float:
    """Largest distance between pixels and those of rays by the formulas; infinite if few are found."""
    x, y = plane_from_points(X, Y, Z, model)
    lens = distort_components(x, y, parameters[len(INTRINSICS) :], model, slopes=False)
    own = torch.stack(to_pixels(lens.x, lens.y, parameters), -1)
    distance = torch.linalg.vector_norm(own - pixels, dim=-1)
    if found is not None:
        if float(found.double().mean()) < 0.9:
            return math.inf
        distance = distance[found]
    return float(torch.nan_to_num(distance, nan=math.inf).amax())
