"""A rig with 10 m of baseline, and the ranges at which it is measured."""

from __future__ import annotations

import torch

from kcal.lens.camera import Camera
from kcal.lens.mounting import Origin
from kcal.lens.pose import rotation_from_vector
from kcal.lens.rig import StereoRig

RANGES = (100.0, 250.0, 500.0, 1000.0, 2000.0, 3500.0, 5000.0)
ORIGIN = Origin(lat=19.07, lon=72.87, height=14.0)


def rig() -> StereoRig:
    """10 m of baseline, f 1600 px, unlike lenses that converge a little."""
    size = (1920, 1080)
    left = Camera.build(focal=(1600, 1603), center=(957, 541), size=size, coefficients=[-0.2, 0.06, 3e-4, -2e-4])
    right = Camera.build(focal=(1605, 1601), center=(962, 538), size=size, coefficients=[-0.19, 0.05, -2e-4, 3e-4])
    rotation = rotation_from_vector(torch.tensor([0.003, 0.02, -0.004], dtype=torch.float64))
    return StereoRig(left, right, rotation, rotation @ torch.tensor([-10.0, 0.15, 0.2], dtype=torch.float64))
