"""Closed forms for calibration: homographies and the poses that follow from them (Algorithm 1 of the paper)."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.lens.pose import nearest_rotation


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
