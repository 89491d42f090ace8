"""A rig with 10 m of baseline, the ranges at which it is measured, and how well marks alone can tell a range."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from kcal import Camera, Features, Landmarks, Origin, Rig
from kcal.lens import rotation_from_vector

RANGES = (100.0, 250.0, 500.0, 1000.0, 2000.0, 3500.0, 5000.0)
ORIGIN = Origin(lat=19.07, lon=72.87, height=14.0)


def rig() -> Rig:
    """10 m of baseline, f 1600 px, unlike lenses that converge a little."""
    size = (1920, 1080)
    left = Camera.build(focal=(1600, 1603), center=(957, 541), size=size, coefficients=[-0.2, 0.06, 3e-4, -2e-4])
    right = Camera.build(focal=(1605, 1601), center=(962, 538), size=size, coefficients=[-0.19, 0.05, -2e-4, 3e-4])
    rotation = rotation_from_vector(torch.tensor([0.003, 0.02, -0.004], dtype=torch.float64))
    return Rig.pair(left, right, rotation, rotation @ torch.tensor([-10.0, 0.15, 0.2], dtype=torch.float64))


def matches_of(pixels: Tensor, **noise: Any) -> Features:
    """Matches (N, V, 2) of unknown range; their noise is `pixel_sigma` or `covariance`."""
    nothing = torch.zeros(len(pixels), dtype=torch.float64)
    names, sigma = tuple(map(str, range(len(pixels)))), torch.full_like(nothing, torch.inf)
    return Features(names=names, pixels=pixels, inverse_range=nothing, inverse_range_sigma=sigma, **noise)


def landmarks_of(points: Tensor, pixels: Tensor, survey: float, mark: float) -> Landmarks:
    """Landmarks (L, 3) and their marks (L, V, 2) without noise, as known to `survey` meters and `mark` pixels."""
    names = tuple(f"post {i}" for i in range(1, len(points) + 1))
    return Landmarks(names=names, points=points, sigma=torch.full_like(points, survey), pixels=pixels, pixel_sigma=mark)


def with_noise(exact: Landmarks, draw: torch.Generator) -> Landmarks:
    """The same, surveyed and marked with the errors that they state."""
    survey = exact.sigma * torch.randn(exact.points.shape, dtype=torch.float64, generator=draw)
    marks = exact.pixel_sigma * torch.randn(exact.pixels.shape, dtype=torch.float64, generator=draw)
    return dataclasses.replace(exact, points=exact.points + survey, pixels=exact.pixels + marks)


def range_sigma(project: Callable[[Tensor], tuple[Tensor, Tensor]], points: Tensor, mark: float) -> Tensor:
    """(N,) meters: standard deviation of each range that noise in the marks leaves, with the rig known exactly.

    Args:
        project: the rig: its points (N, 3) to pixels (N, 2, 2), and which are seen (N, 2).
        points: (N, 3) in the left camera's frame.
        mark: standard deviation of a mark along each axis, px.
    """
    columns = []
    length = points.norm(dim=-1, keepdim=True)
    for axis in torch.eye(3, dtype=torch.float64):
        step = 1e-5 * length * axis
        ahead, behind = (project(points + sign * step)[0].flatten(-2) for sign in (1, -1))
        columns.append((ahead - behind) / (2e-5 * length))
    jacobian = torch.stack(columns, -1)
    covariance = torch.linalg.inv(jacobian.transpose(-1, -2) @ jacobian) * mark**2
    sight = points / length
    return torch.einsum("ni,nij,nj->n", sight, covariance, sight).sqrt()
