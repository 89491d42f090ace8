"""Simulated captures of printed boards that the tests share."""

import math

import torch
from torch import Tensor

from kcal import Board, Camera
from kcal.calibrate.hybrid.board_modes import board_modes
from kcal.lens import rotation_from_vector

# 90 degrees across the diagonal of 1280x960 px, none of ours: opencv5.
WIDE = Camera.build(
    focal=(800, 800), center=(645, 476), size=(1280, 960), coefficients=[-0.12, 0.03, 4e-4, -3e-4, 0.0], model="opencv5"
)


def printed_points(board: Board, seed: int, share: float = 5e-4) -> Tensor:
    """(N, 3) corners of a board whose modes are drawn with `share` of their units."""
    modes = board_modes(board.points)
    draw = torch.randn(len(modes.unit), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return board.points + torch.einsum("b,bkn->nk", share * modes.unit * draw, modes.shapes)


def shown(board: Board, points: Tensor, generator: torch.Generator) -> Tensor:
    """(N, 3) corners in the camera's frame, of a board in a random pose, rolled all around."""
    middle = board.points.mean(0)
    reach = float((board.points - middle).norm(dim=1).max()) / 0.24
    u = 2.0 * torch.rand(6, generator=generator, dtype=torch.float64) - 1.0
    tilt = rotation_from_vector(torch.stack([0.6 * u[0], 0.6 * u[1], torch.zeros_like(u[0])]))
    rotation = tilt @ rotation_from_vector(torch.stack([*torch.zeros(2, dtype=torch.float64), math.pi * u[2]]))
    center = torch.stack([0.4 * u[3], 0.3 * u[4], torch.ones_like(u[0])]) * (0.55 + 0.15 * u[5]) * reach
    return (points - middle) @ rotation.T + center


def seen_whole(camera: Camera, pixels: Tensor, valid: Tensor) -> bool:
    """Whether all corners are a little inside the image."""
    return bool(valid.all()) and bool((pixels > 5).all()) and bool((pixels < torch.tensor(camera.size) - 6).all())


def printed_views(
    camera: Camera, board: Board, points: Tensor, count: int, seed: int, *, noise: float, pupil: float = 0.0
) -> Tensor:
    """Corners (V, N, 2) of a board in random poses, rolled all around, seen through a wandering pupil (m / rad²)."""
    generator = torch.Generator().manual_seed(seed)
    out: list[Tensor] = []
    while len(out) < count:
        cam = shown(board, points, generator)
        from_pupil = torch.zeros_like(cam)
        from_pupil[:, 2] = pupil * torch.atan2(cam[:, :2].norm(dim=-1), cam[:, 2]) ** 2
        pixels, valid = camera.project(cam - from_pupil)
        if seen_whole(camera, pixels, valid):
            out.append(pixels + noise * torch.randn(pixels.shape, generator=generator, dtype=torch.float64))
    return torch.stack(out)


def middle_error(found: Camera, truth: Camera, share: float) -> float:
    """RMS over a share of the image about its middle of the error at infinity, pixels, after the best rotation."""
    middle = 0.5 * (torch.tensor(truth.size, dtype=torch.float64) - 1.0)
    pixels = share * (truth.grid(15, 11).reshape(-1, 2) - middle) + middle
    (rays, known), (own, seen) = truth.unproject(pixels), found.unproject(pixels)
    u, _, v = torch.linalg.svd(rays.T @ own)
    there, valid = found.project_rays(rays @ u @ v)
    assert bool((known & seen & valid).all())
    return float((there - pixels).square().sum(-1).mean().sqrt())


def shape_error(points: Tensor, true: Tensor) -> float:
    """RMS distance in meters of two boards, at the best fit of one to the other."""
    a, b = points - points.mean(0), true - true.mean(0)
    u, s, vh = torch.linalg.svd(a.T @ b)
    return float((s.sum() / a.square().sum() * a @ u @ vh - b).square().sum(-1).mean().sqrt())
