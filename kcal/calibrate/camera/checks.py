"""Check the views of one camera before it is calibrated."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.camera.repeats import repeated_poses
from kcal.calibrate.problem.closed_form import homographies, spread_out
from kcal.errors import DegenerateError, InputError

MINIMUM_VIEWS = 3
# A homography has eight unknowns; six corners leave something to check them by.
_MINIMUM_CORNERS = 6
# RMS distance in pixels of a view's corners from the best line, below which they do not span a plane.
_MINIMUM_WIDTH = 0.5
# Views that are named where none fits, and how many times farther off a plane than the typical one they are.
_WORST, _BENT = 3, 3.0


def mirrored_views(board_points: Tensor, pixels: Tensor) -> Tensor:
    """(V,) whether the corners run the other way round, as on a board seen in a mirror.

    Args:
        board_points: (N, 3) meters.
        pixels: (V, N, 2), NaN where not seen.

    Example:
        >>> points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]).double()
        >>> mirrored_views(points, torch.stack([points[:, :2], -points[:, :2], points[:, :2].flip(1)])).tolist()
        [False, False, True]
    """
    seen = pixels.isfinite().all(-1, keepdim=True)
    count = seen.sum(1, keepdim=True).clamp_min(1)
    flat = torch.where(seen, board_points[:, :2], 0.0)
    shown = torch.where(seen, pixels, 0.0)
    # The sign of an affine map's determinant is that of the moments between both sides.
    flat = torch.where(seen, flat - flat.sum(1, keepdim=True) / count, 0.0)
    return torch.linalg.det(flat.transpose(1, 2) @ shown) < 0


def unusable_views(board_points: Tensor, pixels: Tensor) -> dict[int, str]:
    """Views whose corners do not determine the board's pose, or run the other way than in most: index -> why.

    Args:
        board_points: (N, 3) meters.
        pixels: (V, N, 2), NaN where not seen.
    """
    seen = torch.isfinite(pixels).all(-1).sum(-1)
    spread = spread_out(board_points, pixels)
    centered = torch.nan_to_num(pixels - pixels.nanmean(1, keepdim=True))
    width = torch.linalg.svdvals(centered)[:, 1] / seen.clamp_min(1).sqrt() if len(pixels) else seen.double()
    found: dict[int, str] = {}
    for i in range(len(pixels)):
        if int(seen[i]) < _MINIMUM_CORNERS:
            found[i] = f"it has {int(seen[i])} corners, and at least {_MINIMUM_CORNERS} are needed"
        elif not bool(spread[i]):
            found[i] = "all its corners, or all but one, lie on one line, which leaves the board's pose open"
        elif float(width[i]) < _MINIMUM_WIDTH:
            found[i] = "its corners coincide, or the board is seen edge-on"
    usable = [i for i in range(len(pixels)) if i not in found]
    mirrored = mirrored_views(board_points, pixels[usable]) if usable else torch.zeros(0, dtype=torch.bool)
    if 2 * int(mirrored.sum()) < len(usable):
        why = "it shows the board mirrored: the image is flipped, or its corners are in another order"
        found |= {i: why for i, flipped in zip(usable, mirrored.tolist(), strict=True) if flipped}
    return dict(sorted(found.items()))


def least_planar(board_points: Tensor, pixels: Tensor, names: Sequence[str]) -> str:
    """Which views look least like any flat board, in words: where no lens fits, these are the first to look at.

    Args:
        board_points: (N, 3) meters.
        pixels: (V, N, 2), NaN where not seen.
        names: of the views.

    Example:
        >>> points = torch.cartesian_prod(torch.arange(3.0), torch.arange(3.0), torch.zeros(1)).double()
        >>> mixed = points[[4, 1, 2, 3, 0, 5, 6, 7, 8]]
        >>> views = 100 * torch.stack([points, 2 * points, mixed])[..., :2]
        >>> least_planar(points, views, ["a", "b", "c"])
        'c (its corners are 59 px off a flat board)'
    """
    homography = homographies(board_points, pixels)
    flat = torch.cat([board_points[:, :2], torch.ones_like(board_points[:, :1])], 1)
    seen = flat @ homography.mT
    off = (seen[..., :2] / seen[..., 2:] - pixels).square().sum(-1).nanmean(-1).sqrt().nan_to_num(nan=math.inf)
    worst = off.argsort(descending=True)[:_WORST].tolist()
    # A lens bends boards, too, but those of all views.
    typical = float(off.median())
    named = [i for i in worst if float(off[i]) > _BENT * typical] or worst[:1]
    return ", ".join(f"{names[i]} (its corners are {float(off[i]):.0f} px off a flat board)" for i in named)


def check_views(board_points: Tensor, pixels: Tensor, names: Sequence[str], parameters: int, *, fewest: int) -> None:
    """Refuse views that cannot determine a camera, or a view that does not determine its pose.

    Args:
        board_points: (N, 3) meters.
        pixels: (V, N, 2), NaN where not seen.
        names: of the views.
        parameters: how many are estimated beside the poses.
        fewest: number of views that are needed.

    Raises:
        DegenerateError: too few views, poses or corners.
        InputError: a view with too few corners, or with corners on a line or in one place.
    """
    if len(pixels) < fewest:
        raise DegenerateError(
            f"{len(pixels)} view(s) of the board: at least {fewest} at different tilts are needed, 10 to 40 are good"
        )
    repeated = repeated_poses(pixels)
    if (poses := len(pixels) - len(repeated)) < fewest:
        pairs = ", ".join(f"{names[i]} like {names[k]}" for i, k in list(repeated.items())[:5])
        raise DegenerateError(
            f"{len(pixels)} views show the board in {poses} pose(s) only, the others are too similar ({pairs}"
            f"{', ...' if len(repeated) > 5 else ''}): at least {fewest} at different tilts are needed, 10 to 40 are "
            "good; move and tilt the board between views"
        )
    for i, why in unusable_views(board_points, pixels).items():
        raise InputError(f"view {names[i]!r}: {why}; remove the view")
    seen = int(torch.isfinite(pixels).all(-1).sum())
    unknowns = parameters + 6 * len(pixels)
    if 2 * seen <= unknowns:
        raise DegenerateError(
            f"{seen} corners in {len(pixels)} views cannot determine {unknowns} parameters: add views that show more "
            "of the board, or choose a smaller model"
        )
