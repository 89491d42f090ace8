"""Modules of several inputs travel as ONNX."""

from pathlib import Path

import onnxruntime
import pytest
import torch
from torch import Tensor, nn

from kcal import InputError
from kcal.lens import save_onnx


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
