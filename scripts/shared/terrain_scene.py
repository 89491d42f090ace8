"""Pictures of one terrain by both cameras of a rig: ground, hills and blocks from 50 m to 20 km, and what moves.

Each piece is an upright plane or the level ground, with texture, so that the truth of every pixel is known. The finest
texture is four pixels wide, so that one ray for each pixel is enough.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.sim.backdrop import exposed
from kcal.sim.noise import smooth_noise
from kcal.sim.true_rig import TrueRig
from kcal.sim.truth import TruthLens

Floats = NDArray[np.float64]
EYE_HEIGHT = 14.0  # meters above the ground
SKY = 205.0


@dataclass(frozen=True, kw_only=True)
class Piece:
    """An upright plane across the left camera's axis.

    Args:
        distance: meters along that axis.
        middle: of it to the side, meters.
        half: half its width, meters.
        top: of its upper edge above the cameras, meters.
        rough: by which that edge rises and falls, meters.
        seed: of its texture.
        gray: its mean level.
    """

    distance: float
    middle: float
    half: float
    top: float
    rough: float
    seed: float
    gray: float


class Picture(NamedTuple):
    """What a camera sees.

    Attributes:
        light: (H, W) gray levels before blur and noise.
        depth: (H, W) meters along the left camera's axis, of what is seen; infinite for the sky.
        moving: (H, W) whether it moves.
    """

    light: Floats
    depth: Floats
    moving: NDArray[np.bool_]


def pieces(seed: int) -> list[Piece]:
    """Hills and blocks of a seed."""
    random = np.random.default_rng(seed)
    found = []
    for distance, top in ((20_000.0, 520.0), (11_000.0, 200.0), (6_000.0, 70.0), (3_200.0, 18.0), (1_700.0, 0.0)):
        found.append(
            Piece(distance=distance, middle=0.0, half=2.0 * distance, top=top, rough=0.016 * distance,
                  seed=float(random.uniform(0, 99)), gray=float(random.uniform(80, 130)))
        )  # fmt: skip
    for distance in np.geomspace(50.0, 2500.0, 48):
        middle = float(distance * random.uniform(-0.6, 0.6))
        width = float(distance * random.uniform(0.015, 0.05))
        found.append(
            Piece(distance=float(distance), middle=middle, half=width, rough=0.0,
                  top=float(-EYE_HEIGHT + random.uniform(1.0, 3.0) * width), seed=float(random.uniform(0, 99)),
                  gray=float(random.uniform(70, 170)))
        )  # fmt: skip
    return sorted(found, key=lambda piece: -piece.distance)


def movers(seed: int, moment: int) -> list[Piece]:
    """Vehicles, at each moment elsewhere."""
    random = np.random.default_rng([seed, moment, 7])
    return [
        Piece(distance=float(distance), middle=float(distance * random.uniform(-0.5, 0.5)), half=2.5,
              top=-EYE_HEIGHT + 3.0, rough=0.0, seed=float(random.uniform(0, 99)), gray=float(random.uniform(50, 200)))
        for distance in np.geomspace(60.0, 400.0, 10)
    ]  # fmt: skip


class TerrainScene:
    """A terrain before a rig.

    Args:
        rig: the true cameras.
        seed: of the terrain.
        haze: meters in which a contrast falls to 1/e.
    """

    def __init__(self, rig: TrueRig, seed: int, haze: float = 25_000.0) -> None:
        self.rig, self.seed, self.haze = rig, seed, haze
        self._still = pieces(seed)
        self._lines = [self._lines_of(rig.left, None), self._lines_of(rig.right, rig)]
        self._empty: list[Picture] = [self._painted(side, self._sky(side), self._still) for side in (0, 1)]

    def pictures(self, moment: int | None = None) -> list[Picture]:
        """Both cameras' pictures: of still things, or with what moves at a moment."""
        if moment is None:
            return self._empty
        return [self._painted(side, self._empty[side], movers(self.seed, moment), moving=True) for side in (0, 1)]

    def images(
        self, moment: int, *, noise: float = 1.5, blur: float = 0.7, gain: float = 1.0
    ) -> list[NDArray[np.uint8]]:
        """Both images of a moment, with blur, noise and another exposure."""
        random = np.random.default_rng([self.seed, moment])
        return [exposed(gain * picture.light, blur, noise, random) for picture in self.pictures(moment)]

    def true_right(self, left: Tensor, moment: int) -> tuple[Tensor, Tensor]:
        """Where (N, 2) the right camera sees what the left one sees at pixels (N, 2), and meters to it."""
        near = left.round().long()
        depth = torch.from_numpy(self.pictures(moment)[0].depth)[near[:, 1], near[:, 0]]
        at, heading = self.rig.left.lines(left).spatial()
        points = at + (depth[:, None].clamp_max(1e7) - at[:, 2:]) / heading[:, 2:] * heading
        # On the ground the depth changes from row to row.
        level = heading[:, 1] * depth / heading[:, 2] > EYE_HEIGHT - 0.02 * EYE_HEIGHT
        low = at + ((EYE_HEIGHT - at[:, 1]) / heading[:, 1])[:, None] * heading
        points = torch.where((level & (heading[:, 1] > 0))[:, None], low, points)
        return self.rig.right.project(self.rig.right_from_left(points))[0], points.norm(dim=-1)

    @staticmethod
    def _lines_of(lens: TruthLens, rig: TrueRig | None) -> tuple[Floats, Floats]:
        """Origins and directions (H, W, 3) of all lines of sight in the left camera's frame."""
        width, height = lens.size
        grid = torch.stack(torch.meshgrid(torch.arange(width), torch.arange(height), indexing="xy"), -1).double()
        at, heading = lens.lines(grid.reshape(-1, 2)).spatial()
        if rig is not None:
            turn = rig.right_from_left_rotation
            at, heading = (at - rig.right_from_left_translation) @ turn, heading @ turn
        return at.numpy().reshape(height, width, 3), heading.numpy().reshape(height, width, 3)

    def _sky(self, side: int) -> Picture:
        """Sky, and the ground in front of it up to the first hill."""
        at, heading = self._lines[side]
        shape = heading.shape[:2]
        light, depth = np.full(shape, SKY), np.full(shape, np.inf)
        down = heading[..., 1] > 2e-3
        t = np.where(down, (EYE_HEIGHT - at[..., 1]) / np.where(down, heading[..., 1], 1.0), np.inf)
        z = np.where(down, at[..., 2] + t * heading[..., 2], np.inf)
        ground = down & (z < 20_000.0)
        x = at[ground][:, 0] + t[ground] * heading[ground][:, 0]
        away = z[ground]
        value = np.zeros_like(away)
        for octave in range(12):
            wave = 0.08 * 2.0**octave
            # A pixel is this long on the ground, and a wave must be four pixels.
            pixel = away**2 / (EYE_HEIGHT * 1500.0)
            fine = np.clip(wave / (4.0 * pixel) - 0.5, 0.0, 1.0) * np.clip(60.0 * away / 1500.0 / wave, 0.0, 1.0)
            some = fine > 0.01
            value[some] += 18.0 * fine[some] * smooth_noise(x[some] / wave + self.seed, away[some] / wave, 1)
        light[ground] = self._hazed(105.0 + value, away)
        depth[ground] = away
        return Picture(light, depth, np.zeros(shape, bool))

    def _painted(self, side: int, behind: Picture, things: list[Piece], *, moving: bool = False) -> Picture:
        at, heading = self._lines[side]
        light, depth, marks = behind.light.copy(), behind.depth.copy(), behind.moving.copy()
        for piece in things:
            slope = heading[..., :2] / heading[..., 2:]
            x = at[..., 0] + (piece.distance - at[..., 2]) * slope[..., 0]
            y = at[..., 1] + (piece.distance - at[..., 2]) * slope[..., 1]
            pixel = piece.distance / 1500.0
            wide = 0.06 * piece.distance
            edge = piece.top + (
                piece.rough * smooth_noise(x / wide + piece.seed, np.zeros_like(x), 4) if piece.rough else 0.0
            )
            inside = np.minimum(piece.half - np.abs(x - piece.middle), np.minimum(y + edge, EYE_HEIGHT - y))
            share = np.clip(inside / pixel + 0.5, 0.0, 1.0) * (depth > piece.distance)
            some = share > 0
            if not some.any():
                continue
            value = np.zeros(int(some.sum()))
            for wave in (5.0, 9.0, 17.0, 40.0):
                value += 15.0 * smooth_noise(x[some] / (wave * pixel) + piece.seed, y[some] / (wave * pixel) + wave, 1)
            color = self._hazed(piece.gray + value, np.full(len(value), piece.distance))
            light[some] += share[some] * (color - light[some])
            front = share > 0.5
            depth[front], marks[front] = piece.distance, moving
        return Picture(light, depth, marks)

    def _hazed(self, light: Floats, distance: Floats) -> Floats:
        clear = np.exp(-distance / self.haze)
        hazed: Floats = clear * light + (1.0 - clear) * SKY
        return hazed
