"""What kcal writes in each foreign format, it reads as the same cameras and the same pair."""

import itertools
from pathlib import Path

import pytest
import torch

from kcal import Camera, Rig
from kcal.io.foreign import rig_poses
from kcal.io.formats import FORMATS, import_cameras
from kcal.lens import LensModel, rotation_from_vector
from kcal.lens.pose import Pose

LENS = (-0.21, 0.052, 1.1e-3, -2.3e-3, 0.013, 0.021, -0.032, 0.0041, 5e-4, -6e-4, 7e-4, -8e-4)
SUFFIXES = {
    "opencv": (".yml", ".xml", ".json"),
    "colmap": (".txt", ".bin"),
    "mrcal": (".cameramodel",),
    "matlab": (".mat",),
    "toml": (".toml",),
    **dict.fromkeys(("nerfstudio", "opensfm", "basalt", "multical", "gtsam", "ceres"), (".json",)),
    "numpy": (".npz",),
    "bag": (".bag", ".mcap", ".db3"),
    **dict.fromkeys(("ros", "kalibr"), (".yaml",)),
}


def camera(model: str, number: int = 0, skew: float = 0.0) -> Camera:
    size = LensModel.named(model).size
    lens = (0.02, -0.003, 0.004, -0.0005) if model == "fisheye4" else LENS[:size]
    return Camera.build(
        focal=(501.5 + number, 503.25), center=(310.25, 245.5 - number), size=(640, 480), model=model, skew=skew,
        coefficients=lens if size else (),
    )  # fmt: skip


def same(found: Camera, wanted: Camera) -> None:
    """Equal to rounding; a format may hold the lens in a richer model."""
    assert found.size == wanted.size
    rays = wanted.unproject(wanted.grid(7, 5).reshape(-1, 2))[0]
    pixels, valid = found.project(rays)
    assert bool(valid.all())
    torch.testing.assert_close(pixels, wanted.project(rays)[0], rtol=0, atol=1e-8)


CASES = [
    (name, suffix, model)
    for name, known in FORMATS.items()
    if known.write
    for suffix, model in itertools.product(SUFFIXES[name], known.models)
]


@pytest.mark.parametrize(("name", "suffix", "model"), CASES)
def test_one_camera(name: str, suffix: str, model: str, tmp_path: Path) -> None:
    wanted = camera(model)
    (path,) = FORMATS[name].write([wanted], [], tmp_path / f"one{suffix}")
    found = import_cameras(path, format=name)
    assert found.format == name
    assert len(found.cameras) == 1
    same(found.cameras[0], wanted)


@pytest.mark.parametrize("name", [name for name, known in FORMATS.items() if known.poses and known.write])
def test_a_pair(name: str, tmp_path: Path) -> None:
    """Turned about all axes, the right camera not beside the left one alone."""
    model = next(model for model in ("opencv5", "opencv4", "opencv8") if model in FORMATS[name].models)
    turn = rotation_from_vector(torch.tensor([0.02, -0.05, 0.03]).double())
    rig = Rig.pair(camera(model), camera(model, 5), turn, torch.tensor([-0.52, 0.013, -0.021]).double())
    stem = "cameras" if name == "colmap" else "two"
    paths = FORMATS[name].write([rig.left, rig.right], rig_poses(rig), tmp_path / f"{stem}{SUFFIXES[name][0]}")
    # COLMAP's second file has the rig.
    found = [import_cameras(path, format=name) for path in paths[: 1 if name == "colmap" else 2]]
    cameras = [one for part in found for one in part.cameras]
    for got, wanted in zip(cameras, (rig.left, rig.right), strict=True):
        same(got, wanted)
    poses: list[Pose] = [pose for part in found for pose in part.poses]
    assert len(poses) == 2
    rotation = poses[1].rotation @ poses[0].rotation.T
    torch.testing.assert_close(rotation, rig.right_from_left_rotation, rtol=0, atol=1e-9)
    shift = poses[1].translation - rotation @ poses[0].translation
    torch.testing.assert_close(shift, rig.right_from_left_translation, rtol=0, atol=1e-9)


def test_a_skew_where_it_can_be_held(tmp_path: Path) -> None:
    for name, known in FORMATS.items():
        if known.skew and known.write and "opencv5" in known.models:
            wanted = camera("opencv5", skew=1.25)
            (path,) = known.write([wanted], [], tmp_path / f"skewed{SUFFIXES[name][0]}")
            same(import_cameras(path, format=name).cameras[0], wanted)
