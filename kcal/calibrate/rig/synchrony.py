"""Tell whether both cameras of a rig saw each board in the same place: were they synchronous, and did neither move?"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.problem.poses import poses_under
from kcal.calibrate.problem.views import Views
from kcal.lens.camera import Camera
from kcal.lens.pose import step_rows, vector_from_rotation
from kcal.lens.projection import project_components
from kcal.lens.rig import StereoRig
from kcal.solve.lm import LMOptions

_POSES = LMOptions(max_iterations=60, tolerance=1e-12)
# Median of χ² with six degrees of freedom, over six.
_MEDIAN = 0.8914
# Pairs from which a delay can be told, and corners that a pose needs in each camera.
_FEWEST_PAIRS, _FEWEST_CORNERS = 8, 6


class Synchrony(NamedTuple):
    """How well pairs agree on the relative pose.

    Attributes:
        pairs: how many could be compared.
        ratio: typical disagreement over what noise of the corners explains; about 1 for synchronous cameras.
        shift: typical distance, across the line of sight, by which the board is elsewhere for the right camera, meters.
        delay: time by which the right camera was later, in steps from one view to the next, from displacements along
            the board's motion in the order of the views; None with few pairs.
        delay_sigma: its standard deviation.
    """

    pairs: int
    ratio: float
    shift: float
    delay: float | None = None
    delay_sigma: float | None = None


@torch.no_grad()
def synchrony(rig: StereoRig, board_points: Tensor, pixels: Tensor) -> Synchrony:
    """Compare the board's pose as each camera alone sees it, pair by pair.

    Args:
        rig: the solved rig.
        board_points: (N, 3) meters, as measured.
        pixels: (P, 2, N, 2) corners of each pair in the order in which they were taken; NaN where not seen.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480))
        >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-0.1, 0.0, 0.0]))
        >>> points = torch.cartesian_prod(torch.arange(5.0), torch.arange(4.0), torch.zeros(1)).double() * 0.05
        >>> places = points + torch.tensor([[[-0.1, -0.1, 1.0]], [[0.0, 0.0, 1.2]]], dtype=torch.float64)
        >>> moved = places + torch.tensor([0.0, 0.01, 0.0], dtype=torch.float64)  # 1 cm between both exposures
        >>> pixels = torch.stack([rig(places)[0], rig(moved)[1]], 1)
        >>> round(synchrony(rig, points, pixels).shift, 3)
        0.01
    """
    enough = (pixels.isfinite().all(-1).sum(-1) >= _FEWEST_CORNERS).all(-1)
    pixels = pixels[enough]
    if not len(pixels):
        return Synchrony(0, 1.0, 0.0)
    (turn, shift), left_spread, left_cost = _alone(rig.left, board_points, pixels[:, 0])
    (turn_right, shift_right), right_spread, right_cost = _alone(rig.right, board_points, pixels[:, 1])
    relative = rig.right_from_left_rotation
    predicted = relative @ turn, shift @ relative.T + rig.right_from_left_translation
    apart = torch.cat(
        [
            vector_from_rotation(turn_right @ predicted[0].transpose(-1, -2)),
            shift_right - predicted[1],
        ],
        -1,
    )
    both = torch.block_diag(relative, relative)
    corners = pixels.isfinite().all(-1).sum(-1)
    noise = (left_cost + right_cost).sum() * 2.0 / (2 * corners - 6).sum()
    # Exact data: rounding must not count as a disagreement.
    spread = noise.clamp_min(1e-10) * (both @ left_spread @ both.T + right_spread)
    squares = (apart * torch.linalg.solve(spread, apart[..., None])[..., 0]).sum(-1) / 6.0
    middle = board_points.mean(0)
    center, center_left = (r @ middle + t for r, t in ((turn_right, shift_right), predicted))
    sight = torch.nn.functional.normalize(center, dim=-1)
    away = center - center_left
    away = away - (away * sight).sum(-1, keepdim=True) * sight
    found = Synchrony(
        len(pixels), math.sqrt(float(squares.median()) / _MEDIAN), float(away.norm(dim=-1).square().median().sqrt())
    )
    if len(pixels) < _FEWEST_PAIRS:
        return found
    velocity = torch.gradient(center, dim=0)[0]
    velocity = velocity - (velocity * sight).sum(-1, keepdim=True) * sight
    power = float(velocity.square().sum())
    if not power > 0:
        return found
    delay = float((velocity * away).sum()) / power
    rest = float((away - delay * velocity).square().mean())
    return found._replace(delay=delay, delay_sigma=math.sqrt(rest / power))


def _alone(camera: Camera, board_points: Tensor, pixels: Tensor) -> tuple[tuple[Tensor, Tensor], Tensor, Tensor]:
    """Poses (P, 3, 3) and (P, 3), their covariances (P, 6, 6) for corners of 1 px, and costs (P,)."""
    state, cost = poses_under(camera, Views(board_points=board_points, pixels=pixels), _POSES)
    spreads = []
    for rotation, translation, seen in zip(state.rotation, state.translation, pixels.isfinite().all(-1), strict=True):
        turned = board_points[seen] @ rotation.T
        found = project_components((turned + translation).T, camera.params.detach(), camera.model, ())
        rows = step_rows(found.by_point, turned.T).flatten(1)
        spreads.append(torch.linalg.inv(rows @ rows.T))
    return (state.rotation, state.translation), torch.stack(spreads), cost
