"""Projection equals OpenCV's: reference pixels written down, and a live comparison over many points."""

from __future__ import annotations

import pytest
import torch

from kcal.lens.camera import Camera

# Made with OpenCV 5.0.0:
#   K = np.array([[1000.0, 0, 640], [0, 1100, 360], [0, 0, 1]])
#   cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), K, COEFFICIENTS[:size])[0][:, 0].tolist()
COEFFICIENTS = [
    -0.28,
    0.09,
    0.001,
    -0.0007,
    -0.012,
    0.02,
    -0.01,
    0.004,
    0.0012,
    -0.0006,
    -0.0009,
    0.0004,
    0.011,
    -0.017,
]
POINTS = [[0.0, 0.0, 2.0], [1.0, 0.5, 2.0], [-0.8, 0.6, 1.0], [0.3, -0.7, 1.5], [-1.0, -0.9, 3.0]]
PIXELS = {
    4: [
        [640.0, 360.0],
        [1100.32578125, 613.6432421874999],
        [-10.55600000000004, 897.2312],
        [826.3374222222221, -118.4456355555555],
        [324.1273333333333, 47.64665222222226],
    ],
    5: [
        [640.0, 360.0],
        [1100.14267578125, 613.5425341796874],
        [-0.9560000000000173, 889.3112],
        [826.2963122041152, -118.3401198424142],
        [324.1598696351166, 47.67886316098776],
    ],
    8: [
        [640.0, 360.0],
        [1097.6715853488258, 612.1834344418542],
        [7.858201183431902, 882.0394840236686],
        [825.4488145818676, -116.16487594531219],
        [325.3082378743087, 48.81574771778793],
    ],
    12: [
        [640.0, 360.0],
        [1097.9879915988258, 611.9170281918541],
        [8.458201183431811, 881.4894840236686],
        [825.7182782855714, -116.39083821691719],
        [325.5253038002346, 48.63444381655336],
    ],
    14: [
        [640.0, 360.0],
        [1102.8241785642551, 614.6509977182823],
        [11.836149064413348, 878.5273922353036],
        [825.4472164043094, -115.61742458853655],
        [328.1185885286924, 51.16387553065806],
    ],
}
# Pixels near 1000 carry 1e-13 of rounding, and the two libraries add in different orders.
TOLERANCE = 1e-11


def opencv_camera(size: int, model: str | None = None) -> Camera:
    return Camera.build(
        focal=(1000, 1100),
        center=(640, 360),
        size=(1280, 720),
        coefficients=COEFFICIENTS[:size],
        model=model or f"opencv{size}",
    )


@pytest.mark.parametrize("size", PIXELS)
def test_written_down(size: int) -> None:
    pixels, valid = opencv_camera(size).project(torch.tensor(POINTS, dtype=torch.float64))
    expected = torch.tensor(PIXELS[size], dtype=torch.float64)
    assert bool(valid.all())
    assert float((pixels - expected).abs().max()) < TOLERANCE


@pytest.mark.parametrize(("size", "model"), [(4, "opencv5"), (5, "opencv14"), (8, "ext20"), (14, "ext24")])
def test_richer_models_contain_opencv(size: int, model: str) -> None:
    """OpenCV's coefficient vectors are prefixes: padded with zeros they mean the same in any richer model."""
    pixels, _ = opencv_camera(size, model).project(torch.tensor(POINTS, dtype=torch.float64))
    assert float((pixels - torch.tensor(PIXELS[size], dtype=torch.float64)).abs().max()) < TOLERANCE


@pytest.mark.parametrize("size", PIXELS)
def test_live(size: int) -> None:
    cv2 = pytest.importorskip("cv2")
    generator = torch.Generator().manual_seed(size)
    points = torch.rand(2000, 3, generator=generator, dtype=torch.float64)
    points = (points - 0.5) * torch.tensor([2.0, 1.6, 0.0]).double() + torch.tensor([0.0, 0.0, 1.0]).double()
    points = points * (1.0 + 50.0 * torch.rand(2000, 1, generator=generator, dtype=torch.float64))
    camera = opencv_camera(size)
    zero = torch.zeros(3, dtype=torch.float64).numpy()
    expected, _ = cv2.projectPoints(
        points.numpy(), zero, zero, camera.matrix.numpy(), camera.coefficients.numpy().copy()
    )
    pixels, valid = camera.project(points)
    assert bool(valid.all())
    assert float((pixels - torch.from_numpy(expected[:, 0])).abs().max()) < TOLERANCE
