"""Calibrate a batch of cameras; keep finished pieces of work on disk, and make files and a table from them."""

from __future__ import annotations

import hashlib
import math
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from kcal.calibrate.batch.jobs import (
    WORK,
    BatchOptions,
    Calibrated,
    CameraJob,
    Detected,
    calibrate_again,
    calibrate_observations,
    calibrated,
    calibration_options,
    detect_image,
    hash_of,
    observations_of,
    pieces,
    sharing_jobs,
)
from kcal.calibrate.camera.calibrate import ALONE, sharing
from kcal.calibrate.camera.result import HYBRID, CameraCalibrationResult
from kcal.corners.detect import limit_threads
from kcal.corners.images import image_bytes
from kcal.corners.observations import Observations
from kcal.errors import FileError, InputError, KcalError
from kcal.files import dump_json, make_folder, read_bytes, write_atomic
from kcal.lens.uncertainty import paraxial_focal
from kcal.native_file import NativeFile
from kcal.strict_json import MOST_BYTES, read_json
from kcal.texts import csv_line
from kcal.threads import deaf_to_interrupts

Piece = TypeVar("Piece", bound=NativeFile)


class SummaryRow(NamedTuple):
    """One camera in the table.

    `failures` counts images without a board. `focal` is the focal length on the optical axis, the mean of both axes;
    fx and fy are parameters of the lens model.
    """

    camera: str
    status: str
    model: str
    images: int
    views: int
    failures: int
    width: int | None = None
    height: int | None = None
    rms: float | None = None
    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    sigma_fx: float | None = None
    focal: float | None = None
    sigma_focal: float | None = None
    warnings: str = ""
    error: str = ""


class BatchReport(NamedTuple):
    """A finished batch.

    Attributes:
        rows: one for each camera, in their order.
        summary: the CSV file with these rows.
        reused: how many pieces of work were finished before.
        total: how many pieces of work there are.
    """

    rows: list[SummaryRow]
    summary: Path
    reused: int
    total: int


def calibrate_batch(
    jobs: Sequence[CameraJob],
    folder: str | Path,
    options: BatchOptions | None = None,
    *,
    workers: int = 0,
    scheduler: str | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> BatchReport:
    """Calibrate many cameras from their images, in parallel.

    Writes NAME.obs.json and NAME.camera.json for each camera, and summary.csv. Finished pieces of work are kept in a
    folder `.work`: the same call continues an interrupted run. A camera that fails does not stop the others. When all
    are done, cameras with the hybrid lens that saw one printed board share what they know of it.

    Args:
        jobs: the cameras, from `kcal.calibrate.batch.jobs.read_jobs`.
        folder: for the results; made if it is missing.
        options: see `BatchOptions`.
        workers: processes on this machine; 0 for one per core.
        scheduler: address of a Dask scheduler whose workers see the same files, instead of processes.
        progress: called with a text after each piece of work.

    Raises:
        InputError: a scheduler is given but `distributed` is not installed.
        FileError: the folder cannot be made, or the scheduler does not answer.
    """
    folder = Path(folder)
    results = Results(folder, jobs, options or BatchOptions())
    with pool(workers or os.cpu_count() or 1, scheduler) as crew:
        run_tasks(results.tasks(progress), results.done, crew)
        for numbers in sharing_jobs(jobs):
            results.share(numbers, crew)
    rows = results.rows()
    return BatchReport(rows, write_summary(folder / "summary.csv", rows), results.reused, pieces(jobs))


class Results:
    """The state of a batch in a folder.

    Args:
        folder: made if missing.
        jobs: the cameras.
        options: of all cameras.

    Raises:
        FileError: the folder cannot be made.
    """

    def __init__(self, folder: Path, jobs: Sequence[CameraJob], options: BatchOptions) -> None:
        self.folder, self.jobs, self.options = folder, jobs, options
        self.reused = 0
        self._work = make_folder(folder / WORK)
        self._advance: Callable[[str], None] = lambda _: None
        self._pieces: list[list[Detected | None]] = [[None] * len(job.images) for job in jobs]
        self._digests: list[list[str]] = [[""] * len(job.images) for job in jobs]
        self._views: dict[int, Observations] = {}
        # What was done about images of several sizes.
        self._notes: dict[int, str] = {}
        self._calibrated: dict[int, Calibrated] = {}
        # Cameras whose views are needed once more when all are done; of the others only their line is kept.
        self._share = {number for numbers in sharing_jobs(jobs) for number in numbers}
        self._rows: dict[int, SummaryRow] = {}

    def tasks(self, advance: Callable[[str], None]) -> Iterator[Task]:
        """Yield what is left to do, image after image; `advance` is called after each piece of work."""
        self._advance = advance
        for number, job in enumerate(self.jobs):
            if job.error:
                self._remove_old(number)
            for i, path in enumerate(job.images):
                yield from self._image(number, i, path)

    def _image(self, number: int, i: int, path: Path) -> Iterator[Task]:
        board = self.jobs[number].board
        assert board is not None
        try:
            digest = hashlib.sha256(image_bytes(path)).hexdigest()
        except FileError as error:
            yield from self._detected(number, i, Detected(reason=str(error).removeprefix(f"{path}: ")))
            return
        self._digests[number][i] = digest
        key = hash_of("detected", digest, board.model_dump_json(), self.options.refine)
        kept = self._load(Detected, key)
        if kept is not None:
            yield from self._detected(number, i, kept)
        else:
            yield Task(("image", number, i, key), detect_image, (str(path), board, self.options))

    def done(self, task: Task, outcome: Any) -> list[Task]:
        """Keep the outcome of a task; return the calibration that has become possible."""
        kind, number, i, key = task.tag
        if isinstance(outcome, NativeFile):
            self._keep(key, outcome)
        else:
            # Not kept: more memory or time may help.
            why = str(outcome) if isinstance(outcome, KcalError) else f"{type(outcome).__name__}: {outcome}"
            outcome = Detected(reason=why) if kind == "image" else Calibrated(error=why)
        if kind == "image":
            return self._detected(number, i, outcome)
        self._finish(number, outcome)
        return []

    def _detected(self, number: int, i: int, piece: Detected) -> list[Task]:
        job = self.jobs[number]
        self._pieces[number][i] = piece
        self._advance(f"{job.name} {job.images[i].name}")
        pieces = [piece for piece in self._pieces[number] if piece is not None]
        if len(pieces) < len(job.images):
            return []
        try:
            seen, self._notes[number] = observations_of(job, pieces, self._digests[number], self.options.refine)
        except KcalError as error:
            self._finish(number, Calibrated(error=str(error)))
            return []
        self._views[number] = seen
        seen.save(self._file(number, "obs"))
        key = hash_of("calibrated", job.name, job.model, self.options.board_warp, seen.dump())
        kept = self._load(Calibrated, key)
        if kept is not None:
            self._finish(number, kept)
            return []
        return [Task(("camera", number, 0, key), calibrate_observations, (seen, job.name, job.model, self.options))]

    def _finish(self, number: int, result: Calibrated) -> None:
        self._calibrated[number] = result
        if result.camera is not None:
            result.camera.save(self._file(number, "camera"))
        else:
            self._remove_old(number)
        self._pieces[number].clear()
        if number not in self._share:
            self._rows[number] = self._row(number, self.jobs[number])
            del self._calibrated[number]
            self._views.pop(number, None)
        self._advance(self.jobs[number].name)

    def _file(self, number: int, kind: str) -> Path:
        return self.folder / f"{self.jobs[number].name}.{kind}.json"

    def _remove_old(self, number: int) -> None:
        """Remove what is of an earlier run with other images; of images that come back it is made again at once."""
        self._file(number, "camera").unlink(missing_ok=True)
        if number not in self._views:
            self._file(number, "obs").unlink(missing_ok=True)

    def share(self, numbers: Sequence[int], crew: Pool) -> None:
        """Calibrate cameras that may have seen one board again, each with the board as the others measured it."""
        good = [i for i in numbers if self._calibrated[i].camera is not None]
        everything = hash_of("together", self.options, [self._views[i].dump() for i in good])
        keys = {i: hash_of("shared", everything, self.jobs[i].name) for i in good}
        kept = {i: self._load(Calibrated, key) for i, key in keys.items()} if len(good) > 1 else {}
        if any(piece is None for piece in kept.values()):
            try:
                alone = self._each(calibrate_again, {i: (self._views[i], self.options) for i in good}, crew)
                found = sharing(
                    [alone[i] for i in good],
                    calibration_options(HYBRID, self.options),
                    one_type=self.options.one_type,
                    run=lambda function, tasks: self._each(function, tasks, crew).items(),
                )
            except KcalError as error:
                # What is there is good: cameras that know their own views only. It is not kept as a finished piece.
                for i in good:
                    before = self._calibrated[i]
                    kept[i] = before.model_copy(update={"warnings": (*before.warnings, f"{ALONE}: {error}")})
                found = []
            for i, result in zip(good, found, strict=False):
                if isinstance(result, CameraCalibrationResult):
                    piece = calibrated(result, self.jobs[i].name)
                    self._keep(keys[i], piece)
                    kept[i] = piece
        for i in numbers:
            self._finish(i, kept.get(i) or self._calibrated[i])

    def _each(self, function: Callable[..., Any], tasks: dict[int, tuple[Any, ...]], crew: Pool) -> dict[int, Any]:
        """Call a function with each of the numbered arguments on the workers."""
        found: dict[int, Any] = {}

        def done(task: Task, outcome: Any) -> list[Task]:
            if isinstance(outcome, Exception):
                raise outcome
            found[task.tag] = outcome
            return []

        run_tasks((Task(i, function, arguments) for i, arguments in tasks.items()), done, crew)
        return found

    def rows(self) -> list[SummaryRow]:
        """The table, in the order of the cameras."""
        return [self._rows.get(number) or self._row(number, job) for number, job in enumerate(self.jobs)]

    def _row(self, number: int, job: CameraJob) -> SummaryRow:
        result = self._calibrated.get(number, Calibrated(error=job.error))
        seen = self._views.get(number)
        views = len(seen.views) if seen is not None else 0
        camera = result.camera
        row = SummaryRow(
            camera=job.name,
            status="failed" if camera is None else "ok",
            model=job.model,
            images=len(job.images),
            views=views,
            failures=len(job.images) - views,
            width=seen.image_size[0] if seen is not None else None,
            height=seen.image_size[1] if seen is not None else None,
            warnings="; ".join(filter(None, (self._notes.get(number), *result.warnings))),
            error=result.error,
        )
        if camera is None or camera.calibration is None:
            return row
        focal, sigma_focal = paraxial_focal(camera.camera()).mean
        return row._replace(
            focal=focal,
            sigma_focal=None if math.isnan(sigma_focal) else sigma_focal,
            rms=camera.calibration.rms,
            sigma_fx=(camera.standard_deviations or {}).get("fx"),
            **camera.intrinsics.model_dump(exclude={"skew"}),
        )

    def _path(self, key: str) -> Path:
        return self._work / f"{key}.json"

    def _keep(self, key: str, piece: NativeFile) -> None:
        content = piece.dump()
        write_atomic(self._path(key), dump_json({"sha256": _checksum(content), "piece": content}))

    def _load(self, kind: type[Piece], key: str) -> Piece | None:
        """Load a finished piece; one that cannot be read, or was changed since, is done again."""
        path = self._path(key)
        if not path.exists():
            return None
        try:
            kept = read_json(read_bytes(path, MOST_BYTES), str(path))
            if not isinstance(kept, dict) or kept.get("sha256") != _checksum(kept.get("piece")):
                return None
            piece = kind.parse(kept["piece"], str(path))
        except KcalError:
            return None
        self.reused += 1
        return piece


def _checksum(content: Any) -> str:
    return hashlib.sha256(dump_json(content).encode()).hexdigest()


def write_summary(path: Path, rows: list[SummaryRow]) -> Path:
    """Write the table as CSV, atomically."""
    return write_atomic(path, "".join(csv_line(row) for row in [SummaryRow._fields, *rows]))


# Run many pieces of work on many processes; each returns a result or a reason, even if its process dies.


class Task(NamedTuple):
    """A function call for a worker; `tag` tells the caller which call it was."""

    tag: Any
    function: Callable[..., Any]
    arguments: tuple[Any, ...]


class WorkerDiedError(KcalError):
    """The process of a piece of work ended: out of memory, over its time limit, or crashed."""


# Seconds after which the workers are looked after, and that a scheduler may be without any.
_LOOK, WORKERS_BACK = 5.0, 60.0
_GONE = "the Dask scheduler or its last worker is gone; start them and run the same command: finished work is kept"

# Called with a finished task and its result or exception; returns tasks that can now be done.
Done = Callable[[Task, Any], Iterable[Task]]


class Pool:
    """Processes on this machine, started again when one of them dies, or a Dask scheduler's workers.

    Args:
        workers: processes, if there is no scheduler.
        scheduler: address of a Dask scheduler, or None.

    Raises:
        InputError: a scheduler is given but `distributed` is not installed.
        FileError: the scheduler does not answer.
    """

    def __init__(self, workers: int, scheduler: str | None = None) -> None:
        self.workers = workers
        self._client: Any = None
        self._executor: Executor | None = None
        self._alone_since: float | None = None
        if scheduler is not None:
            self._client = _connect(scheduler)
            self.workers, self._counted_at = 1, -math.inf

    @property
    def ahead(self) -> int:
        """How many tasks to hand out at a time: enough to keep workers busy, few enough to hold in memory.

        Workers of a scheduler come and go, so they are counted again from time to time.
        """
        if self._client is not None and time.monotonic() - self._counted_at > _LOOK:
            self._counted_at = time.monotonic()
            with suppress(OSError, TimeoutError, CancelledError):  # `check` tells what is missing
                self.workers = max(1, sum(self._client.nthreads().values()))
        return 3 * self.workers

    def submit(self, task: Task) -> Future[Any]:
        """Hand out a task."""
        if self._executor is None:
            if self._client is not None:
                # Dask would answer a pure task from its memory of the same arguments, even if files have changed.
                self._executor = self._client.get_executor(pure=False)
            else:
                # Not forked: a fork copies the locks of OpenCV's and torch's threads, but not the threads.
                context = multiprocessing.get_context("spawn")
                self._executor = ProcessPoolExecutor(self.workers, mp_context=context, initializer=_begin)
        try:
            with deaf_to_interrupts():
                return self._executor.submit(_in_one_thread, task.function, *task.arguments)
        except (RuntimeError, OSError, ValueError) as error:
            # What a closed Dask client raises; a broken pool of processes is the caller's to mend.
            if self._client is None:
                raise
            raise FileError(_GONE) from error

    def restart(self) -> None:
        """Forget the processes; the next task starts new ones."""
        if isinstance(self._executor, ProcessPoolExecutor):
            self._executor.shutdown(wait=False, cancel_futures=True)
        elif self._executor is not None:
            self._executor.shutdown(wait=False)
        self._executor = None

    def check(self) -> None:
        """Raise `FileError` if nobody is left to do the tasks: the scheduler, or all its workers, are gone.

        Processes on this machine tell so themselves. Workers have a minute to come back.
        """
        if self._client is None:
            return
        try:
            if self._client.status in ("closing", "closed"):
                raise FileError(_GONE)
            alive = self._client.status == "running" and bool(self._client.nthreads())
        except (OSError, TimeoutError, CancelledError):
            alive = False
        if alive:
            self._alone_since = None
        elif self._alone_since is None:
            self._alone_since = time.monotonic()
        elif time.monotonic() - self._alone_since > WORKERS_BACK:
            raise FileError(_GONE)

    def close(self) -> None:
        """Release all workers."""
        self.restart()
        if self._client is not None:
            # What happens while a connection ends that may be broken already does not matter.
            with suppress(Exception):
                self._client.close(timeout=5)


def pool(workers: int, scheduler: str | None = None) -> closing[Pool]:
    """A `Pool` that is closed at the end, also after an interruption."""
    return closing(Pool(workers, scheduler))


def run_tasks(tasks: Iterable[Task], done: Done, workers: Pool) -> None:
    """Do all tasks, and those that `done` adds; `done` is called in this process, once per task, in any order.

    A task whose worker dies is tried once more, alone; if its worker dies again it is given up with
    `WorkerDiedError`.
    """
    source = iter(tasks)
    added: deque[Task] = deque()
    pending: dict[Future[Any], Task] = {}
    casualties: list[Task] = []
    while True:
        while len(pending) < workers.ahead and not casualties:
            task = added.popleft() if added else next(source, None)
            if task is None:
                break
            try:
                pending[workers.submit(task)] = task
            except BrokenExecutor:
                casualties.append(task)
        if not pending and not casualties:
            return
        finished, _ = wait(pending, _LOOK, return_when=FIRST_COMPLETED) if pending else (set(), None)
        if pending and not finished:
            workers.check()
        for future in finished:
            task = pending.pop(future)
            outcome = _result_of(future)
            if isinstance(outcome, WorkerDiedError) and isinstance(future.exception(), BrokenExecutor):
                casualties.append(task)
            else:
                added.extend(done(task, outcome))
        if casualties and not pending:
            workers.restart()
            for task in casualties:
                outcome = _result_of(workers.submit(task))
                if isinstance(outcome, WorkerDiedError):
                    workers.restart()
                added.extend(done(task, outcome))
            casualties.clear()


def _result_of(future: Future[Any]) -> Any:
    """The result, or the exception instead of raising it.

    Raises:
        FileError: the task was given up because the scheduler is gone.
    """
    try:
        error = future.exception()
    except CancelledError:
        raise FileError(_GONE) from None
    if error is None:
        return future.result()
    if isinstance(error, BrokenExecutor) or type(error).__name__ == "KilledWorker":
        return WorkerDiedError("its process ended: out of memory, over the time limit (--time-limit), or crashed")
    return error


def _begin() -> None:
    """In a new process: leave Ctrl-C to the parent, end when the parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _in_one_thread(function: Callable[..., Any], *arguments: Any) -> Any:
    """A task on one of as many workers as cores, which may have been started a moment ago, after another one died."""
    limit_threads(1)
    return function(*arguments)


def _connect(address: str) -> Any:
    try:
        from distributed import Client
    except ImportError:
        raise InputError('--scheduler needs Dask: pip install "kcal[dask]"') from None
    try:
        return Client(address, timeout=15, set_as_default=False)
    except (OSError, ValueError) as error:
        raise FileError(f"{address}: no Dask scheduler answers here: {error}") from error
