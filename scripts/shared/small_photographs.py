"""Photographs of a chessboard of 6x5 corners, drawn in milliseconds, for what needs many or small ones."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np

from kcal.files import make_folder

WIDTH, HEIGHT = 320, 240
COLUMNS, ROWS = 6, 5  # inner corners
_CELL = 40  # pixels of a square on the sheet that is photographed


def sheet() -> np.ndarray:
    """The board's page, with one square of white around."""
    page = np.full(((ROWS + 3) * _CELL, (COLUMNS + 3) * _CELL), 220, np.uint8)
    for row, column in itertools.product(range(ROWS + 1), range(COLUMNS + 1)):
        if (row + column) % 2 == 0:
            page[(row + 1) * _CELL :, (column + 1) * _CELL :][:_CELL, :_CELL] = 30
    return page


def photographs(folder: Path, seed: int, count: int) -> None:
    """Images 0.png, ... of one camera, which has a focal length, center and distortion of its own.

    Rays of pixels are (1 + k r^2) times the pixel, so no inverse is needed.
    """
    random = np.random.default_rng(seed)
    focal, k = random.uniform(260, 340), random.uniform(0.0, 0.15)
    center = np.array([WIDTH - 1, HEIGHT - 1]) / 2 + random.uniform(-6, 6, 2)
    # Two rays a pixel and axis.
    u, v = np.meshgrid(np.arange(2 * WIDTH) / 2 - 0.25, np.arange(2 * HEIGHT) / 2 - 0.25)
    x, y = (u - center[0]) / focal, (v - center[1]) / focal
    more = 1 + k * (x * x + y * y)
    rays = np.stack([x * more, y * more, np.ones_like(x)], -1)
    page = sheet()
    make_folder(folder)
    for view in range(count):
        turn, _ = cv2.Rodrigues(np.array([*random.uniform(-0.5, 0.5, 2), random.uniform(-0.3, 0.3)]))
        # In squares: the middle of the board is near the camera's axis.
        place = np.array([*random.uniform(-0.8, 0.8, 2), random.uniform(8.5, 10.5)])
        inside = rays @ turn
        away = -turn.T @ place
        hit = away[:2] + inside[..., :2] * (-away[2] / inside[..., 2])[..., None]
        where = ((hit + (np.array([COLUMNS, ROWS]) + 3) / 2) * _CELL - 0.5).astype(np.float32)
        light = cv2.remap(page, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderValue=110)
        light = cv2.GaussianBlur(light.astype(np.float32), (0, 0), 1.4).reshape(HEIGHT, 2, WIDTH, 2).mean((1, 3))
        noisy = light + random.normal(0, 1.5, light.shape)
        cv2.imwrite(str(folder / f"{view}.png"), np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
