"""Refuse a calibration whose views leave open where the camera sees what they showed.

A parameter with a large σ is no fault by itself: others may make up for it everywhere that a board was. So what counts
is the projection: how uncertain the directions are in which the corners were seen, after the best turn of the camera,
in shares of how far these corners are from their middle. For a pinhole that is the relative σ of its focal length.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.camera.advice import STEEP, board_tilts
from kcal.errors import DegenerateError
from kcal.lens.model import LensModel
from kcal.lens.pose import step_rows
from kcal.lens.projection import project_components
from kcal.lens.pupil import FAR

# Directions less certain than this are no calibration: 5 % of range at every distance.
_MOST = 0.05
# Corners that stand for all: more change nothing.
_CORNERS = 400


def direction_share(parameters: Tensor, model: LensModel, points: Tensor, covariance: Tensor) -> float:
    """σ of the directions in which points are seen, in shares of their distances from their middle in the image.

    Both as root mean squares. A turn of the camera does not count, because no board determines it.

    Args:
        parameters: (5 + P,).
        model: the lens model.
        points: (N, 3) in the camera's frame: the corners that were seen.
        covariance: (5 + P, 5 + P) of the parameters.

    Returns:
        infinite where the covariance is not finite or no corner has an image.

    Example:
        >>> pinhole = torch.tensor([800.0, 800.0, 320.0, 240.0, 0.0], dtype=torch.float64)
        >>> corners = torch.tensor([[-0.02, -0.02, 1], [0.02, -0.02, 1], [-0.02, 0.02, 1], [0.02, 0.02, 1]]).double()
        >>> spread = torch.zeros(5, 5, dtype=torch.float64)
        >>> spread[:2, :2] = 8.0**2  # one focal length, ± 1 %
        >>> round(direction_share(pinhole, LensModel(), corners, spread), 4)
        0.01
    """
    chosen = points[:: max(1, len(points) // _CORNERS)]
    rays = FAR * chosen / torch.linalg.vector_norm(chosen, dim=-1, keepdim=True)
    wanted = [i for i, value in enumerate(covariance.diagonal().tolist()) if value != 0]
    seen = project_components(rays.T, parameters, model, wanted)
    good = seen.regular & seen.pixels.isfinite().all(0)
    if not wanted:
        return 0.0
    if int(good.sum()) < 4 or not bool(covariance.isfinite().all()):
        return math.inf
    by_turn = step_rows(seen.by_point, rays.T)[:3, :, good].flatten(1).T
    by_turn = by_turn / by_turn.norm(dim=0)
    by_camera = seen.by_camera[..., good].flatten(1).T
    by_camera = by_camera - by_turn @ torch.linalg.lstsq(by_turn, by_camera).solution
    variance = ((by_camera @ covariance[wanted][:, wanted]) * by_camera).sum().clamp_min(0.0)
    pixels = seen.pixels[:, good]
    spread = (pixels - pixels.mean(1, keepdim=True)).square().sum()
    return float((variance / spread).sqrt()) if float(spread) > 0 else math.inf


def check_directions(
    parameters: Tensor,
    model: LensModel,
    points: Tensor,
    seen: Tensor,
    covariance: Tensor,
    rotation: Tensor,
    names: Sequence[str] = (),
) -> None:
    """Raise `DegenerateError` where the views hardly determine the directions in which they were seen.

    Args:
        parameters: (5 + P,).
        model: the lens model.
        points: (V, N, 3) corners in the camera's frame.
        seen: (V, N) which of them count.
        covariance: (5 + P, 5 + P) of the parameters; a diagonal that is infinite or NaN: not determined.
        rotation: (V, 3, 3) cam_from_board; NaN for views that were left out.
        names: of the views, for the message.
    """
    share = direction_share(parameters, model, points[seen], covariance)
    if share <= _MOST:
        return
    known = "not at all" if math.isinf(share) else f"only to ±{100 * share:.1f} %"
    used = rotation.isfinite().all(-1).all(-1).nonzero()[:, 0].tolist()
    tilts = board_tilts(rotation[used])
    most = int(tilts.argmax())
    name = names[used[most]] if names else f"view {used[most]}"
    smaller = "" if model.hybrid else ", or choose a smaller model"
    tilted = int((tilts > STEEP).sum())
    raise DegenerateError(
        f"the views determine the focal length {known}, measured over the part of the image that they show: the "
        f"board is tilted by more than {STEEP:.0f}° in {tilted} of {len(used)} views (by {float(tilts[most]):.0f}° at "
        f"most, in {name}), or the views are too similar; add views with the board tilted by 30 to 45 degrees to the "
        f"left, right, top and bottom{smaller}"
    )
