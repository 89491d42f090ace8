"""Board poses: closed forms to begin with (Algorithm 1 of the paper), and each view refined under a known camera."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import Views
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.lens.pose import nearest_rotation
from kcal.solve.lm import LMOptions, minimize

# Closed forms for calibration: homographies and the poses that follow from them (Algorithm 1 of the paper).


def homographies(board_points: Tensor, pixels: Tensor) -> Tensor:
    """Homographies board → image (Algorithm 1, step 1), by the normalized direct linear transform.

    Args:
        board_points: (N, 3), z = 0.
        pixels: (V, N, 2), NaN where not seen; at least four corners per view.

    Returns:
        (V, 3, 3), scaled so that the last element is 1.
    """
    seen = torch.isfinite(pixels).all(-1)
    board = board_points[:, :2].expand(len(pixels), -1, -1)
    middle = torch.nanmean(pixels, 1, keepdim=True)
    filled = torch.where(seen[..., None], pixels, middle)
    from kornia.geometry.homography import find_homography_dlt  # kornia takes long to load

    result: Tensor = find_homography_dlt(board, filled, seen.to(pixels.dtype), solver="svd")
    return result


def spread_out(board_points: Tensor, pixels: Tensor) -> Tensor:
    """Whether the corners seen in each view determine a homography: not all, nor all but one, on one line.

    The equations of the direct linear transform from the board to itself have then rank eight.

    Args:
        board_points: (N, 3), z = 0.
        pixels: (V, N, 2), NaN where not seen.

    Returns:
        (V,) bool.
    """
    low, high = board_points[:, :2].amin(0), board_points[:, :2].amax(0)
    x, y = ((2.0 * board_points[:, :2] - low - high) / (high - low)).unbind(-1)
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    upper = torch.stack([x, y, one, zero, zero, zero, -x * x, -x * y, -x], -1)
    lower = torch.stack([zero, zero, zero, x, y, one, -x * y, -y * y, -y], -1)
    seen = torch.isfinite(pixels).all(-1).to(pixels.dtype)[..., None]
    values = torch.linalg.svdvals(torch.cat([seen * upper, seen * lower], -2))
    return values[..., 7] > 1e-9 * values[..., 0]


def poses_from_homographies(homography: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Board poses (Algorithm 1, step 3): cam_from_board rotation (V, 3, 3) and translation (V, 3).

    Args:
        homography: (V, 3, 3) board → image.
        intrinsics: (4,) fx, fy, cx, cy.
    """
    fx, fy, cx, cy = intrinsics
    x = (homography[:, 0] - cx * homography[:, 2]) / fx
    y = (homography[:, 1] - cy * homography[:, 2]) / fy
    m = torch.stack([x, y, homography[:, 2]], 1)
    scale = 2.0 / (torch.linalg.vector_norm(m[..., 0], dim=-1) + torch.linalg.vector_norm(m[..., 1], dim=-1))
    # The board is in front of the camera.
    scale = scale * torch.where(m[:, 2, 2] < 0, -1.0, 1.0)
    m = m * scale[:, None, None]
    third = torch.linalg.cross(m[..., 0], m[..., 1])
    return nearest_rotation(torch.stack([m[..., 0], m[..., 1], third], -1)), m[..., 2]


def flipped_poses(board_points: Tensor, rotation: Tensor, translation: Tensor) -> tuple[Tensor, Tensor]:
    """The other pose of each view that explains a small or distant plane almost as well.

    Seen along the direction d to the board's center, planes tilted by +φ and by -φ differ only in perspective. In a
    frame whose z axis is d, the other pose is D R D with D = diag(1, 1, -1), about the board's center (Schweighofer and
    Pinz 2006; Collins and Bartoli 2014).

    Args:
        board_points: (N, 3) meters.
        rotation: (V, 3, 3) cam_from_board.
        translation: (V, 3) meters.

    Returns:
        rotation and translation of the flipped poses.
    """
    middle = board_points.mean(0)
    center = rotation @ middle + translation
    d = center / torch.linalg.vector_norm(center, dim=-1, keepdim=True)
    # In any frame: D becomes M = 1 - 2 d dᵀ on the left, and stays D on the right.
    mirror = torch.eye(3, dtype=d.dtype) - 2.0 * d[:, :, None] * d[:, None, :]
    flip = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=d.dtype))
    turned = mirror @ rotation @ flip
    return turned, center - turned @ middle


# Board poses under a known camera: find and refine each view alone, and correct those that stopped at a wrong tilt.

# Enough to tell which of two tilts fits; the chosen one is refined with everything else afterwards.
_ROUGH = LMOptions(max_iterations=10, tolerance=1e-4)
# Most flipped poses are still this many times worse after four steps, and are dropped.
_FIRST_STEPS = LMOptions(max_iterations=4, tolerance=1e-4)
_HOPELESS = 30.0
# Cosine of the angle from the middle of a view's rays, from which they have a place on its plane.
_AHEAD = 0.05


def poses_under(camera: Camera, views: Views, options: LMOptions) -> tuple[BoardState, Tensor]:
    """Find each view's board pose under a known camera: in closed form from its rays, refined, with both tilts tried.

    Args:
        camera: a single camera; it stays as it is.
        views: V views of a board.
        options: of the solver.

    Returns:
        the state, and the cost of each view (V,) as in `refine_poses`. Both are NaN for a view whose corners with a ray
        do not determine a homography (`spread_out`).
    """
    rays, valid = camera.unproject(views.pixels)
    # The plane of each view's homography stands across its own rays: wide lenses also see boards beside the camera.
    turn = _to_axis(torch.where(valid[..., None], rays, 0.0).sum(1))
    ahead = rays @ turn.transpose(-1, -2)
    shown = (valid & (ahead[..., 2] > _AHEAD))[..., None]
    ideal = torch.where(shown, ahead[..., :2] / ahead[..., 2:], torch.nan)
    good = spread_out(views.board_points, ideal).nonzero()[:, 0]
    count = len(views.pixels)
    rotation, translation = ideal.new_full((count, 3, 3), torch.nan), ideal.new_full((count, 3), torch.nan)
    cost = ideal.new_full((count,), torch.nan)
    if len(good):
        some, model, back = views.some(good), camera.model, turn[good].transpose(-1, -2)
        pinhole = torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64)
        turned, moved = poses_from_homographies(homographies(views.board_points, ideal[good]), pinhole)
        poses = back @ turned, (back @ moved[..., None])[..., 0]
        state, cost[good] = refine_poses(some, model, BoardState.flat(camera.params.detach(), *poses), options)
        state, flipped = unflip(some, model, state)
        if flipped:
            state, cost[good] = refine_poses(some, model, state, options)
        rotation[good], translation[good] = state.rotation, state.translation
    return BoardState.flat(camera.params.detach(), rotation, translation), cost


def _to_axis(directions: Tensor) -> Tensor:
    """Rotations (V, 3, 3) that turn directions (V, 3) to the z axis."""
    z = torch.nn.functional.normalize(directions, dim=-1)
    least = torch.nn.functional.one_hot(z.abs().argmin(-1), 3).to(z.dtype)
    x = torch.nn.functional.normalize(torch.linalg.cross(least, z), dim=-1)
    return torch.stack([x, torch.linalg.cross(z, x), z], -2)


def refine_poses(views: Views, model: LensModel, state: BoardState, options: LMOptions) -> tuple[BoardState, Tensor]:
    """Minimize over each view's board pose alone, with everything else held.

    Args:
        views: V views of a board.
        model: the lens model.
        state: whose poses are the initial ones.
        options: of the solver.

    Returns:
        the state with refined board poses, and the cost of each view (V,), without a robust loss; NaN where the initial
        pose had none.
    """
    count, weights = len(views.pixels), views.whitening
    each = Views(
        board_points=views.board_points,
        pixels=views.pixels[:, None],
        whitening=None if weights is None else weights[:, None],
    )
    camera = state.parameters.expand(count, -1), state.board.expand(count, -1)
    start = BoardState.still(*camera, state.rotation[:, None], state.translation[:, None])
    result = minimize(each.problem(model, batch=(count,)), start, options)
    poses = result.state
    return state._replace(rotation=poses.rotation[:, 0], translation=poses.translation[:, 0]), result.cost


def unflip(views: Views, model: LensModel, state: BoardState) -> tuple[BoardState, list[int]]:
    """Replace every board pose whose counterpart with the opposite tilt fits better (see `flipped_poses`).

    A view from far away or nearly face-on has two poses of almost equal cost, and a solver that starts at the wrong one
    stays there. In 200 and more measured views, one or two such views raise the RMS of a whole calibration by up to a
    quarter.

    Args:
        views: V views of a board.
        model: the lens model.
        state: with board poses that are already refined.

    Returns:
        the state with the better poses, roughly refined, and the indices of the views that changed.
    """
    cost = 0.5 * (views.problem(model).residuals(state) ** 2).sum(-1)
    rotation, translation = flipped_poses(views.board_points, state.rotation, state.translation)
    flipped = state._replace(rotation=rotation, translation=translation)
    flipped, flipped_cost = refine_poses(views, model, flipped, _FIRST_STEPS)
    near = (flipped_cost < _HOPELESS * cost).nonzero()[:, 0]
    if not len(near):
        return state, []
    flipped, flipped_cost = refine_poses(views.some(near), model, flipped.views(near), _ROUGH)
    better = flipped_cost < 0.999 * cost[near]
    changed = near[better]
    rotation, translation = state.rotation.clone(), state.translation.clone()
    rotation[changed], translation[changed] = flipped.rotation[better], flipped.translation[better]
    return state._replace(rotation=rotation, translation=translation), changed.tolist()
