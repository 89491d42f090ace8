"""The whole localizer keeps its state to the bit, and modules of several inputs travel as ONNX."""

from __future__ import annotations

from pathlib import Path

import onnxruntime
import pytest
import safetensors.torch
import torch
from lenses import HYBRID, strong
from torch import Tensor, nn

from kcal import Camera, InputError, Localizer, Origin, Rig
from kcal.lens import save_onnx
from kcal.lens.model import PRESETS
from kcal.rig import RigCovariance


def localizer(lens: str, scale: float, heading: float) -> Localizer:
    model = HYBRID if lens == "hybrid" else PRESETS[lens]
    values = torch.tensor([0.02, -0.01, 0.003, -0.0005]) if model.fisheye else 0.3 * strong(model)
    focal = torch.tensor([1600.0, 1610.0, 955.0, 541.0, 0.0])
    camera = Camera(torch.cat([focal, scale * values]).double(), size=(1920, 1080), model=model)
    rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-10.0 * scale, 0.1, 0.2]))
    rig.covariance = RigCovariance.of(rig, pose=scale * 1e-8 * torch.eye(6, dtype=torch.float64))
    mounting = scale * 1e-6 * torch.eye(6, dtype=torch.float64)
    return Localizer(
        rig.placed(origin=Origin(lat=19.0, lon=72.0, height=14.0), heading_deg=heading, covariance=mounting)
    )


@pytest.mark.parametrize("lens", ["opencv5", "ext24", "fisheye4", "hybrid"])
def test_state_of_the_whole_localizer(lens: str, tmp_path: Path) -> None:
    module, other = localizer(lens, 1.0, 35.0), localizer(lens, 0.9, 80.0)
    pixels = torch.tensor([[900.0, 500.0], [300.0, 700.0], [1500.0, 200.0]], dtype=torch.float64)
    wanted = module(pixels, pixels - torch.tensor([20.0, 0.0]))
    assert not torch.equal(other(pixels, pixels - torch.tensor([20.0, 0.0])).enu, wanted.enu)
    path = tmp_path / "localizer.safetensors"
    safetensors.torch.save_model(module, str(path))
    safetensors.torch.load_model(other, str(path))
    for name, value in module.state_dict().items():
        assert torch.equal(other.state_dict()[name], value)
    for found, expected in zip(other(pixels, pixels - torch.tensor([20.0, 0.0])), wanted, strict=True):
        assert torch.equal(found, expected)


class Parallax(nn.Module):
    def forward(self, left: Tensor, right: Tensor) -> Tensor:
        return left - 2.0 * right


def test_onnx_of_two_inputs(tmp_path: Path) -> None:
    left = torch.rand(5, 2, dtype=torch.float64)
    with pytest.raises(InputError, match="the same N for every input"):
        save_onnx(Parallax(), (left, left[:3]), tmp_path / "two.onnx")
    session = onnxruntime.InferenceSession(save_onnx(Parallax(), (left[:2], left[:2]), tmp_path / "two.onnx"))
    names = [entry.name for entry in session.get_inputs()]
    (found,) = session.run(None, {names[0]: left.numpy(), names[1]: left.numpy() - 3.0})
    assert torch.allclose(torch.from_numpy(found), 6.0 - left, rtol=0, atol=1e-14)
