"""Rendered frames of a board, as a camera sees them while it is photographed."""

import functools

import numpy as np
import numpy.typing as npt
import torch

from kcal import Board, Camera
from kcal.sim.captures import BoardSize, sample_board_poses
from kcal.sim.scene import RenderOptions, render_board

BOARD = Board(columns=6, rows=5, square=0.02)
Image = npt.NDArray[np.uint8]


@functools.cache
def images() -> tuple[Image, ...]:
    camera = Camera.build(focal=(300, 300), center=(159.5, 119.5), size=(320, 240), model="pinhole")
    size, generator = BoardSize(BOARD.columns, BOARD.rows, BOARD.square), torch.Generator().manual_seed(5)
    poses = sample_board_poses(camera, size, 6, generator, fill=(0.5, 0.8))
    return tuple(render_board(camera, pose, size, RenderOptions(), generator).numpy() for pose in poses)
