"""Evaluate smooth vector fields on a disc: sums of Zernike modes, sorted by how they turn with the azimuth."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.dispatch import is_differentiated, is_traced, may_branch, may_overwrite
from kcal.errors import InputError
from kcal.lens.field_modes import FieldModes, WeightPrior

# Evaluate sums of Zernike modes by products of constant matrices, in few operations: for few places.
#
# A mode is a power z^j of the place z = x + i y (its conjugate for j < 0), times a polynomial in t = 2 |z|² - 1. Powers
# of z and Chebyshev polynomials of t are computed once for all modes; what is left is linear in the weights. Chebyshev
# polynomials keep all digits, where powers of t lose some six at degree 33.

# Up to so many places one product of all powers is faster than vectorized recurrences (measured).
_FEW = 4000


class ZernikeProducts(NamedTuple):
    """Constant matrices of M modes, with powers of z below J and Chebyshev polynomials below K.

    Attributes:
        values: (M, 4 J K) weights to the coefficients of f and g, by real and imaginary part, power, and polynomial.
        slopes: (M, 8 J K) the same, then those of their derivatives by t.
        order: (J, 1) 0, 1, ..., J - 1.
        profiles: (R, K) each polynomial in t that modes have.
        profile: (M,) which of these a mode has.
        pair: (M,) the row of its (u, v): J rows of (re, im), of (-im, re), (re, -im) and (im, re).
    """

    values: Tensor
    slopes: Tensor
    order: Tensor
    profiles: Tensor
    profile: Tensor
    pair: Tensor

    @classmethod
    def of(cls, modes: Sequence[tuple[int, int, np.ndarray]]) -> ZernikeProducts:
        """For modes (j, part, polynomial): the power of z, whether the weight is imaginary, and the polynomial in t.

        Polynomials are given by their coefficients of Chebyshev polynomials.
        """
        J = max((abs(j) for j, _, _ in modes), default=0) + 1
        K = max((len(polynomial) for *_, polynomial in modes), default=1)
        table = np.zeros((len(modes), 2, 2, 2, J, K))
        profiles: dict[tuple[float, ...], int] = {}
        profile, pair = [], []
        for row, (j, part, polynomial) in enumerate(modes):
            turn = 1.0 if j >= 0 else -1.0
            # (re, ± im), or i times that: (∓ im, re).
            places = ((1, -turn), (0, 1.0)) if part else ((0, 1.0), (1, turn))
            slope = np.polynomial.chebyshev.chebder(polynomial)
            for column, (which, factor) in enumerate(places):
                table[row, 0, column, which, abs(j), : len(polynomial)] = factor * polynomial
                table[row, 1, column, which, abs(j), : len(slope)] = factor * slope
            profile.append(profiles.setdefault(tuple(polynomial.tolist()), len(profiles)))
            pair.append((part + 2 * (j < 0)) * J + abs(j))
        rows = np.zeros((len(profiles), K))
        for coefficients, at in profiles.items():
            rows[at, : len(coefficients)] = coefficients
        return cls(
            values=torch.from_numpy(table[:, 0].reshape(len(modes), -1).copy()),
            slopes=torch.from_numpy(table.reshape(len(modes), -1)),
            order=torch.arange(J, dtype=torch.float64)[:, None],
            profiles=torch.from_numpy(rows),
            profile=torch.tensor(profile, dtype=torch.long),
            pair=torch.tensor(pair, dtype=torch.long),
        )

    def to(self, device: torch.device) -> ZernikeProducts:
        """The same on another device."""
        return self if self.order.device == device else ZernikeProducts(*(each.to(device) for each in self))

    def powers(self, x: Tensor, y: Tensor) -> Tensor:
        """(..., 2, J, N) real and imaginary parts of powers of z."""
        if not (is_traced() or is_differentiated(x, y)) and x.numel() <= _FEW:
            z = torch.complex(x, y)[..., None, :]
            many = z.expand(*z.shape[:-2], len(self.order) - 1, -1)
            return torch.view_as_real(torch.cat([torch.ones_like(z), many], -2).cumprod(-2)).movedim(-1, -3)
        re, im = [torch.ones_like(x), x], [torch.zeros_like(x), y]
        for _ in range(2, len(self.order)):
            a, b = re[-1], im[-1]
            re.append(torch.addcmul(a * x, b, y, value=-1.0))
            im.append(torch.addcmul(a * y, b, x))
        count = len(self.order)
        return torch.stack([*re[:count], *im[:count]], -2).unflatten(-2, (2, count))

    def polynomials(self, x: Tensor, y: Tensor) -> Tensor:
        """(..., K, N) Chebyshev polynomials of t."""
        t = 2.0 * torch.addcmul(x * x, y, y) - 1.0
        out, double = [torch.ones_like(t), t], 2.0 * t
        for _ in range(2, self.profiles.shape[1]):
            out.append(torch.addcmul(out[-2], double, out[-1]).sub_(out[-2], alpha=2.0))
        return torch.stack(out[: self.profiles.shape[1]], -2)

    def columns(self, x: Tensor, y: Tensor, scale: Tensor | None = None, out: Tensor | None = None) -> Tensor:
        """(M, ..., 2, N) as `FieldModes.columns`, times a scale (..., 2, N), into memory if it is given."""
        profiles = self.profiles @ self.polynomials(x.reshape(-1), y.reshape(-1))
        profiles = profiles.unflatten(-1, (*x.shape[:-1], 1, x.shape[-1]))
        re, im = self.powers(x, y).movedim((-3, -2), (0, 1))
        # A mode has one of four pairs of u and v.
        pairs = torch.stack([re, im, -im, re, re, -im, im, re]).unflatten(0, (4, 2))
        pairs = pairs.movedim((2, 1), (1, -2)).flatten(0, 1)
        if scale is not None:
            pairs = pairs * scale
        # Rows at a time: these tables are large, and bound by memory.
        found = torch.index_select(pairs, 0, self.pair, out=out)
        return found.mul_(profiles.index_select(0, self.profile))

    def field(self, weights: Tensor, x: Tensor, y: Tensor, slopes: bool) -> tuple[Tensor, ...]:
        """As `FieldModes.field`."""
        if x.ndim > 1 and weights.numel() == weights.shape[-1]:
            # All places in one row: twice as fast for many short ones.
            found = self.field(weights.flatten(), x.flatten(), y.flatten(), slopes)
            return tuple(part.view(x.shape) for part in found)
        powers, count = self.powers(x, y), len(self.order)
        matrix = (weights @ (self.slopes if slopes else self.values)).unflatten(-1, (-1, self.profiles.shape[1]))
        # By value or derivative by t, u or v, real or imaginary part, and power.
        parts = (matrix @ self.polynomials(x, y)).unflatten(-2, (-1, 2, 2, count))
        sums = (parts * powers[..., None, None, :, :, :]).sum((-3, -2))
        f, g = sums[..., 0, :, :].unbind(-2)
        if not slopes:
            return f, g
        # The power j grows by j z^(j - 1) with x, and by i times that with y; t by 4 x and 4 y.
        lower = self.order[1:] * powers[..., :-1, :]
        re, im = lower.unbind(-3)
        turned = torch.stack([-im, re], -3)
        own = parts[..., 0, :, :, 1:, :]
        f_x, g_x = (own * lower[..., None, :, :, :]).sum((-3, -2)).unbind(-2)
        f_y, g_y = (own * turned[..., None, :, :, :]).sum((-3, -2)).unbind(-2)
        f_t, g_t = (4.0 * sums[..., 1, :, :]).unbind(-2)
        return (
            f, g,
            torch.addcmul(f_x, x, f_t), torch.addcmul(f_y, y, f_t),
            torch.addcmul(g_x, x, g_t), torch.addcmul(g_y, y, g_t),
        )  # fmt: skip


# Evaluate smooth vector fields on a disc: sums of Zernike modes, sorted by how they turn with the azimuth.
#
# The displacement (u, v) at the place z = x + i y of the unit disc is u + i v = Σ c_nj Z_nj(z), with complex weights
# and
#
#     Z_nj = √(n+1) z^j P_k^(0,|j|)(2 |z|² - 1),   n = |j| + 2k   (for j < 0 the conjugate of z to the power -j)
#
# These are the circle polynomials of Zernike (1934); P are Jacobi polynomials. On the disc the mean of |Z_nj|² is 1,
# and modes are orthogonal. Relative to the direction from the center, Z_nj turns m = j - 1 times around the image: m =
# 0 are radial profiles (real weight) and swirls (imaginary weight), |m| = 1 decentering and prism, |m| = 2 astigmatism.
#
# Modes that other parameters of a hybrid lens stand for are left out: constants (principal point), n = j = 1 (focal
# length and roll of the camera), and the real weight of n = 3, j = 1 (shape of the base projection).

RADIAL, DECENTERED, ASTIGMATIC, OTHER, TILTED, ASPECT = range(6)

# Median, sd of ln, and largest value: amplitudes of the families in this order, decays per degree of radial and of
# other modes. Decentered modes of second degree are a family of their own: a tilted sensor makes no others, so that
# finer ones do not tell how large they are. Radial modes beyond a hundredth of the disc stand for the focal length and
# shape of the base projection (measured on halves of a fisheye's capture). Below: the degrees at which these families
# begin, to which the amplitudes refer.
_HYPERPRIOR = (
    (5e-4, 1.75, 0.01),
    (3e-4, 1.5, math.inf),
    (5e-5, 1.75, math.inf),
    (4e-5, 1.75, math.inf),
    (3e-4, 1.5, math.inf),
    (0.5, 0.7, math.inf),
    (0.6, 0.5, math.inf),
)
_FIRST_DEGREE = (5, 2, 3, 2, 2)
# Where the decays stand: after the amplitudes.
_DECAY = len(_FIRST_DEGREE)
# The coefficients of Jacobi polynomials by powers of t grow by 2.4 with each second degree: 5e7 at degree 40.
_HIGHEST = 40
# Up to so many places a field is evaluated by products of matrices, in few operations; of more, by Horner's rule, in
# few multiplications (measured: twice as fast at 1,500, equal at some 5,000).
_DERIVED = ("complex_modes", "real_modes", "names", "_chains", "_matrix", "_products")
# Real and imaginary part of a complex number for each point.
_Complex = tuple[Tensor, Tensor]
# Where the real and the imaginary coefficients of a polynomial Q_j(t) stand; None: it is zero.
_Place = tuple[slice, slice] | None


@dataclasses.dataclass(frozen=True, kw_only=True)
class ZernikeModes(FieldModes):
    """Which modes a field has, by their highest degrees.

    Args:
        radial: of m = 0. The W-shaped profile of a webcam's lens needs 31.
        decentered: of |m| = 1.
        astigmatic: of |m| = 2.
        other: of all other m.

    Attributes:
        complex_modes: (j, n) of each complex mode.
        real_modes: (complex mode, part, family, degree) of each real weight: part 0 multiplies the mode, part 1
            multiplies i times the mode. Families are `RADIAL`, `DECENTERED`, `ASTIGMATIC`, `OTHER`, `TILTED`
            (decentered modes of second degree), and `ASPECT` for unequal and skewed axes.
        names: of the real weights: "z5+3" is that of the mode n = 5, j = 3, and "z5+3i" that of i times this mode.

    Raises:
        InputError: a degree that is not a whole number from 0 to 40, beyond which rounding would show; no mode at all.

    Example:
        >>> ZernikeModes(radial=5, decentered=2, astigmatic=1, other=0).names
        ('z1-1', 'z2+0', 'z5+1', 'z2+2', 'z1-1i', 'z2+0i', 'z3+1i', 'z5+1i', 'z2+2i')
    """

    radial: int = 33
    decentered: int = 18
    astigmatic: int = 9
    other: int = 8

    # Computed once: compilers cannot trace lazily computed attributes.
    complex_modes: tuple[tuple[int, int], ...] = dataclasses.field(init=False, repr=False, compare=False)
    real_modes: tuple[tuple[int, int, int, int], ...] = dataclasses.field(init=False, repr=False, compare=False)
    names: tuple[str, ...] = dataclasses.field(init=False, repr=False, compare=False)
    _chains: tuple[tuple[_Place, ...], tuple[_Place, ...]] = dataclasses.field(init=False, repr=False, compare=False)
    _matrix: Tensor = dataclasses.field(init=False, repr=False, compare=False)
    _products: ZernikeProducts = dataclasses.field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("radial", "decentered", "astigmatic", "other"):
            degree = getattr(self, name)
            if not isinstance(degree, int) or isinstance(degree, bool) or not 0 <= degree <= _HIGHEST:
                raise InputError(f"Zernike modes: {name} must be a whole number from 0 to {_HIGHEST}, got {degree!r}")
        derived = _derived(self.radial, self.decentered, self.astigmatic, self.other)
        for name, value in zip(_DERIVED, derived, strict=True):
            object.__setattr__(self, name, value)

    @property
    def radial_names(self) -> frozenset[str]:
        """See `FieldModes`."""
        return frozenset(
            name for name, (_, _, family, _) in zip(self.names, self.real_modes, strict=True) if family == RADIAL
        )

    @property
    def hyperprior(self) -> tuple[tuple[float, float, float], ...]:
        """See `FieldModes`: amplitudes of the five families, then decays per degree of radial and of other modes."""
        return tuple((math.log(value), sd, math.log(most)) for value, sd, most in _HYPERPRIOR)

    @property
    def weight_priors(self) -> tuple[WeightPrior, ...]:
        """See `FieldModes`."""
        return tuple(
            WeightPrior(None, None, 0.0)
            if family == ASPECT
            else WeightPrior(family, _DECAY + (family != RADIAL), max(degree - _FIRST_DEGREE[family], -1.0))
            for _, _, family, degree in self.real_modes
        )

    @property
    def peaks(self) -> tuple[float, ...]:
        """See `FieldModes`."""
        return tuple(math.sqrt(degree + 1) for *_, degree in self.real_modes)

    def columns(self, x: Tensor, y: Tensor) -> Tensor:
        """See `FieldModes`."""
        return self._products.to(x.device).columns(x, y).movedim(-2, 1)

    def fill_columns(self, out: Tensor, x: Tensor, y: Tensor, scale: Tensor) -> None:
        """See `FieldModes`."""
        self._products.to(x.device).columns(x, y, scale, out)

    def field(self, weights: Tensor, x: Tensor, y: Tensor, slopes: bool = True) -> tuple[Tensor, ...]:
        """See `FieldModes`."""
        if may_branch(weights, x, y) and x.shape[-1] <= _FEW:
            return self._products.to(x.device).field(weights, x, y, slopes)
        t = 2.0 * torch.addcmul(x * x, y, y) - 1.0
        coefficients = unbind_last(weights @ self._matrix.to(weights.device))
        reuse = may_overwrite(weights, x, y)
        # Σ z^j Q_j(t) by Horner's rule in z, with complex polynomials Q_j of t; then the same in the conjugate of z.
        ahead, back = (
            _horner_in_z(places, coefficients, z, t, slopes, reuse)
            for places, z in zip(self._chains, ((x, y), (x, -y)), strict=True)
        )
        (f, g), (f_back, g_back) = ahead[0], back[0]
        if not slopes:
            return f + f_back, g + g_back
        # By z, its conjugate, and t; z grows by 1 with x and by i with y, t by 4 x and 4 y.
        (re, im), (re_back, im_back) = ahead[1], back[1]
        f_t, g_t = 4.0 * (ahead[2][0] + back[2][0]), 4.0 * (ahead[2][1] + back[2][1])
        return (
            f + f_back, g + g_back,
            torch.addcmul(re + re_back, x, f_t), torch.addcmul(im_back - im, y, f_t),
            torch.addcmul(im + im_back, x, g_t), torch.addcmul(re - re_back, y, g_t),
        )  # fmt: skip


@functools.cache
def _derived(radial: int, decentered: int, astigmatic: int, other: int) -> tuple[Any, ...]:
    """The derived attributes, in the order of `_DERIVED`; kept, because each fit makes its modes anew."""
    complex_modes = tuple(_complex_modes((radial, decentered, astigmatic), other))
    real_modes = []
    for part in (0, 1):
        for i, (j, n) in enumerate(complex_modes):
            m = abs(j - 1)
            if (j, n) == (1, 1) or ((j, n) == (1, 3) and part == 0):
                continue
            real_modes.append((i, part, ASPECT if (j, n) == (-1, 1) else _family(m, n, part), n))
    if not real_modes:
        raise InputError("Zernike modes: degrees this low leave no mode")
    modes = [(*complex_modes[i], part) for i, part, _, _ in real_modes]
    chains, matrix = _polynomial_layout(complex_modes, [(i, part) for i, part, _, _ in real_modes])
    products = ZernikeProducts.of([(j, part, _chebyshev(n, j)) for j, n, part in modes])
    names = tuple(f"z{n}{j:+d}{'i' * part}" for j, n, part in modes)
    return complex_modes, tuple(real_modes), names, chains, matrix, products


def _complex_modes(highest: Sequence[int], other: int) -> list[tuple[int, int]]:
    """(j, n) of all modes up to the highest degrees of m = 0, |m| = 1, ..., and of all other m."""
    top = max(*highest, other)
    found = []
    for j in range(-top, top + 1):
        m = abs(j - 1)
        limit = highest[m] if m < len(highest) else other
        found += [(j, n) for n in range(abs(j), limit + 1, 2) if n]
    return found


def _family(m: int, degree: int, part: int) -> int:
    """Of a mode that turns m times about the axis."""
    if m == 1:
        return TILTED if degree == 2 else DECENTERED
    return (OTHER if part else RADIAL) if m == 0 else min(m, OTHER)


def _polynomial_layout(
    complex_modes: Sequence[tuple[int, int]], real_modes: Sequence[tuple[int, int]]
) -> tuple[tuple[tuple[_Place, ...], tuple[_Place, ...]], Tensor]:
    """The polynomials Q_j for j = J, ..., 0 and for j = -J, ..., -1 and 0; the matrix (M, Q) of their coefficients."""
    places: dict[int, tuple[slice, slice]] = {}
    begin = 0
    for j in sorted({j for j, _ in complex_modes}):
        count = max((n - abs(j)) // 2 for other, n in complex_modes if other == j) + 1
        places[j] = slice(begin, begin + count), slice(begin + count, begin + 2 * count)
        begin += 2 * count
    matrix = np.zeros((len(real_modes), begin))
    for row, (i, part) in enumerate(real_modes):
        j, n = complex_modes[i]
        k = (n - abs(j)) // 2
        start = places[j][part].start
        matrix[row, start : start + k + 1] = math.sqrt(n + 1) * np.asarray(_jacobi_coefficients(abs(j))[k].coef, float)
    ahead, back = (range(top, -1, -1) for top in (max(0, *places), max(0, *(-j for j in places))))
    chains = tuple(places.get(j) for j in ahead), tuple(places.get(-j) if j else None for j in back)
    return chains, torch.from_numpy(matrix)


def unbind_last(values: Tensor) -> tuple[Tensor, ...]:
    """The last dimension of (..., P) as P tensors that broadcast against (..., N).

    A single vector gives scalars without a dimension, which elementwise kernels take as constants.
    """
    # `torch.export.load` fails where `unbind` gives nothing, as for a pinhole.
    return (values if values.ndim == 1 else values.unsqueeze(-2)).unbind(-1) if values.shape[-1] else ()


def _horner_in_z(
    places: Sequence[_Place], coefficients: Sequence[Tensor], z: _Complex, t: Tensor, slopes: bool, reuse: bool
) -> tuple[_Complex, _Complex, _Complex]:
    """Σ z^j Q_j(t), highest first, and its derivatives by z and t."""
    nothing = torch.zeros_like(t)
    zero = (nothing, nothing)
    value = by_z = by_t = zero
    for number, place in enumerate(places):
        own = reuse and place is not None
        added = added_t = zero
        if place:
            (p, p_t), (q, q_t) = (_horner(coefficients[part], t, slopes, reuse) for part in place)
            added, added_t = (p, q), (p_t, q_t)
        if slopes:
            by_z = _times_plus(by_z, z, value, False) if number > 1 else value
            by_t = _times_plus(by_t, z, added_t, own) if number else added_t
        value = _times_plus(value, z, added, own) if number else added
    return value, by_z, by_t


def _horner(coefficients: Sequence[Tensor], t: Tensor, slopes: bool, reuse: bool) -> tuple[Tensor, Tensor]:
    """A polynomial by rising powers of t, and its derivative if wanted."""
    *rest, value = coefficients
    slope = torch.zeros_like(value)
    for coefficient in reversed(rest):
        own = reuse and value.shape == t.shape
        if slopes:
            slope = torch.addcmul(value, slope, t, out=slope if own and slope.shape == t.shape else None)
        value = torch.addcmul(coefficient, value, t, out=value if own else None)
    return value, slope


def _times_plus(value: _Complex, z: _Complex, added: _Complex, reuse: bool) -> _Complex:
    """Value z + added; `reuse`: the memory of `added` may receive the result."""
    (a, b), (x, y), (p, q) = value, z, added
    if reuse and p.shape == q.shape == x.shape and all(part.ndim == 0 or part.shape == x.shape for part in (a, b)):
        return p.addcmul_(a, x).addcmul_(b, y, value=-1.0), q.addcmul_(b, x).addcmul_(a, y)
    real = torch.addcmul(torch.addcmul(p, a, x), b, y, value=-1.0)
    return real, torch.addcmul(torch.addcmul(q, b, x), a, y)


@functools.cache
def _jacobi_coefficients(b: int) -> list[np.polynomial.Polynomial]:
    """P_k^(0,b)(t) for each k, by rising powers of t."""
    return _jacobi(_HIGHEST // 2, b, np.polynomial.Polynomial([0.0, 1.0]))


def _chebyshev(degree: int, j: int) -> np.ndarray:
    """√(n+1) P_k^(0,|j|)(t) by Chebyshev polynomials of t."""
    k = (degree - abs(j)) // 2
    return np.asarray(math.sqrt(degree + 1) * _jacobi_by_chebyshev(abs(j))[k, : k + 1])


@functools.cache
def _jacobi_by_chebyshev(b: int) -> np.ndarray:
    """(K, K) of P_k^(0,b)(t), each to be cut after k + 1: from values where Chebyshev polynomials are orthogonal."""
    count = _HIGHEST // 2 + 1
    angles = (np.arange(count) + 0.5) * (math.pi / count)
    weights = np.cos(np.arange(count)[:, None] * angles) * (2.0 / count)
    weights[0] *= 0.5
    return np.stack(_jacobi(count - 1, b, np.cos(angles))) @ weights.T


def _jacobi(highest: int, b: int, t: Any) -> list[Any]:
    """Jacobi polynomials P_k^(0,b)(t) for k up to `highest`, by their recurrence (DLMF 18.9.2)."""
    out = [0.0 * t + 1.0, 0.5 * (b + 2) * (t - 1.0) + 1.0]
    for k in range(2, highest + 1):
        c = 2 * k + b
        middle = ((c - 1) * c * (c - 2) * t - (c - 1) * b * b) * out[-1]
        out.append((middle - 2 * (k - 1) * (k + b - 1) * c * out[-2]) * (1.0 / (2 * k * (k + b) * (c - 2))))
    return out
