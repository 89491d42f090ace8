"""What a calibration says of a camera survives its file to the last bit."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch

from kcal.errors import FileError
from kcal.io.camera_file import load_camera, save_camera
from kcal.io.record import Packed
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation


@pytest.fixture
def camera() -> Camera:
    """Focal lengths tied, skew held, two board modes, a prior on k1 and on the board."""
    camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.1], model="opencv4")
    generator = torch.Generator().manual_seed(3)
    slots = (0, 0, 1, 2, -1, 3, 4, 5, 6)
    sigma = torch.tensor([math.inf, math.inf, math.inf, 0.1, math.inf, math.inf, math.inf, 1e-3, 2e-3]).double()
    camera.calibration = CameraCalibration(
        information=CameraInformation(
            slots=slots,
            estimate=torch.cat([camera.params[[0, 2, 3, 5, 6, 7, 8]].detach(), torch.tensor([3e-4, -1e-4]).double()]),
            rows=torch.randn(30, 9, generator=generator, dtype=torch.float64),
            residuals=torch.randn(30, generator=generator, dtype=torch.float64),
            mean=torch.zeros(9).double(),
            sigma=sigma,
        )
    )
    return camera


def known(camera: Camera) -> CameraInformation:
    assert camera.calibration is not None
    found = camera.calibration.known(camera.params)
    assert found is not None
    return found


def test_read_back(camera: Camera, tmp_path: Path) -> None:
    """The same after one trip, and bit for bit after the next."""
    first = save_camera(camera, tmp_path / "first.json")
    again = load_camera(first)
    old, new = known(camera), known(again)
    assert new.slots == old.slots
    for name in ("estimate", "mean", "sigma"):
        assert torch.equal(getattr(new, name), getattr(old, name))
    torch.testing.assert_close(new.covariance(), old.covariance(), rtol=1e-9, atol=0)
    torch.testing.assert_close(new.rows.T @ new.residuals, old.rows.T @ old.residuals, rtol=1e-12, atol=1e-12)
    second = save_camera(again, tmp_path / "second.json")
    assert second.read_bytes() == first.read_bytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"unknowns": [["fx"], ["fx"]]}, "twice"),
        ({"sigma": [1.0]}, "unknowns"),
        ({"triangle": {"shape": [1], "float64": "AAAA"}}, "whole doubles"),
        ({"triangle": {"shape": [54], "float64": "!"}}, "base64"),
        ({"unknowns": [[name] for name in ("fx", "cx", "cy", "k1", "k2", "p1", "k9")]}, "k9"),
        # Their squares overflow, or those of their inverses.
        ({"sigma": [5e-324, *[None] * 8]}, r"camera\.json.*below 1e-100"),
        ({"triangle": Packed.of(1e200 * torch.ones(54).double()).model_dump()}, r"camera\.json.*beyond 1e\+100"),
        ({"triangle": Packed.of(1e-200 * torch.ones(54).double()).model_dump()}, r"camera\.json.*less than 1e-100"),
    ],
)
def test_damaged(camera: Camera, tmp_path: Path, change: dict[str, object], message: str) -> None:
    """Files that contradict themselves are refused, and say where."""
    path = save_camera(camera, tmp_path / "camera.json")
    content = json.loads(path.read_text())
    content["information"] |= change
    path.write_text(json.dumps(content))
    with pytest.raises(FileError, match=message):
        load_camera(path)


def test_packed_refuses_nan() -> None:
    """NaN in base64 does not get past the check of numbers."""
    with pytest.raises(ValueError, match="finite"):
        Packed.of(torch.tensor([1.0, math.nan]))
