"""Lookup cameras in files, and the unit that a MATLAB pair does not state."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.io import loadmat, savemat

from kcal import Camera, FileError, Rig
from kcal.io import lookup_file
from kcal.io.foreign import rig_poses
from kcal.io.format_opencv import write_matlab
from kcal.lens import bake, import_cameras, load_lookup, save_lookup


@pytest.fixture(scope="module")
def camera() -> Camera:
    return Camera.build(focal=(60, 62), center=(30.25, 41.5), size=(64, 80), coefficients=[-0.1, 0.01, 1e-3, 0, 0])


def test_a_lookup_camera_comes_back(camera: Camera, tmp_path: Path) -> None:
    lookup = bake(camera, 0.05)
    again = load_lookup(save_lookup(lookup, tmp_path / "camera.npz"))
    assert again.size == (64, 80)
    assert again.center.tolist() == lookup.center.tolist()
    assert len(set(again.center.tolist())) == 2
    pixels = camera.grid(5, 4).reshape(-1, 2)
    assert torch.equal(again.unproject(pixels)[0], lookup.unproject(pixels)[0])


def test_what_is_no_lookup_camera_is_refused(camera: Camera, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = save_lookup(bake(camera, 0.05), tmp_path / "camera.npz")
    arrays = dict(np.load(path))
    for name, value in (
        ("image_size", np.array([64.0, 80.0])),
        ("center", np.array([1.0, np.nan])),
        ("center", np.zeros(3)),
    ):
        np.savez(tmp_path / "bad.npz", **{**arrays, name: value})
        with pytest.raises(FileError, match=f"bad lookup file: {name}"):
            load_lookup(tmp_path / "bad.npz")
    assert lookup_file._MOST_BYTES == 256 * 2**20
    monkeypatch.setattr(lookup_file, "_MOST_BYTES", 100_000)
    np.savez_compressed(tmp_path / "large.npz", zeros=np.zeros(20_000))
    with pytest.raises(FileError, match="no lookup camera is larger"):
        load_lookup(tmp_path / "large.npz")


def test_a_matlab_pair_without_a_unit_is_in_millimeters_and_that_is_said(camera: Camera, tmp_path: Path) -> None:
    rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-0.5, 0.0, 0.0]))
    (path,) = write_matlab([rig.left, rig.right], rig_poses(rig), tmp_path / "two.mat")
    assert import_cameras(path).notes == ()
    content = {key: value for key, value in loadmat(path).items() if not key.startswith("__")}
    (name,) = content

    def without_unit(struct: np.ndarray) -> dict[str, Any]:
        one = struct[0, 0]
        return {
            field: without_unit(one[field]) if one[field].dtype.names else one[field]
            for field in one.dtype.names
            if field != "WorldUnits"
        }

    savemat(tmp_path / "unsaid.mat", {name: without_unit(content[name])})
    found = import_cameras(tmp_path / "unsaid.mat")
    assert any("the translation is taken as millimeters" in note for note in found.notes)
    assert import_cameras(tmp_path / "unsaid.mat", meters=1.0).notes == ()
