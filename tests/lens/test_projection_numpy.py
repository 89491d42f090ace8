"""The chain that calibration uses on the CPU gives the numbers of `project_components`."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from kcal.lens.model import PRESETS
from kcal.lens.projection import project_components
from kcal.lens.projection_numpy import fill_rows

MODELS = [name for name, model in PRESETS.items() if not model.fisheye]


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("shape", [(), (5,), (3, 5)])
def test_same_as_project_components(name: str, shape: tuple[int, ...]) -> None:
    """Of points on both sides of the camera, with all parameters wanted and with some of them in another order."""
    model, generator = PRESETS[name], torch.Generator().manual_seed(len(shape))
    points = torch.randn(*shape, 3, 7, generator=generator, dtype=torch.float64)
    # Far enough from the camera's plane, and from poles, that rounding stays small.
    depth = points[..., 2, :]
    points[..., 2, :] = torch.sign(depth) * (1.0 + depth.abs())
    batch = (*shape[:-1], 1) if len(shape) > 1 else ()
    parameters = 0.05 * torch.randn(*batch, 5 + model.size, generator=generator, dtype=torch.float64)
    parameters[..., :5] += torch.tensor([500.0, 510.0, 320.0, 240.0, 3.0], dtype=torch.float64)
    for wanted in (list(range(5 + model.size)), list(range(5 + model.size))[::-2]):
        expected = project_components(points, parameters, model, wanted)
        by_point, by_camera = np.empty((*shape, 3, 2, 7)), np.empty((*shape, len(wanted), 2, 7))
        places = {i: k for k, i in enumerate(wanted)}
        u, v, regular = fill_rows(points.numpy(), parameters.numpy(), model, places, by_point, by_camera)
        assert torch.equal(torch.from_numpy(regular), expected.regular)
        pixels = torch.from_numpy(np.stack([u, v], -2))
        torch.testing.assert_close(pixels, expected.pixels, rtol=1e-10, atol=1e-9)
        torch.testing.assert_close(torch.from_numpy(by_point), expected.by_point, rtol=1e-9, atol=1e-8)
        torch.testing.assert_close(torch.from_numpy(by_camera), expected.by_camera, rtol=1e-9, atol=1e-8)
