"""`kcal export`, `import`, `show` and `diff` through the command line."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from command_line import invoked as run

from kcal import Camera, InputError, Observations, Rig, load_camera, load_rig, save_camera, save_rig
from kcal.cli.rig import _exact_line
from kcal.lens import CameraCalibration
from kcal.locate.survey import read_survey


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    known = Camera.build(focal=(800, 810), center=(320, 240), size=(640, 480), coefficients=[-0.1, 0.02, 1e-3, 0, 1e-3])
    spread = torch.tensor([1.0, 1, 2, 2, 0, 1e-3, 1e-3, 1e-4, 1e-4, 1e-4], dtype=torch.float64)
    known.calibration = CameraCalibration(name="north", covariance=torch.diag(spread**2))
    return save_camera(known, tmp_path / "a.json")


def test_a_rig_of_three_cameras_goes_there_and_back(tmp_path: Path, camera: Path) -> None:
    one = load_camera(camera)
    one.calibration = None
    aside = torch.tensor([[0.0, 0, 0], [-1, 0, 0], [-2, 0, 0.1]], dtype=torch.float64)
    rig = Rig([one] * 3, ["a", "b", "c"], torch.eye(3, dtype=torch.float64).expand(3, 3, 3), aside)
    run("export", save_rig(rig, tmp_path / "three.json"), "--format", "toml", "-o", tmp_path / "three.toml")
    assert "rig from toml: a, b, c" in run("import", tmp_path / "three.toml", "-o", tmp_path / "back.json")
    back = load_rig(tmp_path / "back.json")
    assert float((back.translation - back.translation[0] - aside).abs().max()) < 1e-12


def test_there_and_back(tmp_path: Path, camera: Path) -> None:
    text = run("export", camera, "-o", tmp_path / "a.yaml")
    assert "north: opencv5, exact" in text
    assert "not in the file" not in text
    assert "a.prior.json" in text
    text = run("import", tmp_path / "a.yaml", "-o", tmp_path / "b.json")
    assert "camera from opencv: opencv5, 640x480 px" in text
    assert "no error bars" in text
    assert load_camera(tmp_path / "b.json").params.tolist() == load_camera(camera).params.tolist()
    text = run("diff", camera, tmp_path / "b.json", "--picture", tmp_path / "diff.png")
    assert "no difference beyond the error bars of " in text
    assert (tmp_path / "diff.png").stat().st_size > 10_000


def test_a_change_is_told(tmp_path: Path, camera: Path) -> None:
    old = load_camera(camera)
    new = old.with_parameters(old.params + torch.tensor([30.0] + [0.0] * 9, dtype=torch.float64))
    save_camera(new, tmp_path / "new.json")
    assert "a difference beyond the error bars of " in run("diff", camera, tmp_path / "new.json")
    assert "no error bars" in run("diff", tmp_path / "new.json", tmp_path / "new.json")


@pytest.mark.slow
def test_a_fitted_lens_is_told_with_a_picture(tmp_path: Path, camera: Path) -> None:
    text = run("export", camera, "-o", tmp_path / "k.yaml", "--model", "pinhole", "--format", "kalibr",
               "--picture", tmp_path / "m.png")  # fmt: skip
    assert "pinhole, fitted: RMS" in text
    assert (tmp_path / "m.png").exists()


def test_rigs(tmp_path: Path, camera: Path) -> None:
    one = load_camera(camera)
    save_rig(Rig.pair(one, one, torch.eye(3), torch.tensor([-1.5, 0.0, 0.0])), tmp_path / "rig.json")
    text = run("export", tmp_path / "rig.json", "--format", "ros", "-o", tmp_path / "ros.yaml")
    assert "ros_left.yaml" in text
    text = run("import", tmp_path / "ros_left.yaml", tmp_path / "ros_right.yaml", "-o", tmp_path / "back.json")
    assert "baseline 1.5 m" in text
    assert load_rig(tmp_path / "back.json").right_from_left_translation.tolist() == pytest.approx([-1.5, 0, 0])
    whole = run("show", tmp_path / "rig.json")
    assert "baseline 1.5 m" in whole
    left, right = (run("show", f"{tmp_path / 'rig.json'}:{name}") for name in ("left", "right"))
    assert left + right in whole
    assert "camera right" not in left
    run("export", f"{tmp_path / 'rig.json'}:left", "-o", tmp_path / "left.txt")
    with pytest.raises(InputError, match=r"2 cameras; name one of .left., .right., for example \S*rig.json:left$"):
        run("diff", tmp_path / "rig.json", camera)


def test_show(tmp_path: Path, camera: Path) -> None:
    text = run("show", camera)
    assert "camera north" in text
    assert "sigma in the image" in text
    run("export", camera, "-o", tmp_path / "cameras.txt")
    assert "colmap, 1 camera" in run("show", tmp_path / "cameras.txt")


def test_corners_and_surveys(tmp_path: Path) -> None:
    rows = [f"a.png {i} {i} 0" for i in range(6)]
    (tmp_path / "c.vnl").write_text("\n".join(["# filename x y level", *rows]))
    text = run("import", tmp_path / "c.vnl", "--board", "3x2", "--square", "25mm", "--size", "64x48",
               "-o", tmp_path / "c.obs.json")  # fmt: skip
    assert "1 view with 6 corners, without weights" in text
    assert Observations.load(tmp_path / "c.obs.json").image_size == (64, 48)
    assert "1 view with 6 corners" in run("show", tmp_path / "c.obs.json")
    (tmp_path / "s.gpx").write_text('<gpx><wpt lat="19.07" lon="72.87"><ele>80</ele><name>post</name></wpt></gpx>')
    run("import", tmp_path / "s.gpx", "--survey-sigma", 0.02, "--geoid", -66, "-o", tmp_path / "s.csv")
    survey = read_survey(tmp_path / "s.csv")
    assert (survey.origin.lat, survey.origin.height) == pytest.approx((19.07, 14.0), abs=1e-5)


@pytest.mark.parametrize("words", [["--size", "64"], ["--unit", "mile"], ["--board", "3x2"]])
def test_bad_options(tmp_path: Path, camera: Path, words: list[str]) -> None:
    with pytest.raises(InputError):
        run("import", camera, "-o", tmp_path / "x.json", *words)


def test_error_bars_come_along_and_a_rig_says_who_has_none(tmp_path: Path, camera: Path) -> None:
    run("export", camera, "--format", "gtsam", "-o", tmp_path / "a.gtsam.json", "--model", "opencv4")
    assert "no error bars" not in run("import", tmp_path / "a.gtsam.json", "-o", tmp_path / "b.json")
    known, bare = load_camera(tmp_path / "b.json"), Camera.build(focal=(1000, 1000), center=(320, 240), size=(640, 480))
    assert known.calibration.covariance is not None
    rig = Rig.pair(bare, known, torch.eye(3), torch.tensor([-2.0, 0, 0]))
    data = SimpleNamespace(cameras=(bare, known))
    line = _exact_line(SimpleNamespace(exact=("left",), names=("left", "right"), data=data), rig)  # type: ignore[arg-type]
    assert "An error of 0.1 px in one of them is 1.0 % of a range of 200 m" in line
    assert "Without error bars came left:" in line
    fixed = _exact_line(SimpleNamespace(exact=("right",), names=("left", "right"), data=data), rig)  # type: ignore[arg-type]
    assert "Without error bars" not in fixed
