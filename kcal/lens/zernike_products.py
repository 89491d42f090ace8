"""Evaluate sums of Zernike modes by products of constant matrices, in few operations: for few places.

A mode is a power z^j of the place z = x + i y (its conjugate for j < 0), times a polynomial in t = 2 |z|² - 1. Powers
of z and Chebyshev polynomials of t are computed once for all modes; what is left is linear in the weights. Chebyshev
polynomials keep all digits, where powers of t lose some six at degree 33.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.dispatch import is_differentiated, is_traced

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
        profiles = (self.profiles @ self.polynomials(x.reshape(-1), y.reshape(-1))).unflatten(
            -1, (*x.shape[:-1], 1, -1)
        )
        re, im = self.powers(x, y).movedim((-3, -2), (0, 1))
        # A mode has one of four pairs of u and v.
        pairs = (
            torch.stack([re, im, -im, re, re, -im, im, re]).unflatten(0, (4, 2)).movedim((2, 1), (1, -2)).flatten(0, 1)
        )
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
