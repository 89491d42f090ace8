"""A rig is no better than its cameras, their boards and its own solution, and says what could not be checked."""

import dataclasses
import datetime
from pathlib import Path
from typing import Any

import pytest
import torch
from command_line import Command
from locate_rigs import pinhole_rig

from kcal import Board, InputError, Observations, Rig, View, load_rig, save_rig
from kcal.cli import report
from kcal.cli.rig_sources import check_views_of
from kcal.finding import FAULTS, Finding
from kcal.lens.calibration import BoardRecord, CalibrationRecord, CameraCalibration, RigCalibration, RigSource
from kcal.report import rig_verdict
from kcal.report.judge_camera import record_findings
from kcal.report.verdict import Requirement, Verdict
from kcal.rig import RigCovariance

NEED = Requirement.parse("1km:5%")
NOW = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
CLEAN = [f"{i:02}.png" for i in range(20)]
MIXED = [f"{side}{i:02}.png" for side in ("left", "right") for i in range(10)]


def record(names: list[str], tempering: float = 1.0, warnings: tuple[str, ...] = ()) -> CalibrationRecord:
    return CalibrationRecord(
        rms=0.1, views=len(names), points=1000, per_view_rms=dict.fromkeys(names, 0.1), noise=0.07, tempering=tempering,
        board=BoardRecord(columns=9, rows=6, square=0.025), stop_reason="converged", iterations=9, warnings=warnings,
        kcal_version="1", created=NOW,
    )  # fmt: skip


def solved(left: CalibrationRecord, right: CalibrationRecord | None = None, **changes: object) -> Rig:
    first = pinhole_rig()
    rig = Rig.pair(
        first.left, first.left.with_parameters(first.left.params + 1e-3), first.right_from_left_rotation,
        first.right_from_left_translation,
    )  # fmt: skip
    rig.left.calibration = CameraCalibration(name="left", record=left)
    rig.right.calibration = CameraCalibration(name="right", record=right or record(CLEAN))
    spread = torch.cat([torch.full((2 * rig.left.params.shape[-1],), 1e-2), torch.full((6,), 1e-6)]).double()
    rig.covariance = RigCovariance.of(rig, joint=torch.diag(spread.square()))
    known: Any = {"rms": 0.1, "rms_px": (0.1, 0.1), "pairs": 0, "per_pair_rms": {}, "kcal_version": "1", "created": NOW}
    rig.calibration = RigCalibration(**known, **changes)
    return rig


def severities(verdict: Verdict) -> dict[str, str]:
    return {finding.name: finding.severity for finding in verdict.findings}


def test_a_clean_rig_is_allowed_and_says_what_was_not_checked() -> None:
    verdict = rig_verdict(solved(record(CLEAN)), NEED, mark_sigma=0.1)
    assert verdict.usable
    assert severities(verdict) == {"halves": "doubt"}
    assert verdict.findings[0].told.startswith("left and right: the views were not looked at")


def test_images_of_two_cameras_in_one_are_told_by_their_names() -> None:
    verdict = rig_verdict(solved(record(CLEAN), record(MIXED)), NEED, mark_sigma=0.1)
    assert not verdict.usable
    assert verdict.reason.startswith(
        "right: 20 of 20 views are named like pairs of two cameras, left00.png and right00"
    )
    # A few such names among many say nothing.
    assert not [one for one in record_findings(record([*CLEAN, "left01.png", "right01.png"])) if one.name == "names"]


def test_what_its_files_tell_of_the_calibrations_counts() -> None:
    left = record(CLEAN, tempering=9.0, warnings=("residuals repeat within views",))
    verdict = rig_verdict(solved(left), NEED, mark_sigma=0.1)
    # Its error bars are widened for it: a doubt.
    assert severities(verdict)["calibration"] == "doubt"
    assert verdict.usable
    few = severities(rig_verdict(solved(record(CLEAN[:7])), NEED, mark_sigma=0.1))
    assert few["views"] == "doubt"


def test_its_own_solution_counts_from_the_file_alone() -> None:
    sources = (RigSource(name="landmarks", used=9, left_out=0, sigmas=4.0),)
    found = rig_verdict(
        solved(record(CLEAN), sources=sources, warnings=("its geometry is weak",)), NEED, mark_sigma=0.1
    )
    assert severities(found)["misfit"] == "stop"
    assert "residuals are 4.0 times as large" in found.reason
    assert "its geometry is weak" in [finding.text for finding in found.findings]
    bare = solved(record(CLEAN))
    bare.calibration = None
    assert severities(rig_verdict(bare, NEED, mark_sigma=0.1))["record"] == "doubt"


def test_nothing_is_promised_without_a_covariance() -> None:
    rig = solved(record(CLEAN))
    rig.covariance = None
    verdict = rig_verdict(rig, NEED, mark_sigma=0.1)
    assert [answer.ok for answer in verdict.answers] == [False]
    assert verdict.reason.startswith("the rig has no error bars")
    assert verdict.to_dict()["ranges"][0]["sigma_m"] is None


def test_exact_lenses_are_doubted_from_the_file_alone() -> None:
    rig = solved(record(CLEAN))
    assert rig.covariance is not None
    half = rig.covariance.half.clone()
    half[:, : rig.left.params.shape[-1]] = 0.0
    rig.covariance = RigCovariance(half=half)
    (told,) = [one for one in rig_verdict(rig, NEED, mark_sigma=0.1).findings if one.name == "exact-lenses"]
    assert "the lenses of left were taken as exact" in told.text


def test_faults_of_the_cameras_count_in_the_ranges() -> None:
    bent = Finding(name="board", severity="doubt", text="the board bends by 2 mm", action="measure it", part=FAULTS)
    cameras = [Verdict(subject="left", findings=(bent,), unexplained=2.0), Verdict(subject="right")]
    verdict = rig_verdict(solved(record(CLEAN)), NEED, mark_sigma=0.1, cameras=cameras)
    # 2 px of disparity at 1 km are Z² / (f B) = 125 m.
    assert verdict.answers[0].parts[FAULTS] == pytest.approx(125.0, rel=0.01)
    assert (verdict.reason, verdict.next_step) == ("left: the board bends by 2 mm", "measure it, for left")
    borne = [dataclasses.replace(cameras[0], unexplained=0.1), cameras[1]]
    assert rig_verdict(solved(record(CLEAN)), NEED, mark_sigma=0.1, cameras=borne).usable


def test_the_command_ends_with_3_and_names_the_camera(tmp_path: Path, command: Command) -> None:
    save_rig(solved(record(MIXED), warnings=("its geometry is weak",)), tmp_path / "rig.json")
    assert load_rig(tmp_path / "rig.json").left.calibration is not None
    found = command("report", tmp_path / "rig.json", code=3)
    assert "NO: left: 20 of 20 views are named like pairs" in found.out
    assert "its geometry is weak" in found.out
    assert "the views were not looked at" in found.out


def test_images_named_alike_tell_neither_an_exchange_nor_a_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each camera was photographed alone, into a folder of its own, and the rig was solved from landmarks."""
    files = [Path("left.obs.json"), Path("right.obs.json")]
    rig = solved(*(dataclasses.replace(record(CLEAN), observations=file.name) for file in files))
    board, view = Board(columns=9, rows=6, square=0.025), tuple((10.0 + i % 9, 10.0 + i // 9) for i in range(54))
    views = tuple(View(name=name, pixels=view) for name in CLEAN)
    seen = [Observations(board=board, image_size=rig.left.size, views=views)] * 2
    cameras = (rig.left, rig.right)
    check_views_of(cameras, seen, files)
    with pytest.raises(InputError, match="they are exchanged"):
        check_views_of(cameras, seen, files[::-1])
    monkeypatch.setattr(report, "_pairs", lambda *_: (None, "looked for pairs"))
    verdict = report.judged_rig(rig, files, (), mark_sigma=0.1, name="rig", cameras=())[0]
    told = [text.text for text in verdict.findings]
    assert "looked for pairs" not in " ".join(told)
    assert rig.calibration is not None
    rig.calibration = dataclasses.replace(rig.calibration, pairs=20, per_pair_rms=dict.fromkeys(CLEAN, 0.1))
    verdict = report.judged_rig(rig, files, (), mark_sigma=0.1, name="rig", cameras=())[0]
    told = [text.text for text in verdict.findings]
    assert "looked for pairs" in " ".join(told)
