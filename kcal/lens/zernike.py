"""Smooth vector fields on a disc: complex Zernike modes, sorted by how they turn with the azimuth.

A displacement (u, v) at the place z = x + i y of the unit disc is written as u + i v = Σ c_jk Z_jk(z) with

    Z_jk = √(n+1) z^j P_k^(0,|j|)(2|z|² - 1),   n = |j| + 2k   (for j < 0 the conjugate of z to the power -j)

(Zernike 1934; P are Jacobi polynomials). Seen from the center, Z_jk turns m = j - 1 times around the image: m = 0 are
radial profiles and swirls, |m| = 1 decentering and prism, |m| = 2 astigmatism. Constants are the principal point, the
radial mode of degree 1 the focal length, its twin the roll of the camera, and the radial mode of degree 3 the shape of
the base projection (`kcal.lens.base_map`): these are left out.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

RADIAL, DECENTERED, ASTIGMATIC, OTHER, ASPECT = range(5)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ZernikeModes:
    """Which modes there are, by their highest degrees.

    Args:
        radial: of m = 0; a webcam's W-shaped profile needs 31.
        decentered: of |m| = 1.
        astigmatic: of |m| = 2.
        other: of all others.
    """

    radial: int = 33
    decentered: int = 18
    astigmatic: int = 9
    other: int = 8

    @functools.cached_property
    def complex_modes(self) -> tuple[tuple[int, int], ...]:
        """(j, n) of each complex mode."""
        highest = (self.radial, self.decentered, self.astigmatic)
        top = max(*highest, self.other)
        found = []
        for j in range(-top, top + 1):
            m = abs(j - 1)
            limit = highest[m] if m < 3 else self.other
            found += [(j, n) for n in range(abs(j), limit + 1, 2) if n]
        return tuple(found)

    @functools.cached_property
    def real_modes(self) -> tuple[tuple[int, int, int, int], ...]:
        """(complex mode, part, family, degree) of each real coefficient: part 0 multiplies the mode, part 1 i times it.

        Families: `RADIAL`, `DECENTERED`, `ASTIGMATIC`, `OTHER`, and `ASPECT` for unequal and skewed axes.
        """
        found = []
        for part in (0, 1):
            for i, (j, n) in enumerate(self.complex_modes):
                m = abs(j - 1)
                if (j, n) == (1, 1) or ((j, n) == (1, 3) and part == 0):
                    continue
                family = ASPECT if (j, n) == (-1, 1) else (OTHER if part else RADIAL) if m == 0 else min(m, 3)
                found.append((i, part, family, n))
        return tuple(found)

    def __len__(self) -> int:
        """Number of real coefficients."""
        return len(self.real_modes)

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        """Of the real coefficients: `z+3,5` multiplies the mode j = 3, n = 5, and `y+3,5` multiplies i times it."""
        return tuple("zy"[part] + "{:+d},{}".format(*self.complex_modes[i]) for i, part, _, _ in self.real_modes)

    @functools.cached_property
    def _place(self) -> dict[tuple[int, int], int]:
        """Where the coefficient of (complex mode, part) stands."""
        return {(i, part): place for place, (i, part, _, _) in enumerate(self.real_modes)}

    @functools.cached_property
    def _rows(self) -> dict[int, list[tuple[int, int]]]:
        """For each j the (k, complex mode)."""
        rows: dict[int, list[tuple[int, int]]] = {}
        for i, (j, n) in enumerate(self.complex_modes):
            rows.setdefault(j, []).append(((n - abs(j)) // 2, i))
        return rows

    def _polynomials(self, t: Tensor, slopes: bool) -> dict[int, tuple[Tensor, Tensor]]:
        """For each |j|: P_k^(0,|j|)(t) and their derivatives, (K + 1, ...) each."""
        highest: dict[int, int] = {}
        for j, row in self._rows.items():
            highest[abs(j)] = max(highest.get(abs(j), 0), row[-1][0])
        out = {}
        for a, top in highest.items():
            values = torch.stack(_jacobi(top, 0, a, t))
            derivative = values[:0]
            if slopes:
                lower = _jacobi(max(top - 1, 0), 1, a + 1, t)
                derivative = torch.stack(
                    [torch.zeros_like(t), *((k + a + 1) / 2 * lower[k - 1] for k in range(1, top + 1))]
                )
            out[a] = values, derivative
        return out

    def columns(self, x: Tensor, y: Tensor) -> Tensor:
        """Each real mode at places (x, y) (...) of the unit disc: (M, 2, ...)."""
        powers = _powers(x, y, max(abs(j) for j in self._rows))
        polynomials = self._polynomials(2 * (x * x + y * y) - 1, slopes=False)
        real, imaginary = {}, {}
        for j, row in self._rows.items():
            re, im = powers[abs(j)]
            for k, i in row:
                scaled = math.sqrt(self.complex_modes[i][1] + 1) * polynomials[abs(j)][0][k]
                real[i], imaginary[i] = scaled * re, scaled * (im if j >= 0 else -im)
        flat = []
        for i, part, _, _ in self.real_modes:
            flat += [-imaginary[i], real[i]] if part else [real[i], imaginary[i]]
        return torch.stack(flat).unflatten(0, (len(self), 2))

    def field(self, weights: Tensor, x: Tensor, y: Tensor, slopes: bool = True) -> tuple[Tensor, ...]:
        """The sum of all modes: the displacement (f, g), and if wanted its slopes f_x, f_y, g_x, g_y; each (..., N).

        Args:
            weights: (..., M), broadcast against the leading shape of the places (..., N) of the unit disc.
            x: (..., N).
            y: (..., N).
            slopes: whether these are needed.
        """
        t = 2.0 * (x * x + y * y) - 1.0
        f = g = f_x = f_y = g_x = g_y = torch.zeros_like(x)
        f_t = g_t = f
        power = before = torch.ones_like(x), torch.zeros_like(x)
        slices, matrix = self._layout
        coefficients = unbind_last(weights @ matrix.to(weights.device))
        for a, places in enumerate(slices):
            # f = Re z^a A - Im z^a B and g = Re z^a C + Im z^a D, with polynomials A, B, C, D of t.
            (A, A_t), (B, B_t), (C, C_t), (D, D_t) = (_horner(coefficients[place], t, slopes) for place in places)
            re, im = power
            f, g = torch.addcmul(f, re, A), torch.addcmul(g, re, C)
            if a:
                f, g = torch.addcmul(f, im, B, value=-1.0), torch.addcmul(g, im, D)
            if slopes:
                f_t, g_t = torch.addcmul(f_t, re, A_t), torch.addcmul(g_t, re, C_t)
                if a:
                    f_t, g_t = torch.addcmul(f_t, im, B_t, value=-1.0), torch.addcmul(g_t, im, D_t)
                    # d z^a = a z^(a-1) (dx + i dy); `before` is z^(a-1).
                    low_re, low_im = a * before[0], a * before[1]
                    f_x = torch.addcmul(torch.addcmul(f_x, low_re, A), low_im, B, value=-1.0)
                    f_y = torch.addcmul(torch.addcmul(f_y, low_im, A, value=-1.0), low_re, B, value=-1.0)
                    g_x = torch.addcmul(torch.addcmul(g_x, low_re, C), low_im, D)
                    g_y = torch.addcmul(torch.addcmul(g_y, low_im, C, value=-1.0), low_re, D)
            before, power = power, (re * x - im * y, re * y + im * x)
        if not slopes:
            return f, g
        twice_x, twice_y = 4.0 * x, 4.0 * y
        return (
            f, g, torch.addcmul(f_x, twice_x, f_t), torch.addcmul(f_y, twice_y, f_t),
            torch.addcmul(g_x, twice_x, g_t), torch.addcmul(g_y, twice_y, g_t),
        )  # fmt: skip

    @functools.cached_property
    def _layout(self) -> tuple[tuple[tuple[slice, ...], ...], Tensor]:
        """For each |j| where the coefficients of A, B, C, D of `field` stand; and the matrix (M, Q) that makes them."""
        signs = {
            (0, True): ((0, 1.0), (3, 1.0)), (0, False): ((0, 1.0), (3, -1.0)),
            (1, True): ((1, 1.0), (2, 1.0)), (1, False): ((1, -1.0), (2, 1.0)),
        }  # fmt: skip
        slices, columns = [], []
        for a in range(max(abs(j) for j in self._rows) + 1):
            own = [(j, k, i) for j in {a, -a} for k, i in self._rows.get(j, [])]
            count = max(k for _, k, _ in own) + 1
            block = np.zeros((len(self), 4, count))
            for j, k, i in own:
                for part in (0, 1):
                    place = self._place.get((i, part))
                    if place is not None:
                        for which, sign in signs[part, j >= 0]:
                            scale = sign * math.sqrt(self.complex_modes[i][1] + 1)
                            block[place, which, : k + 1] += scale * np.array(_jacobi_monomial(k, a))
            begin = sum(column.shape[1] for column in columns)
            slices.append(tuple(slice(begin + q * count, begin + (q + 1) * count) for q in range(4)))
            columns.append(block.reshape(len(self), -1))
        return tuple(slices), torch.from_numpy(np.concatenate(columns, 1))


def unbind_last(values: Tensor) -> tuple[Tensor, ...]:
    """The last dimension of (..., P) as P tensors that broadcast against (..., N).

    A single vector gives scalars without a dimension, which elementwise kernels take as constants.
    """
    return (values if values.ndim == 1 else values.unsqueeze(-2)).unbind(-1)


def _horner(coefficients: Sequence[Tensor], t: Tensor, slopes: bool) -> tuple[Tensor, Tensor]:
    """A polynomial by rising powers of t, and its derivative if wanted."""
    *rest, value = coefficients
    slope = torch.zeros_like(value)
    for coefficient in reversed(rest):
        if slopes:
            slope = torch.addcmul(value, slope, t)
        value = torch.addcmul(coefficient, value, t)
    return value, slope


@functools.cache
def _jacobi_monomial(k: int, b: int) -> tuple[float, ...]:
    """P_k^(0,b)(t) by rising powers of t."""
    basis = np.polynomial.Polynomial([0.0, 1.0])
    out = [np.polynomial.Polynomial([1.0]), (b + 2) * (basis - 1.0) / 2 + 1.0]
    for n in range(2, k + 1):
        c = 2 * n + b
        top = ((c - 1) * c * (c - 2) * basis - (c - 1) * b * b) * out[-1] - 2 * (n - 1) * (n + b - 1) * c * out[-2]
        out.append(top / (2 * n * (n + b) * (c - 2)))
    return tuple(float(value) for value in out[k].coef)


def _powers(x: Tensor, y: Tensor, highest: int) -> list[tuple[Tensor, Tensor]]:
    """Real and imaginary parts of (x + i y)^j for j from 0."""
    out = [(torch.ones_like(x), torch.zeros_like(x))]
    for _ in range(highest):
        re, im = out[-1]
        out.append((re * x - im * y, re * y + im * x))
    return out


def _jacobi(highest: int, a: int, b: int, t: Tensor) -> list[Tensor]:
    """Jacobi polynomials P_k^(a,b)(t) for k up to `highest`, by their recurrence (DLMF 18.9.2)."""
    out = [torch.ones_like(t)]
    if highest:
        out.append((a + 1) + (a + b + 2) * (t - 1) / 2)
    for n in range(2, highest + 1):
        c = 2 * n + a + b
        first = 2 * n * (n + a + b) * (c - 2)
        slope, constant, last = (c - 1) * c * (c - 2), (c - 1) * (a * a - b * b), 2 * (n + a - 1) * (n + b - 1) * c
        out.append(((slope * t + constant) * out[-1] - last * out[-2]) / first)
    return out
