"""Simulated views of a board for scripts, and measures of what was calibrated from them.

torch and kcal are imported where they are used: other solvers' interpreters, which may have neither, import this too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from kcal.corners.observations import Observations
    from kcal.lens.camera import Camera

MODELS = {5: "opencv5", 8: "opencv8", 14: "opencv14", 20: "ext20"}
SIZE, COLUMNS, ROWS, SQUARE, NOISE = (1920, 1080), 6, 7, 0.05, 0.2
TRUTH = [-0.35, 0.15, 3e-4, -2e-4, -0.03, 0.02, -0.015, 0.005, 4e-4, -2e-4, -3e-4, 2e-4, 0.004, -0.003]
WEAK = 0.3  # the weak prior, where one is used


def true_camera() -> Camera:
    from kcal.lens.camera import Camera

    return Camera.build(focal=(1600, 1600), center=(963, 536), size=SIZE, coefficients=TRUTH, model="opencv14")


def simulate(
    count: int, camera: Camera | None = None, *, noise: float = NOISE, seed: int | None = None
) -> dict[str, np.ndarray]:
    """Views of a board that is wholly inside the image, tilted up to 45 degrees, with normal noise."""
    import torch

    from kcal.corners.board import Board
    from kcal.lens.pose import rotation_from_vector

    rng = np.random.default_rng(count if seed is None else seed)
    camera = camera or true_camera()
    focal = float(camera.focal[0])
    board = Board(columns=COLUMNS, rows=ROWS, square=SQUARE).points
    rotations: list[np.ndarray] = []
    translations: list[np.ndarray] = []
    pixels: list[np.ndarray] = []
    while len(pixels) < count:
        middle = torch.tensor(rng.uniform([0, 0], SIZE))[None]
        tilt, azimuth = np.deg2rad(rng.uniform(0, 45)), rng.uniform(0, 2 * np.pi)
        axis = torch.tensor([[np.cos(azimuth), np.sin(azimuth), 0.0], [0.0, 0.0, 0.0]]).double() * tilt
        axis[1, 2] = rng.uniform(-np.pi / 6, np.pi / 6)
        rotation = rotation_from_vector(axis[0]) @ rotation_from_vector(axis[1])
        depth = focal * SQUARE * (ROWS - 1) / (rng.uniform(0.18, 0.55) * SIZE[1])
        ray = camera.normalize(middle)[0][0]
        center = depth * torch.cat([ray, torch.ones(1).double()])
        translation = center - rotation @ board.mean(0)
        seen, valid = camera.project(board @ rotation.T + translation)
        if bool((valid & camera.inside(seen)).all()):
            rotations.append(rotation.numpy())
            translations.append(translation.numpy())
            pixels.append(seen.detach().numpy() + rng.normal(0, noise, seen.shape))
    return {
        "board": board.numpy(),
        "pixels": np.array(pixels),
        "rotation": np.array(rotations),
        "translation": np.array(translations),
    }


def observed(pixels: list[list[list[float]]]) -> Observations:
    """Corners (V, N, 2) of the benchmark's board as observations; NaN where not seen."""
    from kcal.corners.board import Board
    from kcal.corners.observations import Observations, View

    corners = (tuple((u, v) if u == u else None for u, v in view) for view in pixels)
    views = tuple(View(name=f"{i:04}", pixels=view) for i, view in enumerate(corners))
    return Observations(board=Board(columns=COLUMNS, rows=ROWS, square=SQUARE), image_size=SIZE, views=views)


def flipped_views(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Which of V boards, rotations (V, 3, 3), are more than 8 degrees from the truth."""
    turn = np.einsum("vij,vij->v", found, truth)
    return np.degrees(np.arccos(np.clip((turn - 1) / 2, -1, 1))) > 8


def image_error(found: Camera, truth: Camera) -> float:
    """RMS over the image, in pixels, of the angle between the rays of both cameras after their best rotation."""
    import torch

    pixels = truth.grid(24, 14)
    (ours, valid), (theirs, known) = found.unproject(pixels), truth.unproject(pixels)
    both = valid & known
    a = torch.nn.functional.normalize(ours[both].detach(), dim=-1)
    b = torch.nn.functional.normalize(theirs[both].detach(), dim=-1)
    u, _, vh = torch.linalg.svd(b.T @ a)
    turned = a @ (u @ vh).T
    return float(truth.focal[0]) * float((turned - b).square().sum(-1).mean().sqrt())
