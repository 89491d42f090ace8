"""Closed-form initial values for calibration: Zhang's steps 1 to 4 (Algorithm 1 of the paper)."""

from __future__ import annotations

import torch
from kornia.geometry.homography import find_homography_dlt
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


def _rows(h: Tensor) -> tuple[Tensor, Tensor]:
    """Zhang's two constraints on the image of the absolute conic, from the first two columns of H (V, 3, 3)."""

    def v(i: int, j: int) -> Tensor:
        a, b = h[..., i], h[..., j]
        return torch.stack(
            [
                a[:, 0] * b[:, 0],
                a[:, 0] * b[:, 1] + a[:, 1] * b[:, 0],
                a[:, 1] * b[:, 1],
                a[:, 2] * b[:, 0] + a[:, 0] * b[:, 2],
                a[:, 2] * b[:, 1] + a[:, 1] * b[:, 2],
                a[:, 2] * b[:, 2],
            ],
            -1,
        )

    return v(0, 1), v(0, 0) - v(1, 1)


def intrinsics_candidates(homography: Tensor, size: tuple[int, int]) -> list[Tensor]:
    """Initial values for (fx, fy, cx, cy), best first (Algorithm 1, step 2).

    First the closed form with the principal point in the image's center, which two tilted views determine and which is
    robust to noise; then Zhang's with a free principal point (skew 0), where it is real; then fixed fields of view, for
    data on which the closed forms fail.

    Args:
        homography: (V, 3, 3) board → image.
        size: (width, height).
    """
    width, height = size
    center = torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=torch.float64)
    # In units of the image's half width, so that the rows of both equations have similar scales.
    unit = width / 2
    normalize = torch.tensor([[1 / unit, 0, -center[0] / unit], [0, 1 / unit, -center[1] / unit], [0, 0, 1]])
    h = normalize.to(torch.float64) @ homography
    h = h / torch.linalg.vector_norm(h, dim=(-2, -1), keepdim=True)
    first, second = _rows(h)
    rows = torch.cat([first, second])
    candidates = []

    # Center known: B = diag(1/fx², 1/fy², 1), two unknowns.
    solution = torch.linalg.lstsq(rows[:, [0, 2]], -rows[:, 5:6]).solution[:, 0]
    if bool((solution > 0).all()):
        focal = unit / torch.sqrt(solution)
        candidates.append(torch.cat([focal, center]))

    # Center free, skew zero: B has five entries up to scale.
    kept = rows[:, [0, 2, 3, 4, 5]]
    b = torch.linalg.svd(kept)[2][-1]
    b = b * torch.sign(b[0])
    b11, b22, b13, b23, b33 = b.unbind()
    if bool((b11 > 0) & (b22 > 0)):
        cx, cy = -b13 / b11, -b23 / b22
        scale = b33 - b13**2 / b11 - b23**2 / b22
        if bool(scale > 0) and bool(torch.hypot(cx, cy) < 1.0):
            focal = unit * torch.sqrt(scale / torch.stack([b11, b22]))
            candidates.append(torch.cat([focal, center + unit * torch.stack([cx, cy])]))

    for factor in (1.0, 0.5, 2.0, 4.0):
        focal = torch.full((2,), factor * width, dtype=torch.float64)
        candidates.append(torch.cat([focal, center]))
    return candidates


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


def radial_start(
    board_points: Tensor, pixels: Tensor, intrinsics: Tensor, rotation: Tensor, translation: Tensor
) -> Tensor:
    """k1, k2 by linear least squares under known intrinsics and poses (Algorithm 1, step 4; Zhang 2000, Eq. 13)."""
    points = board_points @ rotation.transpose(-1, -2) + translation[:, None]
    ideal = points[..., :2] / points[..., 2:]
    s = (ideal * ideal).sum(-1, keepdim=True)
    seen = torch.isfinite(pixels).all(-1)
    error = pixels - (ideal * intrinsics[:2] + intrinsics[2:])
    columns = torch.stack([ideal * s, ideal * s * s], -1) * intrinsics[:2, None]
    solution = torch.linalg.lstsq(columns[seen].reshape(-1, 2), error[seen].reshape(-1, 1)).solution
    return solution[:, 0]


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
