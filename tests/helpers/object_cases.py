"""Rendered objects before a rig, with boxes that err, for tests of matching."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector
from kcal.lens.rig import Rig
from scripts.shared.marking_scene import background
from scripts.shared.object_scene import exposed, paint_plate, plate, texture_gradient, true_box

SIZE = (240, 160)
FOCAL = 800.0


def rig_of(lens: tuple[float, ...] = (-0.3, 0.1), roll: float = 0.02) -> Rig:
    camera = Camera.build(focal=(FOCAL, FOCAL), center=(119.5, 79.5), size=SIZE, coefficients=lens)
    other = Camera.build(focal=(790, 795), center=(121.0, 78.0), size=SIZE, coefficients=lens)
    turn = rotation_from_vector(torch.tensor([0.003, -0.002, roll], dtype=torch.float64))
    return Rig.pair(camera, other, turn, torch.tensor([-5.0, 0.2, 0.1]))


class Case(NamedTuple):
    rig: Rig
    left: Tensor
    right: Tensor
    boxes: Tensor
    aims: Tensor
    truth: Tensor


def case(
    seed: int = 0, size: float = 14.0, noise: float = 0.2, box_sigma: float = 1.0, amplitude: float = 0.8, **rig: object
) -> Case:
    """One object at 500 to 2,000 m, rendered; `truth` is where the left anchor's point is in the right image."""
    random = np.random.default_rng(seed)
    rig_ = rig_of(**rig)  # type: ignore[arg-type]
    distance = random.uniform(500, 2000)
    point = torch.tensor([random.uniform(-0.05, 0.05) * distance, 0.02 * distance, distance], dtype=torch.float64)
    item = plate(point, (size, size), FOCAL, 40.0, random)
    images = [background(rig_, side, np.random.default_rng(seed), amplitude) for side in (0, 1)]
    for side in (0, 1):
        paint_plate(images[side], rig_, side, item)
    boxes = [true_box(rig_, side, item) for side in (0, 1)]
    sigma = noise * texture_gradient(images[0], boxes[0])
    left, right = (exposed(image, sigma, random) for image in images)
    seen = [torch.from_numpy(box + random.normal(0, box_sigma, 4)) for box in boxes]
    middle = 0.5 * (seen[0][:2] + seen[0][2:])
    ray, _ = rig_.left.unproject(middle[None])
    truth, _ = rig_.right.project(rig_.right_from_left(ray * distance / ray[:, 2:]))
    return Case(rig_, left, right, seen[0][None], 0.5 * (seen[1][:2] + seen[1][2:])[None], truth)
