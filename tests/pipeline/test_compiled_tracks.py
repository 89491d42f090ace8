"""Compiled tracks are those of the steps as they are: from one target to many, through births, occlusion and turns.

Modules of several inputs travel as ONNX.
"""

from pathlib import Path
from unittest.mock import Mock

import onnxruntime
import pytest
import torch
from torch import Tensor, nn
from track_scenes import pairs_of, seen_by, tracked_site

from kcal import InputError, Localizer
from kcal.lens import save_onnx
from kcal.pipeline.imm_filter import no_beliefs
from kcal.pipeline.tracks import Tracker, compiled_steps, track_steps
from kcal.track import ClockPrior


def scene(localize: Localizer, frame: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Targets on lines, one of which sweeps by closely; first one, then four, then nine, three of which pause."""
    count = 1 if frame < 4 else 4 if frame < 8 else 9
    number = torch.arange(count, dtype=torch.float64)
    z = 100.0 + 150.0 * number
    x = (number / 4.0 - 1.0) * 0.4 * z + torch.where(number > 0, 0.5, 2.0) * frame
    seen = torch.ones(count, dtype=torch.bool)
    if frame in (12, 13):
        seen[2:5] = False
    return seen_by(localize.rig, torch.stack([x, 0.01 * z, z], -1)[seen], 0.2, torch.Generator().manual_seed(frame))


@pytest.mark.slow
def test_compiled_tracks_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    # What the C++ compiler makes of torch's code faster is not kcal's, and takes half of the time.
    monkeypatch.setenv("TORCHINDUCTOR_DEBUG_COMPILE", "1")
    localize = tracked_site(0.002)
    clock = ClockPrior(offset_sigma_s=0.01)
    plain, compiled = Tracker(localize, clock=clock), Tracker(localize, clock=clock, compiled=True)
    for frame in range(25):
        time = torch.tensor([frame / 10.0, frame / 10.0 + 0.004], dtype=torch.float64)
        pairs = pairs_of(*scene(localize, frame), time, 0.2)
        both = plain(pairs), compiled(pairs)
        assert both[0].number == both[1].number
        for name, value, other in zip(both[0].state._fields, both[0].state, both[1].state, strict=True):
            torch.testing.assert_close(other, value, rtol=1e-7, atol=1e-10, msg=f"{name}, frame {frame}")
        torch.testing.assert_close(both[1].models, both[0].models, rtol=1e-7, atol=1e-10)
    assert len(both[0].number) == 9
    assert float(plain.clock_estimate().offset(2.4)[1]) < 0.01
    for value, other in zip(plain.beliefs, compiled.beliefs, strict=True):
        torch.testing.assert_close(other, value, rtol=1e-6, atol=1e-10)


def test_steps_that_cannot_be_compiled_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "compile", Mock(return_value=Mock(side_effect=RuntimeError("no compiler"))))
    localize = tracked_site().weighing_all()
    nothing = no_beliefs(1, 0, 4, torch.device("cpu"))
    with pytest.raises(InputError, match="no compiler"):
        compiled_steps(track_steps(localize, 0.01), 2, nothing, None)


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
