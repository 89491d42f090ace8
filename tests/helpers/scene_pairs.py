"""Small pictures of upright textured planes by a rig with a baseline of 2 m, f 500 px."""

import numpy as np
import torch
from numpy.typing import NDArray

from kcal import Camera, Rig
from kcal.lens import rotation_from_vector
from kcal.rig import ImagePair
from kcal.sim.coast import exposed, smooth_noise

SIZE = (480, 320)
# Distance, left and right edge, upper and lower edge, meters; y is down.
STILL = (
    (600.0, -500.0, 500.0, -300.0, 300.0),
    (120.0, -60.0, -20.0, -20.0, 25.0),
    (60.0, -2.0, 20.0, -5.0, 18.0),
    (40.0, -16.0, -5.0, 2.0, 12.0),
)
VAN = (30.0, 4.0, 12.0, -8.0, -1.0)


def small_rig() -> Rig:
    """Lenses that distort, turned a little."""
    left = Camera.build(focal=(500, 501), center=(238, 161), size=SIZE, coefficients=[-0.12, 0.03, 2e-4, -1e-4])
    right = Camera.build(focal=(502, 500), center=(241, 158), size=SIZE, coefficients=[-0.11, 0.02, -1e-4, 2e-4])
    turn = rotation_from_vector(torch.tensor([0.01, 0.03, -0.02], dtype=torch.float64))
    return Rig.pair(left, right, turn, turn @ torch.tensor([-2.0, 0.05, 0.1], dtype=torch.float64))


def drawn_pixels(draw: torch.Generator, count: int) -> torch.Tensor:
    """(M, 2, 2): places that both cameras of the small rig see, without errors."""
    rig, size = small_rig(), torch.tensor(SIZE, dtype=torch.float64)
    left = torch.rand(2 * count, 2, dtype=torch.float64, generator=draw) * (size - 1.0)
    ranges = 40.0 * 20.0 ** torch.rand(len(left), 1, dtype=torch.float64, generator=draw)
    right = rig(ranges * rig.left.unproject(left)[0])[0][:, 1]
    return torch.stack([left, right], 1)[rig.right.inside(right)][:count]


def pair(
    seed: int,
    *,
    van: float | None = None,
    noise: float = 1.5,
    texture: float = 0.0,
    turns: torch.Tensor | None = None,
) -> ImagePair:
    """Both images; a van drives along the scene if it is given where, meters; `turns` (6,) of the cameras, radians."""
    planes = list(STILL)
    if van is not None:
        distance, low, high, top, bottom = VAN
        planes.append((distance, low + van, high + van, top, bottom))
    rig, random, images = small_rig(), np.random.default_rng(seed), []
    for side in (0, 1):
        turn = None if turns is None else turns[3 * side : 3 * side + 3]
        images.append(exposed(_light(rig, side, planes, texture, turn), 0.7, noise, random))
    return ImagePair(f"pair {seed}", *images)


def true_right(left: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Where the right camera sees what the left one sees, and the distance of its plane."""
    rig = small_rig()
    rays = rig.left.unproject(left)[0]
    rays, depth = rays / rays[:, 2:], torch.full((len(left),), STILL[0][0], dtype=torch.float64)
    for distance, low, high, top, bottom in STILL[1:]:
        at = distance * rays
        inside = (at[:, 0] > low) & (at[:, 0] < high) & (at[:, 1] > top) & (at[:, 1] < bottom)
        depth = torch.where(inside, distance, depth)
    return rig(depth[:, None] * rays)[0][:, 1], depth


def _light(
    rig: Rig, side: int, planes: list[tuple[float, ...]], texture: float, turn: torch.Tensor | None
) -> NDArray[np.float64]:
    grid = torch.stack(torch.meshgrid(*(torch.arange(n).double() for n in SIZE), indexing="xy"), -1).reshape(-1, 2)
    rays, _ = (rig.right if side else rig.left).unproject(grid)
    if turn is not None:
        rays = rays @ rotation_from_vector(turn)
    center = torch.zeros(3, dtype=torch.float64)
    if side:
        rays = rays @ rig.right_from_left_rotation
        center = -rig.right_from_left_rotation.T @ rig.right_from_left_translation
    light = np.zeros(len(rays))
    for number, (distance, low, high, top, bottom) in enumerate(planes):
        at = (center + (distance - center[2]) / rays[:, 2:] * rays).numpy()
        pixel, x, y = distance / 500.0, at[:, 0], at[:, 1]
        inside = np.minimum(np.minimum(x - low, high - x), np.minimum(y - top, bottom - y))
        share = np.clip(inside / pixel + 0.5, 0.0, 1.0)
        value = np.full(len(rays), 90.0 + 20.0 * number)
        for wave in (5.0, 11.0, 29.0):
            value += 22.0 * smooth_noise((x - low) / (wave * pixel) + number + texture, y / (wave * pixel), 1)
        light += share * (value - light)
    found: NDArray[np.float64] = light.reshape(SIZE[::-1])
    return found
