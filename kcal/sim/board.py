"""The simulator's checkerboard: size, errors of its print, pose, true corners, and colors averaged over small areas."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from kcal.checks import as_points, require_finite
from kcal.errors import InputError


class LensLike(Protocol):
    """Anything that projects: a `Camera` or a `TruthLens`."""

    size: tuple[int, int]

    @property
    def focal(self) -> Tensor:
        """(2,) focal lengths in pixels, at least roughly."""

    def project(self, points_cam: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (..., N, 2) of points (..., N, 3), and valid (..., N)."""

    def unproject(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Rays (..., N, 3) of pixels (..., N, 2), at infinity, and valid (..., N)."""

    def inside(self, pixels: Tensor) -> Tensor:
        """Whether pixels lie on the image."""


class BoardLike(Protocol):
    """Anything with a number of inner corners and a square size in meters."""

    @property
    def columns(self) -> int:
        """Inner corners in a row."""

    @property
    def rows(self) -> int:
        """Inner corners in a column."""

    @property
    def square(self) -> float:
        """Side of a square in meters."""


class BoardSize(NamedTuple):
    """A checkerboard with `columns` x `rows` inner corners and squares of `square` meters."""

    columns: int
    rows: int
    square: float


@dataclass(frozen=True)
class PrintedBoard:
    """A checkerboard as a printer and a wall leave it; poses and sizes are those of the board as it should be.

    It is stretched by 0.15 % along x, sheared by 0.02 %, bent by 0.7 mm about an oblique axis, and off by smooth errors
    of 0.03 mm.

    Args:
        columns: inner corners in a row.
        rows: inner corners in a column.
        square: side of a square in meters.
        seed: of the axis of the bend and of the smooth errors.

    Example:
        >>> board = PrintedBoard(9, 6, 0.06, seed=1)
        >>> points = board_points(board)
        >>> [round(1e3 * float(value), 1) for value in board.errors(points).abs().amax(0)]  # millimeters
        [0.4, 0.1, 0.7]
    """

    columns: int
    rows: int
    square: float
    seed: int

    def errors(self, points: Tensor) -> Tensor:
        """Return how far points (..., 3) of the board are from where they should be, meters."""
        generator = torch.Generator().manual_seed(5000 + self.seed)
        half = 0.5 * self.square * torch.tensor([self.columns - 1, self.rows - 1], dtype=torch.float64)
        off = points[..., :2] - half
        a, b = (off / half).unbind(-1)
        angle, phase = (math.pi * torch.rand(2, generator=generator, dtype=torch.float64)).tolist()
        across = a * math.cos(angle) + b * math.sin(angle)
        waves = 3e-5 * torch.randn(3, 2, generator=generator, dtype=torch.float64)
        shapes = torch.stack([torch.sin(2 * a + phase), torch.sin(2 * b + phase), torch.cos(2 * (a + b))], -1)
        x, y = (shapes @ waves / math.sqrt(1.5)).unbind(-1)
        return torch.stack([x + 1.5e-3 * off[..., 0] + 2e-4 * off[..., 1], y, 0.7e-3 * (1.0 - across**2)], -1)


class BoardPose(NamedTuple):
    """cam_from_board: `points_cam = rotation @ points_board + translation`; (3, 3) and (3,) float64 meters."""

    rotation: Tensor
    translation: Tensor


def check_board(board: BoardLike) -> None:
    """Raise `InputError` unless the board has at least 2 x 2 inner corners and squares of a positive size."""
    if board.columns < 2 or board.rows < 2 or not (board.square > 0 and math.isfinite(board.square)):
        raise InputError(
            f"board {board.columns}x{board.rows}, squares of {board.square} m: at least 2x2 inner corners and a "
            "positive size are needed"
        )


def check_pose(cam_from_board: tuple[Tensor, Tensor]) -> BoardPose:
    """Return the pose as float64.

    Raises:
        InputError: wrong shapes, values that are not finite, or a matrix that is no rotation.
    """
    rotation = as_points("cam_from_board rotation", cam_from_board[0], 3)
    translation = as_points("cam_from_board translation", cam_from_board[1], 3)
    if rotation.shape != (3, 3) or translation.shape != (3,):
        raise InputError(
            f"cam_from_board: shapes (3, 3) and (3,) are needed, got {tuple(rotation.shape)} and "
            f"{tuple(translation.shape)}"
        )
    require_finite("cam_from_board rotation", rotation)
    require_finite("cam_from_board translation", translation)
    identity = torch.eye(3, dtype=torch.float64, device=rotation.device)
    if not torch.allclose(rotation @ rotation.T, identity, atol=1e-6) or torch.linalg.det(rotation) < 0:
        raise InputError("cam_from_board rotation: not a rotation matrix (R Rᵀ must be 1 and det R = +1)")
    return BoardPose(rotation, translation)


def board_points(board: BoardLike, border: int = 0) -> Tensor:
    """Return the corners on the board, row by row: (columns * rows, 3) float64 meters, corner 0 at the origin.

    `border` adds that many squares on every side; 1 reaches the outer edge of the outer squares.

    Example:
        >>> board_points(BoardSize(3, 2, 0.5))[:, :2].tolist()
        [[0.0, 0.0], [0.5, 0.0], [1.0, 0.0], [0.0, 0.5], [0.5, 0.5], [1.0, 0.5]]
        >>> board_points(BoardSize(3, 2, 0.5), border=1).shape
        torch.Size([20, 3])
    """
    check_board(board)
    y, x = torch.meshgrid(
        torch.arange(-border, board.rows + border, dtype=torch.float64),
        torch.arange(-border, board.columns + border, dtype=torch.float64),
        indexing="ij",
    )
    return torch.stack([x.reshape(-1), y.reshape(-1), torch.zeros(x.numel(), dtype=torch.float64)], -1) * board.square


def true_corners(board: BoardLike) -> Tensor:
    """Return where the inner corners truly are, in the order of `board_points`: (N, 3) meters."""
    points = board_points(board)
    return points + board.errors(points) if isinstance(board, PrintedBoard) else points


def project_board(camera: LensLike, cam_from_board: tuple[Tensor, Tensor], board: BoardLike) -> tuple[Tensor, Tensor]:
    """Project the inner corners to their true pixels.

    Args:
        camera: a single camera, or a true lens.
        cam_from_board: rotation (3, 3) and translation (3,).
        board: its size.

    Returns:
        pixels (N, 2) in the order of `board_points`, and visible (N,): projected validly and inside the image.

    Raises:
        InputError: a board or pose that cannot be.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480))
        >>> pose = BoardPose(torch.eye(3), torch.tensor([0.0, 0.0, 2.0]))
        >>> pixels, visible = project_board(camera, pose, BoardSize(9, 6, 0.05))
        >>> pixels[1].tolist(), bool(visible.all())
        ([339.5, 239.5], True)
    """
    rotation, translation = check_pose(cam_from_board)
    pixels, valid = camera.project(true_corners(board) @ rotation.T + translation)
    return pixels, valid & camera.inside(pixels)


class Colors(NamedTuple):
    """Shares (0 to 1) of a small area that are paper (board and its white margin), and that are black squares."""

    paper: Tensor
    black: Tensor


def area_colors(a: Tensor, b: Tensor, width_a: Tensor, width_b: Tensor, board: BoardLike, margin: int) -> Colors:
    """Average the pattern over boxes around board positions, by exact integrals, so that edges do not move.

    The black share of a checkerboard is (1 + q(a) q(b)) / 2 with a square wave q along each axis. Box averages of
    both factors come from their antiderivatives (the triangle wave for q), as in I. Quilez, "Box-filtered procedural
    textures".

    Args:
        a: board x in squares from corner 0, any shape.
        b: board y likewise.
        width_a: width of each box along x in squares, positive.
        width_b: width along y.
        board: its size.
        margin: width of the white margin in squares.

    Example:
        >>> a = torch.tensor([-0.5, 0.5, 0.0], dtype=torch.float64)
        >>> narrow = torch.full_like(a, 0.1)
        >>> area_colors(a, a[:1], narrow, narrow[:1], BoardSize(9, 6, 0.05), 1).black.round(decimals=9).abs().tolist()
        [1.0, 0.0, 0.5]
    """

    def averages(t: Tensor, width: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
        low, high = t - 0.5 * width, t + 0.5 * width
        paper = high.clamp(-1 - margin, count + margin) - low.clamp(-1 - margin, count + margin)
        low, high = low.clamp(-1, count), high.clamp(-1, count)
        # |t mod 2 - 1| falls with slope 1 on (0, 1), so that q = +1 there and -1 on (-1, 0).
        wave = (low.remainder(2) - 1).abs() - (high.remainder(2) - 1).abs()
        return paper / width, (high - low) / width, wave / width

    paper_a, squares_a, wave_a = averages(a, width_a, board.columns)
    paper_b, squares_b, wave_b = averages(b, width_b, board.rows)
    return Colors(paper_a * paper_b, 0.5 * (squares_a * squares_b + wave_a * wave_b))
