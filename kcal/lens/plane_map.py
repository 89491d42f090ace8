"""Evaluate a smooth map of a disc by polynomials that were fitted to it: exact to a bound, in few passes over memory.

With z = x + i y on the unit disc and t = 2 |z|² - 1, a map of the plane is u + i v = Σ z^j Q_j(t), with complex
polynomials Q_j (for j < 0 the conjugate of z to the power -j), as in `kcal.lens.zernike`. The values on rings give each
Q_j by a Fourier sum over the azimuth and a least-squares fit over the rings, as Chebyshev series. On the disc no term
of these exceeds its coefficient, so that the trailing ones may be left out while their sum is below a bound.

j = 0, 1, 2 (decentering, radial profile with swirl, decentering) have high degrees and are evaluated by Horner's rule
in t. All others together become one polynomial in x and y: a product of matrices, then Horner's rule in y.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.polynomial import chebyshev
from torch import Tensor

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
