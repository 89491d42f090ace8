"""One thread while small systems are solved, and the caller's settings of before afterwards."""

import gc
import os
import signal
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import MagicMock

import cv2
import pytest
import scipy.linalg  # noqa: F401  has a BLAS of its own
import torch
from threadpoolctl import ThreadpoolController
from waiting import PATIENCE

from kcal import Observations, calibrate_camera
from kcal.__main__ import _THREADS, main
from kcal.threads import in_one_thread, one_thread

# Other tests load libraries that nothing computes with, each with an OpenMP of its own.
LIBRARIES = [
    one
    for one in ThreadpoolController().lib_controllers
    if not {"rawpy.libs", "pycolmap.libs"} & set(Path(one.filepath).parts)
]


def numbers() -> list[int]:
    """Threads of torch, OpenCV and all BLAS and OpenMP libraries, as this thread sees them."""
    return [torch.get_num_threads(), cv2.getNumThreads(), *(library.num_threads for library in LIBRARIES)]


@pytest.fixture(autouse=True)
def several() -> Iterator[list[int]]:
    """Settings of a user, each another one."""
    before = numbers()
    torch.set_num_threads(3)
    cv2.setNumThreads(2)
    for library in LIBRARIES:
        library.set_num_threads(3 if library.user_api == "openmp" else 2)
    yield numbers()
    torch.set_num_threads(before[0])
    cv2.setNumThreads(before[1])
    for library, number in zip(LIBRARIES, before[2:], strict=True):
        library.set_num_threads(number)


def test_it_is_one_in_blocks_within_blocks_and_as_before_after_them(several: list[int]) -> None:
    assert set(several) == {2, 3}
    with one_thread():
        with one_thread():
            assert set(numbers()) == {1}
        assert set(numbers()) == {1}
    assert numbers() == several
    with pytest.raises(KeyError), one_thread():
        raise KeyError
    assert numbers() == several


def test_threads_that_overlap(several: list[int]) -> None:
    """The first to come is not the last to go, and who comes meanwhile gets back what it had."""
    inside, leave = threading.Barrier(2, timeout=PATIENCE), threading.Event()
    found: dict[str, list[int]] = {}

    def first() -> None:
        with one_thread():
            inside.wait()
            leave.wait(PATIENCE)
        found["first"] = numbers()

    def second() -> None:
        with one_thread():
            inside.wait()
            found["while"] = numbers()
            leave.set()
            threads[0].join()
            # OpenBLAS and OpenCV have one number for all threads.
            found["left"] = numbers()
        found["second"] = numbers()

    threads = [threading.Thread(target=work) for work in (first, second)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert set(found["while"]) == set(found["left"]) == {1}
    assert found["second"] == numbers() == several


def test_many_threads(several: list[int]) -> None:
    def work(_: int) -> set[int]:
        with one_thread():
            return set(numbers())

    with ThreadPoolExecutor(8) as pool:
        assert all(found == {1} for found in pool.map(work, range(200)))
        assert all(list(pool.map(lambda _: numbers() == several, range(50))))


def test_the_doors_bound(several: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def fit(*_: object, **__: object) -> None:
        seen.append(numbers())
        raise ArithmeticError

    monkeypatch.setattr("kcal.calibrate.camera.calibrate.unusable_views", fit)
    views = MagicMock()
    views.__class__ = Observations  # type: ignore[assignment]
    with pytest.raises(ArithmeticError):
        calibrate_camera(views)
    assert set(seen[0]) == {1}
    assert numbers() == several


def test_the_command_and_its_processes_have_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the environment of the user asks for more."""
    seen: dict[str, str] = {}
    monkeypatch.setenv("OMP_NUM_THREADS", "8")
    monkeypatch.setattr("kcal.cli.main.main", lambda: seen.update(os.environ))
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
        monkeypatch.setenv(name, "8")
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    thresholds, interrupted = gc.get_threshold(), signal.getsignal(signal.SIGINT)
    with pytest.raises(SystemExit):
        main()
    signal.signal(signal.SIGINT, interrupted)
    gc.unfreeze()
    gc.set_threshold(*thresholds)
    assert {seen[name] for name in _THREADS} == {"1"}


def test_a_function_keeps_its_name_and_result() -> None:
    @in_one_thread
    def double(x: int) -> int:
        """Twice."""
        return 2 * x

    assert (double.__name__, double.__doc__, double(2)) == ("double", "Twice.", 4)
