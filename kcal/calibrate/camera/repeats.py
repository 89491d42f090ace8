"""Find views of one camera that add nothing: copies of other views, and frames of a board that stands still.

The corners of a copy, saved twice or compressed again, differ by far less than the residuals. Both views then have the
same residuals, and counting them twice makes σ too small. Frames of a camera and a board that both stand still differ
by the noise of the image: that averages, but errors of lens model and board are the same in all of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import torch
from torch import Tensor

# Corners of a copy differ by less than this share of what independent noise does. Chance alone brings six corners so
# near each other in three pairs of a million.
_COPY_SHARE = 0.25
# Pixels that corners of a copy differ by at most. JPEG of quality 60 to 98 moves real corners by 0.0005 to 0.013 px.
_COPY_PIXELS = 0.03
# Two views show the same pose where corners differ by less than this share of their distance from their middle. A board
# that is held still moves by less; other poses differ by several times as much.
_POSE_SHARE = 0.05
# Two views are compared if they have this share of their corners in common.
_COMMON = 0.5
# Distances of so many views to all others are formed at a time; they are exact to this share of the sum of squares.
_AT_A_TIME, _ROUNDING = 256, 1e-12


def copied_views(pixels: Tensor, noise: float) -> dict[int, int]:
    """Which views are copies of earlier ones: index -> index of the first of them.

    Args:
        pixels: (V, N, 2), NaN where not seen.
        noise: px of a corner along an axis; with 0, copies have exactly the same corners.

    Example:
        >>> view = torch.rand(9, 2, dtype=torch.float64)
        >>> copied_views(torch.stack([view, view + 0.1, view + 1e-3, view]), noise=0.1)
        {2: 0, 3: 0}
    """
    return _alike(pixels, torch.full((len(pixels),), min(2.0 * _COPY_SHARE * noise, math.sqrt(2.0) * _COPY_PIXELS)))


def repeated_poses(pixels: Tensor) -> dict[int, int]:
    """Which views show the board where an earlier one does: index -> index of the first of them.

    Args:
        pixels: (V, N, 2), NaN where not seen.

    Example:
        >>> view = 100 * torch.rand(9, 2, dtype=torch.float64)
        >>> repeated_poses(torch.stack([view, view + 9.0, view + 0.1]))
        {2: 0}
    """
    spread = (pixels - pixels.nanmean(1, keepdim=True)).square().sum(-1).nanmean(-1).sqrt()
    return _alike(pixels, _POSE_SHARE * spread)


def _alike(pixels: Tensor, limit: Tensor) -> dict[int, int]:
    """Views whose corners have an RMS distance of at most `limit` (V,) from those of an earlier view, in no group."""
    seen = torch.isfinite(pixels).all(-1)
    first: dict[int, int] = {}
    for i, near in enumerate(_nearby(pixels, seen, limit)):
        others = [k for k in near if k not in first]
        if not others:
            continue
        common = (seen[i] & seen[others]).sum(-1)
        squared = (pixels[i] - pixels[others]).square().sum(-1).nansum(-1) / common
        comparable = common >= _COMMON * torch.maximum(seen[i].sum(), seen[others].sum(-1))
        alike = (comparable & (squared.sqrt() <= limit[i])).nonzero()[:, 0].tolist()
        if alike:
            first[i] = others[alike[0]]
    return first


def _nearby(pixels: Tensor, seen: Tensor, limit: Tensor) -> Iterator[list[int]]:
    """For each view the earlier ones that may be that near: none is missed, but rounding lets some through."""
    filled = torch.where(seen[..., None], pixels, 0.0)
    middle = filled.sum((0, 1)) / seen.sum()
    filled = torch.where(seen[..., None], pixels - middle, 0.0)
    mask, flat, square = seen.to(pixels.dtype), filled.flatten(1), filled.square().sum(-1)
    slack = _ROUNDING * square.sum(-1).max()
    for start in range(0, len(pixels), _AT_A_TIME):
        some = slice(start, start + _AT_A_TIME)
        squared = square[some] @ mask.T + mask[some] @ square.T - 2.0 * flat[some] @ flat.T
        common = mask[some] @ mask.T
        near = (common > 0) & (squared <= limit[some, None].square() * common + slack)
        for i, row in enumerate(near, start=start):
            yield row[:i].nonzero()[:, 0].tolist()


def copy_warnings(names: Sequence[str], copied: Mapping[int, int]) -> list[str]:
    """A warning that names the copies."""
    if not copied:
        return []
    pairs = ", ".join(f"{names[i]} of {names[k]}" for i, k in list(copied.items())[:5])
    return [
        f"{len(copied)} of {len(names)} views are copies of others ({pairs}{', ...' if len(copied) > 5 else ''}) and "
        "were left out: they add nothing, and σ would be too small with them; remove them"
    ]


def pose_warnings(pixels: Tensor) -> list[str]:
    """A warning where most views show the board in the pose of another view."""
    views, repeated = len(pixels), len(repeated_poses(pixels))
    if 2 * repeated <= views:
        return []
    return [
        f"{views} views show the board in {views - repeated} poses only: frames of one pose average noise, but errors "
        "of the lens model and the board are the same in all of them, and σ does not contain these; move and tilt the "
        "board between views"
    ]
