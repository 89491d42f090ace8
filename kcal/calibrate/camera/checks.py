"""Check the views of one camera before it is calibrated."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.bundle.closed_form import spread_out
from kcal.calibrate.camera.repeats import repeated_poses
from kcal.errors import DegenerateError, InputError

MINIMUM_VIEWS = 3
# A homography has eight unknowns; six corners leave something to check them by.
_MINIMUM_CORNERS = 6
# RMS distance in pixels of a view's corners from the best line, below which they do not span a plane.
_MINIMUM_WIDTH = 0.5


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
    seen = torch.isfinite(pixels).all(-1).sum(-1)
    if len(pixels) < fewest:
        raise DegenerateError(
            f"{len(pixels)} view(s) of the board: at least {fewest} at different tilts are needed, 10 to 40 are good"
        )
    poses = len(pixels) - len(repeated_poses(pixels))
    if poses < fewest:
        raise DegenerateError(
            f"{len(pixels)} views show the board in {poses} pose(s) only, the others are too similar: at least "
            f"{fewest} at different tilts are needed, 10 to 40 are good; move and tilt the board between views"
        )
    poor = (seen < _MINIMUM_CORNERS).nonzero()[:, 0].tolist()
    if poor:
        raise InputError(
            f"view {names[poor[0]]!r} has {int(seen[poor[0]])} corners; at least {_MINIMUM_CORNERS} are needed: remove "
            "the view"
        )
    on_line = (~spread_out(board_points, pixels)).nonzero()[:, 0].tolist()
    if on_line:
        raise InputError(
            f"view {names[on_line[0]]!r}: all its corners, or all but one, lie on one line, which leaves the board's "
            "pose open; remove the view"
        )
    centered = torch.nan_to_num(pixels - pixels.nanmean(1, keepdim=True))
    width = torch.linalg.svdvals(centered)[:, 1] / seen.sqrt()
    thin = (width < _MINIMUM_WIDTH).nonzero()[:, 0].tolist()
    if thin:
        raise InputError(f"view {names[thin[0]]!r}: its corners coincide or the board is seen edge-on; remove the view")
    unknowns = parameters + 6 * len(pixels)
    if 2 * int(seen.sum()) <= unknowns:
        raise DegenerateError(
            f"{int(seen.sum())} corners cannot determine {unknowns} parameters: add views or choose a smaller model"
        )
