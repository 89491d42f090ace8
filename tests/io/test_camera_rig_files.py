"""Rig files of any number of cameras: everything comes back to the last bit, and what does not fit is refused."""

import datetime
from pathlib import Path
from typing import Any

import pytest
import torch
from wrong_files import assert_refused

from kcal import Camera
from kcal.io.record import Packed
from kcal.io.rig_file import RigFile, rig_to_file, save_rig
from kcal.lens import CameraCalibration, rotation_from_vector
from kcal.lens.rig import Origin, Rig, RigCalibration


def rig() -> Rig:
    cameras = [
        Camera.build(focal=(800 + i, 805), center=(321, 238 - i), size=(640, 480), coefficients=[-0.1, 0.02 * i])
        for i in range(3)
    ]
    cameras[1].calibration = CameraCalibration(name="own name")
    turn = rotation_from_vector(torch.tensor([[0.0, 0.0, 0.0], [0.1, -0.2, 0.3], [1.0, 0.5, 0.2]], dtype=torch.float64))
    center = torch.tensor([[0.0, 0, 0], [10, 1 / 3, 0], [-5, 2, 7]], dtype=torch.float64)
    origin = Origin(lat=19.07, lon=-72.87, height=14.5)
    found = Rig(cameras, ("a", "b", "c"), turn, center=center, origin=origin, refraction=0.13)
    found.root = torch.randn(2, found.quantities, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found.calibration = RigCalibration(
        rms=0.3, rms_px=(0.2, None, 0.4), warnings=("doubt",), kcal_version="0.2",
        created=datetime.datetime(2026, 1, 2, tzinfo=datetime.UTC),
    )  # fmt: skip
    return found


def test_everything_comes_back(tmp_path: Path) -> None:
    wanted = rig()
    found = RigFile.load(save_rig(wanted, tmp_path / "rig.json")).rig()
    assert found.names == wanted.names
    for a, b in zip(found.each, wanted.each, strict=True):
        assert torch.equal(a.params, b.params)
    assert torch.equal(found.rotation, wanted.rotation)
    assert torch.equal(found.center, wanted.center)
    assert torch.equal(found.translation, wanted.translation)
    assert found.origin == wanted.origin
    assert found.refraction == 0.13
    assert found.root is not None
    assert torch.equal(found.root, wanted.root)
    assert found.calibration == wanted.calibration
    # A camera without a name of its own gets the rig's.
    assert [camera.calibration.name for camera in found.each if camera.calibration] == ["a", "own name", "c"]


def test_what_is_not_known_stays_unknown(tmp_path: Path) -> None:
    plain = rig()
    bare = Rig(list(plain.each), plain.names, plain.rotation, center=plain.center)
    found = RigFile.load(save_rig(bare, tmp_path / "rig.json")).rig()
    assert found.origin is None
    assert found.refraction == bare.refraction
    assert found.root is None
    assert found.calibration is None


@pytest.mark.parametrize(("field", "value", "message"), [
    (["names"], ["a", "b"], "names"), (["cameras"], [], "cameras"), (["poses"], [], "poses"),
    (["origin", "lat"], 91.0, "lat"), (["origin", "lon"], -181.0, "lon"), (["refraction"], 2.5, "refraction"),
    (["root"], Packed.of(1e200 * torch.ones(2, rig().quantities).double()).model_dump(), "overflow"),
    (["poses", 1, "rotation", 0, 0], 0.5, "no rotation"),
])  # fmt: skip
def test_what_does_not_fit_is_refused(field: list[str | int], value: Any, message: str, tmp_path: Path) -> None:
    assert_refused(RigFile.load, tmp_path, rig_to_file(rig()).dump(), field, value, message)


def test_the_file_holds_a_copy() -> None:
    wanted = rig()
    stored = rig_to_file(wanted)
    assert stored.poses[2].translation == tuple(wanted.translation[2].tolist())
    assert stored.names == ("a", "b", "c")
