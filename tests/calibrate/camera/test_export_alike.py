"""Export of several cameras into one file: one lens model for all, wide where others are far off, or a note."""

from pathlib import Path

import pytest
import torch

from kcal import Camera, Rig
from kcal.lens import export_cameras, import_cameras


def camera(focal: float, model: str, *coefficients: float) -> Camera:
    return Camera.build(
        focal=(focal, focal), center=(319.5, 239.5), size=(640, 480), coefficients=coefficients, model=model
    )


# Nearest to these are radtan and equidistant, when each is fitted alone.
NARROW = camera(420, "opencv5", -0.02, 0.012, 0.001, 0.0, -0.001)
WIDE = camera(330, "opencv8", 0.4, 0.02, 0.001, 0.0, 0.01, 0.7, 0.08, 0.012)


def rig(left: Camera, right: Camera) -> Rig:
    return Rig.pair(left, right, torch.eye(3), torch.tensor([-0.1, 0.0, 0.0]))


@pytest.mark.slow
def test_a_wide_pair_becomes_omni_in_kalibr(tmp_path: Path) -> None:
    assert export_cameras(NARROW, tmp_path / "one.yaml", format="kalibr").models == ("opencv4",)
    done = export_cameras(rig(NARROW, WIDE), tmp_path / "chain.yaml", format="kalibr")
    assert done.models == ("omni-radtan",) * 2
    # 0.53 px as equidistant.
    assert [misfit is not None and misfit.rms < 0.1 for misfit in done.misfits] == [True, True]
    (note,) = done.notes
    assert note.startswith("written as omni-radtan (camera 1 RMS 0.0")


def test_a_camera_that_gets_worse_beside_another_is_told(tmp_path: Path) -> None:
    exact = camera(420, "fisheye4", 0.02, 0.0, 0.0, 0.0)
    done = export_cameras(rig(exact, NARROW), tmp_path / "chain.yaml", format="kalibr")
    assert done.models == ("fisheye4", "fisheye4")
    (note,) = done.notes
    assert note.startswith("camera 2: written as fisheye4 (RMS 0.19 px)")
    assert note.endswith("it is opencv4 (RMS 0.0024 px)")


def test_one_lens_model_for_all_of_a_file(tmp_path: Path) -> None:
    milder = camera(700, "opencv8", 0.1, 0.02, 0.0, 0.0, 0.0, 0.12, 0.0, 0.0)
    assert len(set(export_cameras(rig(NARROW, milder), tmp_path / "chain.yaml", format="kalibr").models)) == 1
    assert import_cameras(tmp_path / "chain.yaml").is_rig()


def test_kinds_that_differ_are_told(tmp_path: Path) -> None:
    left, right = camera(500, "opencv4", -0.1, 0.01, 0.0, 0.0), camera(300, "fisheye4", 0.01, 0.0, 0.0, 0.0)
    done = export_cameras(rig(left, right), tmp_path / "chain.yaml", format="kalibr")
    assert (done.models, done.misfits) == (("opencv4", "fisheye4"), (None, None))
    (note,) = done.notes
    assert "opencv4 and fisheye4" in note
    assert export_cameras(rig(left, left), tmp_path / "same.yaml", format="kalibr").notes == ()
