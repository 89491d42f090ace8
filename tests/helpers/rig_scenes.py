"""A simulated site for the tests of joint rigs: three unlike cameras, boards, landmarks, far features."""

import math

import torch
from torch import Tensor

from kcal import Board, Boards, Camera, Features, Landmarks
from kcal.lens import rotation_from_vector

BOARD = Board(columns=7, rows=6, square=0.4)
# Left, right, and a narrower one of another size and model between them.
CAMERAS = (
    Camera.build(focal=(1602, 1600), center=(968, 534), size=(1920, 1080), coefficients=[-0.2, 0.06, 3e-4, -2e-4]),
    Camera.build(focal=(1611, 1610), center=(951, 546), size=(1920, 1080), coefficients=[-0.19, 0.05, -2e-4, 3e-4]),
    Camera.build(focal=(1205, 1204), center=(641, 478), size=(1280, 960), model="fisheye4", coefficients=[0.01, 0.002]),
)
NAMES = ("left", "right", "middle")


def tensor(*values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def poses() -> tuple[Tensor, Tensor]:
    """cam_from_local rotations (3, 3, 3) and centers (3, 3); all look about north-north-east."""
    heading = math.radians(16.0)
    look = tensor(
        [math.cos(heading), -math.sin(heading), 0.0],
        [0.0, 0.0, -1.0],
        [math.sin(heading), math.cos(heading), 0.0],
    )
    turns = rotation_from_vector(tensor([0.01, 0.0, 0.004], [0.013, 0.006, -0.004], [0.005, -0.01, 0.01]))
    right = look[0]
    centers = torch.stack([-5.0 * right, 5.0 * right + tensor(0, 0, 0.1), 0.4 * right + tensor(0, 0, 0.9)])
    return turns @ look, centers + tensor(2.0, -1.0, 3.0)


ROTATION, CENTER = poses()


def see(points: Tensor, camera: int) -> Tensor:
    """(..., N, 2) pixels, NaN where a camera does not see a point."""
    pixels, valid = CAMERAS[camera].project((points - CENTER[camera]) @ ROTATION[camera].T)
    good = valid & CAMERAS[camera].inside(pixels)
    return torch.where(good[..., None], pixels, torch.nan)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def normal(shape: object, seed: int) -> Tensor:
    return torch.randn(shape, dtype=torch.float64, generator=generator(seed))  # type: ignore[call-overload]


def spread_points(
    count: int, near: float, far: float, seed: int, along: Tensor = ROTATION[0], center: Tensor = CENTER[0]
) -> Tensor:
    """Points in view of a camera, log-uniform in range, from below to above the horizon."""
    draw = torch.rand(count, 3, dtype=torch.float64, generator=generator(seed))
    distance = near * (far / near) ** draw[:, :1]
    across, up = 0.7 * (draw[:, 1:2] - 0.5), 0.4 * (draw[:, 2:] - 0.5)
    return center + distance * (along[2] + across * along[0] - up * along[1])


def posts(
    truth: Tensor, pixels: Tensor, *, noise: float, error: float, survey: float, sigma: float, seeds: tuple[int, int]
) -> Landmarks:
    """Surveyed points (N, 3) off by `error` m, which claims `survey` m, and marks off by `noise` px, of `sigma` px."""
    return Landmarks(
        names=tuple(f"post {i}" for i in range(len(truth))),
        points=truth + error * normal(truth.shape, seeds[0]),
        sigma=torch.full(truth.shape, survey, dtype=torch.float64),
        pixels=pixels + noise * normal(pixels.shape, seeds[1]),
        pixel_sigma=sigma,
    )


def landmarks(
    *, count: int = 12, cameras: int = 2, noise: float = 0.0, survey: float = 0.02, error: float = 0.0, seed: int = 0
) -> Landmarks:
    """Surveyed points from 60 m to 2 km; `noise` px on the marks, `error` m on the survey, which claims `survey` m."""
    truth = spread_points(count, 60.0, 2000.0, 5)
    pixels = torch.stack([see(truth, c) for c in range(cameras)], 1)
    seeds, sigma = (100 + seed, 200 + seed), max(noise, 0.1)
    return posts(truth, pixels, noise=noise, error=error, survey=survey, sigma=sigma, seeds=seeds)


def features(
    *, count: int = 20, cameras: int = 2, noise: float = 0.0, known: float = math.inf, seed: int = 0
) -> Features:
    """Points from 8 to 40 km, their inverse range known to a share `known`."""
    truth = spread_points(count, 8000.0, 40_000.0, 9)
    pixels = torch.stack([see(truth, c) for c in range(cameras)], 1)
    inverse = 1.0 / torch.linalg.vector_norm(truth - CENTER[:cameras].mean(0), dim=-1)
    sigma = known * inverse
    told = inverse + (sigma * normal(sigma.shape, 300 + seed) if math.isfinite(known) and noise else 0.0)
    return Features(
        names=tuple(f"peak {i}" for i in range(count)),
        pixels=pixels + noise * normal(pixels.shape, 400 + seed),
        inverse_range=told,
        inverse_range_sigma=sigma,
        pixel_sigma=max(noise, 0.1),
    )


def boards(*, count: int = 6, cameras: int = 2, noise: float = 0.0, seed: int = 0) -> Boards:
    """A large board at 14 to 25 m, tilted all round."""
    views, draw = [], torch.rand(count, 4, dtype=torch.float64, generator=generator(3))
    middle = BOARD.points.mean(0)
    for i in range(count):
        angle = 2.0 * math.pi * i / count
        turn = rotation_from_vector(tensor(0.5 * math.cos(angle), 0.5 * math.sin(angle), 0.1 * float(draw[i, 3])))
        place = tensor(3.0 + 4.0 * float(draw[i, 0]), 2.0 * float(draw[i, 1]) - 1.0, 18.0 + 7.0 * float(draw[i, 2]))
        points = ((BOARD.points - middle) @ turn.T + place) @ ROTATION[0] + CENTER[0]
        views.append(torch.stack([see(points, c) for c in range(cameras)]))
    pixels = torch.stack(views)
    return Boards(
        board=BOARD,
        pixels=pixels + noise * normal(pixels.shape, 500 + seed),
        names=tuple(f"pair {i}" for i in range(count)),
    )
