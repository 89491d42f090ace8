import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from unittest.mock import Mock

import cv2
import interrupted
import numpy as np
import pytest
import torch
from batch_crew import Here
from command_line import invoked, ran
from waiting import wait_for

from kcal import Board, Camera, DegenerateError, FileError, InputError, KcalError, Observations
from kcal.calibrate import calibrate_cameras
from kcal.calibrate.batch.jobs import BatchOptions, detect_image, pieces, read_jobs, sharing_jobs
from kcal.calibrate.batch.results import (
    Pool,
    Results,
    SummaryRow,
    Task,
    WorkerDiedError,
    pool,
    run_tasks,
    write_summary,
)
from kcal.io.camera_file import CameraFile, load_camera
from kcal.sim.captures import BoardSize, sample_board_poses
from kcal.sim.scene import RenderOptions, render_board
from kcal.threads import in_one_thread

BOARD = Board(columns=6, rows=5, square=0.02)
WHAT = ("--board", "6x5", "--square", "20mm")


@pytest.fixture(scope="module")
def images():
    """Four views each of two cameras, as PNG bytes."""
    cameras = {}
    for seed, name in enumerate(("east", "west")):
        camera = Camera.build(focal=(300 + 20 * seed,) * 2, center=(159.5, 119.5), size=(320, 240))
        size = BoardSize(BOARD.columns, BOARD.rows, BOARD.square)
        generator = torch.Generator().manual_seed(seed)
        poses = sample_board_poses(camera, size, 4, generator, fill=(0.5, 0.8))
        shots = [render_board(camera, pose, size, RenderOptions(), generator).numpy() for pose in poses]
        cameras[name] = [cv2.imencode(".png", shot)[1].tobytes() for shot in shots]
    return cameras


def write_images(images, folder):
    for name, shots in images.items():
        (folder / name).mkdir(parents=True)
        for i, shot in enumerate(shots):
            (folder / name / f"{i}.png").write_bytes(shot)


def run(folder, output, options=None, board=BOARD, model="opencv5"):
    """A batch in this process: its rows, and how many pieces were done anew."""
    results = Results(output, read_jobs(folder, board, model), options or BatchOptions())
    here = Here()
    run_tasks(results.tasks(lambda _: None), results.done, here)
    return results.rows(), len(here.tasks)


@pytest.fixture(scope="module")
def finished(images, tmp_path_factory):
    """A folder with images in `cameras` and a batch of them in `out`, a copy of it, and the rows of the batch."""
    kept = tmp_path_factory.mktemp("finished")
    place = tmp_path_factory.getbasetemp() / "batch"
    write_images(images, place / "cameras")
    rows, done = run(place / "cameras", place / "out")
    assert done == 10
    shutil.copytree(place, kept, dirs_exist_ok=True)
    return place, kept, rows


@pytest.fixture
def place(finished):
    """The folder as it was right after the batch, at the same path: keys of pieces contain it."""
    place, kept, _ = finished
    shutil.rmtree(place)
    shutil.copytree(kept, place)
    return place


@pytest.fixture
def first(finished):
    return finished[2]


@pytest.fixture
def folder(place):
    return place / "cameras"


class TestResults:
    @pytest.mark.slow
    def test_is_what_detect_and_calibrate_give(self, folder, first, place):
        assert [(row.camera, row.status, row.views) for row in first] == [("east", "ok", 4), ("west", "ok", 4)]
        for name in ("east", "west"):
            single = place / f"{name}.obs.json"
            invoked("detect", folder / name, *WHAT, "-o", single)
            invoked("calibrate", single, "-o", place / f"{name}.camera.json", "--model", "opencv5")
            assert Observations.load(place / "out" / f"{name}.obs.json") == Observations.load(single)
            ours = CameraFile.load(place / "out" / f"{name}.camera.json")
            other = CameraFile.load(place / f"{name}.camera.json")
            # Where memory lies decides the order of sums, and an iteration stops a little elsewhere for it.
            assert ours.intrinsics.model_dump() == pytest.approx(other.intrinsics.model_dump(), rel=1e-7)
            spread, known = ours.standard_deviations or {}, other.standard_deviations or {}
            assert list(spread) == list(known)
            assert [value or 0.0 for value in spread.values()] == pytest.approx(
                [value or 0.0 for value in known.values()], rel=1e-4
            )
        assert first[0].rms == pytest.approx(0.02, abs=0.02)
        assert first[0].fx == pytest.approx(300, rel=0.01)
        assert first[0].focal == pytest.approx(0.5 * (first[0].fx + first[0].fy), rel=1e-12)
        assert 0 < first[0].sigma_focal < 2 * first[0].sigma_fx

    def test_nothing_is_done_twice(self, folder, first, place):
        assert run(folder, place / "out") == (first, 0)

    def test_only_what_changed_is_done_again(self, folder, first, images, place):
        (folder / "east" / "0.png").unlink()
        rows, done = run(folder, place / "out")
        assert done == 1  # east's calibration
        assert rows[0].views == 3
        assert rows[1] == first[1]
        (folder / "east" / "0.png").write_bytes(images["east"][0])
        assert run(folder, place / "out") == (first, 0)
        # A renamed image needs no detection, but its view has another name.
        (folder / "west" / "3.png").rename(folder / "west" / "9.png")
        assert run(folder, place / "out")[1] == 1

    @pytest.mark.slow
    def test_options_are_part_of_the_key(self, folder, place):
        assert run(folder, place / "out", BatchOptions(refine="saddle"))[1] == 10
        assert run(folder, place / "out", model="opencv4")[1] == 2
        assert run(folder, place / "out", BatchOptions(board_warp=True))[1] == 2
        assert run(folder, place / "out", BatchOptions(time_limit=99))[1] == 0

    def test_pieces_that_were_edited_or_damaged_are_done_again(self, folder, first, place):
        pieces = {path: json.loads(path.read_text()) for path in sorted((place / "out" / ".work").iterdir())}
        camera = next(path for path, content in pieces.items() if content["piece"]["kcal"] == "calibrated")
        image, damaged, *_ = (path for path, content in pieces.items() if content["piece"]["kcal"] == "detected")
        pieces[camera]["piece"]["camera"]["intrinsics"]["fx"] += 1.0
        pieces[image]["piece"]["pixels"][0][0] += 5.0
        for path in (camera, image):
            path.write_text(json.dumps(pieces[path]))
        damaged.write_text(damaged.read_text()[:40])
        again, done = run(folder, place / "out")
        assert done == 3
        assert [row.fx for row in again] == pytest.approx([row.fx for row in first], rel=1e-6)

    def test_no_cell_of_the_table_is_a_formula(self, tmp_path):
        path = write_summary(tmp_path / "s.csv", [SummaryRow("=1+1", "ok", "@SUM(A1)", 1, 1, 0, fx=-1.5)])
        (row,) = csv.DictReader(path.open())
        assert (row["camera"], row["model"], row["fx"], row["fy"]) == ("'=1+1", "'@SUM(A1)", "-1.5", "")

    def test_failures_stay_with_their_camera(self, folder, place):
        (folder / "east" / "bad.png").write_bytes(b"no image")
        (folder / "broken").mkdir()
        (folder / "broken" / "a.png").write_bytes(b"")
        (folder / "empty").mkdir()
        (folder / "few").mkdir()
        (folder / "few" / "a.png").write_bytes((folder / "west" / "0.png").read_bytes())
        rows, _ = run(folder, place / "out")
        by_name = {row.camera: row for row in rows}
        assert [row.status for row in rows] == ["failed", "ok", "failed", "failed", "ok"]
        assert (by_name["east"].views, by_name["east"].failures) == (4, 1)
        assert "the file is empty" in by_name["broken"].error
        assert "no image in this folder" in by_name["empty"].error
        assert "at least 3" in by_name["few"].error
        assert not (place / "out" / "few.camera.json").exists()

    @pytest.mark.slow
    def test_an_unexpected_error_is_listed_and_not_kept(self, folder, place, monkeypatch):
        monkeypatch.setattr("kcal.calibrate.batch.jobs.detect_board", lambda *_: 1 / 0)
        rows, _ = run(folder, place / "new")
        assert "ZeroDivisionError: division by zero" in rows[0].error
        monkeypatch.undo()
        rows, done = run(folder, place / "new")
        assert (rows[0].status, done) == ("ok", 10)

    def test_a_camera_that_fails_later_leaves_no_old_file(self, folder, place):
        for i in range(2):
            (folder / "east" / f"{i}.png").unlink()
        assert run(folder, place / "out")[0][0].status == "failed"
        assert not (place / "out" / "east.camera.json").exists()
        for path in (folder / "east").iterdir():
            path.unlink()
        assert "no image in this folder" in run(folder, place / "out")[0][0].error
        assert [path.name for path in (place / "out").glob("east.*")] == []

    def test_results_inside_the_folder_are_no_camera(self, folder):
        run(folder, folder / "results")
        assert [job.name for job in read_jobs(folder, BOARD, "opencv5")] == ["east", "west"]


class TestSharing:
    """Cameras with the hybrid lens that saw one board end as `calibrate_cameras` calibrates them."""

    def batch(self, folder, output, crew):
        results = Results(output, read_jobs(folder, BOARD, "hybrid"), BatchOptions())
        done = []
        run_tasks(results.tasks(done.append), results.done, crew)
        (numbers,) = sharing_jobs(results.jobs)
        results.share(numbers, crew)
        assert len(done) == pieces(results.jobs) == 8 + 2 + 2
        return results

    @pytest.mark.slow
    @in_one_thread  # several would add in another order
    def test_it_is_what_python_gives(self, folder, place, monkeypatch):
        crew = Here()
        out = place / "out"
        # A worker that fails leaves cameras as they are alone, and the next run tries again.
        for kind in (WorkerDiedError, DegenerateError):
            with monkeypatch.context() as patch:
                patch.setattr("kcal.calibrate.batch.results.calibrate_again", Mock(side_effect=kind("out of memory")))
                results = self.batch(folder, out, crew)
            for row in results.rows():
                assert "calibrated alone, without what other cameras tell of the board: out of memory" in row.warnings
                assert row.rms is not None
        # Lines of cameras that may measure a board together are kept until then.
        assert (len(results._views), len(results._calibrated)) == (2, 2)
        self.batch(folder, out, crew)
        seen = [Observations.load(out / f"{name}.obs.json") for name in ("east", "west")]
        for name, result in zip(("east", "west"), calibrate_cameras(seen), strict=True):
            kept = load_camera(out / f"{name}.camera.json")
            torch.testing.assert_close(kept.params, result.camera.params, rtol=1e-12, atol=0)
        # Once more, nothing is left to do: of each camera four images, the calibration alone, and that with both.
        monkeypatch.setattr(Pool, "submit", lambda _, task: crew.submit(task))
        before = len(crew.tasks)
        again = ran("batch", folder, *WHAT, "-o", out)
        assert (again.exit_code, len(crew.tasks)) == (0, before)
        assert "12 of 12 pieces of work were there already" in again.output
        (folder / "empty").mkdir()
        result = ran("batch", folder, *WHAT, "-o", out)
        assert result.exit_code == 1
        assert "1 of 3 cameras failed: empty" in str(result.exception)
        assert "4 of 4" in result.output
        with (out / "summary.csv").open() as file:
            assert [row["status"] for row in csv.DictReader(file)] == ["ok", "failed", "ok"]


def test_refusals_of_the_command(folder, place):
    for words, message in (("--board 6x5", "give the side of its squares"), ("--square 1 --model best", "model")):
        assert message in str(ran("batch", folder, *words.split(), "-o", place / "none").exception)
    assert not (place / "none").exists()


def test_images_that_were_resized_are_scaled_and_it_is_said(folder, images, place):
    """In the table's warnings; one that was cropped is left out."""
    small = cv2.imdecode(np.frombuffer(images["east"][0], np.uint8), cv2.IMREAD_GRAYSCALE)
    half = cv2.resize(small, (small.shape[1] // 2, small.shape[0] // 2), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(folder / "east" / "half.png"), cv2.resize(small, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC))
    rows, _ = run(folder, place / "out")
    height, width = small.shape
    assert f"scaled to {width}x{height} px of most images: half.png from {2 * width}x{2 * height}" in rows[0].warnings
    seen = Observations.load(place / "out" / "east.obs.json")
    assert seen.image_size == (width, height)
    first, again = seen.names.index("0.png"), seen.names.index("half.png")
    assert float((seen.pixels()[first] - seen.pixels()[again]).norm(dim=-1).max()) < 0.2
    cv2.imwrite(str(folder / "east" / "half.png"), half[:-10])
    rows, _ = run(folder, place / "out")
    assert "images were left out, because their size is not the" in rows[0].warnings
    assert [row.error for row in rows] == ["", ""]


class TestJobs:
    def test_table(self, folder, place):
        table = folder / "cameras.csv"
        table.write_text(
            "\ufeffcamera, images,board,square,model\n"
            " a , east ,6x5,20mm,\n"
            "b,west/*.png,,,opencv4\n"
            "c,nowhere/*.png,,,\n"
            "d,east,nonsense,20mm,\n"
        )  # fmt: skip
        jobs = read_jobs(table, Board(columns=6, rows=5, square=0.1), "opencv8")
        assert [job.name for job in jobs] == ["a", "b", "c", "d"]
        # A board that is wrong stays with its camera.
        assert [bool(job.error) for job in jobs] == [False, False, True, True]
        assert [job.model for job in jobs[:2]] == ["opencv8", "opencv4"]
        assert [job.board.square for job in jobs[:2]] == [0.02, 0.1]
        assert [len(job.images) for job in jobs[:3]] == [4, 4, 0]
        assert "no such file" in jobs[2].error or "no file matches" in jobs[2].error

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("name,images\na,east\n", "must name the columns"),
            ("camera,images,color\na,east,red\n", "must name the columns"),
            ("camera,images\n", "no camera"),
            ("camera,images\na,east,\n", "line 2: 2 fields"),
            ("camera,images\na,east\na,west\n", "two cameras"),
            ("camera,images\n../a,east\n", "cannot name a camera"),
            ("camera,images\n\xff,a\n", "not UTF-8"),
        ],
    )
    def test_bad_tables(self, folder, text, message):
        (folder / "t.csv").write_text(text, encoding="latin-1")
        with pytest.raises(KcalError, match=message):
            read_jobs(folder / "t.csv", BOARD, "opencv5")

    def test_no_board_and_no_folders(self, folder):
        (folder / "t.csv").write_text("camera,images\nb,east\n")
        for where, message in ((folder, "no board"), (folder / "t.csv", "camera 'b': no board")):
            with pytest.raises(InputError, match=message):
                read_jobs(where, None, "opencv5")
        with pytest.raises(FileError, match="no folders"):
            read_jobs(folder / "east", BOARD, "opencv5")
        with pytest.raises(FileError, match="cannot read"):
            read_jobs(folder / "none.csv", BOARD, "opencv5")


@pytest.mark.slow
def test_every_piece_comes_back_when_workers_die(folder):
    # os._exit stands for a crash in a C++ library; the last one goes beyond its time limit.
    slow = detect_image, (str(folder / "east" / "0.png"), BOARD, BatchOptions(time_limit=1e-3))
    tasks = [Task(0, os.getpid, ()), Task(1, os._exit, (3,)), Task(2, abs, (-7,)), Task(3, *slow)]
    found = {}

    def done(task, outcome):
        found[task.tag] = outcome
        return [Task(4, divmod, (7, 0))] if task.tag == 2 else []

    with pool(1) as workers:
        run_tasks(tasks, done, workers)
    assert found[0] != os.getpid()
    assert found[2] == 7
    assert isinstance(found[1], WorkerDiedError)
    assert isinstance(found[3], WorkerDiedError)
    assert "--time-limit" in str(found[3])
    assert isinstance(found[4], ZeroDivisionError)


@pytest.mark.slow
def test_a_killed_run_continues_and_gives_the_same_table(folder, first, place):
    out = place / "new"
    words = ["batch", str(folder), *WHAT, "--model", "opencv5", "--workers", "1", "-o", str(out)]
    # A session of its own, so that the workers die with it: one that lived on could still finish a piece.
    dead = subprocess.run([sys.executable, interrupted.__file__, "killed:3", *words], start_new_session=True)
    assert dead.returncode == -signal.SIGKILL
    before = {path: path.stat().st_mtime_ns for path in out.glob(".work/*.json")}
    assert len(before) == 3
    assert not (out / "summary.csv").exists()
    again = subprocess.run([sys.executable, "-m", "kcal", *words], capture_output=True, text=True)
    assert again.returncode == 0, again.stderr
    assert "3 of 10 pieces of work were there already" in again.stdout
    for path, stamp in before.items():
        assert path.stat().st_mtime_ns == stamp
    rows = list(csv.DictReader((out / "summary.csv").open()))
    assert [list(row) for row in rows] == [list(row._asdict()) for row in first]
    for row, known in zip(rows, first, strict=True):
        for key, value in known._asdict().items():
            # As above: pieces that were solved anew agree to what the iteration is stopped at.
            if isinstance(value, float):
                assert float(row[key]) == pytest.approx(value, rel=1e-4)
            else:
                assert row[key] == ("" if value is None else str(value))


def test_the_lines_of_finished_cameras_are_not_kept(folder, place):
    """Nor the views of cameras that will not measure a board together."""
    results = Results(place / "out", read_jobs(folder, BOARD, "pinhole"), BatchOptions())
    run_tasks(results.tasks(lambda _: None), results.done, Here())
    assert (len(results._views), len(results._calibrated), any(results._pieces)) == (0, 0, False)
    assert [(row.camera, row.status, row.views) for row in results.rows()] == [("east", "ok", 4), ("west", "ok", 4)]


@pytest.mark.slow
def test_dask(folder, first, place):
    with pytest.importorskip("distributed").LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None
    ) as cluster:
        plain = [*WHAT, "--model", "opencv5"]
        result = ran("batch", folder, *plain, "-o", place / "new", "--scheduler", cluster.scheduler_address)
    assert result.exit_code == 0, result.exception
    rows = list(csv.DictReader((place / "new" / "summary.csv").open()))
    assert [float(row["rms"]) for row in rows] == pytest.approx([row.rms for row in first], rel=1e-6)


@pytest.fixture
def dask_processes(tmp_path):
    """A scheduler and one worker without a nanny, each a process of its own."""
    pytest.importorskip("distributed")
    where = tmp_path / "scheduler.json"
    started = []
    try:
        for arguments in (["scheduler", "--port", "0"], ["worker", "--no-nanny", "--nthreads", "1"]):
            command = [sys.executable, "-m", "distributed.cli.dask_" + arguments[0], *arguments[1:]]
            command += ["--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", str(where)]
            quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": tmp_path}
            started.append(subprocess.Popen(command, **quiet))
            # Its file is there before all of it is written.
            wait_for(lambda: where.exists() and where.read_text().endswith("}"))
        yield json.loads(where.read_text())["address"], *started
    finally:
        for process in started:
            process.kill()
            process.wait()


@pytest.mark.slow
@pytest.mark.parametrize("killed", ["scheduler", "worker"])
def test_a_scheduler_or_its_last_worker_that_dies_is_an_error(dask_processes, monkeypatch, killed):
    address, scheduler, worker = dask_processes
    monkeypatch.setattr("kcal.calibrate.batch.results._LOOK", 0.5)
    monkeypatch.setattr("kcal.calibrate.batch.results.WORKERS_BACK", 1.0)
    with pool(1, address) as workers:
        wait_for(lambda: bool(workers._client.nthreads()))
        threading.Timer(1.0, (scheduler if killed == "scheduler" else worker).kill).start()
        with pytest.raises(FileError, match="the Dask scheduler or its last worker is gone"):
            run_tasks([Task(0, time.sleep, (600,)), Task(1, time.sleep, (600,))], lambda *_: [], workers)


def test_no_scheduler():
    pytest.importorskip("distributed")
    with pytest.raises(FileError, match="no Dask scheduler"):
        Pool(1, "not-an-address")
