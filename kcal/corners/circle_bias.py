"""The image of a circle's center is not the center of its image: by how much, from the map of board to image around it.

Around a point the image is `J q + ½ K q q` with `q` on the board. A circle of radius r then looks like an ellipse whose
center is shifted by ½ r² J (m + n), with m and n from K (below). Of a homography this is what the projected conic says
(J. Heikkilä, "Geometric camera calibration using circular control points", PAMI 2000), to third order in r; a lens that
bends lines shifts it as well, through its own second derivatives.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

_MOST_DEGREE = 5  # of the polynomial that follows the lens
_POINTS_PER_TERM = 2


class LocalMaps(NamedTuple):
    """The map from board to image around N points: first (N, 2, 2) and second derivatives (N, 2, 2, 2)."""

    first: Tensor
    second: Tensor


def local_maps(points: Tensor, pixels: Tensor, known: Tensor | None = None) -> LocalMaps:
    """Derivatives, at points of the board (N, 2), of the map that brings them to pixels (N, 2).

    Those of the homography of all points, which perspective follows exactly, and of a polynomial through what the
    homography leaves, which is the lens.

    Args:
        points: meters.
        pixels: finite where known.
        known: (N,) which of them determine the map; all if not given.

    Example:
        >>> axis = torch.arange(5, dtype=torch.float64)
        >>> points = torch.cartesian_prod(axis, axis)
        >>> maps = local_maps(points, 10 * points / (1 + 0.1 * points[:, :1]))
        >>> [round(value, 3) + 0.0 for value in maps.second[0].flatten().tolist()]  # x: -2 x 10 x 0.1; y: -10 x 0.1
        [-2.0, 0.0, 0.0, 0.0, 0.0, -1.0, -1.0, 0.0]
    """
    known = torch.ones(len(points), dtype=torch.bool) if known is None else known
    h = homography(points[known], pixels[known])
    there = torch.nn.functional.pad(points, (0, 1), value=1.0) @ h.T
    seen = there[:, :2] / there[:, 2:]
    # (a q + b) / (c q + d): J = (A - p cᵀ) / w, K = -(J_i c_j + J_j c_i) / w.
    slope = h[2, :2]
    first = (h[:2, :2] - seen[:, :, None] * slope) / there[:, 2, None, None]
    second = -(first[:, :, :, None] * slope + first[:, :, None, :] * slope[:, None]) / there[:, 2, None, None, None]
    low, high = points.amin(0), points.amax(0)
    scale = 2.0 / (high - low).clamp_min(1e-12)
    terms = [(i, j) for degree in range(_degree(int(known.sum())) + 1) for i in range(degree + 1) for j in [degree - i]]
    values = _term_values((points - low) * scale - 1.0, terms)
    found = torch.linalg.lstsq(values[0][known], (pixels - seen)[known], driver="gelsd").solution  # (terms, 2)
    by_x, by_y, xx, xy, yy = (value @ found for value in values[1:])
    first = first + torch.stack([by_x, by_y], -1) * scale
    second = second + torch.stack([xx, xy, xy, yy], -1).unflatten(-1, (2, 2)) * scale[:, None] * scale
    return LocalMaps(first, second)


def center_shift(maps: LocalMaps, radius: float) -> Tensor:
    """(N, 2) pixels from the image of each circle's center to the center of the ellipse that it looks like.

    Args:
        maps: of `local_maps`.
        radius: of the circles, in the units of the board's points.
    """
    k = torch.linalg.solve(maps.first, maps.second.flatten(2)).unflatten(-1, (2, 2))
    # Along the edge (cos t, sin t) the displacement is ½ r² (mean + half difference cos 2t + mixed sin 2t); its normal
    # part has the first harmonics that a shift has.
    mean, half, mixed = 0.5 * (k[..., 0, 0] + k[..., 1, 1]), 0.5 * (k[..., 0, 0] - k[..., 1, 1]), k[..., 0, 1]
    x = mean[:, 0] + 0.5 * half[:, 0] + 0.5 * mixed[:, 1]
    y = mean[:, 1] - 0.5 * half[:, 1] + 0.5 * mixed[:, 0]
    return 0.5 * radius**2 * (maps.first @ torch.stack([x, y], -1)[..., None])[..., 0]


def _degree(points: int) -> int:
    """The highest degree with at least two points for each term; 0 for few points, where only the homography counts."""
    degrees = range(_MOST_DEGREE + 1)
    return max((d for d in degrees if _POINTS_PER_TERM * (d + 1) * (d + 2) // 2 <= points), default=0)


def _term_values(at: Tensor, terms: list[tuple[int, int]]) -> list[Tensor]:
    """Values, first (x, y) and second derivatives (xx, xy, yy) of x^i y^j at (N, 2): each (N, terms)."""
    x, y = at.unbind(-1)

    def power(t: Tensor, n: int, derivative: int) -> Tensor:
        factor = 1
        for k in range(derivative):
            factor *= n - k
        return factor * t ** (n - derivative) if n >= derivative else torch.zeros_like(t)

    orders = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    return [torch.stack([power(x, i, a) * power(y, j, b) for i, j in terms], -1) for a, b in orders]


def homography(points: Tensor, pixels: Tensor) -> Tensor:
    """(3, 3) image from board of points (N, 2), by linear least squares in normalized coordinates (R. Hartley)."""
    from_points, a = _normalized(points)
    from_pixels, b = _normalized(pixels)
    x, y = a.unbind(-1)
    u, v = b.unbind(-1)
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    rows = torch.cat(
        [
            torch.stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u], -1),
            torch.stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v], -1),
        ]
    )
    h = torch.linalg.svd(rows)[2][-1].reshape(3, 3)
    found = torch.linalg.solve(from_pixels, h @ from_points)
    return found / found[2, 2]


def _normalized(points: Tensor) -> tuple[Tensor, Tensor]:
    middle = points.mean(0)
    scale = 1.0 / (points - middle).norm(dim=-1).mean().clamp_min(1e-12)
    transform = torch.eye(3, dtype=torch.float64)
    transform[0, 0] = transform[1, 1] = scale
    transform[:2, 2] = -scale * middle
    return transform, (points - middle) * scale
