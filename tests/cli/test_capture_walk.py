"""As a user goes with somebody's capture: calibrate both cameras, ask whether they may be used, solve the rig, ask."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from kcal.cli.main import app
from kcal.corners.observations import Observations
from kcal.io.camera_file import load_camera
from kcal.io.rig_file import load_rig


def kcal(*words: object) -> tuple[int, str]:
    found = CliRunner().invoke(app, [str(word) for word in words])
    return found.exit_code, found.output


def test_files_that_follow_one_option_are_refused_with_the_command(tmp_path: Path) -> None:
    words = ("report", "rig.json", "--observations", "left.obs.json", "right.obs.json", "--require", "1km:5%")
    code, text = kcal(*words)
    assert code == 2
    plain = " ".join(text.replace("│", " ").split())
    assert (
        "--observations takes one file; give it before each: kcal report rig.json --observations left.obs.json "
        "--observations right.obs.json --require 1km:5%" in plain
    )
    # Another slip gets no such advice.
    assert "give it before each" not in kcal("report", "rig.json", "other.json")[1]


@pytest.mark.slow
def test_a_stereo_capture_from_observations_to_the_verdict_on_its_rig(kcal_data: Path, tmp_path: Path) -> None:
    """Ten of the pairs of a webcam rig, of which nobody knows the truth: what must agree, agrees."""
    seen, cameras = [], []
    for side in ("left", "right"):
        file, camera = tmp_path / f"{side}.obs.json", tmp_path / f"{side}.camera.json"
        whole = Observations.load(kcal_data / "captures" / f"st1_{side[0]}.obs.json")
        whole.model_copy(update={"views": whole.views[:10]}).save(file)
        code, text = kcal("calibrate", file, "-o", camera)
        assert code == 0, text
        seen.append(file)
        cameras.append(camera)
        lens = load_camera(camera)
        assert lens.calibration is not None
        assert lens.calibration.record is not None
        assert lens.calibration.record.rms < 0.5
    code, text = kcal("report", cameras[0], "--observations", seen[0], "-o", tmp_path / "left.html", "--json")
    told = json.loads(text[text.index("{") :])
    assert code == (0 if told["verdict"]["usable"] else 3)
    assert (tmp_path / "left.html").stat().st_size > 100_000
    code, text = kcal("rig", *cameras, "--pairs", *seen, "-o", tmp_path / "rig.json")
    assert code == 0, text
    rig = load_rig(tmp_path / "rig.json")
    assert rig.calibration is not None
    assert rig.calibration.pairs >= 7
    assert rig.covariance is not None
    assert 0.02 < float(rig.baseline) < 0.5
    code, text = kcal("report", tmp_path / "rig.json", *(word for file in seen for word in ("--observations", file)))
    assert code in (0, 3)
    assert ("YES" if code == 0 else "NO") in text
    # Each finding in words, none by its internal name.
    assert not any(name in text for name in ("\n  halves:", "\n  patterns:", "\n  other-views:", "\n  exact-lenses:"))
