"""Cameras that the tests of images share."""

import torch

from kcal.lens.camera import Camera

F64 = torch.float64


def build(focal: float, size: tuple[int, int], coefficients: list[float], model: str = "opencv5") -> Camera:
    center = (0.49 * size[0], 0.52 * size[1])
    return Camera.build(focal=(focal, 0.97 * focal), center=center, size=size, coefficients=coefficients, model=model)


BARREL = build(500, (640, 480), [-0.28, 0.1, 1e-3, -1e-3, 0.0])
PINCUSHION = build(500, (640, 480), [0.2, 0.05, -1e-3, 2e-3, 0.0])
# The distorted radius r - 0.2 r³ turns back at r = 1.29; beyond 0.86 * 600 px the image has no preimage.
FOLDING = build(600, (3840, 2160), [-0.2])
LITTLE = build(125, (160, 120), [-0.28, 0.1, 1e-3, -1e-3, 0.0])
OTHER = build(125, (160, 120), [0.2, 0.05, -1e-3, 2e-3, 0.0])
SMALL = build(5, (7, 6), [-0.1, 0.02, 1e-3, -2e-3, 0.0])
