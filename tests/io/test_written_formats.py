"""Files that kcal writes for other programs: what is in them, for lenses that are not in the middle and for pairs."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from scipy.io import loadmat, savemat

from kcal import Camera, Rig
from kcal.io.foreign import rig_poses
from kcal.io.foreign_lenses import ForeignCamera
from kcal.io.format_kalibr import write_kalibr
from kcal.io.format_mrcal import fit_spline, project_spline
from kcal.io.format_opencv import write_matlab
from kcal.lens import import_cameras


def lens(center: tuple[float, float] = (319.5, 239.5)) -> Camera:
    return Camera.build(
        focal=(500, 500), center=center, size=(640, 480), coefficients=[-0.2, 0.05, 0.001, -0.002], model="opencv4"
    )


def pair() -> Rig:
    return Rig.pair(lens(), lens((300.0, 250.0)), torch.eye(3), torch.tensor([-0.1, 0.0, 0.0]))


def test_a_spline_covers_the_wider_side() -> None:
    """Whichever side of the image it is on: of a camera and its mirror image the same."""
    grids = []
    for center in ((500.0, 400.0), (139.0, 79.0)):
        camera = Camera.build(focal=(500, 500), center=center, size=(640, 480), coefficients=[-0.2, 0.05])
        pixels = camera.grid(97, 73).reshape(-1, 2)
        rays, valid = camera.unproject(pixels)
        grid, values = fit_spline(rays[valid].numpy(), pixels[valid].numpy(), camera.size)
        assert np.abs(project_spline(grid, values, rays[valid].numpy()) - pixels[valid].numpy()).max() < 0.05
        grids.append((grid.fov_deg, grid.rows))
    assert grids[0] == grids[1]


def test_matlab_has_one_camera_or_a_pair(tmp_path: Path) -> None:
    (single,) = write_matlab([lens()], [], tmp_path / "one.mat")
    assert "stereoParams" not in loadmat(single)
    rig = pair()
    (both,) = write_matlab([rig.left, rig.right], rig_poses(rig), tmp_path / "two.mat")
    assert "cameraParams" not in loadmat(both)


def test_an_omni_lens_is_written_as_kalibr_has_it(tmp_path: Path) -> None:
    rig = pair()
    values = [
        (600.0, 601.0, 320.0, 240.0, 0.0, 1.1, -0.1, 0.01, 0.001, 0.002),
        (590.0, 591.0, 321.0, 241.0, 0.0, 0.9, 0.0, 0.0, 0.0, 0.0),
    ]
    lenses = [ForeignCamera("omni-radtan", own, (640, 480), "") for own in values]
    (path,) = write_kalibr(lenses, rig_poses(rig), tmp_path / "chain.yaml")
    first, second = (yaml.safe_load(path.read_text())[name] for name in ("cam0", "cam1"))
    assert (first["camera_model"], first["distortion_model"]) == ("omni", "radtan")
    assert first["intrinsics"] == [1.1, 600.0, 601.0, 320.0, 240.0]
    assert first["distortion_coeffs"] == [-0.1, 0.01, 0.001, 0.002]
    assert "T_cn_cnm1" not in first
    assert np.array(second["T_cn_cnm1"])[:3, 3].tolist() == pytest.approx([-0.1, 0, 0])


def test_a_matlab_pair_without_a_unit_is_in_millimeters_and_that_is_said(tmp_path: Path) -> None:
    rig = pair()
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
