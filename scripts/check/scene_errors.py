"""Which errors of matches repeat, and what they do to yaw: pictures without noise beside the truth.

Each seed is a terrain (`scripts.shared.terrain`, 960 x 540) with exact lenses. Keypoints are matched along the true
epipolar lines of pictures with noise, and refined in these and in the same without noise: what then is left comes again
in every pair of that light. Weights are those of noise and of 0.08 px.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from torch import Tensor

from kcal.corners.match import keypoints
from kcal.lens.rig import Rig
from kcal.scene.common_errors import line_errors
from kcal.scene.match import guided_matches
from kcal.scene.refine import refine_matches
from scripts.check.scene import HALF, WRONG, exact, rig_of
from scripts.shared.page import table
from scripts.shared.sections import section
from scripts.shared.terrain import Terrain, Weather
from scripts.shared.timing import rms

KINDS = ("level ground", "hills and walls", "edges before something farther")
BESIDE = 0.08  # px, added to the σ of each match in weights
PATCH, DEEP = 21, 0.03  # px, and the logarithm of the depth's ratio in a patch from which there is an edge


class Errors(NamedTuple):
    """Matches (M,): kind, px across their lines with noise and without, σ, and degrees of yaw by those without."""

    kind: Tensor
    noisy: Tensor
    clean: Tensor
    sigma: Tensor
    yaw: Tensor


def kinds(terrain: Terrain, pixels: Tensor) -> Tensor:
    """Kind (M,) of patches around pixels (M, 2) of the left image; -1: something moves there."""
    picture = terrain.picture(0, 1, Weather())
    depth = np.minimum(picture.depth, 1e6)
    level = minimum_filter(picture.ground.astype(np.uint8), PATCH) > 0
    deep = np.log(maximum_filter(depth, PATCH) / minimum_filter(depth, PATCH)) > DEEP
    kind = np.where(level, 0, np.where(deep, 2, 1))
    kind[maximum_filter(picture.moving, PATCH)] = -1
    at = pixels.round().long()
    return torch.from_numpy(kind)[at[:, 1], at[:, 0]]


@torch.no_grad()
def errors_of(seed: int) -> Errors:
    """Of a terrain."""
    rig, cameras = rig_of(HALF), exact(HALF)
    true = Rig.pair(*cameras, rig.right_from_left_rotation, rig.right_from_left_translation)
    terrain, weather = Terrain(rig, seed), Weather()
    images = terrain.images(1, weather)
    light = [gaussian_filter(terrain.picture(side, 1, weather).light, weather.blur) for side in (0, 1)]
    points = keypoints(images[0], 8000), keypoints(images[1], 8000)
    index = guided_matches(true, points)
    left, right = (own.pixels[index[:, k]] for k, own in enumerate(points))
    noisy, clean = (
        refine_matches(true, (one, two), left, right)
        for one, two in [[torch.from_numpy(part.astype(np.float32)) for part in each] for each in (images, light)]
    )
    truth, _ = terrain.true_right(left, 1)
    near = [torch.linalg.vector_norm(found.right - truth, dim=-1) < WRONG for found in (noisy, clean)]
    kind = kinds(terrain, left)
    good = noisy.good & clean.good & near[0] & near[1] & (kind >= 0)
    lines = [line_errors(true, torch.stack([left, found.right], 1)[good]) for found in (noisy, clean)]
    sigma = lines[0].sigma(noisy.covariance[good])
    weight = 1.0 / (sigma.square() + BESIDE**2) * (lines[1].off.abs() < 5.0 * BESIDE)
    slopes = lines[1].slopes
    variance = torch.linalg.inv(slopes.T @ (weight[:, None] * slopes))
    yaw = (slopes @ variance[1]) * weight * lines[1].off
    return Errors(kind[good], lines[0].off, lines[1].off, sigma, yaw.rad2deg())


def rows(found: list[Errors]) -> list[list[str]]:
    """Rows of the table."""
    every = Errors(*(torch.cat(parts) for parts in zip(*found, strict=True)))
    rows = []
    for number, name in enumerate((*KINDS, "all")):
        own = (every.kind == number) | (number == len(KINDS))
        turns = [float(one.yaw[(one.kind == number) | (number == len(KINDS))].sum()) for one in found]
        error = torch.tensor(turns)
        rows.append([
            name, f"{int(own.sum()) / len(found):.0f}", f"{rms(every.noisy[own]):.3f}", f"{rms(every.sigma[own]):.3f}",
            f"{rms(every.clean[own]):.3f}", f"{float(every.clean[own].abs().median()):.3f}", f"{rms(error):.5f}°",
            f"{float(error.mean()):+.5f} ± {float(error.std()) / math.sqrt(len(found)):.5f}°",
        ])  # fmt: skip
    return rows


HEADS = ("what", "matches", "RMS, px", "σ of noise", "of it repeats, RMS", "median", "yaw, RMS", "yaw, mean")


@section("scene.md", "repeats", seeds=range(700, 701))
def repeats(seeds: range = range(700, 712)) -> Iterator[str]:
    return table(HEADS, rows([errors_of(seed) for seed in seeds]))
