"""Cameras behind flat windows, in air and under water: whether the port is found, and whether error bars hold.

Truth: a central lens (scripts/check/ports.py) without a window, behind one in air, and behind one in water, all rays
by Snell's law; windows of 5 to 20 mm, 2 to 8 cm before the lens, tilted by up to 5°. 40 views of a board of 11 x 8
corners, 35 mm apart, some 0.5 to 3.5 m away; corners with 0.1 px of noise. Error bars: how often the true direction of
a pixel, at infinity in the same medium and after the best rotation, lies in the 95 % ellipse, on a grid of the image.

Cameras behind a flat window, by exact refraction: air or water, glass, air.
"""

from __future__ import annotations

import statistics
from dataclasses import dataclass
from unittest.mock import patch

import torch
from torch import Tensor

from kcal import Board, CalibrationOptions, Camera, Observations
from kcal.lens.pose import rotation_from_vector
from kcal.sim.captures import LensLike, sample_board_poses
from scripts.bench.traced_lenses import measured
from scripts.shared.captures import as_observations
from scripts.shared.page import NOT_KEPT, Kept, Lines, Record, section, table

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


MEDIA = {"no window": None, "window in air": AIR, "window in water": WATER}
BOARD = Board(columns=11, rows=8, square=0.035)
VIEWS, NOISE, FILL = 40, 0.1, (0.2, 0.92)


def seen_by(camera: LensLike | PortedCamera, seed: int, views: int = VIEWS, sigma: float = NOISE) -> Observations:
    """Views of the board in poses that cover the image."""
    generator = torch.Generator().manual_seed(seed)
    poses = sample_board_poses(camera, BOARD, views, generator, fill=FILL)  # type: ignore[arg-type]
    rotation, translation = (torch.stack([getattr(p, part) for p in poses]) for part in ("rotation", "translation"))
    pixels, _ = camera.project(BOARD.points @ rotation.mT + translation[:, None])
    noise = sigma * torch.randn(pixels.shape, dtype=torch.float64, generator=generator)
    return as_observations(pixels + noise, camera.size, BOARD)


def measure(name: str, seed: int, views: int) -> Record:
    """One capture, with the port's terms where kcal wants them, and without."""
    camera = drawn(MEDIA[name], seed)
    seen = seen_by(camera, seed, views)
    after = measured(camera, seen, CalibrationOptions())  # type: ignore[arg-type]
    before = after
    if after.get("port"):
        with patch("kcal.calibrate.hybrid.fit.pupil_recedes", lambda _: False):
            before = measured(camera, seen, CalibrationOptions())  # type: ignore[arg-type]
    return {"before": before, "after": after}


def rows(records: list[Record]) -> Lines:
    """One row for each medium."""
    for name in MEDIA:
        own = [r for r in records if r["key"][0] == name]
        if not own:
            continue
        row = [name, f"{sum(bool(r['after'].get('port')) for r in own)} of {len(own)}"]
        for key, unit in (("inside", "%"), ("beyond", "%"), ("rms", "px")):
            means = []
            for which in ("before", "after"):
                values = [r[which][key] for r in own if key in r[which] and r[which][key] == r[which][key]]
                mean = statistics.fmean(values)
                means.append(f"{100 * mean:.1f}" if unit == "%" else f"{mean:.2f}")
            row.append(" → ".join(means) if means[0] != means[1] else means[0])
        yield row


@section("one-camera.md", "ports", seeds=range(100, 101), media=("window in water",), views=10)
def ports(
    kept: Kept = NOT_KEPT, seeds: range = range(100, 200), media: tuple[str, ...] = tuple(MEDIA), views: int = VIEWS
) -> Lines:
    head = ["", "port found", "inside where boards reached, %", "beyond, %", "RMS at infinity, px"]
    return table(head, rows(kept.records([(name, seed, views) for seed in seeds for name in media], measure)))
