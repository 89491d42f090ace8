"""A small renderer of checkerboards with known corners, for the tests of the corners floor."""

import cv2
import numpy as np
import torch

from kcal.corners.board import Board

DARK, LIGHT = 40.0, 215.0


def homography(board: Board, size, square, tilt=(0.0, 0.0), roll=0.0, shift=(0.0, 0.0)):
    """pixel_from_squares (3, 3): the board's center near the image's center, `square` pixels a square there.

    tilt is the change of depth across the board's half width and height (0.3: 30 % further); roll in radians.
    """
    width, height = size
    center = np.array([[1, 0, -(board.columns - 1) / 2], [0, 1, -(board.rows - 1) / 2], [0, 0, 1]])
    perspective = np.eye(3)
    perspective[2, :2] = np.array(tilt) / (np.array([board.columns + 1, board.rows + 1]) / 2)
    c, s = np.cos(roll), np.sin(roll)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    place = np.array([[square, 0, (width - 1) / 2 + shift[0]], [0, square, (height - 1) / 2 + shift[1]], [0, 0, 1.0]])
    return place @ turn @ perspective @ center


def render(board, size, H, blur=1.0, noise=2.0, seed=0, supersample=6, dark_first=True, dtype=np.uint8):
    """The board under homography `H`: image (H, W), and true corners (N, 2) in the board's order.

    Each pixel is the mean of supersample² rays over its area, after a Gaussian of `blur` pixels. The squares one step
    beyond the inner corners are drawn, all else is light. `dark_first`: the square outside corner 0 is dark.
    """
    width, height = size
    n = supersample
    u, v = np.meshgrid((np.arange(width * n) + 0.5) / n - 0.5, (np.arange(height * n) + 0.5) / n - 0.5)
    G = np.linalg.inv(H)
    w = G[2, 0] * u + G[2, 1] * v + G[2, 2]
    column, across = _stripes((G[0, 0] * u + G[0, 1] * v + G[0, 2]) / w, board.columns)
    row, down = _stripes((G[1, 0] * u + G[1, 1] * v + G[1, 2]) / w, board.rows)
    # +1 on the squares of corner 0's color, -1 on the others, in between where an edge crosses the fine pixel.
    sign = across * down * (1 if dark_first else -1)
    fine = (LIGHT + (DARK - LIGHT) * np.where((column & row) & (w > 0), (1 + sign) / 2, 0.0)).astype(np.float32)
    if blur > 0:
        fine = cv2.GaussianBlur(fine, (0, 0), blur * n)
    image = fine.reshape(height, n, width, n).mean((1, 3))
    image = image + noise * np.random.default_rng(seed).standard_normal(image.shape)
    levels = np.clip(image, 0, 255) * (257 if dtype == np.uint16 else 1)
    if dtype != np.float64:
        levels = np.rint(levels).astype(dtype)
    squares = board.points[:, :2].numpy() / board.square
    corners = np.concatenate([squares, np.ones((len(squares), 1))], 1) @ H.T
    return levels, torch.from_numpy(corners[:, :2] / corners[:, 2:])


def _stripes(value, count):
    """Where -1 < value < count, and stripes of width 1 that alternate +1 and -1, with the cover of each edge pixel.

    Counting covered fine pixels instead would move a nearly upright edge by up to half a fine pixel.
    """
    gradient = np.hypot(*np.gradient(value))
    nearest = np.round(value)
    rising = np.where(nearest % 2 == 0, 1.0, -1.0)
    return (value > -1) & (value < count), rising * np.clip(2 * (value - nearest) / gradient, -1, 1)
