"""Cameras behind a flat window, by exact refraction: air or water, glass, air."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kcal import Camera
from kcal.lens.pose import rotation_from_vector

AIR, GLASS, WATER = 1.0, 1.52, 1.333
_HALVINGS = 60


@dataclass(frozen=True, kw_only=True)
class PortedCamera:
    """A camera in a housing: a plane window refracts the light on its way to the lens (Snell's law).

    Args:
        lens: of the camera in air, central.
        normal: (3,) of the window, of length one, outward.
        gap: meters along it from the entrance pupil to the window.
        thickness: of the window, meters.
        outside: index of refraction of what is outside; inside is air.

    Example:
        >>> lens = Camera.build(focal=(1000, 1000), center=(500, 500), size=(1001, 1001))
        >>> under = PortedCamera(lens=lens, normal=torch.tensor([0.0, 0, 1]).double(), gap=0.05, thickness=0.01)
        >>> ray = under.unproject(torch.tensor([[900.0, 500.0]]))[0][0]
        >>> round(float(ray[0]) * WATER, 6) == round(0.4 / (1 + 0.4**2) ** 0.5, 6)
        True
    """

    lens: Camera
    normal: Tensor
    gap: float
    thickness: float
    outside: float = WATER

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the image."""
        return self.lens.size

    @property
    def focal(self) -> Tensor:
        """(2,) pixels, about the axis, of what is outside."""
        return self.lens.focal * self.outside

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (..., N, 2) of points (..., N, 3) outside, and which are seen."""
        ahead = points @ self.normal
        across = points - ahead[..., None] * self.normal
        target, depth = across.norm(dim=-1), ahead - self.gap - self.thickness
        low, high = torch.zeros_like(ahead), torch.ones_like(ahead)
        for _ in range(_HALVINGS):
            # The sine in air of the angle to the normal: how far from it does that ray pass the point's plane?
            sine = 0.5 * (low + high)
            reached = sum(
                length * sine / torch.sqrt(index**2 - sine**2)
                for length, index in ((self.gap, AIR), (self.thickness, GLASS), (depth, self.outside))
            )
            low, high = torch.where(reached < target, sine, low), torch.where(reached < target, high, sine)
        heading = torch.nn.functional.normalize(across, dim=-1) * sine[..., None]
        pixels, valid = self.lens.project(heading + torch.sqrt(1.0 - sine**2)[..., None] * self.normal)
        return pixels, valid & (depth > 0)

    def unproject(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Directions (..., N, 3) outside, and which pixels have one."""
        rays, valid = self.lens.unproject(pixels)
        ahead = (rays @ self.normal)[..., None]
        across = (rays - ahead * self.normal) / self.outside
        return across + torch.sqrt(1.0 - across.square().sum(-1, keepdim=True)) * self.normal, valid


def drawn(medium: float | None, seed: int, size: tuple[int, int] = (1920, 1080)) -> PortedCamera | Camera:
    """A camera of 1400 to 1800 px behind a window of 5 to 15 mm, 2 to 8 cm before it, tilted by up to 5°; or without.

    `medium` is the index of what is outside; None: there is no window.
    """
    r = torch.rand(8, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)).tolist()
    focal, center = 1400.0 + 400.0 * r[0], (959.5 + 30.0 * (r[1] - 0.5), 539.5 + 30.0 * (r[2] - 0.5))
    lens = Camera.build(focal=(focal, focal), center=center, size=size, coefficients=[-0.1 * r[3], 0.02 * r[3]])
    if medium is None:
        return lens
    axis = torch.tensor([r[4] - 0.5, r[5] - 0.5, 0.0], dtype=torch.float64)
    turn = rotation_from_vector(axis / axis.norm() * 0.0873 * r[6])
    gap, thickness = 0.02 + 0.06 * r[7], 0.005 + 0.01 * r[3]
    return PortedCamera(lens=lens, normal=turn[:, 2], gap=gap, thickness=thickness, outside=medium)
