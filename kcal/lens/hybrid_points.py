"""Project and unproject many points of a hybrid camera by polynomials, fitted once to its formulas and checked."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.polynomial import chebyshev
from torch import Tensor

from kcal.dispatch import is_traced, may_overwrite
from kcal.lens.inverse import PreparedInverse, inverse_jacobian, undistort_components
from kcal.lens.model import HybridForm, LensModel, distort_components
from kcal.lens.projection import INTRINSICS, plane_from_points, pupil_depth, ray_starts, rays_from_plane, to_pixels
from kcal.lens.region import SURE, Region
from kcal.lens.zernike import ZernikeModes

# Evaluate a smooth map of a disc by polynomials that were fitted to it: exact to a bound, in few passes over memory.
#
# With z = x + i y on the unit disc and t = 2 |z|² - 1, a map of the plane is u + i v = Σ z^j Q_j(t), with complex
# polynomials Q_j (for j < 0 the conjugate of z to the power -j), as in `kcal.lens.zernike`. The values on rings give
# each Q_j by a Fourier sum over the azimuth and a least-squares fit over the rings, as Chebyshev series. On the disc no
# term of these exceeds its coefficient, so that the trailing ones may be left out while their sum is below a bound.
#
# j = 0, 1, 2 (decentering, radial profile with swirl, decentering) have high degrees and are evaluated by Horner's rule
# in t. All others together become one polynomial in x and y: a product of matrices, then Horner's rule in y.

# A map of places (N,): x and y to u and v.
Map = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


class Polynomials(NamedTuple):
    """Several real polynomials of one variable, evaluated together by Horner's rule.

    Attributes:
        levels: for each power, highest first, its coefficients (m, 1) in those m polynomials that reach it, which are
            sorted by falling degree.
        places: where each polynomial stands after sorting.
    """

    levels: tuple[Tensor, ...]
    places: tuple[int, ...]

    def __call__(self, t: Tensor, out: Tensor) -> list[Tensor]:
        """The polynomials at t (n,), as rows of `out`, which has at least as many rows as there are polynomials."""
        out[: len(self.places)] = 0.0
        for level in self.levels:
            rows = out[: len(level)]
            torch.addcmul(level, rows, t, out=rows)
        return [out[place] for place in self.places]


def polynomials_of(series: Sequence[np.ndarray]) -> Polynomials:
    """Polynomials from Chebyshev series; an empty one is zero."""
    powers = [each @ _chebyshev_powers(len(each)) for each in series]
    order = sorted(range(len(powers)), key=lambda i: -len(powers[i]))
    levels = []
    for power in reversed(range(len(powers[order[0]]))):
        levels.append(torch.tensor([[powers[i][power]] for i in order if len(powers[i]) > power], dtype=torch.float64))
    return Polynomials(tuple(levels), tuple(order.index(i) for i in range(len(powers))))


class PlaneMap(NamedTuple):
    """A map of the unit disc.

    Attributes:
        profiles: Q_1, Q_0, Q_2, each as real and imaginary part.
        matrix: (2 (D + 1), D + 1) coefficients of the polynomial in x and y of degree D: by powers of y, then u and v;
            columns by powers of x.
    """

    profiles: Polynomials
    matrix: Tensor

    @property
    def rows(self) -> int:
        """How many rows of memory a call needs."""
        return len(self.profiles.places) + 3 * self.matrix.shape[-1]

    def __call__(self, x: Tensor, y: Tensor, work: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Map places (n,) to u, v, and the square of their distance from the center; u and v lie in `work` (rows, n).

        `work` spares the time that the system takes to hand out large pieces of memory.
        """
        xx, yy = x * x, y * y
        square = xx + yy
        count = len(self.profiles.places)
        u, v = self._sum_in_x_and_y(x, y, xx, work[count:])
        t = torch.addcmul(square.new_tensor(-1.0), square, square.new_tensor(2.0))
        radial, swirl, shift_u, shift_v, bend_u, bend_v = self.profiles(t, work)
        u.addcmul_(x, radial).addcmul_(y, swirl, value=-1.0).add_(shift_u)
        v.addcmul_(y, radial).addcmul_(x, swirl).add_(shift_v)
        re, im = xx.sub_(yy), torch.mul(x, y, out=t).mul_(2.0)
        u.addcmul_(re, bend_u).addcmul_(im, bend_v, value=-1.0)
        v.addcmul_(re, bend_v).addcmul_(im, bend_u)
        return u, v, square

    def _sum_in_x_and_y(self, x: Tensor, y: Tensor, xx: Tensor, work: Tensor) -> Tensor:
        count = self.matrix.shape[-1]
        powers = work[:count]
        powers[0] = 1.0
        for power, known in ((1, x), (2, xx)):
            if power < count:
                powers[power] = known
        top = 2
        while top + 1 < count:
            more = min(top, count - 1 - top)
            torch.mul(powers[1 : 1 + more], powers[top], out=powers[top + 1 : top + 1 + more])
            top += more
        by_y = torch.mm(self.matrix, powers, out=work[count : 3 * count]).unflatten(0, (count, 2))
        value = by_y[-1]
        for rest in reversed(by_y[:-1].unbind()):
            value = torch.addcmul(rest, value, y, out=rest)
        return value


def fit_plane_map(function: Map, degrees: Mapping[int, int], bound: float) -> PlaneMap:
    """Fit a map of the unit disc.

    Args:
        function: the map.
        degrees: highest degree |j| + 2 k of each j; what is not listed is not fitted.
        bound: largest sum of the coefficients that are left out of one polynomial Q_j.
    """
    rings = max((degree - abs(j)) // 2 for j, degree in degrees.items()) * 5 // 4 + 8
    azimuths = 2 * max(abs(j) for j in degrees) + 8
    t = chebyshev_nodes(rings)
    radius = np.sqrt(0.5 * (1.0 + t))
    place = (radius[:, None] * np.exp(2j * np.pi * np.arange(azimuths) / azimuths)).ravel()
    u, v = function(torch.from_numpy(place.real.copy()), torch.from_numpy(place.imag.copy()))
    waves = np.fft.fft((u.numpy() + 1j * v.numpy()).reshape(rings, azimuths)) / azimuths
    series = {}
    for j, degree in degrees.items():
        columns = chebyshev.chebvander(t, (degree - abs(j)) // 2) * radius[:, None] ** abs(j)
        series[j] = trim(np.linalg.lstsq(columns, waves[:, j], rcond=None)[0], bound)
    parts = [part for j in (1, 0, 2) for whole in [series.pop(j, np.zeros(0))] for part in (whole.real, whole.imag)]
    return PlaneMap(polynomials_of([trim(part, bound) for part in parts]), _matrix(series))


def chebyshev_nodes(count: int) -> np.ndarray:
    """The zeros of the Chebyshev polynomial of this degree: `count` places in [-1, 1]."""
    return np.cos(np.pi * (np.arange(count) + 0.5) / count)


def trim(series: np.ndarray, bound: float) -> np.ndarray:
    """A Chebyshev series without its last terms, as many as can be left out while their sum stays below the bound."""
    tail = np.cumsum(np.abs(series[::-1]))[::-1]
    return series[: int((tail > bound).sum())]


@functools.cache
def _chebyshev_powers(count: int) -> np.ndarray:
    """The coefficients of the first Chebyshev polynomials (rows) by rising powers."""
    table = np.zeros((count, count))
    for k in range(count):
        table[k, : k + 1] = chebyshev.cheb2poly(np.eye(k + 1)[k])
    return table


def shifted_powers(count: int) -> np.ndarray:
    """The same of the polynomials T_k(2 s - 1), which are T_2k(√s)."""
    return _chebyshev_powers(2 * count)[::2, ::2]


def _matrix(series: Mapping[int, np.ndarray]) -> Tensor:
    """`PlaneMap.matrix` of Σ z^j Q_j(t), from Chebyshev series."""
    degree = max((abs(j) + 2 * (len(part) - 1) for j, part in series.items() if len(part)), default=0)
    total = np.zeros((degree + 1, degree + 1), dtype=complex)
    for j, part in series.items():
        # By powers of s = |z|²: z^j s^k is z^(j + k) times the conjugate of z to the power k.
        for k, weight in enumerate(part @ shifted_powers(len(part))):
            total += weight * _powers_of_z(max(j, 0) + k, max(-j, 0) + k, degree)
    # [power of y, u or v, power of x]
    both = np.stack([total.real, total.imag], 1)
    return torch.from_numpy(both.reshape(2 * (degree + 1), degree + 1))


@functools.cache
def _powers_of_z(ahead: int, back: int, degree: int) -> np.ndarray:
    """(x + i y)^ahead (x - i y)^back: its coefficients by power of y (rows) and of x."""
    product = np.ones(1, dtype=complex)
    for unit in [1j] * ahead + [-1j] * back:
        product = np.convolve(product, [1.0, unit])
    found = np.zeros((degree + 1, degree + 1), dtype=complex)
    for power, weight in enumerate(product):
        found[power, ahead + back - power] = weight
    return found


# Project and unproject many points of a hybrid camera by polynomials, fitted once to its formulas and checked.
#
# Points pass through three stages, each a polynomial on a disc a little smaller than the valid one:
#
# * base map and entrance pupil at once: with R the distance of the point, (X, Y) / (R + Z) is the stereographic chart;
#   the place on the lens's plane is that times a polynomial in its squared radius and 1 / R;
# * lens: a `PlaneMap`;
# * back: a second such map from distorted places approximates the inverse to 1e-6; applied again to the place plus what
#   was missed, to 1e-11, and what is missed then is small enough to be added as it is.
#   Rays follow by a polynomial in r².
#
# Camera and polynomials agree to 5e-10 px where they were compared when fitted; otherwise there are none. Points close
# to the camera or near the edge of its valid region are left to the formulas, and so are derivatives, compiled graphs,
# batches of cameras and small calls.

# Calls with fewer points do not repay a fit: measured on a busy core, 30 ms for `project` and 50 more for `unproject`.
FEWEST = 8192
# Points in one piece: each call to torch costs as much as some thousand of them.
PIECE = 32768


class Forward(NamedTuple):
    """The polynomials of one camera from points to pixels.

    Attributes:
        base: of each power of 1 / R, a polynomial of 2 (x² + y²) / widest - 1 on the chart.
        widest: largest x² + y² on the chart.
        nearest: smallest distance R of a point, meters.
        radius: of the disc on the plane of the lens.
        reach: of the disc about the origin of the distorted plane all of which the lens reaches from there.
        lens: from the first disc to the second.
        intrinsics: fx, fy, cx, cy, skew.
    """

    base: Polynomials
    widest: float
    nearest: float
    radius: float
    reach: float
    lens: PlaneMap
    intrinsics: tuple[float, ...]

    @property
    def rows(self) -> int:
        """How many rows of memory a call needs."""
        return max(len(self.base.places), self.lens.rows)

    def __call__(self, points: Tensor, work: Tensor) -> tuple[Tensor, Tensor | None]:
        """Map points (n, 3) to pixels (n, 2), with a mask of where they are found (None: everywhere)."""
        X, Y, Z = _planes(points)
        square = torch.addcmul(X * X, Y, Y)
        distance = torch.addcmul(square, Z, Z)
        nearness = torch.rsqrt(distance)
        scale = distance.mul_(nearness).add_(Z).reciprocal_()
        square.mul_(scale).mul_(scale)
        variable = torch.addcmul(square.new_tensor(-1.0), square, square.new_tensor(2.0 / self.widest))
        *rest, stretch = self.base(variable, work)
        for row in reversed(rest):
            stretch = torch.addcmul(row, stretch, nearness, out=row)
        scale.mul_(stretch)
        x, y, place = self.lens(X.mul_(scale), Y.mul_(scale), work)
        fx, fy, cx, cy, skew = self.intrinsics
        pixels = points.new_empty((len(points), 2))
        u, v, f = (points.new_tensor(value) for value in (cx, cy, fx * self.reach))
        torch.addcmul(u, x, f, out=pixels[:, 0])
        torch.addcmul(v, y, points.new_tensor(fy * self.reach), out=pixels[:, 1])
        if skew:
            pixels[:, 0].add_(y, alpha=skew * self.reach)
        return pixels, _within((square, self.widest), (nearness, 1.0 / self.nearest), (place, 1.0))


class Backward(NamedTuple):
    """The polynomials of one camera from pixels to rays.

    Attributes:
        forward: of the same camera.
        guess: approximate inverse of `forward.lens`.
        chart: tan(θ/2) / r as a polynomial of 2 r² - 1 on the disc.
        remainder: largest squared error of the second guess, in units of `forward.reach`.
    """

    forward: Forward
    guess: PlaneMap
    chart: Polynomials
    remainder: float

    @property
    def rows(self) -> int:
        """How many rows of memory a call needs."""
        return self.guess.rows + self.forward.lens.rows

    def __call__(self, pixels: Tensor, work: Tensor) -> tuple[Tensor, Tensor | None]:
        """Map pixels (n, 2) to rays (n, 3), with a mask of where they are found (None: everywhere)."""
        lens, guess = self.forward.lens, self.guess
        work_lens, work_guess = work.split((lens.rows, guess.rows))
        fx, fy, cx, cy, skew = self.forward.intrinsics
        u, v = _planes(pixels)
        y = v.sub_(cy).mul_(1.0 / (fy * self.forward.reach))
        x = u.sub_(cx).mul_(1.0 / (fx * self.forward.reach))
        if skew:
            x.add_(y, alpha=-skew / fx)
        place_x, place_y, square = guess(x, y, work_guess)
        reached_x, reached_y, _ = lens(place_x, place_y, work_lens)
        place_x, place_y, _ = guess(2.0 * x - reached_x, 2.0 * y - reached_y, work_guess)
        reached_x, reached_y, _ = lens(place_x, place_y, work_lens)
        missed_x, missed_y = x.sub_(reached_x), y.sub_(reached_y)
        found = _within((square, 1.0), (torch.addcmul(missed_x * missed_x, missed_y, missed_y), self.remainder))
        unit = self.forward.reach / self.forward.radius
        place_x.add_(missed_x, alpha=unit)
        place_y.add_(missed_y, alpha=unit)
        square = torch.addcmul(place_x * place_x, place_y, place_y)
        (half,) = self.chart(2.0 * square - 1.0, work_lens)
        across = square.mul_(half).mul_(half)
        inverse = (1.0 + across).reciprocal_().mul_(2.0)
        half = inverse * half
        rays = pixels.new_empty((len(pixels), 3))
        torch.mul(place_x, half, out=rays[:, 0])
        torch.mul(place_y, half, out=rays[:, 1])
        torch.sub(inverse, 1.0, out=rays[:, 2])
        return rays, found


def _planes(points: Tensor) -> tuple[Tensor, ...]:
    """The coordinates of points (n, K), each in its own memory; NumPy copies four times as fast."""
    return torch.from_numpy(np.ascontiguousarray(points.numpy().T)).unbind()


def _within(*limits: tuple[Tensor, float]) -> Tensor | None:
    """Where no value exceeds its limit; None: nowhere. NaN does."""
    if all(bool(value.amax() <= limit) for value, limit in limits):
        return None
    return torch.stack([value <= limit for value, limit in limits]).all(0)


def map_points(
    polynomials: Forward | Backward,
    formulas: Callable[[Tensor], tuple[Tensor, Tensor]],
    points: Tensor,
    width: int,
) -> tuple[Tensor, Tensor]:
    """Map points (..., N, K) to values (..., N, width) and valid (..., N): by `formulas` where not by `polynomials`."""
    flat = points.detach().reshape(-1, points.shape[-1])
    values = flat.new_empty((len(flat), width))
    valid = torch.ones(len(flat), dtype=torch.bool)
    memory = flat.new_empty(polynomials.rows * min(PIECE, len(flat)))
    for begin in range(0, len(flat), PIECE):
        piece = flat[begin : begin + PIECE]
        work = memory[: polynomials.rows * len(piece)].view(-1, len(piece))
        values[begin : begin + PIECE], found = polynomials(piece, work)
        if found is not None:
            valid[begin : begin + PIECE] = found
    rest = (~valid).nonzero()[:, 0]
    if len(rest):
        values[rest], valid[rest] = formulas(flat[rest])
    return values.unflatten(0, points.shape[:-1]), valid.unflatten(0, points.shape[:-1])


# Fit the polynomials of `kcal.lens.hybrid_points` to the formulas of a hybrid camera, and compare both.

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
    if is_traced() or parameters.ndim > 1 or not (model.hybrid and isinstance(model.hybrid.modes, ZernikeModes)):
        return False
    on_host = points.device.type == "cpu" and parameters.device.type == "cpu"
    return on_host and points.numel() >= FEWEST * points.shape[-1] and may_overwrite(points, parameters)


@torch.no_grad()
def fit_forward(parameters: Tensor, model: LensModel, region: Region) -> Forward | None:
    """Fit the way from points to pixels; None if polynomials are not accurate enough, or rays start off the axis."""
    assert model.hybrid
    radius = SURE * float(region.radius) * (1.0 - 1e-12)
    if not radius > 0 or model.hybrid.port:
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
    pupil = ray_starts(across, torch.zeros_like(across), ahead, coefficients)
    if not bool(pupil.found.all()):
        return None
    x, _ = plane_from_points(*pupil.moved(across, torch.zeros_like(across), ahead), model)
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
    moved = ray_starts(X, Y, Z, coefficients).moved(X, Y, Z)
    return _largest_distance(*moved, pixels, found, parameters, model)


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
    distance = torch.linalg.vector_norm(torch.stack(to_pixels(lens.x, lens.y, parameters), -1) - pixels, dim=-1)
    if found is not None:
        if float(found.double().mean()) < 0.9:
            return math.inf
        distance = distance[found]
    return float(torch.nan_to_num(distance, nan=math.inf).amax())
