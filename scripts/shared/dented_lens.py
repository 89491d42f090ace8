"""A lens with a local dent, a capture of it, and a small network for it: what no polynomial of the radius has."""

from __future__ import annotations

import functools
import math

import torch
from torch import nn

from kcal import Board, Camera, Observations, View
from kcal.lens import LensModel, rotation_from_vector
from kcal.lens.field_modes import GaussianModes
from kcal.lens.model import HybridForm

BOARD = Board(columns=9, rows=7, square=0.04)
SIZE, NOISE = (800, 600), 0.05


@functools.cache
def truth(dent: float = 3.0) -> Camera:
    """A local dent of three pixels off the middle, which no polynomial of the radius has."""
    modes = GaussianModes(widths=(0.2,))
    form = HybridForm(shape=0.9, radius=1.08 * 500.0 / 700.0, modes=modes)
    values = torch.zeros(8 + len(modes), dtype=torch.float64)
    values[:4] = torch.tensor([700.0, 700.0, 402.0, 297.0])
    x = modes.columns(torch.tensor([0.45], dtype=torch.float64), torch.tensor([-0.2], dtype=torch.float64))[:, 0, 0]
    values[8 + int(x.argmax())] = dent / 700.0
    return Camera(values, size=SIZE, model=LensModel(hybrid=form))


@functools.cache
def capture(count: int = 18, dent: float = 3.0) -> Observations:
    random, middle, views = torch.Generator().manual_seed(5), BOARD.points.mean(0), list[View]()
    while len(views) < count:
        u = 2.0 * torch.rand(6, generator=random, dtype=torch.float64) - 1.0
        turn = rotation_from_vector(torch.stack([0.5 * u[0], 0.5 * u[1], math.pi * u[2]]))
        shift = torch.stack([0.2 * u[3], 0.14 * u[4], 0.5 + 0.06 * u[5]])
        pixels, valid = truth(dent).project((BOARD.points - middle) @ turn.T + shift)
        if bool((valid & truth().inside(pixels)).all()):
            noise = NOISE * torch.randn(pixels.shape, generator=random, dtype=torch.float64)
            views.append(View(name=str(len(views)), pixels=tuple(map(tuple, (pixels + noise).tolist()))))
    return Observations(board=BOARD, image_size=SIZE, views=tuple(views))


def network() -> nn.Module:
    """Twenty waves, whose bends cross the image."""
    torch.manual_seed(2)
    chain = nn.Sequential(nn.Linear(2, 20), nn.Tanh(), nn.Linear(20, 2))
    with torch.no_grad():
        chain.get_parameter("0.weight").mul_(4.0)
    return chain


def off(camera: Camera) -> float:
    """RMS of the error at infinity over the middle of the image, pixels, after the best rotation."""
    pixels = 0.75 * (truth().grid(21, 15).reshape(-1, 2) - truth().center) + truth().center
    rays, found = truth().unproject(pixels)[0], camera.unproject(pixels)[0]
    u, _, v = torch.linalg.svd(rays.T @ found)
    return float((camera.project_rays(rays @ u @ v)[0] - pixels).square().sum(-1).mean().sqrt())
