"""What a file tells besides parameters travels with the camera or rig, is written again, and never outlives them."""

import copy
import json
import pickle
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from kcal import Camera, FileError, InputError, Rig, load_rig, save_rig
from kcal.io.camera_file import CameraFile, load_camera, save_camera
from kcal.io.record import Packed
from kcal.lens import CameraCalibration
from kcal.rig import RigCovariance

# Cameras, covariances, mounting with link, sources, records.
SAMPLE = Path(__file__).parent / "rig.json"


def assert_same(before: Any, after: Any, where: str = "") -> None:
    """Equal to the last bit; what is derived on writing (the valid region) to rounding."""
    if isinstance(before, dict):
        assert list(after) == list(before), where
        for key in set(before) - {"summary"}:
            assert_same(before[key], after[key], f"{where}.{key}")
    elif isinstance(before, list):
        assert len(before) == len(after), where
        for i, (one, other) in enumerate(zip(before, after, strict=True)):
            assert_same(one, other, f"{where}[{i}]")
    elif ".valid_region." in where:
        assert after == pytest.approx(before, rel=1e-12, abs=1e-3), where
    else:
        assert before == after, where


def as_two(content: dict[str, Any]) -> dict[str, Any]:
    """What a file of any number of cameras contains, as 1.0 wrote it of two."""
    solved = content["calibration"]
    if solved is not None:
        rms = dict(zip(("rms_left", "rms_right"), solved.pop("rms_px"), strict=True))
        assert not solved.pop("undetermined", None)
        solved |= rms
    (left, right), (still, pose) = content["cameras"], content["poses"]
    assert still == {"rotation": torch.eye(3).tolist(), "translation": [0.0, 0.0, 0.0]}
    return {**content, "left": left, "right": right, "right_from_left": pose, "calibration": solved}


def assert_close(known: Tensor, half: Tensor) -> None:
    """Both roots have the same covariance, in units of its standard deviations."""
    unit = torch.where(half.any(0), half.norm(dim=0), 1.0)
    torch.testing.assert_close((known.T @ known) / unit / unit[:, None], (half.T @ half) / unit / unit[:, None],
                               rtol=0, atol=1e-12)  # fmt: skip


def assert_same_rig(before: dict[str, Any], path: Path) -> None:
    """What 1.0 wrote of two cameras is in a present file, to the last bit, and its covariances to rounding."""
    after, rig = as_two(json.loads(path.read_text())), load_rig(path)
    for key in ("left", "right", "right_from_left"):
        assert_same(before[key], after[key], key)
    stands, relative = before["mounting"], rig.relative_root
    if before["half"] is None:
        assert rig.covariance is None
    else:
        assert_close(relative[:, :-7], Packed.model_validate(before["half"]).tensor())
    if stands is None:
        assert rig.mounting is None
        return
    assert_same({k: v for k, v in after["mounting"].items() if k != "refraction"}, {k: stands[k] for k in (
        "lat", "lon", "height", "heading_deg", "pitch_deg", "roll_deg")})  # fmt: skip
    covariance = torch.tensor(stands["covariance"], dtype=torch.float64)
    unit = covariance.diagonal().sqrt()
    found = rig.mounting.covariance[:6, :6]
    torch.testing.assert_close(found / unit / unit[:, None], covariance / unit / unit[:, None], rtol=0, atol=1e-12)
    assert float(rig.mounting.covariance[6, 6]) == pytest.approx(0.01)
    link, spread = torch.tensor(stands["link"], dtype=torch.float64), relative[:, :-7].norm(dim=0)
    spread = torch.where(spread > 0, spread, 1.0)[:, None]
    found = relative[:, :-7].T @ relative[:, -7:-1]
    torch.testing.assert_close(found / unit / spread, link / unit / spread, rtol=0, atol=1e-10)
    for key, value in (before["calibration"] or {}).items():
        if key not in ("baseline_m", "frame"):
            assert_same(value, after["calibration"][key], f"calibration.{key}")


def test_rig_file(tmp_path: Path) -> None:
    again = save_rig(load_rig(SAMPLE), tmp_path / "rig.json")
    assert_same_rig(json.loads(SAMPLE.read_text()), again)
    assert save_rig(load_rig(again), tmp_path / "third.json").read_bytes() == again.read_bytes()


@pytest.mark.parametrize("side", ["left", "right"])
def test_camera_file(side: str, tmp_path: Path) -> None:
    content = {"kcal": "camera", "version": 2, **json.loads(SAMPLE.read_text())[side]}
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(content))
    camera = load_camera(path)
    assert camera.calibration is not None
    assert camera.calibration.record is not None
    assert camera.calibration.record.views == 20
    assert_same(content, json.loads(save_camera(camera, tmp_path / "again.json").read_text()))
    assert CameraFile.load(save_camera(camera, tmp_path / "again.json", name="west")).name == "west"


def test_files_with_little_in_them(tmp_path: Path) -> None:
    """No error bars, no record, no name."""
    content = json.loads(SAMPLE.read_text())
    for key in ("half", "mounting", "calibration"):
        content[key] = None
    for side in ("left", "right"):
        content[side] |= {"standard_deviations": None, "covariance": None, "calibration": None}
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(content))
    rig = load_rig(path)
    assert (rig.covariance, rig.mounting, rig.calibration) == (None, None, None)
    assert_same_rig(content, save_rig(rig, tmp_path / "again.json"))
    content["left"] |= {"name": ""}
    bare = {"kcal": "camera", "version": 2, **content["left"]}
    path.write_text(json.dumps(bare))
    assert load_camera(path).calibration is None
    assert_same(bare, json.loads(save_camera(load_camera(path), tmp_path / "again.json").read_text()))


def test_copies_and_pickles_keep_it() -> None:
    rig = load_rig(SAMPLE)
    assert rig.covariance is not None
    for other in (copy.copy(rig), copy.deepcopy(rig), pickle.loads(pickle.dumps(rig)), rig.to(torch.float32)):
        assert other.covariance is not None
        assert torch.equal(other.covariance.matrix, rig.covariance.matrix)
        assert other.mounting is not None
        assert other.calibration == rig.calibration
        assert other.left.calibration is not None
        assert other.left.calibration.name == "left"
    # It is no part of the state, and the state loads into rigs that know nothing.
    assert not any("calibration" in key or "covariance" in key for key in rig.state_dict())
    plain = load_rig(SAMPLE)
    plain.load_state_dict(rig.state_dict())
    assert plain.covariance is not None


def test_it_does_not_outlive_the_parameters() -> None:
    rig = load_rig(SAMPLE)
    known = rig.left.calibration
    assert rig.left.with_parameters(rig.left.params + 1e-9).calibration is None
    with torch.no_grad():
        rig.left.params[0] += 1e-9
    assert rig.left.calibration is None
    assert (rig.covariance, rig.mounting, rig.calibration) == (None, None, None)
    assert rig.right.calibration is not None
    with torch.no_grad():
        rig.left.params.copy_(load_rig(SAMPLE).left.params)
    assert rig.left.calibration is known
    turned = Rig.pair(rig.left, rig.right, rig.right_from_left_rotation, 2 * rig.right_from_left_translation)
    assert turned.covariance is None
    turned.load_state_dict(rig.state_dict())
    assert turned.covariance is None


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    rig = load_rig(SAMPLE)
    with pytest.raises(InputError, match=r"\(K, 26\) is needed"):
        rig.covariance = RigCovariance(half=torch.eye(6, dtype=torch.float64))
    camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
    with pytest.raises(InputError, match=r"\(5, 5\) is needed"):
        camera.calibration = CameraCalibration(covariance=torch.eye(6, dtype=torch.float64))
    content = json.loads(SAMPLE.read_text())
    for change, complaint in (
        ({"link": content["mounting"]["link"][1:]}, "link must be 26 x 6"),
        ({"link": [[1e3] * 6] * 26}, "covariance of rig and mounting.*not a covariance"),
        ({"covariance": None}, "link needs the covariances of the rig and of the mounting"),
        ({"lat": 95.0}, "lat"),
        ({"speed": 1.0}, "Extra"),
    ):
        path = tmp_path / "rig.json"
        path.write_text(json.dumps(content | {"mounting": content["mounting"] | change}))
        with pytest.raises(FileError, match=complaint):
            load_rig(path)
    path.write_text(
        json.dumps(content | {"mounting": None, "half": Packed.of(1e200 * torch.ones(1, 26).double()).model_dump()})
    )
    with pytest.raises(FileError, match=r"rig\.json.*overflows"):
        load_rig(path)
    for change, complaint in (({"rms": -1.0}, "rms"), ({"color": "red"}, "Unexpected|Extra"), ({"pairs": 3}, "pairs")):
        path.write_text(json.dumps(content | {"calibration": content["calibration"] | change}))
        with pytest.raises(FileError, match=complaint):
            load_rig(path)
