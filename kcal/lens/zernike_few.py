"""Sum Zernike modes at a few points, all modes at once: there, starting an operation takes longer than the operation.

The sums are those of `kcal.lens.zernike`, which goes through the modes one by one and so touches each number once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

# Points; from about here on, memory counts for more than the number of operations.
FEW = 512


class FewLayout(NamedTuple):
    """Where the numbers of all modes stand; J different signed j, of which the largest is `top` in absolute value.

    Attributes:
        signed: (J,) each j.
        coefficients: (2, J, D + 1) place of each coefficient of Q_j(t), real parts first, in the list of all of them;
            what a polynomial does not have points behind the end of that list.
        recurrence: (3, K + 1, top + 1, 1) factors of the recurrence of Jacobi polynomials P_k^(0,b), by k and b.
        polynomial: (C,) place of each complex mode's polynomial among all (k, b).
        scale: (C, 1) by which it is multiplied.
        azimuth: (C,) j of each complex mode as its place in `signed`.
        mode: (M,) complex mode of each real weight.
        unit: (M, 1) complex: 1 or i.
    """

    signed: Tensor
    coefficients: Tensor
    recurrence: Tensor
    polynomial: Tensor
    scale: Tensor
    azimuth: Tensor
    mode: Tensor
    unit: Tensor


def few_layout(
    complex_modes: Sequence[tuple[int, int]],
    parts: Sequence[tuple[int, int]],
    places: dict[int, tuple[slice, slice]],
) -> FewLayout:
    """The layout of modes (j, n).

    Args:
        complex_modes: (j, n) of each.
        parts: (complex mode, part) of each real weight.
        places: of each j, where the real and imaginary coefficients of Q_j stand in the list of all.
    """
    signed = sorted(places)
    behind = max((both[1].stop for both in places.values()), default=0)
    longest = max((both[0].stop - both[0].start for both in places.values()), default=1)
    coefficients = torch.full((2, len(signed), longest), behind)
    for row, j in enumerate(signed):
        for part, place in enumerate(places[j]):
            coefficients[part, row, : place.stop - place.start] = torch.arange(place.start, place.stop)
    highest = max(((n - abs(j)) // 2 for j, n in complex_modes), default=0)
    top = max((abs(j) for j in signed), default=0)
    b = torch.arange(top + 1, dtype=torch.float64)[:, None]
    recurrence = torch.zeros(3, highest + 1, top + 1, 1, dtype=torch.float64)
    for k in range(2, highest + 1):
        # DLMF 18.9.2, as in `kcal.lens.zernike`.
        c = 2 * k + b
        divisor = 2 * k * (k + b) * (c - 2)
        recurrence[:, k] = torch.stack(
            [(c - 1) * c * (c - 2) / divisor, -(c - 1) * b * b / divisor, -2 * (k - 1) * (k + b - 1) * c / divisor]
        )
    return FewLayout(
        signed=torch.tensor(signed),
        coefficients=coefficients,
        recurrence=recurrence,
        polynomial=torch.tensor([(n - abs(j)) // 2 * (top + 1) + abs(j) for j, n in complex_modes], dtype=torch.int64),
        scale=torch.tensor([[math.sqrt(n + 1)] for _, n in complex_modes], dtype=torch.float64),
        azimuth=torch.tensor([signed.index(j) for j, _ in complex_modes], dtype=torch.int64),
        mode=torch.tensor([i for i, _ in parts], dtype=torch.int64),
        unit=torch.tensor([[1j if part else 1.0] for _, part in parts], dtype=torch.complex128),
    )


def field_of_few(layout: FewLayout, coefficients: Tensor, x: Tensor, y: Tensor, slopes: bool) -> tuple[Tensor, ...]:
    """The field and its slopes as `ZernikeModes.field` returns them; coefficients (Q,) of all polynomials."""
    shape, x, y = x.shape, x.reshape(-1), y.reshape(-1)
    t = 2.0 * (x * x + y * y) - 1.0
    polynomials = torch.cat([coefficients, coefficients.new_zeros(1)])[layout.coefficients]
    degree = polynomials.shape[-1] - 1
    powers = torch.cat([torch.ones_like(t)[None], t.expand(degree, -1)]).cumprod(0)
    powers_of_z = _powers(layout, x, y)
    turns = _turns(layout, powers_of_z)
    terms = torch.complex(*(polynomials @ powers).unbind(0))
    value = (terms * turns).sum(0)
    if not slopes:
        return value.real.reshape(shape), value.imag.reshape(shape)
    rising = polynomials[..., 1:] * torch.arange(1, degree + 1, dtype=torch.float64)
    by_t = (torch.complex(*(rising @ powers[:-1]).unbind(0)) * turns).sum(0)
    # z^j grows with x by j z^(j-1), and with y by i times that; in the conjugate of z, by -i times that.
    each = layout.signed.abs()[:, None] * terms * _turns(layout, powers_of_z, 1)
    by_x = each.sum(0) + 4.0 * x * by_t
    by_y = 1j * (layout.signed.sign()[:, None] * each).sum(0) + 4.0 * y * by_t
    parts = value.real, value.imag, by_x.real, by_y.real, by_x.imag, by_y.imag
    return tuple(part.reshape(shape) for part in parts)


def columns_of_few(layout: FewLayout, x: Tensor, y: Tensor) -> Tensor:
    """(M, 2, ...) the displacements of all real modes, as `ZernikeModes.columns` returns them."""
    shape, x, y = x.shape, x.reshape(-1), y.reshape(-1)
    t = 2.0 * (x * x + y * y) - 1.0
    a, b, c = layout.recurrence
    width = a.shape[1]
    jacobi = [torch.ones(width, len(t), dtype=torch.float64)]
    if len(a) > 1:
        jacobi.append(0.5 * (torch.arange(width, dtype=torch.float64)[:, None] + 2.0) * (t - 1.0) + 1.0)
    for k in range(2, len(a)):
        jacobi.append(torch.addcmul((a[k] * t + b[k]) * jacobi[-1], c[k], jacobi[-2]))
    chosen = torch.stack(jacobi).flatten(0, 1)[layout.polynomial]
    values = layout.scale * chosen * _turns(layout, _powers(layout, x, y))[layout.azimuth]
    columns = torch.view_as_real(layout.unit * values[layout.mode]).movedim(-1, 1)
    return columns.reshape(len(layout.mode), 2, *shape)


def _powers(layout: FewLayout, x: Tensor, y: Tensor) -> Tensor:
    """(top + 1, N) powers of x + i y."""
    z = torch.complex(x, y)
    return torch.cat([torch.ones_like(z)[None], z.expand(layout.recurrence.shape[2] - 1, -1)]).cumprod(0)


def _turns(layout: FewLayout, powers: Tensor, less: int = 0) -> Tensor:
    """(J, N) z^(j - less), for j < 0 the conjugate of z to the power -j - less."""
    chosen = powers[(layout.signed.abs() - less).clamp_min(0)]
    return torch.where(layout.signed[:, None] < 0, chosen.conj(), chosen)
