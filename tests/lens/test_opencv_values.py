"""Projection equals OpenCV's, over many points."""

import cv2
import numpy as np
import pytest
import torch

from kcal.lens.camera import Camera

COEFFICIENTS = [-0.28, 0.09, 1e-3, -7e-4, -0.012, 0.02, -0.01, 4e-3, 1.2e-3, -6e-4, -9e-4, 4e-4, 0.011, -0.017]
SIZES = (4, 5, 8, 12, 14)
# Pixels near 1000 carry 1e-13 of rounding, and the two libraries add in different orders.
TOLERANCE = 1e-11


def opencv_camera(size: int, model: str) -> Camera:
    lens = COEFFICIENTS[:size]
    return Camera.build(focal=(1000, 1100), center=(640, 360), size=(1280, 720), coefficients=lens, model=model)


@pytest.mark.parametrize(
    ("size", "model"),
    [(size, f"opencv{size}") for size in SIZES] + [(4, "opencv5"), (5, "opencv14"), (8, "ext20"), (14, "ext24")],
)
def test_live(size: int, model: str) -> None:
    """OpenCV's coefficient vectors are prefixes: padded with zeros they mean the same in any richer model."""
    generator = torch.Generator().manual_seed(size)
    points = torch.rand(2000, 3, generator=generator, dtype=torch.float64)
    points = (points - 0.5) * torch.tensor([2.0, 1.6, 0.0]).double() + torch.tensor([0.0, 0.0, 1.0]).double()
    points = points * (1.0 + 50.0 * torch.rand(2000, 1, generator=generator, dtype=torch.float64))
    camera, zero = opencv_camera(size, model), np.zeros(3)
    expected = cv2.projectPoints(points.numpy(), zero, zero, camera.matrix.numpy(), np.array(COEFFICIENTS[:size]))[0]
    pixels, valid = camera.project(points)
    assert bool(valid.all())
    assert float((pixels - torch.from_numpy(expected[:, 0])).abs().max()) < TOLERANCE
