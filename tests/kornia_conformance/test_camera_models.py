"""Kornia's camera models against vectors of another library: pixels, and derivatives by points and parameters.

Needs torch, kornia and pytest; `vectors.json` lies beside this file.
"""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from kornia.geometry.vector import Vector2, Vector3
from kornia.image import ImageSize
from kornia.sensors.camera import CameraModel, CameraModelType

CAMERAS = json.loads(Path(__file__).with_name("vectors.json").read_text())["cameras"]


def tensor(values: Any) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def model(case: dict[str, Any], params: torch.Tensor) -> CameraModel:
    width, height = case["size"]
    return CameraModel(ImageSize(height, width), CameraModelType[case["type"]], params)


@pytest.mark.parametrize("case", CAMERAS, ids=[case["type"] for case in CAMERAS])
def test_projection(case: dict[str, Any]) -> None:
    seen = model(case, tensor(case["params"])).project(Vector3(tensor(case["points"]))).data
    torch.testing.assert_close(seen, tensor(case["pixels"]), rtol=0, atol=1e-9)


@pytest.mark.parametrize("case", CAMERAS, ids=[case["type"] for case in CAMERAS])
def test_derivatives(case: dict[str, Any]) -> None:
    params, points = tensor(case["params"]), tensor(case["points"])

    def project(params: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        return model(case, params).project(Vector3(points)).data

    by_params = torch.autograd.functional.jacobian(lambda p: project(p, points), params)
    by_point = torch.stack([torch.autograd.functional.jacobian(lambda p: project(params, p[None])[0], point)
                            for point in points])  # fmt: skip
    torch.testing.assert_close(by_params, tensor(case["pixels_by_params"]), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(by_point, tensor(case["pixels_by_point"]), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("case", CAMERAS, ids=[case["type"] for case in CAMERAS])
def test_unprojection(case: dict[str, Any]) -> None:
    """Kornia inverts a Brown-Conrady lens by a fixed number of steps, here to 2.3e-7 of the depth."""
    points = tensor(case["points"])
    back = model(case, tensor(case["params"])).unproject(Vector2(tensor(case["pixels"])), points[:, 2]).data
    torch.testing.assert_close(back / points[:, 2:], points / points[:, 2:], rtol=0, atol=1e-6)
