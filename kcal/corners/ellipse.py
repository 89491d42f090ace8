"""Fit the edge of a blurred dark or light ellipse: its center with covariance, its shape, its blur.

Light is `out + (in - out) Φ(-d / blur)` plus a ramp, with d the distance from the ellipse |B (p - c)| = 1 to first
order, (ρ² - ρ) / |B B (p - c)| with ρ = |B (p - c)| and B symmetric. A small batched Levenberg-Marquardt estimates the
ten parameters of all ellipses at once from the pixels around each.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

# cx, cy, B00, B01, B11, light outside, contrast, blur, ramp x, ramp y
PARAMETERS = 10
_STEPS = 30
_CONVERGED = 1e-4  # pixels: the last step of a center that converged is shorter
_LEAST_BLUR = 0.2  # pixels: the pixel's own area alone gives 0.29
_MOST_PIXELS = 1500  # of one ellipse: beyond, every other row and column tells nearly as much


class Ellipses(NamedTuple):
    """Fitted ellipses.

    Args:
        center: (M, 2) pixels.
        shape: (M, 2, 2) B: the ellipse is |B (p - center)| = 1.
        covariance: (M, 2, 2) px² of the centers.
        blur: (M,) pixels.
        contrast: (M,) gray levels by which the inside is lighter.
        misfit: (M,) RMS residual over the contrast.
        converged: (M,).
    """

    center: Tensor
    shape: Tensor
    covariance: Tensor
    blur: Tensor
    contrast: Tensor
    misfit: Tensor
    converged: Tensor


def fit_ellipses(image: npt.NDArray[np.generic], center: Tensor, shape: Tensor, reach: Tensor) -> Ellipses:
    """Fit one ellipse near each start.

    Args:
        image: (H, W) gray levels.
        center: (M, 2) starts, good to a third of the radius; all finite.
        shape: (M, 2, 2) symmetric positive starts of B.
        reach: (M,) pixels are used where |B (p - c)| is at most this: beyond the edge, short of the next ellipse.

    Example:
        >>> y, x = np.mgrid[:40, :40]
        >>> image = 200 - 150 / (1 + np.exp(3 * (np.hypot(x - 19.3, y - 20.6) - 8)))
        >>> start = torch.tensor([[20.0, 20.0]], dtype=torch.float64)
        >>> found = fit_ellipses(image, start, torch.eye(2, dtype=torch.float64)[None] / 7, torch.tensor([1.7]))
        >>> [round(value, 2) for value in found.center[0].tolist()]
        [19.3, 20.6]
    """
    where, levels, weight = _pixels(image, center, shape, reach)
    p = torch.zeros(len(center), PARAMETERS, dtype=torch.float64)
    p[:, 2], p[:, 3], p[:, 4] = shape[:, 0, 0], shape[:, 0, 1], shape[:, 1, 1]
    rho = torch.linalg.vector_norm(torch.einsum("mij,mkj->mki", shape, where), dim=-1)
    inside, outside = weight * (rho < 0.7), weight * (rho > 1.25)
    dark, light = ((share * levels).sum(-1) / share.sum(-1).clamp_min(1e-9) for share in (inside, outside))
    p[:, 5], p[:, 6], p[:, 7] = light, dark - light, 0.8
    # Lengths are in units of the radius, for the normal equations.
    size = torch.linalg.det(shape).clamp_min(1e-12).rsqrt()
    lam = torch.full((len(p),), 1e-3, dtype=torch.float64)
    cost, normal, gradient = _system(p, where, levels, weight)
    step = torch.full((len(p), 2), math.inf, dtype=torch.float64)
    done = torch.zeros(len(p), dtype=torch.bool)
    for _ in range(_STEPS):
        diagonal = normal.diagonal(dim1=-2, dim2=-1)
        damped = normal + torch.diag_embed(
            lam[:, None] * diagonal + 1e-9 * diagonal.amax(-1, keepdim=True).clamp_min(1e-30)
        )
        move = -torch.linalg.solve_ex(damped, gradient[..., None])[0][..., 0]
        move[:, :2] *= (0.3 * size / move[:, :2].norm(dim=-1).clamp_min(1e-12)).clamp_max(1.0)[:, None]
        trial = p + move
        trial[:, 7] = trial[:, 7].clamp(_LEAST_BLUR, None)
        new_cost, new_normal, new_gradient = _system(trial, where, levels, weight)
        better = (new_cost < cost) & _is_ellipse(trial)
        step = torch.where(better[:, None], move[:, :2], step)
        p = torch.where(better[:, None], trial, p)
        cost = torch.where(better, new_cost, cost)
        normal = torch.where(better[:, None, None], new_normal, normal)
        gradient = torch.where(better[:, None], new_gradient, gradient)
        lam = torch.where(better, lam / 4, lam * 6).clamp(1e-9, 1e9)
        # Where no damping improves a step, the fit has converged as well.
        done |= (better & (step.norm(dim=-1) < 0.1 * _CONVERGED)) | (lam > 1e6)
        if bool(done.all()):
            break
    freedom = (weight.sum(-1) - PARAMETERS).clamp_min(1.0)
    noise = cost / freedom
    unit = normal.diagonal(dim1=-2, dim2=-1).clamp_min(1e-30).sqrt()
    scaled = normal / (unit[:, :, None] * unit[:, None, :]) + 1e-12 * torch.eye(PARAMETERS, dtype=torch.float64)
    covariance = torch.linalg.inv(scaled)[:, :2, :2] / (unit[:, :2, None] * unit[:, None, :2]) * noise[:, None, None]
    return Ellipses(
        center + p[:, :2],
        _shape(p),
        covariance,
        p[:, 7],
        p[:, 6],
        noise.sqrt() / p[:, 6].abs().clamp_min(1e-9),
        step.norm(dim=-1) < _CONVERGED,
    )


def _shape(p: Tensor) -> Tensor:
    return p[:, [2, 3, 3, 4]].unflatten(-1, (2, 2))


def _is_ellipse(p: Tensor) -> Tensor:
    return (p[:, 2] > 0) & (p[:, 2] * p[:, 4] > p[:, 3] ** 2) & torch.isfinite(p).all(-1)


def _pixels(
    image: npt.NDArray[np.generic], center: Tensor, shape: Tensor, reach: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Offsets (M, K, 2) of pixels from the starts, their levels and their weights (M, K): 0 outside reach or image."""
    height, width = image.shape
    # The box around |B p| <= reach: its half-widths are the rows' norms of the inverse.
    half = (torch.linalg.vector_norm(torch.linalg.inv(shape), dim=-1) * reach[:, None]).amax()
    size = int(half.ceil()) + 1
    stride = max(1, math.isqrt(int(math.pi * size**2) // _MOST_PIXELS))
    axis = torch.arange(-size, size + 1, stride)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    base = center.round().long()
    places = base[:, None] + torch.stack([x, y], -1).reshape(1, -1, 2)
    u, v = places.unbind(-1)
    within = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    levels = torch.from_numpy(image[v.clamp(0, height - 1).numpy(), u.clamp(0, width - 1).numpy()].astype(np.float64))
    where = places - center[:, None]
    rho = torch.linalg.vector_norm(torch.einsum("mij,mkj->mki", shape, where), dim=-1)
    weight = ((rho <= reach[:, None]) & within).double()
    used = (weight > 0).any(0)
    return where[:, used], levels[:, used], weight[:, used]


def _system(p: Tensor, where: Tensor, levels: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sum of squared residuals (M,), normal matrices (M, P, P) and gradients (M, P)."""
    b = _shape(p)
    q = where - p[:, None, :2]
    w = q @ b  # B is symmetric
    rho = torch.linalg.vector_norm(w, dim=-1).clamp_min(1e-6)
    g = w @ b
    length = torch.linalg.vector_norm(g, dim=-1).clamp_min(1e-9)
    top = rho**2 - rho
    distance = top / length
    blur = p[:, 7:8]
    t = distance / blur
    share = 0.5 * torch.erfc(t / math.sqrt(2.0))
    density = torch.exp(-0.5 * t.square()) / (math.sqrt(2.0 * math.pi) * blur)
    ramp = torch.einsum("mkj,mj->mk", where, p[:, 8:])
    model = p[:, 5:6] + p[:, 6:7] * share + ramp
    # d distance by q: (2 - 1/ρ) Bw / |g| - top / |g|³ B B g, and by an element of B likewise.
    slope = 2.0 - 1.0 / rho
    bbg = (g @ b) @ b
    by_q = (slope / length)[..., None] * g - (top / length**3)[..., None] * bbg
    columns = [-by_q[..., 0], -by_q[..., 1]]
    bg = g @ b
    for i, j in ((0, 0), (0, 1), (1, 1)):
        # dB = E: dw = E q, d ρ = w·dw / ρ, dg = E w + B dw.
        dw = torch.zeros_like(q)
        ew = torch.zeros_like(q)
        dw[..., i], ew[..., i] = q[..., j], w[..., j]
        if i != j:
            dw[..., j], ew[..., j] = q[..., i], w[..., i]
        d_top = slope * (w * dw).sum(-1)
        d_length = ((g * ew).sum(-1) + (bg * dw).sum(-1)) / length
        columns.append(d_top / length - top / length**2 * d_length)
    scale = -p[:, 6:7] * density
    one = torch.ones_like(share)
    jacobian = torch.stack(
        [*(scale * column for column in columns), one, share, p[:, 6:7] * density * t, where[..., 0], where[..., 1]], -1
    )
    residual = model - levels
    weighted = weight[..., None] * jacobian
    return (
        (weight * residual.square()).sum(-1),
        weighted.transpose(1, 2) @ jacobian,
        torch.einsum("mkp,mk->mp", weighted, residual),
    )
