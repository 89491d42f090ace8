"""Cameras for other programs: exact where the format holds the lens, else fitted with a true maximum.

Export of several cameras into one file: one lens model for all, wide where others are far off, or a note.
"""

import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from lenses import hybrid_camera

from kcal import Camera, InputError, Rig
from kcal.io.format_mrcal import SplineGrid
from kcal.io.formats import FORMATS, import_cameras
from kcal.lens import export_cameras, rotation_from_vector

LENSES = {
    "pinhole": [],
    "opencv4": [-0.2, 0.05, 1e-3, -2e-3],
    "opencv5": [-0.2, 0.05, 1e-3, -2e-3, 0.01],
    "opencv8": [-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.1, 0.02, 0.003],
    "opencv12": [-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.1, 0.02, 0.003, 1e-3, -1e-3, 2e-3, 1e-3],
    "opencv14": [-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.1, 0.02, 0.003, 1e-3, -1e-3, 2e-3, 1e-3, 0.01, 0.02],
    "fisheye4": [0.05, -0.01, 0.003, -0.001],
}
FILES = {"opencv": "c.yaml", "ros": "ros.yaml", "kalibr": "k.yaml", "mrcal": "m.cameramodel", "colmap": "cameras.txt",
         "nerfstudio": "transforms.json", "matlab": "m.mat", "opensfm": "camera_models.json", "toml": "c.toml",
         "gtsam": "g.json", "ceres": "c.json", "numpy": "n.npz", "basalt": "b.json",
         "multical": "calibration.json", "bag": "b.bag"}  # fmt: skip
ROTATION = rotation_from_vector(torch.tensor([0.01, -0.02, 0.03], dtype=torch.float64))
TRANSLATION = torch.tensor([-1.0, 0.02, 0.01], dtype=torch.float64)


def camera(model: str) -> Camera:
    return Camera.build(
        focal=(1000.1, 1001.3), center=(640.3, 359.2), size=(1280, 720), coefficients=LENSES[model], model=model
    )


@pytest.mark.parametrize(("name", "model"), [(name, model) for name in FORMATS for model in FORMATS[name].models])
def test_what_a_format_holds_comes_back(tmp_path: Path, name: str, model: str) -> None:
    done = export_cameras(camera(model), tmp_path / FILES[name], format=name)
    assert done.misfits == (None,)
    back = import_cameras(*done.paths).cameras[0]
    pixels = camera(model).grid(40, 30).reshape(-1, 2)
    rays, _ = camera(model).unproject(pixels)
    assert float((back.project_rays(rays)[0] - pixels).abs().max()) < 1e-9


@pytest.mark.parametrize("name", [name for name in FORMATS if FORMATS[name].poses])
def test_a_rig_comes_back(tmp_path: Path, name: str) -> None:
    rig = Rig.pair(camera("opencv4"), camera("pinhole"), ROTATION, TRANSLATION)
    paths = export_cameras(rig, tmp_path / FILES[name], format=name).paths
    back = import_cameras(*(path for path in paths if path.stem != "rigs")).rig()
    assert float((back.right_from_left_rotation - ROTATION).abs().max()) < 1e-12
    assert float((back.right_from_left_translation - TRANSLATION).abs().max()) < 1e-12


def test_opencv_itself_reads_it(tmp_path: Path) -> None:
    subject = camera("opencv14")
    (path,) = export_cameras(subject, tmp_path / "c.yaml").paths
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    matrix, lens = (file.getNode(name).mat() for name in ("camera_matrix", "distortion_coefficients"))
    pixels = subject.grid(100, 100).reshape(-1, 2)
    points = 7.0 * subject.unproject(pixels)[0].numpy()
    seen = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, lens)[0][:, 0]
    assert np.abs(seen - pixels.numpy()).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", ["opencv", "kalibr", "mrcal"])
def test_a_fitted_lens_keeps_its_stated_maximum(tmp_path: Path, name: str) -> None:
    subject = hybrid_camera("webcam")
    done = export_cameras(subject, tmp_path / FILES[name], format=name)
    misfit = done.misfits[0]
    assert "entrance pupil" in done.lost
    assert misfit.rms < misfit.largest
    if name == "mrcal":
        assert misfit.largest < 1e-3
        return
    draw = torch.Generator().manual_seed(0)
    pixels = torch.rand(10_000, 2, generator=draw, dtype=torch.float64) * torch.tensor(subject.size) - 0.5
    rays, _ = subject.unproject(pixels)
    seen, valid = import_cameras(*done.paths).cameras[0].project_rays(rays)
    assert bool(valid.all())
    assert float((seen - pixels).norm(dim=-1).max()) <= misfit.largest


def test_skew_is_fitted_or_held(tmp_path: Path) -> None:
    skewed = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), skew=2.0, model="pinhole")
    assert export_cameras(skewed, tmp_path / "a.mat").misfits == (None,)
    misfit = export_cameras(skewed, tmp_path / "a.yaml", model="pinhole").misfits[0]
    # Half the height over the focal length, times the skew; a shift of the center halves it.
    assert 0.1 < misfit.largest < 0.7


def test_a_lens_that_nothing_shows_is_refused(tmp_path: Path) -> None:
    wide = hybrid_camera("wide")
    with pytest.raises(InputError, match=r"no lens model of matlab files.*\.cameramodel"):
        export_cameras(wide, tmp_path / "a.mat")
    assert not (tmp_path / "a.mat").exists()
    with pytest.raises(InputError, match="do not hold opencv14"):
        export_cameras(camera("opencv5"), tmp_path / "c.txt", model="opencv14")
    with pytest.raises(InputError, match="no format for this suffix"):
        export_cameras(camera("opencv5"), tmp_path / "c.doc")


def test_the_spline_has_mrcals_layout() -> None:
    """Weights sum to one and reproduce straight lines, also between control points."""
    grid = SplineGrid(30, 20, 100)
    u = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    index, weight = grid.weights(u)
    assert np.allclose(weight.sum(1), 1.0)
    place = (index % 30 - 14.5) / grid.per_unit
    assert np.allclose((place * weight).sum(1), u[:, 0])


def test_mrcal_projects_alike(tmp_path: Path) -> None:
    python = "/usr/bin/python3"
    if subprocess.run([python, "-c", "import mrcal"], capture_output=True, env={}).returncode:
        pytest.skip("mrcal is not installed for /usr/bin/python3")
    subject = hybrid_camera("wide")
    done = export_cameras(subject, tmp_path / "m.cameramodel")
    pixels = subject.grid(30, 20).reshape(-1, 2)
    np.save(tmp_path / "p.npy", 1e6 * subject.unproject(pixels)[0].numpy())
    code = (
        "import sys, numpy, mrcal; m = mrcal.cameramodel(sys.argv[1]); "
        "numpy.save(sys.argv[3], mrcal.project(numpy.load(sys.argv[2]), *m.intrinsics()))"
    )
    files = [str(done.paths[0]), str(tmp_path / "p.npy"), str(tmp_path / "q.npy")]
    subprocess.run([python, "-c", code, *files], check=True, env={})
    assert np.abs(np.load(tmp_path / "q.npy") - pixels.numpy()).max() <= done.misfits[0].largest


def test_maps_undistort(tmp_path: Path) -> None:
    (path,) = export_cameras(camera("opencv5"), tmp_path / "maps.npz").paths
    with np.load(path) as maps:
        assert maps["map_x"].shape == (720, 1280)
        assert maps["camera_matrix"][0, 0] > 0


def narrow(focal: float, model: str, *coefficients: float) -> Camera:
    return Camera.build(
        focal=(focal, focal), center=(319.5, 239.5), size=(640, 480), coefficients=coefficients, model=model
    )


# Nearest to these are radtan and equidistant, when each is fitted alone.
NARROW = narrow(420, "opencv5", -0.02, 0.012, 0.001, 0.0, -0.001)
WIDE = narrow(330, "opencv8", 0.4, 0.02, 0.001, 0.0, 0.01, 0.7, 0.08, 0.012)


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
    exact = narrow(420, "fisheye4", 0.02, 0.0, 0.0, 0.0)
    done = export_cameras(rig(exact, NARROW), tmp_path / "chain.yaml", format="kalibr")
    assert done.models == ("fisheye4", "fisheye4")
    (note,) = done.notes
    assert note.startswith("camera 2: written as fisheye4 (RMS 0.19 px)")
    assert note.endswith("it is opencv4 (RMS 0.0024 px)")


def test_one_lens_model_for_all_of_a_file(tmp_path: Path) -> None:
    milder = narrow(700, "opencv8", 0.1, 0.02, 0.0, 0.0, 0.0, 0.12, 0.0, 0.0)
    assert len(set(export_cameras(rig(NARROW, milder), tmp_path / "chain.yaml", format="kalibr").models)) == 1
    assert import_cameras(tmp_path / "chain.yaml").is_rig()


def test_kinds_that_differ_are_told(tmp_path: Path) -> None:
    left, right = narrow(500, "opencv4", -0.1, 0.01, 0.0, 0.0), narrow(300, "fisheye4", 0.01, 0.0, 0.0, 0.0)
    done = export_cameras(rig(left, right), tmp_path / "chain.yaml", format="kalibr")
    assert (done.models, done.misfits) == (("opencv4", "fisheye4"), (None, None))
    (note,) = done.notes
    assert "opencv4 and fisheye4" in note
    assert export_cameras(rig(left, left), tmp_path / "same.yaml", format="kalibr").notes == ()
