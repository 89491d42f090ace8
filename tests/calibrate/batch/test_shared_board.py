"""Batches whose cameras share a board: what is passed on, kept and said; with calibrations that take no time."""

import csv
import dataclasses
import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from batch_crew import Here
from calibrate_scenes import BOARD, camera, motions, observe, pixels_of

from kcal import Board, DegenerateError, Observations, load_camera
from kcal.calibrate.batch import results as module
from kcal.calibrate.batch.jobs import (
    BatchOptions,
    Calibrated,
    CameraJob,
    Detected,
    calibrated,
    pieces,
    read_jobs,
    sharing_jobs,
)
from kcal.calibrate.batch.results import Results, calibrate_batch, run_tasks
from kcal.calibrate.camera.calibrate import CalibrationOptions, CameraCalibrationResult, calibrate_camera

NAMES = ("east", "west", "lone")


SEEN = {
    name: observe(pixels_of(camera(), motions(camera(), 5, seed), noise=0.1, seed=seed))
    for seed, name in enumerate(NAMES)
}


@functools.cache
def solved(model: str) -> dict[str, CameraCalibrationResult]:
    """As if cameras were alone (opencv4), and with what others tell of their board (pinhole)."""
    return {name: calibrate_camera(SEEN[name], CalibrationOptions(model=model)) for name in NAMES}


@pytest.fixture
def jobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[CameraJob]:
    """Three cameras of five images; the first two may share a board."""

    def detect(path: str, board: Board, options: BatchOptions) -> Detected:
        view = SEEN[Path(path).parent.name].views[int(Path(path).stem)]
        return Detected(size=SEEN["east"].image_size, pixels=view.pixels)

    def calibrate(seen: Observations, name: str, model: str, options: BatchOptions) -> Calibrated:
        return calibrated(solved("opencv4")[name], name)

    def again(seen: Observations, options: BatchOptions) -> Any:
        return next(solved("opencv4")[name] for name in NAMES if SEEN[name].views[0].pixels == seen.views[0].pixels)

    def sharing(alone: list[Any], options: CalibrationOptions, *, one_type: bool, run: Callable[..., Any]) -> list[Any]:
        assert (options.model, one_type) == ("hybrid", False)
        assert alone == [solved("opencv4")["east"], solved("opencv4")["west"]]
        assert dict(run(divmod, {0: (7, 2), 1: (9, 4)})) == {0: (3, 1), 1: (2, 1)}
        return [solved("pinhole")["east"], solved("pinhole")["west"]]

    monkeypatch.setattr(module, "detect_image", detect)
    monkeypatch.setattr(module, "calibrate_observations", calibrate)
    monkeypatch.setattr(module, "calibrate_again", again)
    monkeypatch.setattr(module, "sharing", sharing)
    for name in NAMES:
        (tmp_path / "images" / name).mkdir(parents=True)
        for i in range(5):
            (tmp_path / "images" / name / f"{i}.png").write_bytes(f"{name} {i}".encode())
    by_name = {job.name: job for job in read_jobs(tmp_path / "images", BOARD, "hybrid")}
    return [by_name["east"], by_name["west"], dataclasses.replace(by_name["lone"], model="opencv4")]


def together(jobs: list[CameraJob], folder: Path, alone: set[Path] | None = None) -> tuple[Results, Here, list[str]]:
    """Calibrate all; into `alone` go the pieces of work that were there before what cameras share."""
    results, here, advanced = Results(folder, jobs, BatchOptions()), Here(), []
    run_tasks(results.tasks(advanced.append), results.done, here)  # type: ignore[arg-type]
    if alone is not None:
        alone.update((folder / ".work").iterdir())
    for numbers in sharing_jobs(jobs):
        results.share(numbers, here)  # type: ignore[arg-type]
    return results, here, advanced


@pytest.mark.slow
def test_cameras_that_share_a_board_are_calibrated_together(jobs: list[CameraJob], tmp_path: Path) -> None:
    assert sharing_jobs(jobs) == [[0, 1]]
    alone: set[Path] = set()
    results, here, advanced = together(jobs, tmp_path / "out", alone)
    assert len(advanced) == pieces(jobs) == 15 + 3 + 2
    for name in NAMES:
        wanted = solved("opencv4") if name == "lone" else solved("pinhole")
        kept = load_camera(tmp_path / "out" / f"{name}.camera.json")
        torch.testing.assert_close(kept.params, wanted[name].camera.params, rtol=1e-14, atol=0)
    assert here.done.count("again") == 2
    assert [row.status for row in results.rows()] == ["ok"] * 3
    # Another run finds everything done.
    results, here, advanced = together(jobs, tmp_path / "out")
    assert here.done == []
    assert len(advanced) == results.reused == pieces(jobs)
    # One of the shared pieces that is gone is made anew, with all that share.
    min(set((tmp_path / "out" / ".work").iterdir()) - alone).unlink()
    _, here, _ = together(jobs, tmp_path / "out")
    assert here.done.count("again") == 2


def test_cameras_that_cannot_be_calibrated_together_stay_alone(
    jobs: list[CameraJob], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "sharing", Mock(side_effect=DegenerateError("no common shape")))
    results, _, _ = together(jobs, tmp_path / "out")
    rows = results.rows()
    for row in rows[:2]:
        assert "calibrated alone, without what other cameras tell of the board: no common shape" in row.warnings
    assert "calibrated alone" not in rows[2].warnings
    monkeypatch.undo()
    assert torch.equal(
        load_camera(tmp_path / "out" / "east.camera.json").params, solved("opencv4")["east"].camera.params
    )


def test_a_camera_that_failed_shares_nothing(
    jobs: list[CameraJob], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def calibrate(seen: Observations, name: str, model: str, options: BatchOptions) -> Calibrated:
        return Calibrated(error="no") if name == "west" else calibrated(solved("opencv4")[name], name)

    monkeypatch.setattr(module, "calibrate_observations", calibrate)
    results, here, _ = together(jobs, tmp_path / "out")
    assert "again" not in here.done
    assert [row.status for row in results.rows()] == ["ok", "failed", "ok"]
    assert torch.equal(
        load_camera(tmp_path / "out" / "east.camera.json").params, solved("opencv4")["east"].camera.params
    )


def test_a_whole_batch(jobs: list[CameraJob], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, str | None]] = []

    @contextmanager
    def crew(workers: int, scheduler: str | None = None) -> Iterator[Here]:
        asked.append((workers, scheduler))
        yield Here()

    monkeypatch.setattr(module, "pool", crew)
    monkeypatch.setattr("os.cpu_count", lambda: 7)
    report = calibrate_batch(jobs, tmp_path / "out")
    again = calibrate_batch(jobs, tmp_path / "out", workers=3, scheduler="tcp://x")
    assert asked == [(7, None), (3, "tcp://x")]
    assert (report.reused, report.total, again.reused) == (0, 20, 20)
    assert report.rows == again.rows
    with report.summary.open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [row["camera"] for row in table] == list(NAMES)
    assert [(row["images"], row["views"], row["failures"]) for row in table] == [("5", "5", "0")] * 3
    lone = solved("opencv4")["lone"]
    assert float(table[2]["rms"]) == pytest.approx(lone.rms, rel=1e-5)
    for column, number in (("fx", 0), ("fy", 1), ("cx", 2), ("cy", 3)):
        assert float(table[2][column]) == pytest.approx(float(lone.camera.params[number]), rel=1e-5)
    assert float(table[2]["sigma_fx"]) == pytest.approx(lone.sigma["fx"], rel=1e-5)  # type: ignore[arg-type]
    assert (table[2]["width"], table[2]["height"]) == tuple(map(str, SEEN["lone"].image_size))


def test_an_image_that_is_gone_is_a_failure_of_its_own(jobs: list[CameraJob], tmp_path: Path) -> None:
    jobs[2].images[3].unlink()
    results, _, _ = together(jobs, tmp_path / "out")
    row = results.rows()[2]
    assert (row.images, row.views, row.failures) == (5, 4, 1)
    seen = Observations.load(tmp_path / "out" / "lone.obs.json")
    assert [failure.name for failure in seen.failures] == ["3.png"]
    assert not seen.failures[0].reason.startswith(str(tmp_path))


def test_which_cameras_may_share_a_board() -> None:
    """Of the hybrid lens and of one kind of board; one alone shares with nobody."""
    other = Board(columns=5, rows=4, square=0.1)
    kinds = [
        ("hybrid", BOARD, ""), ("hybrid", other, ""), ("opencv5", BOARD, ""), ("hybrid", BOARD, "no file"),
        ("hybrid", BOARD, ""), ("hybrid", other, ""), ("hybrid", Board(columns=9, rows=4, square=0.1), ""),
    ]  # fmt: skip
    jobs = [CameraJob(name=str(i), board=b, model=m, error=e) for i, (m, b, e) in enumerate(kinds)]
    assert sharing_jobs(jobs) == [[0, 4], [1, 5]]
    # No images here: one for each that can be calibrated, and one for each that shares.
    assert pieces(jobs) == 6 + 4
