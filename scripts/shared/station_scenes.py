"""Stations some kilometers apart that look at one area, with truth for tests and figures."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcal import Camera, Origin, Rig
from kcal.lens import rotation_from_vector
from kcal.lens.pose import enu_from_cam
from kcal.locate.geodesy import anchor, ecef_from_enu_rotation, enu_to_geodetic, geodetic_to_enu, mean_radius

ORIGIN = Origin(lat=45.0, lon=6.0, height=800.0)


def ring(count: int, radius: float, focal: float = 1600.0, refraction: float = 0.13) -> Rig:
    """Stations around a place `radius` m away, over half a circle, level at their own verticals."""
    camera = Camera.build(focal=(focal, focal), center=(959.5, 539.5), size=(1920, 1080), model="pinhole")
    angles = [math.pi * (c + 0.5) / count for c in range(count)]
    flat = torch.tensor([[radius * math.cos(a), -radius * math.sin(a), 0.0] for a in angles], dtype=torch.float64)
    geodetic = enu_to_geodetic(flat, ORIGIN)
    geodetic[:, 2] = ORIGIN.height + 100.0 + 10.0 * torch.arange(count)
    center, base = geodetic_to_enu(geodetic, ORIGIN), anchor(ORIGIN)[0]
    turns = []
    for (lat, lon, _), place in zip(geodetic.tolist(), center, strict=True):
        to_own = ecef_from_enu_rotation(lat, lon).T @ base
        way = to_own @ -place
        turns.append(enu_from_cam(math.degrees(math.atan2(float(way[0]), float(way[1])))).T @ to_own)
    names = [f"tower {c + 1}" for c in range(count)]
    return Rig([camera] * count, names, torch.stack(turns), center=center, origin=ORIGIN, refraction=refraction)


def drawn_errors(root: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """(N, P) errors of a rig, drawn from what `root` says."""
    return torch.randn(count, len(root), dtype=torch.float64, generator=generator) @ root


def marks(rig: Rig, points: Tensor, errors: Tensor | None = None) -> Tensor:
    """(N, C, 2) where points (N, 3) are seen through bent light by rigs off by `errors` (N, P), lenses excepted.

    Not as kcal computes it: in each station's own east, north, up.
    """
    assert rig.origin is not None
    errors = torch.zeros(len(points), rig.quantities, dtype=torch.float64) if errors is None else errors
    pixels = []
    for c, camera in enumerate(rig.each):
        lat, lon, _ = enu_to_geodetic(rig.center[c], rig.origin).tolist()
        to_own = ecef_from_enu_rotation(lat, lon).T @ anchor(rig.origin)[0]
        pose = errors[:, rig.pose_columns(c)]
        own = (points - rig.center[c] - pose[:, :3]) @ to_own.T
        bending = (rig.refraction + errors[:, -1]) / (2.0 * mean_radius(lat))
        lift = bending * own[:, :2].square().sum(-1)
        seen = torch.cat([own[:, :2], own[:, 2:] + lift[:, None]], 1) @ to_own
        turn = rig.rotation[c] @ rotation_from_vector(-pose[:, 3:])
        pixels.append(camera.project((turn @ seen[..., None])[..., 0])[0])
    return torch.stack(pixels, 1)


def targets(count: int, generator: torch.Generator, spread: float = 300.0) -> Tensor:
    """(N, 3) points about the middle."""
    flat = spread * torch.randn(count, 3, dtype=torch.float64, generator=generator)
    return flat * torch.tensor([1.0, 1.0, 0.1]) + torch.tensor([0.0, 0.0, 120.0])


def hills(side: int = 400, seed: int = 4, mean: float = 400.0, spread: float = 180.0) -> Tensor:
    """(side, side) heights of rolling ground, rougher the larger the scale, meters."""
    generator = torch.Generator().manual_seed(seed)
    frequency = torch.fft.fftfreq(side, dtype=torch.float64)
    power = (frequency[:, None].square() + frequency.square()).clamp_min(1e-5) ** -1.05
    noise = torch.randn(side, side, 2, generator=generator, dtype=torch.float64)
    ground = torch.fft.ifft2(torch.view_as_complex(noise) * power).real
    return mean + spread * (ground - ground.mean()) / ground.std()
