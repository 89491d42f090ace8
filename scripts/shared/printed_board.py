"""Photographs of printed boards of any pattern, with their true points: the page of `kcal board` through a camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal import Board, Camera
from kcal.corners.print_board import board_sheet
from kcal.lens import rotation_from_vector

DARK, LIGHT = 40.0, 210.0
WALL = 0.3  # share of white
_FINE = 4  # rays a pixel and axis
_RAYS: dict[tuple[str, int], NDArray[np.float64]] = {}  # of the last camera


class Paper:
    """A board's page as shares of black, exact on each cell of a fine grid."""

    def __init__(self, board: Board, cell_mm: float = 0.1, page: str = "auto") -> None:
        sheet = board_sheet(board, page)
        self.board, self.cell = board, cell_mm
        self.origin = np.array(sheet.origin)
        width, height = (round(side / cell_mm) for side in (sheet.drawing.width, sheet.drawing.height))
        black = np.zeros((height, width), np.float32)
        for r in sheet.drawing.rectangles:
            add(black, r.x / cell_mm, r.y / cell_mm, r.width / cell_mm, r.height / cell_mm)
        for c in sheet.drawing.circles:
            add_circle(black, c.x / cell_mm, c.y / cell_mm, c.diameter / cell_mm / 2)
        self.light = 1.0 - black.clip(0, 1)

    def shoot(
        self,
        camera: Camera,
        rotation: Tensor,
        translation: Tensor,
        blur: float = 0.7,
        noise: float = 1.5,
        seed: int = 0,
        supersample: int = _FINE,
    ) -> tuple[NDArray[np.uint8], Tensor]:
        """An image (H, W) uint8 and the true points (N, 2)."""
        width, height = camera.size
        fine = light_of([(self, rotation, translation)], camera, supersample)
        image = expose(fine, width, height, blur, noise, seed, supersample)
        return image, points_of(self.board, camera, rotation, translation)


def light_of(
    scenes: Sequence[tuple[Paper, Tensor, Tensor]], camera: Camera, supersample: int = _FINE, wall: float = WALL
) -> NDArray[np.float32]:
    """Shares of white on a grid of `supersample` rays a pixel and axis; papers lie before a wall, later ones on top."""
    width, height = camera.size
    axis = [(np.arange(side * supersample) + 0.5) / supersample - 0.5 for side in (width, height)]
    u, v = np.meshgrid(*axis)
    key = (camera.fingerprint, supersample)
    if key not in _RAYS:
        _RAYS.clear()
        _RAYS[key] = camera.unproject(torch.from_numpy(np.stack([u, v], -1)))[0].numpy()
    rays = _RAYS[key]
    fine = np.full(u.shape, wall, np.float32)
    for paper, rotation, translation in scenes:
        R, t = rotation.numpy(), translation.numpy()
        inside = rays @ R
        center = -R.T @ t
        with np.errstate(divide="ignore", invalid="ignore"):
            hit = center[:2] + inside[..., :2] * (-center[2] / inside[..., 2])[..., None]
        where = ((1000 * hit + paper.origin) / paper.cell - 0.5).astype(np.float32)
        # The page is averaged over the distance of two rays, so that they miss no edge.
        pitch = float(np.nanmedian(np.linalg.norm(np.diff(where, axis=1), axis=-1)))
        light = cv2.GaussianBlur(paper.light, (0, 0), max(0.5 * pitch, 0.3), borderType=cv2.BORDER_REPLICATE)
        sample = cv2.remap(light, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderValue=-1.0)
        fine = np.where(np.isfinite(sample) & (sample >= 0) & (inside[..., 2] > 0), sample, fine)
    return fine


def through_lens(
    fine: NDArray[np.float32], width: int, height: int, blur: float = 0.7, supersample: int = _FINE
) -> NDArray[np.float64]:
    """What falls on each pixel of the light on a fine grid, blurred by `blur` pixels."""
    fine = np.asarray(cv2.GaussianBlur(fine, (0, 0), blur * supersample), np.float32) if blur else fine
    return np.asarray(fine.reshape(height, supersample, width, supersample).mean((1, 3)), np.float64)


def expose(
    fine: NDArray[np.float32],
    width: int,
    height: int,
    blur: float = 0.7,
    noise: float = 1.5,
    seed: int = 0,
    supersample: int = _FINE,
) -> NDArray[np.uint8]:
    """An image (H, W) of the light on a fine grid."""
    image = DARK + (LIGHT - DARK) * through_lens(fine, width, height, blur, supersample)
    image += noise * np.random.default_rng(seed).standard_normal((height, width))
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def points_of(board: Board, camera: Camera, rotation: Tensor, translation: Tensor) -> Tensor:
    """Pixels (N, 2) of the board's points."""
    return camera.project(board.points @ rotation.T + translation)[0]


def pose(
    board: Board, tilt: Sequence[float], distance: float, shift: tuple[float, float] = (0.0, 0.0)
) -> tuple[Tensor, Tensor]:
    """The board's middle at `distance` before the camera, turned by a rotation vector."""
    rotation = rotation_from_vector(torch.tensor(tilt, dtype=torch.float64))
    middle = 0.5 * (board.points.amin(0) + board.points.amax(0))
    place = torch.tensor([*shift, distance], dtype=torch.float64)
    return rotation, place - rotation @ middle


def errors(pixels: Tensor, truth: Tensor) -> tuple[float, float, int]:
    """RMS and largest error of the points that were found, and how many there are."""
    distance = (pixels - truth).norm(dim=-1)
    distance = distance[distance.isfinite()]
    return float(distance.square().mean().sqrt()), float(distance.max()), len(distance)


def add(black: NDArray[Any], x: float, y: float, width: float, height: float) -> None:
    """Add a rectangle by the share of each cell that it covers."""
    rows, columns = (
        np.clip(np.minimum(np.arange(size) + 1, begin + length) - np.maximum(np.arange(size), begin), 0, 1)
        for size, begin, length in ((black.shape[0], y, height), (black.shape[1], x, width))
    )
    i, j = np.flatnonzero(rows), np.flatnonzero(columns)
    black[np.ix_(i, j)] += np.outer(rows[i], columns[j]).astype(np.float32)


def add_circle(black: NDArray[Any], x: float, y: float, radius: float, parts: int = 16) -> None:
    """Add a circle by the share of each cell that it covers."""
    top, left = int(y - radius) - 1, int(x - radius) - 1
    size = int(2 * radius) + 4
    axis = (np.arange(size * parts) + 0.5) / parts
    inside = (axis[None] + left - x) ** 2 + (axis[:, None] + top - y) ** 2 < radius**2
    black[top : top + size, left : left + size] += inside.reshape(size, parts, size, parts).mean((1, 3))
